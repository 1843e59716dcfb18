"""All that one refit produces."""

from dataclasses import dataclass

from drivers.sample import Floats
from monitor.estimate.coefficients import Coefficients
from monitor.estimate.curve import AllanCurve


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
