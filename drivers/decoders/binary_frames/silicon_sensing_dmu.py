"""Silicon Sensing DMU11 over RS-422, 460800 bit/s. The DMU41 sends the same message as the DMU11.

The message is big-endian and consists of 34 words of 16 bits: ``55 AA | message count u16 | x rate f32 | x acceleration
f32 | y rate | y acceleration | z rate | z acceleration | auxiliary voltage f32 | temperature f32 | six increments f32 |
start-up flags u16 | operating flags u16 | error flags u16 | checksum u16``. The units are °/s, g, V and °C. The
increments (° and m/s) are not read. The content can be configured: the variant of 40 bytes contains neither the voltage
nor the increments. The sum of all words, including the checksum, is 0 modulo 65536.

Sources: two public drivers that quote the data sheet DMU11-00-0100-132 revision 3 (drivers for ArduPilot with 68 and
with 40 bytes), and lisusdaniil/dmu_ros, which reads a DMU11 and a DMU41. leo-drive/dmu11_ros2_driver differs from these
sources: it reads the y acceleration before the y rate. The decoder follows the quoted data sheet.

The drivers for ArduPilot change the sign of all six axes, and the two other drivers change none. This decoder keeps the
signs of the message. The table ``[device.axes]`` changes signs, for example ``gx = "-gx"``. The public sources do not
explain the flags. If the error flags are not 0, the decoder accepts the sample and reports the flags. The layout of the
DMU30 is not public, so the decoder does not read a DMU30.
"""

import struct
from typing import Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import Chunk, CounterTimedFormat, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE, G0
from drivers.validation.settings_model import SettingsModel

HEADER: Final = b"\x55\xaa"


def _message_layout(length: int, temperature_at: int) -> np.dtype[np.void]:
    """Return the structured dtype of messages with ``length`` bytes. Rates and accelerations alternate."""
    fields = {
        "header": ("S2", 0),
        "count": (">u2", 2),
        "values": (">6f4", 4),
        "temperature": (">f4", temperature_at),
        "errors": (">u2", length - 4),
    }
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": length})


LAYOUTS: Final = {68: _message_layout(68, temperature_at=32), 40: _message_layout(40, temperature_at=28)}
"""Structured dtype of the messages for each length in bytes."""
ORDER: Final = (0, 2, 4, 1, 3, 5)
"""Position of each axis among the values of a message, in the order of ``AXES``."""
STEPS: Final = np.repeat([DEGREE, G0], 3)
"""Factors that convert °/s to rad/s and g to m/s² for each axis [6]."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    length: Literal[68, 40] = Field(
        68, description="number of bytes of a message: 68, or 40 without auxiliary voltage and increments"
    )


class SiliconSensingDmuDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of DMU11 messages."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(HEADER, self._match_message, settings.length)
        self._layout = LAYOUTS[settings.length]
        self.timing: Timing = CounterTimedFormat(1 << 16)
        self._errors = 0

    @property
    def recent_problem(self) -> str:
        """Error flags of the sensor, or reason why messages were rejected; "" if there is no problem."""
        if self._errors:
            return f"the sensor reports the error flags 0x{self._errors:04X}"
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        messages = np.frombuffer(b"".join(frames.data), self._layout)
        self._errors = int(messages["errors"][-1])
        with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
            values = base.nan_to_infinity(messages["values"][:, ORDER].astype(np.float64)) * STEPS
            temperature_c = messages["temperature"].astype(np.float64)
        count = messages["count"].astype(np.int64)
        return self._builder.build_plausible_blocks(frames.t_ns, values, temperature_c, count, frames.bad_before)

    def _match_message(self, buffer: bytes, at: int) -> int:
        length = self._layout.itemsize
        if len(buffer) < at + length:
            return base.NEED_MORE
        return base.REJECT if _sum_of_words(buffer[at : at + length]) else length

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one message. Increments and the auxiliary voltage are 0."""
        rows = np.zeros(len(samples), self._layout)
        rows["header"], rows["count"] = HEADER, samples.ticks & 0xFFFF
        rows["values"][:, ORDER] = samples.values / STEPS
        rows["temperature"] = samples.temperature_c
        return base.make_chunks([append_checksum(row.tobytes()[:-2]) for row in rows], samples.t_ns)


def append_checksum(body: bytes) -> bytes:
    """Return a message that consists of ``body`` and its checksum."""
    return body + (-_sum_of_words(body) & 0xFFFF).to_bytes(2, "big")


def _sum_of_words(data: bytes) -> int:
    """Return the sum of the 16-bit words modulo 65536."""
    words: tuple[int, ...] = struct.unpack(f">{len(data) // 2}H", data)
    return sum(words) & 0xFFFF


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of DMU11 messages with the given settings."""
    return SiliconSensingDmuDecoder(settings)
