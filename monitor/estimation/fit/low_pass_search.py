"""Search for the low-pass filter of a sensor, and fit of the noise coefficients with this filter.

If the bandwidth of a sensor is less than half the sample rate, the Allan variance at the shortest τ is smaller than
N²/τ. The coefficient N would therefore be biased. The fit in this module therefore uses the Allan variance of white
noise after a Butterworth low-pass filter. The filter is either a digital filter at the sample rate or an analogue
filter before sampling. The search selects the order from 1 to 4 and the cutoff frequency with the smallest misfit. The
fit takes the uncertainty of the cutoff frequency into account. If no low-pass filter explains the Allan variances, the
fit without the shortest τ is kept.

N is the level of the white noise in the passband. Only an upper bound of Q is given, because the effects of Q and the
filter cannot be distinguished. A filter is only accepted if the measured spectrum decreases above the cutoff frequency.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Final, Literal

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.minimization import minimize_by_golden_section
from monitor.estimation.allan.uncertainty import CovarianceTable
from monitor.estimation.fit.coefficient_fit import (
    DesignMatrix,
    Fit,
    MeasuredVariancesAndSlopes,
    fit_coefficients,
    replace_axis_results,
)
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.estimation.fit.confidence_bounds import UPPER_BOUND_Z, avar_upper_limit
from monitor.estimation.fit.least_squares import N, Q

Kind = Literal["digital", "sampled"]
"""Kind of low-pass filter: "digital" at the sample rate, or "sampled" for an analogue filter before sampling."""
FAMILIES: Final[tuple[tuple[Kind, int], ...]] = tuple(
    (kind, order) for order in (1, 2, 3, 4) for kind in ("digital", "sampled")
)
"""Kinds and orders of low-pass filters from which the search selects."""
CUTOFFS: Final = np.geomspace(0.005, 0.49, 56)
"""Grid of cutoff frequencies, as fractions of the sample rate."""
SPECTRUM_BINS: Final = 1 << 13
"""Number of bins of the squared frequency response from zero to half the sample rate."""
REFINED_FAMILIES: Final = 3
"""Number of combinations of filter kind and order for which the cutoff frequency is refined."""
CUTOFFS_PER_STEP: Final = 8
"""Number of cutoff frequencies from the grid that one step of the search evaluates."""
REFINED_CUTOFFS_PER_STEP: Final = 10
"""Number of refined cutoff frequencies that one step of the search evaluates."""
CUTOFF_TOLERANCE: Final = 1e-4
"""Relative tolerance of the refined cutoff frequency."""
ALIASES: Final = 8
"""Number of aliases of positive and of negative frequency in the response of a sampled analogue filter."""
MAX_SCATTER: Final = 2.0
"""Largest mean squared residual of the fit with an accepted filter, relative to the expected variance."""
POWER_BINS: Final = 1024
"""Number of bins of the measured power spectrum from zero to half the sample rate."""
MIN_PRESENT_SHARE: Final = 0.98
"""Minimum share of the samples in a segment that must be present to compute its spectrum."""
MAX_STRETCHES: Final = 64
"""Maximum number of segments of the recording over which a power spectrum is averaged."""
MIN_STRETCHES: Final = 4
"""Minimum number of segments of the recording over which a power spectrum is averaged."""
STOPBAND_START: Final = 1.2
"""Start of the stopband, as a multiple of the cutoff frequency."""
MAX_STOPBAND_RATIO: Final = 2.0
"""Largest ratio of the measured level in the stopband to the expected level."""
MAX_STOPBAND_SHARE: Final = 0.05
"""Fraction of the passband level by which the limit of the stopband level is increased."""
CUTOFF_STEP: Final = 1.01
"""Factor by which the cutoff frequency is changed to compute a numerical derivative."""
LOG_CUTOFF_SIGMA: Final = 3.0
"""Prior standard deviation of the logarithm of the cutoff frequency. The large value allows any cutoff frequency."""


@dataclass(frozen=True, slots=True)
class LowPass:
    """Butterworth low-pass filter of a sensor."""

    kind: Kind
    order: int
    cutoff: float  # cutoff frequency as a fraction of the sample rate

    def filtered_white_noise_avar(self, factors: Ints) -> Floats:
        """Return the Allan variance [m] of filtered white noise with N = 1 in the passband and τ0 = 1.

        It is computed as (4 V(m) − V(2m)) / 2m², where V(m) is the variance of a sum of m samples.

        >>> LowPass("digital", 2, 0.1).filtered_white_noise_avar(np.array([1, 1000])).round(6).tolist()
        [0.024355, 0.000998]
        """
        m = np.asarray(factors, np.int64)
        return (4.0 * self._sums(m) - self._sums(2 * m)) / (2.0 * m.astype(np.float64) ** 2)

    def _sums(self, m: Ints) -> Floats:
        level, first = _autocovariance_sums(self.kind, self.order, self.cutoff)
        k = np.minimum(m, level.size) - 1
        return np.asarray(m * level[k] - first[k])


def _squared_response(kind: Kind, order: int, cutoff: float, bins: int = SPECTRUM_BINS) -> Floats:
    scale = (np.tan(np.pi * cutoff) if kind == "digital" else cutoff) ** -2
    response = np.zeros(bins + 1)
    with np.errstate(over="ignore"):
        for squares in _squared_frequencies(kind, bins):
            ratio = scale * squares
            attenuation = ratio
            for _ in range(order - 1):  # several times faster than the power function
                attenuation = attenuation * ratio
            response += 1.0 / (1.0 + attenuation)
    return response


@cache
def _squared_frequencies(kind: Kind, bins: int) -> Floats:
    """Return the squared frequencies [aliases, bins + 1] of the analogue filter. A digital filter has no aliases."""
    f = np.arange(bins + 1) / (2.0 * bins)
    if kind == "digital":
        return np.asarray(np.tan(np.pi * f)[None, :] ** 2)
    return np.asarray((f + np.arange(-ALIASES, ALIASES + 1)[:, None]) ** 2)


@lru_cache(1024)
def _column(low_pass: LowPass, factors: bytes) -> Floats:
    """Return the cached Allan variance of filtered white noise. The cluster sizes are the bytes of an int64 array."""
    return low_pass.filtered_white_noise_avar(np.frombuffer(factors, np.int64))


def _autocovariance_sums(kind: Kind, order: int, cutoff: float) -> tuple[Floats, Floats]:
    """Return the sums of r(k) and |k| r(k) over |k| < n for n = 1, 2, …, where r is the autocovariance.

    The filtered white noise is scaled so that the autocovariances r sum to 1.
    """
    r = np.fft.irfft(_squared_response(kind, order, cutoff))[:SPECTRUM_BINS]
    both = np.where(np.arange(SPECTRUM_BINS) > 0, 2.0, 1.0) * r
    level, first = np.cumsum(both), np.cumsum(both * np.arange(SPECTRUM_BINS))
    return level / level[-1], first / level[-1]


def power_spectrum(rates: Floats) -> Floats:
    """Return the power spectrum [POWER_BINS + 1] of one axis in arbitrary units.

    The spectrum is averaged over segments with few missing samples. If there are too few segments, the result is empty.
    """
    rows = 2 * POWER_BINS
    begins = np.unique(np.linspace(0, len(rates) - rows, MAX_STRETCHES).astype(np.int64))
    if begins[0] < 0 or len(rates) < MIN_STRETCHES * rows:
        return np.empty(0)
    parts = np.stack([rates[begin : begin + rows] for begin in begins])
    parts = parts[np.isfinite(parts).mean(axis=1) >= MIN_PRESENT_SHARE]
    if len(parts) < MIN_STRETCHES:
        return np.empty(0)
    parts = parts - np.nanmean(parts, axis=1, keepdims=True)
    turned = np.fft.rfft(np.nan_to_num(parts) * np.hanning(rows), axis=1)
    return np.asarray((turned.real**2 + turned.imag**2).mean(axis=0))


def is_visible_in_spectrum(low_pass: LowPass, power: Floats) -> bool:
    """Return True if a measured power spectrum decreases above the cutoff frequency of a low-pass filter.

    The function compares the medians of passband and stopband, because a median is insensitive to spectral lines.

    Parameters
    ----------
    low_pass : LowPass
        Low-pass filter to test.
    power : ndarray of float64, shape (POWER_BINS + 1,)
        Power spectrum of the axis, from ``power_spectrum``.
    """
    f = np.arange(power.size) / (2.0 * max(power.size - 1, 1))
    below = (f >= low_pass.cutoff / 4.0) & (f <= low_pass.cutoff / 2.0) & (f >= 3.0 / (2.0 * POWER_BINS))
    beyond = f >= min(STOPBAND_START * low_pass.cutoff, 0.49)
    if not below.any():
        return False
    filtered = _squared_response(low_pass.kind, low_pass.order, low_pass.cutoff, POWER_BINS)
    expected = np.median(filtered[beyond]) / np.median(filtered[below])
    return bool(
        np.median(power[beyond]) <= (MAX_STOPBAND_RATIO * expected + MAX_STOPBAND_SHARE) * np.median(power[below])
    )


def refit_with_low_passes(
    design: DesignMatrix,
    table: CovarianceTable,
    measured: MeasuredVariancesAndSlopes,
    five_term_fit: Fit,
    filters: Sequence[LowPass | None],
) -> tuple[Fit, list[LowPass | None]]:
    """Repeat the fit with a low-pass filter for axes whose Allan variances contradict the five noise terms.

    Parameters
    ----------
    design : DesignMatrix
        Design matrix of the fit without low-pass filters.
    table : CovarianceTable
        Covariances of the Allan variances.
    measured : MeasuredVariancesAndSlopes
        Measured Allan variances and slopes of the rate.
    five_term_fit : Fit
        Fit without low-pass filters.
    filters : sequence of LowPass or None
        Result of ``find_low_pass`` for each axis.

    Returns
    -------
    fit : Fit
        Fit that takes the accepted filters into account.
    filters : list of LowPass or None
        Accepted filter of each axis, or None.
    """
    used: list[LowPass | None] = [None] * len(filters)
    contradicts = axes_contradicting_five_terms(five_term_fit)
    for axis, low_pass in enumerate(filters):
        if low_pass is not None and contradicts[axis]:
            better = _fit_low_pass(design, table, measured.select_axis(axis), low_pass)
            if better.scatter[0] < MAX_SCATTER:
                _bound_q(design, better, measured.select_axis(axis))
                five_term_fit = replace_axis_results(five_term_fit, axis, better)
                used[axis] = low_pass
    return five_term_fit, used


def _bound_q(design: DesignMatrix, fit: Fit, measured: MeasuredVariancesAndSlopes) -> None:
    """Compute an upper bound of Q from the Allan variance at the shortest τ."""
    c, first = fit.coefficients, int(np.argmax(measured.avar[:, 0] > 0.0))
    excess = 0.0 if measured.excess is None else measured.excess[first, 0]
    most = avar_upper_limit(measured.avar[first, 0], excess, fit.edf[first, 0], UPPER_BOUND_Z)
    most /= design.columns[first, Q]
    if np.isfinite(most):
        c.status[Q], c.lo[Q], c.hi[Q] = Status.UPPER_BOUND, 0.0, most**0.5 / design.rate_hz


def axes_contradicting_five_terms(five_term_fit: Fit) -> list[bool]:
    """Return True for each axis of a fit without low-pass filter whose Allan variances contradict the five terms."""
    fit = five_term_fit
    found: list[bool] = ((fit.left_out > 0) | (fit.theta[0] < 0.0) | (fit.misfit > 1.0)).tolist()
    return found


def find_low_pass(
    design: DesignMatrix, table: CovarianceTable, measured: MeasuredVariancesAndSlopes, power: Floats
) -> LowPass | None:
    """Return the low-pass filter that best explains the Allan variances of one axis, or None if no filter is accepted.

    Parameters
    ----------
    design : DesignMatrix
        Design matrix for the cluster sizes.
    table : CovarianceTable
        Covariances of the Allan variances.
    measured : MeasuredVariancesAndSlopes
        Measured Allan variances of a single axis.
    power : ndarray of float64
        Power spectrum of the axis, from ``power_spectrum``.
    """
    search = search_low_pass_in_steps(design, table, measured, power)
    while True:
        try:
            next(search)
        except StopIteration as end:
            found: LowPass | None = end.value
            return found


def search_low_pass_in_steps(
    design: DesignMatrix, table: CovarianceTable, measured: MeasuredVariancesAndSlopes, power: Floats
) -> Generator[None, None, LowPass | None]:
    """Search for the low-pass filter of one axis in steps that take a few milliseconds.

    The generator yields after each step. The parameters and the result are those of ``find_low_pass``.
    """
    factors = np.ascontiguousarray(design.factors, np.int64).tobytes()
    grids: list[list[float]] = []
    for kind, order in FAMILIES:
        grids.append([])
        for number, cutoff in enumerate(CUTOFFS):
            column = _column(LowPass(kind, order, float(cutoff)), factors)
            grids[-1].append(float(_fit_columns(_with_noise_column(design, column), table, measured).scatter[0]))
            if number % CUTOFFS_PER_STEP == CUTOFFS_PER_STEP - 1:
                yield
    found = []
    for family in np.argsort([min(grid) for grid in grids])[:REFINED_FAMILIES]:
        kind, order = FAMILIES[family]
        at = int(np.argmin(grids[family]))
        ends = np.log(CUTOFFS[[max(at - 1, 0), min(at + 1, CUTOFFS.size - 1)]])

        def scatter_at(log_cutoff: float, kind: Kind = kind, order: int = order) -> float:
            column = LowPass(kind, order, float(np.exp(log_cutoff))).filtered_white_noise_avar(design.factors)
            return float(_fit_columns(_with_noise_column(design, column), table, measured).scatter[0])

        least, log_cutoff = yield from _yield_after_several_steps(
            minimize_by_golden_section(scatter_at, float(ends[0]), float(ends[1]), CUTOFF_TOLERANCE)
        )
        found.append((least, LowPass(kind, order, float(np.exp(log_cutoff)))))
        yield
    least, low_pass = min(found, key=lambda one: one[0])
    return low_pass if least < MAX_SCATTER and is_visible_in_spectrum(low_pass, power) else None


def _yield_after_several_steps(
    search: Generator[None, None, tuple[float, float]],
) -> Generator[None, None, tuple[float, float]]:
    steps = 0
    while True:
        try:
            next(search)
        except StopIteration as end:
            found: tuple[float, float] = end.value
            return found
        steps += 1
        if steps % REFINED_CUTOFFS_PER_STEP == 0:
            yield


def _fit_columns(design: DesignMatrix, table: CovarianceTable, measured: MeasuredVariancesAndSlopes) -> Fit:
    return fit_coefficients(design, table, measured, full_covariance=False, may_drop_short_taus=False)


def _with_noise_column(design: DesignMatrix, column: Floats) -> DesignMatrix:
    columns = design.columns.copy()
    columns[:, N], columns[:, Q] = column, 0.0
    return replace(design, columns=columns)


def _fit_low_pass(
    design: DesignMatrix, table: CovarianceTable, measured: MeasuredVariancesAndSlopes, low_pass: LowPass
) -> Fit:
    """Fit the coefficients with a low-pass filter whose cutoff frequency is uncertain."""
    factors = np.ascontiguousarray(design.factors, np.int64).tobytes()
    up, down = (
        _column(replace(low_pass, cutoff=low_pass.cutoff * by), factors) for by in (CUTOFF_STEP, 1.0 / CUTOFF_STEP)
    )
    own = _with_noise_column(design, _column(low_pass, factors))
    rough = _fit_columns(own, table, measured)
    level = max(float(rough.theta[N, 0]) * design.rate_hz, 0.0)
    ignored_direction = level * LOG_CUTOFF_SIGMA * (up - down) / (2.0 * np.log(CUTOFF_STEP))
    return fit_coefficients(own, table, measured, ignored_direction=ignored_direction, may_drop_short_taus=False)
