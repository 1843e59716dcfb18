"""Fit of outliers and of heavy tails to white residuals.

The magnitudes of the residuals are fitted by a Gaussian, Student's t and a mixture of two Gaussians (Tukey 1960). The
mixture is (1−f) N(0, s²) + f N(0, s² + scale²) with the outlier fraction f. True outliers fit the mixture best and are
equally likely at all times. Heavy tails fit Student's t best, and large magnitudes are equally likely at all times.

The magnitudes are collected in bins, so that the fit time does not grow with the recording length.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtrc, gammaln, ndtr, ndtri, pdtrc, stdtr

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import NORMAL_QUARTILE, Z95
from monitor.reconcile.preparation.value_artifacts import Mask, ValueWithInterval

LINEAR_BINS: Final = 240
LINEAR_RANGE_SIGMA: Final = 6.0
"""Magnitude, in standard deviations, up to which the bins have equal width."""
TOTAL_BINS: Final = 1024
BINS_PER_LOG_UNIT: Final = 34.0
"""Number of bins per factor of e beyond the linear range."""
BIN_EDGES: Final = np.concatenate(
    [
        np.arange(LINEAR_BINS) * LINEAR_RANGE_SIGMA / LINEAR_BINS,
        LINEAR_RANGE_SIGMA * np.exp(np.arange(TOTAL_BINS - LINEAR_BINS + 1) / BINS_PER_LOG_UNIT),
    ]
)
"""Edges of the bins, in standard deviations."""
START_WIDTHS: Final = np.array([1.3, 1.6, 2.0, 2.6, 3.4, 5.0, 8.0, 15.0, 40.0, 200.0, 3000.0])
"""Starting values of the EM algorithm: standard deviation of the wide component relative to the narrow one."""
NEIGHBOUR_SAMPLES: Final = 4
"""Largest distance, in samples, between neighbouring outliers."""
STUDENT_FREEDOMS: Final = np.geomspace(1.0, 300.0, 40)
MIN_MIXTURE_GAIN_NATS: Final = 0.01
MIN_PROBABILITY: Final = 1e-300
MAX_Z: Final = 37.0
"""z value of a probability that underflows in 64 bits."""
STUDENT_TABLE_SIZE: Final = 1 << 15
"""Number of values between which the conversion from Student's t is interpolated. The relative error is about 10⁻⁷."""


@dataclass(frozen=True, slots=True)
class OutlierFit:
    """Fit of outliers to white residuals, with tests against other explanations."""

    fraction: ValueWithInterval
    scale: ValueWithInterval  # standard deviation of the error that is added to a sample
    mask: Mask  # [n] True for samples that are more likely outliers than not
    count: int  # number of samples in the mask
    gain: float  # log-likelihood gain over one Gaussian, nats
    gain_over_student: float  # log-likelihood gain over Student's t, nats; the mixture has one more parameter
    clustering_z: float  # z of the clustering of outliers, corrected for the number of tests
    misfit_z: float  # z of the misfit between the magnitudes and the mixture
    student: "StudentFit"


@dataclass(frozen=True, slots=True)
class StudentFit:
    """Fit of Student's t distribution to white residuals."""

    nu: ValueWithInterval  # degrees of freedom
    scale: float  # scale of the distribution
    log_likelihood: float


