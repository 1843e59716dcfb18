"""Variance of a window or a recording at each τ, with degrees of freedom and confidence intervals."""

from dataclasses import dataclass

from drivers.data_types import Floats, Ints


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Overlapping Allan variance of six axes at m averaging times."""

    tau_s: Floats  # [m]
    factors: Ints  # [m] cluster sizes in samples
    avar: Floats  # [m, 6] Allan variance in squared units of the axis; NaN if the window is too short
    terms: Ints  # [m, 6] number of averaged second differences
    edf: Floats  # [m, 6] equivalent degrees of freedom of ``avar`` + ``excess``; NaN where ``avar`` is NaN
    lo: Floats  # [m, 6] lower end of the 95 % confidence interval of the Allan deviation
    hi: Floats  # [m, 6] upper end of the 95 % confidence interval of the Allan deviation
    n: int  # number of samples in the window, including missing samples
    # [m, 6] contribution of missing samples that has been subtracted from the mean squares, see ``missing_samples``
    excess: Floats | float = 0.0


@dataclass(frozen=True, slots=True)
class VarianceCurve:
    """Total or Hadamard variance of k axes at m averaging times."""

    tau_s: Floats  # [m]
    factors: Ints  # [m] cluster sizes in samples
    variance: Floats  # [m, k] squared units of the axis; NaN if too many samples are missing
    terms: Ints  # [m, k] number of averaged squared differences
    edf: Floats  # [m, k] equivalent degrees of freedom; NaN if the noise is unknown
    lo: Floats  # [m, k] lower end of the 95 % confidence interval of the deviation; total variance: NaN for τ > T/2
    hi: Floats  # [m, k] upper end of the 95 % confidence interval of the deviation; total variance: NaN for τ > T/2
