"""Samples of another imu-monitor, or of anything that publishes the same map: one message a batch.

The layout is in ``drivers.zenoh.sample_message``. The message brings Unix times and says how many samples its
publisher has had since its start: a jump of that count beyond the batch's own rows is a lost message, and
its rows are ``lost`` before the batch. A count that goes back is a publisher started anew, and no loss.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np

from drivers.decoders.base import QUIET_FRAMES, Decoder, DecoderSettings, Given, Rows, Timing
from drivers.errors import DecodeError
from drivers.sample import Chunk, SampleBlock
from drivers.zenoh.sample_message import pack, unpack

LONGEST_GAP: Final = 1_000_000_000
"""Samples; a larger jump of the count, eleven days at 1 kHz, is another count, not a loss."""


class Settings(DecoderSettings, frozen=True):
    """The message says all there is to know: no keys."""


class SamplesDecoder:
    """msgpack maps -> samples."""

    carrier: ClassVar[str] = "messages"

    def __init__(self) -> None:
        self.timing: Timing = Given()
        self.bad = 0  # messages rejected and implausible rows
        self.hint = ""
        self._quiet = 0  # messages since the last rejected one
        self._rows = Rows()
        self._rejected = 0  # messages
        self._received: int | None = None  # the publisher's count with its last message
        self._lost = 0  # rows missing before the next block
        self._encoded = 0

    def reset(self) -> None:
        """Messages are whole: only the count of lost ones is begun anew."""
        self._received = None
        self._lost = 0
        self._rows.reset()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """The samples of each message; ``t_ns`` are the message's own Unix times."""
        found: list[SampleBlock] = []
        for chunk in chunks:
            try:
                found += self._message(chunk.data)
                self._quiet += 1
            except DecodeError as error:
                self._rejected += 1
                self.hint = str(error)
                self._quiet = 0
        if self._quiet >= QUIET_FRAMES:
            self.hint = ""
        self.bad = self._rejected + self._rows.bad
        return found

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """One message with these samples."""
        self._encoded += len(samples)
        return [Chunk(pack("encoded", self._encoded, samples), int(samples.t_ns[-1]))]

    def _message(self, data: bytes) -> list[SampleBlock]:
        batch = unpack(data)
        rows = batch.block
        self._lost = min(self._lost + rows.lost + self._skipped(batch.samples, len(rows)), LONGEST_GAP)
        blocks = self._rows.blocks(
            rows.t_ns, rows.values, rows.temperature_c, rows.ticks, np.zeros(len(rows), np.int64)
        )
        if blocks and self._lost:
            blocks[0] = replace(blocks[0], lost=blocks[0].lost + self._lost)
            self._lost = 0
        return blocks

    def _skipped(self, received: int, rows: int) -> int:
        """Samples of messages that did not arrive."""
        before, self._received = self._received, received
        missing = 0 if before is None else received - rows - before
        return missing if 0 <= missing <= LONGEST_GAP else 0


def build(settings: Settings) -> Decoder:
    """A decoder of samples messages."""
    return SamplesDecoder()
