"""Epson inertial sensors M-G3xx and M-G570 in UART auto mode.

A burst is big-endian: ``80 | fields | checksum u16 | 0D``. The registers BURST_CTRL1 and BURST_CTRL2 of the sensor
select the fields and their widths, which therefore must be configured here as well. The fields are always in the order
of the table ``FIELDS``. The checksum is the sum of the 16-bit words between header and checksum, modulo 65536. Sources:
data sheet of the M-G362 (rev. 20131217, tables 6.7 and 6.14), and Epson's public drivers cubicleguy/ess_imu_driver,
cubicleguy/py_esensorlib and cubicleguy/su_arduino_uart. The M-V340 has another format without a checksum and is not
supported.

The value of one LSB depends on the model. The table ``MODELS`` contains the values for 16-bit numbers. One LSB of a
32-bit number is smaller by a factor of 65536. Some models have two accelerometer ranges, so the range must be
configured. The drivers state the scale of some gyroscopes either as 1/66 °/s or as the rounded number 0.0151515 °/s.
The decoder uses 1/66 °/s. The driver py_esensorlib 2.1.0 and this decoder return the same values for every model.

The field ``count`` is a 16-bit counter of samples. The public sources do not state whether each output sample advances
the counter by one, so missing samples are computed from the usual step. If an external signal resets the counter,
``count`` is the time since the last reset in steps of 16 µs or 21.3 µs. In this case the key ``clock`` must be
"arrival".

Bit 0 of the flags reports an error of the sensor. A sample with this bit is bad. Bits 15 to 9 mark new data and are not
used, because the sensor sends each sample once in auto mode.
"""

import struct
from collections.abc import Iterator
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, Timing
from drivers.decoders import base
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.settings_model import Conflict, ListOf, SettingsModel, checked_by

HEADER: Final = b"\x80"
DELIMITER: Final = 0x0D

NUMBERS: Final = {
    "temperature": 1,
    "gyro": 3,
    "accel": 3,
    "delta_angle": 3,
    "delta_velocity": 3,
    "quaternion": 4,
    "attitude": 3,
}
"""Number of values in each field of 16-bit or 32-bit values."""
FIELDS: Final = ("flags", *NUMBERS, "gpio", "count")
"""Fields of a burst in the order of transmission. Fields that are not in ``NUMBERS`` have 16 bits."""
NEW_DATA_FLAGS: Final = 0xFE00
ERROR_FLAG: Final = 0x0001


class Model(NamedTuple):
    """Value of one LSB of the 16-bit numbers of a sensor model."""

    gyro_deg_s: float
    accel_mg: float
    temperature_c: float
    zero: int  # number that stands for 25 °C
    accel_16g_mg: float | None = None  # accelerometer LSB in the range of 16 g; None if there is only one range


ModelName = Literal[
    "g320",
    "g330pdg0",
    "g354",
    "g355qdg0",
    "g364pdc0",
    "g364pdca",
    "g365pdc1",
    "g365pdf1",
    "g366pdg0",
    "g370pdf1",
    "g370pdg0",
    "g370pds0",
    "g370pdt0",
    "g570pr20",
]
MODELS: Final[dict[ModelName, Model]] = {
    "g320": Model(0.008, 0.2, -0.0037918, 2634),
    "g330pdg0": Model(1 / 66, 0.25, 2.0**-8, 0, 0.5),
    "g354": Model(0.016, 0.2, -0.0037918, 2634),
    "g355qdg0": Model(1 / 66, 0.25, 2.0**-8, 0, 0.5),
    "g364pdc0": Model(0.0075, 0.125, -0.0037918, 2634),
    "g364pdca": Model(0.00375, 0.125, -0.0037918, 2634),
    "g365pdc1": Model(1 / 66, 0.16, -0.0037918, 2634),
    "g365pdf1": Model(1 / 66, 0.4, -0.0037918, 2634),
    "g366pdg0": Model(1 / 66, 0.25, 2.0**-8, 0, 0.5),
    "g370pdf1": Model(1 / 66, 0.4, -0.0037918, 2634),
    "g370pdg0": Model(1 / 66, 0.25, 2.0**-8, 0, 0.5),
    "g370pds0": Model(1 / 150, 0.4, -0.0037918, 2634),
    "g370pdt0": Model(1 / 150, 0.25, 2.0**-8, 0, 0.5),
    "g570pr20": Model(1 / 66, 0.5, 2.0**-8, 0),
}


