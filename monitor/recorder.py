"""The daemon's own recordings: samples as received and decoded, and the bytes they came in where that is wanted.

Readers' threads hand over blocks and chunks, which wait in bounded queues; one thread appends them to segments twice a
second and has the disk keep them once a second, begins a new segment when one is as long as it may be, packs those that
have ended, and deletes the oldest by age and while the disk is fuller than it may be. So a slow disk delays no sample;
what does not fit a queue is counted and becomes a hole of the recording.

A disk that is full or read-only stops the recording, with an event; everything else goes on, and recording is tried
again every few seconds. After a crash the newest segment is read up to its last whole batch (``Recorder.tail``), so
that the daemon goes on from there.

One process at a time records into a folder (``FolderLock``). While another one does, nothing is written or deleted, and
``state`` says which process it is. When that process ends this one goes on: rows that the other has recorded are left
out, and the rows between the two are still in the queue. In every round the thread checks that the file that it writes
still has its name and its size. A file that was deleted, renamed, replaced or cut ends there, and a new one is begun.
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
from drivers.recording import segment
from drivers.recording.segment import Origin, Piece, SegmentWriter, State
from drivers.recording.table import PART
from drivers.sample import AXES, NO_TICK, Chunk, Ints, SampleBlock, block
from drivers.small_file import check_folder
from monitor import retention
from monitor.folder_lock import RECORDING_LOCK, FolderLock
from monitor.settings import Storage

WRITE_S: Final = 0.5
"""Between two batches of a device: a crash costs no more than this, a power cut no more than SYNC_S."""
SYNC_S: Final = 1.0
RETRY_S: Final = 5.0
TIDY_S: Final = 30.0
PACKING_S: Final = 0.1
"""Of packing in one round, between which batches are written."""
QUEUE_BYTES: Final = 16_000_000
"""Of one device, that wait for the disk: three minutes at 1 kHz."""
RESOLUTION_NS: Final = 1000
"""Of Unix times in a recording, a little more than it is."""
SAME_NS: Final = 500_000_000
"""Two rows with the same count that are no further apart are the same sample, as two processes received it."""
SAMPLE_BYTES: Final = 80
CHUNK_BYTES: Final = 100
"""What a chunk takes beside its bytes."""
RAW: Final = "raw"
ADVICE: Final = "end it, or choose another folder in [storage]"

Opening = Callable[[Path, Origin], SegmentWriter]


@dataclass(frozen=True, slots=True)
class Told:
    """Something that happened to the recording of a device."""

    device: str
    kind: str  # recording_stopped | recording_back
    text: str


@dataclass(frozen=True, slots=True)
class Tail:
    """The end of a recording, to go on from."""

    origin: Origin
    paths: tuple[Path, ...]  # oldest first
    newest: Piece

    def pieces(self, span_s: float) -> Iterator[Piece]:
        """The last ``span_s``, oldest first; nothing of another mounting."""
        begin_ns = int(self.newest.samples.t_ns[-1]) - round(span_s * 1e9)
        for path in self._since(begin_ns):
            for piece in segment.read_samples(path):
                if piece.samples.t_ns[-1] >= begin_ns:
                    yield piece

    def _since(self, begin_ns: int) -> list[Path]:
        chosen: deque[Path] = deque()
        for path in reversed(self.paths):
            try:
                if segment.origin(path).axes != self.origin.axes:
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
    """One folder of segments: the samples of a device, or its raw bytes."""

    origin: Origin
    folder: Path
    writer: SegmentWriter | None = None
    began_s: float = 0.0  # Unix time of the open segment's first row
    number: int | None = None  # of the newest segment; None: not looked for yet
    waiting: deque[SampleBlock | Chunk] = field(default_factory=deque)  # Unix times
    bytes: int = 0  # that wait
    held: list[SampleBlock | Chunk] = field(default_factory=list)  # being written
    dropped: int = 0  # rows before the oldest that waits, missing ones included
    rows: int = 0  # rows or chunks in the open segment
    missed: int = 0  # rows that are not in the recording
    unsynced: bool = False
    trouble: str = ""
    stopped_s: float = 0.0
    leaving: bool = False  # the device is no more: what waits is written, and that is all


@dataclass(frozen=True, slots=True)
class _Newest:
    """The newest row of a recording."""

    t_ns: int  # Unix
    tick: int = NO_TICK
    rate_hz: float | None = None


class Recorder:
    """Writes what all devices bring.

    Args:
        storage: where, and how long it is kept
        origins: what is recorded: device and kind, see ``segment.Origin``
        opening: begins a segment; tests give slow and broken disks
    """

    def __init__(self, storage: Storage, origins: Sequence[Origin], opening: Opening = SegmentWriter) -> None:
        self._storage = storage
        self._opening = opening
        self._tracks = {(one.device, one.kind): _Track(one, self.folder(one)) for one in origins}
        self._states: dict[str, State] = {}
        self._lock = threading.Lock()  # held for moments: readers' threads wait for it
        self._told: deque[Told] = deque(maxlen=1000)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._tidied_s = self._synced_s = -TIDY_S
        self._packing: Iterator[None] | None = None
        self._to_pack: deque[Path] = deque()
        self._full = ""  # why the disk takes no more
        self._folder_lock = FolderLock(storage.folder, RECORDING_LOCK)
        self._excluded = ""  # why nothing is recorded in the folder at all
        self._excluded_s = 0.0
        self._other = False  # because another process records there
        self._note = ""  # the newest thing that happened to a file

    def add(self, origins: Sequence[Origin]) -> None:
        """Record another device too."""
        with self._lock:
            self._tracks = {
                **self._tracks,
                **{(one.device, one.kind): _Track(one, self.folder(one)) for one in origins},
            }

    def remove(self, device: str) -> None:
        """Record a device no more, once what waits of it is written; ``has`` tells when."""
        for track in self._tracks.values():
            track.leaving |= track.origin.device == device

    def has(self, device: str) -> bool:
        """Whether something of the device is recorded, or waits to be."""
        return any(name == device for name, _ in self._tracks)

    def folder(self, origin: Origin) -> Path:
        """Where the segments of a device are."""
        own = self._storage.folder / origin.device
        return own if origin.kind == "samples" else own / RAW

    @property
    def state(self) -> str:
        """``ok``, or what is wrong: for the status."""
        if self._thread.ident is not None and not self._thread.is_alive() and not self._closing.is_set():
            return "recording ended by a fault of the program"
        if self._excluded:
            return self._excluded
        wrong = sorted({track.trouble for track in self._tracks.values() if track.trouble})
        if wrong:
            return wrong[0]
        missed = sum(track.missed for track in self._tracks.values())
        lacking = f"{missed} rows are not in the recording: the disk was too slow or full" if missed else ""
        but = "; ".join(filter(None, (self._note, self._folder_lock.warning, lacking)))
        return f"ok, but {but}" if but else "ok"

    @property
    def missed(self) -> int:
        """Samples and chunks that are not in the recording."""
        return sum(track.missed for track in self._tracks.values())

    def take(self) -> list[Told]:
        """What happened since the last call."""
        return [self._told.popleft() for _ in range(len(self._told))]

    def start(self) -> None:
        """Start writing."""
        self._thread.start()

    def close(self, timeout_s: float = 10.0) -> None:
        """Write what waits and end the files; a disk that hangs is waited for no longer than ``timeout_s``."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    # --- from the readers' threads

    def samples(self, device: str, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """A block; ``offset_ns`` [n] makes its times Unix time."""
        track = self._tracks.get((device, "samples"))
        if track is None:
            return
        if not isinstance(offset_ns, int) or offset_ns:
            t_ns = samples.t_ns + offset_ns
            samples = block(t_ns, samples.values, samples.temperature_c, samples.ticks, samples.lost)
        self._wait(track, [samples])

    def chunks(self, device: str, chunks: Sequence[Chunk], offset_ns: int) -> None:
        """Bytes as they came; ``offset_ns`` makes their times Unix time."""
        track = self._tracks.get((device, "raw"))
        if track is not None:
            self._wait(track, [replace(one, t_ns=one.t_ns + offset_ns) if offset_ns else one for one in chunks])

    def _wait(self, track: _Track, more: Sequence[SampleBlock | Chunk]) -> None:
        """Queue, and drop the oldest where there is no room."""
        with self._lock:
            track.waiting.extend(more)
            track.bytes += sum(_size(one) for one in more)
            while track.bytes > QUEUE_BYTES and len(track.waiting) > 1:
                gone = track.waiting.popleft()
                track.bytes -= _size(gone)
                if self._other:  # another process records: what is missing is found once that has ended
                    continue
                rows = len(gone) if isinstance(gone, SampleBlock) else 1
                track.dropped += rows + (gone.lost if isinstance(gone, SampleBlock) else 0)
                track.missed += rows

    def know(self, device: str, state: State) -> None:
        """What is written with the rows from now on."""
        self._states[device] = state

    def full(self, device: str) -> bool:
        """Whether a recording that is replayed had better wait."""
        track = self._tracks.get((device, "samples"))
        return track is not None and not self._excluded and track.bytes > QUEUE_BYTES // 4

    # --- after a restart

    def tail(self, device: str) -> Tail | None:
        """What was recorded of a device before this start; None where there is nothing to go on from.

        To be called before anything is written. What is no segment is passed over and stays for people to look at.
        """
        track = self._tracks.get((device, "samples"))
        if track is None:
            return None
        if self._thread.ident is None:
            self._hold_folder()  # from here on nobody else adds to what is found now
        paths = segment.segments(track.folder)
        while paths:
            path = paths[-1]
            try:
                if segment.origin(path).axes != track.origin.axes:
                    return None
                newest = segment.newest(path)
            except (RecordingError, ConfigError, OSError):
                newest = None
            if newest is not None:
                return Tail(track.origin, tuple(paths), newest)
            paths.pop()
        return None

    # --- the thread

    def _run(self) -> None:
        closing = False
        while not closing:
            held = self._hold_folder()
            closing = self._closing.wait(WRITE_S)
            for track in self._tracks.values():
                leaving = track.leaving  # before what waits is looked at: nothing comes after it
                if held:
                    self._check(track)
                    self._write(track)
                if leaving:
                    self._leave(track)
            if held and not closing:
                self._sync()
                self._tidy()
                self._pack()
        for track in self._tracks.values():
            self._end(track)
        self._folder_lock.release()

    def _hold_folder(self) -> bool:
        """Take the lock on the folder, or check that it is still held; False while nothing is to be written."""
        if self._excluded and time.monotonic() - self._excluded_s < RETRY_S:
            return False
        try:
            holder = self._folder_lock.hold()
        except OSError as error:
            why = f"{self._storage.folder}: {error.strerror or error}; recording stopped, trying again"
        else:
            why = holder and f"{holder}; nothing is recorded here until it ends; {ADVICE}"
            self._other |= bool(holder)
        if why:
            self._exclude(why)
        elif self._excluded:
            self._include()
        return not why

    def _exclude(self, why: str) -> None:
        """Write nothing, and begin a new file when that is over."""
        self._packing = None
        self._to_pack.clear()
        for track in self._tracks.values():
            self._end(track, pack=False)
            track.number = None  # somebody else may number files meanwhile
            if not self._excluded:
                self._told.append(Told(track.origin.device, "recording_stopped", why))
        self._excluded, self._excluded_s = why, time.monotonic()

    def _include(self) -> None:
        """Go on, without the rows that another process has recorded meanwhile."""
        for track in self._tracks.values():
            if self._other:
                self._leave_out_recorded(track)
            text = f"recording goes on; {track.missed} rows are missing in it"
            self._told.append(Told(track.origin.device, "recording_back", text))
        self._excluded, self._other = "", False

    def _leave_out_recorded(self, track: _Track) -> None:
        """Drop rows up to the newest that is in the folder; rows that are missing after it are a hole."""
        newest = _newest_in(track)
        with self._lock:
            waiting = [*track.held, *track.waiting]
            if newest is not None:
                end_ns = _time_of(newest, waiting)
                waiting = [part for one in waiting for part in _after(one, end_ns)]
                if waiting and isinstance(first := waiting[0], SampleBlock):
                    gap_s = (int(first.t_ns[0]) - end_ns) / 1e9
                    lost = max(round(gap_s * newest.rate_hz) - 1, 0) if newest.rate_hz else 0
                    waiting[0] = replace(first, lost=lost)
            track.held, track.dropped = [], 0
            track.waiting = deque(waiting)
            track.bytes = sum(_size(one) for one in waiting)

    def _check(self, track: _Track) -> None:
        """End a file that another program has changed; the next row begins a new one."""
        change = "" if track.writer is None else track.writer.change()
        if not change:
            return
        writer, track.writer = track.writer, None
        assert writer is not None
        try:
            writer.abandon()
        except OSError as error:
            change = f"{change} ({error.strerror or error})"
        known = segment.segments(track.folder)  # there may be other files now; none of them is packed unasked
        track.number = max(track.number or 0, segment.number_of(known[-1]) if known else 0)
        self._note = f"{writer.path} {change} while it was written, with {track.rows} rows in it; a new one is begun"
        self._told.append(Told(track.origin.device, "recording_stopped", self._note))
        self._told.append(Told(track.origin.device, "recording_back", "recording goes on in a new file"))

    def _leave(self, track: _Track) -> None:
        """End the file of a device that is no more."""
        self._end(track)
        with self._lock:
            self._tracks = {key: one for key, one in self._tracks.items() if one is not track}

    def _write(self, track: _Track) -> None:
        """Append what waits; where that fails it goes on waiting, as far as there is room."""
        if self._full:
            self._stop(track, self._full)
        if track.trouble and (self._full or time.monotonic() - track.stopped_s < RETRY_S):
            return
        if not track.held:
            self._hold(track)
        if not track.held:
            return
        try:
            self._append(track)
        except ConfigError as error:  # no pyarrow
            self._stop(track, str(error))
        except OSError as error:
            self._stop(track, f"{track.folder}: {error.strerror or error}; recording stopped, trying again")
            self._end(track)
        else:
            track.held = []
            self._go_on(track)

    def _hold(self, track: _Track) -> None:
        """Take what waits; what was dropped before it is a hole of the recording."""
        with self._lock:
            track.held = list(track.waiting)
            track.waiting.clear()
            track.bytes = 0
            dropped, track.dropped = track.dropped, 0
        if track.held and isinstance(track.held[0], SampleBlock):
            track.held[0] = replace(track.held[0], lost=track.held[0].lost + dropped)

    def _append(self, track: _Track) -> None:
        began_s = _time_s(track.held[0])
        if track.writer is not None and began_s - track.began_s >= self._storage.segment_s:
            self._end(track)
        if track.writer is None:
            self._begin(track, began_s)
        assert track.writer is not None
        if track.origin.kind == "samples":
            blocks = [one for one in track.held if isinstance(one, SampleBlock)]
            track.writer.samples(blocks, self._states.get(track.origin.device, State()))
            track.rows += sum(len(one) for one in blocks)
        else:
            track.writer.chunks([one for one in track.held if isinstance(one, Chunk)])
            track.rows += len(track.held)
        track.unsynced = True

    def _begin(self, track: _Track, began_s: float) -> None:
        check_folder(track.folder)
        track.folder.mkdir(parents=True, exist_ok=True)
        if track.number is None:
            known = segment.segments(track.folder)
            track.number = segment.number_of(known[-1]) if known else 0
            self._to_pack.extend(known)
            for part in track.folder.glob(f"*{PART}"):
                part.unlink()
        path = track.folder / segment.segment_name(track.number + 1, began_s)
        track.writer = self._opening(path, track.origin)
        track.number += 1
        track.began_s, track.rows = began_s, 0

    def _end(self, track: _Track, pack: bool = True) -> None:
        writer, track.writer = track.writer, None
        if writer is None:
            return
        try:
            writer.close()
        except OSError as error:
            self._stop(track, f"{writer.path}: {error.strerror or error}; recording stopped, trying again")
        if pack:
            self._to_pack.append(writer.path)

    def _sync(self) -> None:
        if time.monotonic() - self._synced_s < SYNC_S - WRITE_S / 2:
            return
        self._synced_s = time.monotonic()
        for track in self._tracks.values():
            if track.writer is None or not track.unsynced:
                continue
            track.unsynced = False
            try:
                track.writer.sync()
            except OSError as error:
                self._stop(track, f"{track.folder}: {error.strerror or error}; recording stopped, trying again")
                self._end(track)

    def _pack(self) -> None:
        """A piece of packing."""
        until_s = time.monotonic() + PACKING_S
        while time.monotonic() < until_s and (self._packing is not None or self._to_pack):
            try:
                if self._packing is None:
                    self._packing = segment.pack(self._to_pack.popleft())
                next(self._packing)
            except StopIteration:
                self._packing = None
            except (RecordingError, ConfigError, OSError):
                self._packing = None  # it stays as it was: larger, and as readable

    # --- room

    def _tidy(self) -> None:
        """Delete what is too old, and the oldest while the disk is fuller than it may be."""
        if time.monotonic() - self._tidied_s < (RETRY_S if self._full else TIDY_S):
            return
        self._tidied_s = time.monotonic()
        folders = [track.folder for track in self._tracks.values()]
        try:
            retention.delete_old(folders, self._storage.keep_s, self._storage.segment_s)
            self._full = retention.make_room(self._storage.folder, folders, self._storage.disk_share)
        except OSError as error:
            self._full = f"{self._storage.folder}: {error.strerror or error}; recording stopped, trying again"

    # --- trouble

    def _stop(self, track: _Track, why: str) -> None:
        if not track.trouble:
            self._told.append(Told(track.origin.device, "recording_stopped", why))
        track.trouble = why
        track.stopped_s = time.monotonic()

    def _go_on(self, track: _Track) -> None:
        if track.trouble:
            track.trouble = ""
            text = f"recording goes on; {track.missed} rows are missing in it"
            self._told.append(Told(track.origin.device, "recording_back", text))


def origin(device: str, axes: AxisMap, kind: segment.Kind = "samples", carrier: str = "", decoder: str = "") -> Origin:
    """What a device's segments are of."""
    measured = zip(axes.source, axes.sign, strict=True)
    mounting = " ".join(f"{'-' if sign < 0.0 else ''}{AXES[at]}" for at, sign in measured)
    return Origin(device, kind, mounting, carrier, decoder)


def _newest_in(track: _Track) -> _Newest | None:
    """Return the newest row in the folder of a track; None if there is none."""
    for path in reversed(segment.segments(track.folder)):
        with contextlib.suppress(RecordingError, ConfigError, OSError):  # what is no segment is passed over
            if track.origin.kind == "raw":
                last = deque(segment.read_chunks(path), maxlen=1)
                if last:
                    return _Newest(last[0].t_ns)
            elif (piece := segment.newest(path)) is not None:
                rows = piece.samples
                span_s = int(rows.t_ns[-1] - rows.t_ns[0]) / 1e9
                rate_hz = piece.state.rate or ((len(rows) - 1) / span_s if span_s > 0.0 else None)
                return _Newest(int(rows.t_ns[-1]), int(rows.ticks[-1]), rate_hz)
    return None


def _time_of(newest: _Newest, waiting: Sequence[SampleBlock | Chunk]) -> int:
    """Return the time of a recorded row in the rows that wait [Unix ns]; its own time if it is not found among them.

    Two processes give a sample times that differ by some ms. The device's counter tells which sample it is.
    """
    for one in waiting if newest.tick != NO_TICK else ():
        if isinstance(one, SampleBlock):
            found = np.flatnonzero((one.ticks == newest.tick) & (np.abs(one.t_ns - newest.t_ns) < SAME_NS))
            if found.size:
                return int(one.t_ns[found[-1]])
    return newest.t_ns


def _after(one: SampleBlock | Chunk, t_ns: int) -> list[SampleBlock | Chunk]:
    """Rows later than a time: all of a block, some or none."""
    if isinstance(one, Chunk):
        return [one] if one.t_ns > t_ns else []
    later = np.flatnonzero(one.t_ns > t_ns + RESOLUTION_NS)
    return [one[int(later[0]) :]] if later.size else []


def _size(one: SampleBlock | Chunk) -> int:
    if isinstance(one, SampleBlock):
        return SAMPLE_BYTES * len(one)
    return CHUNK_BYTES + len(one.data) + len(one.attachment)


def _time_s(one: SampleBlock | Chunk) -> float:
    return float(one.t_ns[0] if isinstance(one, SampleBlock) else one.t_ns) / 1e9
