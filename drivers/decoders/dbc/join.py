"""Frames of several messages -> samples: which frames belong together, and which samples are bad.

A frame whose message the open sample already has, or that is later than ``window`` after its first, starts
the next sample; so does a message that holds nothing but the counter, and with ``join = "counter"`` a frame with
another count. A sample is done when every message has come; one that ends before is bad (with ``partial``:
done as it is). What stands before the first complete sample, joined mid-stream, is not counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.decoders.dbc.bits import Bits
from drivers.decoders.dbc.settings import Settings
from drivers.sample import AXES, EXTENDED_ID, NO_TICK

COLUMNS: Final = (*AXES, "temperature")


@dataclass(frozen=True, slots=True)
class Column:
    """One axis: which signal it is, and the way to SI."""

    place: int  # in COLUMNS
    bits: Bits
    factor: float
    offset: float


@dataclass(slots=True)
class Message:
    """One message of a sample."""

    name: str
    frame_id: int
    extended: bool
    j1939: bool
    size: int  # bytes that the signals used need
    length: int  # bytes as sent
    columns: list[Column]
    valid: Bits | None = None
    counter: Bits | None = None

    @property
    def address(self) -> int:
        """As in ``Chunk.address``."""
        return self.frame_id | (EXTENDED_ID if self.extended else 0)

    @property
    def only_counter(self) -> bool:
        """Whether the message does nothing but number the samples."""
        return self.counter is not None and not self.columns and self.valid is None

    @property
    def only_temperature(self) -> bool:
        """Whether it may be slower than the samples."""
        places = {c.place for c in self.columns}
        return places == {len(AXES)} and self.valid is None and self.counter is None


@dataclass(slots=True)
class Sample:
    """Frames of one sample; None = not come; b"" = too short."""

    frames: list[bytes | None]
    t_ns: int  # of the newest frame
    start_ns: int
    count: int  # of the counter; NO_TICK = none yet
    bad_before: int = 0
    temperature: bytes | None = None  # newest frame of the message that brings it alone

    @property
    def complete(self) -> bool:
        """Whether every message has come."""
        return None not in self.frames


class Join:
    """Frames in order of arrival -> samples in order."""

    def __init__(self, messages: Sequence[Message], settings: Settings) -> None:
        self._n = len(messages)
        self._by_count = settings.join == "counter"
        self._counters = [m.counter for m in messages]
        self._starter = next((i for i, m in enumerate(messages) if m.only_counter), None)
        self._window_ns = round(settings.window * 1e9) or (1 << 62)
        self._partial = settings.partial
        self.reset()

    def reset(self) -> None:
        """Forget the open sample and being in step."""
        self._open: Sample | None = None
        self._in_step = False
        self._bad = 0
        self.temperature: bytes | None = None

    def take_bad(self) -> int:
        """Samples rejected since the last good one; forgets them."""
        bad, self._bad = self._bad, 0
        return bad

    def put(self, which: int, data: bytes, t_ns: int, done: list[Sample]) -> None:
        """One frame of message ``which``; samples that it completes or ends go to ``done``."""
        count = self._count(which, data)
        sample = self._open
        if sample is not None and self._begins_next(sample, which, count, t_ns):
            self._finish(sample, done)
            sample = None
        if sample is None:
            sample = self._open = Sample([None] * self._n, t_ns, t_ns, NO_TICK)
        sample.frames[which] = data
        sample.t_ns = t_ns
        if count != NO_TICK:
            sample.count = count
        if sample.complete:
            self._finish(sample, done)
            self._open = None

    def _count(self, which: int, data: bytes) -> int:
        bits = self._counters[which]
        if bits is None or not data or not self._by_count:
            return NO_TICK
        return int(bits.raw(np.frombuffer(data, np.uint8)[None, :])[0])

    def _begins_next(self, sample: Sample, which: int, count: int, t_ns: int) -> bool:
        if sample.frames[which] is not None or t_ns - sample.start_ns > self._window_ns:
            return True
        if which == self._starter:
            return True
        return NO_TICK not in (count, sample.count) and count != sample.count

    def _finish(self, sample: Sample, done: list[Sample]) -> None:
        whole = sample.complete and b"" not in sample.frames
        if whole or (self._partial and any(sample.frames)):
            sample.bad_before = self.take_bad()
            sample.temperature = self.temperature
            self._in_step = True
            done.append(sample)
        elif self._in_step or sample.complete:
            self._bad += 1
