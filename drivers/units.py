"""Conversion factors from the unit names in settings and CAN databases to SI units.

Each table maps a unit name to the factor that converts a number to rad/s, m/s² or s. A temperature unit also has an
offset. Unit names are case-sensitive. An unknown unit raises ``ConfigError``.

A unit of angular rate, acceleration or time may be divided by a number, as in ``deg/s/131``, ``g/16384`` or
``s/10000``. Data sheets state this number as the sensitivity in LSB/(°/s) or LSB/g. ``rad s^-1`` is another spelling
of ``rad/s``.
"""

import math
import re
from collections.abc import Mapping
from typing import Final, TypeVar

from drivers.errors import ConfigError
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.number_ranges import HOUR_S, SCALE

G0: Final = 9.80665
"""Standard acceleration of free fall in m/s², exact by definition (CGPM 1901)."""
DEGREE: Final = math.pi / 180.0
"""One degree in rad."""
KELVIN_OFFSET: Final = -273.15
"""Temperature of 0 K in °C, exact by definition of the degree Celsius."""

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
    "deg/h": DEGREE / HOUR_S,
    "deg/hr": DEGREE / HOUR_S,
    "°/h": DEGREE / HOUR_S,
}
"""Factor that converts each unit of angular rate to rad/s."""

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
"""Factor that converts each unit of acceleration to m/s²."""

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
"""Factor and offset that convert each unit of temperature to °C: temperature = factor · number + offset."""

TIME: Final[Mapping[str, float]] = {
    "s": 1.0,
    "sec": 1.0,
    "ms": 1e-3,
    "µs": 1e-6,
    "us": 1e-6,
    "ns": 1e-9,
}
"""Factor that converts each unit of time to s."""

_SENSITIVITY: Final = re.compile(r"(.*\S)\s*/\s*(\d+(?:\.\d*)?(?:e\d+)?)")
T = TypeVar("T")


def angular_rate_factor(unit: str) -> float:
    """Return the factor that converts a unit of angular rate to rad/s. Raise ConfigError if the unit is unknown.

    >>> round(angular_rate_factor("deg/s"), 6)
    0.017453
    """
    return _look_up_scaled(RATE, unit, "angular rate")


def acceleration_factor(unit: str) -> float:
    """Return the factor that converts a unit of acceleration to m/s². Raise ConfigError if the unit is unknown.

    >>> acceleration_factor("g"), acceleration_factor("g/2")
    (9.80665, 4.903325)
    """
    return _look_up_scaled(ACCELERATION, unit, "acceleration")


def temperature_factor_and_offset(unit: str) -> tuple[float, float]:
    """Return the factor and the offset that convert a unit of temperature to °C.

    The temperature in °C is factor · number + offset. ConfigError is raised if the unit is unknown.

    >>> temperature_factor_and_offset("K")
    (1.0, -273.15)
    """
    return _look_up(TEMPERATURE, unit, "temperature")


def time_factor(unit: str) -> float:
    """Return the factor that converts a unit of time to s. Raise ConfigError if the unit is unknown.

    >>> time_factor("ms"), time_factor("s/10000")
    (0.001, 0.0001)
    """
    return _look_up_scaled(TIME, unit, "time")


def _look_up_scaled(table: Mapping[str, float], unit: str, quantity: str) -> float:
    """Return the factor of a unit that may be divided by a sensitivity, as in ``g/16384``."""
    divided = _SENSITIVITY.fullmatch(unit.strip())
    if divided is None or unit.strip() in table or not SCALE.supports(sensitivity := float(divided[2])):
        return _look_up(table, unit, quantity)
    return _look_up(table, divided[1], quantity) / sensitivity


def _look_up(table: Mapping[str, T], unit: str, quantity: str) -> T:
    # Unicode has two characters for the prefix micro.
    name = unit.strip().replace("\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}")
    name = name.replace(" s^-1", "/s").replace(" s^-2", "/s^2")
    if name not in table:
        raise ConfigError(f'"{unit}" is not a unit of {quantity}{format_choices_by_similarity(name, tuple(table))}')
    return table[name]
