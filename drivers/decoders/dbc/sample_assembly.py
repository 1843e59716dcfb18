"""Assembly of samples from the frames of several CAN messages, and detection of incomplete samples.

A sample is complete when one frame of every message has arrived. A frame starts the next sample if the current sample
already contains a frame of the same message, or if the message contains only the counter. With ``join = "counter"``, a
frame with a new counter value also starts the next sample. An incomplete sample is rejected, unless ``partial`` is
True. Frames before the first complete sample are ignored, since the link may have been opened in the middle of a
sample.

A frame that arrives more than ``window`` seconds after the first frame of the current sample either is late or starts
the next sample. A frame with the counter value of the current sample is late. Without counter values, the order of the
messages decides whether the frame is late. The first message of a sample is the message with the longest median pause
before its frames. A frame of the first message starts the next sample. A frame of any other message is late, unless a
complete sample period has passed. A frame waits in a queue while the order of the messages is unknown. If all frames of
a sample have arrived but some were late, the sample is dropped and counted as late, but not as bad.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Final

import numpy as np

from drivers.data_types import AXES, EXTENDED_ID, NO_TICK
from drivers.decoders.dbc.settings import Settings
from drivers.decoders.dbc.signal_bits import SignalCodec

PAUSE_HISTORY: Final = 15
"""Number of recent pauses per message from which the median pause is computed."""
MIN_PAUSES: Final = 3
"""Minimum number of pauses per message from which the order of the messages is determined."""
MAX_UNDECIDED_PER_MESSAGE: Final = 8
"""Maximum number of queued frames per message.

