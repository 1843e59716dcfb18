"""Coefficients as people read them: one cell of a table, in the field's unit; and the units, of ``monitor.common.units``."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import AXES
from monitor.common.units import (
    COEFFICIENT_NAMES,
    COEFFICIENT_UNITS,
    DEGREE,
    DEVIATION_UNITS,
    HOUR,
    KIND_NAMES,
    KINDS,
    MICRO_G,
    SAMPLE_UNITS,
    Kind,
    Unit,
    axes_of,
    kind_of,
    number,
    unit_of,
)
from monitor.estimation.fit.coefficients import LETTERS, Coefficients, Status

__all__ = [
    "COEFFICIENT_NAMES",
    "COEFFICIENT_UNITS",
    "DEGREE",
    "DEVIATION_UNITS",
    "HOUR",
    "KINDS",
    "KIND_NAMES",
    "MICRO_G",
    "SAMPLE_UNITS",
    "TEMPERATURE_MARK",
    "TEMPERATURE_MEANS",
    "Kind",
    "Reading",
    "Unit",
    "axes_of",
    "kind_of",
    "marked",
    "measured_axes",
    "number",
    "reading",
    "unit_of",
]

TEMPERATURE_MARK: Final = "†"
TEMPERATURE_MEANS: Final = "its slow part is temperature"


@dataclass(frozen=True, slots=True)
class Reading:
    """One coefficient of one axis as a person reads it, without its unit."""

    value: str  # "0.516", "≤ 2.10" where the data only bound it, "—" where there are too few
    interval: str  # "0.512 … 0.520", or "" where there is none
    unit: str


def reading(coefficients: Coefficients, letter: str, axis: str, digits: int = 3) -> Reading:
    """One cell of a table of coefficients, in the field's unit."""
    at = LETTERS.index(letter), AXES.index(axis)
    unit = unit_of(letter, axis)
    value, lo, hi = (float(a[at]) * unit.factor for a in (coefficients.value, coefficients.lo, coefficients.hi))
    match Status(int(coefficients.status[at])):
        case Status.ESTIMATED:
            return Reading(number(value, digits), f"{number(lo, digits)} … {number(hi, digits)}", unit.name)
        case Status.UPPER_BOUND:
            return Reading(f"≤ {number(hi, digits)}", "", unit.name)
        case Status.UNESTIMATED:
            return Reading("—", "", unit.name)


def marked(axis: str, axes_of_temperature: Collection[str]) -> str:
    """Return the name of an axis, with TEMPERATURE_MARK if its slow part is temperature.

    >>> marked("gy", ("gy", "gz")), marked("gx", ("gy", "gz"))
    ('gy †', 'gx')
    """
    return f"{axis} {TEMPERATURE_MARK}" if axis in axes_of_temperature else axis


def measured_axes(avar: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> tuple[str, ...]:
    """The axes of ``avar`` ([m, 6]) that hold any number at all."""
    return tuple(axis for i, axis in enumerate(AXES) if bool(np.isfinite(avar[:, i]).any()))
