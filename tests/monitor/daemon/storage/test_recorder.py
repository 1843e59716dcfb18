"""What is recorded comes back to the last bit, whatever the disk and the process do; a window goes on from it."""

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

import msgspec
import numpy as np
import pytest

from drivers.data_types import Chunk, SampleBlock, concatenate_blocks, make_block
from drivers.decoders import text
from drivers.driver import AxisMap
from drivers.recordings import load_samples, segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter, SegmentMetadata
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.daemon.storage import recorder, recording_track, retention
from monitor.daemon.storage.recorder import Recorder, segment_metadata
from monitor.settings.loading import BuiltLinkAndDecoder, Device, Storage
from tests.support.loopback_link import LoopbackLink
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")

START_NS = 1_700_000_000_000_000_000
RATE = 100.0
SAMPLES = SegmentMetadata("bench", "samples")


def rows(first: int, n: int, lost: int = 0, start_ns: int = START_NS) -> SampleBlock:
    index = np.arange(first, first + n)
    values = np.random.default_rng(first).standard_normal((n, 6)) * 1e-3
    return make_block(start_ns + index * 10_000_000, values, 20.0 + index * 1e-4, index.astype(np.int64), lost)


def written(folder: Path) -> list[segment_file.GapFreeSegmentPart]:
    return [piece for path in segment_file.list_segments(folder) for piece in segment_file.read_samples(path)]


def all_written(keeper: Recorder) -> None:
    """Wait until the recorder has written all that it was given."""
    wait_for(lambda: not any(track._queue or track._taken for track in keeper._tracks.values()))


@pytest.fixture(autouse=True)
def _brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "WRITE_INTERVAL_S", 0.02)
    monkeypatch.setattr(recorder, "RETRY_S", 0.1)
    monkeypatch.setattr(recording_track, "RETRY_S", 0.1)
    monkeypatch.setattr(recorder, "DELETE_INTERVAL_S", 0.05)


def test_every_value_counter_and_hole_comes_back(tmp_path: Path) -> None:
    keeper = Recorder(Storage.model_construct(folder=tmp_path, segment_s=3.0), [SAMPLES])
    keeper.set_estimate_state("bench", DaemonState(RATE, (None, None, 5.0, None, None, None), 1.0))
    keeper.start()
    given = [rows(0, 150), rows(160, 150, lost=10), rows(310, 1), rows(311, 700)]
    for one in given:
        keeper.queue_samples("bench", one, 0)
        all_written(keeper)  # as a batch of its own
    keeper.close(PATIENCE_S)
    back = written(tmp_path / "bench")
    got, expected = concatenate_blocks([piece.samples for piece in back]), concatenate_blocks(given)
    np.testing.assert_array_equal(got.values, expected.values)
    np.testing.assert_array_equal(got.ticks, expected.ticks)
    np.testing.assert_array_equal(got.temperature_c, expected.temperature_c)
    assert np.abs(got.t_ns - expected.t_ns).max() <= 240
    assert [piece.samples.lost for piece in back if piece.samples.lost] == [10]
    assert back[-1].state == DaemonState(RATE, (None, None, 5.0, None, None, None), 1.0)
    assert len(segment_file.list_segments(tmp_path / "bench")) > 1
    whole = load_samples(tmp_path / "bench")
    np.testing.assert_array_equal(whole.values, expected.values)
    assert not any("not used" in note for note in whole.notes)


def test_segments_that_have_ended_are_packed_and_say_the_same(tmp_path: Path) -> None:
    keeper = Recorder(Storage.model_construct(folder=tmp_path, segment_s=5.0), [SAMPLES])
    keeper.start()
    given = [rows(first, 20) for first in range(0, 2000, 20)]
    for one in given:
        keeper.queue_samples("bench", one, 0)
        all_written(keeper)

    def packed() -> list[bool]:
        segments = segment_file.list_segments(tmp_path / "bench")
        return [segment_file.read_metadata(path).packed for path in segments]

    wait_for(lambda: len(packed()) >= 3 and all(packed()[:-1]))
    keeper.close(PATIENCE_S)
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in written(tmp_path / "bench")]).values,
        concatenate_blocks(given).values,
    )
    assert not list(tmp_path.rglob("*.part"))


