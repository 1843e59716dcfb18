"""Names of units that people write in settings and CAN databases -> factors to SI.

Each table maps a spelling to the factor that turns a number in that unit into rad/s, m/s², s; a
temperature also has an offset. Spellings are those of data sheets, DBC files and plots; case matters
(``mg`` is not ``Mg``), blanks around a name do not. A name that no table holds is a ``ConfigError``
that names it and all that are known, the nearest first.
"""

import math
from collections.abc import Mapping
from typing import Final, TypeVar

from drivers.discovery import possible
from drivers.errors import ConfigError

G0: Final = 9.80665
"""m/s²; standard acceleration of free fall, exact by definition (CGPM 1901)."""
DEGREE: Final = math.pi / 180.0
"""rad."""
KELVIN_OFFSET: Final = -273.15
"""°C at 0 K, exact by definition of the degree Celsius."""

RATE: Final[Mapping[str, float]] = {
    "rad/s": 1.0,
    "rad/sec": 1.0,
    "mrad/s": 1e-3,
    "µrad/s": 1e-6,
    "urad/s": 1e-6,
    "deg/s": DEGREE,
    "deg/sec": DEGREE,
    "°/s": DEGREE,
    "dps": DEGREE,
    "mdeg/s": 1e-3 * DEGREE,
    "mdps": 1e-3 * DEGREE,
    "deg/h": DEGREE / 3600.0,
    "deg/hr": DEGREE / 3600.0,
    "°/h": DEGREE / 3600.0,
}
"""Angular rate: unit -> rad/s."""

ACCELERATION: Final[Mapping[str, float]] = {
    "m/s²": 1.0,
    "m/s^2": 1.0,
    "m/s2": 1.0,
    "m/s/s": 1.0,
    "mm/s²": 1e-3,
    "mm/s^2": 1e-3,
    "mm/s2": 1e-3,
    "g": G0,
    "mg": 1e-3 * G0,
    "µg": 1e-6 * G0,
    "ug": 1e-6 * G0,
}
"""Acceleration: unit -> m/s²."""

TEMPERATURE: Final[Mapping[str, tuple[float, float]]] = {
    "°C": (1.0, 0.0),
    "degC": (1.0, 0.0),
    "deg C": (1.0, 0.0),
    "C": (1.0, 0.0),
    "m°C": (1e-3, 0.0),
    "mdegC": (1e-3, 0.0),
    "K": (1.0, KELVIN_OFFSET),
    "°F": (5.0 / 9.0, -160.0 / 9.0),
    "degF": (5.0 / 9.0, -160.0 / 9.0),
    "F": (5.0 / 9.0, -160.0 / 9.0),
}
"""Temperature: unit -> (factor, offset), °C = factor · number + offset."""

TIME: Final[Mapping[str, float]] = {
    "s": 1.0,
    "sec": 1.0,
    "ms": 1e-3,
    "µs": 1e-6,
    "us": 1e-6,
    "ns": 1e-9,
}
"""Time: unit -> s."""

T = TypeVar("T")


def rate_factor(unit: str) -> float:
    """rad/s in one ``unit`` of angular rate.

    >>> round(rate_factor("deg/s"), 6)
    0.017453
    """
    return _look_up(RATE, unit, "angular rate")


def acceleration_factor(unit: str) -> float:
    """m/s² in one ``unit`` of acceleration.

    >>> acceleration_factor("g")
    9.80665
    """
    return _look_up(ACCELERATION, unit, "acceleration")


def temperature_scale(unit: str) -> tuple[float, float]:
    """(factor, offset) of a ``unit`` of temperature: °C = factor · number + offset.

    >>> temperature_scale("K")
    (1.0, -273.15)
    """
    return _look_up(TEMPERATURE, unit, "temperature")


def time_factor(unit: str) -> float:
    """Seconds in one ``unit`` of time.

    >>> time_factor("ms")
    0.001
    """
    return _look_up(TIME, unit, "time")


def _look_up(table: Mapping[str, T], unit: str, quantity: str) -> T:
    # Unicode holds the micro sign twice; keyboards and fonts give either
    name = unit.strip().replace("\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}")
    if name not in table:
        raise ConfigError(f'"{unit}" is no unit of {quantity}{possible(name, tuple(table))}')
    return table[name]
