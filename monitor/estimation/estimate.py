"""Results of the live estimator."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.fit.coefficient_values import Coefficients, Status


@dataclass(frozen=True, slots=True)
class PerSampleCoefficients:
    """Noise coefficients after each of n consecutive samples."""

    t_ns: Ints  # [n] host monotonic clock, nanoseconds
    value: Floats  # [n, 5, 6] Q N B K R in SI; NaN where not estimated


def concatenate_coefficients(blocks: Collection[PerSampleCoefficients]) -> PerSampleCoefficients | None:
    """Concatenate the coefficients of successive blocks. Return None if there are no blocks."""
    if not blocks:
        return None
    return PerSampleCoefficients(
        np.concatenate([part.t_ns for part in blocks]), np.concatenate([part.value for part in blocks])
    )


@dataclass(frozen=True, slots=True)
class Estimate:
    """Allan deviations and fitted noise coefficients of one device at one moment."""

    t_ns: int  # time of the newest sample
    rate_hz: float
    window_s: float  # length of the full window
    samples: int  # number of samples received since the start
    curve: AllanCurve
    fitted: Floats  # [m, 6] Allan variance of the fitted model; NaN without a fit or at excluded averaging times
    coefficients: Coefficients
    k_or_r: NDArray[np.bool_]  # [6] True if rate random walk and rate ramp cannot be distinguished
    display_curve: AllanCurve | None = (
        None  # Allan curve of the newest samples, see ``window.samples_per_displayed_tau``
    )
    history: PerSampleCoefficients | None = (
        None  # coefficients since the previous estimate, if computed after every sample
    )

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
        )