def test_raw_bytes_come_back_as_chunks(tmp_path: Path) -> None:
    of = SegmentMetadata("bench", "raw", carrier="bytes", decoder="text")
    keeper = Recorder(Storage(folder=tmp_path), [of])
    keeper.start()
    given = [Chunk(bytes([i] * (i + 1)), 1000 + i, address=i, attachment=b"a" * (i % 3)) for i in range(50)]
    keeper.queue_chunks("bench", given, offset_ns=START_NS)
    keeper.close(PATIENCE_S)
    (path,) = segment_file.list_segments(tmp_path / "bench" / "raw")
    back = list(segment_file.read_chunks(path))
    assert [(one.data, one.t_ns - START_NS, one.address, one.attachment) for one in back] == [
        (one.data, one.t_ns, one.address, one.attachment) for one in given
    ]
    assert segment_file.read_metadata(path).carrier == "bytes"


@pytest.mark.parametrize("cut", [1, 7, 200, 1999, 2600])
def test_a_segment_that_was_cut_is_read_up_to_the_cut(tmp_path: Path, cut: int) -> None:
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    writer = SegmentFileWriter(path, SAMPLES)
    for first in range(0, 100, 10):
        writer.write_samples([rows(first, 10)], DaemonState())
    writer.close()
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    back = concatenate_blocks([piece.samples for piece in segment_file.read_samples(path)])
    assert len(back) % 10 == 0
    assert len(back) >= 60
    np.testing.assert_array_equal(back.values, rows_of(len(back)))
    newest = segment_file.read_last_piece(path)
    assert newest is not None
    assert newest.samples.ticks[-1] == len(back) - 1
    list(segment_file.compress_segment_stepwise(path))
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in segment_file.read_samples(path)]).values, back.values
    )


@pytest.mark.parametrize("read", [segment_file.read_samples, segment_file.read_last_piece])
def test_a_segment_that_is_packed_while_it_is_opened_is_read_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object]
) -> None:
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    writer = SegmentFileWriter(path, SAMPLES)
    for first in range(0, 100, 10):
        writer.write_samples([rows(first, 10)], DaemonState())
    writer.close()
    opened = segment_file.open_regular_file

    def open_then_pack(name: Path) -> IO[bytes]:
        file = opened(name)
        monkeypatch.setattr(segment_file, "open_regular_file", opened)
        list(segment_file.compress_segment_stepwise(path))
        return file

    monkeypatch.setattr(segment_file, "open_regular_file", open_then_pack)
    found = read(path)
    pieces = [found] if isinstance(found, segment_file.GapFreeSegmentPart) else list(found)  # type: ignore[call-overload]
    assert segment_file.read_metadata(path).packed
    assert pieces[-1].samples.ticks[-1] == 99


def rows_of(n: int) -> np.ndarray:
    return np.concatenate([rows(first, 10).values for first in range(0, n, 10)])


class Broken(SegmentFileWriter):
    """A disk that fails in the middle of a batch while ``why`` is set; it writes nothing until it is ``released``."""

    why: int | None = None
    refused = 0
    released = threading.Event()

    def write_samples(self, blocks, state) -> None:
        assert Broken.released.wait(PATIENCE_S)
        if Broken.why is not None:
            Broken.refused += 1
            self._file.write(b"half a batch")
            self._file.truncate(self._valid_bytes)
            self._file.seek(self._valid_bytes)
            raise OSError(Broken.why, os.strerror(Broken.why))
        super().write_samples(blocks, state)