Once the queue is full, the order of the messages is estimated from the pauses measured so far.
"""


@dataclass(frozen=True, slots=True)
class MeasuredSignal:
    """Signal of one axis or of the temperature, with the conversion to SI units."""

    index: int  # index of the column in COLUMNS
    bits: SignalCodec
    factor: float
    offset: float


@dataclass(slots=True)
class CanMessage:
    """Definition of a CAN message that contains a part of a sample."""

    name: str
    frame_id: int
    extended: bool
    j1939: bool
    size: int  # number of bytes from the start of the message to the end of the last used signal
    length: int  # number of bytes of the complete message
    columns: list[MeasuredSignal]
    valid: SignalCodec | None = None
    counter: SignalCodec | None = None

    @property
    def address(self) -> int:
        """Address of the frames, encoded as in ``Chunk.address``."""
        return self.frame_id | (EXTENDED_ID if self.extended else 0)

    @property
    def contains_only_counter(self) -> bool:
        """True if the message contains only the counter."""
        return self.counter is not None and not self.columns and self.valid is None

    @property
    def contains_only_temperature(self) -> bool:
        """True if the message contains only the temperature."""
        indices = {column.index for column in self.columns}
        return indices == {len(AXES)} and self.valid is None and self.counter is None


@dataclass(slots=True)
class ReceivedSampleFrames:
    """CAN frames of one sample, in the order of the messages. A missing frame is None, and a short frame is b""."""

    frames: list[bytes | None]
    t_ns: int  # arrival time of the newest frame
    start_ns: int  # arrival time of the first frame
    count: int  # value of the counter; NO_TICK = no counter value has arrived
    missing_before: int = 0  # number of bad and late samples since the last good sample
    late: set[int] = field(default_factory=set)  # indices of the messages whose frames were late
    temperature: bytes | None = None  # newest frame of the message that contains only the temperature

    @property
    def complete(self) -> bool:
        """True if a frame of every message has arrived."""
        return None not in self.frames


class SampleAssembler:
    """Assembler that combines CAN frames into samples, in order of arrival.

    Parameters
    ----------
    messages
        CAN messages that make up one sample.
    settings
        Settings of the decoder.
    """

    def __init__(self, messages: Sequence[CanMessage], settings: Settings) -> None:
        self._n = len(messages)
        self._by_count = settings.join == "counter"
        self._counters = [m.counter for m in messages]
        self._counter_message = next((i for i, m in enumerate(messages) if m.contains_only_counter), None)
        self._window_ns = round(settings.window * 1e9) or (1 << 62)
        self._partial = settings.partial
        self.dropped_late_samples = 0
        """Number of samples that were dropped because some of their frames were late."""
        self._delay_ns = 0  # time from the first frame of a sample to a late frame; 0 = no frame has been late
        self.forget_stream_state()

    def forget_stream_state(self) -> None:
        """Discard the current sample and the order of the messages."""
        self._current: ReceivedSampleFrames | None = None
        self._synchronized = False
        self._missing = 0
        self._count_before = NO_TICK  # counter value of the previous sample
        self._newest_ns: int | None = None  # arrival time of the newest frame
        self._pauses: list[deque[int]] = [deque(maxlen=PAUSE_HISTORY) for _ in range(self._n)]  # ns before each message
        self._undecided: deque[tuple[int, bytes, int]] = deque()
        self.temperature: bytes | None = None

    def take_missing_samples(self) -> int:
        """Return the number of bad and late samples since the last good sample, and reset the number to 0."""
        missing, self._missing = self._missing, 0
        return missing

    def take_newest_late_frame_delay_ns(self) -> int:
        """Return and reset the delay in ns from the first frame of a sample to the newest late frame."""
        delay_ns, self._delay_ns = self._delay_ns, 0
        return delay_ns

    def add_frame(self, message_index: int, data: bytes, t_ns: int, finished: list[ReceivedSampleFrames]) -> None:
        """Add one CAN frame to the current or the next sample.

        Parameters
        ----------
        message_index
            Index of the message.
        data
            Bytes of the frame; b"" if the frame is too short.
        t_ns
            Arrival time in ns.
        finished
            List to which finished samples are appended.
        """
        if self._newest_ns is not None:
            self._pauses[message_index].append(t_ns - self._newest_ns)
        self._newest_ns = t_ns
        if not self._undecided and self._assign_frame(message_index, data, t_ns, finished):
            return
        self._undecided.append((message_index, data, t_ns))
        while self._undecided and self._assign_frame(*self._undecided[0], finished):
            self._undecided.popleft()

    def _assign_frame(self, message_index: int, data: bytes, t_ns: int, finished: list[ReceivedSampleFrames]) -> bool:
        """Add a frame to the current or the next sample.

        Return False if the order of the messages must be known first.
        """
        count = self._read_count(message_index, data)
        sample = self._current
        if sample is not None:
            delay_ns = t_ns - sample.start_ns
            next_one = self._begins_next(sample, message_index, count, delay_ns)
            if next_one is None:
                return False
            if next_one:
                if NO_TICK != count == self._count_before:
                    return True  # the frame belongs to the previous sample, which has already been counted
                self._finish(sample, finished)
                sample = None
            elif delay_ns > self._window_ns:
                self._delay_ns = delay_ns
                self._add_late_frame(sample, message_index, data, finished)
                return True
        if sample is None:
            sample = self._current = ReceivedSampleFrames([None] * self._n, t_ns, t_ns, NO_TICK)
        sample.frames[message_index] = data
        sample.t_ns = t_ns
        if count != NO_TICK:
            sample.count = count
        if sample.complete:
            self._finish(sample, finished)
            self._current = None
        return True

    def _add_late_frame(
        self, sample: ReceivedSampleFrames, message_index: int, data: bytes, finished: list[ReceivedSampleFrames]
    ) -> None:
        if data:
            sample.late.add(message_index)
        else:
            sample.frames[message_index] = data  # the frame is too short, so the sample is bad
        if sample.frames.count(None) == len(sample.late):
            self._finish(sample, finished)
            self._current = None

    def _read_count(self, message_index: int, data: bytes) -> int:
        bits = self._counters[message_index]
        if bits is None or not data or not self._by_count:
            return NO_TICK
        return int(bits.extract_raw(np.frombuffer(data, np.uint8)[None, :])[0])

    def _begins_next(self, sample: ReceivedSampleFrames, message_index: int, count: int, delay_ns: int) -> bool | None:
        """Return True if a frame starts the next sample; None if the order of the messages must be known first."""
        if (
            sample.frames[message_index] is not None
            or message_index in sample.late
            or message_index == self._counter_message
        ):
            return True
        if NO_TICK not in (count, sample.count):
            return count != sample.count
        if delay_ns <= self._window_ns:
            return False
        fewest = min(map(len, self._pauses))
        if fewest < MIN_PAUSES and len(self._undecided) < MAX_UNDECIDED_PER_MESSAGE * self._n:
            return None
        pauses = [median(newest) if newest else 0 for newest in self._pauses]
        first = pauses.index(max(pauses)) if self._counter_message is None else self._counter_message
        # The pauses before all messages add up to the sample period.
        return message_index == first or delay_ns >= sum(pauses)

    def _finish(self, sample: ReceivedSampleFrames, finished: list[ReceivedSampleFrames]) -> None:
        """Append a good sample to ``finished``, or increase the number of late or bad samples."""
        self._count_before = sample.count
        whole = sample.complete and b"" not in sample.frames
        if whole or (self._partial and any(sample.frames)):
            sample.missing_before = self.take_missing_samples()
            sample.temperature = self.temperature
            self._synchronized = True
            finished.append(sample)
        elif sample.late and b"" not in sample.frames and sample.frames.count(None) == len(sample.late):
            self._synchronized = True
            self.dropped_late_samples += 1
            self._missing += 1
        elif self._synchronized or sample.complete:
            self._missing += 1
