"""The daemon's own recordings: samples as received and decoded, and the bytes they came in where that is wanted.

Readers' threads hand over blocks and chunks, which wait in bounded queues; one thread appends them to segments twice a
second and has the disk keep them once a second, begins a new segment when one is as long as it may be, packs those that
have ended, and deletes the oldest by age and while the disk is fuller than it may be. So a slow disk delays no sample;
what does not fit a queue is counted and becomes a hole of the recording.

A disk that is full or read-only stops the recording, with an event; everything else goes on, and recording is tried
again every few seconds. After a crash the newest segment is read up to its last whole batch (``Recorder.tail``), so
that the daemon goes on from there.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from drivers.driver import AxisMap
from drivers.errors import ConfigError, RecordingError
from drivers.recording import segment
from drivers.recording.segment import Origin, Piece, SegmentWriter, State
from drivers.recording.table import PART
from drivers.sample import AXES, Chunk, SampleBlock, block
from monitor import retention
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
SAMPLE_BYTES: Final = 80
CHUNK_BYTES: Final = 100
"""What a chunk takes beside its bytes."""
RAW: Final = "raw"

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
            except RecordingError:
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
    missed: int = 0  # rows that are not in the recording
    unsynced: bool = False
    trouble: str = ""
    stopped_s: float = 0.0
    leaving: bool = False  # the device is no more: what waits is written, and that is all


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
        wrong = sorted({track.trouble for track in self._tracks.values() if track.trouble})
        if wrong:
            return wrong[0]
        missed = sum(track.missed for track in self._tracks.values())
        return f"ok, but {missed} rows are not in the recording: the disk was too slow or full" if missed else "ok"

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

    def samples(self, device: str, samples: SampleBlock, offset_ns: int) -> None:
        """A block; ``offset_ns`` makes its times Unix time."""
        track = self._tracks.get((device, "samples"))
        if track is None:
            return
        if offset_ns:
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
                rows = len(gone) if isinstance(gone, SampleBlock) else 1
                track.dropped += rows + (gone.lost if isinstance(gone, SampleBlock) else 0)
                track.missed += rows

    def know(self, device: str, state: State) -> None:
        """What is written with the rows from now on."""
        self._states[device] = state

    def full(self, device: str) -> bool:
        """Whether a recording that is replayed had better wait."""
        track = self._tracks.get((device, "samples"))
        return track is not None and track.bytes > QUEUE_BYTES // 4

    # --- after a restart

    def tail(self, device: str) -> Tail | None:
        """What was recorded of a device before this start; None where there is nothing to go on from.

        To be called before anything is written. What is no segment is passed over and stays for people to look at.
        """
        track = self._tracks.get((device, "samples"))
        if track is None:
            return None
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
        while True:
            closing = self._closing.wait(WRITE_S)
            for track in self._tracks.values():
                leaving = track.leaving  # before what waits is looked at: nothing comes after it
                self._write(track)
                if leaving:
                    self._leave(track)
            if closing:
                break
            self._sync()
            self._tidy()
            self._pack()
        for track in self._tracks.values():
            self._end(track)

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
        else:
            track.writer.chunks([one for one in track.held if isinstance(one, Chunk)])
        track.unsynced = True

    def _begin(self, track: _Track, began_s: float) -> None:
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
        track.began_s = began_s

    def _end(self, track: _Track) -> None:
        writer, track.writer = track.writer, None
        if writer is None:
            return
        try:
            writer.close()
        except OSError as error:
            self._stop(track, f"{writer.path}: {error.strerror or error}; recording stopped, trying again")
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


def _size(one: SampleBlock | Chunk) -> int:
    if isinstance(one, SampleBlock):
        return SAMPLE_BYTES * len(one)
    return CHUNK_BYTES + len(one.data) + len(one.attachment)


def _time_s(one: SampleBlock | Chunk) -> float:
    return float(one.t_ns[0] if isinstance(one, SampleBlock) else one.t_ns) / 1e9