@pytest.fixture
def disk():
    Broken.why, Broken.refused = None, 0
    Broken.released.set()
    yield Broken
    Broken.why = None
    Broken.released.set()


@pytest.mark.parametrize("why", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_disk_that_fails_stops_the_recording_with_an_event_until_it_can_go_on(tmp_path, disk, why: int) -> None:
    keeper = Recorder(Storage(folder=tmp_path), [SAMPLES], Broken)
    keeper.start()
    keeper.queue_samples("bench", rows(0, 100), 0)
    wait_for(lambda: len(written(tmp_path / "bench")) == 1)
    disk.why = why
    keeper.queue_samples("bench", rows(100, 100), 0)
    wait_for(lambda: keeper.state != "ok")
    assert os.strerror(why) in keeper.state
    keeper.queue_samples("bench", rows(200, 100), 0)
    refused = disk.refused
    wait_for(lambda: disk.refused >= refused + 3)  # it is tried again and again
    disk.why = None
    wait_for(lambda: keeper.state == "ok")
    keeper.close(PATIENCE_S)
    told = keeper.take_events()
    assert [one.kind for one in told] == ["recording_stopped", "recording_back"]
    # what came meanwhile had room in memory
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in written(tmp_path / "bench")]).ticks, np.arange(300)
    )


def test_what_a_slow_disk_cannot_take_is_a_hole_that_is_counted(tmp_path, disk, monkeypatch) -> None:
    monkeypatch.setattr(recording_track, "MAX_QUEUE_BYTES", 500 * recording_track.SAMPLE_BYTES)
    keeper = Recorder(Storage(folder=tmp_path), [SAMPLES], Broken)
    keeper.start()
    for first in range(0, 20_000, 2000):
        disk.released.clear()
        for at in range(first, first + 2000, 100):
            keeper.queue_samples("bench", rows(at, 100), 0)  # returns, although the disk writes nothing
        disk.released.set()
        all_written(keeper)
    keeper.close(PATIENCE_S)
    back = written(tmp_path / "bench")
    got = concatenate_blocks([piece.samples for piece in back])
    assert keeper.missed_rows > 0
    assert keeper.missed_rows == 20_000 - len(got)
    assert str(keeper.missed_rows) in keeper.state
    # each hole is told where it is
    counted = 0
    for piece in back:
        counted += piece.samples.lost
        assert piece.samples.ticks[0] == counted
        counted += len(piece.samples)


def test_old_segments_go_when_both_their_names_and_their_number_say_so(tmp_path: Path) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    names = [segment_file.format_segment_name(i, 1.7e9 + 100.0 * i) for i in range(10)]
    for name in names:
        (folder / name).write_bytes(b"x")
    (folder / "notes.txt").write_text("mine")
    retention.delete_old_segments([folder], keep_s=350.0, segment_s=100.0)
    assert [path.name for path in segment_file.list_segments(folder)] == names[5:]
    assert (folder / "notes.txt").exists()


@pytest.mark.parametrize(("step_s", "newest_s"), [(100.0, 3.0e8), (1.0, 10.0)], ids=["a clock set wrong", "restarts"])
def test_neither_a_clock_set_wrong_nor_many_restarts_delete_what_is_new(tmp_path, step_s: float, newest_s) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    began = [1.7e9 + step_s * i for i in range(9)] + [1.7e9 + newest_s]
    for i, unix_s in enumerate(began):
        (folder / segment_file.format_segment_name(i, unix_s)).write_bytes(b"x")
    retention.delete_old_segments([folder], keep_s=2000.0 if step_s > 1.0 else 350.0, segment_s=100.0)
    assert len(segment_file.list_segments(folder)) == 10


