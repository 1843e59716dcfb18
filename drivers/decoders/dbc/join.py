"""Frames of several messages -> samples: which frames belong together, and which samples are bad.

A frame whose message the open sample already has starts the next sample. So does a message that holds nothing but the
counter, and with ``join = "counter"`` a frame with another count. A sample is done when every message has come. A
sample that ends before is bad (with ``partial``: done as it is). Frames before the first whole sample are not counted,
as the link may have been opened in the middle of a sample.

A frame that comes more than ``window`` after the first frame of the open sample is either a late frame of this sample,
or starts the next sample because earlier frames were lost. Equal counts decide where there are counts. Otherwise the
order of the messages decides: samples start with the message before which the pause is longest, so a frame of that
message starts the next sample. A frame of another message is late, unless a whole sample period has passed. Pauses are
medians over the last frames; a frame that comes before the order is known waits until it is. A sample with all its
frames, some of them late, counts as late and not as bad: its values are left out and its place stays
empty.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Final

import numpy as np

from drivers.decoders.dbc.bits import Bits
from drivers.decoders.dbc.settings import Settings
from drivers.sample import AXES, EXTENDED_ID, NO_TICK

COLUMNS: Final = (*AXES, "temperature")
PAUSES_KEPT: Final = 15
"""Pauses per message that the median is taken of."""
PAUSES_NEEDED: Final = 3
"""Pauses per message from which the order of the messages is known."""
UNDECIDED_PER_MESSAGE: Final = 8
"""So many frames per message wait until the order is known; then the order of those that have come is used."""


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
    missing_before: int = 0  # samples left out since the last good one, bad or late
    late: set[int] = field(default_factory=set)  # messages that came after the window
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
        self.late = 0
        """Samples left out because some of their frames came after the window."""
        self._delay_ns = 0  # from the first frame of a sample to its late frame; 0 = no frame has been late
        self.reset()

    def reset(self) -> None:
        """Forget the open sample, the order of the messages and whether a whole sample has come."""
        self._open: Sample | None = None
        self._in_step = False
        self._missing = 0
        self._count_before = NO_TICK  # of the sample before the open one
        self._newest_ns: int | None = None  # arrival of the newest frame
        self._pauses: list[deque[int]] = [deque(maxlen=PAUSES_KEPT) for _ in range(self._n)]  # ns, before each message
        self._undecided: deque[tuple[int, bytes, int]] = deque()
        self.temperature: bytes | None = None

    def take_missing(self) -> int:
        """Samples left out since the last good one, bad or late; forgets them."""
        missing, self._missing = self._missing, 0
        return missing

    def take_delay_ns(self) -> int:
        """Return the delay of the newest late frame after the first of its sample; 0 if none since the last call."""
        delay_ns, self._delay_ns = self._delay_ns, 0
        return delay_ns

    def put(self, which: int, data: bytes, t_ns: int, done: list[Sample]) -> None:
        """One frame of message ``which``; samples that it completes or ends go to ``done``."""
        if self._newest_ns is not None:
            self._pauses[which].append(t_ns - self._newest_ns)
        self._newest_ns = t_ns
        if not self._undecided and self._place(which, data, t_ns, done):
            return
        self._undecided.append((which, data, t_ns))
        while self._undecided and self._place(*self._undecided[0], done):
            self._undecided.popleft()

    def _place(self, which: int, data: bytes, t_ns: int, done: list[Sample]) -> bool:
        """Put a frame into its sample; False if it cannot be told yet which sample that is."""
        count = self._count(which, data)
        sample = self._open
        if sample is not None:
            delay_ns = t_ns - sample.start_ns
            next_one = self._begins_next(sample, which, count, delay_ns)
            if next_one is None:
                return False
            if next_one:
                if NO_TICK != count == self._count_before:
                    return True  # a frame of the sample before, which is finished and counted
                self._finish(sample, done)
                sample = None
            elif delay_ns > self._window_ns:
                self._delay_ns = delay_ns
                self._note_late(sample, which, data, done)
                return True
        if sample is None:
            sample = self._open = Sample([None] * self._n, t_ns, t_ns, NO_TICK)
        sample.frames[which] = data
        sample.t_ns = t_ns
        if count != NO_TICK:
            sample.count = count
        if sample.complete:
            self._finish(sample, done)
            self._open = None
        return True

    def _note_late(self, sample: Sample, which: int, data: bytes, done: list[Sample]) -> None:
        if data:
            sample.late.add(which)
        else:
            sample.frames[which] = data  # too short: the sample is bad
        if sample.frames.count(None) == len(sample.late):
            self._finish(sample, done)
            self._open = None

    def _count(self, which: int, data: bytes) -> int:
        bits = self._counters[which]
        if bits is None or not data or not self._by_count:
            return NO_TICK
        return int(bits.raw(np.frombuffer(data, np.uint8)[None, :])[0])

    def _begins_next(self, sample: Sample, which: int, count: int, delay_ns: int) -> bool | None:
        """Whether a frame starts the next sample; None if the order of the messages has to be known first."""
        if sample.frames[which] is not None or which in sample.late or which == self._starter:
            return True
        if NO_TICK not in (count, sample.count):
            return count != sample.count
        if delay_ns <= self._window_ns:
            return False
        fewest = min(map(len, self._pauses))
        if fewest < PAUSES_NEEDED and len(self._undecided) < UNDECIDED_PER_MESSAGE * self._n:
            return None
        pauses = [median(last) if last else 0 for last in self._pauses]
        first = pauses.index(max(pauses)) if self._starter is None else self._starter
        # the pauses before all messages add up to the period of the samples
        return which == first or delay_ns >= sum(pauses)

    def _finish(self, sample: Sample, done: list[Sample]) -> None:
        self._count_before = sample.count
        whole = sample.complete and b"" not in sample.frames
        if whole or (self._partial and any(sample.frames)):
            sample.missing_before = self.take_missing()
            sample.temperature = self.temperature
            self._in_step = True
            done.append(sample)
        elif sample.late and b"" not in sample.frames and sample.frames.count(None) == len(sample.late):
            self._in_step = True
            self.late += 1
            self._missing += 1
        elif self._in_step or sample.complete:
            self._missing += 1
