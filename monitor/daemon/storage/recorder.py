"""Recorder of the daemon: writes the decoded samples of each device, and optionally its raw bytes, to segment files.

The reader threads put blocks and chunks into bounded queues. One thread appends them to segments twice a second, and
flushes the files to disk once a second. It begins a new segment when the present one has its full length, and packs
finished segments. It deletes the oldest segments by age, and while the disk is too full. A slow disk therefore delays
no sample. Samples that do not fit into the queue are counted, and leave a gap in the recording.

A full or read-only disk stops the recording, and an event reports it. The rest of the service continues. The recorder
tries again every few seconds. After a crash, the newest segment can be read up to its last complete batch
(``Recorder.tail``), so that the daemon resumes from there.

Only one process at a time records into a folder (``FolderLock``). While another process holds the lock, nothing is
written or deleted, and ``state`` names that process. When it ends, this process continues. Rows that the other process
has recorded are left out, and later rows are still in the queue. In every round the thread checks that its open file
still has its name and size. If another program has deleted, renamed, replaced or truncated the file, the recorder
begins a new one.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from drivers.driver import AxisMap
from drivers.errors import ConfigError, RecordingError
from drivers.file_access import check_folder
from drivers.recordings import segment
from drivers.recordings.segment import DaemonState, SegmentMetadata, SegmentPiece, SegmentWriter
from drivers.recordings.table import PARTIAL_SUFFIX
from drivers.sample import AXES, NO_TICK, Chunk, Ints, SampleBlock, make_block
from monitor.common.folder_lock import RECORDING_LOCK, FolderLock
from monitor.daemon.storage import retention
from monitor.settings.loading import Storage

WRITE_INTERVAL_S: Final = 0.5
"""Interval between two batches of a device: the most that a crash loses. A power failure loses up to SYNC_INTERVAL_S.
"""
SYNC_INTERVAL_S: Final = 1.0
"""Interval between two flushes of the files to disk."""
RETRY_S: Final = 5.0
"""Interval between two attempts to record after an error."""
DELETE_INTERVAL_S: Final = 30.0
"""Interval between two checks for segments to delete."""
MAX_PACKING_S: Final = 0.1
"""Longest time for packing in one round, so that batches are written in between."""
MAX_QUEUE_BYTES: Final = 16_000_000
"""Capacity of the queue of one device: three minutes of samples at 1 kHz."""
TIME_RESOLUTION_NS: Final = 1000
"""Upper bound of the resolution of Unix times in a recording."""
MAX_SAME_SAMPLE_NS: Final = 500_000_000
"""Two rows with the same counter value are the same sample, received by two processes, if their times differ by less.
"""
SAMPLE_BYTES: Final = 80
"""Memory that one sample occupies in a queue."""
CHUNK_OVERHEAD_BYTES: Final = 100
"""Memory that a chunk occupies in a queue, in addition to its bytes."""
RAW_FOLDER: Final = "raw"
"""Name of the folder for raw bytes, inside the folder of a device."""
FOLDER_IN_USE_ADVICE: Final = "end it, or choose another folder in [storage]"
"""Second half of the message about a folder that another process uses."""

Opening = Callable[[Path, SegmentMetadata], SegmentWriter]
"""Function that opens a new segment."""


@dataclass(frozen=True, slots=True)
class RecorderEvent:
    """Event in the recording of a device."""

    device: str
    kind: str  # recording_stopped | recording_back
    text: str


@dataclass(frozen=True, slots=True)
class RecordingTail:
    """End of an existing recording, from which the daemon resumes after a restart."""

    segment_origin: SegmentMetadata
    paths: tuple[Path, ...]  # oldest first
    newest: SegmentPiece

    def pieces(self, span_s: float) -> Iterator[SegmentPiece]:
        """Yield the last ``span_s`` seconds of the recording, oldest first, as far as the mounting is the same."""
        begin_ns = int(self.newest.samples.t_ns[-1]) - round(span_s * 1e9)
        for path in self._since(begin_ns):
            for piece in segment.read_samples(path):
                if piece.samples.t_ns[-1] >= begin_ns:
                    yield piece

    def _since(self, begin_ns: int) -> list[Path]:
        """Return the newest segments with the same axis mounting, back to the one that contains ``begin_ns``."""
        chosen: deque[Path] = deque()
        for path in reversed(self.paths):
            try:
                if segment.read_metadata(path).axes != self.segment_origin.axes:
                    break
                first = next(segment.read_samples(path), None)
            except (RecordingError, OSError):
                continue
            if first is None:
                continue
            chosen.appendleft(path)
            if first.samples.t_ns[0] <= begin_ns:
                break
        return list(chosen)


@dataclass(slots=True)
class _Track:
    """Recording of one kind for one device: its folder, open segment and queue."""

    origin: SegmentMetadata
    folder: Path
    writer: SegmentWriter | None = None
    began_s: float = 0.0  # Unix time of the open segment's first row
    number: int | None = None  # of the newest segment; None until the folder has been searched
    waiting: deque[SampleBlock | Chunk] = field(default_factory=deque)  # queue, with Unix times
    bytes: int = 0  # memory that the queue occupies
    held: list[SampleBlock | Chunk] = field(default_factory=list)  # taken from the queue and being written
    dropped: int = 0  # rows that were dropped before the oldest in the queue, missing samples included
    rows: int = 0  # rows or chunks in the open segment
    missed: int = 0  # rows that are not in the recording
    unsynced: bool = False  # True if rows were written since the last flush to disk
    trouble: str = ""  # reason why recording has stopped; empty while it works
    stopped_s: float = 0.0  # monotonic time of the last failure
    leaving: bool = False  # True if the device was removed: its queue is written, and then the track is deleted


@dataclass(frozen=True, slots=True)
class _Newest:
    """Newest row of a recording."""

    t_ns: int  # Unix
    tick: int = NO_TICK
    rate_hz: float | None = None


class Recorder:
    """Recorder of the samples and raw bytes of all devices.

    Parameters
    ----------
    storage : Storage
        Folder, limits of age and disk use, and segment length.
    origins : sequence of Origin
        Recordings to write, each with its device and kind, see ``segment.SegmentMetadata``.
    opening : callable, optional
        Opens a segment. Tests pass functions that simulate slow and broken disks.
    """

    def __init__(self, storage: Storage, origins: Sequence[SegmentMetadata], opening: Opening = SegmentWriter) -> None:
        self._storage = storage
        self._opening = opening
        self._tracks = {(one.device, one.kind): _Track(one, self.folder(one)) for one in origins}
        self._states: dict[str, DaemonState] = {}
        self._lock = threading.Lock()  # held only briefly, because reader threads wait for it
        self._events: deque[RecorderEvent] = deque(maxlen=1000)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._tidied_s = self._synced_s = -DELETE_INTERVAL_S
        self._packing: Iterator[None] | None = None
        self._to_pack: deque[Path] = deque()
        self._full = ""  # message if the disk is too full
        self._folder_lock = FolderLock(storage.folder, RECORDING_LOCK)
        self._lock_failure = ""  # message if the lock on the folder is not held
        self._lock_failed_s = 0.0  # monotonic time of the last attempt to take the lock
        self._other_process = False  # True if another process holds the lock
        self._note = ""  # message about the last change of a file by another program

    def add(self, origins: Sequence[SegmentMetadata]) -> None:
        """Start to record a further device."""
        with self._lock:
            self._tracks = {
                **self._tracks,
                **{(one.device, one.kind): _Track(one, self.folder(one)) for one in origins},
            }

    def remove(self, device: str) -> None:
        """Stop recording a device after its queue has been written. ``has`` returns False when that is done."""
        for track in self._tracks.values():
            track.leaving |= track.origin.device == device

    def is_recording(self, device: str) -> bool:
        """Return True while a device is recorded, or its queue is not written yet."""
        return any(name == device for name, _ in self._tracks)

    def folder(self, origin: SegmentMetadata) -> Path:
        """Return the folder for the segments of a recording."""
        own = self._storage.folder / origin.device
        return own if origin.kind == "samples" else own / RAW_FOLDER

    @property
    def state(self) -> str:
        """Status message: ``ok``, or a description of the problem."""
        if self._thread.ident is not None and not self._thread.is_alive() and not self._closing.is_set():
            return "recording ended by a fault of the program"
        if self._lock_failure:
            return self._lock_failure
        wrong = sorted({track.trouble for track in self._tracks.values() if track.trouble})
        if wrong:
            return wrong[0]
        missed = sum(track.missed for track in self._tracks.values())
        lacking = f"{missed} rows are not in the recording: the disk was too slow or full" if missed else ""
        but = "; ".join(filter(None, (self._note, self._folder_lock.warning, lacking)))
        return f"ok, but {but}" if but else "ok"

    @property
    def missed(self) -> int:
        """Number of samples and chunks that are missing in the recordings."""
        return sum(track.missed for track in self._tracks.values())

    def take_events(self) -> list[RecorderEvent]:
        """Return the events since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def start(self) -> None:
        """Start the writer thread."""
        self._thread.start()

    def close(self, timeout_s: float = 10.0) -> None:
        """Write the queues and close the files. If the disk hangs, return after ``timeout_s`` seconds."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    # --- called by the reader threads

    def samples(self, device: str, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Queue a block of samples for the recording.

        Parameters
        ----------
        device : str
            Name of the device.
        samples : SampleBlock
            Samples in SI units.
        offset_ns : array of int64, shape (n,), or int
            Offset that converts the times to Unix time, in nanoseconds.
        """
        track = self._tracks.get((device, "samples"))
        if track is None:
            return
        if not isinstance(offset_ns, int) or offset_ns:
            t_ns = samples.t_ns + offset_ns
            samples = make_block(t_ns, samples.values, samples.temperature_c, samples.ticks, samples.lost)
        self._enqueue(track, [samples])

    def chunks(self, device: str, chunks: Sequence[Chunk], offset_ns: int) -> None:
        """Queue received bytes for the recording.

        Parameters
        ----------
        device : str
            Name of the device.
        chunks : sequence of Chunk
            Bytes as received from the link.
        offset_ns : int
            Offset that converts the times to Unix time, in nanoseconds.
        """
        track = self._tracks.get((device, "raw"))
        if track is not None:
            self._enqueue(track, [replace(one, t_ns=one.t_ns + offset_ns) if offset_ns else one for one in chunks])

    def _enqueue(self, track: _Track, more: Sequence[SampleBlock | Chunk]) -> None:
        """Append to the queue of a track, and drop the oldest entries if it is full."""
        with self._lock:
            track.waiting.extend(more)
            track.bytes += sum(_size(one) for one in more)
            while track.bytes > MAX_QUEUE_BYTES and len(track.waiting) > 1:
                gone = track.waiting.popleft()
                track.bytes -= _size(gone)
                if self._other_process:  # another process records; missing rows are found after it has ended
                    continue
                rows = len(gone) if isinstance(gone, SampleBlock) else 1
                track.dropped += rows + (gone.lost if isinstance(gone, SampleBlock) else 0)
                track.missed += rows

    def set_state(self, device: str, state: DaemonState) -> None:
        """Set the state of the estimate that is recorded with the rows of a device from now on.

        Parameters
        ----------
        device : str
            Name of the device.
        state : State
            Rate, start of each axis, and values of the fit.
        """
        self._states[device] = state

    def is_queue_filling(self, device: str) -> bool:
        """Return True if a replayed recording should wait, because the queue of its device is filling up."""
        track = self._tracks.get((device, "samples"))
        return track is not None and not self._lock_failure and track.bytes > MAX_QUEUE_BYTES // 4

    # --- after a restart

    def tail(self, device: str) -> RecordingTail | None:
        """Return the end of a device's recording from before this start, or None if there is nothing to resume from.

        This method must be called before anything is written. Files that are not valid segments are skipped and left in
        place.
        """
        track = self._tracks.get((device, "samples"))
        if track is None:
            return None
        if self._thread.ident is None:
            self._acquire_folder()  # with the lock, no other process adds to the segments that are found now
        paths = segment.list_segments(track.folder)
        while paths:
            path = paths[-1]
            try:
                if segment.read_metadata(path).axes != track.origin.axes:
                    return None
                newest = segment.read_last_piece(path)
            except (RecordingError, ConfigError, OSError):
                newest = None
            if newest is not None:
                return RecordingTail(track.origin, tuple(paths), newest)
            paths.pop()
        return None

    # --- writer thread

    def _run(self) -> None:
        """Write, flush, delete and pack in rounds until the recorder is closed."""
        closing = False
        while not closing:
            held = self._acquire_folder()
            closing = self._closing.wait(WRITE_INTERVAL_S)
            for track in self._tracks.values():
                leaving = track.leaving  # read before the queue: nothing is added after it has been set
                if held:
                    self._end_if_changed(track)
                    self._write(track)
                if leaving:
                    self._remove_track(track)
            if held and not closing:
                self._sync()
                self._delete_old()
                self._pack()
        for track in self._tracks.values():
            self._end(track)
        self._folder_lock.release()

    def _acquire_folder(self) -> bool:
        """Take the lock on the folder, or check that it is still held; return False if nothing may be written."""
        if self._lock_failure and time.monotonic() - self._lock_failed_s < RETRY_S:
            return False
        try:
            holder = self._folder_lock.hold()
        except OSError as error:
            why = f"{self._storage.folder}: {error.strerror or error}; recording stopped, trying again"
        else:
            why = holder and f"{holder}; nothing is recorded here until it ends; {FOLDER_IN_USE_ADVICE}"
            self._other_process |= bool(holder)
        if why:
            self._suspend(why)
        elif self._lock_failure:
            self._resume()
        return not why

    def _suspend(self, why: str) -> None:
        """Close all files and write nothing until the lock is held again."""
        self._packing = None
        self._to_pack.clear()
        for track in self._tracks.values():
            self._end(track, pack=False)
            track.number = None  # another process may create segments in the meantime
            if not self._lock_failure:
                self._events.append(RecorderEvent(track.origin.device, "recording_stopped", why))
        self._lock_failure, self._lock_failed_s = why, time.monotonic()

    def _resume(self) -> None:
        """Continue to record, without the rows that another process has recorded in the meantime."""
        for track in self._tracks.values():
            if self._other_process:
                self._drop_recorded_rows(track)
            text = f"recording goes on; {track.missed} rows are missing in it"
            self._events.append(RecorderEvent(track.origin.device, "recording_back", text))
        self._lock_failure, self._other_process = "", False

    def _drop_recorded_rows(self, track: _Track) -> None:
        """Drop queued rows that are already in the folder; missing rows after these become a gap of the recording."""
        newest = _find_newest(track)
        with self._lock:
            waiting = [*track.held, *track.waiting]
            if newest is not None:
                end_ns = _time_of(newest, waiting)
                waiting = [part for one in waiting for part in _rows_after(one, end_ns)]
                if waiting and isinstance(first := waiting[0], SampleBlock):
                    gap_s = (int(first.t_ns[0]) - end_ns) / 1e9
                    lost = max(round(gap_s * newest.rate_hz) - 1, 0) if newest.rate_hz else 0
                    waiting[0] = replace(first, lost=lost)
            track.held, track.dropped = [], 0
            track.waiting = deque(waiting)
            track.bytes = sum(_size(one) for one in waiting)

    def _end_if_changed(self, track: _Track) -> None:
        """Close a file that another program has changed; the next row begins a new file."""
        change = "" if track.writer is None else track.writer.external_change()
        if not change:
            return
        writer, track.writer = track.writer, None
        assert writer is not None
        try:
            writer.abandon()
        except OSError as error:
            change = f"{change} ({error.strerror or error})"
        known = segment.list_segments(track.folder)  # files of another program may be among them, and are not packed
        track.number = max(track.number or 0, segment.segment_number(known[-1]) if known else 0)
        self._note = f"{writer.path} {change} while it was written, with {track.rows} rows in it; a new one is begun"
        self._events.append(RecorderEvent(track.origin.device, "recording_stopped", self._note))
        self._events.append(RecorderEvent(track.origin.device, "recording_back", "recording goes on in a new file"))

    def _remove_track(self, track: _Track) -> None:
        """Close the file of a removed device and delete its track."""
        self._end(track)
        with self._lock:
            self._tracks = {key: one for key, one in self._tracks.items() if one is not track}

    def _write(self, track: _Track) -> None:
        """Append the queue of a track to its segment. If that fails, the rows wait, as far as the queue has space."""
        if self._full:
            self._report_failure(track, self._full)
        if track.trouble and (self._full or time.monotonic() - track.stopped_s < RETRY_S):
            return
        if not track.held:
            self._take_queue(track)
        if not track.held:
            return
        try:
            self._append(track)
        except ConfigError as error:  # pyarrow is not installed
            self._report_failure(track, str(error))
        except OSError as error:
            self._report_failure(track, f"{track.folder}: {error.strerror or error}; recording stopped, trying again")
            self._end(track)
        else:
            track.held = []
            self._report_recovery(track)

    def _take_queue(self, track: _Track) -> None:
        """Take the queue of a track for writing; rows that were dropped before it become a gap of the recording."""
        with self._lock:
            track.held = list(track.waiting)
            track.waiting.clear()
            track.bytes = 0
            dropped, track.dropped = track.dropped, 0
        if track.held and isinstance(track.held[0], SampleBlock):
            track.held[0] = replace(track.held[0], lost=track.held[0].lost + dropped)

    def _append(self, track: _Track) -> None:
        """Append the taken rows to the open segment, and begin a new segment if the present one has its full length."""
        began_s = _time_s(track.held[0])
        if track.writer is not None and began_s - track.began_s >= self._storage.segment_s:
            self._end(track)
        if track.writer is None:
            self._begin(track, began_s)
        assert track.writer is not None
        if track.origin.kind == "samples":
            blocks = [one for one in track.held if isinstance(one, SampleBlock)]
            track.writer.write_samples(blocks, self._states.get(track.origin.device, DaemonState()))
            track.rows += sum(len(one) for one in blocks)
        else:
            track.writer.write_chunks([one for one in track.held if isinstance(one, Chunk)])
            track.rows += len(track.held)
        track.unsynced = True

    def _begin(self, track: _Track, began_s: float) -> None:
        """Open the next segment of a track."""
        check_folder(track.folder)
        track.folder.mkdir(parents=True, exist_ok=True)
        if track.number is None:
            known = segment.list_segments(track.folder)
            track.number = segment.segment_number(known[-1]) if known else 0
            self._to_pack.extend(known)
            for part in track.folder.glob(f"*{PARTIAL_SUFFIX}"):
                part.unlink()
        path = track.folder / segment.segment_name(track.number + 1, began_s)
        track.writer = self._opening(path, track.origin)
        track.number += 1
        track.began_s, track.rows = began_s, 0

    def _end(self, track: _Track, pack: bool = True) -> None:
        """Close the open segment of a track, and queue it for packing."""
        writer, track.writer = track.writer, None
        if writer is None:
            return
        try:
            writer.close()
        except OSError as error:
            self._report_failure(track, f"{writer.path}: {error.strerror or error}; recording stopped, trying again")
        if pack:
            self._to_pack.append(writer.path)

    def _sync(self) -> None:
        """Flush the open segments to disk once a second."""
        if time.monotonic() - self._synced_s < SYNC_INTERVAL_S - WRITE_INTERVAL_S / 2:
            return
        self._synced_s = time.monotonic()
        for track in self._tracks.values():
            if track.writer is None or not track.unsynced:
                continue
            track.unsynced = False
            try:
                track.writer.sync()
            except OSError as error:
                self._report_failure(
                    track, f"{track.folder}: {error.strerror or error}; recording stopped, trying again"
                )
                self._end(track)

    def _pack(self) -> None:
        """Pack finished segments for a short time."""
        until_s = time.monotonic() + MAX_PACKING_S
        while time.monotonic() < until_s and (self._packing is not None or self._to_pack):
            try:
                if self._packing is None:
                    self._packing = segment.compress_segment(self._to_pack.popleft())
                next(self._packing)
            except StopIteration:
                self._packing = None
            except (RecordingError, ConfigError, OSError):
                self._packing = None  # the segment stays unpacked: it is larger, but can still be read

    # --- deletion of old segments

    def _delete_old(self) -> None:
        """Delete segments that are too old, and the oldest segments while the disk is too full."""
        if time.monotonic() - self._tidied_s < (RETRY_S if self._full else DELETE_INTERVAL_S):
            return
        self._tidied_s = time.monotonic()
        folders = [track.folder for track in self._tracks.values()]
        try:
            retention.delete_old(folders, self._storage.keep_s, self._storage.segment_s)
            self._full = retention.delete_until_free(self._storage.folder, folders, self._storage.disk_share)
        except OSError as error:
            self._full = f"{self._storage.folder}: {error.strerror or error}; recording stopped, trying again"

    # --- errors

    def _report_failure(self, track: _Track, why: str) -> None:
        """Store the reason why the recording of a track has stopped, and queue an event if it had worked until now."""
        if not track.trouble:
            self._events.append(RecorderEvent(track.origin.device, "recording_stopped", why))
        track.trouble = why
        track.stopped_s = time.monotonic()

    def _report_recovery(self, track: _Track) -> None:
        """Queue an event if the recording of a track works again."""
        if track.trouble:
            track.trouble = ""
            text = f"recording goes on; {track.missed} rows are missing in it"
            self._events.append(RecorderEvent(track.origin.device, "recording_back", text))


