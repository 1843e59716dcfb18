"""What is recorded comes back to the last bit, whatever the disk and the process do; a window goes on from it."""

import errno
import os
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from drivers.decoders import text
from drivers.driver import AxisMap
from drivers.links.loopback_link import LoopbackLink
from drivers.recording import load_samples, segment
from drivers.recording.segment import Origin, SegmentWriter, State
from drivers.sample import Chunk, SampleBlock, block, join
from monitor import recorder as room
from monitor.chain import Ready
from monitor.recorder import Recorder, origin
from monitor.settings import Device, Storage
from monitor.station import Station
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")

START_NS = 1_700_000_000_000_000_000
RATE = 100.0
SAMPLES = Origin("bench", "samples")


def rows(first: int, n: int, lost: int = 0, start_ns: int = START_NS) -> SampleBlock:
    index = np.arange(first, first + n)
    values = np.random.default_rng(first).standard_normal((n, 6)) * 1e-3
    return block(start_ns + index * 10_000_000, values, 20.0 + index * 1e-4, index.astype(np.int64), lost)


def written(folder: Path) -> list[segment.Piece]:
    return [piece for path in segment.segments(folder) for piece in segment.read_samples(path)]


def all_written(keeper: Recorder) -> None:
    """Wait until the recorder has written all that it was given."""
    wait_for(lambda: not any(track.waiting or track.held for track in keeper._tracks.values()))


@pytest.fixture(autouse=True)
def _brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "WRITE_S", 0.02)
    monkeypatch.setattr(room, "RETRY_S", 0.1)
    monkeypatch.setattr(room, "TIDY_S", 0.05)


def test_every_value_counter_and_hole_comes_back(tmp_path: Path) -> None:
    keeper = Recorder(Storage(tmp_path, segment_s=3.0), [SAMPLES])
    keeper.know("bench", State(RATE, (None, None, 5.0, None, None, None), 1.0))
    keeper.start()
    given = [rows(0, 150), rows(160, 150, lost=10), rows(310, 1), rows(311, 700)]
    for one in given:
        keeper.samples("bench", one, 0)
        all_written(keeper)  # as a batch of its own
    keeper.close(PATIENCE_S)
    back = written(tmp_path / "bench")
    got, expected = join([piece.samples for piece in back]), join(given)
    np.testing.assert_array_equal(got.values, expected.values)
    np.testing.assert_array_equal(got.ticks, expected.ticks)
    np.testing.assert_array_equal(got.temperature_c, expected.temperature_c)
    assert np.abs(got.t_ns - expected.t_ns).max() <= 240
    assert [piece.samples.lost for piece in back if piece.samples.lost] == [10]
    assert back[-1].state == State(RATE, (None, None, 5.0, None, None, None), 1.0)
    assert len(segment.segments(tmp_path / "bench")) > 1
    whole = load_samples(tmp_path / "bench")
    np.testing.assert_array_equal(whole.values, expected.values)
    assert not any("left aside" in note for note in whole.notes)


def test_segments_that_have_ended_are_packed_and_say_the_same(tmp_path: Path) -> None:
    keeper = Recorder(Storage(tmp_path, segment_s=5.0), [SAMPLES])
    keeper.start()
    given = [rows(first, 20) for first in range(0, 2000, 20)]
    for one in given:
        keeper.samples("bench", one, 0)
        all_written(keeper)
    packed = lambda: [segment.origin(path).packed for path in segment.segments(tmp_path / "bench")]  # noqa: E731
    wait_for(lambda: len(packed()) >= 3 and all(packed()[:-1]))
    keeper.close(PATIENCE_S)
    np.testing.assert_array_equal(
        join([piece.samples for piece in written(tmp_path / "bench")]).values, join(given).values
    )
    assert not list(tmp_path.rglob("*.part"))


def test_raw_bytes_come_back_as_chunks(tmp_path: Path) -> None:
    of = Origin("bench", "raw", carrier="bytes", decoder="text")
    keeper = Recorder(Storage(tmp_path), [of])
    keeper.start()
    given = [Chunk(bytes([i] * (i + 1)), 1000 + i, address=i, attachment=b"a" * (i % 3)) for i in range(50)]
    keeper.chunks("bench", given, offset_ns=START_NS)
    keeper.close(PATIENCE_S)
    (path,) = segment.segments(tmp_path / "bench" / "raw")
    back = list(segment.read_chunks(path))
    assert [(one.data, one.t_ns - START_NS, one.address, one.attachment) for one in back] == [
        (one.data, one.t_ns, one.address, one.attachment) for one in given
    ]
    assert segment.origin(path).carrier == "bytes"


