"""Tests of the recorder: stored samples, failing disks, old segments, restarts, and other programs in the folder."""

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
from drivers.decoders.text_lines import text
from drivers.driver import AxisMap
from drivers.host.wake_signal import WakeSignal
from drivers.recordings import load_samples, segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter, SegmentMetadata
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.daemon.storage import recorder, recording_track, retention
from monitor.daemon.storage.recorder import Recorder, segment_metadata
from monitor.settings.loading import BuiltLinkAndDecoder, Device, Storage
from tests.support.loopback_link import LoopbackLink
from tests.support.program import exit_status
from tests.support.waiting import PATIENCE_S, wait_for

pa = pytest.importorskip("pyarrow", reason="recording needs the extra arrow")

START_NS = 1_700_000_000_000_000_000
RATE = 100.0
SAMPLES = SegmentMetadata("bench", "samples")


def make_rows(first: int, n: int, lost: int = 0, start_ns: int = START_NS) -> SampleBlock:
    index = np.arange(first, first + n)
    values = np.random.default_rng(first).standard_normal((n, 6)) * 1e-3
    return make_block(start_ns + index * 10_000_000, values, 20.0 + index * 1e-4, index.astype(np.int64), lost)


def read_written_parts(folder: Path) -> list[segment_file.GapFreeSegmentPart]:
    return [piece for path in segment_file.list_segments(folder) for piece in segment_file.read_samples(path)]


def wait_until_written(sample_recorder: Recorder) -> None:
    """Wait until the recorder has written all queued samples."""
    wait_for(lambda: not any(track._queue or track._taken for track in sample_recorder._tracks.values()))


@pytest.fixture(autouse=True)
def _short_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "WRITE_INTERVAL_S", 0.02)
    monkeypatch.setattr(recorder, "RETRY_S", 0.1)
    monkeypatch.setattr(recording_track, "RETRY_S", 0.1)
    monkeypatch.setattr(recorder, "DELETE_INTERVAL_S", 0.05)


def test_values_counters_and_gaps_are_preserved(tmp_path: Path) -> None:
    sample_recorder = Recorder(Storage.model_construct(folder=tmp_path, segment_s=3.0), [SAMPLES])
    sample_recorder.set_estimate_state("bench", DaemonState(RATE, (None, None, 5.0, None, None, None), 1.0))
    sample_recorder.start()
    given = [make_rows(0, 150), make_rows(160, 150, lost=10), make_rows(310, 1), make_rows(311, 700)]
    for block in given:
        sample_recorder.queue_samples("bench", block, 0)
        wait_until_written(sample_recorder)  # each block is a separate batch
    sample_recorder.close(PATIENCE_S)
    back = read_written_parts(tmp_path / "bench")
    got, expected = concatenate_blocks([piece.samples for piece in back]), concatenate_blocks(given)
    np.testing.assert_array_equal(got.values, expected.values)
    np.testing.assert_array_equal(got.ticks, expected.ticks)
    np.testing.assert_array_equal(got.temperature_c, expected.temperature_c)
    assert got.t_ns.tolist() == expected.t_ns.tolist()
    assert [piece.samples.lost for piece in back if piece.samples.lost] == [10]
    assert back[-1].state == DaemonState(RATE, (None, None, 5.0, None, None, None), 1.0)
    assert len(segment_file.list_segments(tmp_path / "bench")) > 1
    whole = load_samples(tmp_path / "bench")
    np.testing.assert_array_equal(whole.values, expected.values)
    assert not any("not used" in note for note in whole.notes)


def test_closed_segments_are_compressed_without_loss(tmp_path: Path) -> None:
    sample_recorder = Recorder(Storage.model_construct(folder=tmp_path, segment_s=5.0), [SAMPLES])
    sample_recorder.start()
    given = [make_rows(first, 20) for first in range(0, 2000, 20)]
    for block in given:
        sample_recorder.queue_samples("bench", block, 0)
        wait_until_written(sample_recorder)

    def list_compressed() -> list[bool]:
        segments = segment_file.list_segments(tmp_path / "bench")
        return [segment_file.read_metadata(path).packed for path in segments]

    wait_for(lambda: len(list_compressed()) >= 3 and all(list_compressed()[:-1]))
    sample_recorder.close(PATIENCE_S)
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in read_written_parts(tmp_path / "bench")]).values,
        concatenate_blocks(given).values,
    )
    assert not list(tmp_path.rglob("*.part"))


