r"""VectorNav VN-100/200/300 ASCII sentences ``$VNIMU`` and ``$VNYMR``.

A sentence is ``$VNxxx,f1,f2,...*CC\r\n``. The checksum CC covers the characters between ``$`` and ``*``. A checksum of
two hexadecimal digits is the exclusive or of the characters. A checksum of four digits is a CRC-16 with the polynomial
0x1021 and the initial value 0. Only a host may send ``*XX`` ("do not check"), so a received ``*XX`` is rejected. A
sentence may end in LF alone. Other sentences with a correct checksum are ignored (VN-100 user manual UM001 v2.1, pages
27-43).

``$VNIMU`` contains the measured magnetic field [Gauss], acceleration [m/s²], angular rate [rad/s], temperature [°C] and
pressure [kPa]. ``$VNYMR`` contains yaw, pitch, roll [°], and the magnetic field, acceleration and angular rate after
compensation by the on-board filter. The bias instability and random walk of ``$VNYMR`` values describe the on-board
filter and not the sensor. A synchronization count or time at the end of a sentence is ignored. The printed resolution
is 0.001 m/s² and 1e-6 rad/s, so the Allan deviation shows quantization noise. Binary messages have a finer resolution.
"""

import binascii
from typing import Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import ArrivalTimedFormat, Chunk, Floats, SampleBlock, Timing
from drivers.decoders import base
from drivers.validation.settings_model import SettingsModel

LONGEST: Final = 256
"""Maximum length of a sentence in bytes. The longest sentence in the manual has fewer than 200 bytes."""

COLUMNS: Final = {
    b"$VNIMU,": ((6, 7, 8, 3, 4, 5), 11, 9),
    b"$VNYMR,": ((9, 10, 11, 6, 7, 8), 12, None),
}
"""For each sentence: the columns of gx gy gz ax ay az, the number of columns, and the column of the temperature."""
MAX_UNWANTED_SENTENCES: Final = 100
"""Number of consecutive sentences of other types after which a problem is reported."""
GYRO: Final = "{:+010.6f}"  # rad/s
ACCEL: Final = "{:+07.3f}"  # m/s²


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    sentence: Literal["auto", "VNIMU", "VNYMR"] = Field(
        "auto", description="sentence to read; auto: the sentence that arrives first"
    )


class VectornavAsciiDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of VectorNav sentences."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(b"$VN", _match_sentence, LONGEST)
        self.timing: Timing = ArrivalTimedFormat()
        self._wanted = b"" if settings.sentence == "auto" else f"${settings.sentence},".encode()
        self._sentence = self._wanted
        self._unwanted_sentences = 0  # number of sentences of other types since the last sample

    @property
    def recent_problem(self) -> str:
        """Reason why samples are missing or sentences were rejected; "" if there is no problem."""
        if self._unwanted_sentences > MAX_UNWANTED_SENTENCES:
            return "sentences arrive, but none of the wanted kind: set the sensor's async output to VNIMU"
        return super().recent_problem

    @property
    def on_board_filter_note(self) -> str:
        """Note that ``$VNYMR`` contains corrected values; "" for ``$VNIMU``."""
        return f"{base.ON_BOARD_FILTER_NOTE}; select $VNIMU" if self._sentence == b"$VNYMR," else ""

    def forget_stream_state(self) -> None:
        """Discard a partially received sentence. With ``sentence = "auto"``, select the sentence type again."""
        super().forget_stream_state()
        self._sentence = self._wanted

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        if not self._sentence:
            self._sentence = next((f[:7] for f in frames.data if f[:7] in COLUMNS), b"")
        wanted = self._sentence or b"none yet"
        rows = [i for i, f in enumerate(frames.data) if f.startswith(wanted)]
        self._unwanted_sentences = 0 if rows else self._unwanted_sentences + len(frames.data)
        frames = frames.select_frames(rows)
        axes, width, temperature = COLUMNS.get(self._sentence, COLUMNS[b"$VNIMU,"])
        table = _parse_numbers([f[7 : f.rindex(b"*")] for f in frames.data], width)
        temperature_c = None if temperature is None else table[:, temperature]
        values = base.nan_to_infinity(table[:, axes])
        return self._builder.build_plausible_blocks(
            frames.t_ns, values, temperature_c, None, frames.bad_before, frames.bad_after
        )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode samples as VNYMR or VNIMU sentences. A missing temperature is sent as 0."""
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
            frames.append(b"$%b*%02X\r\n" % (body, base.xor_checksum(body)))
        return base.make_chunks(frames, samples.t_ns)


def _parse_numbers(bodies: list[bytes], width: int) -> Floats:
    """Return the first ``width`` numbers of each sentence, or infinity for a sentence that is not numeric."""
    split = [body.split(b",", width)[:width] for body in bodies]
    try:
        return np.array([[float(field) for field in fields] for fields in split]).reshape(len(bodies), width)
    except ValueError:
        return np.array([_parse_fields(fields, width) for fields in split])


def _parse_fields(fields: list[bytes], width: int) -> list[float]:
    """Return the numbers of one sentence, or infinity if a field is missing or is not a number."""
    try:
        row = [float(field) for field in fields]
    except ValueError:
        row = []
    return row if len(row) == width else [np.inf] * width


def _match_sentence(buffer: bytes, at: int) -> int:
    end = buffer.find(b"\n", at, at + LONGEST) + 1
    if not end:
        return base.NEED_MORE
    star = buffer.rfind(b"*", at, end)
    if star < 0:
        return base.REJECT
    body = buffer[at + 1 : star]
    stated = buffer[star + 1 : end - 1].removesuffix(b"\r")
    if len(stated) == 2:
        return end - at if b"%02X" % base.xor_checksum(body) == stated else base.REJECT
    return end - at if b"%04X" % binascii.crc_hqx(body, 0) == stated else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of VectorNav sentences with the given settings."""
    return VectornavAsciiDecoder(settings)
