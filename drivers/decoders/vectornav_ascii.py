r"""VectorNav VN-100/200/300 ASCII sentences ``$VNIMU`` and ``$VNYMR``.

A sentence is ``$VNxxx,f1,f2,...*CC\r\n``. CC is the exclusive or of the characters between ``$`` and ``*`` in two hex
digits. Four digits are a CRC-16 of the same characters with the polynomial 0x1021 and the initial value 0. ``*XX`` ("do
not check") is only for the host. A device always computes its checksum, so ``*XX`` is rejected here. A line end that
was converted to LF is accepted. Other sentences with a correct checksum are ignored (VN-100 user manual UM001 v2.1,
pages 27-43).

``$VNIMU`` contains the magnetic field [Gauss], acceleration [m/s²], rate [rad/s], temperature [°C] and pressure [kPa]
as measured. ``$VNYMR`` contains yaw, pitch, roll [°], magnetic field, acceleration and rate, all compensated. Its bias
instability and random walk are the residuals of the on-board filter and do not describe the sensor. Data that may be
appended to a sentence (a count or time of synchronization) are ignored. The printed resolution is 0.001 m/s² and 1e-6
rad/s, so quantization is visible in the Allan deviation. Binary messages have a finer resolution.
"""

import binascii
from typing import Final, Literal

import numpy as np
from pydantic import Field

from drivers.decoders.base import (
    NEED_MORE,
    REJECT,
    Decoder,
    DecoderSettings,
    FrameBuffer,
    Frames,
    FrameStreamDecoder,
    chunk_per_sample,
    nan_to_infinity,
    xor_checksum,
)
from drivers.sample import ArrivalTimedFormat, Chunk, Floats, SampleBlock, Timing

LONGEST: Final = 256
"""Maximum length of a sentence in bytes. The longest sentence of the manual is under 200."""

COLUMNS: Final = {
    b"$VNIMU,": ((6, 7, 8, 3, 4, 5), 11, 9),
    b"$VNYMR,": ((9, 10, 11, 6, 7, 8), 12, None),
}
"""Columns of gx gy gz ax ay az in each sentence, number of columns, and column of the temperature."""
MAX_UNWANTED_SENTENCES: Final = 100
"""Number of consecutive unwanted sentences after which a hint is given."""
GYRO: Final = "{:+010.6f}"  # rad/s
ACCEL: Final = "{:+07.3f}"  # m/s²


class Settings(DecoderSettings):
    """Keys of ``[device.driver.decoder_options]``."""

    sentence: Literal["auto", "VNIMU", "VNYMR"] = Field(
        "auto", description="sentence to read; auto reads the first of the two that arrives"
    )


class VectornavAsciiDecoder(FrameStreamDecoder):
    """Decoder and encoder of VectorNav sentences."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(FrameBuffer(b"$VN", _match_sentence, LONGEST))
        self.timing: Timing = ArrivalTimedFormat()
        self._wanted = b"" if settings.sentence == "auto" else f"${settings.sentence},".encode()
        self._sentence = self._wanted
        self._unwanted_sentences = 0  # number of sentences since the last wanted sentence

    @property
    def recent_problem(self) -> str:
        """Reason for missing samples or rejected sentences."""
        if self._unwanted_sentences > MAX_UNWANTED_SENTENCES:
            return "sentences arrive, but none of the wanted kind: set the sensor's async output to VNIMU"
        return super().recent_problem

    def reset(self) -> None:
        """Discard an incomplete sentence, and with auto the selected sentence."""
        super().reset()
        self._sentence = self._wanted

    def _decode(self, frames: Frames) -> list[SampleBlock]:
        """Return the samples of the sentences of the wanted kind."""
        if not self._sentence:
            self._sentence = next((f[:7] for f in frames.data if f[:7] in COLUMNS), b"")
        wanted = self._sentence or b"none yet"
        rows = [i for i, f in enumerate(frames.data) if f.startswith(wanted)]
        self._unwanted_sentences = 0 if rows else self._unwanted_sentences + len(frames.data)
        frames = frames.select_frames(rows)
        axes, width, temperature = COLUMNS.get(self._sentence, COLUMNS[b"$VNIMU,"])
        table = _parse_numbers([f[7 : f.rindex(b"*")] for f in frames.data], width)
        temperature_c = None if temperature is None else table[:, temperature]
        values = nan_to_infinity(table[:, axes])
        return self._builder.build_plausible_blocks(
            frames.t_ns, values, temperature_c, None, frames.bad_before, frames.bad_after
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return sentences as the device prints them: VNYMR if it is configured, otherwise VNIMU.

        Unknown values are 0.
        """
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
            frames.append(b"$%b*%02X\r\n" % (body, xor_checksum(body)))
        return chunk_per_sample(frames, samples.t_ns)


def _parse_numbers(bodies: list[bytes], width: int) -> Floats:
    """Return the first ``width`` numbers of each sentence as an array. A sentence with other text gives infinities."""
    split = [body.split(b",", width)[:width] for body in bodies]
    try:
        return np.array([[float(field) for field in fields] for fields in split]).reshape(len(bodies), width)
    except ValueError:
        return np.array([_parse_fields(fields, width) for fields in split])


def _parse_fields(fields: list[bytes], width: int) -> list[float]:
    """Return the numbers of one sentence; infinities if a field is other text or the number of fields is wrong."""
    try:
        row = [float(field) for field in fields]
    except ValueError:
        row = []
    return row if len(row) == width else [np.inf] * width


def _match_sentence(buffer: bytes, at: int) -> int:
    """Return the length of a sentence (see ``drivers.decoders.base.FrameMatcher``)."""
    end = buffer.find(b"\n", at, at + LONGEST) + 1
    if not end:
        return NEED_MORE
    star = buffer.rfind(b"*", at, end)
    if star < 0:
        return REJECT
    body = buffer[at + 1 : star]
    stated = buffer[star + 1 : end - 1].removesuffix(b"\r")
    if len(stated) == 2:
        return end - at if b"%02X" % xor_checksum(body) == stated else REJECT
    return end - at if b"%04X" % binascii.crc_hqx(body, 0) == stated else REJECT


def build(settings: Settings) -> Decoder:
    """Return a decoder with these settings."""
    return VectornavAsciiDecoder(settings)
