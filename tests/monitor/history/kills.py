"""Kills a writer at random moments, and looks at what it left."""

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
from tests.monitor.history.killed import T0, row_of

ALL = TimeRange(float("-inf"), float("inf"))
ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Left:
    """What was found after a kill."""

    acknowledged: int  # rows that the writer had said were written
    found: int  # minutes in the file
    widths: tuple[int, ...]  # of the rows


def kill_once(path: Path, first: int, rng: random.Random, within_s: float) -> Left:
    """Let a writer begin at minute ``first``, kill it at a random moment after its first row, and check the file."""
    command = [sys.executable, "-m", "tests.monitor.history.killed", str(path), str(first)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        said = [process.stdout.readline()]
        time.sleep(rng.uniform(0.0, within_s))
        process.kill()
        said += process.stdout.readlines()
    lines = [line for line in said if line.endswith("\n")]
    return check(path, int(lines[-1]) + 1)


def check(path: Path, acknowledged: int) -> Left:
    """Every minute in one row, none missing, sums and extremes exact."""
    with open_history(path) as reader:
        rows = sorted(reader.read_rows("bench-1", ALL), key=lambda row: row.start_s)
        events, in_all = reader.read_events("bench-1", ALL, 10_000_000)
    found = (rows[-1].end_s - T0) // 60 if rows[-1].width_s == 60 else _minutes(rows)
    assert found in (acknowledged, acknowledged + 1), (found, acknowledged)
    assert in_all == len(events) == found
    assert [one.t_s for one in events] == [T0 + 60.0 * i for i in range(found)]
    at = T0
    for row in rows:
        assert row.start_s == at, "a bucket twice, or missing"
        at = row.end_s
        inside = [row_of(i) for i in range((row.start_s - T0) // 60, min((row.end_s - T0) // 60, found))]
        assert row.n.tolist() == [sum(int(one.n[0]) for one in inside)] * 2
        assert row.counts == tuple(sum(one.counts[i] for one in inside) for i in range(4))
        assert float(row.low[0]) == min(float(one.low[0]) for one in inside)
        assert float(row.high[0]) == max(float(one.high[0]) for one in inside)
        assert float(row.last[0]) == float(inside[-1].last[0])
    return Left(acknowledged, found, tuple(sorted({row.width_s for row in rows})))


def _minutes(rows: list[HistoryRow]) -> int:
    return sum(int(row.counts[1]) for row in rows)  # each minute lost one sample


def kill(path: Path, times: int, seed: int, within_s: float) -> list[Left]:
    """So many writers one after the other on one file."""
    rng, left = random.Random(seed), []
    first = 0
    for _ in range(times):
        left.append(kill_once(path, first, rng, within_s))
        first = left[-1].found
    assert np.all(np.diff([one.found for one in left]) > 0)
    return left
