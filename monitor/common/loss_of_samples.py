"""Share of missing samples, and their effect on the width of the intervals of the noise coefficients."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from monitor.common.unit_formatting import format_two_significant_digits

MIN_WIDENING: Final = 0.005
"""Minimum relative increase of the width of an interval that is reported."""


@dataclass(frozen=True, slots=True)
class LossOfSamples:
    """Missing samples of one window or recording, and their effect on the intervals."""

    share: float
    """Share of the samples that are missing, from 0 to 1, on the axis with the most missing samples."""
    wider: Mapping[str, float]
    """Relative increase of the width of the interval of each coefficient, on the axis with the largest increase."""

    @property
    def widens_intervals(self) -> bool:
        """True if the interval of a coefficient is wider by at least ``MIN_WIDENING``."""
        return any(one >= MIN_WIDENING for one in self.wider.values())

    def describe(self) -> str:
        """Return a sentence for users.

        >>> LossOfSamples(0.012, {"N": 0.002, "K": 0.04}).describe()
        '1.2 % of the samples are missing: intervals of K 4 % wider'
        """
        wider = ", ".join(f"{symbol} {100.0 * x:.0f} %" for symbol, x in self.wider.items() if x >= MIN_WIDENING)
        cost = f"intervals of {wider} wider" if self.widens_intervals else "intervals hardly wider"
        return f"{format_two_significant_digits(100.0 * self.share)} % of the samples are missing: {cost}"


NO_LOSS: Final = LossOfSamples(0.0, {})
"""Value if no samples are missing, or if the loss is not known yet."""