def test_raw_bytes_are_restored_as_chunks(tmp_path: Path) -> None:
    metadata = SegmentMetadata("bench", "raw", carrier="bytes", decoder="text")
    sample_recorder = Recorder(Storage(folder=tmp_path), [metadata])
    sample_recorder.start()
    given = [Chunk(bytes([i] * (i + 1)), 1000 + i, address=i, attachment=b"a" * (i % 3)) for i in range(50)]
    sample_recorder.queue_chunks("bench", given, offset_ns=START_NS)
    sample_recorder.close(PATIENCE_S)
    (path,) = segment_file.list_segments(tmp_path / "bench" / "raw")
    back = list(segment_file.read_chunks(path))
    assert [(chunk.data, chunk.t_ns - START_NS, chunk.address, chunk.attachment) for chunk in back] == [
        (chunk.data, chunk.t_ns, chunk.address, chunk.attachment) for chunk in given
    ]
    assert segment_file.read_metadata(path).carrier == "bytes"


def test_conversion_preserves_times(tmp_path: Path) -> None:
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    t_ns = START_NS + np.arange(100) * 10_000_001
    writer = SegmentFileWriter(path, SAMPLES)
    writer.write_samples([make_block(t_ns, np.zeros((100, 6)))], DaemonState())
    writer.close()
    list(segment_file.compress_segment_stepwise(path))
    for name in ("x.csv", "x.npz", "x.parquet", "x.arrow", "x.mcap"):
        assert exit_status("convert", tmp_path, tmp_path.parent / name) == 0
        times = load_samples(tmp_path.parent / name).times
        assert times is not None
        assert times.tolist() == t_ns.tolist()


def test_segment_of_an_earlier_revision_has_times_in_s(tmp_path: Path) -> None:
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    t_s = np.array([1.7e9, 1.7e9 + 0.5, 1.7e9 + 1.0])
    schema = segment_file._schema(pa, SAMPLES, "t")
    with pa.ipc.new_stream(path, schema) as file:
        for rows in (slice(2), slice(2, 3)):
            n = t_s[rows].size
            columns = [t_s[rows], *np.zeros((7, n)), *np.zeros((2, n), np.int64)]
            file.write_batch(pa.record_batch([pa.array(column) for column in columns], schema=schema))
    for _ in range(2):
        back = concatenate_blocks([piece.samples for piece in segment_file.read_samples(path)])
        assert back.t_ns.tolist() == [START_NS, START_NS + 500_000_000, START_NS + 1_000_000_000]
        list(segment_file.compress_segment_stepwise(path))


@pytest.mark.parametrize("cut", [1, 7, 200, 1999, 2600])
def test_truncated_segment_is_read_up_to_the_cut(tmp_path: Path, cut: int) -> None:
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    writer = SegmentFileWriter(path, SAMPLES)
    for first in range(0, 100, 10):
        writer.write_samples([make_rows(first, 10)], DaemonState())
    writer.close()
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    back = concatenate_blocks([piece.samples for piece in segment_file.read_samples(path)])
    assert len(back) % 10 == 0
    assert len(back) >= 60
    np.testing.assert_array_equal(back.values, make_row_values(len(back)))
    newest = segment_file.read_last_piece(path)
    assert newest is not None
    assert newest.samples.ticks[-1] == len(back) - 1
    list(segment_file.compress_segment_stepwise(path))
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in segment_file.read_samples(path)]).values, back.values
    )


@pytest.mark.parametrize("read", [segment_file.read_samples, segment_file.read_last_piece])
def test_segment_compressed_while_it_is_opened_is_read_completely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object]
) -> None:
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    writer = SegmentFileWriter(path, SAMPLES)
    for first in range(0, 100, 10):
        writer.write_samples([make_rows(first, 10)], DaemonState())
    writer.close()
    opened = segment_file.open_regular_file

    def open_then_compress(name: Path) -> IO[bytes]:
        file = opened(name)
        monkeypatch.setattr(segment_file, "open_regular_file", opened)
        list(segment_file.compress_segment_stepwise(path))
        return file

    monkeypatch.setattr(segment_file, "open_regular_file", open_then_compress)
    found = read(path)
    pieces = [found] if isinstance(found, segment_file.GapFreeSegmentPart) else list(found)  # type: ignore[call-overload]
    assert segment_file.read_metadata(path).packed
    assert pieces[-1].samples.ticks[-1] == 99