def test_the_oldest_of_all_devices_go_while_the_disk_is_too_full(tmp_path: Path, monkeypatch) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for at, folder in enumerate(folders):
        folder.mkdir()
        for i in range(5):
            (folder / segment_file.format_segment_name(i, 1.7e9 + 100.0 * i + at)).write_bytes(b"x")
    left = lambda: [len(segment_file.list_segments(folder)) for folder in folders]  # noqa: E731
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.1 * sum(left()))
    assert retention.delete_until_free(tmp_path, folders, max_used_share=0.75) == ""
    assert left() == [3, 4]
    assert "no older segment is left" in retention.delete_until_free(tmp_path, folders, max_used_share=0.2)
    assert left() == [2, 2]


def test_a_disk_that_others_have_filled_stops_the_recording(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.95)
    keeper = Recorder(Storage(folder=tmp_path), [SAMPLES])
    keeper.start()
    keeper.queue_samples("bench", rows(0, 10), 0)
    wait_for(lambda: "95 % full" in keeper.state)
    keeper.queue_samples("bench", rows(10, 10), 0)  # waits until there is room
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.5)
    wait_for(lambda: keeper.state == "ok")
    keeper.close(PATIENCE_S)
    assert len(concatenate_blocks([piece.samples for piece in written(tmp_path / "bench")])) == 20


# --- going on after a restart


def station(folder: Path, keeper: Recorder, window_s: float = 30.0, axes: AxisMap | None = None) -> DeviceWorker:
    decoder = text.build(text.Settings(columns=("counter", "gx", "gy", "gz", "ax", "ay", "az")))
    ready = KernelReadiness()
    for kernels in (ready.window, ready.fit, ready.all):
        kernels.set()
    link = LoopbackLink()
    driver = BuiltLinkAndDecoder(link, decoder, silence_s=0.0)
    device = Device.model_construct(
        name="bench", rate_hz=RATE, window_s=window_s, axes=axes or AxisMap(), driver=driver
    )
    return DeviceWorker(device, link, [], threading.Event(), ready, keeper)


def now_rows(first: int, n: int, wall_ns: int) -> SampleBlock:
    """Rows of the host's monotonic clock, the last of them just now."""
    return rows(first, n, start_ns=wall_ns - (first + n) * 10_000_000)


def lived(tmp_path: Path, tick_step: float | None = 1.0) -> DeviceWorker:
    """A station that has taken 60 s, recorded them, and died without a word."""
    keeper = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    keeper.start()
    before = station(tmp_path, keeper)
    mono_ns = time.monotonic_ns()
    for first in range(0, 6000, 50):
        before._push(rows(first, 50, start_ns=mono_ns - 6000 * 10_000_000))
        before.process_new_samples(first / 100.0)
    before.process_new_samples(100.0, drain=True)
    keeper.set_estimate_state("bench", msgspec.structs.replace(before.restore.state_to_record(), tick_step=tick_step))
    wait_for(lambda: sum(len(piece.samples) for piece in written(tmp_path / "bench")) == 6000)
    before._push(rows(6000, 1, start_ns=mono_ns - 6000 * 10_000_000))  # with what is known at last
    before.process_new_samples(101.0, drain=True)
    keeper.close(PATIENCE_S)
    return before


def test_the_window_after_a_restart_is_the_one_before(tmp_path: Path) -> None:
    before = lived(tmp_path)
    keeper = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    after = station(tmp_path, keeper)
    after.restore.resume_from(keeper.find_recording_tail("bench"))
    assert not after._can_take()  # new samples wait
    after.refill_window_from_recording()
    assert after._can_take()
    old, new = before.pipeline.estimator.get_estimate(), after.pipeline.estimator.get_estimate()
    assert new.curve.n == old.curve.n == 3000
    np.testing.assert_array_equal(new.curve.terms, old.curve.terms)
    np.testing.assert_allclose(new.curve.avar, old.curve.avar, rtol=1e-9)
    for _ in range(10):  # the live fit takes a step each look
        old = before.pipeline.estimator.get_estimate()
    np.testing.assert_allclose(new.coefficients.value, old.coefficients.value, rtol=1e-9)
    # bounds are sought to seven digits
    np.testing.assert_allclose(new.coefficients.hi, old.coefficients.hi, rtol=1e-6)
    np.testing.assert_array_equal(new.coefficients.status, old.coefficients.status)
    assert after.pipeline.signal_monitor is not None
    (event,) = after.timeline._events
    assert event.kind == "window_rebuilt"
    assert event.text == "30 s of the window were rebuilt from the recording"


