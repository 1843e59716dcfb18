"""Generalized Method of Wavelet Moments, and its ranking of models: the nearest peer of ``reconcile``, written anew.

In comes a series, out go all nested models of WN, QN, RW, DR and up to three AR1, best first. Each is fitted to the
Haar wavelet variance of the series by weighted least squares, as by S. Guerrier, J. Skaloud, Y. Stebler & M.-P.
Victoria-Feser, "Wavelet-variance-based estimation for composite stochastic processes", J. Am. Stat. Assoc. 108 (2013)
1021. The rank is by the wavelet variance information criterion: the objective at the fit, and what it flatters the
fit by, 2 tr(Ω cov[ν̂, ν(θ̂)]) (S. Guerrier, R. Molinari & J. Skaloud, "Automatic identification and calibration of
stochastic parameters in inertial sensors", Navigation 62 (2015) 265; J. Balamuta, S. Guerrier, R. Molinari & W. Yang,
arXiv:1603.05297).

Settings are the defaults of the authors' packages: classical variance of the MODWT without its boundary, intervals of
χ² with max(M/2^j, 1) degrees of freedom ("η₃" of D. B. Percival, Biometrika 82 (1995) 619), Ω = diag(1/(hi − lo)²), and
the covariance V of ν̂ that of the largest model. Here V is the asymptotic one of the 2013 article instead of simulated;
the sizes, which are linear, are found exactly by non-negative least squares, and only correlation times are searched.
A model of which a term comes out as nothing is the smaller model, and only ranked as that. Second derivatives of
ν(θ), which matter where no model is right, are left out of the flattery, which is then that of a projection.

Everything is in units of the series and in samples; scale τ = 2^j. Wavelet coefficients are half the difference of two
neighbouring means of τ/2 samples, so their variance is half the Allan variance at τ/2.
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
"""Those of one parameter: white noise, quantization noise, random walk, drift."""
MOST: Final = 3
"""AR1 of the largest model."""
GRID: Final = 25
"""Correlation times at which a search begins."""
STEP: Final = 1e-4
"""Of the logarithm of a correlation time, for the derivative by it."""
ALIKE: Final = 1e-7
"""Directions of a normalised Jacobian below this are none: two terms that nothing tells apart."""


@dataclass(frozen=True, slots=True)
class Moments:
    """Wavelet variance of a series of ``n``, with 95 % intervals; all [J]."""

    n: int
    scales: Floats  # 2^j samples
    variance: Floats
    lo: Floats
    hi: Floats


@dataclass(frozen=True, slots=True)
class Known:
    """What needs no fit: its wavelet variance [J], and its spectrum [n // 2] at k/n, white noise being its variance."""

    variance: Floats
    density: Floats


@dataclass(frozen=True, slots=True)
class Ranked:
    """One model, fitted."""

    terms: tuple[str, ...]  # of TERMS, in their order
    sizes: tuple[float, ...]  # variance of the innovations; of a drift its squared slope
    times: tuple[float, ...]  # of each AR1, samples
    sigmas: tuple[float, ...]  # of each AR1, its standard deviation
    objective: float
    optimism: float

    @property
    def criterion(self) -> float:
        """WVIC: the smaller, the better."""
        return self.objective + self.optimism

    def density(self, n: int) -> Floats:
        """[n // 2] spectrum at k/n; a drift has none."""
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
        """Zero of a term that is not there."""
        return dict(zip(self.terms, self.sizes, strict=True)).get(term, 0.0)


# --- wavelet variance


def moments(y: Floats) -> Moments:
    """Of a series [n] at all its scales.

    >>> [float(x) for x in moments(np.array([1.0, -1.0, 1.0, -1.0])).variance]
    [1.0, 0.0]
    """
    scales = dyadic(y.size)
    phase = np.concatenate([[0.0], np.cumsum(y - y.mean())])
    variance = []
    for scale in scales.astype(np.int64).tolist():
        half = scale // 2
        w = (phase[scale:] - 2.0 * phase[half:-half] + phase[:-scale]) / scale
        variance.append(float(w @ w) / w.size)
    return with_intervals(np.array(variance), y.size)


def dyadic(n: int) -> Floats:
    """Scales 2 … of n samples."""
    return np.asarray(2.0 ** np.arange(1, int(np.log2(n)) + 1))


def with_intervals(variance: Floats, n: int) -> Moments:
    """Of a wavelet variance that was measured in n samples."""
    scales = dyadic(n)
    freedom = np.maximum((n - scales + 1.0) / scales, 1.0)
    lo, hi = (freedom * variance / chi2.ppf(p, freedom) for p in (0.975, 0.025))
    return Moments(n, scales, variance, lo, hi)


def column(term: str, scales: Floats) -> Floats:
    """Wavelet variance [J] of a term of size 1.

    >>> [[float(x) for x in column(term, np.array([2.0, 4.0]))] for term in TERMS]
    [[0.5, 0.25], [1.5, 0.375], [0.25, 0.375], [0.25, 1.0]]
    """
    if term == "WN":
        return 1.0 / scales
    if term == "QN":
        return 6.0 / scales**2
    if term == "RW":
        return (scales**2 + 2.0) / (12.0 * scales)
    return scales**2 / 16.0


def correlated(scales: Floats, time: float) -> Floats:
    """Wavelet variance [J] of an AR1 of variance 1 whose correlation falls to 1/e in ``time`` samples.

    N. F. Zhang, "Allan variance of time series models for measurement data", Metrologia 45 (2008) 549, halved.
    """
    m = 0.5 * scales
    phi, d, u = np.exp(-1.0 / time), -np.expm1(-1.0 / time), -np.expm1(-m / time)
    return np.asarray((m * d * (1.0 + phi) - phi * u * (2.0 + u)) / (2.0 * (m * d) ** 2))


@lru_cache(maxsize=2)
def _gains(n: int) -> Floats:
    """[J, n // 2] of power, from series to wavelet coefficients, at frequencies k/n."""
    f = np.arange(1, n // 2 + 1) / n
    half = 0.5 * dyadic(n)[:, None]
    return np.asarray(np.sin(np.pi * f * half) ** 4 / (half * np.sin(np.pi * f)) ** 2)


def covariance(n: int, density: Floats, drift: float = 0.0, walk: float = 0.0) -> Floats:
    """V [J, J] of the wavelet variance of a Gaussian series of that spectrum [n // 2]: 2 ∫ |S_jk|² df / M.

    A. Serroukh & A. T. Walden, J. Comput. Graph. Stat. 9 (2000) 196. The integral is a sum over k/n; at 0 only a random
    walk of step variance ``walk`` is left. ``drift``: a slope adds a mean μ = slope · τ/4 to the coefficients, and
    2 μ_j μ_k S_jk(0) to the integral.
    """
    scales = dyadic(n)
    power = _gains(n) * density
    at_zero = walk / 16.0 * np.outer(scales, scales)
    integral = 4.0 / n * (power @ power.T) + 2.0 / n * at_zero**2
    integral += 4.0 * (drift / 4.0) ** 2 * np.outer(scales, scales) * at_zero
    terms = n - scales + 1.0
    return np.asarray(integral / np.maximum.outer(terms, terms))


# --- fit and rank


class _Problem:
    """Weighted least squares of one series: sizes are solved for, correlation times are given."""

    def __init__(self, found: Moments, known: Floats) -> None:
        self.n, self.scales = found.n, found.scales
        self.weight = 1.0 / (found.hi - found.lo)  # √Ω
        self.target = self.weight * (found.variance - known)
        self.linear = {term: self.weight * column(term, found.scales) for term in TERMS}
        self.grid = [float(t) for t in np.geomspace(1.0, found.n, GRID)]
        self._ready = {time: self.weight * correlated(found.scales, time) for time in self.grid}

    def correlated(self, time: float) -> Floats:
        """Weighted column [J]."""
        ready = self._ready.get(time)
        return self.weight * correlated(self.scales, time) if ready is None else ready

    def jacobian(self, terms: tuple[str, ...], times: tuple[float, ...]) -> Floats:
        """Columns [J, k] of the sizes."""
        return np.stack([*(self.linear[term] for term in terms), *(self.correlated(time) for time in times)], axis=1)

    def solve(self, terms: tuple[str, ...], times: tuple[float, ...]) -> tuple[float, Floats]:
        """Objective, and the sizes [k] that are best."""
        if not terms and not times:
            return float(self.target @ self.target), np.empty(0)
        columns = self.jacobian(terms, times)
        norms = np.sqrt((columns**2).sum(axis=0))
        sizes, distance = nnls(columns / norms, self.target)
        return float(distance) ** 2, sizes / norms

    def longer(self, terms: tuple[str, ...], times: tuple[float, ...]) -> tuple[float, ...]:
        """The best correlation times with one more: from the best of the grid, all of them searched."""
        start = min(((*times, time) for time in self.grid), key=lambda those: self.solve(terms, those)[0])

        def cost(logs: Floats) -> float:
            return self.solve(terms, tuple(np.exp(logs)))[0]

        bounds = [(0.0, float(np.log(self.n)))] * len(start)
        best = minimize(
            cost, np.log(start), method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3, "fatol": 1e-6}
        )
        return tuple(sorted(float(t) for t in np.exp(best.x)))

    def directions(self, terms: tuple[str, ...], times: tuple[float, ...], sizes: Floats) -> Floats:
        """Orthonormal [J, r]: where the fit can follow the moments, sizes and correlation times."""
        columns = [self.jacobian(terms, times)]
        for time, size in zip(times, sizes[len(terms) :], strict=True):
            ends = [self.weight * correlated(self.scales, time * np.exp(h)) for h in (STEP, -STEP)]
            columns.append(size * (ends[0] - ends[1])[:, None] / (2.0 * STEP))
        stack = np.hstack(columns)
        u, s, _ = np.linalg.svd(stack / np.sqrt((stack**2).sum(axis=0)), full_matrices=False)
        return np.asarray(u[:, s > ALIKE * s[0]])


def rank(found: Moments, known: Known | None = None, most: int = MOST) -> list[Ranked]:
    """All nested models, the best first.

    Args:
        found: of a series
        known: a part of the series that every model has; then nothing more is a model, too
        most: AR1 of the largest model

    >>> y = np.random.default_rng(1).normal(size=4096)
    >>> rank(moments(y))[0].terms
    ('WN',)
    """
    problem = _Problem(found, known.variance if known else np.zeros_like(found.variance))
    fits = list(_fits(problem, most))
    largest = _ranked(problem, *fits[0], None)
    base = known.density if known else 0.0
    v = covariance(found.n, base + largest.density(found.n), largest.size("DR") ** 0.5, largest.size("RW"))
    ranked = [_ranked(problem, *fit, v) for fit in fits if (fit[2] > 0.0).all() and (known or fit[2].size)]
    return sorted(ranked, key=lambda one: one.criterion)


def _fits(problem: _Problem, most: int) -> Iterator[tuple[tuple[str, ...], tuple[float, ...], Floats]]:
    """Terms, correlation times and sizes of each model, the largest first."""
    for few in range(len(TERMS), -1, -1):
        for terms in combinations(TERMS, few):
            times: tuple[float, ...] = ()
            of_terms = [times]
            for _ in range(most):
                times = problem.longer(terms, times)
                of_terms.append(times)
            for those in reversed(of_terms):
                yield terms, those, problem.solve(terms, those)[1]


def _ranked(
    problem: _Problem, terms: tuple[str, ...], times: tuple[float, ...], sizes: Floats, v: Floats | None
) -> Ranked:
    """With its optimism, where V [J, J] is given."""
    optimism = 0.0
    if v is not None and sizes.size:
        q = problem.directions(terms, times, sizes)
        optimism = 2.0 * float(np.trace(q.T @ (problem.weight[:, None] * v * problem.weight) @ q))
    sigmas = tuple(float(size) ** 0.5 for size in sizes[len(terms) :])
    objective = problem.solve(terms, times)[0]
    return Ranked(terms, tuple(float(x) for x in sizes[: len(terms)]), times, sigmas, objective, optimism)
