"""Likelihoods for effects that share a spectrum: what ``telegraph`` and ``steps`` have in common.

A random telegraph has the second moments of exponentially correlated noise, Poisson steps those of a random walk. What
differs is the distribution, so both of a pair are given their full likelihood on the same data, with the same noise
around it: that is a ``Contest``. Its gain is the logarithm of the ratio of the likelihoods, each at its maximum; the
prices of parameters and of prejudice are the caller's.

Data are block means. The noise around is ``Rest``: white, random walk, flicker, exponentially correlated, written as
independent first-order processes whose mean over a block is known given where they begin: a block costs one step of a
Kalman filter, and no error is made by averaging. The level begins anywhere: a flat prior, the same on both sides.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, exp, log, pi
from typing import Final, NamedTuple

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled
from monitor.reconcile.result import Bounds

MOST_BLOCKS: Final = 1 << 15
"""Of a longer recording the first blocks stand for all."""
WANTED: Final = 200.0
"""Blocks in a recording, unless its samples are fewer."""
FEWEST_BLOCKS: Final = 16
ANYWHERE: Final = 100.0
"""Variance of the first level, in variances of the data: as good as infinite, and the same for both models."""
DECADE: Final = 10.0
"""Spacing of the processes that make flicker: their sum then ripples by 5 % about 1/f."""
WHITE_RULES: Final = 20.0
"""Flicker is not modelled above this many times the frequency at which it crosses the white noise."""
DEVIATIONS: Final = 1.96
"""Standard deviations either side that hold 95 of 100."""
NEARBY: Final = 0.1
"""Spacing, in the logarithm of a parameter, of the points from which the curvature at the maximum is taken."""
LITTLE: Final = 1e-3
"""Relative change of the odds by which events are counted."""
FACTOR: Final = log(30.0)
"""Farther from its start than this a parameter is not followed."""


@dataclass(frozen=True, slots=True)
class Contest:
    """Two explanations of one axis."""

    gain: float  # log-likelihood of the first minus that of the second
    first: Mapping[str, Bounds]  # parameters at the maximum, SI, 95 %
    second: Mapping[str, Bounds]
    events: int  # switches or jumps expected, given the data and the first explanation


@dataclass(frozen=True, slots=True)
class Rest:
    """The other noise of an axis; two-sided spectra."""

    white: float  # N²: S(f) = N², unit² s
    walk: float = 0.0  # K²: S(f) = K²/(2πf)², unit²/s
    flicker: float = 0.0  # B²: S(f) = B²/(2πf), unit²
    correlated: tuple[tuple[float, float], ...] = ()  # σ, unit, and T_c, s, of each exponentially correlated noise


class Parts(NamedTuple):
    """The noise of block means, as sum of independent first-order processes and of white noise.

    From the start of one block to the start of the next x ← decay·x + w, and the mean of the block is seen·x + v with
    Var w = drive, Cov(v, w) = shared. The first process is the level, with the random walk on it.
    """

    table: Floats  # [d, 4] decay, seen, drive, shared
    white: float  # variance of white noise and of all v


class Peak(NamedTuple):
    """A maximum of a log-likelihood over the logarithms of its parameters."""

    height: float
    at: Floats  # [k] parameters
    deviation: Floats  # [k] standard deviations of their logarithms; NaN where there is no peak

    def bounds(self, k: int) -> Bounds:
        """Parameter ``k`` with its 95 % interval; none where it is wider than the search."""
        value, wide = float(self.at[k]), DEVIATIONS * float(self.deviation[k])
        return Bounds(value, value * exp(-wide), value * exp(wide)) if wide < FACTOR else Bounds(value)


class Process(NamedTuple):
    """Events at random times, at the maximum of their likelihood."""

    peak: Peak
    names: tuple[str, str]
    events: float  # expected, given the data

    @property
    def parameters(self) -> dict[str, Bounds]:
        """By name."""
        return {name: self.peak.bounds(k) for k, name in enumerate(self.names)}


def block_means(y: Floats, tau0_s: float, block_s: float) -> tuple[Floats, float]:
    """Means of blocks of about ``block_s``, less their mean, and their true length in s.

    >>> block_means(np.arange(48.0), 0.5, 1.4)[0][:3].tolist(), block_means(np.arange(48.0), 0.5, 1.4)[1]
    ([-22.5, -19.5, -16.5], 1.5)

    Raises:
        ValueError: too short a series for that
    """
    size = max(1, round(block_s / tau0_s))
    count = min(y.size // size, MOST_BLOCKS)
    if count < FEWEST_BLOCKS:
        raise ValueError(f"{count} blocks of {size * tau0_s:g} s; at least {FEWEST_BLOCKS} are needed")
    means = y[: count * size].reshape(count, size).mean(1)
    return means - means.mean(), size * tau0_s


def parts(rest: Rest, block_s: float, span_s: float) -> Parts:
    """``rest`` as it shows in means over ``block_s`` of a recording that lasts ``span_s``.

    Raises:
        ValueError: no white noise: then nothing hides a single switch, and no likelihood is needed
    """
    if not rest.white > 0.0:
        raise ValueError(f"white noise of {rest.white:g}; it must be above zero")
    walk = rest.walk * block_s
    rows, white = [(1.0, 1.0, walk, 0.5 * walk)], rest.white / block_s + walk / 3.0
    for sigma, time_s in (*rest.correlated, *flicker(rest, block_s, span_s)):
        row, own = markov(sigma, time_s, block_s)
        rows.append(row)
        white += own
    return Parts(np.array(rows), white)


def markov(sigma: float, time_s: float, block_s: float) -> tuple[tuple[float, float, float, float], float]:
    """Exponentially correlated noise in block means: its row of ``Parts.table``, and the variance of its v.

    With x = Δ/T_c the mean of a block has variance σ² 2(x − 1 + e^−x)/x², and covariance σ² (1 − e^−x)/x with either
    end (integrals of σ² e^−|t|/T_c); given the start of the block, what is left of them.
    """
    x = block_s / time_s
    decay, seen = exp(-x), -float(np.expm1(-x)) / x
    own = x * (2.0 / 3.0 - x * (0.5 - x * 7.0 / 30.0)) if x < 0.01 else 2.0 * (x - 1.0 + decay) / x**2 - seen**2
    return (decay, seen, -(sigma**2) * float(np.expm1(-2.0 * x)), sigma**2 * seen * (1.0 - decay)), sigma**2 * own


def flicker(rest: Rest, block_s: float, span_s: float) -> list[tuple[float, float]]:
    """σ and T_c of exponentially correlated noises whose sum is B²/(2πf) from 1/span to where white noise rules.

    Processes of equal variance s, equally spaced by ln ρ in ln T_c, add to πs/(ln ρ 2πf) (Keshner, "1/f noise",
    Proc. IEEE 70, 1982): s = B² ln ρ/π.
    """
    if rest.flicker <= 0.0:
        return []
    slowest = span_s / pi
    fastest = min(max(block_s / pi, rest.white / (WHITE_RULES * rest.flicker)), 0.1 * slowest)
    count = ceil(log(slowest / fastest) / log(DECADE)) + 1
    spacing = log(slowest / fastest) / (count - 1)
    sigma = (rest.flicker * spacing / pi) ** 0.5
    return [(sigma, slowest * exp(-k * spacing)) for k in range(count)]


def maximise(log_likelihood: Callable[..., float], start: Sequence[float]) -> Peak:
    """The maximum over positive parameters, by the simplex method in their logarithms from ``start``."""
    from scipy.optimize import minimize

    origin = np.log(np.asarray(start, np.float64))
    found = minimize(
        lambda at: -log_likelihood(*np.exp(at)),
        origin,
        method="Nelder-Mead",
        bounds=[(x - FACTOR, x + FACTOR) for x in origin],
        options={"initial_simplex": _simplex(origin), "xatol": 0.02, "fatol": 0.02, "maxiter": 80},
    )
    curvature = _curvature(lambda at: log_likelihood(*np.exp(at)), found.x, -float(found.fun))
    deviation = np.full(origin.size, np.nan)
    if (np.linalg.eigvalsh(curvature) < 0.0).all():
        deviation = np.sqrt(np.diag(np.linalg.inv(-curvature)))
    return Peak(-float(found.fun), np.exp(found.x), deviation)


def fit_process(likelihood: Callable[[float, float, float], float], start: Mapping[str, float]) -> Process:
    """The maximum over two named parameters from ``start``; the third argument is a factor on the odds of an event.

    Fisher's identity: the derivative of the log-likelihood by the logarithm of that factor is the number of events
    expected from the data.
    """
    first, second = start
    peak = maximise(lambda a, b: likelihood(a, b, 1.0), (start[first], start[second]))
    a, b = peak.at.tolist()
    events = (likelihood(a, b, 1.0 + LITTLE) - peak.height) / LITTLE
    return Process(peak, (first, second), events)


def _simplex(origin: Floats) -> Floats:
    return np.vstack([origin, origin + 0.3 * np.eye(origin.size)])


def _curvature(function: Callable[[Floats], float], at: Floats, height: float) -> Floats:
    """Second derivatives [k, k], from differences over ``NEARBY``."""
    k = at.size
    steps = NEARBY * np.eye(k)
    curvature = np.empty((k, k))
    for i in range(k):
        curvature[i, i] = function(at + steps[i]) - 2.0 * height + function(at - steps[i])
        for j in range(i):
            crossed = [function(at + p * steps[i] + q * steps[j]) * p * q for p in (1.0, -1.0) for q in (1.0, -1.0)]
            curvature[i, j] = curvature[j, i] = 0.25 * sum(crossed)
    return curvature / NEARBY**2


def anywhere(means: Floats) -> float:
    """Variance of the first level."""
    return ANYWHERE * float(means.var())


@compiled
def begin(table, start):  # type: ignore[no-untyped-def]
    """Covariance [d, d] before the first block: the level anywhere, the others stationary."""
    d = table.shape[0]
    covariance = np.zeros((d, d))
    covariance[0, 0] = start
    for i in range(1, d):
        covariance[i, i] = table[i, 2] / (1.0 - table[i, 0] ** 2)
    return covariance


@compiled
def predict(table, covariance, reach):  # type: ignore[no-untyped-def]
    """Variance of a block's mean without its v, and in ``reach`` [d] its covariance with the next start."""
    d = table.shape[0]
    variance = 0.0
    for i in range(d):
        total = 0.0
        for j in range(d):
            total += covariance[i, j] * table[j, 1]
        variance += table[i, 1] * total
        reach[i] = table[i, 0] * total + table[i, 3]
    return variance


@compiled
def kalman(means, table, white, start):  # type: ignore[no-untyped-def]
    """Log-likelihood of Gaussian noise (Anderson & Moore, "Optimal Filtering", 1979, sections 5.5 and 10.4)."""
    d = table.shape[0]
    covariance, at, reach = begin(table, start), np.zeros(d), np.empty(d)
    total = 0.0
    for z in means:
        variance = predict(table, covariance, reach) + white
        innovation = z
        for i in range(d):
            innovation -= table[i, 1] * at[i]
        total -= 0.5 * (np.log(2.0 * np.pi * variance) + innovation * innovation / variance)
        for i in range(d):
            at[i] = table[i, 0] * at[i] + reach[i] * innovation / variance
            for j in range(d):
                covariance[i, j] *= table[i, 0] * table[j, 0]
                covariance[i, j] -= reach[i] * reach[j] / variance
            covariance[i, i] += table[i, 2]
    return total
