"""Recorder of the daemon: writes the samples of each device, and optionally the raw bytes, to segment files.

The reader threads put blocks and chunks into bounded queues (``RecordingTrack``). The recorder thread writes the queued
data to segment files twice a second, compresses finished segments, and deletes old segments. A slow disk does not delay
samples.

If a write fails, an event reports the reason, the service continues, and the recorder tries again every few seconds.
After a crash, the newest segment can be read up to the last complete batch.

Only one process at a time records into a folder (``FolderLock``). If another program deletes, renames, replaces or
truncates the open segment, the recorder begins a new file.
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
from drivers.recordings import segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter, SegmentMetadata
from monitor.common.folder_lock import RECORDING_LOCK, FolderLock
from monitor.common.unexpected_errors import RestartedThread
from monitor.daemon.storage import retention
from monitor.daemon.storage.last_recorded_samples import LastRecordedSamples, read_last_recorded_samples
from monitor.daemon.storage.recording_track import (
    RETRY_S,
    Opening,
    RecorderEvent,
    RecordingTrack,
    recording_stopped_text,
)
from monitor.settings.loading import Storage

WRITE_INTERVAL_S: Final = 0.5
"""Interval between two writes. A crash of the program loses at most the samples of one interval."""
SYNC_INTERVAL_S: Final = 1.0
"""Interval between two flushes of the segments to the disk."""
DELETE_INTERVAL_S: Final = 30.0
"""Interval between two deletions of old segments."""
MAX_PACKING_S: Final = 0.1
"""Maximum time for compression in one round."""
FOLDER_IN_USE_ADVICE: Final = "end it, or choose another folder in [storage]"
"""Advice to the user if another process uses the folder."""


class Recorder:
    """Recorder of the samples and raw bytes of all devices.

    Parameters
    ----------
    storage : Storage
        Settings of the storage.
    origins : sequence of SegmentMetadata
        Metadata of the recordings to write.
    opening : callable, optional
        Function that opens a segment.
    owner_pid : int, optional
        Process id of the daemon, whose processes record into one folder. By default, that of this process.
    """

    def __init__(
        self,
        storage: Storage,
        origins: Sequence[SegmentMetadata],
        opening: Opening = SegmentFileWriter,
        owner_pid: int | None = None,
    ) -> None:
        self._storage = storage
        self._opening = opening
        self._events: deque[RecorderEvent] = deque(maxlen=1000)
        # replaced as a whole, because several threads iterate over the dictionary
        self._tracks: dict[tuple[str, str], RecordingTrack] = {}
        self._leaving: tuple[RecordingTrack, ...] = ()  # recordings of removed devices, which end in the next round
        self._lock = threading.Lock()  # protects the replacement of ``_tracks`` and ``_leaving``
        self._states: dict[str, DaemonState] = {}
        self._closing = threading.Event()
        self._thread = RestartedThread(self._run, "recorder", self._closing)
        self._delete_checked_s = self._synced_s = -DELETE_INTERVAL_S
        self._packing: Iterator[None] | None = None
        self._finished: deque[Path] = deque()  # segments to compress
        self._disk_full = ""  # message if the disk is too full
        self._folder_lock = FolderLock(storage.folder, RECORDING_LOCK, owner_pid)
        self._lock_failure = ""  # message if the lock on the folder is not held
        self._lock_failed_s = 0.0  # monotonic time of the last attempt to take the lock
        self._other_process = False  # True if another process holds the lock on the folder
        self._note = ""  # message about the last change of a file by another program
        self.start_recordings(origins)

    def start_recordings(self, origins: Sequence[SegmentMetadata]) -> None:
        """Start additional recordings."""
        more = [RecordingTrack(one, self._storage, self._opening, self._events, self._finished) for one in origins]
        with self._lock:
            self._tracks = {**self._tracks, **{(track.origin.device, track.origin.kind): track for track in more}}

    def remove_device(self, device: str) -> None:
        """Stop the recording of a device as soon as the queue has been written."""
        with self._lock:
            self._leaving += tuple(track for (name, _), track in self._tracks.items() if name == device)
            self._tracks = {key: track for key, track in self._tracks.items() if key[0] != device}

    def is_recording(self, device: str) -> bool:
        """Return True while a device is recorded or the queue of the device is not empty."""
        return any(track.origin.device == device for track in (*self._tracks.values(), *self._leaving))

    @property
    def state(self) -> str:
        """Status message: ``ok``, or a description of the problem."""
        if self._thread.failure or self._lock_failure:
            return self._thread.failure or self._lock_failure
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
        """Number of samples and chunks that are missing in all recordings."""
        return sum(track.missed for track in self._tracks.values())

    def take_events(self) -> list[RecorderEvent]:
        """Return the events of all recordings since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def start(self) -> None:
        """Start the recorder thread."""
        self._thread.start()

    def close(self, timeout_s: float = 10.0) -> None:
        """Write the queued data and close the files, within ``timeout_s`` seconds."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def find_last_recorded_samples(self, device: str) -> LastRecordedSamples | None:
        """Return the end of the existing recording of a device, or None if there is no recording to continue.

        Call this method before the recorder is started.
        """
        track = self._tracks.get((device, "samples"))
        if track is None:
            return None
        if self._thread.ident is None:
            self._acquire_folder()  # the lock prevents another process from adding segments
        return read_last_recorded_samples(track.origin, track.folder)

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
            Offset that converts the times of the samples to Unix time, in nanoseconds.
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
            Received bytes with monotonic times.
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
            State of the estimate.
        """
        self._states[device] = state

    def is_queue_filling(self, device: str) -> bool:
        """Return True if the queue of a device is filling up, so that a replayed recording must wait."""
        track = self._tracks.get((device, "samples"))
        return track is not None and not self._lock_failure and track.is_queue_filling_up

    # --- writer thread

    def _run(self) -> None:
        closing = False
        while not closing:
            locked = self._acquire_folder()
            closing = self._closing.wait(WRITE_INTERVAL_S)
            leaving = self._leaving
            for track in (*self._tracks.values(), *leaving):
                if locked:
                    try:
                        self._note = track.close_if_file_changed() or self._note
                        track.write_queued_rows(self._states.get(track.origin.device, DaemonState()), self._disk_full)
                    except Exception as error:  # noqa: BLE001 - the status of the recording shows the error
                        track.drop_rows_after_error(error)
            for track in leaving:
                track.close_segment()
            with self._lock:
                self._leaving = self._leaving[len(leaving) :]
            if locked and not closing:
                self._sync()
                self._delete_old()
                self._pack()
        for track in self._tracks.values():
            track.close_segment()
        self._folder_lock.release()

    def _acquire_folder(self) -> bool:
        """Acquire or check the lock on the folder; return False if the lock is not held."""
        if self._lock_failure and time.monotonic() - self._lock_failed_s < RETRY_S:
            return False
        try:
            holder = self._folder_lock.ensure_held()
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
        self._packing = None
        self._finished.clear()
        for track in self._tracks.values():
            track.suspend_recording()
            if not self._lock_failure:
                track.queue_recorder_event("recording_stopped", reason)
        self._lock_failure, self._lock_failed_s = reason, time.monotonic()

    def _resume(self) -> None:
        for track in self._tracks.values():
            if self._other_process:
                track.drop_rows_already_recorded_elsewhere()
            track.queue_continuation_event()
        self._lock_failure, self._other_process = "", False

    def _sync(self) -> None:
        if time.monotonic() - self._synced_s >= SYNC_INTERVAL_S - WRITE_INTERVAL_S / 2:
            self._synced_s = time.monotonic()
            for track in self._tracks.values():
                track.sync_segment_to_disk()

    def _pack(self) -> None:
        until_s = time.monotonic() + MAX_PACKING_S
        while time.monotonic() < until_s and (self._packing is not None or self._finished):
            try:
                if self._packing is None:
                    self._packing = segment_file.compress_segment_stepwise(self._finished.popleft())
                next(self._packing)
            except StopIteration:
                self._packing = None
            except (RecordingError, ConfigError, OSError):
                self._packing = None  # an uncompressed segment can still be read

    def _delete_old(self) -> None:
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
    device: str, axes: AxisMap, kind: segment_file.Kind = "samples", carrier: str = "", decoder: str = ""
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