def make_row_values(n: int) -> np.ndarray:
    return np.concatenate([make_rows(first, 10).values for first in range(0, n, 10)])


class FailingSegmentFileWriter(SegmentFileWriter):
    """A writer that fails in the middle of a batch while ``why`` is set and waits until it is ``released``."""

    error_number: int | None = None
    refused = 0
    released = threading.Event()

    def write_samples(self, blocks, state) -> None:
        assert FailingSegmentFileWriter.released.wait(PATIENCE_S)
        error_number = FailingSegmentFileWriter.error_number  # read once: the test clears it in another thread
        if error_number is not None:
            FailingSegmentFileWriter.refused += 1
            self._file.write(b"half a batch")
            self._file.truncate(self._valid_bytes)
            self._file.seek(self._valid_bytes)
            raise OSError(error_number, os.strerror(error_number))
        super().write_samples(blocks, state)


@pytest.fixture
def failing_writer():
    FailingSegmentFileWriter.error_number, FailingSegmentFileWriter.refused = None, 0
    FailingSegmentFileWriter.released.set()
    yield FailingSegmentFileWriter
    FailingSegmentFileWriter.error_number = None
    FailingSegmentFileWriter.released.set()


@pytest.mark.parametrize("error_number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_failing_disk_stops_the_recording_until_writing_succeeds(tmp_path, failing_writer, error_number: int) -> None:
    sample_recorder = Recorder(Storage(folder=tmp_path), [SAMPLES], FailingSegmentFileWriter)
    sample_recorder.start()
    sample_recorder.queue_samples("bench", make_rows(0, 100), 0)
    wait_for(lambda: len(read_written_parts(tmp_path / "bench")) == 1)
    failing_writer.error_number = error_number
    sample_recorder.queue_samples("bench", make_rows(100, 100), 0)
    wait_for(lambda: sample_recorder.state != "ok")
    assert os.strerror(error_number) in sample_recorder.state
    sample_recorder.queue_samples("bench", make_rows(200, 100), 0)
    refused = failing_writer.refused
    wait_for(lambda: failing_writer.refused >= refused + 3)  # writing is retried
    failing_writer.error_number = None
    wait_for(lambda: sample_recorder.state == "ok")
    sample_recorder.close(PATIENCE_S)
    events = sample_recorder.take_events()
    assert [event.kind for event in events] == ["recording_stopped", "recording_back"]
    # The samples that arrived meanwhile were kept in memory.
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in read_written_parts(tmp_path / "bench")]).ticks, np.arange(300)
    )


def test_samples_that_a_slow_disk_cannot_store_are_counted_as_lost(tmp_path, failing_writer, monkeypatch) -> None:
    monkeypatch.setattr(recording_track, "MAX_QUEUE_BYTES", 500 * recording_track.SAMPLE_BYTES)
    sample_recorder = Recorder(Storage(folder=tmp_path), [SAMPLES], FailingSegmentFileWriter)
    sample_recorder.start()
    for first in range(0, 20_000, 2000):
        failing_writer.released.clear()
        for at in range(first, first + 2000, 100):
            sample_recorder.queue_samples("bench", make_rows(at, 100), 0)  # returns although the disk writes nothing
        failing_writer.released.set()
        wait_until_written(sample_recorder)
    sample_recorder.close(PATIENCE_S)
    back = read_written_parts(tmp_path / "bench")
    got = concatenate_blocks([piece.samples for piece in back])
    assert sample_recorder.missed_rows > 0
    assert sample_recorder.missed_rows == 20_000 - len(got)
    assert str(sample_recorder.missed_rows) in sample_recorder.state
    # Each loss is recorded at its position.
    counted = 0
    for piece in back:
        counted += piece.samples.lost
        assert piece.samples.ticks[0] == counted
        counted += len(piece.samples)


