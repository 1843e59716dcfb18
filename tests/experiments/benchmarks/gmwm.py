"""Generalized Method of Wavelet Moments with its ranking of models, the method most similar to ``reconcile``.

For a series, ``rank`` returns all nested models of WN, QN, RW, DR and up to three AR1, the best model first. Each model
is fitted to the Haar wavelet variance of the series by weighted least squares (S. Guerrier, J. Skaloud, Y. Stebler &
M.-P. Victoria-Feser, "Wavelet-variance-based estimation for composite stochastic processes", J. Am. Stat. Assoc. 108
(2013) 1021). The models are ranked by the wavelet variance information criterion. This criterion is the objective at
the fit plus the optimism 2 tr(Ω cov[ν̂, ν(θ̂)]) (S. Guerrier, R. Molinari & J. Skaloud, "Automatic identification and
calibration of stochastic parameters in inertial sensors", Navigation 62 (2015) 265; J. Balamuta, S. Guerrier,
R. Molinari & W. Yang, arXiv:1603.05297).

The settings are the defaults of the authors' packages: classical variance of the MODWT without its boundary, intervals
of χ² with max(M/2^j, 1) degrees of freedom ("η₃" of D. B. Percival, Biometrika 82 (1995) 619), Ω = diag(1/(hi − lo)²),
and the covariance V of ν̂ of the largest model. There are three differences. V is the asymptotic covariance of the 2013
article instead of a simulated one. The linear sizes are solved exactly by non-negative least squares, and only the
correlation times are searched. The optimism omits the second derivatives of ν(θ), which matter only if no model is
right. A model with a term of size 0 is ranked only as the smaller model.

All quantities are in units of the series and in samples, with scales τ = 2^j. A wavelet coefficient is half the
difference of two successive means of τ/2 samples, so its variance is half the Allan variance at τ/2.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
from scipy.optimize import minimize, nnls
from scipy.stats import chi2

from drivers.data_types import Floats

TERMS: Final = ("WN", "QN", "RW", "DR")
"""Terms with one parameter: white noise, quantization noise, random walk, drift."""
MAX_AR1: Final = 3
"""Number of AR1 in the largest model."""
GRID: Final = 25
"""Number of correlation times in the grid at the start of a search."""
STEP: Final = 1e-4
"""Step of the logarithm of a correlation time for its derivative."""
MIN_SINGULAR_VALUE: Final = 1e-7
"""Smaller singular values of a normalised Jacobian count as 0, for terms that cannot be distinguished."""


@dataclass(frozen=True, slots=True)
class WaveletVariance:
    """Wavelet variance [J] of a series of ``n`` samples, with 95 % intervals."""

    n: int
    scales: Floats  # 2^j samples
    variance: Floats
    lo: Floats
    hi: Floats


@dataclass(frozen=True, slots=True)
class KnownPart:
    """Known part of a series: wavelet variance [J], and spectrum [n // 2] at k/n relative to white noise."""

    variance: Floats
    density: Floats


@dataclass(frozen=True, slots=True)
class FittedModel:
    """Fitted model with its criterion."""

    terms: tuple[str, ...]  # in the order of TERMS
    sizes: tuple[float, ...]  # variance of the innovations, or squared slope of a drift
    times: tuple[float, ...]  # correlation time of each AR1 in samples
    sigmas: tuple[float, ...]  # standard deviation of each AR1
    objective: float
    optimism: float

    @property
    def criterion(self) -> float:
        """Wavelet variance information criterion. A smaller value is better."""
        return self.objective + self.optimism

    def density(self, n: int) -> Floats:
        """Return the spectrum [n // 2] at k/n, without drift."""
        chord = 4.0 * np.sin(np.pi * np.arange(1, n // 2 + 1) / n) ** 2
        shape = {"WN": np.ones_like(chord), "QN": chord, "RW": 1.0 / chord}
        total = np.zeros_like(chord)
        for term, size in zip(self.terms, self.sizes, strict=True):
            if term in shape:
                total += size * shape[term]
        for time, sigma in zip(self.times, self.sigmas, strict=True):
            phi, rest = np.exp(-1.0 / time), -np.expm1(-1.0 / time)
            total += sigma**2 * rest * (1.0 + phi) / (rest**2 + phi * chord)
        return total

    def size(self, term: str) -> float:
        """Return the size of a term, or 0 without this term."""
        return dict(zip(self.terms, self.sizes, strict=True)).get(term, 0.0)


# --- wavelet variance


def wavelet_variance(y: Floats) -> WaveletVariance:
    """Return the wavelet variance of a series [n] at all scales.

    >>> [float(x) for x in wavelet_variance(np.array([1.0, -1.0, 1.0, -1.0])).variance]
    [1.0, 0.0]
    """
    scales = dyadic_scales(y.size)
    phase = np.concatenate([[0.0], np.cumsum(y - y.mean())])
    variance = []
    for scale in scales.astype(np.int64).tolist():
        half = scale // 2
        w = (phase[scale:] - 2.0 * phase[half:-half] + phase[:-scale]) / scale
        variance.append(float(w @ w) / w.size)
    return with_intervals(np.array(variance), y.size)


def dyadic_scales(n: int) -> Floats:
    """Return the scales 2, 4, 8, … of n samples."""
    return np.asarray(2.0 ** np.arange(1, int(np.log2(n)) + 1))


def with_intervals(variance: Floats, n: int) -> WaveletVariance:
    """Return a wavelet variance of n samples with its intervals."""
    scales = dyadic_scales(n)
    freedom = np.maximum((n - scales + 1.0) / scales, 1.0)
    lo, hi = (freedom * variance / chi2.ppf(p, freedom) for p in (0.975, 0.025))
    return WaveletVariance(n, scales, variance, lo, hi)


def term_variance(term: str, scales: Floats) -> Floats:
    """Return the wavelet variance [J] of a term of size 1.

    >>> [[float(x) for x in term_variance(term, np.array([2.0, 4.0]))] for term in TERMS]
    [[0.5, 0.25], [1.5, 0.375], [0.25, 0.375], [0.25, 1.0]]
    """
    if term == "WN":
        return 1.0 / scales
    if term == "QN":
        return 6.0 / scales**2
    if term == "RW":
        return (scales**2 + 2.0) / (12.0 * scales)
    return scales**2 / 16.0


def ar1_variance(scales: Floats, time: float) -> Floats:
    """Return the wavelet variance [J] of an AR1 of variance 1 whose correlation falls to 1/e in ``time`` samples.

    N. F. Zhang, "Allan variance of time series models for measurement data", Metrologia 45 (2008) 549, halved.
    """
    m = 0.5 * scales
    phi, d, u = np.exp(-1.0 / time), -np.expm1(-1.0 / time), -np.expm1(-m / time)
    return np.asarray((m * d * (1.0 + phi) - phi * u * (2.0 + u)) / (2.0 * (m * d) ** 2))


@lru_cache(maxsize=2)
def _gains(n: int) -> Floats:
    """Return the power gain [J, n // 2] from the series to the wavelet coefficients at frequencies k/n."""
    f = np.arange(1, n // 2 + 1) / n
    half = 0.5 * dyadic_scales(n)[:, None]
    return np.asarray(np.sin(np.pi * f * half) ** 4 / (half * np.sin(np.pi * f)) ** 2)


def covariance(n: int, density: Floats, drift: float = 0.0, walk: float = 0.0) -> Floats:
    """Return V [J, J] of the wavelet variance of a Gaussian series of that spectrum [n // 2]: 2 ∫ |S_jk|² df / M.

    A. Serroukh & A. T. Walden, J. Comput. Graph. Stat. 9 (2000) 196. The integral is a sum over k/n; at 0 only a random
    walk of step variance ``walk`` is left. ``drift``: a slope adds a mean μ = slope · τ/4 to the coefficients, and
    2 μ_j μ_k S_jk(0) to the integral.
    """
    scales = dyadic_scales(n)
    power = _gains(n) * density
    at_zero = walk / 16.0 * np.outer(scales, scales)
    integral = 4.0 / n * (power @ power.T) + 2.0 / n * at_zero**2
    integral += 4.0 * (drift / 4.0) ** 2 * np.outer(scales, scales) * at_zero
    terms = n - scales + 1.0
    return np.asarray(integral / np.maximum.outer(terms, terms))


# --- fit and rank


class _Problem:
    """Weighted least squares of one series for given correlation times."""

    def __init__(self, found: WaveletVariance, known: Floats) -> None:
        self.n, self.scales = found.n, found.scales
        self.weight = 1.0 / (found.hi - found.lo)  # √Ω
        self.target = self.weight * (found.variance - known)
        self.linear = {term: self.weight * term_variance(term, found.scales) for term in TERMS}
        self.grid = [float(t) for t in np.geomspace(1.0, found.n, GRID)]
        self._ready = {time: self.weight * ar1_variance(found.scales, time) for time in self.grid}

    def ar1_column(self, time: float) -> Floats:
        """Return the weighted column [J] of an AR1."""
        ready = self._ready.get(time)
        return self.weight * ar1_variance(self.scales, time) if ready is None else ready

    def jacobian(self, terms: tuple[str, ...], times: tuple[float, ...]) -> Floats:
        """Return the columns [J, k] of the sizes."""
        return np.stack([*(self.linear[term] for term in terms), *(self.ar1_column(time) for time in times)], axis=1)

    def solve(self, terms: tuple[str, ...], times: tuple[float, ...]) -> tuple[float, Floats]:
        """Return the objective and the best sizes [k]."""
        if not terms and not times:
            return float(self.target @ self.target), np.empty(0)
        columns = self.jacobian(terms, times)
        norms = np.sqrt((columns**2).sum(axis=0))
        sizes, distance = nnls(columns / norms, self.target)
        return float(distance) ** 2, sizes / norms

    def add_correlation_time(self, terms: tuple[str, ...], times: tuple[float, ...]) -> tuple[float, ...]:
        """Add one correlation time: start at the best value of the grid, and optimise all correlation times."""
        start = min(((*times, time) for time in self.grid), key=lambda candidate: self.solve(terms, candidate)[0])

        def cost(logs: Floats) -> float:
            return self.solve(terms, tuple(np.exp(logs)))[0]

        bounds = [(0.0, float(np.log(self.n)))] * len(start)
        best = minimize(
            cost, np.log(start), method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3, "fatol": 1e-6}
        )
        return tuple(sorted(float(t) for t in np.exp(best.x)))

    def directions(self, terms: tuple[str, ...], times: tuple[float, ...], sizes: Floats) -> Floats:
        """Return an orthonormal basis [J, r] of the derivatives by sizes and correlation times."""
        columns = [self.jacobian(terms, times)]
        for time, size in zip(times, sizes[len(terms) :], strict=True):
            ends = [self.weight * ar1_variance(self.scales, time * np.exp(h)) for h in (STEP, -STEP)]
            columns.append(size * (ends[0] - ends[1])[:, None] / (2.0 * STEP))
        stack = np.hstack(columns)
        u, s, _ = np.linalg.svd(stack / np.sqrt((stack**2).sum(axis=0)), full_matrices=False)
        return np.asarray(u[:, s > MIN_SINGULAR_VALUE * s[0]])


def rank(found: WaveletVariance, known: KnownPart | None = None, most: int = MAX_AR1) -> list[FittedModel]:
    """Return all nested models, the best model first.

    Parameters
    ----------
    found
        Wavelet variance of a series.
    known
        Known part of the series, which every model contains. The empty model is then ranked too.
    most
        Number of AR1 in the largest model.

    >>> y = np.random.default_rng(1).normal(size=4096)
    >>> rank(wavelet_variance(y))[0].terms
    ('WN',)
    """
    problem = _Problem(found, known.variance if known else np.zeros_like(found.variance))
    fits = list(_fits(problem, most))
    largest = _make_fitted_model(problem, *fits[0], None)
    base = known.density if known else 0.0
    v = covariance(found.n, base + largest.density(found.n), largest.size("DR") ** 0.5, largest.size("RW"))
    ranked = [_make_fitted_model(problem, *fit, v) for fit in fits if (fit[2] > 0.0).all() and (known or fit[2].size)]
    return sorted(ranked, key=lambda one: one.criterion)


def _fits(problem: _Problem, most: int) -> Iterator[tuple[tuple[str, ...], tuple[float, ...], Floats]]:
    """Yield terms, correlation times and sizes of each model, the largest model first."""
    for count in range(len(TERMS), -1, -1):
        for terms in combinations(TERMS, count):
            times: tuple[float, ...] = ()
            all_times = [times]
            for _ in range(most):
                times = problem.add_correlation_time(terms, times)
                all_times.append(times)
            for candidate in reversed(all_times):
                yield terms, candidate, problem.solve(terms, candidate)[1]


def _make_fitted_model(
    problem: _Problem, terms: tuple[str, ...], times: tuple[float, ...], sizes: Floats, v: Floats | None
) -> FittedModel:
    """Return a fitted model, with its optimism if V [J, J] is given."""
    optimism = 0.0
    if v is not None and sizes.size:
        q = problem.directions(terms, times, sizes)
        optimism = 2.0 * float(np.trace(q.T @ (problem.weight[:, None] * v * problem.weight) @ q))
    sigmas = tuple(float(size) ** 0.5 for size in sizes[len(terms) :])
    objective = problem.solve(terms, times)[0]
    return FittedModel(terms, tuple(float(x) for x in sizes[: len(terms)]), times, sigmas, objective, optimism)
