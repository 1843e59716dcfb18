"""Dynamic Allan variance, which gives the Allan deviation and noise coefficients of a recording as functions of time.

A window slides along the recording in steps. At each step, the overlapping Allan variance is computed, and the noise
coefficients Q, N, B, K and R are fitted to it. The method follows "Dynamic extraction of random drift error
coefficients of MEMS gyroscopes". Noise terms enter and leave the fit with hysteresis, so each fit starts from the terms
of the previous fit.

Results are computed only for full windows, so a change of the noise is fully visible one window length later.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from drivers.errors import ConfigError, NotReady
from monitor.estimation.allan.batch import NO_PAUSES, TauGrid, cluster_sizes
from monitor.estimation.allan.uncertainty import covariance_table, deviation_intervals
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH, AllanWindow
from monitor.estimation.fit.coefficient_fit import MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix

STEPS_PER_WINDOW: Final = 20
"""Default number of steps in which the window moves by its own length."""
MAX_STEPS: Final = 500

Progress = Callable[[float], None]
"""Type of a function that receives the completed fraction of the computation, from 0 to 1."""


@dataclass(frozen=True, slots=True)
class DynamicAllan:
    """Dynamic Allan variance of six axes at T times, in SI units.

    The last dimension of each array is the axis, in the order gx, gy, gz, ax, ay, az. The coefficients are in the order
    Q, N, B, K, R.
    """

    t_s: Floats  # [T] end of each window, in seconds since the first sample
    window_s: float  # length of the sliding window
    rate_hz: float
    tau_s: Floats  # [m]
    deviation: Floats  # [T, m, 6] Allan deviation in units of the axis; NaN if too many samples are missing
    lo: Floats  # [T, m, 6] lower end of the 95 % confidence interval of the Allan deviation
    hi: Floats  # [T, m, 6] upper end of the 95 % confidence interval of the Allan deviation

    value: Floats  # [T, 5, 6] coefficients; NaN unless estimated
    value_lo: Floats  # [T, 5, 6] lower end of the 95 % confidence interval; 0 if only an upper bound is known
    value_hi: Floats  # [T, 5, 6] upper end of the 95 % confidence interval, or the one-sided 95 % upper bound
    status: NDArray[np.int8]  # [T, 5, 6] values of ``Status``


def compute_dynamic_allan(
    values: Floats,
    rate_hz: float,
    window_s: float,
    tau: TauGrid = "octave",
    step_s: float | None = None,
    progress: Progress | None = None,
    pauses: Ints = NO_PAUSES,
) -> DynamicAllan:
    """Compute the dynamic Allan variance and the noise coefficients of a recording with a constant sample rate.

    Parameters
    ----------
    values : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    window_s : float
        Length of the sliding window in seconds.
    tau : TauGrid
        Name of a grid of averaging times, or a tuple of times in seconds.
    step_s : float or None
        Time step of the sliding window in seconds. None means a twentieth of the window length. The step is increased
        if the number of steps would exceed ``MAX_STEPS``.
    progress : Progress or None
        Function that is called with the completed fraction of the computation, from 0 to 1.
    pauses : ndarray of int64
        Rows of missing samples that represent a pause of any length. No cluster that contains such a row counts.

    Raises
    ------
    ConfigError
        If the window length, the step or the averaging times are out of range.
    NotReady
        If the recording is shorter than the window.

    >>> steady = compute_dynamic_allan(np.random.default_rng(1).standard_normal((3000, 6)), 10.0, 100.0, step_s=50.0)
    >>> steady.t_s.tolist()
    [100.0, 150.0, 200.0, 250.0, 300.0]
    >>> steady.deviation.shape, steady.value.shape
    ((5, 8, 6), (5, 5, 6))
    """
    length = _length(rate_hz, window_s)
    ends = _ends(len(values), length, rate_hz, step_s)
    factors = cluster_sizes(length, rate_hz, tau)
    window = AllanWindow(length, factors)
    columns, covariances = make_design_matrix(factors, rate_hz), covariance_table(length, factors)
    steps, taus, axes = ends.size, factors.size, values.shape[1]
    deviation, lo, hi = np.full((3, steps, taus, axes), np.nan)
    value, value_lo, value_hi = np.full((3, steps, 5, axes), np.nan)
    status = np.zeros((steps, 5, axes), np.int8)
    entered = np.zeros((5, axes), np.bool_)
    start = 0
    for row, end in enumerate(ends.tolist()):
        for pause in pauses[(pauses >= start) & (pauses < end)].tolist():
            window.append_samples(values[start : pause + 1])
            for axis in range(axes):
                window.keep_newest(axis, 0)
            start = pause + 1
        window.append_samples(values[start:end])
        start = end
        (avar, terms, excess), (slope, slopes) = window.variances(), window.drift_slopes_by_axis_and_tau()
        measured = MeasuredVariancesAndSlopes(avar, terms, slope * rate_hz, slopes * rate_hz, entered, excess)
        found = fit_coefficients(columns, covariances, measured)
        entered = found.entered
        deviation[row] = np.sqrt(np.maximum(avar, 0.0))
        lo[row], hi[row] = deviation_intervals(avar, found.edf, excess=excess)
        known = found.coefficients
        value[row], value_lo[row], value_hi[row], status[row] = known.value, known.lo, known.hi, known.status
        if progress is not None:
            progress((row + 1) / steps)
    return DynamicAllan(
        ends / rate_hz, length / rate_hz, rate_hz, factors / rate_hz,
        deviation, lo, hi, value, value_lo, value_hi, status,
    )  # fmt: skip


def _length(rate_hz: float, window_s: float) -> int:
    length = round(window_s * rate_hz)
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        raise ConfigError(
            f"window of {window_s:g} s: {length} samples at {rate_hz:g} Hz; possible are "
            f"{MIN_LENGTH / rate_hz:g} to {MAX_LENGTH / rate_hz:g} s"
        )
    return length


def _ends(n: int, length: int, rate_hz: float, step_s: float | None) -> NDArray[np.int64]:
    if step_s is not None and not 0.0 < step_s < np.inf:
        raise ConfigError(f"step of {step_s:g} s; the step must be above 0")
    if n < length:
        raise NotReady(f"{n / rate_hz:g} s are recorded, less than the window of {length / rate_hz:g} s")
    step = max(round(length / STEPS_PER_WINDOW if step_s is None else step_s * rate_hz), 1)
    fewest = -(-(n - length) // (MAX_STEPS - 1))
    return np.arange(length, n + 1, max(step, fewest), dtype=np.int64)
