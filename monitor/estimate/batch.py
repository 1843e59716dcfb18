"""Allan variance of a whole recording at once, in floating point: the reference for the window.

Shares no arithmetic with ``window``, which works in integers. Three things keep the digits, with 9.81 m/s² under 1e-4
of noise or not, and for 10⁷ samples and more:

- A term never reaches across a missing sample, so each unbroken run is a recording of its own. Its mean is taken off
  first: exact where the noise is small beside it (Sterbenz), and second differences do not see which constant it was.
- Phase is the running sum of what is left, with the roundings of all its steps summed beside it and put back
  (Ogita, Rump & Oishi, "Accurate sum and dot product", SIAM J. Sci. Comput. 26(6), 2005): right to its last digit.
- Squares are added in LANES separate sums, and these by NumPy in pairs.

Against sums in whole numbers without any rounding σ² is right to 1e-15 for stationary noise, and to 1e-12 under a
random walk. What remains is the last digit of phase, large where the mean is not steady: 1e-10 with a rate that ramps
through 20 000 times its noise.

One float64 a sample and axis is held beside the samples. The kernel runs without the GIL, an axis a call: who has
threads maps the axes over them, ``overlapping(values, factors, each=pool.map)``.

A run is walked in blocks, all τ to each: for τ shorter than a block phase comes from memory once for all of them, and
of a longer octave's three places two were touched by the octave before. A τ at a time, memory would bound it.
"""

from collections.abc import Callable, Iterable
from typing import Final, Literal

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
from monitor.compiled import compiled

TauGrid = Literal["octave", "decade10"] | tuple[float, ...]

Column = tuple[Floats, Ints]
"""Allan variance [m] of one axis, and the number of its terms [m]."""

EachAxis = Callable[[Callable[[Floats], Column], Iterable[Floats]], Iterable[Column]]
"""What ``map`` does, and an executor's ``map`` in threads."""

PRESENT: Final = 0.98
"""Share of the samples that must be there for a slope."""
BLOCK: Final = 16_384
"""Phase points of a block: three of them fill a third of a second-level cache of 1 MB."""
LANES: Final = 512
"""Separate sums of squares a τ: a row long enough for the set-up of a vector loop, and in the first-level cache."""


def overlapping(values: Floats, factors: Ints, each: EachAxis = map) -> tuple[Floats, Ints]:
    """Overlapping Allan variance [m, k] of rates [n, k], and the number of its terms [m, k].

    NIST SP 1065 eq. 11 on rates: σ²(m) = Σ (x_{k+2m} - 2x_{k+m} + x_k)² / (2 m² C), with phase x in samples of the
    rate, so that τ0 does not enter. What is not finite is missing: terms that touch it are left out.

    Args:
        values: rates [n, k] of any floating type; left alone
        factors: cluster sizes m ≥ 1
        each: maps the axes; of an executor, they are done side by side

    >>> overlapping(np.tile([1.0, 2.0], 50)[:, None], np.array([1, 2]))[0].ravel().tolist()
    [0.5, 0.0]
    """
    columns = list(each(lambda column: overlapping_axis(column, factors), values.T))
    return np.stack([avar for avar, _ in columns], axis=1), np.stack([terms for _, terms in columns], axis=1)


def overlapping_axis(rate: Floats, factors: Ints) -> Column:
    """``overlapping`` of one axis [n]: variance and terms, [m] each."""
    phase = np.empty(len(rate) + 1)
    phase[0] = 0.0
    phase[1:] = rate  # a copy in float64, whatever came: float32 sums hold no Allan variance
    m = np.ascontiguousarray(factors, np.int64)
    lanes, terms = np.zeros((m.size, LANES)), np.zeros(m.size, np.int64)
    _add_runs(phase, m, lanes, terms)
    with np.errstate(invalid="ignore"):  # 0/0 where no term is whole
        return lanes.sum(axis=1) / (2.0 * m * m * terms), terms


def slope(values: Floats) -> Floats:
    """Slope of the rate [k] over a recording [n, k], unit a sample, from its first and last third.

    NaN where more than a fiftieth of the samples is missing.

    >>> slope(0.5 * np.arange(9.0)[:, None]).tolist()
    [0.5]
    """
    third = len(values) // 3
    if third == 0:
        return np.full(values.shape[1], np.nan)
    newest = np.ascontiguousarray(values[len(values) - 3 * third :], np.float64)
    parts = [_mean(newest[part * third : (part + 1) * third]) for part in range(3)]
    counts = np.stack([count for count, _ in parts])
    whole = (counts.sum(axis=0) >= PRESENT * 3 * third) & (counts[::2] >= PRESENT * third).all(axis=0)
    return np.where(whole, (parts[2][1] - parts[0][1]) / (2.0 * third), np.nan)


