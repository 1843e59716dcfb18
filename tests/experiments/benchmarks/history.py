"""Cost of the history per estimate, its size after years, duration of queries, and consistency after kills.

    python -m tests.experiments.benchmarks.history [--years 5] [--kills 100] [--keep FILE]

The simulated years belong to one device of six axes and are written as by the daemon. There is a row for each minute
with all numbers of a window of an hour at 100 Hz, and an event every three hours. Old rows are merged. The values
change slowly, with steps and single outliers.
"""

import argparse
import math
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from monitor.estimation.estimate import Estimate
from monitor.history import bucketed_history as past
from monitor.history.bucketed_history import HistoryTable
from monitor.history.history_row import HistoryRow, pack_count_min_max_last
from monitor.history.minute_aggregation import (
    HEALTH_COLUMNS,
    TEMPERATURE_COLUMNS,
    EstimateToColumnsConverter,
    MinuteAggregator,
)
from monitor.history.query_parameters import PARTS, HistoryQuery
from monitor.history.sqlite_store import HistoryFileWriter, open_history
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.messages.history import HistoryMessage
from tests.experiments.benchmarks.machine import Load
from tests.monitor.history.kill_writers import kill_writers
from tests.monitor.publishing.example_results import make_estimate

T0 = 1_609_459_200  # 2021-01-01
DAY_S, MINUTES, YEAR_D = 86_400, 1440, 365.25
ESTIMATES_PER_MINUTE = 600  # at 10 Hz
DEVICE = "bench-1"
QUERIES = (
    ("last hour", 3600.0, HistoryQuery()),
    ("last day", 86_400.0, HistoryQuery()),
    ("last month", 30 * 86_400.0, HistoryQuery()),
    ("all, N of gz", math.inf, HistoryQuery(what=("coefficients",), axes=("gz",), symbols=("N",))),
    ("all, coefficients and status", math.inf, HistoryQuery()),
    ("all, everything", math.inf, HistoryQuery(what=PARTS)),
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--years", type=float, default=5.0)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--keep", type=Path, help="path for the file of the years")
    arguments = parser.parse_args()
    load = Load()
    print_cost()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.keep or Path(folder) / "years.sqlite"
        if arguments.years:
            write_years(path, arguments.years)
            print_queries(path)
        if arguments.kills:
            run_kills(Path(folder) / "kills.sqlite", arguments.kills)
    print(load.describe())


def print_cost() -> None:
    """Print the time of an estimate in the main loop and of a row in the thread of the writer."""
    estimates = [make_estimate(seed=seed) for seed in range(50)]
    minutes, rows = MinuteAggregator(), []
    begun = time.perf_counter()
    for i in range(20_000):
        rows.append(minutes.add_estimate(T0 + 0.1 * i, estimates[i % 50]))
    each = (time.perf_counter() - begun) / 20_000
    full = [row for row in rows if row is not None]
    print(f"an estimate: {each * 1e6:.1f} µs in the loop; {len(full[0].names)} numbers")
    packed = _measure_time(lambda: [pack_count_min_max_last(row) for row in full]) / len(full)
    size = np.mean([len(pack_count_min_max_last(row)) for row in full])
    print(f"a row: {packed * 1e6:.0f} µs to pack, {size:.0f} bytes")


def write_years(path: Path, count: float) -> None:
    """Write the years, and print size and time."""
    rng, simulated_days = np.random.default_rng(1), _SimulatedDays(make_estimate())
    store, begun, written = HistoryFileWriter(path), time.perf_counter(), 0
    days = round(count * YEAR_D)
    largest = 0
    for day in range(days):
        rows = simulated_days.day(day, rng)
        store.write_rows_and_events([(DEVICE, row) for row in rows], [(DEVICE, one) for one in _events(day, rng)])
        written += len(rows)
        while store.merge_old_rows(math.inf, 1000):
            pass
        if day % 30 == 0 or day == days - 1:
            largest = max(largest, _size(path))
            if day > 100 and day % 360 == 0:
                print(f"  after {day} d: {_size(path) / 1e6:.1f} MB", flush=True)
    store.close()
    took = time.perf_counter() - begun
    print(f"{count:g} years of one device: {_size(path) / 1e6:.1f} MB (with its log at most {largest / 1e6:.1f} MB)")
    print(f"  {written:,} rows written and thinned, {took / written * 1e6:.0f} µs each")
    with open_history(path) as reader:
        widths = [row.width_s for row in reader.read_rows(DEVICE, TimeRange(-math.inf, math.inf))]
        print("  rows: " + ", ".join(f"{widths.count(one):,} of {one} s" for one in sorted(set(widths))))
        print(f"  events: {reader.read_events(DEVICE, TimeRange(-math.inf, math.inf), 10**9)[1]:,}")


