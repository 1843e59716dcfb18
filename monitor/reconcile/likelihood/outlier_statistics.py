"""Outliers among white residuals, told from what else has heavy tails.

In comes a white series; a Gaussian, a mixture (1−f) N(0, s²) + f N(0, s² + scale²) (Tukey 1960) and Student's t are
fitted to the distribution of its sizes. Outliers gain over the Gaussian and over Student's t, and come at any time as
likely as at any other: neighbours that are both far off speak of bursts or jumps; more of them in one hour than in the
next, of noise that changes. Whether the gains suffice is the caller's to say.

The fits see the sizes in bins so narrow that nothing is lost (a fortieth of a deviation, three percent far out), each
with its own mean square: their time does not grow with the recording.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtrc, gammaln, ndtr, ndtri, pdtrc

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.reconcile.preparation.value_statistics import Mask, Size

EVEN: Final = 240
EVEN_TO: Final = 6.0
"""Deviations up to which bins are all as wide, and how many they are."""
BINS: Final = 1024
A_LOG: Final = 34.0
"""All bins; those further out, to 6·10¹⁰ deviations, are so many for a natural logarithm."""
EDGES: Final = np.concatenate([np.arange(EVEN) * EVEN_TO / EVEN, EVEN_TO * np.exp(np.arange(BINS - EVEN + 1) / A_LOG)])
WIDER: Final = np.array([1.3, 1.6, 2.0, 2.6, 3.4, 5.0, 8.0, 15.0, 40.0, 200.0, 3000.0])
"""Deviations of the wide part over the narrow one that EM starts from."""
NEAR: Final = 4
"""Samples: outliers nearer than this are neighbours."""
FREEDOMS: Final = np.geomspace(1.0, 300.0, 40)
"""Degrees of freedom of Student's t that are tried."""
LEAST: Final = 0.01
"""Nats: with less there is no second Gaussian to speak of."""
Z_MOST: Final = 37.0
"""Where the chance is no number of 64 bits any more."""
Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Outliers:
    """A mixture of two Gaussians beside its rivals."""

    fraction: Size
    scale: Size  # deviation of the error that is added
    noise: float  # deviation of the others
    mask: Mask  # [n] more likely outliers than not
    count: int  # of the mask
    gain: float  # nats over one Gaussian
    over_student: float  # nats over Student's t; the mixture has one parameter more
    vuong_z: float  # the same over its own standard deviation (Vuong 1989)
    freedom: float  # of that Student's t
    clustering_z: float  # that the outliers keep together, corrected for all the ways that were looked for
    misfit_z: float  # of the sizes to the mixture