def test_old_segments_are_deleted_if_both_name_and_number_are_old(tmp_path: Path) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    names = [segment_file.format_segment_name(i, 1.7e9 + 100.0 * i) for i in range(10)]
    for name in names:
        (folder / name).write_bytes(b"x")
    (folder / "notes.txt").write_text("mine")
    retention.delete_old_segments([folder], keep_s=350.0, segment_s=100.0)
    assert [path.name for path in segment_file.list_segments(folder)] == names[5:]
    assert (folder / "notes.txt").exists()


@pytest.mark.parametrize(("step_s", "newest_s"), [(100.0, 3.0e8), (1.0, 10.0)], ids=["wrong clock", "restarts"])
def test_wrong_clock_or_many_restarts_delete_no_new_segment(tmp_path, step_s: float, newest_s) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    began = [1.7e9 + step_s * i for i in range(9)] + [1.7e9 + newest_s]
    for i, unix_s in enumerate(began):
        (folder / segment_file.format_segment_name(i, unix_s)).write_bytes(b"x")
    retention.delete_old_segments([folder], keep_s=2000.0 if step_s > 1.0 else 350.0, segment_s=100.0)
    assert len(segment_file.list_segments(folder)) == 10


def test_oldest_segments_of_all_devices_are_deleted_from_a_full_disk(tmp_path: Path, monkeypatch) -> None:
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


def test_disk_filled_by_other_programs_stops_the_recording(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.95)
    sample_recorder = Recorder(Storage(folder=tmp_path), [SAMPLES])
    sample_recorder.start()
    sample_recorder.queue_samples("bench", make_rows(0, 10), 0)
    wait_for(lambda: "95 % full" in sample_recorder.state)
    sample_recorder.queue_samples("bench", make_rows(10, 10), 0)  # the samples wait until there is space
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.5)
    wait_for(lambda: sample_recorder.state == "ok")
    sample_recorder.close(PATIENCE_S)
    assert len(concatenate_blocks([piece.samples for piece in read_written_parts(tmp_path / "bench")])) == 20


# --- restart


def make_worker(
    folder: Path, sample_recorder: Recorder, window_s: float = 30.0, axes: AxisMap | None = None
) -> DeviceWorker:
    decoder = text.build(text.Settings(columns=("counter", "gx", "gy", "gz", "ax", "ay", "az")))
    ready = KernelReadiness()
    for kernels in (ready.window, ready.fit, ready.all):
        kernels.set()
    link = LoopbackLink()
    driver = BuiltLinkAndDecoder(link, decoder, silence_s=0.0)
    device = Device.model_construct(
        name="bench", rate_hz=RATE, window_s=window_s, axes=axes or AxisMap(), driver=driver
    )
    return DeviceWorker(device, link, [], WakeSignal(), ready, sample_recorder)


def make_recent_rows(first: int, n: int, wall_ns: int) -> SampleBlock:
    """Return rows with times of the host's monotonic clock; the last row is from now."""
    return make_rows(first, n, start_ns=wall_ns - (first + n) * 10_000_000)


def record_until_abrupt_end(tmp_path: Path, tick_step: float | None = 1.0) -> DeviceWorker:
    """Return a worker that has recorded 60 s and ended without a final state."""
    sample_recorder = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    sample_recorder.start()
    before = make_worker(tmp_path, sample_recorder)
    mono_ns = time.monotonic_ns()
    for first in range(0, 6000, 50):
        before._push(make_rows(first, 50, start_ns=mono_ns - 6000 * 10_000_000))
        before.process_new_samples(first / 100.0)
    before.process_new_samples(100.0, drain=True)
    sample_recorder.set_estimate_state(
        "bench", msgspec.structs.replace(before.restore.state_to_record(), tick_step=tick_step)
    )
    wait_for(lambda: sum(len(piece.samples) for piece in read_written_parts(tmp_path / "bench")) == 6000)
    before._push(make_rows(6000, 1, start_ns=mono_ns - 6000 * 10_000_000))  # recorded with the final state
    before.process_new_samples(101.0, drain=True)
    sample_recorder.close(PATIENCE_S)
    return before