def slopes(values: Floats, factors: Ints) -> Floats:
    """Slope of the rate [m, k] as each τ sees it, unit a sample: mean second difference of phase over m².

    NaN where no term is whole, and for an axis of which more than a fiftieth is missing; fewer count as its mean. The
    sum of all second differences telescopes to four blocks of phase at the ends, so that no τ costs a walk.

    >>> slopes(0.5 * np.arange(90.0)[:, None], np.array([1, 8])).round(12).ravel().tolist()
    [0.5, 0.5]
    """
    m = np.asarray(factors, np.int64)
    rates = np.ascontiguousarray(values, np.float64)
    terms = len(rates) + 1 - 2 * m
    ends = np.stack([np.zeros_like(m), m, 2 * m, terms, terms + m, terms + 2 * m])
    places, at = np.unique(ends, return_inverse=True)
    mean = _present_mean(rates)
    first, second, third, fourth, fifth, sixth = _sums_of_phase(rates, mean, places)[at.reshape(6, -1)]
    blocks = (sixth - 2.0 * fifth + fourth) - (third - 2.0 * second + first)
    with np.errstate(invalid="ignore", divide="ignore"):
        bent = blocks / (terms * m.astype(np.float64) ** 2)[:, None]
        return np.where((terms > 0)[:, None] & ~np.isnan(mean), bent, np.nan)


def _present_mean(values: Floats) -> Floats:
    """Mean [k] of what is there in [n, k]; NaN where too little is."""
    count, mean = _mean(values)
    return np.where(count < PRESENT * len(values), np.nan, mean)


@compiled
def _mean(values: Floats) -> tuple[Ints, Floats]:
    """How many are finite, and their mean, [k] each; sums are of what differs from the first, to keep its digits."""
    n, k = values.shape
    first, total, count = np.zeros(k), np.zeros(k), np.zeros(k, np.int64)
    for i in range(n):
        for a in range(k):
            if np.isfinite(values[i, a]):
                if count[a] == 0:
                    first[a] = values[i, a]
                total[a] += values[i, a] - first[a]
                count[a] += 1
    return count, first + total / np.maximum(count, 1)


@compiled
def _sums_of_phase(values: Floats, mean: Floats, places: Ints) -> Floats:
    """Running sum of phase, itself the running sum of the mean-free rates [n, k], before the ascending ``places``."""
    n, k = values.shape
    phase, total, result = np.zeros(k), np.zeros(k), np.zeros((places.size, k))
    at = 0
    while at < places.size and places[at] < 2:
        at += 1
    for i in range(n):
        for a in range(k):
            if np.isfinite(values[i, a]):
                phase[a] += values[i, a] - mean[a]
            total[a] += phase[a]
        if at < places.size and places[at] == i + 2:
            result[at] = total
            at += 1
    return result


def cluster_sizes(samples: int, rate_hz: float, tau: TauGrid = "octave") -> Ints:
    """Cluster sizes m for a window of that many samples: τ = m/rate.

    ``octave``: 1, 2, 4, …; ``decade10``: ten a decade; else the nearest m of each τ in seconds. The longest named by
    a grid is a quarter of the window, where each estimate still rests on several independent terms; τ asked for by the
    user may reach half of it.

    Raises:
        ConfigError: no τ of the list lies between one sample and half the window
    """
    longest = samples // 4
    if tau == "octave":
        return 2 ** np.arange(max(longest, 1).bit_length(), dtype=np.int64)
    if tau == "decade10":
        exponents = np.arange(0, np.log10(max(longest, 1)) + 1e-9, 0.1)
        return np.unique(np.rint(10.0**exponents).astype(np.int64))
    wanted = np.rint(np.array(tau, float) * rate_hz)
    possible = np.unique(wanted[(wanted >= 1) & (2 * wanted <= samples)].astype(np.int64))
    if possible.size == 0:
        raise ConfigError(
            f"tau: none of {list(tau)} s lies between one sample ({1 / rate_hz:g} s) "
            f"and half the window ({samples / 2 / rate_hz:g} s)"
        )
    return possible


@compiled
def _add_runs(phase: Floats, factors: Ints, lanes: Floats, terms: Ints) -> None:
    """Add all terms of rates ``phase[1:]``, which become phase in place, each run from 0 in the slot before it."""
    before = 0
    while before + 1 < phase.size:
        last = _integrate(phase, before)
        for begin in range(before, last + 1, BLOCK):
            end = min(begin + BLOCK, last + 1)
            for i in range(factors.size):
                first = max(begin, before + 2 * factors[i])
                if first < end:
                    terms[i] += end - first
                    _add_squares(phase, first, end, factors[i], lanes[i])
        before = last + 1


@compiled
def _integrate(phase: Floats, before: int) -> int:
    """Turn the run of finite rates behind a slot into phase; returns its last slot, ``before`` where there is none."""
    total, last = 0.0, before
    while last + 1 < phase.size and np.isfinite(phase[last + 1]):
        last += 1
        total += phase[last]
    mean = total / max(last - before, 1)
    total, rest = 0.0, 0.0
    phase[before] = 0.0
    for i in range(before + 1, last + 1):
        step = phase[i] - mean
        longer = total + step
        back = longer - total
        rest += (total - (longer - back)) + (step - back)
        total = longer
        phase[i] = total + rest
    return last


@compiled
def _add_squares(phase: Floats, first: int, end: int, m: int, lanes: Floats) -> None:
    """Squared second differences that end at first … end - 1, to the lanes in turn.

    An index that could be negative would make a scalar loop of the inner one.
    """
    for row in range(first, end, LANES):
        at0, at1, at2 = np.uintp(row), np.uintp(row - m), np.uintp(row - 2 * m)
        for lane in range(np.uintp(min(LANES, end - row))):
            d = (phase[at0 + lane] - phase[at1 + lane]) - (phase[at1 + lane] - phase[at2 + lane])
            lanes[lane] += d * d
