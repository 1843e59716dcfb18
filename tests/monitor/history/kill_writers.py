"""Kill a history writer at random times and check the file that it leaves."""

import random
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monitor.history.history_row import HistoryRow
from monitor.history.sqlite_store import open_history
from monitor.history.time_ranges import TimeRange
from tests.monitor.history.killed_writer import T0, make_minute_row

ALL_TIMES = TimeRange(float("-inf"), float("inf"))
ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class KillResult:
    """Content of the history file after a kill."""

    acknowledged: int  # rows that the writer reported as written
    found: int  # minutes found in the file
    widths: tuple[int, ...]  # widths of the rows in seconds


def kill_writer_once(path: Path, first: int, rng: random.Random, within_s: float) -> KillResult:
    """Start a writer at minute ``first``, kill it at a random time after its first row, and check the file."""
    command = [sys.executable, "-m", "tests.monitor.history.killed_writer", str(path), str(first)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        time.sleep(rng.uniform(0.0, within_s))
        process.kill()
        lines += process.stdout.readlines()
    complete_lines = [line for line in lines if line.endswith("\n")]
    return check_history(path, int(complete_lines[-1]) + 1)


def check_history(path: Path, acknowledged: int) -> KillResult:
    """Check that every minute is in exactly one row, with exact sums and extremes."""
    with open_history(path) as reader:
        rows = sorted(reader.read_rows("bench-1", ALL_TIMES), key=lambda row: row.start_s)
        events, event_count = reader.read_events("bench-1", ALL_TIMES, 10_000_000)
    found = (rows[-1].end_s - T0) // 60 if rows[-1].width_s == 60 else _count_minutes(rows)
    assert found in (acknowledged, acknowledged + 1), (found, acknowledged)
    assert event_count == len(events) == found
    assert [event.t_s for event in events] == [T0 + 60.0 * i for i in range(found)]
    expected_start_s = T0
    for row in rows:
        assert row.start_s == expected_start_s, "a bucket is missing or repeated"
        expected_start_s = row.end_s
        inside = [make_minute_row(i) for i in range((row.start_s - T0) // 60, min((row.end_s - T0) // 60, found))]
        assert row.n.tolist() == [sum(int(minute.n[0]) for minute in inside)] * 2
        assert row.counts == tuple(sum(minute.counts[i] for minute in inside) for i in range(4))
        assert float(row.low[0]) == min(float(minute.low[0]) for minute in inside)
        assert float(row.high[0]) == max(float(minute.high[0]) for minute in inside)
        assert float(row.last[0]) == float(inside[-1].last[0])
    return KillResult(acknowledged, found, tuple(sorted({row.width_s for row in rows})))


def _count_minutes(rows: list[HistoryRow]) -> int:
    return sum(int(row.counts[1]) for row in rows)  # each minute has one lost sample


def kill_writers(path: Path, times: int, seed: int, within_s: float) -> list[KillResult]:
    """Start and kill this many writers one after the other on one file."""
    rng, results = random.Random(seed), []
    first = 0
    for _ in range(times):
        results.append(kill_writer_once(path, first, rng, within_s))
        first = results[-1].found
    assert np.all(np.diff([result.found for result in results]) > 0)
    return results
