"""Settings of the text decoder, with the presets of known boards."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import AfterValidator, Field

from drivers import units
from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.host.extras import require_extra
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.number_ranges import COUNTER_MODULUS, HEADER_LINES, OFFSET, SCALE
from drivers.validation.settings_model import Conflict, ListOf, SettingsModel, checked_by, fields_by_key, one_of

SKIP: Final = "-"
COLUMNS: Final = (*AXES, "temperature", "t", "counter", SKIP)
TICK_S: Final = 1e-9
"""Duration of one tick in s. The time in the column ``t`` is converted to ticks of 1 ns."""

# MPU-6000 and MPU-6050 register map and descriptions (RM-MPU-6000A-00): sensitivities and temperature.
MPU6050_COUNTS_PER_DEG_S: Final[Mapping[int, float]] = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
MPU6050_COUNTS_PER_G: Final[Mapping[int, int]] = {2: 16384, 4: 8192, 8: 4096, 16: 2048}
MPU6050_COUNTS_PER_C, MPU6050_ZERO_COUNT_C = 340.0, 36.53


def _check_columns(columns: tuple[str, ...]) -> None:
    given = [name for name in columns if name != SKIP]
    wrong = [
        f'unknown column "{name}"{format_choices_by_similarity(name, COLUMNS)}' for name in given if name not in COLUMNS
    ]
    if len(given) != len(set(given)):
        wrong.append("a name is given twice")
    if not set(given) & set(AXES):
        wrong.append(f"none of {', '.join(AXES)} is given")
    if {"t", "counter"} <= set(given):
        wrong.append('give one of t and counter, and "-" for the other')
    if wrong:
        raise ConfigError(*wrong)


def _unit(look_up: Callable[[str], object], axis: str) -> AfterValidator:
    """Return a validator for the unit of a column. The error message also explains the conversion of raw counts."""

    def check_unit(unit: str) -> None:
        try:
            look_up(unit)
        except ConfigError as error:
            counts = f"name one of these units, and the size of a count: scale = {{ {axis} = 0.0305 }}"
            raise ConfigError(f"{error}; for raw counts {counts}") from error

    return checked_by(check_unit)


def _check_delimiter(delimiter: str) -> None:
    if not delimiter or not delimiter.isascii() or set(delimiter) & set("\r\n"):
        raise ConfigError(f"{delimiter!r}; it is auto, or ASCII text within a line")


def compile_pattern(pattern: str) -> Any:
    """Compile a regular expression of RE2. Raise ConfigError if the expression is invalid or RE2 is missing."""
    require_extra("pattern", "pattern")
    import re2

    options = re2.Options()
    options.log_errors = False
    try:
        return re2.compile(pattern, options)
    except re2.error as error:
        reason = error.args[0].decode(errors="replace") if isinstance(error.args[0], bytes) else error
        raise ConfigError(f"not a regular expression of RE2 (github.com/google/re2/wiki/Syntax): {reason}") from error


def _check_pattern(pattern: str) -> None:
    if pattern:
        _check_columns(tuple(compile_pattern(pattern).groupindex))


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    columns: Annotated[ListOf[str], checked_by(_check_columns)] = Field(
        (),
        examples=[["gx", "gy", "gz", "ax", "ay", "az"]],
        description="content of each column: gx gy gz ax ay az temperature t counter, - to skip a column",
    )
    pattern: Annotated[str, checked_by(_check_pattern)] = Field(
        "",
        examples=["GyX = (?P<gx>[-.0-9]+).*AcX = (?P<ax>[-.0-9]+)"],
        description="instead of columns: regular expression (RE2) whose groups are named as the columns",
    )
    preset: Literal["none", "mpu6050_raw"] = Field(
        "none",
        description="mpu6050_raw: units, scale and offset of the raw counts of an MPU-6050, by default in the columns "
        "ax ay az gx gy gz; keys with other values than the default take precedence",
    )
    gyro_range: Literal[250, 500, 1000, 2000] = Field(250, description="full scale of an MPU-6050 in °/s")
    accelerometer_range: Literal[2, 4, 8, 16] = Field(2, description="full scale of an MPU-6050 in g")
    delimiter: Annotated[str, checked_by(_check_delimiter)] = Field(
        "auto",
        description='text between two fields, " " = any number of blanks; auto: comma, semicolon, tab or blanks',
    )
    gyro_unit: Annotated[str, _unit(units.angular_rate_factor, "gx")] = Field(
        "rad/s", description=f"unit of gx gy gz: {', '.join(units.RATE)}"
    )
    accel_unit: Annotated[str, _unit(units.acceleration_factor, "ax")] = Field(
        "m/s²", description=f"unit of ax ay az: {', '.join(units.ACCELERATION)}"
    )
    temperature_unit: Annotated[str, _unit(units.temperature_factor_and_offset, "temperature")] = Field(
        "°C", description=f"unit of the temperature: {', '.join(units.TEMPERATURE)}"
    )
    scale: dict[Annotated[str, one_of(COLUMNS)], Annotated[float, SCALE]] = Field(
        {},
        examples=[{"gx": 0.0305}],
        description="factor of a column before its unit is applied, such as the size of a raw count; absent: 1",
    )
    offset: dict[Annotated[str, one_of(COLUMNS)], Annotated[float, OFFSET]] = Field(
        {},
        examples=[{"temperature": 36.53}],
        description="number added to a column after scale and before its unit is applied; absent: 0",
    )
    comment: str = Field("#", description='lines that begin with this text are skipped; "" = none')
    header: Annotated[int, HEADER_LINES] = Field(0, description="number of lines to skip after the link was opened")
    first_line: Literal["drop", "keep"] = Field(
        "drop", description="drop: skip the first line after the link was opened, because its start can be missing"
    )
    nmea: bool = Field(False, description="true: lines have the form $fields*CC with a checksum")
    time_unit: Literal["s", "ms", "us", "ns"] = Field("s", description="unit of column t, the clock of the device")
    counter_modulus: Annotated[int, COUNTER_MODULUS] = Field(
        1 << 32, description="number of counts after which the column counter starts again at 0"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if the columns are missing or are given twice."""
        if self.pattern and self.columns:
            yield Conflict("pattern", "give either columns or pattern", ("columns",))
        if not self.pattern and not self.columns and self.preset == "none":
            yield Conflict("columns", 'missing; give columns, such as ["gx", "gy", "gz"], or pattern, or preset')


