"""Results of the estimator: ``Estimate`` at one moment, and the coefficients after every sample."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.fit.coefficient_values import Coefficients, Status


@dataclass(frozen=True, slots=True)
class PerSampleCoefficients:
    """Coefficients after each of n consecutive samples."""

    t_ns: Ints  # [n] host monotonic clock, nanoseconds
    value: Floats  # [n, 5, 6] Q N B K R in SI; NaN where not estimated


def concatenate_coefficients(blocks: Collection[PerSampleCoefficients]) -> PerSampleCoefficients | None:
    """Concatenate the coefficients of successive blocks of samples. Return None without blocks."""
    if not blocks:
        return None
    return PerSampleCoefficients(
        np.concatenate([part.t_ns for part in blocks]), np.concatenate([part.value for part in blocks])
    )


@dataclass(frozen=True, slots=True)
class Estimate:
    """Allan curve of the window and the fitted coefficients at one sample."""

    t_ns: int  # time of the newest sample
    rate_hz: float
    window_s: float  # length of the full window
    samples: int  # received since the start
    curve: AllanCurve
    fitted: Floats  # [m, 6] Allan variance of the fitted model at curve.tau_s; NaN without a fit, or at τ left out
    coefficients: Coefficients
    k_or_r: NDArray[np.bool_]  # [6] True if the window drifts, but random walk and ramp cannot be distinguished
    display_curve: AllanCurve | None = (
        None  # curve at the same τ over shorter spans, see ``window.samples_per_displayed_tau``
    )
    history: PerSampleCoefficients | None = None  # since the previous estimate, if the fit is updated with every sample

    def without_coefficients(self) -> "Estimate":
        """Return a copy without the fit, in which every coefficient is unestimated."""
        shape = self.coefficients.status.shape
        nothing = np.full(shape, np.nan)
        return replace(
            self,
            fitted=np.full_like(self.fitted, np.nan),
            coefficients=Coefficients(nothing, nothing, nothing, np.full(shape, Status.UNESTIMATED, np.int8)),
            k_or_r=np.zeros_like(self.k_or_r),
            history=None,
        )