def test_window_after_a_restart_equals_the_window_before(tmp_path: Path) -> None:
    before = record_until_abrupt_end(tmp_path)
    sample_recorder = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    after = make_worker(tmp_path, sample_recorder)
    after.restore.resume_from(sample_recorder.find_last_recorded_samples("bench"))
    assert not after._can_take()  # new samples have to wait
    after.refill_window_from_recording()
    assert after._can_take()
    old, new = before.pipeline.estimator.get_estimate(), after.pipeline.estimator.get_estimate()
    assert new.curve.n == old.curve.n == 3000
    np.testing.assert_array_equal(new.curve.terms, old.curve.terms)
    np.testing.assert_allclose(new.curve.avar, old.curve.avar, rtol=1e-9)
    for _ in range(10):  # the live fit advances by one step per call
        old = before.pipeline.estimator.get_estimate()
    np.testing.assert_allclose(new.coefficients.value, old.coefficients.value, rtol=1e-9)
    # bounds are computed to seven digits
    np.testing.assert_allclose(new.coefficients.hi, old.coefficients.hi, rtol=1e-6)
    np.testing.assert_array_equal(new.coefficients.status, old.coefficients.status)
    assert after.pipeline.motion_and_change_monitor is not None
    (event,) = after.timeline._events
    assert event.kind == "window_rebuilt"
    assert event.text == "30 s of the window were rebuilt from the recording"


def test_restarted_axis_keeps_its_sample_count_after_a_restart(tmp_path: Path) -> None:
    sample_recorder = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    sample_recorder.start()
    before = make_worker(tmp_path, sample_recorder)
    mono_ns = time.monotonic_ns()
    for first in range(0, 6000, 50):
        before._push(make_rows(first, 50, start_ns=mono_ns - 6000 * 10_000_000))
        before.process_new_samples(first / 100.0)
        if first == 5000:
            before.pipeline.estimator.restart_axis(2, 1000)
            before.pipeline.since_ns[2] = before.timeline._newest_ns - 9_995_000_000
            before.slew_and_publish_status({}, 0)
            wait_until_written(sample_recorder)
    wait_for(lambda: sum(len(piece.samples) for piece in read_written_parts(tmp_path / "bench")) == 6000)
    sample_recorder.close(PATIENCE_S)
    after = make_worker(tmp_path, Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())]))
    after.restore.resume_from(after._recorder.find_last_recorded_samples("bench"))
    after.refill_window_from_recording()
    old, new = before.pipeline.estimator.get_estimate(), after.pipeline.estimator.get_estimate()
    assert old.curve.terms[0, 2] < old.curve.terms[0, 0]
    np.testing.assert_array_equal(new.curve.terms, old.curve.terms)
    np.testing.assert_allclose(new.curve.avar, old.curve.avar, rtol=1e-9)


@pytest.mark.parametrize("tick_step", [1.0, None], ids=["by counter", "by elapsed time"])
def test_samples_missed_during_the_restart_are_counted_as_lost(tmp_path: Path, tick_step) -> None:
    begun_s = time.monotonic()
    record_until_abrupt_end(tmp_path, tick_step)
    sample_recorder = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    after = make_worker(tmp_path, sample_recorder)
    after.start_reader_and_resume_recording()
    try:
        after.refill_window_from_recording()
        if tick_step is None:
            rebuilt_s = time.monotonic()
            wait_for(lambda: time.monotonic() > rebuilt_s + 1.0)  # longer than the duration of the lines sent at once
        lines = "".join(f"{count},0.001,0,0,0,0,9.8\n" for count in range(6041, 6100))
        after.driver.link.write(b"\n" + lines.encode())
        counts = after.driver.counts
        wait_for(
            lambda: counts.received == 59 and counts.lost, lambda: counts
        )  # the reader updates the counters one after the other
        if tick_step:
            assert counts.lost == 40
        else:
            assert counts.lost <= RATE * (time.monotonic() - begun_s)
        wait_for(
            lambda: after.process_new_samples(time.monotonic()) or after.pipeline.estimator.samples_received >= 6059
        )
        assert after.pipeline.estimator.samples_in_window == 3000
    finally:
        after.stop_reader_thread()
        after.join_reader_thread(PATIENCE_S)


