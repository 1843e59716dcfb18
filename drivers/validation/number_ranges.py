"""Units and supported ranges of numbers in options, configuration files, model files and recordings.

Each number is checked against one of the ranges in this module, so that no computation overflows, divides by zero or
runs out of memory. The ranges are wider than the values of any known sensor or application. Products, squares and
quotients of numbers within the ranges are finite.

The type annotation of a settings field contains the range, for example ``Annotated[float, RATE_HZ]``. pydantic then
calls ``NumberRange.check``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, Final, TypeVar

from drivers.errors import ConfigError

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema

Number = TypeVar("Number", int, float)

HOUR_S: Final = 3600
"""Seconds per hour."""
DAY_S: Final = 86_400
"""Seconds per day."""
PREFIXED_UNITS: Final = ("Hz", "bit/s", "byte/s", "byte")
"""Units that are written with the prefixes k, M, G and T."""
PREFIXES: Final = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))
"""Factors and names of the prefixes, largest first."""
MAX_WRITTEN_INTEGER: Final = 1 << 64
"""Largest integer that an error message quotes. A larger integer may have thousands of digits."""
MAX_QUOTED_CHARACTERS: Final = 60
"""Maximum number of characters of a value that an error message quotes."""


@dataclass(frozen=True, slots=True)
class NumberRange:
    """Unit and supported range of a number. The range includes both limits.

    >>> RATE_HZ.check(200.0)
    200.0
    >>> RATE_HZ.check(1e300)
    Traceback (most recent call last):
    drivers.errors.ConfigError: 1e+300 Hz is outside the supported range 0.001 Hz to 1 MHz
    """

    unit: str  # "" for a number without a unit
    low: float
    high: float
    zero: bool = False  # True if 0 is also supported, with a special meaning
    signed: bool = False  # True if the range applies to the absolute value

    def check(self, value: Number) -> Number:
        """Return the value if it is in the supported range.

        Raises
        ------
        ConfigError
            If the value is NaN or outside the supported range. The error text contains the value and the range.
        """
        if self.supports(value):
            return value
        raise ConfigError(f"{_number_text(value, self.unit)} is outside the supported range {self.format_range()}")

    def supports(self, value: float) -> bool:
        """Return True if the value is in the supported range. Return False for NaN."""
        size = abs(value) if self.signed else value
        return self.low <= size <= self.high or (self.zero and value == 0)

    def format_range(self) -> str:
        """Return the supported range and the unit as text for messages.

        >>> DURATION_S.format_range(), SILENCE_S.format_range()
        ('1 µs to 36525 d', '1 ms to 36525 d, or 0')
        """
        sign = "±" if self.signed else ""
        ends = f"{sign}{self.low:g} to {sign}{self.high:g} {self.unit}".rstrip()
        if self.unit in PREFIXED_UNITS or self.unit == "s":
            ends = f"{_number_text(self.low, self.unit)} to {_number_text(self.high, self.unit)}"
        return f"{ends}, or 0" if self.zero else ends

    def __get_pydantic_core_schema__(self, source: Any, handler: "GetCoreSchemaHandler") -> "CoreSchema":
        """Return the pydantic schema of a field with the type ``Annotated[float, self]``."""
        from pydantic_core import ValidationError, core_schema

        kind = "a whole number" if source is int else "a number"

        def convert_and_check(value: Any, convert: Callable[[Any], Any]) -> Any:
            try:
                number = convert(value)
            except ValidationError:
                raise ConfigError(f"expected {kind} from {self.format_range()}, got {format_value(value)}") from None
            return self.check(number)

        return core_schema.no_info_wrap_validator_function(convert_and_check, handler(source))


# --- time and rates

RATE_HZ: Final = NumberRange("Hz", 1e-3, 1e6)
"""Sample rate, from about one sample per quarter of an hour to far more than the fastest vibration sensors (30 kHz)."""
EFFECT_FREQUENCY_HZ: Final = NumberRange("Hz", 1e-12, 1e6, zero=True)
"""Frequency of a spectral line or of random events in a noise model; 0 = none."""
UPDATE_RATE_HZ: Final = NumberRange("Hz", 1e-6, 1e6)
"""Rate at which results are published."""
DURATION_S: Final = NumberRange("s", 1e-6, 36_525.0 * DAY_S)
"""Duration, from one period of the highest sample rate to a century."""
AVERAGING_TIME_S: Final = NumberRange("s", 1e-6, 36_525.0 * DAY_S)
"""Averaging time τ of the Allan variance."""
DELAY_S: Final = NumberRange("s", 1e-6, 36_525.0 * DAY_S, zero=True)
"""Delay after a start; 0 = no delay."""
SILENCE_S: Final = NumberRange("s", 1e-3, 36_525.0 * DAY_S, zero=True)
"""Time without data after which the program reacts; 0 = never."""
RUN_TIME_S: Final = NumberRange("s", 0.1, 36_525.0 * DAY_S)
"""Time after which a command ends automatically."""
JITTER_S: Final = NumberRange("s", 0.0, 0.5)
READ_TIMEOUT_S: Final = NumberRange("s", 1e-4, 0.1)
"""Longest wait of one read from a serial port. Closing a port without ``cancel_read`` may take this long."""
TICK_S: Final = NumberRange("s", 1e-12, DAY_S)
"""Duration of one count of a device clock."""

# --- transmission

BIT_RATE: Final = NumberRange("bit/s", 1, 1_000_000_000)
REQUEST_RATE_HZ: Final = NumberRange("Hz", 1e-3, 1e4)
"""Rate of requests to a sensor that sends data only as an answer."""
BYTE_RATE: Final = NumberRange("byte/s", 1.0, 1e9)
PORT: Final = NumberRange("", 0, 65_535)
"""TCP or UDP port."""
ROS_DOMAIN: Final = NumberRange("", 0, 232)
"""Domain of ROS 2. The maximum is that of DDS."""
SIZE_BYTES: Final = NumberRange("byte", 1e6, 1e15)
"""Memory limit."""

# --- counts and factors

FRACTION: Final = NumberRange("", 0.0, 1.0)
POSITIVE_SHARE: Final = NumberRange("", 1e-6, 1.0)
PERCENT: Final = NumberRange("%", 1.0, 100.0)
SEED: Final = NumberRange("", 0, (1 << 63) - 1)
WORKERS: Final = NumberRange("", 1, 64)
"""Number of worker processes."""
SAMPLE_COUNT: Final = NumberRange("samples", 1, 10_000_000_000)
"""Number of samples of a simulated recording."""
COUNTER_MODULUS: Final = NumberRange("counts", 2, 1 << 62)
"""Number of counts after which a device counter wraps to 0."""
COUNTER_STEP: Final = NumberRange("counts", 1e-9, 1 << 62)
"""Increase of a device counter from one sample to the next."""
MAVLINK_ID: Final = NumberRange("", 0, 255)
"""System, component or instance number of MAVLink."""
SOURCE_ADDRESS: Final = NumberRange("", 0, 255)
"""Source address of SAE J1939."""
HEADER_LINES: Final = NumberRange("lines", 0, 1_000_000)
ALARMS_PER_DAY: Final = NumberRange("a day", 1e-6, 1e4, zero=True)
"""Rate of false alarms per day; 0 = detection is off."""
REPLAY_SPEED: Final = NumberRange("times", 1e-3, 1e6)
"""Speed of a replay relative to real time."""
SIMULATION_SPEED: Final = NumberRange("times", 1e-3, 1e4)
RATE_RATIO: Final = NumberRange("", 1e-3, 1e3)
"""True sample rate divided by the stated sample rate."""
CLOCK_RATIO: Final = NumberRange("", 0.5, 2.0)
INFLATION: Final = NumberRange("", 1.0, 1e6)
SCALE: Final = NumberRange("", 1e-15, 1e15, signed=True)
"""Factor that converts the raw numbers of a device to a unit."""
OFFSET: Final = NumberRange("", 1e-15, 1e15, zero=True, signed=True)
"""Number that is added to the raw numbers of a device."""
NOISE_RATIO: Final = NumberRange("times", 1e-6, 1e6)
"""Ratio of two noise levels."""

# --- measured quantities and noise

FULL_SCALE: Final = NumberRange("", 1e-3, 1e6)
"""Full scale of a sensor, in g or °/s."""
COEFFICIENT: Final = NumberRange("", 1e-30, 1e30)
"""Noise coefficient in SI units. The range covers every sensor, and squares and quotients are finite."""
PARAMETER: Final = NumberRange("", 1e-30, 1e30, zero=True, signed=True)
"""Parameter of a noise model in SI units."""
FIT_NUMBER: Final = NumberRange("", 0.0, 1e30, signed=True)
"""Number in a file that contains a fitted model."""
TEMPERATURE_C: Final = NumberRange("°C", -273.15, 2_000.0)


def format_value(value: object) -> str:
    """Return a value in TOML syntax. Long text is shortened, and a list or a table becomes "a list" or "a table".

    >>> format_value(True), format_value("x"), format_value([1, 2])
    ('true', '"x"', 'a list')
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        ellipsis = "…" if len(value) > MAX_QUOTED_CHARACTERS else ""
        return f'"{value[:MAX_QUOTED_CHARACTERS]}{ellipsis}"'
    if isinstance(value, list | tuple | dict):
        return "a table" if isinstance(value, dict) else "a list"
    if isinstance(value, int) and abs(value) > MAX_WRITTEN_INTEGER:
        return "an integer of more than 64 bits"
    return str(value)[:MAX_QUOTED_CHARACTERS]


def _number_text(value: float, unit: str) -> str:
    """Return a number with a unit as text.

    >>> _number_text(2e6, "Hz"), _number_text(0.25, "s"), _number_text(172_800.0, "s"), _number_text(10**400, "")
    ('2 MHz', '250 ms', '2 d', 'an integer of more than 64 bits')
    """
    if isinstance(value, int) and abs(value) > MAX_WRITTEN_INTEGER:
        return "an integer of more than 64 bits"
    if unit in PREFIXED_UNITS and isfinite(value) and value < 1e15:
        for factor, prefix in PREFIXES:
            if value >= factor:
                return f"{value / factor:g} {prefix}{unit}"
    if unit == "s" and 0.0 < value < 1e12:
        for factor, name in ((DAY_S, "d"), (1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
            if value >= factor:
                return f"{value / factor:g} {name}"
    return f"{value:g} {unit}".rstrip()
