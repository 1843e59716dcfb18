"""Units of inertial navigation, data sheets and SI, and formatting of quantities, durations and numbers as text.

The program computes in SI units. Terminal output and figures use the units of inertial navigation, unless a command
is called with ``--units``. The conversion factors follow from 1
rad = 180/π ° and standard gravity, 1 g = 9.80665 m/s² (CGPM 1901).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Final, Literal, NamedTuple

import numpy as np

from drivers.data_types import AXES
from drivers.units import G0
from drivers.validation.number_ranges import DAY_S, HOUR_S

Kind = Literal["gyro", "accel"]
KINDS: Final[tuple[Kind, Kind]] = ("gyro", "accel")
KIND_NAMES: Final = {"gyro": "Gyroscopes", "accel": "Accelerometers"}
SHORT_KIND_NAMES: Final = {"gyro": "Gyro", "accel": "Accel"}
"""Names for titles and tables with little space."""

DEGREE: Final = 180.0 / math.pi  # degrees per radian
ROOT_HOUR: Final = 60.0  # √s per √h
MILLI_G: Final = 1e-3 * G0
MICRO_G: Final = 1e6 / G0  # µg per m/s²
NO_VALUE: Final = "—"
DURATION_UNITS: Final = ((DAY_S, "d"), (HOUR_S, "h"), (60, "min"), (1, "s"))
"""Units of durations [s], the largest first."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Customary unit with the conversion factor from SI units."""

    factor: float
    name: str

    def format_si_value(self, si_value: float, digits: int = 3) -> str:
        """Format a value in the customary unit.

        Parameters
        ----------
        si_value : float
            Value in SI units.
        digits : int, optional
            Number of significant digits.

        Examples
        --------
        >>> COEFFICIENT_UNITS["gyro"]["N"].format_si_value(1.5e-4)
        '0.516 °/√h'
        """
        return f"{format_number(si_value * self.factor, digits)} {self.name}"


COEFFICIENT_UNITS: Final[dict[Kind, dict[str, Unit]]] = {
    "gyro": {
        "Q": Unit(1e6, "µrad"),
        "N": Unit(DEGREE * ROOT_HOUR, "°/√h"),
        "B": Unit(DEGREE * HOUR_S, "°/h"),
        "K": Unit(DEGREE * HOUR_S * ROOT_HOUR, "°/h/√h"),
        "R": Unit(DEGREE * HOUR_S * HOUR_S, "°/h/h"),
    },
    "accel": {
        "Q": Unit(1e6, "µm/s"),
        "N": Unit(ROOT_HOUR, "m/s/√h"),
        "B": Unit(MICRO_G, "µg"),
        "K": Unit(MICRO_G * ROOT_HOUR, "µg/√h"),
        "R": Unit(MICRO_G * HOUR_S, "µg/h"),
    },
}
"""Customary unit of each noise coefficient, for gyroscopes and accelerometers."""

DEVIATION_UNITS: Final = {kind: units["B"] for kind, units in COEFFICIENT_UNITS.items()}
"""Customary unit of Allan deviations, which is the unit of the bias instability B."""
SAMPLE_UNITS: Final[dict[Kind, Unit]] = {"gyro": Unit(DEGREE, "°/s"), "accel": Unit(1.0, "m/s²")}

COEFFICIENT_NAMES: Final[dict[Kind, dict[str, str]]] = {
    "gyro": {
        "Q": "quantization noise",
        "N": "angle random walk",
        "B": "bias instability",
        "K": "rate random walk",
        "R": "rate ramp",
    },
    "accel": {
        "Q": "quantization noise",
        "N": "velocity random walk",
        "B": "bias instability",
        "K": "acceleration random walk",
        "R": "acceleration ramp",
    },
}
"""Name of each noise coefficient, for gyroscopes and accelerometers."""


class CoefficientColumn(NamedTuple):
    """Column of a table in which a noise coefficient is shown."""

    symbol: str
    name: str
    unit: Unit


