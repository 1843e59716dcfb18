r"""VectorNav VN-100/200/300 ASCII sentences ``$VNIMU`` and ``$VNYMR``.

``$VNxxx,f1,f2,...*CC\r\n``: CC is the exclusive or of the characters between ``$`` and ``*`` in two hex
digits; four digits are a CRC-16 of polynomial 0x1021 and start 0 over the same. ``*XX`` ("do not check") is
for the host to send; a device always computes its checksum, so that it is rejected here. A line end that
was made LF on the way is taken too. Other sentences that pass their check are ignored (VN-100 user manual
UM001 v2.1, pages 27-43).

``$VNIMU``: magnetic field [Gauss], acceleration [m/s²], rate [rad/s], temperature [°C], pressure [kPa], as
the sensor measures. ``$VNYMR``: yaw, pitch, roll [°], magnetic field, acceleration, rate, compensated: the
bias instability and random walk in it are those left over by the on-board filter, not the sensor's.
What may be appended to a sentence (a count or time of synchronization) is not read. Printed resolution is
0.001 m/s² and 1e-6 rad/s: quantization shows in the Allan plot; the binary messages have none of it.
"""

import binascii
from collections.abc import Sequence
from typing import ClassVar, Final, Literal

import numpy as np

from drivers.decoders.base import (
    NEED_MORE,
    REJECT,
    Decoder,
    DecoderSettings,
    FrameBuffer,
    Rows,
    Unmeasured,
    invalid,
    one_chunk_each,
    xor,
)
from drivers.sample import Arrival, Chunk, Floats, SampleBlock, Timing

LONGEST: Final = 256
"""Bytes; the longest sentence of the manual is under 200."""

# columns of gx gy gz ax ay az in the sentence's numbers, how many numbers it has, column of the temperature
COLUMNS: Final = {
    b"$VNIMU,": ((6, 7, 8, 3, 4, 5), 11, 9),
    b"$VNYMR,": ((9, 10, 11, 6, 7, 8), 12, None),
}
GYRO: Final = "{:+010.6f}"  # rad/s
ACCEL: Final = "{:+07.3f}"  # m/s²


class Settings(DecoderSettings, frozen=True):
    """Keys of ``[device.driver.decoder_options]``."""

    sentence: Literal["auto", "VNIMU", "VNYMR"] = "auto"
    """The sentence to read; auto takes the first of the two that comes."""


class VectornavAsciiDecoder:
    """VectorNav sentences <-> SampleBlock."""

    carrier: ClassVar[str] = "bytes"

    def __init__(self, settings: Settings) -> None:
        self.timing: Timing = Arrival()
        self._wanted = b"" if settings.sentence == "auto" else f"${settings.sentence},".encode()
        self._sentence = self._wanted
        self._buffer = FrameBuffer(b"$VN", match, LONGEST)
        self._rows = Rows()
        self._others = 0  # sentences since the last one that was wanted

    @property
    def bad(self) -> int:
        """Sentences that failed their check, and samples that cannot be."""
        return self._rows.bad

    @property
    def hint(self) -> str:
        """Why there are no samples, or rejected ones."""
        if self._others > 100:
            return "sentences come, but none of those wanted: set the sensor's async output to VNIMU"
        return self._buffer.hint

    def reset(self) -> None:
        """Forget a half-received sentence, and with auto which sentence it was."""
        self._buffer.reset()
        self._rows.reset()
        self._sentence = self._wanted

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Samples of the sentences that these chunks complete."""
        frames = self._buffer.feed(chunks)
        if not self._sentence:
            self._sentence = next((f[:7] for f in frames.data if f[:7] in COLUMNS), b"")
        wanted = self._sentence or b"none yet"
        rows = [i for i, f in enumerate(frames.data) if f.startswith(wanted)]
        self._others = 0 if rows else self._others + len(frames.data)
        frames, bad_after = frames.keep(rows)
        if not rows and not bad_after:
            return []
        axes, width, warm = COLUMNS.get(self._sentence, COLUMNS[b"$VNIMU,"])
        table = numbers([f[7 : f.rindex(b"*")] for f in frames.data], width)
        temperature_c = Unmeasured.temperature(len(rows)) if warm is None else table[:, warm].copy()
        values = invalid(table[:, axes])
        ticks = Unmeasured.ticks(len(rows))
        return self._rows.blocks(frames.t_ns, values, temperature_c, ticks, frames.bad_before, bad_after)

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Sentences as the device prints them, VNIMU unless VNYMR is set; what is not known is sent as 0."""
        imu = self._wanted != b"$VNYMR,"
        frames = []
        temperatures = np.nan_to_num(samples.temperature_c).tolist()
        for row, temperature_c in zip(samples.values.tolist(), temperatures, strict=True):
            parts = [ACCEL.format(x) for x in row[3:]] + [GYRO.format(x) for x in row[:3]]
            magnetic = ["+00.0000"] * 3
            if imu:
                parts = ["VNIMU", *magnetic, *parts, f"{temperature_c:+05.1f}", "+101.325"]
            else:
                parts = ["VNYMR", *["+000.000"] * 3, *magnetic, *parts]
            body = ",".join(parts).encode()
            frames.append(b"$%b*%02X\r\n" % (body, xor(body)))
        return one_chunk_each(frames, samples.t_ns)


def numbers(bodies: list[bytes], width: int) -> Floats:
    """[n, width] of the first numbers of each body; a row that is not made of numbers is infinite."""
    split = [body.split(b",", width)[:width] for body in bodies]
    try:
        return np.array([[float(field) for field in fields] for fields in split]).reshape(len(bodies), width)
    except ValueError:
        return np.array([_row(fields, width) for fields in split])


def _row(fields: list[bytes], width: int) -> list[float]:
    try:
        row = [float(field) for field in fields]
    except ValueError:
        row = []
    return row if len(row) == width else [np.inf] * width


def match(buffer: bytes, at: int) -> int:
    """Length of the sentence at this place, if it is whole and its checksum holds."""
    end = buffer.find(b"\n", at, at + LONGEST) + 1
    if not end:
        return NEED_MORE
    star = buffer.rfind(b"*", at, end)
    if star < 0:
        return REJECT
    body = buffer[at + 1 : star]
    stated = buffer[star + 1 : end - 1].removesuffix(b"\r")
    if len(stated) == 2:
        return end - at if b"%02X" % xor(body) == stated else REJECT
    return end - at if b"%04X" % binascii.crc_hqx(body, 0) == stated else REJECT


def build(settings: Settings) -> Decoder:
    """A decoder with these settings."""
    return VectornavAsciiDecoder(settings)