def apply_preset(settings: Settings) -> Settings:
    """Return the settings with the values of the preset for all keys that have their default values."""
    if settings.preset == "none":
        return settings
    preset = {
        "gyro_unit": f"deg/s/{MPU6050_COUNTS_PER_DEG_S[settings.gyro_range]}",
        "accel_unit": f"g/{MPU6050_COUNTS_PER_G[settings.accelerometer_range]}",
        "columns": () if settings.pattern else ("ax", "ay", "az", "gx", "gy", "gz"),
    }
    defaults = fields_by_key(Settings)
    return settings.model_copy(
        update={key: value for key, value in preset.items() if getattr(settings, key) == defaults[key].default}
        | {
            "scale": {"temperature": 1.0 / MPU6050_COUNTS_PER_C, **settings.scale},
            "offset": {"temperature": MPU6050_ZERO_COUNT_C, **settings.offset},
        }
    )


def compute_factors_and_offsets(settings: Settings, columns: Sequence[str]) -> tuple[Floats, Floats]:
    """Return the factors [n] and offsets [n] that convert n columns to SI units, and the column ``t`` to ticks.

    Parameters
    ----------
    settings
        Settings with units, scales and offsets.
    columns
        Names of the n columns.
    """
    factors, offsets = np.ones(len(columns)), np.zeros(len(columns))
    for i, name in enumerate(columns):
        factor, offset = 1.0, 0.0
        if name in AXES[:3]:
            factor = units.angular_rate_factor(settings.gyro_unit)
        elif name in AXES[3:]:
            factor = units.acceleration_factor(settings.accel_unit)
        elif name == "temperature":
            factor, offset = units.temperature_factor_and_offset(settings.temperature_unit)
        elif name == "t":
            factor = round(units.time_factor(settings.time_unit) / TICK_S)
        factors[i] = factor * settings.scale.get(name, 1.0)
        offsets[i] = factor * settings.offset.get(name, 0.0) + offset
    return factors, offsets