def origin(
    device: str, axes: AxisMap, kind: segment.Kind = "samples", carrier: str = "", decoder: str = ""
) -> SegmentMetadata:
    """Return the description of a device's segments.

    Parameters
    ----------
    device : str
        Name of the device.
    axes : AxisMap
        Mounting of the sensor axes.
    kind : {"samples", "raw"}, optional
        Content of the segments.
    carrier, decoder : str, optional
        Carrier and decoder of the raw bytes.
    """
    measured = zip(axes.source, axes.sign, strict=True)
    mounting = " ".join(f"{'-' if sign < 0.0 else ''}{AXES[at]}" for at, sign in measured)
    return SegmentMetadata(device, kind, mounting, carrier, decoder)


def _find_newest(track: _Track) -> _Newest | None:
    """Return the newest row in the folder of a track; None if there is none."""
    for path in reversed(segment.list_segments(track.folder)):
        with contextlib.suppress(RecordingError, ConfigError, OSError):  # files that are no segments are skipped
            if track.origin.kind == "raw":
                last = deque(segment.read_chunks(path), maxlen=1)
                if last:
                    return _Newest(last[0].t_ns)
            elif (piece := segment.read_last_piece(path)) is not None:
                rows = piece.samples
                span_s = int(rows.t_ns[-1] - rows.t_ns[0]) / 1e9
                rate_hz = piece.state.rate or ((len(rows) - 1) / span_s if span_s > 0.0 else None)
                return _Newest(int(rows.t_ns[-1]), int(rows.ticks[-1]), rate_hz)
    return None


