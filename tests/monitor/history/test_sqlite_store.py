"""The file: what goes in comes out, thinned or not, killed or not; what cannot be read or written is said."""

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
from tests.monitor.history.kills import ALL, kill
from tests.monitor.history.made import NAMES, numbers_of, row, same, together

DAY_S = 86_400
T0 = 1_760_400_000  # a multiple of all widths


@contextlib.contextmanager
def writing(path: Path) -> Iterator[HistoryFileWriter]:
    store = HistoryFileWriter(path)
    try:
        yield store
    finally:
        store.close()


def rows_in(path: Path, device: str = "a", span: TimeRange = ALL) -> list[HistoryRow]:
    with open_history(path) as reader:
        return sorted(reader.read_rows(device, span), key=lambda one: one.start_s)


def thinned(store: HistoryFileWriter, now_s: float) -> int:
    done = 0
    while some := store.merge_old_rows(now_s, 7):
        done += some
    return done


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(seed=st.integers(0, 2**32), days=st.floats(0.1, 130.0), data=st.data())
def test_thinning_keeps_every_sum_and_extreme(
    tmp_path_factory: pytest.TempPathFactory, seed: int, days: float, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("thin") / "h.sqlite"
    rng = np.random.default_rng(seed)
    minutes = np.unique(np.append(rng.integers(0, int(days * 1440) + 1, 120), int(days * 1440)))
    rows = [row(T0 + 60 * int(i), rng) for i in minutes]
    cut = data.draw(st.integers(0, len(rows)))
    with writing(path) as store:
        store.write_rows_and_events([("a", one) for one in rows[:cut]])
        thinned(store, math.inf)  # at two ages: some rows are merged twice
        store.write_rows_and_events([("a", one) for one in rows[cut:]])
        thinned(store, math.inf)
    found = rows_in(path)
    newest_s = rows[-1].end_s
    for one, after in zip(found, [*found[1:], None], strict=True):
        assert after is None or one.end_s <= after.start_s
        inside = [each for each in rows if one.start_s <= each.start_s < one.end_s]
        for name in NAMES:
            assert same(numbers_of(one, name), together(inside, name))
        assert one.counts == tuple(sum(each.counts[i] for each in inside) for i in range(4))
        assert one.state == max(each.state for each in inside)
        for width_s, age_s in LEVELS[:-1]:
            assert one.width_s > width_s or one.end_s > newest_s - age_s - one.end_s % 21_600 - 21_600
    assert sum(int(one.n[0]) for one in found) == sum(int(one.n[0]) for one in rows)


def test_rows_have_the_widths_of_their_age(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(1)
    ages_s = {60: 6 * DAY_S, 900: 80 * DAY_S, 21_600: 200 * DAY_S}
    newest_s = T0 + 200 * DAY_S
    with writing(path) as store:
        store.write_rows_and_events([("a", row(newest_s - age_s, rng)) for age_s in (*ages_s.values(), 0)])
        assert thinned(store, math.inf) == 3  # one twice
        assert thinned(store, math.inf) == 0
    assert [one.width_s for one in rows_in(path)] == [21_600, 900, 60, 60]


def test_a_clock_that_was_ahead_once_does_not_age_what_is_new(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(2)
    with writing(path) as store:
        store.write_rows_and_events([("a", row(T0 + 50 * 365 * DAY_S, rng)), ("a", row(T0, rng))])
        assert thinned(store, T0 + 60.0) == 0
    assert [one.width_s for one in rows_in(path)] == [60, 60]


def test_a_bucket_that_comes_again_is_added_wherever_it_is_by_now(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(3)
    old, new, again = row(T0, rng), row(T0 + 30 * DAY_S, rng), row(T0 + 120, rng)
    with writing(path) as store:
        store.write_rows_and_events([("a", old), ("a", new)])
        store.write_rows_and_events([("a", new)])
        assert thinned(store, math.inf) == 1
        store.write_rows_and_events([("a", again)])
    first, last = rows_in(path)
    assert (first.width_s, last.width_s) == (900, 60)
    for name in NAMES:
        assert same(numbers_of(first, name), together([old, again], name))
        assert numbers_of(last, name)[0] == 2 * numbers_of(new, name)[0]


def test_devices_do_not_mix_and_spans_are_kept_to(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(4)
    with writing(path) as store:
        store.write_rows_and_events([(device, row(T0 + 60 * i, rng)) for i in range(5) for device in ("a", "b")])
        store.write_rows_and_events([("c", row(T0, rng))])
    with open_history(path) as reader:
        assert reader.list_devices() == ("a", "b", "c")
        assert reader.stored_range("a") == (T0, T0 + 300)
        assert reader.stored_range("nobody") is None
        assert list(reader.read_rows("nobody", ALL)) == []
    some = rows_in(path, "b", TimeRange(T0 + 61.0, T0 + 180.0, end_included=False))
    assert [one.start_s - T0 for one in some] == [60, 120]


def test_a_transaction_is_whole_or_has_not_happened(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(5)
    broken = StoredEvent(T0, "moved", "x", sigma=object())  # type: ignore[arg-type]
    with writing(path) as store:
        with pytest.raises((RecordingError, sqlite3.Error)):
            store.write_rows_and_events([("new", row(T0, rng, names=("other",)))], [("new", broken)])
        store.write_rows_and_events([("a", row(T0, rng))])
    with open_history(path) as reader:
        assert reader.list_devices() == ("a",)


def test_a_reader_sees_one_moment_while_a_writer_goes_on(tmp_path: Path) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(6)
    with writing(path) as store:
        store.write_rows_and_events([("a", row(T0 + 60 * i, rng)) for i in range(15)])
        with open_history(path) as reader:
            before = reader.stored_range("a")
            store.write_rows_and_events([("a", row(T0 + 30 * DAY_S, rng))])
            assert thinned(store, math.inf) == 1
            assert reader.stored_range("a") == before
            assert [one.width_s for one in reader.read_rows("a", ALL)] == [60] * 15
    assert [one.width_s for one in rows_in(path)] == [900, 60]


@pytest.mark.long
def test_twenty_kills_leave_every_minute_once(tmp_path: Path) -> None:
    left = kill(tmp_path / "h.sqlite", 20, seed=1, within_s=0.05)
    assert len(left) == 20
    assert set(left[-1].widths) >= {60, 900}


def test_two_writers_share_a_file(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"

    def write(device: str, seed: int) -> None:
        with writing(path) as store:
            for i in range(30):
                own = row(T0 + 60 * i, np.random.default_rng([seed, i]))
                store.write_rows_and_events([(device, own), ("both", row(T0, np.random.default_rng(i)))])

    threads = [threading.Thread(target=write, args=(name, i)) for i, name in enumerate("ab")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(rows_in(path, "a")) == len(rows_in(path, "b")) == 30
    (both,) = rows_in(path, "both")
    assert both.counts[0] == 2 * sum(row(T0, np.random.default_rng(i)).counts[0] for i in range(30))


# --- events


def event(t_s: float, kind: str = "moved", sigma: float | None = None, axis: str | None = None) -> StoredEvent:
    return StoredEvent(t_s, kind, f"{kind} at {t_s}", axis, {"N": {"before": 1.0, "after": 2.0}}, t_s - 5.0, sigma)


def events_in(path: Path, span: TimeRange = ALL, at_most: int = 10_000_000) -> tuple[list[StoredEvent], int]:
    with open_history(path) as reader:
        return reader.read_events("a", span, at_most)


def test_events_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    told = [event(T0 + i, sigma=float(i), axis="gz") for i in range(10)]
    odd = StoredEvent(T0 + 20.0, "limit_crossed", "∞ \n", None, {"N": {"limit": math.nan}}, None, None)
    with writing(path) as store:
        store.write_rows_and_events([], [("a", one) for one in (*told[::-1], odd)])
        store.write_rows_and_events([], [("b", told[0])])
    found, count = events_in(path)
    assert (found[:10], count) == (told, 11)
    assert math.isnan(found[10].what["N"]["limit"])
    assert events_in(path, TimeRange(T0, T0 + 5.0, end_included=False), 2) == (told[3:5], 6)


def test_too_many_events_leave_the_first_the_last_and_the_surest_and_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "MAX_EVENTS", 200)
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(7)
    told = [
        event(T0 + DAY_S * day + second, kind, float(rng.random()))
        for day in range(5)
        for kind in ("moved", "bias_stepped")
        for second in np.sort(rng.choice(DAY_S, 40, replace=False)).tolist()
    ]
    with writing(path) as store:
        store.write_rows_and_events([], [("a", one) for one in told])
        thinned(store, math.inf)
    found, _ = events_in(path)
    assert sum(one.represented_events for one in found) == len(told)
    for day in range(5):
        for kind in ("moved", "bias_stepped"):
            of = [one for one in told if one.kind == kind and (one.t_s - T0) // DAY_S == day]
            stay = {of[0].t_s, of[-1].t_s, max(of, key=lambda one: one.sigma or 0.0).t_s}
            assert {one.t_s for one in found if one.kind == kind and (one.t_s - T0) // DAY_S == day} == stay


def test_a_flood_of_events_for_years_stays_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "MAX_EVENTS", 300)
    path = tmp_path / "h.sqlite"
    with writing(path) as store:
        for month in range(60):
            store.write_rows_and_events([], [("a", event(T0 + 30 * DAY_S * month + 3600 * i)) for i in range(100)])
            store.merge_old_rows(math.inf)
    found, _ = events_in(path)
    assert len(found) <= 300
    assert sum(one.represented_events for one in found) == 6000


# --- what goes wrong


def test_a_folder_that_is_not_there_is_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "deep" / "h.sqlite"
    with writing(path):
        assert path.exists()


def test_what_is_not_a_history_is_said_and_left_alone(tmp_path: Path) -> None:
    text, other, newer, empty = (tmp_path / name for name in ("text", "other", "newer", "empty"))
    text.write_bytes(b"not a database, but long enough for one" * 100)
    with contextlib.closing(sqlite3.connect(other)) as db:
        db.execute("CREATE TABLE mine (x)")
    with writing(newer) as store:
        store.write_rows_and_events([("a", row(T0, np.random.default_rng(1)))])
    with contextlib.closing(sqlite3.connect(newer)) as db:
        db.execute("PRAGMA user_version = 99")
    empty.touch()
    for path, says in ((text, "damaged"), (other, "not a history"), (newer, "newer imu-monitor")):
        before = path.read_bytes()
        for attempt in (lambda path=path: HistoryFileWriter(path), lambda path=path: rows_in(path)):
            with pytest.raises(RecordingError, match=says) as error:
                attempt()
            assert str(path) in str(error.value)
            assert "\n" not in str(error.value)
        assert path.read_bytes() == before
    with pytest.raises(RecordingError, match="the history is still empty"):
        rows_in(empty)
    with pytest.raises(RecordingError, match="no such file"):
        rows_in(tmp_path / "absent")


@pytest.mark.parametrize("seed", range(12))
def test_damage_anywhere_is_a_line_or_does_not_matter(tmp_path: Path, seed: int) -> None:
    path, rng = tmp_path / "h.sqlite", np.random.default_rng(seed)
    with writing(path) as store:
        store.write_rows_and_events(
            [("a", row(T0 + 60 * i, rng)) for i in range(200)], [("a", event(T0 + i)) for i in range(50)]
        )
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, len(data), 400).tolist():
        data[at] = int(rng.integers(0, 256))
    path.write_bytes(data[: int(rng.integers(len(data) // 2, len(data) + 1))])
    with contextlib.suppress(RecordingError), open_history(path) as reader:
        list(reader.read_rows("a", ALL))
        reader.read_events("a", ALL, 1000)
    with contextlib.suppress(RecordingError, sqlite3.OperationalError), writing(path) as store:
        store.write_rows_and_events([("a", row(T0 + 60 * i, rng)) for i in range(200)], [("a", event(T0))])
        store.merge_old_rows(math.inf)


@pytest.mark.skipif(os.geteuid() == 0, reason="to root every folder can be written")
def test_a_history_in_a_folder_that_cannot_be_written_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "h"
    path = folder / "h.sqlite"
    with writing(path) as store:
        store.write_rows_and_events([("a", row(T0, np.random.default_rng(1)))])
    before = sorted(folder.iterdir())
    os.chmod(path, 0o444)
    os.chmod(folder, 0o555)
    try:
        assert len(rows_in(path)) == 1
    finally:
        os.chmod(folder, 0o755)
    assert sorted(folder.iterdir()) == before
