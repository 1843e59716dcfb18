"""Decoder of sample messages from another imu-monitor, or from any program that publishes the same map.

The layout is defined in ``drivers.zenoh.sample_message``. A message contains Unix times and the number of samples that
the publisher has received since its start. If the number increases by more than the samples of the message, messages
have been lost. Their samples are counted as ``lost`` before the message. If the number decreases, the publisher has
been restarted, and no samples are counted as lost.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from drivers.decoders.base import BlockBuilder, Decoder, DecoderSettings, RecentRejection
from drivers.errors import DecodeError
from drivers.sample import Chunk, SampleBlock, SenderTimedFormat, Timing
from drivers.zenoh.sample_message import decode_samples, encode_samples

MAX_GAP_SAMPLES: Final = 1_000_000_000
"""Largest gap in samples, eleven days at 1 kHz. A larger jump indicates that the counter was restarted."""


class Settings(DecoderSettings):
    """Settings of the decoder. There are no keys, since the message contains everything."""


class SamplesDecoder:
    """Decoder and encoder of msgpack maps of samples."""

    carrier: ClassVar[str] = "messages"

    def __init__(self) -> None:
        self.timing: Timing = SenderTimedFormat()
        self._rejection = RecentRejection()
        self._builder = BlockBuilder()
        self._rejected = 0  # messages
        self._received: int | None = None  # count of the publisher in its last message
        self._lost = 0  # samples missing before the next block
        self._encoded = 0

    @property
    def bad(self) -> int:
        """Number of rejected messages and of implausible samples."""
        return self._rejected + self._builder.bad

    @property
    def recent_problem(self) -> str:
        """Reason for the last rejected message, while it is recent."""
        return self._rejection.rejection_reason

    def reset(self) -> None:
        """Start the count of lost samples again. There are no incomplete messages."""
        self._received = None
        self._lost = 0
        self._builder.forget_rejected_frames()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples of each message. ``t_ns`` are the Unix times of the message."""
        found: list[SampleBlock] = []
        for chunk in chunks:
            try:
                found += self._decode_message(chunk.data)
                self._rejection.count_good_frames()
            except DecodeError as error:
                self._rejected += 1
                self._rejection.note_rejection(str(error))
        return found

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return one message with these samples."""
        self._encoded += len(samples)
        return [Chunk(encode_samples("encoded", self._encoded, samples), int(samples.t_ns[-1]))]

    def _decode_message(self, data: bytes) -> list[SampleBlock]:
        """Return the samples of one message. The first block states the number of samples lost before the message."""
        message = decode_samples(data)
        rows = message.block
        self._lost = min(self._lost + rows.lost + self._count_skipped(message.samples, len(rows)), MAX_GAP_SAMPLES)
        blocks = self._builder.build_plausible_blocks(rows.t_ns, rows.values, rows.temperature_c, rows.ticks)
        if blocks and self._lost:
            blocks[0] = replace(blocks[0], lost=blocks[0].lost + self._lost)
            self._lost = 0
        return blocks

    def _count_skipped(self, received: int, rows: int) -> int:
        """Return the number of samples in messages that did not arrive."""
        before, self._received = self._received, received
        missing = 0 if before is None else received - rows - before
        return missing if 0 <= missing <= MAX_GAP_SAMPLES else 0


def build(settings: Settings) -> Decoder:
    """Return a decoder of sample messages."""
    return SamplesDecoder()