def test_an_axis_that_began_anew_counts_from_there_after_a_restart_too(tmp_path: Path) -> None:
    keeper = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    keeper.start()
    before = station(tmp_path, keeper)
    mono_ns = time.monotonic_ns()
    for first in range(0, 6000, 50):
        before._push(rows(first, 50, start_ns=mono_ns - 6000 * 10_000_000))
        before.process_new_samples(first / 100.0)
        if first == 5000:
            before.pipeline.estimator.restart_axis(2, 1000)
            before.pipeline.since_ns[2] = before.timeline._newest_ns - 9_995_000_000
            before.slew_and_publish_status({}, 0)
            all_written(keeper)
    wait_for(lambda: sum(len(piece.samples) for piece in written(tmp_path / "bench")) == 6000)
    keeper.close(PATIENCE_S)
    after = station(tmp_path, Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())]))
    after.restore.resume_from(after._recorder.find_recording_tail("bench"))
    after.refill_window_from_recording()
    old, new = before.pipeline.estimator.get_estimate(), after.pipeline.estimator.get_estimate()
    assert old.curve.terms[0, 2] < old.curve.terms[0, 0]
    np.testing.assert_array_equal(new.curve.terms, old.curve.terms)
    np.testing.assert_allclose(new.curve.avar, old.curve.avar, rtol=1e-9)


@pytest.mark.parametrize("tick_step", [1.0, None], ids=["by the counter", "by the time that passed"])
def test_what_came_while_nobody_was_there_is_lost_and_keeps_its_place(tmp_path: Path, tick_step) -> None:
    begun_s = time.monotonic()
    lived(tmp_path, tick_step)
    keeper = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    after = station(tmp_path, keeper)
    after.start_reader_and_resume_recording()
    try:
        after.refill_window_from_recording()
        if tick_step is None:
            rebuilt_s = time.monotonic()
            wait_for(lambda: time.monotonic() > rebuilt_s + 1.0)  # longer than the lines that come at once would take
        lines = "".join(f"{count},0.001,0,0,0,0,9.8\n" for count in range(6041, 6100))
        after.driver.link.write(b"\n" + lines.encode())
        counts = after.driver.counts
        wait_for(lambda: counts.received == 59 and counts.lost, lambda: counts)  # the reader counts one after the other
        if tick_step:
            assert counts.lost == 40
        else:
            assert counts.lost <= RATE * (time.monotonic() - begun_s)
        wait_for(
            lambda: after.process_new_samples(time.monotonic()) or after.pipeline.estimator.samples_received >= 6059
        )
        assert after.pipeline.estimator.samples_in_window == 3000
    finally:
        after.stop()
        after.join_reader_thread(PATIENCE_S)


@pytest.mark.parametrize(
    ("axes", "older_s", "reason"),
    [
        (AxisMap((1, 0, 2, 3, 4, 5)), 0.0, None),
        (AxisMap(), 40.0, "ended 40"),
        (AxisMap(), -3600.0, "later than the present time"),
    ],
    ids=["another mounting", "longer ago than the window", "the clock was set back"],
)
def test_what_the_samples_cannot_go_on_from_begins_anew(tmp_path, axes, older_s: float, reason) -> None:
    keeper = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    keeper.start()
    keeper.queue_samples("bench", rows(0, 3000, start_ns=time.time_ns() - int((older_s + 30.0) * 1e9)), 0)
    keeper.close(PATIENCE_S)
    after = station(tmp_path, Recorder(Storage(folder=tmp_path), [segment_metadata("bench", axes)]), axes=axes)
    after.restore.resume_from(after._recorder.find_recording_tail("bench"))
    after.refill_window_from_recording()
    assert after.pipeline.estimator is None
    assert after._can_take() is False or after.ring.free_capacity == after.ring.capacity
    texts = [event.text for event in after.timeline._events]
    assert texts == [] if reason is None else reason in texts[0]


