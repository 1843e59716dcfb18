"""Result types of the live estimator."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.fit.coefficients_with_intervals import Coefficients, Status


@dataclass(frozen=True, slots=True)
class CoefficientsAfterEachSample:
    """Noise coefficients after each of n consecutive samples."""

    t_ns: Ints  # [n] times of the samples on the monotonic clock of the host, nanoseconds
    value: Floats  # [n, 5, 6] Q, N, B, K, R in SI units; NaN if not estimated


def concatenate_successive_coefficients(
    blocks: Collection[CoefficientsAfterEachSample],
) -> CoefficientsAfterEachSample | None:
    """Concatenate the coefficients of successive blocks of samples, or return None if there are no blocks."""
    if not blocks:
        return None
    return CoefficientsAfterEachSample(
        np.concatenate([part.t_ns for part in blocks]), np.concatenate([part.value for part in blocks])
    )


@dataclass(frozen=True, slots=True)
class Estimate:
    """Allan deviations and fitted noise coefficients of one device at one point in time."""

    t_ns: int  # time of the newest sample
    rate_hz: float
    window_s: float  # length of the full sliding window
    samples: int  # number of samples that have been received since the start
    curve: AllanCurve
    fitted: Floats  # [m, 6] Allan variance of the fitted model; NaN at averaging times that are not used in the fit
    coefficients: Coefficients
    k_or_r: NDArray[np.bool_]  # [6] True if rate random walk and rate ramp cannot be distinguished
    display_curve: AllanCurve | None = (
        None  # Allan curve of the newest samples, see ``window.newest_samples_per_displayed_tau``
    )
    history: CoefficientsAfterEachSample | None = (
        None  # coefficients after each sample since the previous estimate, if they are computed
    )
    poorly_fitted_axes: tuple[str, ...] = ()  # axes whose residuals are significantly too large
    temperature_shares: Mapping[str, float] = field(default_factory=dict)
    # variance share of the interval means that temperature explains, by axis; 0 without a significant dependence

    def without_coefficients(self) -> "Estimate":
        """Return a copy of the estimate without fitted coefficients."""
        shape = self.coefficients.status.shape
        nothing = np.full(shape, np.nan)
        return replace(
            self,
            fitted=np.full_like(self.fitted, np.nan),
            coefficients=Coefficients(nothing, nothing, nothing, np.full(shape, Status.UNESTIMATED, np.int8)),
            k_or_r=np.zeros_like(self.k_or_r),
            history=None,
            poorly_fitted_axes=(),
        )