@pytest.mark.parametrize("cut", [1, 7, 200, 1999, 2600])
def test_a_segment_that_was_cut_is_read_up_to_the_cut(tmp_path: Path, cut: int) -> None:
    path = tmp_path / segment.segment_name(1, 1.7e9)
    writer = SegmentWriter(path, SAMPLES)
    for first in range(0, 100, 10):
        writer.samples([rows(first, 10)], State())
    writer.close()
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    back = join([piece.samples for piece in segment.read_samples(path)])
    assert len(back) % 10 == 0
    assert len(back) >= 60
    np.testing.assert_array_equal(back.values, rows_of(len(back)))
    newest = segment.newest(path)
    assert newest is not None
    assert newest.samples.ticks[-1] == len(back) - 1
    list(segment.pack(path))
    np.testing.assert_array_equal(join([piece.samples for piece in segment.read_samples(path)]).values, back.values)


def rows_of(n: int) -> np.ndarray:
    return np.concatenate([rows(first, 10).values for first in range(0, n, 10)])


class Broken(SegmentWriter):
    """A disk that fails in the middle of a batch while ``why`` is set; it writes nothing until it is ``released``."""

    why: int | None = None
    refused = 0
    released = threading.Event()

    def samples(self, blocks, state) -> None:
        assert Broken.released.wait(PATIENCE_S)
        if Broken.why is not None:
            Broken.refused += 1
            self._file.write(b"half a batch")
            self._file.truncate(self._whole)
            self._file.seek(self._whole)
            raise OSError(Broken.why, os.strerror(Broken.why))
        super().samples(blocks, state)


@pytest.fixture
def disk():
    Broken.why, Broken.refused = None, 0
    Broken.released.set()
    yield Broken
    Broken.why = None
    Broken.released.set()