@pytest.mark.parametrize(
    ("axes", "older_s", "reason"),
    [
        (AxisMap((1, 0, 2, 3, 4, 5)), 0.0, None),
        (AxisMap(), 40.0, "ended 4"),  # 40 s, or a little more on a busy machine
        (AxisMap(), -3600.0, "later than the present time"),
    ],
    ids=["other mounting", "older than the window", "clock set back"],
)
def test_unsuitable_recording_starts_an_empty_window(tmp_path, axes, older_s: float, reason) -> None:
    sample_recorder = Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())])
    sample_recorder.start()
    sample_recorder.queue_samples("bench", make_rows(0, 3000, start_ns=time.time_ns() - int((older_s + 30.0) * 1e9)), 0)
    sample_recorder.close(PATIENCE_S)
    after = make_worker(tmp_path, Recorder(Storage(folder=tmp_path), [segment_metadata("bench", axes)]), axes=axes)
    after.restore.resume_from(after._recorder.find_last_recorded_samples("bench"))
    after.refill_window_from_recording()
    assert after.pipeline.estimator is None
    assert after._can_take() is False or after.ring.free_capacity == after.ring.capacity
    texts = [event.text for event in after.timeline._events]
    assert texts == [] if reason is None else reason in texts[0]


def test_invalid_segment_files_are_ignored(tmp_path: Path) -> None:
    record_until_abrupt_end(tmp_path)
    (tmp_path / "bench" / segment_file.format_segment_name(900, 1.8e9)).write_bytes(b"no stream at all")
    (tmp_path / "bench" / segment_file.format_segment_name(901, 1.8e9)).write_bytes(b"")
    after = make_worker(tmp_path, Recorder(Storage(folder=tmp_path), [segment_metadata("bench", AxisMap())]))
    after.restore.resume_from(after._recorder.find_last_recorded_samples("bench"))
    after.refill_window_from_recording()
    assert after.pipeline.estimator.samples_in_window == 3000


# --- other programs in the same folder


def read_ticks_and_lost_count(folder: Path) -> tuple[np.ndarray, int]:
    """Return the ticks of all rows and the samples lost between them; a loss before the first row is ignored."""
    pieces = read_written_parts(folder)
    return concatenate_blocks([piece.samples for piece in pieces]).ticks, sum(
        piece.samples.lost for piece in pieces[1:]
    )


