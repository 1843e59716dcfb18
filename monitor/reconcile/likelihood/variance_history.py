"""How the variance of white residuals goes in time, over all frequencies and band by band.

``variance_course``: one step of the noise, at every time at once, and its rivals, which are fitted to the energies of
blocks (χ²; log-linear variances): a trend, a period, more steps, a slow wandering. Every gain is one in log-likelihood
over a constant variance, so that they may be compared; a step is a step when it gains more than its rivals and
nothing is left after it.

``tiles``: the recording is cut into pieces, each as its Fourier transform between the usual frequencies, in which
white noise is independent everywhere and a steady line has a steady power. Every rectangle of 2^a pieces by 2^b
frequencies is held against the rest of its frequencies, so that a steady line or colour says nothing; and every row of
them against a steady one. Long pieces see lines that waver, short ones bursts.

All statistics are of ratios of energies: they know no unit and their law under white Gaussian noise depends on the
number of samples only. Outliers break it: they are to be replaced before.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.fft import fft
from scipy.special import gammaincc, gammaln, polygamma, psi

from drivers.sample import Floats, Ints
from monitor.common.compiled import compiled
from monitor.reconcile.preparation.value_statistics import Size

AWAY: Final = 16
"""Samples on each side of a step, at least."""
STRIDE: Final = 8
FINE: Final = 20_000
"""Samples: among fewer the time of a step is sought sample by sample."""
BLOCK: Final = 32
"""Samples of a block, at least: energies of fewer are far from Gaussian."""
BLOCKS: Final = 4096
"""At most."""
PARTS: Final = 8
"""Blocks, or pieces, that say anything of a course."""
CYCLES: Final = 2
"""Of a period in the recording, at least: less is a trend."""
CHANGES: Final = 8
"""Steps that are looked for, one after the other."""
FURTHER: Final = 12.0
"""Nats: a change that gains less is the last that is told."""
PIECES: Final = (256, 2048)
"""Samples of a piece of the spectrogram."""
EVEN_ROWS: Final = 64
"""Squares in each cell from which cells of several pieces are asked whether their row is steady."""
QUIET: Final = 8
"""Squares."""
Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Change:
    """A step of the noise."""

    gain: float  # nats over a constant variance
    time: Size  # s from the first sample
    ratio: Size  # of the deviations, after over before


@dataclass(frozen=True, slots=True)
class Periodic:
    """Variance that swings."""

    gain: float
    frequency: float  # Hz
    depth: float  # of ln σ: σ swings by e^±depth


@dataclass(frozen=True, slots=True)
class Course:
    """The variance over time: a step, and what else it may be."""

    step: Change
    trend: float  # nats of ln σ² = a + b t + c t² over a constant
    periodic: Periodic
    wander: float  # nats of a slow random course over a constant
    changes: tuple[Change, ...]  # one after the other, each with what it gains beside those before
    block_s: float
    energy: Floats  # [k] mean square of each block, in the unit of w squared


@dataclass(frozen=True, slots=True)
class Tiles:
    """The most striking place of a spectrogram, and its most striking row."""

    gain: float  # nats of the best rectangle over the rest of its row
    ratio: float  # its power over that of the rest
    time: tuple[float, float]  # s from the first sample
    frequency: tuple[float, float]  # Hz
    row_gain: float  # −ln of the chance that a steady row is so uneven
    row: tuple[float, float]  # Hz
    seconds: tuple[float, float]  # of the pieces: of the rectangle, of the row


def variance_course(w: Floats, tau0_s: float) -> Course:
    """Steps and other courses of the variance of white residuals [n], τ0 apart; none may be missing.

    Raises:
        ValueError: fewer than 256 samples

    >>> rng = np.random.default_rng(0)
    >>> w = rng.standard_normal(60_000)
    >>> w[20_000:] *= 1.2
    >>> found = variance_course(w, 0.01)
    >>> print(f"{found.step.gain > 100} {found.step.time.value:.1f} {found.step.ratio.value:.1f}")
    True 200.5 1.2
    """
    if w.size < PARTS * BLOCK:
        raise ValueError(f"{w.size} samples are too few, {PARTS * BLOCK} are needed")
    squares = w * w
    length = max(BLOCK, -(-w.size // BLOCKS))
    count = w.size // length
    energy = squares[: count * length].reshape(count, length).mean(axis=1)
    scores = energy / energy.mean() - 1.0
    step = _change(squares, tau0_s)
    time = np.linspace(-1.0, 1.0, count)
    return Course(
        step=step,
        trend=_log_linear(energy, length, np.stack([time, time**2 - 1.0 / 3.0])),
        periodic=_periodic(energy, scores, length, length * tau0_s),
        wander=_wander(scores, length),
        changes=_changes(squares, tau0_s, step),
        block_s=length * tau0_s,
        energy=energy,
    )


def tiles(w: Floats, tau0_s: float) -> Tiles:
    """The rectangle of time and frequency, and the row, where white residuals [n] are least steady.

    Samples τ0 apart; none may be missing.

    Raises:
        ValueError: fewer than 2048 samples

    >>> rng = np.random.default_rng(0)
    >>> w, t = rng.standard_normal(60_000), 0.01 * np.arange(60_000)
    >>> w[30_000:40_000] += 0.3 * np.sin(2.0 * np.pi * 17.3 * t[30_000:40_000])
    >>> found = tiles(w, 0.01)
    >>> found.gain > 50.0, found.frequency[0] < 17.3 < found.frequency[1]
    (True, True)
    """
    if w.size < PARTS * PIECES[0]:
        raise ValueError(f"{w.size} samples are too few, {PARTS * PIECES[0]} are needed")
    best = row = (-1.0, 0, 0, 0, 0, 0, 0.0)
    for piece in (one for one in PIECES if w.size >= PARTS * one):
        one, other = _rectangle(_powers(w, piece), piece)
        best, row = max(best, one), max(row, other)
    _, piece, a, i, b, j, ratio = best
    return Tiles(
        gain=best[0],
        ratio=ratio,
        time=(i * a * piece * tau0_s, (i + 1) * a * piece * tau0_s),
        frequency=(j * b / (piece * tau0_s), (j + 1) * b / (piece * tau0_s)),
        row_gain=row[0],
        row=(row[5] * row[4] / (row[1] * tau0_s), (row[5] + 1) * row[4] / (row[1] * tau0_s)),
        seconds=(piece * tau0_s, row[1] * tau0_s),
    )


def _change(squares: Floats, tau0_s: float, first: int = 0) -> Change:
    """The best single step of squares that begin at sample ``first``.

    The gain at every STRIDE-th time, and at every one where a step is likely at all.
    """
    sums = np.cumsum(squares)
    k = np.arange(AWAY, sums.size - AWAY + 1, STRIDE)
    gains = _gains(sums, k)
    likely = k[gains > gains.max() - 10.0]
    stride = STRIDE
    if likely[-1] - likely[0] < FINE:
        stride = 1
        k = np.arange(max(likely[0] - STRIDE, AWAY), min(likely[-1] + STRIDE, sums.size - AWAY) + 1)
        gains = _gains(sums, k)
    best = int(gains.argmax())
    chance = np.cumsum(np.exp(gains - gains[best]))
    lo, hi = np.searchsorted(chance, np.array([0.025, 0.975]) * chance[-1])
    at = int(k[best])
    after = sums.size - at
    ratio = float(((sums[-1] / sums[at - 1] - 1.0) * at / after) ** 0.5)
    half = float(np.exp(Z95 * (0.5 / at + 0.5 / after) ** 0.5))
    ends = (at, min(int(k[lo]), at) - stride + 1, max(int(k[hi]), at) + stride - 1)
    return Change(
        float(gains[best]), Size(*((first + one) * tau0_s for one in ends)), Size(ratio, ratio / half, ratio * half)
    )


def _gains(sums: Floats, k: Ints) -> Floats:
    """Log-likelihood gains of a step after ``k`` samples, by running sums of squares."""
    n, before, after = sums.size, sums[k - 1], sums[-1] - sums[k - 1]
    return np.asarray(0.5 * (n * np.log(sums[-1] / n) - k * np.log(before / k) - (n - k) * np.log(after / (n - k))))


def _changes(squares: Floats, tau0_s: float, step: Change) -> tuple[Change, ...]:
    """That step and more: each time the segment is cut that gains most by it (binary segmentation)."""
    found = [step]
    ends = [0, squares.size]
    open_: dict[tuple[int, int], Change] = {}
    while len(found) < CHANGES and found[-1].gain >= FURTHER:
        ends = sorted({*ends, round(found[-1].time.value / tau0_s)})
        parts = [(a, b) for a, b in pairwise(ends) if b - a > 4 * AWAY]
        open_ = {part: open_.get(part) or _change(squares[slice(*part)], tau0_s, part[0]) for part in parts}
        if not open_:
            break
        found.append(max(open_.values(), key=lambda one: one.gain))
    return tuple(found)


def _log_linear(energy: Floats, length: int, rows: Floats) -> float:
    """Likelihood gain of ln σ² = a + Σ b_i row_i over a constant, energies being means of ``length`` squares.

    Fisher scoring of a Gamma model with logarithmic link (McCullagh & Nelder 1989).
    """
    x = np.vstack([np.ones(energy.size), rows])
    normal = np.linalg.inv(x @ x.T)
    b = np.zeros(x.shape[0])
    b[0] = np.log(energy.mean())
    for _ in range(20):
        move = normal @ (x @ (energy * np.exp(-(b @ x)) - 1.0))
        b += np.clip(move, -1.0, 1.0)
        if np.abs(move).max() < 1e-6:
            break
    level = b @ x
    constant = energy.size * (np.log(energy.mean()) + 1.0)
    return max(0.5 * length * float(constant - (level + energy * np.exp(-level)).sum()), 0.0)


def _periodic(energy: Floats, scores: Floats, length: int, block_s: float) -> Periodic:
    """The best frequency of the score's periodogram, padded twofold, and the fit there."""
    power = np.abs(np.fft.rfft(scores, 2 * scores.size)) ** 2
    power[: 2 * CYCLES] = 0.0
    best = int(power[:-1].argmax())
    around = np.fft.rfft(scores, 16 * scores.size)[max(8 * best - 8, 16 * CYCLES) : 8 * best + 9]
    frequency = (max(8 * best - 8, 16 * CYCLES) + int(np.abs(around).argmax())) / (16.0 * scores.size)
    angle = 2.0 * np.pi * frequency * np.arange(scores.size)
    rows = np.stack([np.cos(angle), np.sin(angle)])
    depth = float(np.hypot(*(rows @ np.log(energy)))) / scores.size
    return Periodic(_log_linear(energy, length, rows), frequency / block_s, depth)


