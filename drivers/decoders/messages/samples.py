"""Decoder of the sample messages that imu-monitor publishes.

``drivers.zenoh.sample_message`` defines the format. A message contains samples with Unix times, and the total number of
samples that the publisher has received since its start. If the total has increased by more than the number of samples
in the message, messages were lost. The field ``lost`` of the next sample block includes the samples of lost messages.
If the total has decreased, the publisher was restarted, and no samples are counted as lost.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from drivers.data_types import Chunk, SampleBlock, SenderTimedFormat, Timing
from drivers.decoders.base import Decoder, RejectingDecoder
from drivers.errors import DecodeError
from drivers.live_stream_check import configure_si_messages
from drivers.validation.settings_model import SettingsModel
from drivers.zenoh.sample_message import decode_samples, encode_samples

MAX_GAP_SAMPLES: Final = 1_000_000_000
"""Maximum number of lost samples (eleven days at 1 kHz). A larger step of the total indicates a restart."""


class Settings(SettingsModel):
    """Settings of the decoder. There are no options."""


class SamplesDecoder(RejectingDecoder):
    """Decoder and encoder of sample messages."""

    carrier: ClassVar[str] = "messages"

    def __init__(self) -> None:
        super().__init__(configure_si_messages("subscribe to the key of one sensor"))
        self.timing: Timing = SenderTimedFormat()
        self._rejected = 0  # number of rejected messages
        self._received: int | None = None  # total number of samples according to the last message
        self._lost = 0  # number of samples missing before the next block
        self._encoded = 0

    @property
    def bad(self) -> int:
        """Number of rejected messages and implausible samples."""
        return self._rejected + self._builder.bad

    def forget_stream_state(self) -> None:
        """Discard the total number of samples, so that no loss is reported for the next message."""
        self._received = None
        self._lost = 0
        self._builder.forget_missing_samples()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples of each message. ``t_ns`` are the Unix times in the message."""
        found: list[SampleBlock] = []
        for chunk in chunks:
            try:
                found += self._decode_message(chunk.data)
                self._rejection.add_good_frames()
            except DecodeError as error:
                self._rejected += 1
                self._rejection.note_rejection(str(error))
        return found

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return one message with these samples."""
        self._encoded += len(samples)
        return [Chunk(encode_samples("encoded", self._encoded, samples), int(samples.t_ns[-1]))]

    def _decode_message(self, data: bytes) -> list[SampleBlock]:
        """Return the samples of one message. ``lost`` of the first block counts the samples lost before the message."""
        message = decode_samples(data)
        rows = message.block
        self._lost = min(
            self._lost + rows.lost + self._count_skipped(message.total_samples, len(rows)), MAX_GAP_SAMPLES
        )
        blocks = self._builder.build_plausible_blocks(rows.t_ns, rows.values, rows.temperature_c, rows.ticks)
        if blocks and self._lost:
            blocks[0] = replace(blocks[0], lost=blocks[0].lost + self._lost)
            self._lost = 0
        return blocks

    def _count_skipped(self, received: int, rows: int) -> int:
        before, self._received = self._received, received
        missing = 0 if before is None else received - rows - before
        return missing if 0 <= missing <= MAX_GAP_SAMPLES else 0


def build(settings: Settings) -> Decoder:
    """Return a decoder of sample messages."""
    return SamplesDecoder()