def test_two_recorders_on_one_folder_lose_and_duplicate_nothing(tmp_path: Path) -> None:
    """Both recorders receive the same samples; the times of the second are 3 ms late."""
    first, second = (Recorder(Storage.model_construct(folder=tmp_path, segment_s=10.0), [SAMPLES]) for _ in range(2))
    for sample_recorder in (first, second):
        sample_recorder.set_estimate_state("bench", DaemonState(RATE))
    first.start()
    wait_for((tmp_path / "recording.lock").exists)
    first.queue_samples("bench", make_rows(0, 20), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    second.start()
    wait_for(lambda: "in use" in second.state)
    assert second.state == (
        f"{tmp_path}: in use by process {os.getpid()}; nothing is recorded here until it ends; "
        "end it, or choose another folder in [storage]"
    )
    given = 20
    for at in range(20, 4000, 20):
        first.queue_samples("bench", make_rows(at, 20), 0)
        second.queue_samples("bench", make_rows(at, 20), 3_000_000)
        given = at + 20
    first.close()
    first_has, _ = read_ticks_and_lost_count(tmp_path / "bench")
    assert first_has.tolist() == list(range(given))
    for at in range(given, given + 2000, 20):
        second.queue_samples("bench", make_rows(at, 20), 3_000_000)
    wait_for(lambda: second.state == "ok")
    second.close()
    ticks, lost = read_ticks_and_lost_count(tmp_path / "bench")
    assert ticks.tolist() == list(range(given + 2000))
    assert lost == 0
    assert [sample_recorder.kind for sample_recorder in second.take_events()] == ["recording_stopped", "recording_back"]
    assert first.state == second.state == "ok"


def test_second_recorder_without_counters_continues_by_time(tmp_path: Path) -> None:
    def make_rows_without_counter(first: int, n: int) -> SampleBlock:
        block = make_rows(first, n)
        return make_block(block.t_ns.copy(), block.values.copy(), block.temperature_c.copy())

    first, second = (Recorder(Storage(folder=tmp_path), [SAMPLES]) for _ in range(2))
    first.set_estimate_state("bench", DaemonState(RATE))
    first.start()
    first.queue_samples("bench", make_rows_without_counter(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    second.start()
    wait_for(lambda: "in use" in second.state)
    second.queue_samples("bench", make_rows_without_counter(50, 50), 0)  # these samples are already recorded
    second.queue_samples("bench", make_rows_without_counter(105, 50), 0)
    first.close()
    wait_for(lambda: second.state == "ok")
    second.close()
    pieces = read_written_parts(tmp_path / "bench")
    times = (concatenate_blocks([piece.samples for piece in pieces]).t_ns - START_NS + 1000) // 10_000_000
    assert times.tolist() == [*range(100), *range(105, 155)]
    assert sum(piece.samples.lost for piece in pieces) == 5


def test_waiting_recorder_deletes_nothing(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.1)
    first = Recorder(Storage(folder=tmp_path), [SAMPLES])
    first.start()
    first.queue_samples("bench", make_rows(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    for i in range(2, 8):
        (tmp_path / "bench" / segment_file.format_segment_name(i, 1.0e9)).write_bytes(b"old")
    (tmp_path / "bench" / "00000099_x.arrows.part").write_bytes(b"of the first")
    monkeypatch.setattr(retention, "used_disk_share", lambda _: 0.99)
    monkeypatch.setattr(first, "_delete_old", lambda: None)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    second = Recorder(Storage.model_construct(folder=tmp_path, keep_s=10.0, segment_s=10.0), [SAMPLES])
    second.start()
    second.queue_samples("bench", make_rows(0, 100), 0)
    wait_for(lambda: "in use" in second.state)
    rounds = second._lock_failed_s
    wait_for(lambda: second._lock_failed_s != rounds)
    second.close()
    assert sorted(path.name for path in tmp_path.rglob("*")) == before
    first.close()


def test_raw_bytes_of_two_recorders_are_stored_once(tmp_path: Path) -> None:
    metadata = SegmentMetadata("bench", "raw", carrier="frames", decoder="dbc")
    given = [Chunk(bytes([i]), START_NS + i, address=i) for i in range(100)]
    first, second = (Recorder(Storage(folder=tmp_path), [metadata]) for _ in range(2))
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
        chunk
        for path in segment_file.list_segments(tmp_path / "bench" / "raw")
        for chunk in segment_file.read_chunks(path)
    ]
    assert [chunk.address for chunk in back] == list(range(100))


def delete(path: Path) -> None:
    path.unlink()


def rename(path: Path) -> None:
    path.rename(path.with_name("elsewhere.arrows"))


def cut(path: Path) -> None:
    os.truncate(path, 1000)


def append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"mine")


def replace_file(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(b"mine")
    other.rename(path)


def remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent.parent)


def rename_folder(path: Path) -> None:
    path.parent.parent.rename(path.parent.parent.with_name("away"))


@pytest.mark.parametrize("tamper", [delete, rename, cut, append, replace_file, remove_folder, rename_folder])
def test_changed_segment_file_is_noticed_and_a_new_file_is_started(tmp_path: Path, tamper) -> None:
    folder = tmp_path / "store" / "bench"
    sample_recorder = Recorder(Storage(folder=tmp_path / "store"), [SAMPLES])
    sample_recorder.start()
    sample_recorder.queue_samples("bench", make_rows(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(folder)))
    (path,) = segment_file.list_segments(folder)
    tamper(path)
    wait_for(lambda: "ok, but" in sample_recorder.state)
    assert f"{path} was " in sample_recorder.state
    assert "with 100 rows in it; a new file is begun" in sample_recorder.state
    assert [event.kind for event in sample_recorder.take_events()] == ["recording_stopped", "recording_back"]
    sample_recorder.queue_samples("bench", make_rows(100, 100), 0)
    wait_for(lambda: any(other != path and other.stat().st_size > 9000 for other in segment_file.list_segments(folder)))
    sample_recorder.close()
    newest = segment_file.list_segments(folder)[-1]
    np.testing.assert_array_equal(
        concatenate_blocks([piece.samples for piece in segment_file.read_samples(newest)]).ticks, np.arange(100, 200)
    )
    match tamper.__name__:
        case "replace_file":
            assert path.read_bytes() == b"mine"
        case "cut":
            assert path.stat().st_size == 1000
        case "append":
            assert path.read_bytes().endswith(b"mine")
        case "rename" | "rename_folder":
            (old,) = tmp_path.rglob("elsewhere.arrows" if tamper is rename else f"away/*/{path.name}")
            assert len(load_samples(old)) == 100
            assert not load_samples(old).notes  # the segment was closed properly


def test_folder_of_one_device_may_be_deleted_while_another_is_recorded(tmp_path: Path) -> None:
    sample_recorder = Recorder(Storage(folder=tmp_path), [SAMPLES, SegmentMetadata("other", "samples")])
    sample_recorder.start()
    for at in range(0, 300, 100):
        sample_recorder.queue_samples("bench", make_rows(at, 100), 0)
        sample_recorder.queue_samples("other", make_rows(at, 100), 0)
        if at == 0:
            wait_for(lambda: len(list(tmp_path.rglob("*.arrows"))) == 2)
            shutil.rmtree(tmp_path / "bench")
            wait_for(lambda: "was deleted" in sample_recorder.state)
    sample_recorder.close()
    assert read_ticks_and_lost_count(tmp_path / "other")[0].tolist() == list(range(300))
    assert read_ticks_and_lost_count(tmp_path / "bench")[0].tolist() == list(range(100, 300))


@pytest.mark.parametrize("kind", ["fifo", "directory", "loop"])
def test_other_file_types_in_place_of_segments_are_ignored(tmp_path: Path, kind: str) -> None:
    sample_recorder = Recorder(Storage(folder=tmp_path), [SAMPLES])
    sample_recorder.start()
    sample_recorder.queue_samples("bench", make_rows(0, 100), 0)
    wait_for(lambda: bool(segment_file.list_segments(tmp_path / "bench")))
    sample_recorder.close()
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
    tail = again.find_last_recorded_samples("bench")
    assert tail is not None
    assert tail.newest.samples.ticks[-1] == 99
    assert len(list(tail.read_pieces(10.0))) == 1
    again.start()
    again.queue_samples("bench", make_rows(100, 100), 0)
    wait_for(lambda: segment_file.parse_segment_number(segment_file.list_segments(tmp_path / "bench")[-1]) == 8)
    again.close()
    assert again.state == "ok"


def test_wrong_storage_folder_is_reported_until_it_is_removed(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "store")
    sample_recorder = Recorder(Storage(folder=tmp_path / "store"), [SAMPLES])
    sample_recorder.start()
    sample_recorder.queue_samples("bench", make_rows(0, 100), 0)
    state = f"{tmp_path / 'store'}: is a FIFO, not a folder; recording stopped, trying again"
    wait_for(lambda: sample_recorder.state == state)
    (tmp_path / "store").unlink()
    wait_for(lambda: sample_recorder.state == "ok")
    sample_recorder.close()
    assert read_ticks_and_lost_count(tmp_path / "store" / "bench")[0].tolist() == list(range(100))


def test_unusable_folder_loses_only_samples_that_do_not_fit_into_memory(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(recording_track, "MAX_QUEUE_BYTES", 500 * recording_track.SAMPLE_BYTES)
    (tmp_path / "store").write_text("in the way")
    sample_recorder = Recorder(Storage(folder=tmp_path / "store"), [SAMPLES])
    sample_recorder.start()
    wait_for(lambda: "is a file, not a folder" in sample_recorder.state)
    for at in range(0, 1000, 100):
        sample_recorder.queue_samples("bench", make_rows(at, 100), 0)
    (tmp_path / "store").unlink()
    wait_for(lambda: sample_recorder.state.startswith("ok"))
    sample_recorder.close()
    assert sample_recorder.missed_rows == 500
    assert sample_recorder.state == "ok, but 500 rows are not in the recording: the disk was too slow or full"
    (piece,) = read_written_parts(tmp_path / "store" / "bench")
    assert (piece.samples.lost, piece.samples.ticks[0]) == (500, 500)
