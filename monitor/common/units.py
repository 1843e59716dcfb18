"""Conversion from SI units to the units of the field, for viewer, terminal, plots and events.

The functions take a number in SI units (rad, m, s) and return it in the field's unit, or as a short text with the unit.
No other module converts, and nothing is computed in field units. The factors follow from 1 rad = 180/π °, 1 h = 3600 s
(√h = 60 √s) and 1 g = 9.80665 m/s² (standard gravity, CGPM 1901).
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

from drivers.quantities import HOUR_S
from drivers.sample import AXES
from drivers.units import G0

Kind = Literal["gyro", "accel"]
KINDS: Final[tuple[Kind, Kind]] = ("gyro", "accel")
KIND_NAMES: Final = {"gyro": "Gyroscopes", "accel": "Accelerometers"}

DEGREE: Final = 180.0 / math.pi  # degrees per radian
ROOT_HOUR: Final = 60.0  # √s per √h
MICRO_G: Final = 1e6 / G0  # µg per m/s²


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of the field with its name and its factor: a value in SI units times ``factor`` is a value in this unit."""

    factor: float
    name: str

    def text(self, si: float, digits: int = 3) -> str:
        """Format a value with this unit.

        Parameters
        ----------
        si : float
            Value in SI units.
        digits : int, optional
            Number of significant digits.

        Examples
        --------
        >>> COEFFICIENT_UNITS["gyro"]["N"].text(1.5e-4)
        '0.516 °/√h'
        """
        return f"{format_number(si * self.factor, digits)} {self.name}"


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
"""Field unit of each noise coefficient, for gyroscopes and accelerometers."""

DEVIATION_UNITS: Final[dict[Kind, Unit]] = {
    "gyro": Unit(DEGREE * HOUR_S, "°/h"),
    "accel": Unit(MICRO_G, "µg"),
}
"""Field unit of Allan deviations."""
SAMPLE_UNITS: Final[dict[Kind, Unit]] = {"gyro": Unit(DEGREE, "°/s"), "accel": Unit(1.0, "m/s²")}
"""Field unit of samples."""

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


def sensor_kind(axis: str) -> Kind:
    """Return the kind of sensor to which an axis of ``AXES`` belongs."""
    return "gyro" if axis.startswith("g") else "accel"


def axes_of(kind: Kind) -> tuple[str, ...]:
    """Return the axes x, y, z of a kind of sensor."""
    return AXES[:3] if kind == "gyro" else AXES[3:]


def unit_of(letter: str, axis: str) -> Unit:
    """Return the field unit of a noise coefficient.

    Parameters
    ----------
    letter : {"Q", "N", "B", "K", "R"}
        Noise coefficient.
    axis : str
        Axis of ``AXES``.
    """
    return COEFFICIENT_UNITS[sensor_kind(axis)][letter]


def format_number(value: float, digits: int = 3) -> str:
    """Format a number, without an exponent if it is easy to read without one.

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
        return "—" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value == 0.0:
        return "0"
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = math.floor(math.log10(abs(rounded)))
    if not -4 <= exponent < 6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(power)}"
    return f"{rounded:.{max(0, digits - 1 - exponent)}f}"