@pytest.mark.parametrize("why", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_disk_that_fails_stops_the_recording_with_an_event_until_it_can_go_on(tmp_path, disk, why: int) -> None:
    keeper = Recorder(Storage(tmp_path), [SAMPLES], Broken)
    keeper.start()
    keeper.samples("bench", rows(0, 100), 0)
    wait_for(lambda: len(written(tmp_path / "bench")) == 1)
    disk.why = why
    keeper.samples("bench", rows(100, 100), 0)
    wait_for(lambda: keeper.state != "ok")
    assert os.strerror(why) in keeper.state
    keeper.samples("bench", rows(200, 100), 0)
    refused = disk.refused
    wait_for(lambda: disk.refused >= refused + 3)  # it is tried again and again
    disk.why = None
    wait_for(lambda: keeper.state == "ok")
    keeper.close(PATIENCE_S)
    told = keeper.take()
    assert [one.kind for one in told] == ["recording_stopped", "recording_back"]
    # what came meanwhile had room in memory
    np.testing.assert_array_equal(join([piece.samples for piece in written(tmp_path / "bench")]).ticks, np.arange(300))


def test_what_a_slow_disk_cannot_take_is_a_hole_that_is_counted(tmp_path, disk, monkeypatch) -> None:
    monkeypatch.setattr(room, "QUEUE_BYTES", 500 * room.SAMPLE_BYTES)
    keeper = Recorder(Storage(tmp_path), [SAMPLES], Broken)
    keeper.start()
    for first in range(0, 20_000, 2000):
        disk.released.clear()
        for at in range(first, first + 2000, 100):
            keeper.samples("bench", rows(at, 100), 0)  # returns, although the disk writes nothing
        disk.released.set()
        all_written(keeper)
    keeper.close(PATIENCE_S)
    back = written(tmp_path / "bench")
    got = join([piece.samples for piece in back])
    assert keeper.missed > 0
    assert keeper.missed == 20_000 - len(got)
    assert str(keeper.missed) in keeper.state
    # each hole is told where it is
    counted = 0
    for piece in back:
        counted += piece.samples.lost
        assert piece.samples.ticks[0] == counted
        counted += len(piece.samples)


def test_old_segments_go_when_both_their_names_and_their_number_say_so(tmp_path: Path) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    names = [segment.segment_name(i, 1.7e9 + 100.0 * i) for i in range(10)]
    for name in names:
        (folder / name).write_bytes(b"x")
    (folder / "notes.txt").write_text("mine")
    room.retention.delete_old([folder], keep_s=350.0, segment_s=100.0)
    assert [path.name for path in segment.segments(folder)] == names[5:]
    assert (folder / "notes.txt").exists()


@pytest.mark.parametrize(("step_s", "newest_s"), [(100.0, 3.0e8), (1.0, 10.0)], ids=["a clock set wrong", "restarts"])
def test_neither_a_clock_set_wrong_nor_many_restarts_delete_what_is_new(tmp_path, step_s: float, newest_s) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    began = [1.7e9 + step_s * i for i in range(9)] + [1.7e9 + newest_s]
    for i, unix_s in enumerate(began):
        (folder / segment.segment_name(i, unix_s)).write_bytes(b"x")
    room.retention.delete_old([folder], keep_s=2000.0 if step_s > 1.0 else 350.0, segment_s=100.0)
    assert len(segment.segments(folder)) == 10


def test_the_oldest_of_all_devices_go_while_the_disk_is_too_full(tmp_path: Path, monkeypatch) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for at, folder in enumerate(folders):
        folder.mkdir()
        for i in range(5):
            (folder / segment.segment_name(i, 1.7e9 + 100.0 * i + at)).write_bytes(b"x")
    left = lambda: [len(segment.segments(folder)) for folder in folders]  # noqa: E731
    monkeypatch.setattr(room.retention, "taken_share", lambda _: 0.1 * sum(left()))
    assert room.retention.make_room(tmp_path, folders, share=0.75) == ""
    assert left() == [3, 4]
    assert "no older segment is left" in room.retention.make_room(tmp_path, folders, share=0.2)
    assert left() == [2, 2]


def test_a_disk_that_others_have_filled_stops_the_recording(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(room.retention, "taken_share", lambda _: 0.95)
    keeper = Recorder(Storage(tmp_path), [SAMPLES])
    keeper.start()
    keeper.samples("bench", rows(0, 10), 0)
    wait_for(lambda: "95 % full" in keeper.state)
    keeper.samples("bench", rows(10, 10), 0)  # waits until there is room
    monkeypatch.setattr(room.retention, "taken_share", lambda _: 0.5)
    wait_for(lambda: keeper.state == "ok")
    keeper.close(PATIENCE_S)
    assert len(join([piece.samples for piece in written(tmp_path / "bench")])) == 20


# --- going on after a restart


def station(folder: Path, keeper: Recorder, window_s: float = 30.0, axes: AxisMap | None = None) -> Station:
    decoder = text.build(text.Settings(columns=("counter", "gx", "gy", "gz", "ax", "ay", "az")))
    ready = Ready()
    for kernels in (ready.window, ready.fit, ready.all):
        kernels.set()
    link = LoopbackLink()
    device = Device("bench", RATE, window_s, "octave", 0.1, 0.1, link, decoder, axes or AxisMap(), 0.0)
    return Station(device, link, decoder, threading.Event(), ready, keeper)


def now_rows(first: int, n: int, wall_ns: int) -> SampleBlock:
    """Rows of the host's monotonic clock, the last of them just now."""
    return rows(first, n, start_ns=wall_ns - (first + n) * 10_000_000)


def lived(tmp_path: Path, tick_step: float | None = 1.0) -> Station:
    """A station that has taken 60 s, recorded them, and died without a word."""
    keeper = Recorder(Storage(tmp_path), [origin("bench", AxisMap())])
    keeper.start()
    before = station(tmp_path, keeper)
    mono_ns = time.monotonic_ns()
    for first in range(0, 6000, 50):
        before._push(rows(first, 50, start_ns=mono_ns - 6000 * 10_000_000))
        before.work([], first / 100.0)
    before.work([], 100.0, drain=True)
    keeper.know("bench", msgspec.structs.replace(before._known(), tick_step=tick_step))
    wait_for(lambda: sum(len(piece.samples) for piece in written(tmp_path / "bench")) == 6000)
    before._push(rows(6000, 1, start_ns=mono_ns - 6000 * 10_000_000))  # with what is known at last
    before.work([], 101.0, drain=True)
    keeper.close(PATIENCE_S)
    return before


def test_the_window_after_a_restart_is_the_one_before(tmp_path: Path) -> None:
    before = lived(tmp_path)
    keeper = Recorder(Storage(tmp_path), [origin("bench", AxisMap())])
    after = station(tmp_path, keeper)
    after._resume(keeper.tail("bench"))
    assert not after._can_take()  # new samples wait
    after.rebuild()
    assert after._can_take()
    old, new = before.chain.estimator.get(), after.chain.estimator.get()
    assert new.curve.n == old.curve.n == 3000
    np.testing.assert_array_equal(new.curve.terms, old.curve.terms)
    np.testing.assert_allclose(new.curve.avar, old.curve.avar, rtol=1e-9)
    for _ in range(10):  # the live fit takes a step each look
        old = before.chain.estimator.get()
    np.testing.assert_allclose(new.coefficients.value, old.coefficients.value, rtol=1e-9)
    # bounds are sought to seven digits
    np.testing.assert_allclose(new.coefficients.hi, old.coefficients.hi, rtol=1e-6)
    np.testing.assert_array_equal(new.coefficients.status, old.coefficients.status)
    assert after.chain.watch is not None
    (event,) = after._happened
    assert event.kind == "window_rebuilt"
    assert event.text == "30 s of the window were rebuilt from the recording"


def test_an_axis_that_began_anew_counts_from_there_after_a_restart_too(tmp_path: Path) -> None:
    keeper = Recorder(Storage(tmp_path), [origin("bench", AxisMap())])
    keeper.start()
    before = station(tmp_path, keeper)
    mono_ns = time.monotonic_ns()
    for first in range(0, 6000, 50):
        before._push(rows(first, 50, start_ns=mono_ns - 6000 * 10_000_000))
        before.work([], first / 100.0)
        if first == 5000:
            before.chain.estimator.restart(2, 1000)
            before.chain.since_ns[2] = before._newest_ns - 9_995_000_000
            before.report([], {}, 0)
            all_written(keeper)
    wait_for(lambda: sum(len(piece.samples) for piece in written(tmp_path / "bench")) == 6000)
    keeper.close(PATIENCE_S)
    after = station(tmp_path, Recorder(Storage(tmp_path), [origin("bench", AxisMap())]))
    after._resume(after._recorder.tail("bench"))
    after.rebuild()
    old, new = before.chain.estimator.get(), after.chain.estimator.get()
    assert old.curve.terms[0, 2] < old.curve.terms[0, 0]
    np.testing.assert_array_equal(new.curve.terms, old.curve.terms)
    np.testing.assert_allclose(new.curve.avar, old.curve.avar, rtol=1e-9)


@pytest.mark.parametrize("tick_step", [1.0, None], ids=["by the counter", "by the time that passed"])
def test_what_came_while_nobody_was_there_is_lost_and_keeps_its_place(tmp_path: Path, tick_step) -> None:
    begun_s = time.monotonic()
    lived(tmp_path, tick_step)
    keeper = Recorder(Storage(tmp_path), [origin("bench", AxisMap())])
    after = station(tmp_path, keeper)
    after.start()
    try:
        after.rebuild()
        if tick_step is None:
            rebuilt_s = time.monotonic()
            wait_for(lambda: time.monotonic() > rebuilt_s + 1.0)  # longer than the lines that come at once would take
        lines = "".join(f"{count},0.001,0,0,0,0,9.8\n" for count in range(6041, 6100))
        after.driver.link.write(b"\n" + lines.encode())
        wait_for(lambda: after.driver.counts.received == 59)
        if tick_step:
            assert after.driver.counts.lost == 40
        else:
            assert 0 < after.driver.counts.lost <= RATE * (time.monotonic() - begun_s)
        wait_for(lambda: after.work([], time.monotonic()) or after.chain.estimator.samples >= 6059)
        assert after.chain.estimator.filled == 3000
    finally:
        after.stop()
        after.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("axes", "older_s", "reason"),
    [
        (AxisMap((1, 0, 2, 3, 4, 5)), 0.0, None),
        (AxisMap(), 40.0, "ends 40"),
        (AxisMap(), -3600.0, "ends after the host's clock"),
    ],
    ids=["another mounting", "longer ago than the window", "the clock was set back"],
)
def test_what_the_samples_cannot_go_on_from_begins_anew(tmp_path, axes, older_s: float, reason) -> None:
    keeper = Recorder(Storage(tmp_path), [origin("bench", AxisMap())])
    keeper.start()
    keeper.samples("bench", rows(0, 3000, start_ns=time.time_ns() - int((older_s + 30.0) * 1e9)), 0)
    keeper.close(PATIENCE_S)
    after = station(tmp_path, Recorder(Storage(tmp_path), [origin("bench", axes)]), axes=axes)
    after._resume(after._recorder.tail("bench"))
    after.rebuild()
    assert after.chain.estimator is None
    assert after._can_take() is False or after.ring.room == after.ring.capacity
    texts = [event.text for event in after._happened]
    assert texts == [] if reason is None else reason in texts[0]


def test_files_that_are_no_segments_are_passed_over(tmp_path: Path) -> None:
    lived(tmp_path)
    (tmp_path / "bench" / segment.segment_name(900, 1.8e9)).write_bytes(b"no stream at all")
    (tmp_path / "bench" / segment.segment_name(901, 1.8e9)).write_bytes(b"")
    after = station(tmp_path, Recorder(Storage(tmp_path), [origin("bench", AxisMap())]))
    after._resume(after._recorder.tail("bench"))
    after.rebuild()
    assert after.chain.estimator.filled == 3000
