"""Detect biases that lie outside the prediction interval of the thermal model too often.

If the model is correct, the bias lies above the 95 % prediction interval in 2.5 % of the intervals, and below it in
another 2.5 %. A change is suspected if, in MIN_OUTSIDE of the last WINDOW_INTERVALS intervals, the bias lies outside
the prediction interval on the same side. The measured false alarm rate is given in docs/measurements/thermal-models.md.
"""

from collections import deque
from dataclasses import dataclass
from itertools import dropwhile
from typing import Final

import numpy as np

from monitor.common.distributions import Z95

MIN_OUTSIDE: Final = 4
"""A change is suspected if at least this many recent biases are outside the prediction interval on the same side."""
WINDOW_INTERVALS: Final = 6
"""Number of recent intervals with a known bias that are considered."""
FAR_HALF_WIDTHS: Final = 2.0
"""Maximum deviation from the prediction at which a bias is used for the fit, in half-widths of the interval."""


@dataclass(frozen=True, slots=True)
class PredictionInterval:
    """Predicted mean bias in one interval, with a 95 % prediction interval, in rad/s or m/s²."""

    bias: float
    lo: float
    hi: float

    def side_of_interval(self, bias: float) -> int:
        """Return 1 if a bias lies above the prediction interval, -1 if it lies below, and 0 otherwise."""
        return int(bias > self.hi) - int(bias < self.lo)


@dataclass(frozen=True, slots=True)
class UnexplainedChange:
    """Change of a bias that temperature does not explain."""

    size: float  # mean difference between measured and predicted bias since the change began; rad/s or m/s²
    outside: int  # number of intervals with a bias outside the prediction interval, on one side
    of: int  # number of intervals that were considered
    since: int  # number of intervals since the first bias outside, including missing intervals
    sigma: float  # combined deviation of these intervals, in standard deviations


@dataclass(frozen=True, slots=True)
class _Residual:
    """Residuals of one interval."""

    at: int  # index of the interval
    side: int  # 1 if the bias is above the prediction interval, -1 if below, 0 if inside
    apart: float  # residual of the multi-step prediction
    z: float  # normalised residual of the one-step prediction


class UnexplainedBiasChangeDetector:
    """Detector of bias changes that temperature does not explain, for one axis."""

    def __init__(self) -> None:
        self._recent: deque[_Residual] = deque(maxlen=WINDOW_INTERVALS)  # intervals with a known bias
        self._interval_count = 0

    @property
    def recent_intervals_fit_prediction(self) -> bool:
        """Return True if the last bias agrees with its prediction, with at most one recent bias outside on each
        side."""
        return not (self._recent and self._recent[-1].side) and all(self._count_outside(side) < 2 for side in (-1, 1))

    @property
    def last_interval_is_far_outside(self) -> bool:
        """Return True if the last bias is too far outside the prediction interval to be used for the fit."""
        return bool(self._recent) and abs(self._recent[-1].z) > FAR_HALF_WIDTHS * Z95

    def check_interval(
        self, bias: float, multi_step: PredictionInterval, one_step: PredictionInterval
    ) -> UnexplainedChange | None:
        """Compare the bias in an interval with its predictions, and return a suspected change or None.

        Parameters
        ----------
        bias : float
            Measured mean bias in rad/s or m/s²; NaN means not measured.
        multi_step, one_step : PredictionInterval
            Predictions for the interval.
        """
        self._interval_count += 1
        if not np.isfinite(bias):
            return None
        half = max(0.5 * (one_step.hi - one_step.lo), 1e-300)
        z = Z95 * (bias - one_step.bias) / half
        self._recent.append(_Residual(self._interval_count, one_step.side_of_interval(bias), bias - multi_step.bias, z))
        side = self._recent[-1].side
        if not side or self._count_outside(side) < MIN_OUTSIDE:
            return None
        part = list(dropwhile(lambda one: one.side != side, self._recent))
        size = float(np.mean([one.apart for one in part]))
        together = float(abs(sum(one.z for one in part))) / len(part) ** 0.5
        outside, of, since = self._count_outside(side), len(self._recent), self._interval_count - part[0].at + 1
        found = UnexplainedChange(size, outside, of, since, together)
        self._recent.clear()
        return found

    def forget_residuals(self) -> None:
        """Discard the residuals of all recent intervals."""
        self._recent.clear()

    def _count_outside(self, side: int) -> int:
        """Return the number of recent intervals with a bias above (1) or below (-1) the prediction interval."""
        return sum(one.side == side for one in self._recent)
