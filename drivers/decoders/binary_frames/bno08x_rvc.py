"""CEVA / Bosch BNO080, BNO085 and BNO086 over UART in RVC mode (robot vacuum cleaner), 115200 baud, 100 Hz.

The format is ``AA AA | index u8 | yaw, pitch, roll i16le in 0.01° | acceleration xyz i16le in mg | 3 reserved bytes |
checksum``, 19 bytes. The checksum is the low byte of the sum of all bytes between the header and the checksum. The
index counts the frames. Source: BNO080 data sheet 1000-3927, section 1.3.5.2, whose example frame is used as a test.

The frames contain no angular rates, so the gyroscope axes are marked as not measured. The resolution of 1 mg is coarse
compared with the noise of the sensor. The angles come from the orientation filter and are ignored.
"""

from typing import Final

import numpy as np

from drivers.data_types import Chunk, CounterTimedFormat, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import G0
from drivers.validation.settings_model import SettingsModel

HEADER: Final = b"\xaa\xaa"
LENGTH: Final = 19
ACCEL_STEP: Final = 1e-3 * G0


class Settings(SettingsModel):
    """Settings of the decoder. There are no options."""


class Bno08xRvcDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of RVC frames."""

    def __init__(self) -> None:
        super().__init__(HEADER, _match_frame, LENGTH)
        self.timing: Timing = CounterTimedFormat(256)

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        data = frames.stack_frames(np.arange(len(frames.data)))
        values = np.full((len(data), 6), np.nan)
        values[:, 3:] = np.ascontiguousarray(data[:, 9:15]).view("<i2") * ACCEL_STEP
        return self._builder.build_plausible_blocks(
            frames.t_ns, values, None, data[:, 2].astype(np.int64), frames.bad_before
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode the accelerations. Axes that are not measured are sent as 0, and all angles are 0."""
        words = np.zeros((len(samples), 6), "<i2")
        words[:, 3:] = base.quantize(samples.values[:, 3:], ACCEL_STEP, 16)
        rows = zip(samples.ticks.tolist(), words, strict=True)
        return base.make_chunks([encode_frame(tick & 0xFF, row.tobytes()) for tick, row in rows], samples.t_ns)


def encode_frame(index: int, words: bytes) -> bytes:
    """Return a frame.

    Parameters
    ----------
    index
        Number of the frame, 0 to 255.
    words
        Angles and accelerations, 12 bytes.
    """
    body = bytes([index]) + words + bytes(3)
    return HEADER + body + bytes([sum(body) & 0xFF])


def _match_frame(buffer: bytes, at: int) -> int:
    if len(buffer) < at + LENGTH:
        return base.NEED_MORE
    return LENGTH if sum(buffer[at + 2 : at + LENGTH - 1]) & 0xFF == buffer[at + LENGTH - 1] else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of RVC frames."""
    return Bno08xRvcDecoder()
