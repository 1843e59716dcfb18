"""Noise coefficients as text for tables, in the units that data sheets use, such as °/√h."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from drivers.data_types import AXES
from monitor.common.unit_formatting import NO_VALUE, Unit, coefficient_unit, format_number
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status

TEMPERATURE_MARK: Final = "†"
TEMPERATURE_MEANS: Final = "slow variance due to temperature"


@dataclass(frozen=True, slots=True)
class CoefficientText:
    """Value, confidence interval and unit of one noise coefficient as text."""

    value: str  # "0.516"; "≤ 2.10" for an upper bound; "—" if there is no estimate
    interval: str  # "0.512 … 0.520"; "" if there is no interval
    unit: str


def format_coefficient(
    coefficients: Coefficients, symbol: str, axis: str, digits: int = 3, unit: Unit | None = None
) -> CoefficientText:
    """Format one noise coefficient.

    Parameters
    ----------
    coefficients
        Noise coefficients of all axes, in SI units.
    symbol
        Symbol of the coefficient: Q, N, B, K or R.
    axis
        Name of the axis.
    digits
        Number of significant digits.
    unit
        Unit of the text. By default, the unit of inertial navigation, such as °/√h.
    """
    at = SYMBOLS.index(symbol), AXES.index(axis)
    unit = unit or coefficient_unit(symbol, axis)
    value, lo, hi = (float(a[at]) * unit.factor for a in (coefficients.value, coefficients.lo, coefficients.hi))
    match Status(int(coefficients.status[at])):
        case Status.ESTIMATED:
            return CoefficientText(
                format_number(value, digits), f"{format_number(lo, digits)} … {format_number(hi, digits)}", unit.name
            )
        case Status.UPPER_BOUND:
            return CoefficientText(f"≤ {format_number(hi, digits)}", "", unit.name)
        case Status.UNESTIMATED:
            return CoefficientText(NO_VALUE, "", unit.name)


def format_relative_interval(coefficients: Coefficients, symbol: str, axis: str) -> str:
    """Return the distances of the ends of a 95 % interval from its value in percent, such as "±0.6 %" or "−21 +24 %".

    The text is empty if there is no interval.

    Parameters
    ----------
    coefficients
        Noise coefficients of all axes.
    symbol
        Symbol of the coefficient: Q, N, B, K or R.
    axis
        Name of the axis.
    """
    at = SYMBOLS.index(symbol), AXES.index(axis)
    value, lo, hi = (float(a[at]) for a in (coefficients.value, coefficients.lo, coefficients.hi))
    if Status(int(coefficients.status[at])) is not Status.ESTIMATED or value <= 0.0:
        return ""
    percent = [100.0 * part / value for part in (value - lo, hi - value)]
    below, above = (f"{one:.0f}" if one >= 1.0 else f"{one:.1g}" for one in percent)
    return f"±{above} %" if below == above else f"−{below} +{above} %"


def mark_temperature_axis(axis: str, axes_of_temperature: Collection[str]) -> str:
    """Append TEMPERATURE_MARK to the name of an axis if temperature explains most of the axis's slow variance.

    >>> mark_temperature_axis("gy", ("gy", "gz")), mark_temperature_axis("gx", ("gy", "gz"))
    ('gy †', 'gx')

    Parameters
    ----------
    axis
        Name of the axis.
    axes_of_temperature
        Axes on which temperature explains most of the slow variance.
    """
    return f"{axis} {TEMPERATURE_MARK}" if axis in axes_of_temperature else axis
