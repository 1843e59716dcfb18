"""Decoder for CAN sensors that are described by a DBC file. The settings assign a CAN signal to each axis.

A sample may consist of several CAN messages, which ``drivers.decoders.dbc.sample_assembly`` joins. A sample is rejected
if a frame is missing or too short, or if the signal ``valid`` is not 1. With ``partial = true``, a sample with a
missing frame is kept, and the axes of the missing frame are marked as not measured. A sample with late frames is
counted in ``dropped_late_samples`` and not in ``bad``. A message that contains only the temperature may arrive at a
lower rate than the samples. Each sample then contains the newest temperature.

J1939 messages (attribute VFrameFormat, or ``j1939 = true``) are identified by the parameter group. The priority and the
source address are not part of the parameter group. The decoder accepts the first source address that it receives,
unless the key ``source`` is set. A J1939 value in the top 2/256 of its range means "error" or "not available", so the
axis is marked as not measured. For 16-bit values, this part is 0xFE00 to 0xFFFF (SAE J1939-71). Other messages are
treated in the same way if ``not_available = true``.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import ANY_SOURCE, AXES, EXTENDED_ID, NO_TICK, Chunk, Ints, SampleBlock, Timing
from drivers.decoders.base import HINT_FRAMES, BlockBuilder, Bytes, Decoder
from drivers.decoders.dbc.database import ConfiguredDbcMessages
from drivers.decoders.dbc.sample_assembly import CanMessage, ReceivedSampleFrames, SampleAssembler
from drivers.decoders.dbc.settings import COLUMNS, Settings, SignalSettings
from drivers.live_stream_check import StreamConfiguration

__all__ = ["DbcDecoder", "Settings", "SignalSettings", "build"]

TRIADS: Final = {"gyro": AXES[:3], "accel": AXES[3:]}
MAX_CACHED_IDS: Final = 4096
"""Maximum number of cached 29-bit identifiers. The limit prevents corrupted identifiers from filling the memory."""


class DbcDecoder:
    """Decoder and encoder of the CAN frames of one device.

    Parameters
    ----------
    messages
        Messages that contain the signals.
    settings
        Settings of the decoder.
    timing
        Source of the sample times.
    configuration
        Units of the samples. None if they are not checked.
    """

    carrier: ClassVar[str] = "frames"

    def __init__(
        self,
        messages: Sequence[CanMessage],
        settings: Settings,
        timing: Timing,
        configuration: StreamConfiguration | None = None,
    ) -> None:
        slow = [m for m in messages if m.contains_only_temperature and len(messages) > 1]
        self._slow = slow[0] if slow else None
        self._messages = [m for m in messages if m is not self._slow]
        self._settings = settings
        self.timing: Timing = timing
        self.bad = 0
        self.dropped_late_samples = 0
        self.late_frames_hint = ""
        self._dropped = 0  # number of bad and late samples
        self.recent_problem = ""
        self._two_senders_hint = ""  # message if two senders use the same parameter groups
        self._samples_since_reject = 0  # number of valid samples since the last rejected sample
        self._builder = BlockBuilder(configuration)
        self._assembler = SampleAssembler(self._messages, settings)
        self._known = {m.address: i for i, m in self._numbered_messages() if not m.j1939}
        self._groups = {_parameter_group(m.frame_id): i for i, m in self._numbered_messages() if m.j1939}
        self._cache: dict[int, int | None] = {}
        self._source = settings.source

    @property
    def accepted_addresses(self) -> tuple[int, ...]:
        """Addresses to receive from the CAN bus. The bit ``ANY_SOURCE`` marks J1939 parameter groups."""
        return tuple(m.address | (ANY_SOURCE if m.j1939 else 0) for _, m in self._numbered_messages())

    def forget_stream_state(self) -> None:
        """Discard an incomplete sample, the newest temperature and the accepted J1939 source address."""
        self._assembler.forget_stream_state()
        self._builder.forget_missing_samples()
        self._source = self._settings.source
        self._two_senders_hint = ""
        self._cache.clear()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples that are complete after the given frames.

        ``t_ns`` is the arrival time of the last frame of a sample.
        """
        done: list[ReceivedSampleFrames] = []
        for chunk in chunks:
            which = self._message_index(chunk.address)
            if which is None:
                continue
            if which < 0:
                self._note_temperature(chunk.data)
                continue
            size = self._messages[which].size
            if len(chunk.data) < size:
                message = self._messages[which].name
                self.recent_problem = f"{message}: frames of {len(chunk.data)} bytes, but its signals need {size}"
            self._assembler.add_frame(which, chunk.data[:size] if len(chunk.data) >= size else b"", chunk.t_ns, done)
        blocks = self._decode_samples(done)
        rejected = self._builder.bad != self._dropped
        self._samples_since_reject = 0 if rejected else self._samples_since_reject + len(done)
        if self._samples_since_reject >= HINT_FRAMES:
            self.recent_problem = self.late_frames_hint = ""
        if delay_ns := self._assembler.take_newest_late_frame_delay_ns():
            self._samples_since_reject = 0
            self.recent_problem = self.late_frames_hint = (
                f"frames of one sample arrive {delay_ns * 1e-6:.3g} ms apart, more than "
                f"window = {self._settings.window:g} s: increase `window` in decoder_options"
            )
        self.recent_problem = self._builder.problem or self._two_senders_hint or self.recent_problem
        self._dropped, self.dropped_late_samples = self._builder.bad, self._assembler.dropped_late_samples
        self.bad = self._dropped - self.dropped_late_samples
        return blocks

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode samples as CAN frames. Unused bits are 1 in J1939 messages and 0 in other messages."""
        n = len(samples)
        table = np.column_stack((samples.values, samples.temperature_c))
        sent: list[tuple[CanMessage, Bytes]] = []
        # The temperature is sent first, because the decoder assigns a temperature to the samples that follow.
        for _, message in sorted(self._numbered_messages()):
            frames = np.full((n, message.length), 0xFF if message.j1939 else 0, np.uint8)
            for column in message.columns:
                column.bits.insert_values(frames, (table[:, column.index] - column.offset) / column.factor)
            if message.valid is not None:
                message.valid.insert_raw(frames, np.ones(n, np.uint64))
            if message.counter is not None:
                message.counter.insert_raw(frames, samples.ticks.view(np.uint64))
            sent.append((message, frames))
        return [
            Chunk(frames[row].tobytes(), int(samples.t_ns[row]), message.address)
            for row in range(n)
            for message, frames in sent
            if message is not self._slow or not np.isnan(samples.temperature_c[row])
        ]

    def _numbered_messages(self) -> list[tuple[int, CanMessage]]:
        """Return each CAN message with its index. A message that contains only the temperature has the index -1."""
        slow = [(-1, self._slow)] if self._slow is not None else []
        return [*slow, *enumerate(self._messages)]

    def _message_index(self, address: int) -> int | None:
        if address in self._known:
            return self._known[address]
        if not self._groups or not address & EXTENDED_ID:
            return None
        if address not in self._cache:
            if len(self._cache) >= MAX_CACHED_IDS:
                self._cache.clear()
            self._cache[address] = self._find_j1939_message(address)
        return self._cache[address]

    def _find_j1939_message(self, address: int) -> int | None:
        which = self._groups.get(_parameter_group(address))
        if which is None:
            return None
        source = address & 0xFF
        if self._source is None:
            self._source = source
        if source == self._source:
            return which
        if self._settings.source is None:
            self._two_senders_hint = (
                f"senders 0x{self._source:02X} and 0x{source:02X} both send these messages; "
                f"listening to 0x{self._source:02X}, source = {source} would choose the other"
            )
        return None

    def _note_temperature(self, data: bytes) -> None:
        assert self._slow is not None
        if len(data) >= self._slow.size:
            self._assembler.temperature = data[: self._slow.size]

    def _decode_samples(self, done: Sequence[ReceivedSampleFrames]) -> list[SampleBlock]:
        n = len(done)
        table = np.full((n, len(COLUMNS)), np.nan)
        ticks = np.full(n, NO_TICK, np.int64)
        valid = np.ones(n, bool)
        for which, message in self._numbered_messages():
            frames, there = _stack_frames(done, which, message.size)
            for column in message.columns:
                physical = column.bits.extract_values(frames) * column.factor + column.offset
                table[there, column.index] = physical[there]
            if message.valid is not None:
                valid &= ~there | (message.valid.extract_raw(frames) == 1)
            if message.counter is not None:
                raw: Ints = message.counter.extract_raw(frames).astype(np.int64)
                ticks[there] = raw[there]
        # ``BlockBuilder`` rejects a sample without any value and counts the sample as missing.
        table[~valid] = np.nan
        if not valid.all():
            self.recent_problem = f"{self._settings.valid} is not 1: the sensor reports that its values are invalid"
        return self._builder.build_plausible_blocks(
            np.array([s.t_ns for s in done], np.int64),
            np.ascontiguousarray(table[:, : len(AXES)]),
            table[:, len(AXES)].copy(),
            ticks,
            np.array([s.missing_before for s in done], np.int64),
            self._assembler.take_missing_samples(),
        )


def _describe_configuration(units: Mapping[str, str]) -> StreamConfiguration:
    """Return what the DBC file and the settings state about the samples. ``units`` contains the unit of each axis."""

    def unit_of(axes: Sequence[str], si_unit: str) -> str:
        given = {units[axis] for axis in axes if axis in units}
        return given.pop() if len(given) == 1 else si_unit

    return StreamConfiguration(
        (unit_of(TRIADS["gyro"], "rad/s"), unit_of(TRIADS["accel"], "m/s²")),
        (True, True),
        lambda found: f"set unit = {found.fits} for {' '.join(TRIADS[found.triad])} in `signals`",
        "assign the messages of one sensor in `signals`, or choose its `channel` or `source`",
    )


def _stack_frames(done: Sequence[ReceivedSampleFrames], which: int, size: int) -> tuple[Bytes, NDArray[np.bool_]]:
    frames = [s.temperature if which < 0 else s.frames[which] for s in done]
    empty = bytes(size)
    data = np.frombuffer(b"".join(f or empty for f in frames), np.uint8)
    return data.reshape(len(frames), size), np.array([bool(f) for f in frames], bool)


def _parameter_group(frame_id: int) -> int:
    """Return the J1939 parameter group number of a 29-bit identifier (SAE J1939-21 5.1.2)."""
    group = frame_id >> 8 & 0x3_FFFF
    return group if group >> 8 & 0xFF >= 240 else group & 0x3_FF00


def build(settings: Settings) -> Decoder:
    """Return a decoder for the DBC file in the settings.

    Raises
    ------
    ConfigError
        If the settings contain mistakes. The error has one line for each mistake.
    """
    database = ConfiguredDbcMessages(settings)
    configuration = _describe_configuration(database.units)
    return DbcDecoder(database.messages_with_configured_signals, settings, database.timing, configuration)