def _check_fields(fields: tuple[str, ...]) -> None:
    unknown = [name for name in fields if name not in FIELDS]
    wrong = [f'unknown field "{name}"{format_choices_by_similarity(name, FIELDS)}' for name in unknown]
    if len(fields) != len(set(fields)):
        wrong.append("a name is given twice")
    if not {"gyro", "accel"} & set(fields):
        wrong.append("neither gyro nor accel is given")
    if wrong:
        raise ConfigError(*wrong)


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    model: ModelName = Field(examples=["g366pdg0"], description="sensor model, which determines the scales")
    fields: Annotated[ListOf[str], checked_by(_check_fields)] = Field(
        ("flags", "temperature", "gyro", "accel", "gpio", "count"),
        description=f"fields that the sensor sends before the checksum: {' '.join(FIELDS)}",
    )
    bits: Literal[16, 32] = Field(
        16, description="number of bits of temperatures, rates, accelerations and other numbers"
    )
    accelerometer_range: Literal["8g", "16g"] = Field(
        "8g", description="accelerometer range, for models with two ranges"
    )
    clock: Literal["count", "arrival"] = Field(
        "count", description="source of the sample times; use arrival if an external signal resets the counter"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if the counter is not sent or the model has a single accelerometer range."""
        if self.clock == "count" and "count" not in self.fields:
            yield Conflict("clock", '"count" needs the field count; add it to fields, or set clock = "arrival"')
        if self.accelerometer_range == "16g" and MODELS[self.model].accel_16g_mg is None:
            yield Conflict("accelerometer_range", f"{self.model} has no range of 16g; remove this key")


class EpsonUartDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of Epson bursts."""

    def __init__(self, settings: Settings) -> None:
        self._layout = _burst_layout(settings)
        super().__init__(HEADER, self._match_burst, self._layout.itemsize)
        self._fields = settings.fields
        self._uses_count = settings.clock == "count"
        self.timing: Timing = CounterTimedFormat(1 << 16) if self._uses_count else ArrivalTimedFormat()
        self._bits = settings.bits
        model, divisor = MODELS[settings.model], 1 << (settings.bits - 16)
        accel_mg = model.accel_mg
        if settings.accelerometer_range == "16g" and model.accel_16g_mg is not None:
            accel_mg = model.accel_16g_mg
        self._steps = {"gyro": DEGREE * model.gyro_deg_s / divisor, "accel": 1e-3 * G0 * accel_mg / divisor}
        self._temperature_step = model.temperature_c / divisor
        self._temperature_offset = 25.0 - model.zero * model.temperature_c
        self._sensor_error = False

    @property
    def recent_problem(self) -> str:
        """Error of the sensor, or reason why bursts were rejected; "" if there is no problem."""
        return "the sensor reports an error in its flags" if self._sensor_error else super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        n = len(frames.data)
        bursts = np.frombuffer(b"".join(frames.data), self._layout)
        values = np.full((n, 6), np.nan)
        temperature_c = np.full(n, np.nan)
        ticks = np.full(n, NO_TICK, np.int64)
        for field, axes in (("gyro", slice(0, 3)), ("accel", slice(3, 6))):
            if field in self._fields:
                values[:, axes] = bursts[field] * self._steps[field]
        if "temperature" in self._fields:
            temperature_c = bursts["temperature"][:, 0] * self._temperature_step + self._temperature_offset
        if "flags" in self._fields:
            error = bursts["flags"] & ERROR_FLAG != 0
            values[error] = np.inf
            self._sensor_error = bool(error[-1])
        if self._uses_count:
            ticks = bursts["count"].astype(np.int64)
        return self._builder.build_plausible_blocks(frames.t_ns, values, temperature_c, ticks, frames.bad_before)

    def _match_burst(self, buffer: bytes, at: int) -> int:
        length = self._layout.itemsize
        if len(buffer) < at + length:
            return base.NEED_MORE
        is_valid = (
            buffer[at + length - 1] == DELIMITER
            and burst_checksum(buffer[at + 1 : at + length - 3]) == buffer[at + length - 3 : at + length - 1]
        )
        return length if is_valid else base.REJECT

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one burst. The flags report an error if an axis of the burst is not measured."""
        rows = np.zeros(len(samples), self._layout)
        sent = [i for i in range(6) if ("gyro" if i < 3 else "accel") in self._fields]
        for field, axes in (("gyro", slice(0, 3)), ("accel", slice(3, 6))):
            if field in self._fields:
                rows[field] = base.quantize(samples.values[:, axes], self._steps[field], self._bits)
        if "temperature" in self._fields:
            excess = samples.temperature_c - self._temperature_offset
            rows["temperature"][:, 0] = base.quantize(excess, self._temperature_step, self._bits)
        if "flags" in self._fields:
            rows["flags"] = NEW_DATA_FLAGS | np.isnan(samples.values[:, sent]).any(axis=1) * ERROR_FLAG
        if "count" in self._fields:
            rows["count"] = samples.ticks & 0xFFFF
        return base.make_chunks([encode_burst(row.tobytes()[1:-3]) for row in rows], samples.t_ns)


def _burst_layout(settings: Settings) -> np.dtype[np.void]:
    """Return the structured dtype of a complete burst."""
    sent = [field for field in FIELDS if field in settings.fields]
    width = settings.bits // 8
    numbers = [(field, f">i{width}", (NUMBERS[field],)) if field in NUMBERS else (field, ">u2") for field in sent]
    return np.dtype([("header", "u1"), *numbers, ("checksum", ">u2"), ("delimiter", "u1")])


def encode_burst(content: bytes) -> bytes:
    """Return a burst with the given fields."""
    return HEADER + content + burst_checksum(content) + bytes([DELIMITER])


def burst_checksum(content: bytes) -> bytes:
    """Return the two checksum bytes of a burst with the given fields."""
    words: tuple[int, ...] = struct.unpack(f">{len(content) // 2}H", content)
    return (sum(words) & 0xFFFF).to_bytes(2, "big")


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of Epson bursts with the given settings."""
    return EpsonUartDecoder(settings)