def test_files_that_are_no_segments_are_passed_over(tmp_path: Path) -> None:
    lived(tmp_path)
    (tmp_path / "bench" / segment_file.format_segment_name(900, 1.8e9)).write_bytes(b"no stream at all")
    (tmp_path / "bench" / segment_file.format_segment_name(901, 1.8e9)).write_bytes(b"")
    after = station(tmp_path, Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())]))
    after.restore.resume_from(after._recorder.find_recording_tail("bench"))
    after.refill_window_from_recording()
    assert after.pipeline.estimator.samples_in_window == 3000


# --- other programs in the same folder


def rows_of_all(folder: Path) -> tuple[np.ndarray, int]:
    """Counts of all rows, and the samples that are said to be lost between them; the first loss does not count."""
    pieces = written(folder)
    return concatenate_blocks([piece.samples for piece in pieces]).ticks, sum(
        piece.samples.lost for piece in pieces[1:]
    )


def test_two_recorders_on_one_folder_lose_nothing_and_keep_nothing_twice(tmp_path: Path) -> None:
    """Both receive the same samples; the times of the second are 3 ms late."""
    first, second = (Recorder(Storage.model_construct(folder=tmp_path, segment_s=10.0), [SAMPLES]) for _ in range(2))
    for one in (first, second):
        one.set_estimate_state("bench", DaemonState(RATE))
    first.start()
    wait_for((tmp_path / "recording.lock").exists)
    first.queue_samples("bench", rows(0, 20), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    second.start()
    wait_for(lambda: "in use" in second.state)
    assert second.state == (
        f"{tmp_path}: in use by process {os.getpid()}; nothing is recorded here until it ends; "
        "end it, or choose another folder in [storage]"
    )
    given = 20
    for at in range(20, 4000, 20):
        first.queue_samples("bench", rows(at, 20), 0)
        second.queue_samples("bench", rows(at, 20), 3_000_000)
        given = at + 20
    first.close()
    first_has, _ = rows_of_all(tmp_path / "bench")
    assert first_has.tolist() == list(range(given))
    for at in range(given, given + 2000, 20):
        second.queue_samples("bench", rows(at, 20), 3_000_000)
    wait_for(lambda: second.state == "ok")
    second.close()
    ticks, lost = rows_of_all(tmp_path / "bench")
    assert ticks.tolist() == list(range(given + 2000))
    assert lost == 0
    assert [one.kind for one in second.take_events()] == ["recording_stopped", "recording_back"]
    assert first.state == second.state == "ok"


def test_a_second_recorder_without_counts_goes_on_by_time_and_says_what_is_missing(tmp_path: Path) -> None:
    def uncounted(first: int, n: int) -> SampleBlock:
        one = rows(first, n)
        return make_block(one.t_ns.copy(), one.values.copy(), one.temperature_c.copy())

    first, second = (Recorder(Storage(folder=tmp_path), [SAMPLES]) for _ in range(2))
    first.set_estimate_state("bench", DaemonState(RATE))
    first.start()
    first.queue_samples("bench", uncounted(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    second.start()
    wait_for(lambda: "in use" in second.state)
    second.queue_samples("bench", uncounted(50, 50), 0)  # these are in the recording
    second.queue_samples("bench", uncounted(105, 50), 0)
    first.close()
    wait_for(lambda: second.state == "ok")
    second.close()
    pieces = written(tmp_path / "bench")
    times = (concatenate_blocks([piece.samples for piece in pieces]).t_ns - START_NS + 1000) // 10_000_000
    assert times.tolist() == [*range(100), *range(105, 155)]
    assert sum(piece.samples.lost for piece in pieces) == 5


def test_a_second_recorder_deletes_nothing(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.1)
    first = Recorder(Storage(folder=tmp_path), [SAMPLES])
    first.start()
    first.queue_samples("bench", rows(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    for i in range(2, 8):
        (tmp_path / "bench" / segment_file.format_segment_name(i, 1.0e9)).write_bytes(b"old")
    (tmp_path / "bench" / "00000099_x.arrows.part").write_bytes(b"of the first")
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.99)
    monkeypatch.setattr(first, "_delete_old", lambda: None)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    second = Recorder(Storage.model_construct(folder=tmp_path, keep_s=10.0, segment_s=10.0), [SAMPLES])
    second.start()
    second.queue_samples("bench", rows(0, 100), 0)
    wait_for(lambda: "in use" in second.state)
    rounds = second._lock_failed_s
    wait_for(lambda: second._lock_failed_s != rounds)
    second.close()
    assert sorted(path.name for path in tmp_path.rglob("*")) == before
    first.close()


def test_raw_bytes_of_two_recorders_are_kept_once(tmp_path: Path) -> None:
    of = SegmentMetadata("bench", "raw", carrier="frames", decoder="dbc")
    given = [Chunk(bytes([i]), START_NS + i, address=i) for i in range(100)]
    first, second = (Recorder(Storage(folder=tmp_path), [of]) for _ in range(2))
    first.start()
    first.queue_chunks("bench", given[:60], 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench" / "raw")))
    second.start()
    wait_for(lambda: "in use" in second.state)
    second.queue_chunks("bench", given[30:], 0)
    first.close()
    wait_for(lambda: second.state == "ok")
    second.close()
    back = [
        one for path in segment_file.list_segments(tmp_path / "bench" / "raw") for one in segment_file.read_chunks(path)
    ]
    assert [one.address for one in back] == list(range(100))


def delete(path: Path) -> None:
    path.unlink()


def rename(path: Path) -> None:
    path.rename(path.with_name("elsewhere.arrows"))


def cut(path: Path) -> None:
    os.truncate(path, 1000)


def append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"mine")


def put_another(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(b"mine")
    other.rename(path)


def remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent.parent)


def rename_folder(path: Path) -> None:
    path.parent.parent.rename(path.parent.parent.with_name("away"))


@pytest.mark.parametrize("tamper", [delete, rename, cut, append, put_another, remove_folder, rename_folder])
def test_a_file_that_is_changed_while_it_is_written_is_noticed_and_another_begun(tmp_path: Path, tamper) -> None:
    folder = tmp_path / "store" / "bench"
    keeper = Recorder(Storage(folder=tmp_path / "store"), [SAMPLES])
    keeper.start()
    keeper.queue_samples("bench", rows(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(folder)))
    (path,) = segment_file.list_segments(folder)
    tamper(path)
    wait_for(lambda: "ok, but" in keeper.state)
    assert f"{path} was " in keeper.state
    assert "with 100 rows in it; a new file is begun" in keeper.state
    assert [one.kind for one in keeper.take_events()] == ["recording_stopped", "recording_back"]
    keeper.queue_samples("bench", rows(100, 100), 0)
    wait_for(lambda: any(one != path and one.stat().st_size > 9000 for one in segment_file.list_segments(folder)))
    keeper.close()
    newest = segment_file.list_segments(folder)[-1]
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in segment_file.read_samples(newest)]).ticks, np.arange(100, 200)
    )
    match tamper.__name__:
        case "put_another":
            assert path.read_bytes() == b"mine"
        case "cut":
            assert path.stat().st_size == 1000
        case "append":
            assert path.read_bytes().endswith(b"mine")
        case "rename" | "rename_folder":
            (old,) = tmp_path.rglob("elsewhere.arrows" if tamper is rename else f"away/*/{path.name}")
            assert len(load_samples(old)) == 100
            assert not load_samples(old).notes  # it was ended


def test_the_folder_of_one_device_can_go_while_another_is_recorded(tmp_path: Path) -> None:
    keeper = Recorder(Storage(folder=tmp_path), [SAMPLES, SegmentMetadata("other", "samples")])
    keeper.start()
    for at in range(0, 300, 100):
        keeper.queue_samples("bench", rows(at, 100), 0)
        keeper.queue_samples("other", rows(at, 100), 0)
        if at == 0:
            wait_for(lambda: len(list(tmp_path.rglob("*.arrows"))) == 2)
            shutil.rmtree(tmp_path / "bench")
            wait_for(lambda: "was deleted" in keeper.state)
    keeper.close()
    assert rows_of_all(tmp_path / "other")[0].tolist() == list(range(300))
    assert rows_of_all(tmp_path / "bench")[0].tolist() == list(range(100, 300))


@pytest.mark.parametrize("kind", ["fifo", "directory", "loop"])
def test_what_is_no_file_in_place_of_segments_is_passed_over(tmp_path: Path, kind: str) -> None:
    keeper = Recorder(Storage(folder=tmp_path), [SAMPLES])
    keeper.start()
    keeper.queue_samples("bench", rows(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    keeper.close()
    for name in (segment_file.format_segment_name(1, 1.0e9), segment_file.format_segment_name(7, 1.7e9)):
        path = tmp_path / "bench" / name
        match kind:
            case "fifo":
                os.mkfifo(path)
            case "directory":
                path.mkdir()
            case _:
                path.symlink_to(path.name)
    again = Recorder(Storage.model_construct(folder=tmp_path, keep_s=1.0, segment_s=1.0), [SAMPLES])
    tail = again.find_recording_tail("bench")
    assert tail is not None
    assert tail.newest.samples.ticks[-1] == 99
    assert len(list(tail.read_pieces(10.0))) == 1
    again.start()
    again.queue_samples("bench", rows(100, 100), 0)
    wait_for(lambda: segment_file.parse_segment_number(segment_file.list_segments(tmp_path / "bench")[-1]) == 8)
    again.close()
    assert again.state == "ok"


def test_something_else_in_place_of_the_folder_is_said_until_it_is_gone(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "store")
    keeper = Recorder(Storage(folder=tmp_path / "store"), [SAMPLES])
    keeper.start()
    keeper.queue_samples("bench", rows(0, 100), 0)
    said = f"{tmp_path / 'store'}: is a FIFO, not a folder; recording stopped, trying again"
    wait_for(lambda: keeper.state == said)
    (tmp_path / "store").unlink()
    wait_for(lambda: keeper.state == "ok")
    keeper.close()
    assert rows_of_all(tmp_path / "store" / "bench")[0].tolist() == list(range(100))


def test_a_folder_that_cannot_be_used_costs_only_what_has_no_room_in_memory(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(recording_track, "MAX_QUEUE_BYTES", 500 * recording_track.SAMPLE_BYTES)
    (tmp_path / "store").write_text("in the way")
    keeper = Recorder(Storage(folder=tmp_path / "store"), [SAMPLES])
    keeper.start()
    wait_for(lambda: "is a file, not a folder" in keeper.state)
    for at in range(0, 1000, 100):
        keeper.queue_samples("bench", rows(at, 100), 0)
    (tmp_path / "store").unlink()
    wait_for(lambda: keeper.state.startswith("ok"))
    keeper.close()
    assert keeper.missed_rows == 500
    assert keeper.state == "ok, but 500 rows are not in the recording: the disk was too slow or full"
    (piece,) = written(tmp_path / "store" / "bench")
    assert (piece.samples.lost, piece.samples.ticks[0]) == (500, 500)
