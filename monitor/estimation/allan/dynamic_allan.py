"""Dynamic curves of a whole recording: the Allan surface and Q(t) N(t) B(t) K(t) R(t).

A window slides along the recording in steps; at each step the overlapping Allan variance of the window is read and
fitted, as the live ``Estimator`` does while it watches ("Dynamic extraction of random drift error coefficients of MEMS
gyroscopes": the windowed variance renewed sample by sample, then a least-squares fit). What changed shows where a
curve of the whole recording averages over before and after. Terms enter and leave with the hysteresis of a fit that
is repeated: each step is told what was in at the step before.

Only full windows are shown, so that every time step is as sure as the next. There are MOST_STEPS steps at most,
however long the recording is, so that months cost no more memory than hours; all samples enter every window that
holds them. A change is seen in full one window after it happened: until then old and new are mixed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError, NotReady
from drivers.sample import Floats
from monitor.estimation.allan.batch import TauGrid, cluster_sizes
from monitor.estimation.allan.uncertainty import intervals, table
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH, AllanWindow
from monitor.estimation.fit.coefficient_fit import design, fit

STEPS_A_WINDOW: Final = 20
"""Steps in the time of one window, unless told otherwise."""
MOST_STEPS: Final = 500

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Dynamic:
    """What the window showed at T times; columns gx … az, rows of the coefficients Q N B K R, all in SI."""

    t_s: Floats  # [T] END of the window, seconds since the first sample; the window began ``window_s`` before
    window_s: float
    rate_hz: float
    tau_s: Floats  # [m]
    deviation: Floats  # [T, m, 6] Allan deviation, unit of the axis; NaN = no complete term in that window
    lo: Floats  # [T, m, 6] ends of its 95 % interval
    hi: Floats
    value: Floats  # [T, 5, 6] coefficients; NaN unless estimated
    value_lo: Floats  # [T, 5, 6] ends of the 95 % interval; of a bound 0 and the one-sided 95 % bound
    value_hi: Floats
    status: NDArray[np.int8]  # [T, 5, 6] of Status


def dynamic(
    values: Floats,
    rate_hz: float,
    window_s: float,
    tau: TauGrid = "octave",
    step_s: float | None = None,
    progress: Progress | None = None,
) -> Dynamic:
    """The dynamic curves of a recording on a regular grid.

    Args:
        values: [n, 6] rad/s and m/s²; NaN = missing, in its place
        rate_hz: samples a second
        window_s: length of the sliding window
        tau: grid or list of averaging times within the window
        step_s: between two times; None = a twentieth of the window. It is made longer where there would be more than
            MOST_STEPS steps
        progress: called with the share that is done, 0 … 1
    Raises:
        ConfigError: a window that is too short or too long, a step below 0, or no τ that fits the window
        NotReady: the recording is shorter than the window

    >>> steady = dynamic(np.random.default_rng(1).standard_normal((3000, 6)), 10.0, 100.0, step_s=50.0)
    >>> steady.t_s.tolist()
    [100.0, 150.0, 200.0, 250.0, 300.0]
    >>> steady.deviation.shape, steady.value.shape
    ((5, 8, 6), (5, 5, 6))
    """
    length = _length(rate_hz, window_s)
    ends = _ends(len(values), length, rate_hz, step_s)
    factors = cluster_sizes(length, rate_hz, tau)
    window = AllanWindow(length, factors)
    columns, covariances = design(factors, rate_hz), table(length, factors)
    steps, taus, axes = ends.size, factors.size, values.shape[1]
    deviation, lo, hi = np.full((3, steps, taus, axes), np.nan)
    value, value_lo, value_hi = np.full((3, steps, 5, axes), np.nan)
    status = np.zeros((steps, 5, axes), np.int8)
    entered = np.zeros((5, axes), np.bool_)
    start = 0
    for row, end in enumerate(ends.tolist()):
        window.update(values[start:end])
        start = end
        avar = window.avar()
        slope, slopes = window.slope() * rate_hz, window.slopes() * rate_hz
        found = fit(columns, covariances, avar, window.terms(), entered, slope, slopes)
        entered = found.entered
        deviation[row] = np.sqrt(avar)
        lo[row], hi[row] = intervals(avar, found.edf)
        known = found.coefficients
        value[row], value_lo[row], value_hi[row], status[row] = known.value, known.lo, known.hi, known.status
        if progress is not None:
            progress((row + 1) / steps)
    return Dynamic(
        ends / rate_hz, length / rate_hz, rate_hz, factors / rate_hz,
        deviation, lo, hi, value, value_lo, value_hi, status,
    )  # fmt: skip


def _length(rate_hz: float, window_s: float) -> int:
    """Samples in the window."""
    length = round(window_s * rate_hz)
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        raise ConfigError(
            f"window of {window_s:g} s: {length} samples at {rate_hz:g} Hz; possible are "
            f"{MIN_LENGTH / rate_hz:g} to {MAX_LENGTH / rate_hz:g} s"
        )
    return length


def _ends(n: int, length: int, rate_hz: float, step_s: float | None) -> NDArray[np.int64]:
    """How many samples have passed at each step: the first full window, then on in equal steps."""
    if step_s is not None and not 0.0 < step_s < np.inf:
        raise ConfigError(f"step of {step_s:g} s; it must be above 0")
    if n < length:
        raise NotReady(f"{n / rate_hz:g} s are recorded, less than the window of {length / rate_hz:g} s")
    step = max(round(length / STEPS_A_WINDOW if step_s is None else step_s * rate_hz), 1)
    fewest = -(-(n - length) // (MOST_STEPS - 1))
    return np.arange(length, n + 1, max(step, fewest), dtype=np.int64)
