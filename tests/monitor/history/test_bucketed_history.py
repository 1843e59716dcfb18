"""Tests of the history table of a time range against the stored rows."""

import math
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import NotReady
from monitor.history import bucketed_history as past
from monitor.history.bucketed_history import HistoryTable
from monitor.history.history_row import HistoryRow
from monitor.history.sqlite_store import HistoryFileWriter, open_history
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from tests.monitor.history.random_rows import COLUMN_NAMES, aggregate_column, equal_with_nan, make_row

T0 = 1_760_400_000
DAY_S = 86_400


def write_history(path: Path, rows: list[HistoryRow], events: tuple[StoredEvent, ...] = ()) -> None:
    store = HistoryFileWriter(path)
    store.write_rows_and_events([("a", r) for r in rows], [("a", event) for event in events])
    while store.merge_old_rows(math.inf):
        pass
    store.close()


def read_table(path: Path, *arguments: object, **more: object) -> HistoryTable:
    with open_history(path) as reader:
        return past.read_history(reader, "a", *arguments, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def long_history(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[HistoryRow]]:
    """Write 200 days with gaps, so that rows of all three widths exist."""
    path = tmp_path_factory.mktemp("past") / "h.sqlite"
    rng = np.random.default_rng(1)
    minutes = np.unique(np.append(rng.integers(0, 200 * 1440, 600), 200 * 1440))
    rows = [make_row(T0 + 60 * int(i), rng) for i in minutes]
    write_history(path, rows)
    return path, rows


@settings(max_examples=25, deadline=None)
@given(
    start_d=st.floats(0.0, 199.0),
    days=st.floats(0.01, 200.0),
    step_s=st.sampled_from([None, 60, 900, 7000, DAY_S]),
    points=st.sampled_from([3, 50, 1000]),
)
def test_buckets_have_the_sums_and_extremes_of_their_rows(
    long_history: tuple[Path, list[HistoryRow]], start_d: float, days: float, step_s: int | None, points: int
) -> None:
    path, rows = long_history
    span = TimeRange(T0 + start_d * DAY_S, T0 + (start_d + days) * DAY_S)
    try:
        found = read_table(path, span, step_s=step_s, points=points)
    except NotReady:
        assert not [r for r in rows if span.overlaps(r.start_s, r.end_s)]
        return
    assert len(found) <= 2 * points + 4
    assert (found.width_s >= found.step_s).all()
    assert (np.diff(found.end_s) > 0).all()
    inner = range(1, len(found) - 1)  # the first and last bucket are only partly in the span
    for p in inner:
        inside = [r for r in rows if found.start_s[p] <= r.start_s < found.end_s[p]]
        for name in COLUMN_NAMES:
            column = found.select_column(name)
            numbers = (int(column.n[p]), *(float(part[p]) for part in (column.low, column.high, column.last)))
            assert equal_with_nan(numbers, aggregate_column(inside, name))
        assert found.counts[p].tolist() == [sum(r.counts[i] for r in inside) for i in range(4)]
    every = [r for r in rows if span.overlaps(r.start_s, r.end_s)]
    assert int(found.counts[:, 0].sum()) >= sum(r.counts[0] for r in every)


def test_default_range_is_the_last_day(long_history: tuple[Path, list[HistoryRow]]) -> None:
    path, rows = long_history
    found = read_table(path, None)
    assert found.end_s[-1] >= rows[-1].end_s
    assert found.start_s[0] >= rows[-1].end_s - DAY_S - found.step_s
    assert found.step_s == 300


def test_unselected_columns_are_absent(long_history: tuple[Path, list[HistoryRow]]) -> None:
    found = read_table(long_history[0], None, wants_column=lambda name: name == "rate")
    assert found.names == ("rate",)
    assert np.isnan(found.select_column("gz.N").last).all()
    assert found.select_column("gz.N").n.sum() == 0


def test_empty_range_reports_the_stored_range(long_history: tuple[Path, list[HistoryRow]]) -> None:
    with pytest.raises(NotReady, match=r"no results in this time range; stored are 2025-10-15 00:\d\d"):
        read_table(long_history[0], TimeRange(T0 - 30 * DAY_S, T0 - 29 * DAY_S))
    with open_history(long_history[0]) as reader, pytest.raises(NotReady, match="nobody: no history yet"):
        past.read_history(reader, "nobody", None)


def test_unlimited_range_is_accepted(long_history: tuple[Path, list[HistoryRow]]) -> None:
    found = read_table(long_history[0], TimeRange(-math.inf, math.inf))
    assert int(found.counts[:, 1].sum()) == sum(r.counts[1] for r in long_history[1])
    assert len(found) <= 1000


def test_event_without_a_row_is_found(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    event = StoredEvent(T0 + 5 * 3600.0, "link_lost", "gone")
    write_history(path, [make_row(T0, np.random.default_rng(1))], (event,))
    found = read_table(path, TimeRange(T0 + 4 * 3600.0, T0 + 6 * 3600.0))
    assert (len(found), found.events, found.events_in_all) == (0, (event,), 1)


@pytest.mark.long
def test_table_can_be_read_while_rows_are_written(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(1)
    write_history(path, [make_row(T0, rng)])
    done = threading.Event()

    def write() -> None:
        store = HistoryFileWriter(path)
        for i in range(1, 200):
            store.write_rows_and_events([("a", make_row(T0 + 60 * i, rng))])
            store.merge_old_rows(math.inf)
        store.close()
        done.set()

    thread = threading.Thread(target=write)
    thread.start()
    counts = []
    while not done.is_set():
        counts.append(len(read_table(path, None, step_s=60)))
    thread.join()
    assert counts == sorted(counts)
    assert len(read_table(path, None, step_s=60)) == 200
