"""All that one look at the estimate gives."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats, Ints
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.fit.coefficients import Coefficients, Status


@dataclass(frozen=True, slots=True)
class Course:
    """The coefficients after each of n consecutive samples."""

    t_ns: Ints  # [n]
    value: Floats  # [n, 5, 6] Q N B K R in SI; NaN where not estimated


def joined(courses: Collection[Course]) -> Course | None:
    """Courses one after another as one; None of none."""
    if not courses:
        return None
    return Course(np.concatenate([part.t_ns for part in courses]), np.concatenate([part.value for part in courses]))


@dataclass(frozen=True, slots=True)
class Estimate:
    """The window's Allan curve and the coefficients fitted to it, at one sample."""

    t_ns: int  # newest sample
    rate_hz: float
    window_s: float  # the window's full length
    samples: int  # received since start
    curve: AllanCurve
    fitted: Floats  # [m, 6] Allan variance of the fitted model at curve.tau_s; NaN where none, or left out of the fit
    coefficients: Coefficients
    k_or_r: NDArray[np.bool_]  # [6] the window drifts, and does not tell whether by random walk or by a ramp
    recent: AllanCurve | None = None  # the same τ, each over a span of its own, see window.quick_spans
    course: Course | None = None  # since the look before, where a fit at every sample is wanted

    def without_coefficients(self) -> "Estimate":
        """Return the curve alone: every coefficient is unestimated, and nothing is fitted."""
        shape = self.coefficients.status.shape
        nothing = np.full(shape, np.nan)
        return replace(
            self,
            fitted=np.full_like(self.fitted, np.nan),
            coefficients=Coefficients(nothing, nothing, nothing, np.full(shape, Status.UNESTIMATED, np.int8)),
            k_or_r=np.zeros_like(self.k_or_r),
            course=None,
        )