def print_queries(path: Path) -> None:
    """Print the time of each query, from the file to the message."""
    with open_history(path) as reader:
        stored = reader.stored_range(DEVICE)
    assert stored is not None
    for name, seconds, query in QUERIES:
        span = TimeRange(stored[1] - seconds, stored[1])
        read_s = _measure_time(partial(_read, path, span, query))
        found = _read(path, span, query)
        encode = partial(_encode_reply, found, query)
        write_s = _measure_time(encode)
        size = len(encode())
        print(
            f"{name}: {len(found)} buckets of {found.step_s} s; {read_s * 1e3:.0f} ms to read, "
            f"{write_s * 1e3:.0f} ms to write as {size / 1e3:.0f} kB"
        )


def run_kills(path: Path, count: int) -> None:
    """Kill a writer at random moments; the check is in ``tests.monitor.history.kill_writers``."""
    left = kill_writers(path, count, seed=1, within_s=0.2)
    unacknowledged = sum(result.found > result.acknowledged for result in left)
    print(
        f"{count} kills: {left[-1].found:,} minutes, each in one row, sums and extremes exact; "
        f"{unacknowledged} of the kills came after a commit and before its acknowledgement"
    )


class _SimulatedDays:
    """Simulation of the rows of a day with slowly changing numbers."""

    def __init__(self, first: Estimate) -> None:
        numbers = EstimateToColumnsConverter(first)
        self.names = (*numbers.names, *HEALTH_COLUMNS, *TEMPERATURE_COLUMNS)
        values = np.concatenate([numbers.convert_estimate(first), [100.0, 0.02, 1.8e8, 25.0]])
        self._centre = values
        # wide for what a short window knows badly, narrow for rate and memory
        self._spread = np.array([_spread(name) for name in self.names])

    def day(self, day: int, rng: np.random.Generator) -> list[HistoryRow]:
        """Return the rows of a day. On some days, rows are missing."""
        t = (day * MINUTES + np.arange(MINUTES)) / MINUTES  # d
        k = len(self.names)
        wander = np.cumsum(rng.standard_normal((MINUTES, k)), axis=0) * 0.02
        season = 0.05 * np.sin(2.0 * np.pi * t / YEAR_D)[:, None]
        old = 0.25 if day > 900 else 0.0  # something has aged at a stroke
        last = self._centre * np.exp(
            self._spread * (season + 0.03 * wander + 0.01 * rng.standard_normal((MINUTES, k)) + old)
        )
        half = np.abs(self._spread * rng.standard_normal((2, MINUTES, k)) * 0.004)
        outliers = rng.random(MINUTES) < 0.5 / MINUTES
        half[1][outliers] += 0.5 * self._spread
        low, high = (last * (1.0 - half[0])).astype(np.float32), (last * (1.0 + half[1])).astype(np.float32)
        n = np.where(np.isfinite(self._centre), ESTIMATES_PER_MINUTE, 0)
        absent = slice(700, 700 + int(rng.integers(0, 400))) if rng.random() < 0.02 else slice(0, 0)
        there = np.ones(MINUTES, np.bool_)
        there[absent] = False
        singles, day_s = last.astype(np.float32), T0 + day * DAY_S
        rows = []
        for i in np.flatnonzero(there).tolist():
            start_s, lost = day_s + 60 * i, int(rng.poisson(0.02))
            counts = (6000 - lost, lost, 0, 0)
            rows.append(HistoryRow(start_s, 60, start_s + 59.9, self.names, n, low[i], high[i], singles[i], counts, 1))
        return rows


def _spread(name: str) -> float:
    if name in HEALTH_COLUMNS:
        return 0.01
    if name in TEMPERATURE_COLUMNS:
        return 1.5
    return 2.0 if ".K" in name or ".R" in name else 1.0


def _events(day: int, rng: np.random.Generator) -> list[StoredEvent]:
    kinds = ("moved", "samples_lost", "bias_stepped", "noise_changed")
    found = []
    for at in np.sort(rng.uniform(0.0, DAY_S, 8)).tolist():
        kind, t_s = kinds[int(rng.choice(4, p=[0.6, 0.35, 0.03, 0.02]))], T0 + day * DAY_S + at
        axis = "gz" if kind in ("bias_stepped", "noise_changed") else None
        what = {"N": {"before": 1.5e-4, "after": 2.2e-4}} if kind == "noise_changed" else {}
        text = f"{axis or 'device'}: {kind.replace('_', ' ')} by 47 %"
        found.append(StoredEvent(t_s, kind, text, axis, what, t_s - 5.0, float(rng.uniform(3.0, 12.0))))
    return found


def _read(path: Path, span: TimeRange, query: HistoryQuery) -> HistoryTable:
    with open_history(path) as reader:
        return past.read_history(reader, DEVICE, span, query.selects_column, query.step_s)


def _encode_reply(table: HistoryTable, query: HistoryQuery) -> bytes:
    return HistoryMessage.build_reply(table, query, 0.0, 0).encode()


def _measure_time(work: Callable[[], object]) -> float:
    """Return the least time of three runs in seconds."""
    taken: list[float] = []
    for _ in range(3):
        begun = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun)
    return min(taken)


def _size(path: Path) -> int:
    """Return the size of a file and of the files with the same prefix."""
    return sum(os.stat(one).st_size for one in path.parent.glob(f"{path.name}*"))


if __name__ == "__main__":
    main()