def fit_outliers(residuals: Floats) -> OutlierFit | None:
    """Fit a mixture of two Gaussians to white residuals.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals. NaN values are ignored.

    Returns
    -------
    OutlierFit or None
        Best mixture, or None if a single Gaussian fits equally well.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> w = rng.standard_normal(20_000)
    >>> w[::400] += 8.0 * rng.standard_normal(50)
    >>> found = fit_outliers(w)
    >>> print(f"{found.fraction.value:.4f} {found.scale.value:.1f}", found.gain > 100.0, found.gain_over_student > 5.0)
    0.0023 7.2 True True
    """
    good = np.isfinite(residuals)
    n = int(good.sum())
    some = np.abs(residuals[good][:: max(1, n // 20_000)])
    unit = float(np.median(some)) / NORMAL_QUARTILE if n >= 100 else 0.0
    if not unit > 0.0:
        return None
    counts, squares = _bin_magnitudes(residuals, unit)
    kept = np.flatnonzero(counts)
    counts, squares = counts[kept], squares[kept] / counts[kept]
    narrow, wide, share, best = _fit_mixture(counts, squares, START_WIDTHS)
    mixture = (1.0 - share) * ndtr(BIN_EDGES / narrow**0.5) + share * ndtr(BIN_EDGES / wide**0.5)
    gain = best - _gaussian_log_likelihood(counts, squares)
    student = _fit_student(counts, squares, unit)
    if not (gain > MIN_MIXTURE_GAIN_NATS and wide > narrow):
        return None
    far = _outlier_threshold(narrow, wide, share)
    mask = (
        np.asarray(np.abs(residuals) > far * unit) & good
        if np.isfinite(far)
        else np.zeros(residuals.size, dtype=np.bool_)
    )
    fraction, scale = _parameter_intervals(counts, squares, narrow, wide, share)
    return OutlierFit(
        fraction=fraction,
        scale=ValueWithInterval(unit * scale.value, unit * scale.lo, unit * scale.hi),
        mask=mask,
        count=int(mask.sum()),
        gain=float(gain),
        gain_over_student=float(best - student.log_likelihood),
        clustering_z=_clustering_z(np.flatnonzero(mask), residuals.size),
        misfit_z=_misfit_z(counts, kept, mixture),
        student=student,
    )


def student_misfit_z(residuals: Floats, fit: StudentFit) -> float:
    """Return the z value of a χ² goodness-of-fit test of a fitted Student's t distribution.

    Parameters
    ----------
    residuals : ndarray of float64, shape (n,)
        White residuals. NaN values are ignored.
    fit : StudentFit
        Fit of the residuals.
    """
    counts, _ = _bin_magnitudes(residuals, fit.scale)
    kept = np.flatnonzero(counts)
    return _misfit_z(counts[kept], kept, stdtr(fit.nu.value, BIN_EDGES))


def convert_student_to_gaussian(values: Floats, nu: float) -> Floats:
    """Convert values that follow Student's t distribution to values that follow a standard normal distribution.

    Parameters
    ----------
    values : ndarray of float64, shape (n,)
        Values with a variance of 1.
    nu : float
        Degrees of freedom, above 2.

    Examples
    --------
    >>> t = np.random.default_rng(0).standard_t(4.0, 100_000) / 2.0**0.5
    >>> print(f"{np.mean(convert_student_to_gaussian(t, 4.0) ** 4):.1f}")
    3.0
    """
    places = np.log1p(np.abs(values))
    table = np.linspace(0.0, places.max(initial=0.0), STUDENT_TABLE_SIZE)
    below = stdtr(nu, -np.expm1(table) * (nu / (nu - 2.0)) ** 0.5)
    return np.asarray(np.copysign(np.interp(places, table, ndtri(np.maximum(below, MIN_PROBABILITY))), values))


@compiled
def _bin_magnitudes(w: Floats, unit: float) -> tuple[Floats, Floats]:
    counts, squares = np.zeros(TOTAL_BINS), np.zeros(TOTAL_BINS)
    for k in range(w.size):
        x = abs(w[k]) / unit
        if x <= 1e10:  # false for NaN
            at = (
                int(x * (LINEAR_BINS / LINEAR_RANGE_SIGMA))
                if x < LINEAR_RANGE_SIGMA
                else LINEAR_BINS + int(BINS_PER_LOG_UNIT * np.log(x / LINEAR_RANGE_SIGMA))
            )
            counts[at] += 1.0
            squares[at] += x * x
    return counts, squares


@compiled
def _fit_mixture(counts: Floats, squares: Floats, start_widths: Floats) -> tuple[float, float, float, float]:
    """Fit the mixture by the EM algorithm from several starting values.

    Return the variances of the two Gaussians, the share of the wide Gaussian, and the log-likelihood.
    """
    total = counts.sum()
    mean = (counts * squares).sum() / total
    best = (mean, mean, 0.0, -np.inf)
    for one in start_widths:
        narrow, wide, share = min(1.0, mean), one * one, 0.01
        for step in range(40):
            share, narrow, wide, like = _em_step(counts, squares, total, narrow, wide, share, step < 15)
        if like > best[3]:
            best = (narrow, wide, share, like)
    narrow, wide, share, like = best
    for _ in range(600):
        last = like
        share, narrow, wide, like = _em_step(counts, squares, total, narrow, wide, share, False)
        if like - last < 1e-7:
            break
    return narrow, wide, share, like


@compiled
def _em_step(
    counts: Floats, squares: Floats, total: float, narrow: float, wide: float, share: float, held: bool
) -> tuple[float, float, float, float]:
    """Update the mixture by one EM step, and return the log-likelihood before the step.

    If ``held`` is True, the wide variance stays fixed.
    """
    outside, outside_squares, inside_squares, like = 0.0, 0.0, 0.0, 0.0
    log_narrow = np.log1p(-share) - 0.5 * np.log(narrow)
    log_wide = np.log(share) - 0.5 * np.log(wide)
    for k in range(counts.size):
        apart = (log_wide - 0.5 * squares[k] / wide) - (log_narrow - 0.5 * squares[k] / narrow)
        if apart > 0.0:
            small = np.exp(-apart)
            part = 1.0 / (1.0 + small)
            like += counts[k] * (log_wide - 0.5 * squares[k] / wide + np.log1p(small))
        else:
            small = np.exp(apart)
            part = small / (1.0 + small)
            like += counts[k] * (log_narrow - 0.5 * squares[k] / narrow + np.log1p(small))
        outside += counts[k] * part
        outside_squares += counts[k] * part * squares[k]
        inside_squares += counts[k] * (1.0 - part) * squares[k]
    share = min(max(outside / total, 1e-12), 1.0 - 1e-12)
    narrow = inside_squares / max(total - outside, 1e-9)
    if not held:
        wide = max(outside_squares / max(outside, 1e-9), narrow)
    return share, narrow, wide, like - 0.5 * total * np.log(2.0 * np.pi)


def _gaussian_log_likelihood(counts: Floats, squares: Floats) -> float:
    total = counts.sum()
    return -0.5 * float(total * (np.log(2.0 * np.pi * np.dot(counts, squares) / total) + 1.0))


def _mixture_log_density(squares: Floats, narrow: float, wide: float, share: float) -> Floats:
    inside = np.log1p(-share) - 0.5 * (np.log(2.0 * np.pi * narrow) + squares / narrow)
    outside = np.log(share) - 0.5 * (np.log(2.0 * np.pi * wide) + squares / wide)
    return np.asarray(np.logaddexp(inside, outside))


def _fit_student(counts: Floats, squares: Floats, unit: float) -> StudentFit:
    """Fit Student's t distribution to magnitudes in ``unit``.

    The EM algorithm fits the scale s with the weights (ν+1)/(ν + x²/s²) (Lange, Little & Taylor 1989) for all degrees
    of freedom ν.
    """
    column = STUDENT_FREEDOMS[:, None]
    scale = np.ones_like(column)
    for _ in range(30):
        weights = (column + 1.0) / (column + squares / scale)
        scale = ((weights * squares) @ counts / (weights @ counts))[:, None]
    each = (
        gammaln(0.5 * (column + 1.0))
        - gammaln(0.5 * column)
        - 0.5 * np.log(np.pi * column * scale)
        - 0.5 * (column + 1.0) * np.log1p(squares / (column * scale))
    )
    likes = each @ counts
    best = int(likes.argmax())
    top, apart = float(likes[best]), 0.0
    spacing = float(np.log(STUDENT_FREEDOMS[1] / STUDENT_FREEDOMS[0]))
    if not 0 < best < STUDENT_FREEDOMS.size - 1:
        value = float(STUDENT_FREEDOMS[best])
        return StudentFit(ValueWithInterval(value, value, value), unit * float(scale[best, 0]) ** 0.5, top)
    # maximum of the parabola through the best three values
    left, right = top - float(likes[best - 1]), top - float(likes[best + 1])
    curvature = max(left + right, 1e-9)
    apart = 0.5 * (left - right) / curvature
    nu = float(STUDENT_FREEDOMS[best] * np.exp(apart * spacing))
    half = float(np.exp(Z95 * spacing / curvature**0.5))
    width = np.interp(best + apart, np.arange(STUDENT_FREEDOMS.size), scale[:, 0]) ** 0.5
    top += 0.125 * (left - right) ** 2 / curvature
    return StudentFit(ValueWithInterval(nu, nu / half, nu * half), unit * float(width), top)


def _outlier_threshold(narrow: float, wide: float, share: float) -> float:
    """Return the magnitude above which a sample is more likely an outlier than not."""
    square = 2.0 * (np.log1p(-share) - np.log(share) + 0.5 * np.log(wide / narrow)) / (1.0 / narrow - 1.0 / wide)
    return float(square**0.5) if square > 0.0 else 0.0


def _parameter_intervals(
    counts: Floats, squares: Floats, narrow: float, wide: float, share: float
) -> tuple[ValueWithInterval, ValueWithInterval]:
    at = np.array([0.5 * np.log(narrow), 0.5 * np.log(max(wide - narrow, 1e-12)), np.log(share) - np.log1p(-share)])

    def log_likelihood(x: Floats) -> float:
        inner, f = np.exp(2.0 * x[0]), 1.0 / (1.0 + np.exp(-x[2]))
        return float(np.dot(counts, _mixture_log_density(squares, inner, inner + np.exp(2.0 * x[1]), f)))

    step = np.diag([1e-3 / max(1.0, (counts.sum() / 1e4) ** 0.5), 0.02, 0.02])
    curve = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            a, b = step[i], step[j]
            curve[i, j] = (
                log_likelihood(at + a - b)
                + log_likelihood(at - a + b)
                - log_likelihood(at + a + b)
                - log_likelihood(at - a - b)
            ) / (4.0 * a[i] * b[j])
    variance = np.diag(np.linalg.pinv(curve))
    half = np.where(variance > 0.0, Z95 * np.sqrt(np.maximum(variance, 0.0)), 700.0)
    with np.errstate(over="ignore"):
        f = 1.0 / (1.0 + np.exp(-(at[2] + half[2] * np.array([0.0, -1.0, 1.0]))))
        scale = np.exp(at[1] + half[1] * np.array([0.0, -1.0, 1.0]))
    return ValueWithInterval(*map(float, f)), ValueWithInterval(*map(float, scale))


def _clustering_z(positions: Ints, n: int) -> float:
    """Return the z value of the strongest of several tests for clusters of outliers.

    The first test compares the number of pairs of outliers within ``NEIGHBOUR_SAMPLES`` samples with a Poisson
    distribution. The other tests count the outliers in 4, 8, … parts of the recording and compare the dispersion with
    χ² (Cochran 1954). The smallest probability is multiplied by the number of tests.
    """
    if positions.size < 2:
        return 0.0
    pairs = sum(
        int(np.count_nonzero(positions[k:] - positions[:-k] <= NEIGHBOUR_SAMPLES))
        for k in range(1, min(NEIGHBOUR_SAMPLES, positions.size - 1) + 1)
    )
    expected = NEIGHBOUR_SAMPLES * positions.size * (positions.size - 1.0) / n
    if expected < 0.2 * positions.size:
        chances = [float(pdtrc(pairs - 1, expected)) if pairs else 1.0]
    else:  # outliers are so frequent that only the next sample is informative
        following = int(np.count_nonzero(np.diff(positions) == 1))
        chances = [float(bdtrc(following - 1, positions.size, positions.size / n)) if following else 1.0]
    parts = 4
    while 2 * parts <= positions.size and parts <= 4096:
        held = np.bincount(positions * parts // n, minlength=parts)
        mean = positions.size / parts
        spread = float(((held - mean) ** 2).sum()) / (mean * (1.0 - positions.size / n))
        chances.append(float(chdtrc(parts - 1, spread)))
        parts *= 2
    return _z_of_probability(min(chances) * len(chances))


def _z_of_probability(probability: float) -> float:
    """Return the z value of a one-sided tail probability, but at least 0."""
    if probability > 0.5:
        return 0.0
    return -float(ndtri(probability)) if probability > 1e-300 else MAX_Z


def _misfit_z(counts: Floats, kept: NDArray[np.intp], below: Floats) -> float:
    """Return the z value of a χ² goodness-of-fit test of a distribution function at the edges of the bins."""
    total = counts.sum()
    expected = 2.0 * total * np.diff(below)
    seen = np.zeros(TOTAL_BINS)
    seen[kept] = counts
    groups = np.minimum((2.0 * (below[:-1] - 0.5)) * 40.0, 39.0).astype(np.int64)  # forty groups of equal probability
    tail = np.minimum(np.floor(-np.log2(np.maximum(2.0 * (1.0 - below[:-1]), 1e-300))), np.log2(total / 20.0))
    groups = groups + np.maximum(tail.astype(np.int64), 0) * (groups == 39)
    want, have = np.bincount(groups, expected), np.bincount(groups, seen)
    some = want > 5.0
    square = float(((have - want)[some] ** 2 / want[some]).sum())
    return _z_of_probability(float(chdtrc(max(int(some.sum()) - 4, 1), square)))
