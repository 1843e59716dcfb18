"""Tests of the history file: merging of old rows, events, concurrent access, kills and damage."""

import contextlib
import math
import os
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.errors import RecordingError
from monitor.history import sqlite_store as stores
from monitor.history.history_row import HistoryRow
from monitor.history.sqlite_store import LEVELS, HistoryFileWriter, open_history
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from tests.monitor.history.kill_writers import ALL_TIMES, kill_writers
from tests.monitor.history.random_rows import (
    COLUMN_NAMES,
    aggregate_column,
    equal_with_nan,
    get_column_values,
    make_row,
)

DAY_S = 86_400
T0 = 1_760_400_000  # a multiple of all widths


@contextlib.contextmanager
def open_writer(path: Path) -> Iterator[HistoryFileWriter]:
    store = HistoryFileWriter(path)
    try:
        yield store
    finally:
        store.close()


def read_sorted_rows(path: Path, device: str = "a", span: TimeRange = ALL_TIMES) -> list[HistoryRow]:
    with open_history(path) as reader:
        return sorted(reader.read_rows(device, span), key=lambda r: r.start_s)


def merge_completely(store: HistoryFileWriter, now_s: float) -> int:
    done = 0
    while some := store.merge_old_rows(now_s, 7):
        done += some
    return done


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(seed=st.integers(0, 2**32), days=st.floats(0.1, 130.0), data=st.data())
def test_merging_preserves_sums_and_extremes(
    tmp_path_factory: pytest.TempPathFactory, seed: int, days: float, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("thin") / "h.sqlite"
    rng = np.random.default_rng(seed)
    minutes = np.unique(np.append(rng.integers(0, int(days * 1440) + 1, 120), int(days * 1440)))
    rows = [make_row(T0 + 60 * int(i), rng) for i in minutes]
    cut = data.draw(st.integers(0, len(rows)))
    with open_writer(path) as store:
        store.write_rows_and_events([("a", r) for r in rows[:cut]])
        merge_completely(store, math.inf)  # merged at two ages, some rows twice
        store.write_rows_and_events([("a", r) for r in rows[cut:]])
        merge_completely(store, math.inf)
    found = read_sorted_rows(path)
    newest_s = rows[-1].end_s
    for merged, after in zip(found, [*found[1:], None], strict=True):
        assert after is None or merged.end_s <= after.start_s
        inside = [r for r in rows if merged.start_s <= r.start_s < merged.end_s]
        for name in COLUMN_NAMES:
            assert equal_with_nan(get_column_values(merged, name), aggregate_column(inside, name))
        assert merged.counts == tuple(sum(r.counts[i] for r in inside) for i in range(4))
        assert merged.state == max(r.state for r in inside)
        for width_s, age_s in LEVELS[:-1]:
            assert merged.width_s > width_s or merged.end_s > newest_s - age_s - merged.end_s % 21_600 - 21_600
    assert sum(int(r.n[0]) for r in found) == sum(int(r.n[0]) for r in rows)


def test_row_width_follows_the_age(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(1)
    ages_s = {60: 6 * DAY_S, 900: 80 * DAY_S, 21_600: 200 * DAY_S}
    newest_s = T0 + 200 * DAY_S
    with open_writer(path) as store:
        store.write_rows_and_events([("a", make_row(newest_s - age_s, rng)) for age_s in (*ages_s.values(), 0)])
        assert merge_completely(store, math.inf) == 3  # one row is merged twice
        assert merge_completely(store, math.inf) == 0
    assert [r.width_s for r in read_sorted_rows(path)] == [21_600, 900, 60, 60]


def test_row_from_a_wrong_clock_does_not_age_new_rows(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(2)
    with open_writer(path) as store:
        store.write_rows_and_events([("a", make_row(T0 + 50 * 365 * DAY_S, rng)), ("a", make_row(T0, rng))])
        assert merge_completely(store, T0 + 60.0) == 0
    assert [r.width_s for r in read_sorted_rows(path)] == [60, 60]


def test_row_of_a_merged_bucket_is_added_to_it(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(3)
    old, new, again = make_row(T0, rng), make_row(T0 + 30 * DAY_S, rng), make_row(T0 + 120, rng)
    with open_writer(path) as store:
        store.write_rows_and_events([("a", old), ("a", new)])
        store.write_rows_and_events([("a", new)])
        assert merge_completely(store, math.inf) == 1
        store.write_rows_and_events([("a", again)])
    first, last = read_sorted_rows(path)
    assert (first.width_s, last.width_s) == (900, 60)
    for name in COLUMN_NAMES:
        assert equal_with_nan(get_column_values(first, name), aggregate_column([old, again], name))
        assert get_column_values(last, name)[0] == 2 * get_column_values(new, name)[0]


def test_devices_and_time_ranges_are_separated(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(4)
    with open_writer(path) as store:
        store.write_rows_and_events([(device, make_row(T0 + 60 * i, rng)) for i in range(5) for device in ("a", "b")])
        store.write_rows_and_events([("c", make_row(T0, rng))])
    with open_history(path) as reader:
        assert reader.list_devices() == ("a", "b", "c")
        assert reader.stored_range("a") == (T0, T0 + 300)
        assert reader.stored_range("nobody") is None
        assert list(reader.read_rows("nobody", ALL_TIMES)) == []
    some = read_sorted_rows(path, "b", TimeRange(T0 + 61.0, T0 + 180.0, end_included=False))
    assert [r.start_s - T0 for r in some] == [60, 120]


def test_failed_transaction_writes_nothing(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(5)
    broken = StoredEvent(T0, "moved", "x", sigma=object())  # type: ignore[arg-type]
    with open_writer(path) as store:
        with pytest.raises((RecordingError, sqlite3.Error)):
            store.write_rows_and_events([("new", make_row(T0, rng, names=("other",)))], [("new", broken)])
        store.write_rows_and_events([("a", make_row(T0, rng))])
    with open_history(path) as reader:
        assert reader.list_devices() == ("a",)


def test_reader_sees_a_snapshot_while_rows_are_written(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(6)
    with open_writer(path) as store:
        store.write_rows_and_events([("a", make_row(T0 + 60 * i, rng)) for i in range(15)])
        with open_history(path) as reader:
            before = reader.stored_range("a")
            store.write_rows_and_events([("a", make_row(T0 + 30 * DAY_S, rng))])
            assert merge_completely(store, math.inf) == 1
            assert reader.stored_range("a") == before
            assert [r.width_s for r in reader.read_rows("a", ALL_TIMES)] == [60] * 15
    assert [r.width_s for r in read_sorted_rows(path)] == [900, 60]


@pytest.mark.long
def test_twenty_kills_leave_every_minute_once(tmp_path: Path) -> None:
    left = kill_writers(tmp_path / "h.sqlite", 20, seed=1, within_s=0.05)
    assert len(left) == 20
    assert set(left[-1].widths) >= {60, 900}


def test_two_writers_can_use_one_file(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"

    def write(device: str, seed: int) -> None:
        with open_writer(path) as store:
            for i in range(30):
                own = make_row(T0 + 60 * i, np.random.default_rng([seed, i]))
                store.write_rows_and_events([(device, own), ("both", make_row(T0, np.random.default_rng(i)))])

    threads = [threading.Thread(target=write, args=(name, i)) for i, name in enumerate("ab")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(read_sorted_rows(path, "a")) == len(read_sorted_rows(path, "b")) == 30
    (both,) = read_sorted_rows(path, "both")
    assert both.counts[0] == 2 * sum(make_row(T0, np.random.default_rng(i)).counts[0] for i in range(30))


def test_two_writers_can_create_one_file(tmp_path: Path) -> None:
    errors: list[Exception] = []

    def create(path: Path, start: threading.Barrier) -> None:
        start.wait()
        try:
            with open_writer(path):
                pass
        except (sqlite3.Error, RecordingError, OSError) as error:
            errors.append(error)

    for i in range(50):
        start = threading.Barrier(2)
        threads = [threading.Thread(target=create, args=(tmp_path / f"{i}.sqlite", start)) for _ in "ab"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert errors == []


# --- events


def make_event(t_s: float, kind: str = "moved", sigma: float | None = None, axis: str | None = None) -> StoredEvent:
    return StoredEvent(t_s, kind, f"{kind} at {t_s}", axis, {"N": {"before": 1.0, "after": 2.0}}, t_s - 5.0, sigma)


def read_events(path: Path, span: TimeRange = ALL_TIMES, at_most: int = 10_000_000) -> tuple[list[StoredEvent], int]:
    with open_history(path) as reader:
        return reader.read_events("a", span, at_most)


def test_events_are_read_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    events = [make_event(T0 + i, sigma=float(i), axis="gz") for i in range(10)]
    unusual = StoredEvent(T0 + 20.0, "limit_crossed", "∞ \n", None, {"N": {"limit": math.nan}}, None, None)
    with open_writer(path) as store:
        store.write_rows_and_events([], [("a", e) for e in (*events[::-1], unusual)])
        store.write_rows_and_events([], [("b", events[0])])
    found, count = read_events(path)
    assert (found[:10], count) == (events, 11)
    assert math.isnan(found[10].what["N"]["limit"])
    assert read_events(path, TimeRange(T0, T0 + 5.0, end_included=False), 2) == (events[3:5], 6)


def test_excess_events_are_reduced_to_first_last_and_most_significant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "MAX_EVENTS", 200)
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(7)
    events = [
        make_event(T0 + DAY_S * day + second, kind, float(rng.random()))
        for day in range(5)
        for kind in ("moved", "bias_stepped")
        for second in np.sort(rng.choice(DAY_S, 40, replace=False)).tolist()
    ]
    with open_writer(path) as store:
        store.write_rows_and_events([], [("a", e) for e in events])
        merge_completely(store, math.inf)
    found, _ = read_events(path)
    assert sum(e.represented_events for e in found) == len(events)
    for day in range(5):
        for kind in ("moved", "bias_stepped"):
            same_day = [e for e in events if e.kind == kind and (e.t_s - T0) // DAY_S == day]
            kept = {same_day[0].t_s, same_day[-1].t_s, max(same_day, key=lambda e: e.sigma or 0.0).t_s}
            assert {e.t_s for e in found if e.kind == kind and (e.t_s - T0) // DAY_S == day} == kept


def test_number_of_stored_events_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "MAX_EVENTS", 300)
    path = tmp_path / "h.sqlite"
    with open_writer(path) as store:
        for month in range(60):
            store.write_rows_and_events([], [("a", make_event(T0 + 30 * DAY_S * month + 3600 * i)) for i in range(100)])
            store.merge_old_rows(math.inf)
    found, _ = read_events(path)
    assert len(found) <= 300
    assert sum(e.represented_events for e in found) == 6000


# --- errors


def test_missing_folder_is_created(tmp_path: Path) -> None:
    path = tmp_path / "new" / "deep" / "h.sqlite"
    with open_writer(path):
        assert path.exists()


def test_invalid_history_file_is_refused_and_not_changed(tmp_path: Path) -> None:
    text, other, newer, empty = (tmp_path / name for name in ("text", "other", "newer", "empty"))
    text.write_bytes(b"not a database, but long enough for one" * 100)
    with contextlib.closing(sqlite3.connect(other)) as db:
        db.execute("CREATE TABLE mine (x)")
    with open_writer(newer) as store:
        store.write_rows_and_events([("a", make_row(T0, np.random.default_rng(1)))])
    with contextlib.closing(sqlite3.connect(newer)) as db:
        db.execute("PRAGMA user_version = 99")
    empty.touch()
    for path, message in ((text, "damaged"), (other, "not a history"), (newer, "newer imu-monitor")):
        before = path.read_bytes()
        for attempt in (lambda path=path: HistoryFileWriter(path), lambda path=path: read_sorted_rows(path)):
            with pytest.raises(RecordingError, match=message) as error:
                attempt()
            assert str(path) in str(error.value)
            assert "\n" not in str(error.value)
        assert path.read_bytes() == before
    with pytest.raises(RecordingError, match="the history is still empty"):
        read_sorted_rows(empty)
    with pytest.raises(RecordingError, match="no such file"):
        read_sorted_rows(tmp_path / "absent")


@pytest.mark.parametrize("seed", range(12))
def test_any_damage_is_reported_in_one_line_or_harmless(tmp_path: Path, seed: int) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(seed)
    with open_writer(path) as store:
        store.write_rows_and_events(
            [("a", make_row(T0 + 60 * i, rng)) for i in range(200)], [("a", make_event(T0 + i)) for i in range(50)]
        )
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, len(data), 400).tolist():
        data[at] = int(rng.integers(0, 256))
    path.write_bytes(data[: int(rng.integers(len(data) // 2, len(data) + 1))])
    with contextlib.suppress(RecordingError), open_history(path) as reader:
        list(reader.read_rows("a", ALL_TIMES))
        reader.read_events("a", ALL_TIMES, 1000)
    with contextlib.suppress(RecordingError, sqlite3.OperationalError), open_writer(path) as store:
        store.write_rows_and_events([("a", make_row(T0 + 60 * i, rng)) for i in range(200)], [("a", make_event(T0))])
        store.merge_old_rows(math.inf)


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write to every folder")
def test_history_in_a_read_only_folder_can_be_read(tmp_path: Path) -> None:
    folder = tmp_path / "h"
    path = folder / "h.sqlite"
    with open_writer(path) as store:
        store.write_rows_and_events([("a", make_row(T0, np.random.default_rng(1)))])
    before = sorted(folder.iterdir())
    os.chmod(path, 0o444)
    os.chmod(folder, 0o555)
    try:
        assert len(read_sorted_rows(path)) == 1
    finally:
        os.chmod(folder, 0o755)
    assert sorted(folder.iterdir()) == before
