"""Recorder of the daemon: writes the decoded samples of each device, and optionally its raw bytes, to segment files.

The reader threads put blocks and chunks into bounded queues (``RecordingTrack``). The recorder thread writes the queues
to segment files twice a second, and flushes the files to disk once a second. The recorder thread also packs finished
segments, and deletes segments that are too old or overfill the disk. A slow disk delays no sample.

A full or read-only disk stops the recording, and an event reports the reason. The rest of the service continues. The
recorder tries again every few seconds. After a crash, the newest segment can be read up to the last complete batch
(``Recorder.find_recording_tail``), so the daemon can continue from the end of the recording.

Only one process at a time records into a folder (``FolderLock``). While another process holds the lock, this process
does not write or delete, and ``state`` names the other process. When the other process ends, this process continues
with the rows that are not recorded yet. In every round, the recorder thread checks the name and the size of the open
file. If another program has deleted, renamed, replaced or truncated the file, the recorder begins a new file.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from drivers.data_types import AXES, Chunk, Ints, SampleBlock, make_block
from drivers.driver import AxisMap
from drivers.errors import ConfigError, RecordingError
from drivers.recordings import segment_file as segment
from drivers.recordings.segment_file import DaemonState, SegmentMetadata, SingleSegmentWriter
from monitor.common.folder_lock import RECORDING_LOCK, FolderLock
from monitor.daemon.storage import retention
from monitor.daemon.storage.device_recording import (
    RETRY_S,
    Opening,
    RecorderEvent,
    RecordingTrack,
    recording_stopped_text,
)
from monitor.daemon.storage.recording_tail import RecordingTail, read_recording_tail
from monitor.settings.loading import Storage

WRITE_INTERVAL_S: Final = 0.5
"""Interval between two batches. A crash loses at most this time, a power failure at most SYNC_INTERVAL_S."""
SYNC_INTERVAL_S: Final = 1.0
"""Interval between two flushes of the files to disk."""
DELETE_INTERVAL_S: Final = 30.0
"""Interval between two checks for segments to delete."""
MAX_PACKING_S: Final = 0.1
"""Longest time for packing in one round, so that batches are written in time."""
FOLDER_IN_USE_ADVICE: Final = "end it, or choose another folder in [storage]"
"""Advice in the message about a folder that another process uses."""


class Recorder:
    """Recorder of the samples and raw bytes of all devices.

    Parameters
    ----------
    storage : Storage
        Folder, segment length, and limits of age and disk use.
    origins : sequence of SegmentMetadata
        Recordings to write, each with its device and kind.
    opening : callable, optional
        Opens a segment. Tests simulate slow and broken disks with this function.
    """

    def __init__(
        self, storage: Storage, origins: Sequence[SegmentMetadata], opening: Opening = SingleSegmentWriter
    ) -> None:
        self._storage = storage
        self._opening = opening
        self._events: deque[RecorderEvent] = deque(maxlen=1000)
        # several threads iterate over the dictionary, so it is replaced and never changed in place
        self._tracks: dict[tuple[str, str], RecordingTrack] = {}
        self._lock = threading.Lock()  # protects the replacement of the dictionary
        self._states: dict[str, DaemonState] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._delete_checked_s = self._synced_s = -DELETE_INTERVAL_S
        self._packing: Iterator[None] | None = None
        self._finished: deque[Path] = deque()  # segments that are to be packed
        self._disk_full = ""  # message if the disk is too full
        self._folder_lock = FolderLock(storage.folder, RECORDING_LOCK)
        self._lock_failure = ""  # message if the lock on the folder is not held
        self._lock_failed_s = 0.0  # monotonic time of the last attempt to take the lock
        self._other_process = False  # True if another process holds the lock
        self._note = ""  # message about the last change of a file by another program
        self.add_recordings(origins)

    def add_recordings(self, origins: Sequence[SegmentMetadata]) -> None:
        """Start to record further devices."""
        more = [RecordingTrack(one, self._storage, self._opening, self._events, self._finished) for one in origins]
        with self._lock:
            self._tracks = {**self._tracks, **{(track.origin.device, track.origin.kind): track for track in more}}

    def remove_device(self, device: str) -> None:
        """Stop to record a device as soon as its queue has been written. ``is_recording`` then returns False."""
        for track in self._tracks.values():
            track.leaving |= track.origin.device == device

    def is_recording(self, device: str) -> bool:
        """Return True while a device is recorded or its queue is not yet written."""
        return any(name == device for name, _ in self._tracks)

    @property
    def state(self) -> str:
        """Status message: ``ok``, or a description of the problem."""
        if self._thread.ident is not None and not self._thread.is_alive() and not self._closing.is_set():
            return "the recording ended because of an error in the program"
        if self._lock_failure:
            return self._lock_failure
        troubles = sorted({track.trouble for track in self._tracks.values() if track.trouble})
        if troubles:
            return troubles[0]
        missed = (
            f"{self.missed_rows} rows are not in the recording: the disk was too slow or full"
            if self.missed_rows
            else ""
        )
        warnings = "; ".join(filter(None, (self._note, self._folder_lock.warning, missed)))
        return f"ok, but {warnings}" if warnings else "ok"

    @property
    def missed_rows(self) -> int:
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

    def find_recording_tail(self, device: str) -> RecordingTail | None:
        """Return the end of the existing recording of a device, or None if there is no recording to continue.

        This method must be called before new rows are written.
        """
        track = self._tracks.get((device, "samples"))
        if track is None:
            return None
        if self._thread.ident is None:
            self._acquire_folder()  # the lock prevents that another process adds segments
        return read_recording_tail(track.origin, track.folder)

    # --- called by the reader threads

    def queue_samples(self, device: str, samples: SampleBlock, offset_ns: Ints | int) -> None:
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
        track.queue_entries([samples], not self._other_process)

    def queue_chunks(self, device: str, chunks: Sequence[Chunk], offset_ns: int) -> None:
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
            moved = [replace(one, t_ns=one.t_ns + offset_ns) if offset_ns else one for one in chunks]
            track.queue_entries(moved, not self._other_process)

    def set_estimate_state(self, device: str, state: DaemonState) -> None:
        """Set the state of the estimate that is recorded with the next rows of a device.

        Parameters
        ----------
        device : str
            Name of the device.
        state : DaemonState
            Rate, start of each axis, and values of the fit.
        """
        self._states[device] = state

    def is_queue_filling(self, device: str) -> bool:
        """Return True if a replayed recording should wait, because the queue of the device is filling up."""
        track = self._tracks.get((device, "samples"))
        return track is not None and not self._lock_failure and track.is_queue_filling_up

    # --- writer thread

    def _run(self) -> None:
        """Write, flush, delete and pack in rounds until the recorder is closed."""
        closing = False
        while not closing:
            locked = self._acquire_folder()
            closing = self._closing.wait(WRITE_INTERVAL_S)
            for key, track in self._tracks.items():
                leaving = track.leaving  # read before the queue, which receives no rows after ``leaving`` is set
                if locked:
                    self._note = track.close_if_file_changed() or self._note
                    track.write_queued_rows(self._states.get(track.origin.device, DaemonState()), self._disk_full)
                if leaving:
                    self._remove_track(key)
            if locked and not closing:
                self._sync()
                self._delete_old()
                self._pack()
        for track in self._tracks.values():
            track.close_segment()
        self._folder_lock.release()

    def _remove_track(self, key: tuple[str, str]) -> None:
        """Close the file of a removed device and delete its track."""
        self._tracks[key].close_segment()
        with self._lock:
            self._tracks = {other: track for other, track in self._tracks.items() if other != key}

    def _acquire_folder(self) -> bool:
        """Take the lock on the folder, or check that the lock is still held; return False without the lock."""
        if self._lock_failure and time.monotonic() - self._lock_failed_s < RETRY_S:
            return False
        try:
            holder = self._folder_lock.hold()
        except OSError as error:
            reason = recording_stopped_text(self._storage.folder, error)
        else:
            reason = holder and f"{holder}; nothing is recorded here until it ends; {FOLDER_IN_USE_ADVICE}"
            self._other_process |= bool(holder)
        if reason:
            self._suspend(reason)
        elif self._lock_failure:
            self._resume()
        return not reason

    def _suspend(self, reason: str) -> None:
        """Close all files until the lock is held again."""
        self._packing = None
        self._finished.clear()
        for track in self._tracks.values():
            track.suspend_recording()
            if not self._lock_failure:
                track.queue_event("recording_stopped", reason)
        self._lock_failure, self._lock_failed_s = reason, time.monotonic()

    def _resume(self) -> None:
        """Continue to record, without the rows that another process has recorded."""
        for track in self._tracks.values():
            if self._other_process:
                track.drop_rows_recorded_elsewhere()
            track.report_continuation()
        self._lock_failure, self._other_process = "", False

    def _sync(self) -> None:
        """Flush the open segments to disk once a second."""
        if time.monotonic() - self._synced_s >= SYNC_INTERVAL_S - WRITE_INTERVAL_S / 2:
            self._synced_s = time.monotonic()
            for track in self._tracks.values():
                track.sync_segment_to_disk()

    def _pack(self) -> None:
        """Pack finished segments for a short time."""
        until_s = time.monotonic() + MAX_PACKING_S
        while time.monotonic() < until_s and (self._packing is not None or self._finished):
            try:
                if self._packing is None:
                    self._packing = segment.compress_segment(self._finished.popleft())
                next(self._packing)
            except StopIteration:
                self._packing = None
            except (RecordingError, ConfigError, OSError):
                self._packing = None  # an unpacked segment is larger, but can be read

    def _delete_old(self) -> None:
        """Delete segments that are too old. If the disk is too full, delete the oldest segments."""
        if time.monotonic() - self._delete_checked_s < (RETRY_S if self._disk_full else DELETE_INTERVAL_S):
            return
        self._delete_checked_s = time.monotonic()
        folders = [track.folder for track in self._tracks.values()]
        try:
            retention.delete_old_segments(folders, self._storage.keep_s, self._storage.segment_s)
            self._disk_full = retention.delete_until_free(self._storage.folder, folders, self._storage.disk_share)
        except OSError as error:
            self._disk_full = recording_stopped_text(self._storage.folder, error)


def segment_metadata(
    device: str, axes: AxisMap, kind: segment.Kind = "samples", carrier: str = "", decoder: str = ""
) -> SegmentMetadata:
    """Return the metadata of the segments of a device.

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