@dataclass(frozen=True, slots=True)
class UnitSystem:
    """Units in which tables, figures and reports show noise coefficients and Allan deviations."""

    coefficients: Mapping[Kind, Mapping[str, Unit]]
    densities: Mapping[Kind, Unit] = field(default_factory=dict)
    """Units of the one-sided noise density, which is shown in addition to the random walk N. Empty without density."""
    is_si: bool = False

    def deviation(self, kind: Kind) -> Unit:
        """Return the unit of Allan deviations, which is the unit of the bias instability B."""
        return self.coefficients[kind]["B"]

    def single(self, kind: Kind, symbol: str) -> Unit:
        """Return the unit of a coefficient for places that show only one unit: that of the noise density rather than
        the random walk."""
        return self.columns(kind, symbol)[-1].unit

    def columns(self, kind: Kind, symbols: Sequence[str] = "QNBKR") -> list[CoefficientColumn]:
        """Return the columns of a table of coefficients.

        >>> [f"{one.symbol} {one.unit.name}" for one in UNIT_SYSTEMS["datasheet"].columns("gyro")][:3]
        ['Q µrad', 'N °/√h', 'N m°/s/√Hz']

        Parameters
        ----------
        kind : {"gyro", "accel"}
            Kind of sensor.
        symbols : sequence of str, optional
            Symbols of the coefficients. By default, all coefficients.
        """
        found = []
        for symbol in symbols:
            found.append(CoefficientColumn(symbol, COEFFICIENT_NAMES[kind][symbol], self.coefficients[kind][symbol]))
            if symbol == "N" and kind in self.densities:
                found.append(CoefficientColumn(symbol, "noise density, one-sided", self.densities[kind]))
        return found


UNIT_SYSTEMS: Final = {
    "imu": UnitSystem(COEFFICIENT_UNITS),
    "datasheet": UnitSystem(
        COEFFICIENT_UNITS,
        # White noise with the two-sided density N² has the one-sided density 2 N², which data sheets state.
        {
            "gyro": Unit(math.sqrt(2.0) * DEGREE * 1e3, "m°/s/√Hz"),
            "accel": Unit(math.sqrt(2.0) * MICRO_G, "µg/√Hz"),
        },
    ),
    "si": UnitSystem(
        {
            "gyro": {
                "Q": Unit(1.0, "rad"),
                "N": Unit(1.0, "rad/s/√Hz"),
                "B": Unit(1.0, "rad/s"),
                "K": Unit(1.0, "rad/s²/√Hz"),
                "R": Unit(1.0, "rad/s²"),
            },
            "accel": {
                "Q": Unit(1.0, "m/s"),
                "N": Unit(1.0, "m/s²/√Hz"),
                "B": Unit(1.0, "m/s²"),
                "K": Unit(1.0, "m/s³/√Hz"),
                "R": Unit(1.0, "m/s³"),
            },
        },
        is_si=True,
    ),
}
"""Unit systems of the option ``--units``. In SI, N and K are two-sided densities: rad/s/√Hz is the same as rad/√s."""
DEFAULT_UNITS: Final = UNIT_SYSTEMS["imu"]


def sensor_kind(axis: str) -> Kind:
    """Return the kind of sensor, gyroscope or accelerometer, of an axis."""
    return "gyro" if axis.startswith("g") else "accel"


def axes_of(kind: Kind) -> tuple[str, ...]:
    """Return the three axes of the gyroscopes or the accelerometers."""
    return AXES[:3] if kind == "gyro" else AXES[3:]


def coefficient_unit(coefficient: str, axis: str) -> Unit:
    """Return the customary unit of a noise coefficient.

    Parameters
    ----------
    coefficient : {"Q", "N", "B", "K", "R"}
        Noise coefficient.
    axis : str
        Axis of ``AXES``.
    """
    return COEFFICIENT_UNITS[sensor_kind(axis)][coefficient]


def format_number(value: float, digits: int = 3) -> str:
    """Format a number for display, in decimal notation from 1e-4 to 1e6 and otherwise with an exponent.

    Parameters
    ----------
    value : float
        Number to format.
    digits : int, optional
        Number of significant digits.

    Examples
    --------
    >>> format_number(0.51566), format_number(1234.5), format_number(2.4e-6), format_number(float("nan"))
    ('0.516', '1230', '2.40e-6', '—')
    """
    if not math.isfinite(value):
        return NO_VALUE if math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value == 0.0:
        return "0"
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = math.floor(math.log10(abs(rounded)))
    if not -4 <= exponent < 6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(power)}"
    return f"{rounded:.{max(0, digits - 1 - exponent)}f}"


