"""Recording of one device: a bounded queue, and the segment file to which the queue is written.

The reader thread of the device fills the queue, and the recorder thread calls the other methods. After a failed write,
samples stay in the queue. Samples that do not fit into the queue are counted as missing in the recording.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from drivers.data_types import NO_TICK, Chunk, SampleBlock
from drivers.errors import ConfigError, RecordingError
from drivers.host.safe_file_reading import check_folder_or_absent
from drivers.recordings import segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter, SegmentMetadata
from drivers.recordings.table import PARTIAL_SUFFIX
from monitor.common.unexpected_errors import log_unexpected_error
from monitor.settings.loading import Storage

RETRY_S: Final = 5.0
"""Interval between two attempts to record after an error."""
MAX_QUEUE_BYTES: Final = 16_000_000
"""Capacity of the queue of one device in bytes, which is three minutes of samples at 1 kHz."""
TIME_RESOLUTION_NS: Final = 1000
"""Resolution of the Unix times in a recording, in nanoseconds."""
MAX_SAME_SAMPLE_NS: Final = 500_000_000
"""Maximum time difference between two rows of the same sample, in nanoseconds."""
SAMPLE_BYTES: Final = 80
"""Memory of one sample in the queue, in bytes."""
CHUNK_OVERHEAD_BYTES: Final = 100
"""Memory overhead of a queued chunk, in bytes."""
RAW_FOLDER: Final = "raw"
"""Name of the subfolder for raw bytes."""

Opening = Callable[[Path, SegmentMetadata], SegmentFileWriter]
"""Function that opens a new segment."""


@dataclass(frozen=True, slots=True)
class RecorderEvent:
    """Event about the recording of a device."""

    device: str
    kind: str  # recording_stopped | recording_back
    text: str


@dataclass(frozen=True, slots=True)
class _NewestRow:
    t_ns: int  # Unix
    tick: int = NO_TICK
    rate_hz: float | None = None


class RecordingTrack:
    """Recording of the samples or of the raw bytes of one device.

    Parameters
    ----------
    origin : SegmentMetadata
        Device and kind of the recording.
    storage : Storage
        Settings of the storage, with folder and segment length.
    opening : callable
        Function that opens a segment.
    events : deque of RecorderEvent
        Queue for the events of the recording.
    finished : deque of Path
        Queue for the paths of finished segments.
    """

    def __init__(
        self,
        origin: SegmentMetadata,
        storage: Storage,
        opening: Opening,
        events: deque[RecorderEvent],
        finished: deque[Path],
    ) -> None:
        self.origin = origin
        device_folder = storage.folder / origin.device
        self.folder = device_folder if origin.kind == "samples" else device_folder / RAW_FOLDER
        self.missed = 0
        """Number of rows that are missing in the recording."""
        self.trouble = ""
        """Reason why the recording has stopped, or ""."""
        self._segment_s = storage.segment_s
        self._opening = opening
        self._events = events
        self._finished = finished
        self._lock = threading.Lock()  # protects the queue
        self._queue: deque[SampleBlock | Chunk] = deque()  # with Unix times
        self._queue_bytes = 0
        self._dropped = 0  # rows that are missing before the oldest row in the queue
        self._taken: list[SampleBlock | Chunk] = []  # taken from the queue and being written
        self._writer: SegmentFileWriter | None = None
        self._begin_s = 0.0  # Unix time of the first row in the open segment
        self._number: int | None = None  # number of the newest segment, or None if it is unknown
        self._rows = 0  # rows or chunks in the open segment
        self._unsynced = False  # True if rows have been written since the last flush
        self._stopped_s = 0.0  # monotonic time of the last failure

    # --- queue

    @property
    def is_queue_filling_up(self) -> bool:
        """True if more than a quarter of the queue is in use."""
        return self._queue_bytes > MAX_QUEUE_BYTES // 4

    def queue_entries(self, entries: Sequence[SampleBlock | Chunk], count_dropped: bool) -> None:
        """Append entries to the queue, and drop the oldest entries if the queue is full.

        Parameters
        ----------
        entries : sequence of SampleBlock or Chunk
            Entries with Unix times.
        count_dropped : bool
            True if dropped rows count as missing in the recording.
        """
        with self._lock:
            self._queue.extend(entries)
            self._queue_bytes += sum(_size(one) for one in entries)
            while self._queue_bytes > MAX_QUEUE_BYTES and len(self._queue) > 1:
                dropped = self._queue.popleft()
                self._queue_bytes -= _size(dropped)
                if count_dropped:
                    rows, lost = (len(dropped), dropped.lost) if isinstance(dropped, SampleBlock) else (1, 0)
                    self._dropped += rows + lost
                    self.missed += rows

    def drop_rows_already_recorded_elsewhere(self) -> None:
        """Drop queued rows that another process has already recorded."""
        newest = self._find_newest_row()
        with self._lock:
            waiting = [*self._taken, *self._queue]
            if newest is not None:
                end_ns = _time_of(newest, waiting)
                waiting = [part for one in waiting for part in _rows_after(one, end_ns)]
                if waiting and isinstance(first := waiting[0], SampleBlock):
                    gap_s = (int(first.t_ns[0]) - end_ns) / 1e9
                    lost = max(round(gap_s * newest.rate_hz) - 1, 0) if newest.rate_hz else 0
                    waiting[0] = replace(first, lost=lost)
            self._taken, self._dropped = [], 0
            self._queue = deque(waiting)
            self._queue_bytes = sum(_size(one) for one in waiting)

    def _take_queue(self) -> None:
        """Move the queued rows to the list of rows to write, and mark dropped rows as missing."""
        with self._lock:
            self._taken = list(self._queue)
            self._queue.clear()
            self._queue_bytes = 0
            dropped, self._dropped = self._dropped, 0
        if self._taken and isinstance(first := self._taken[0], SampleBlock):
            self._taken[0] = replace(first, lost=first.lost + dropped)

    def _find_newest_row(self) -> _NewestRow | None:
        for path in reversed(segment_file.list_segments(self.folder)):
            with contextlib.suppress(RecordingError, ConfigError, OSError):  # invalid segments are skipped
                if self.origin.kind == "raw":
                    last = deque(segment_file.read_chunks(path), maxlen=1)
                    if last:
                        return _NewestRow(last[0].t_ns)
                elif (piece := segment_file.read_last_piece(path)) is not None:
                    rows = piece.samples
                    span_s = int(rows.t_ns[-1] - rows.t_ns[0]) / 1e9
                    rate_hz = piece.state.rate or ((len(rows) - 1) / span_s if span_s > 0.0 else None)
                    return _NewestRow(int(rows.t_ns[-1]), int(rows.ticks[-1]), rate_hz)
        return None

    # --- segment file

    def write_queued_rows(self, state: DaemonState, disk_problem: str) -> None:
        """Write the queued rows to the segment, or keep the rows for the next attempt after an error.

        Parameters
        ----------
        state : DaemonState
            State of the estimate that is recorded with the rows.
        disk_problem : str
            Message if the disk is too full, otherwise "".
        """
        if disk_problem:
            self._report_failure(disk_problem)
        if self.trouble and (disk_problem or time.monotonic() - self._stopped_s < RETRY_S):
            return
        if not self._taken:
            self._take_queue()
        if not self._taken:
            return
        try:
            self._append(state)
        except ConfigError as error:  # pyarrow is not installed
            self._report_failure(str(error))
        except OSError as error:
            self._report_failure(recording_stopped_text(self.folder, error))
            self.close_segment()
        else:
            self._taken = []
            if self.trouble:
                self.trouble = ""
                self.queue_continuation_event()

    def drop_rows_after_error(self, error: Exception) -> None:
        """Close the segment and drop the rows that could not be written, after an unexpected exception.

        Parameters
        ----------
        error : Exception
            Exception of ``write_queued_rows``, which would be raised again for the same rows.
        """
        self._report_failure(f"{self.folder}: {log_unexpected_error(f'recording of {self.origin.device}', error)}")
        self.missed += sum(len(one) if isinstance(one, SampleBlock) else 1 for one in self._taken)
        self._taken = []
        self.close_segment(pack=False)

    def sync_segment_to_disk(self) -> None:
        """Flush the open segment to the disk."""
        if self._writer is None or not self._unsynced:
            return
        self._unsynced = False
        try:
            self._writer.flush_to_disk()
        except OSError as error:
            self._report_failure(recording_stopped_text(self.folder, error))
            self.close_segment()

    def close_segment(self, pack: bool = True) -> None:
        """Close the open segment, and request its compression if ``pack`` is True."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
        except OSError as error:
            self._report_failure(recording_stopped_text(writer.path, error))
        if pack:
            self._finished.append(writer.path)

    def suspend_recording(self) -> None:
        """Close the open segment while another process may create segments in the folder."""
        self.close_segment(pack=False)
        self._number = None

    def close_if_file_changed(self) -> str:
        """Close the segment if another program has changed the file; return a message or ""."""
        writer = self._writer
        change = "" if writer is None else writer.describe_external_change()
        if writer is None or not change:
            return ""
        self._writer = None
        try:
            writer.close_changed_file()
        except OSError as error:
            change = f"{change} ({error.strerror or error})"
        known = segment_file.list_segments(self.folder)  # not compressed, because another program may use them
        self._number = max(self._number or 0, segment_file.parse_segment_number(known[-1]) if known else 0)
        note = f"{writer.path} {change} during recording, with {self._rows} rows in it; a new file is begun"
        self.queue_recorder_event("recording_stopped", note)
        self.queue_recorder_event("recording_back", "recording continues in a new file")
        return note

    def _append(self, state: DaemonState) -> None:
        """Append rows to the open segment, or to a new segment if the open segment has reached the full length."""
        begin_s = _time_s(self._taken[0])
        if self._writer is not None and begin_s - self._begin_s >= self._segment_s:
            self.close_segment()
        writer = self._writer or self._begin(begin_s)
        if self.origin.kind == "samples":
            blocks = [one for one in self._taken if isinstance(one, SampleBlock)]
            writer.write_samples(blocks, state)
            self._rows += sum(len(one) for one in blocks)
        else:
            writer.write_chunks([one for one in self._taken if isinstance(one, Chunk)])
            self._rows += len(self._taken)
        self._unsynced = True

    def _begin(self, begin_s: float) -> SegmentFileWriter:
        check_folder_or_absent(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._number is None:
            known = segment_file.list_segments(self.folder)
            self._number = segment_file.parse_segment_number(known[-1]) if known else 0
            self._finished.extend(known)
            for part in self.folder.glob(f"*{PARTIAL_SUFFIX}"):
                part.unlink()
        path = self.folder / segment_file.format_segment_name(self._number + 1, begin_s)
        self._writer = self._opening(path, self.origin)
        self._number += 1
        self._begin_s, self._rows = begin_s, 0
        return self._writer

    # --- events

    def queue_recorder_event(self, kind: str, text: str) -> None:
        """Queue an event of the device.

        Parameters
        ----------
        kind : str
            "recording_stopped" or "recording_back".
        text : str
            Message of the event.
        """
        self._events.append(RecorderEvent(self.origin.device, kind, text))

    def queue_continuation_event(self) -> None:
        """Queue an event that the recording continues."""
        self.queue_recorder_event("recording_back", f"recording continues; {self.missed} rows are missing in it")

    def _report_failure(self, reason: str) -> None:
        if not self.trouble:
            self.queue_recorder_event("recording_stopped", reason)
        self.trouble = reason
        self._stopped_s = time.monotonic()


def recording_stopped_text(path: Path, error: OSError) -> str:
    """Return a message that the recording has stopped because of a file system error.

    Parameters
    ----------
    path : Path
        File or folder of the error.
    error : OSError
        Error of the file system.
    """
    return f"{path}: {error.strerror or error}; recording stopped, trying again"


def _time_of(newest: _NewestRow, waiting: Sequence[SampleBlock | Chunk]) -> int:
    """Return the time of a recorded row on the clock of the queued rows, in Unix nanoseconds.

    Two processes assign different times to the same sample, so the sample is identified by the counter of the device.
    """
    for one in waiting if newest.tick != NO_TICK else ():
        if isinstance(one, SampleBlock):
            found = np.flatnonzero((one.ticks == newest.tick) & (np.abs(one.t_ns - newest.t_ns) < MAX_SAME_SAMPLE_NS))
            if found.size:
                return int(one.t_ns[found[-1]])
    return newest.t_ns


def _rows_after(one: SampleBlock | Chunk, t_ns: int) -> list[SampleBlock | Chunk]:
    """Return the rows that are later than a time, as a list of zero or one blocks."""
    if isinstance(one, Chunk):
        return [one] if one.t_ns > t_ns else []
    later = np.flatnonzero(one.t_ns > t_ns + TIME_RESOLUTION_NS)
    return [one[int(later[0]) :]] if later.size else []


def _size(one: SampleBlock | Chunk) -> int:
    if isinstance(one, SampleBlock):
        return SAMPLE_BYTES * len(one)
    return CHUNK_OVERHEAD_BYTES + len(one.data) + len(one.attachment)


def _time_s(one: SampleBlock | Chunk) -> float:
    return float(one.t_ns[0] if isinstance(one, SampleBlock) else one.t_ns) / 1e9