def _time_of(newest: _Newest, waiting: Sequence[SampleBlock | Chunk]) -> int:
    """Return the time of a recorded row on the clock of the queued rows, in Unix nanoseconds.

    Two processes give a sample times that differ by some ms. The device's counter identifies the sample. If no queued
    row has the same counter value, the recorded time is returned.
    """
    for one in waiting if newest.tick != NO_TICK else ():
        if isinstance(one, SampleBlock):
            found = np.flatnonzero((one.ticks == newest.tick) & (np.abs(one.t_ns - newest.t_ns) < MAX_SAME_SAMPLE_NS))
            if found.size:
                return int(one.t_ns[found[-1]])
    return newest.t_ns


def _rows_after(one: SampleBlock | Chunk, t_ns: int) -> list[SampleBlock | Chunk]:
    """Return the rows later than a time: a whole block, a part of it, or nothing."""
    if isinstance(one, Chunk):
        return [one] if one.t_ns > t_ns else []
    later = np.flatnonzero(one.t_ns > t_ns + TIME_RESOLUTION_NS)
    return [one[int(later[0]) :]] if later.size else []


def _size(one: SampleBlock | Chunk) -> int:
    """Return the memory that a block or chunk occupies in a queue, in bytes."""
    if isinstance(one, SampleBlock):
        return SAMPLE_BYTES * len(one)
    return CHUNK_OVERHEAD_BYTES + len(one.data) + len(one.attachment)


def _time_s(one: SampleBlock | Chunk) -> float:
    """Return the time of the first row of a block or chunk, in Unix seconds."""
    return float(one.t_ns[0] if isinstance(one, SampleBlock) else one.t_ns) / 1e9