def format_two_significant_digits(value: float, sign: bool = False) -> str:
    """Format a number with two significant digits in decimal notation.

    Parameters
    ----------
    value : float
        Number to format.
    sign : bool, optional
        True to show the sign of positive values.
    """
    return np.format_float_positional(float(f"{value:.1e}"), trim="-", sign=sign)


def format_axis_value(axis: str, si_value: float, sign: bool = False) -> str:
    """Format an angular rate in °/s or an acceleration in mg or m/s², with two significant digits.

    Parameters
    ----------
    axis : str
        Axis of ``AXES``.
    si_value : float
        Angular rate in rad/s or acceleration in m/s².
    sign : bool, optional
        True to show the sign of positive values, as for a difference.

    Examples
    --------
    >>> format_axis_value("gz", 2.79), format_axis_value("ax", -0.0324, sign=True), format_axis_value("az", 27.0)
    ('160 °/s', '-3.3 mg', '27 m/s²')
    """
    if axis.startswith("g"):
        return f"{format_two_significant_digits(math.degrees(si_value), sign)} °/s"
    if abs(si_value) < 1000.0 * MILLI_G:
        return f"{format_two_significant_digits(si_value / MILLI_G, sign)} mg"
    return f"{format_two_significant_digits(si_value, sign)} m/s²"


def format_sample_rate(rate_hz: float | None) -> str:
    """Format a sample rate in Hz with two decimal places."""
    return NO_VALUE if rate_hz is None else f"{rate_hz:.2f} Hz"


def format_duration(seconds: float) -> str:
    """Format a duration in the two largest suitable units.

    >>> format_duration(3725.0), format_duration(0.5), format_duration(90.0)
    ('1 h 02 min', '0.500 s', '1 min 30 s')
    """
    if seconds < 60:
        return f"{format_number(seconds)} s" if seconds < 10 else f"{seconds:.0f} s"
    whole = round(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    if days:
        return f"{days} d {hours:02d} h"
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {whole % 60:02d} s"


def format_age(seconds: float) -> str:
    """Format an age in a single suitable unit.

    >>> format_age(0.44), format_age(75.0), format_age(600.0), format_age(90_000.0)
    ('0.4 s', '75 s', '10 min', '25 h')
    """
    if seconds < 10:
        return f"{max(seconds, 0.0):.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def format_duration_in_largest_unit(seconds: int) -> str:
    """Format a duration as a whole number of the largest possible unit.

    >>> format_duration_in_largest_unit(300), format_duration_in_largest_unit(604_800)
    ('5 min', '7 d')
    """
    unit_s, unit = next((unit_s, unit) for unit_s, unit in DURATION_UNITS if seconds % unit_s == 0)
    return f"{seconds // unit_s} {unit}"


def format_milliseconds(seconds: float | None) -> str:
    """Format a duration in milliseconds."""
    return NO_VALUE if seconds is None else f"{format_number(seconds * 1e3)} ms"


def format_utc(t_s: float) -> str:
    """Format a Unix time in seconds as date and time in UTC.

    >>> format_utc(90.0)
    '1970-01-01 00:01:30'
    """
    try:
        return datetime.fromtimestamp(t_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return f"{t_s:g} s"


def format_count(count: int, noun: str) -> str:
    """Format a count together with the singular or plural of a noun.

    >>> format_count(1, "frame"), format_count(2000, "frame")
    ('1 frame', '2,000 frames')

    Parameters
    ----------
    count : int
        Number of objects.
    noun : str
        Singular of the noun.
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def format_short_count(count: int) -> str:
    """Format a count with at most five characters.

    >>> format_short_count(9_999), format_short_count(123_456), format_short_count(999_999)
    ('9999', '123k', '1M')
    """
    if count < 10_000:
        return str(count)
    count = int(float(f"{count:.2e}"))  # round first, so that 999 999 becomes 1M
    power = min((len(str(count)) - 1) // 3, 4)
    return f"{count / 1000**power:.3g}{'kMGT'[power - 1]}"