def _wander(scores: Floats, length: int) -> float:
    """Likelihood gain of the lowest 2^j frequencies of the scores being stronger, for the best j.

    Ordinates of a white score of variance 2/length are exponential; K of them with mean p gain K (p − 1 − ln p).
    """
    ordinates = np.abs(np.fft.rfft(scores)[1 : scores.size // 2]) ** 2 * length / (2.0 * scores.size)
    ends = 2 ** np.arange(2, int(np.log2(max(ordinates.size, 4))) + 1)
    means = np.cumsum(ordinates)[np.minimum(ends, ordinates.size) - 1] / ends
    gains = ends * (means - 1.0 - np.log(means))
    return float(np.where(means > 1.0, gains, 0.0).max())


Place = tuple[float, int, int, int, int, int, float]
"""Gain, samples of a piece, pieces, which of those, frequencies, which of those, ratio of powers."""


def _powers(w: Floats, piece: int) -> Floats:
    """Powers [pieces, piece/2] of a Fourier transform at (k + ½)/piece: of white noise each is χ² of two squares."""
    half = np.exp(-1j * np.pi / piece * np.arange(piece))
    lines = fft(w[: w.size // piece * piece].reshape(-1, piece) * half, axis=1)[:, : piece // 2]
    return np.asarray(lines.real**2 + lines.imag**2)


def _rectangle(power: Floats, piece: int) -> tuple[Place, Place]:
    """The best rectangle and the best row of powers [pieces, frequencies]."""
    best = row = (-1.0, piece, 1, 0, 1, 0, 1.0)
    b, total = 1, power.sum(axis=0)
    while True:
        tall, a = power, 1
        while tall.shape[0] >= 2:
            low, low_at, high, high_at, logs = _columns(tall)
            for x, at in ((low, low_at), (high, high_at)):
                gain, j, ratio = _over_rest(x, total, 2 * a * b, 2 * power.shape[0] * b)
                best = max(best, (gain, piece, a, int(at[j]), b, j, ratio))
            if 2 * a * b >= EVEN_ROWS or a == 1:
                gain, j = _uneven(tall.sum(axis=0), logs, tall.shape[0], 2 * a * b)
                row = max(row, (gain, piece, a, 0, b, j, 1.0))
            even = tall.shape[0] // 2 * 2
            tall, a = tall[0:even:2] + tall[1:even:2], 2 * a
        if power.shape[1] == 1:
            return best, row
        power, total, b = power[:, ::2] + power[:, 1::2], total[::2] + total[1::2], 2 * b


@compiled
def _columns(power):  # type: ignore[no-untyped-def]
    """Least and largest of each column, which those are, and the sum of the logarithms (of products of eight)."""
    rows, columns = power.shape
    low, high, logs = power[0].copy(), power[0].copy(), np.zeros(columns)
    low_at, high_at = np.zeros(columns, np.int64), np.zeros(columns, np.int64)
    product = np.ones(columns)
    for i in range(rows):
        for j in range(columns):
            x = power[i, j]
            product[j] *= max(x, 1e-30)
            if x < low[j]:
                low[j], low_at[j] = x, i
            if x > high[j]:
                high[j], high_at[j] = x, i
        if i % 8 == 7 or i == rows - 1:
            for j in range(columns):
                logs[j] += np.log(product[j])
                product[j] = 1.0
    return low, low_at, high, high_at, logs


@compiled
def _over_rest(x, total, inside, whole):  # type: ignore[no-untyped-def]
    """The best of energies of ``inside`` squares each over the rest of their columns: gain, which, ratio of powers.

    With x of c squares inside and R of d outside: (c+d)/2 ln((x+R)/(c+d)) − c/2 ln(x/c) − d/2 ln(R/d), which is convex
    in x: of a column only its least and its largest can be the best. That a few squares are silent is no evidence.
    """
    outside = whole - inside
    best, place, ratio = -1.0, 0, 1.0
    for j in range(x.size):
        u = max(x[j] * whole / (inside * total[j]), 1e-30)
        if u < 1.0 and inside < QUIET:
            gain, v = 0.0, 1.0
        else:
            v = max((total[j] - x[j]) * whole / (outside * total[j]), 1e-30)
            gain = -0.5 * (inside * np.log(u) + outside * np.log(v))
        if gain > best:
            best, place, ratio = gain, j, u / v
    return best, place, ratio


def _uneven(total: Floats, logs: Floats, count: int, squares: int) -> tuple[float, int]:
    """−ln p and place of the column of ``count`` energies that is least steady, by Bartlett's (1937) statistic.

    Σ c/2 (ln of the mean − ln of each), c squares in each cell; its law is taken for a Gamma's of the same moments.
    """
    uneven = 0.5 * squares * (count * np.log(total / count) - logs)
    j = int(uneven.argmax())
    expected, variance = _moments(count, 0.5 * squares)
    shape, x = expected**2 / variance, float(uneven[j]) * expected / variance
    chance = float(gammaincc(shape, x))
    far = x - (shape - 1.0) * float(np.log(x)) + float(gammaln(shape))  # the first term, where 64 bits have no number
    return -float(np.log(chance)) if chance > 1e-300 else far, j


@lru_cache(maxsize=1024)
def _moments(count: int, half: float) -> tuple[float, float]:
    """Mean and variance of Bartlett's statistic of ``count`` χ² of 2 ``half`` squares each: exact."""
    expected = half * count * (float(psi(count * half)) - float(np.log(count)) - float(psi(half)))
    return expected, half**2 * (count * float(polygamma(1, half)) - count**2 * float(polygamma(1, count * half)))