def outliers(w: Floats) -> Outliers | None:
    """The mixture that fits white residuals [n] best; None where a single Gaussian fits no worse.

    NaN are passed over.

    >>> rng = np.random.default_rng(0)
    >>> w = rng.standard_normal(20_000)
    >>> w[::400] += 8.0 * rng.standard_normal(50)
    >>> found = outliers(w)
    >>> print(f"{found.fraction.value:.4f} {found.scale.value:.1f} {found.gain > 100.0} {found.over_student > 5.0}")
    0.0023 7.2 True True
    """
    good = np.isfinite(w)
    n = int(good.sum())
    some = np.abs(w[good][:: max(1, n // 20_000)])
    unit = float(np.median(some)) / 0.6744897501960817 if n >= 100 else 0.0
    if not unit > 0.0:
        return None
    counts, squares = _binned(w, unit)
    kept = np.flatnonzero(counts)
    counts, squares = counts[kept], squares[kept] / counts[kept]
    narrow, wide, share, best = _mixture(counts, squares, WIDER)
    gain = best - _gaussian(counts, squares)
    if not (gain > LEAST and wide > narrow):
        return None
    freedom, student, each_student = _student(counts, squares)
    each = _each(squares, narrow, wide, share)
    far = _far(narrow, wide, share)
    mask = np.asarray(np.abs(w) > far * unit) & good if np.isfinite(far) else np.zeros(w.size, dtype=np.bool_)
    fraction, scale = _intervals(counts, squares, narrow, wide, share)
    return Outliers(
        fraction=fraction,
        scale=Size(unit * scale.value, unit * scale.lo, unit * scale.hi),
        noise=unit * float(narrow**0.5),
        mask=mask,
        count=int(mask.sum()),
        gain=float(gain),
        over_student=float(best - student),
        vuong_z=_vuong(counts, each - each_student),
        freedom=freedom,
        clustering_z=_clustering(np.flatnonzero(mask), w.size),
        misfit_z=_misfit(counts, kept, narrow, wide, share),
    )


@compiled
def _binned(w, unit):  # type: ignore[no-untyped-def]
    """Counts of |w|/unit in bins, and their sums of squares."""
    counts, squares = np.zeros(BINS), np.zeros(BINS)
    for k in range(w.size):
        x = abs(w[k]) / unit
        if x <= 1e10:  # false for NaN
            at = int(x * (EVEN / EVEN_TO)) if x < EVEN_TO else EVEN + int(A_LOG * np.log(x / EVEN_TO))
            counts[at] += 1.0
            squares[at] += x * x
    return counts, squares


@compiled
def _mixture(counts, squares, wider):  # type: ignore[no-untyped-def]
    """Variances, share and log-likelihood of the best mixture; EM from every start, then to its end from the best."""
    total = counts.sum()
    mean = (counts * squares).sum() / total
    best = (mean, mean, 0.0, -np.inf)
    for one in wider:
        narrow, wide, share = min(1.0, mean), one * one, 0.01
        for step in range(40):
            share, narrow, wide, like = _improved(counts, squares, total, narrow, wide, share, step < 15)
        if like > best[3]:
            best = (narrow, wide, share, like)
    narrow, wide, share, like = best
    for _ in range(600):
        last = like
        share, narrow, wide, like = _improved(counts, squares, total, narrow, wide, share, False)
        if like - last < 1e-7:
            break
    return narrow, wide, share, like


@compiled
def _improved(counts, squares, total, narrow, wide, share, held):  # type: ignore[no-untyped-def]
    """One step of EM (``held``: the wide variance stays), and the log-likelihood before it."""
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


def _gaussian(counts: Floats, squares: Floats) -> float:
    """Log-likelihood of the best single Gaussian."""
    total = counts.sum()
    return -0.5 * float(total * (np.log(2.0 * np.pi * np.dot(counts, squares) / total) + 1.0))


def _each(squares: Floats, narrow: float, wide: float, share: float) -> Floats:
    """Log-density of the mixture at these squares."""
    inside = np.log1p(-share) - 0.5 * (np.log(2.0 * np.pi * narrow) + squares / narrow)
    outside = np.log(share) - 0.5 * (np.log(2.0 * np.pi * wide) + squares / wide)
    return np.asarray(np.logaddexp(inside, outside))


def _student(counts: Floats, squares: Floats) -> tuple[float, float, Floats]:
    """Degrees of freedom, log-likelihood and log-densities of the best Student's t.

    The scale by EM (weights (ν+1)/(ν + x²/s²); Lange, Little & Taylor 1989), all degrees of freedom at once.
    """
    nu = FREEDOMS[:, None]
    scale = np.ones_like(nu)
    for _ in range(30):
        weights = (nu + 1.0) / (nu + squares / scale)
        scale = ((weights * squares) @ counts / (weights @ counts))[:, None]
    each = (
        gammaln(0.5 * (nu + 1.0))
        - gammaln(0.5 * nu)
        - 0.5 * np.log(np.pi * nu * scale)
        - 0.5 * (nu + 1.0) * np.log1p(squares / (nu * scale))
    )
    likes = each @ counts
    best = int(likes.argmax())
    top = float(likes[best])
    if 0 < best < FREEDOMS.size - 1:  # a parabola through the best three
        left, right = top - likes[best - 1], top - likes[best + 1]
        top += 0.125 * float((left - right) ** 2 / (left + right)) if left + right > 0.0 else 0.0
    return float(FREEDOMS[best]), top, each[best]


def _far(narrow: float, wide: float, share: float) -> float:
    """Size beyond which an outlier is more likely than not."""
    square = 2.0 * (np.log1p(-share) - np.log(share) + 0.5 * np.log(wide / narrow)) / (1.0 / narrow - 1.0 / wide)
    return float(square**0.5) if square > 0.0 else 0.0


def _intervals(counts: Floats, squares: Floats, narrow: float, wide: float, share: float) -> tuple[Size, Size]:
    """Fraction and scale with 95 % intervals, by the curvature of the likelihood in ln s, ln scale and logit f."""
    at = np.array([0.5 * np.log(narrow), 0.5 * np.log(max(wide - narrow, 1e-12)), np.log(share) - np.log1p(-share)])

    def like(x: Floats) -> float:
        inner, f = np.exp(2.0 * x[0]), 1.0 / (1.0 + np.exp(-x[2]))
        return float(np.dot(counts, _each(squares, inner, inner + np.exp(2.0 * x[1]), f)))

    step = np.diag([1e-3 / max(1.0, (counts.sum() / 1e4) ** 0.5), 0.02, 0.02])
    curve = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            a, b = step[i], step[j]
            curve[i, j] = (like(at + a - b) + like(at - a + b) - like(at + a + b) - like(at - a - b)) / (
                4.0 * a[i] * b[j]
            )
    variance = np.diag(np.linalg.pinv(curve))
    half = np.where(variance > 0.0, Z95 * np.sqrt(np.maximum(variance, 0.0)), 700.0)
    with np.errstate(over="ignore"):
        f = 1.0 / (1.0 + np.exp(-(at[2] + half[2] * np.array([0.0, -1.0, 1.0]))))
        scale = np.exp(at[1] + half[1] * np.array([0.0, -1.0, 1.0]))
    return Size(*map(float, f)), Size(*map(float, scale))


def _vuong(counts: Floats, apart: Floats) -> float:
    """Mean difference of log-densities over its standard error."""
    total = float(counts.sum())
    mean = float(np.dot(counts, apart)) / total
    spread = float(np.dot(counts, (apart - mean) ** 2)) / total
    return mean * (total / spread) ** 0.5 if spread > 0.0 else 0.0


def _clustering(when: Ints, n: int) -> float:
    """z of the most striking of all ways in which events keep together.

    Neighbours: pairs at most NEAR samples apart against a Poisson count. Parts of the recording (4, 8, … with two
    events or more a part): their counts' dispersion against χ² (Cochran 1954). The least p is paid for as often as was
    looked.
    """
    if when.size < 2:
        return 0.0
    pairs = sum(int(np.count_nonzero(when[k:] - when[:-k] <= NEAR)) for k in range(1, min(NEAR, when.size - 1) + 1))
    expected = NEAR * when.size * (when.size - 1.0) / n
    if expected < 0.2 * when.size:
        chances = [float(pdtrc(pairs - 1, expected)) if pairs else 1.0]
    else:  # so many that only the next sample tells
        following = int(np.count_nonzero(np.diff(when) == 1))
        chances = [float(bdtrc(following - 1, when.size, when.size / n)) if following else 1.0]
    parts = 4
    while 2 * parts <= when.size and parts <= 4096:
        held = np.bincount(when * parts // n, minlength=parts)
        mean = when.size / parts
        spread = float(((held - mean) ** 2).sum()) / (mean * (1.0 - when.size / n))
        chances.append(float(chdtrc(parts - 1, spread)))
        parts *= 2
    return _z(min(chances) * len(chances))


def _z(chance: float) -> float:
    """The z that a Gaussian exceeds with that chance; 0 for even chances and better ones."""
    if chance > 0.5:
        return 0.0
    return -float(ndtri(chance)) if chance > 1e-300 else Z_MOST


def _misfit(counts: Floats, kept: NDArray[np.intp], narrow: float, wide: float, share: float) -> float:
    """z of χ² between counts and the mixture, in bins of about equal expectation."""
    below = (1.0 - share) * ndtr(EDGES / narrow**0.5) + share * ndtr(EDGES / wide**0.5)
    total = counts.sum()
    expected = 2.0 * total * np.diff(below)
    seen = np.zeros(BINS)
    seen[kept] = counts
    groups = np.minimum((2.0 * (below[:-1] - 0.5)) * 40.0, 39.0).astype(np.int64)  # forty of a fortieth
    tail = np.minimum(np.floor(-np.log2(np.maximum(2.0 * (1.0 - below[:-1]), 1e-300))), np.log2(total / 20.0))
    groups = groups + np.maximum(tail.astype(np.int64), 0) * (groups == 39)
    want, have = np.bincount(groups, expected), np.bincount(groups, seen)
    some = want > 5.0
    square = float(((have - want)[some] ** 2 / want[some]).sum())
    return _z(float(chdtrc(max(int(some.sum()) - 4, 1), square)))
