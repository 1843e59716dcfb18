"""What no sum of five Gaussian noises has: steady lines and resonances in the spectrum, and outliers.

Comes in: a recording on its grid, and its Allan curve. Goes out: ``Line`` for each peak that matters to the curve, and
the share of outliers of each axis. Both are asked of at most MOST stretches of ROWS samples, spread over the recording,
so that the longest costs no more than a second of it; stretches with more than LACKING missing are passed over.

- **Lines.** Periodograms (Hann) of the stretches are averaged (Welch 1967). A peak stands CLEAR σ and a factor RISES
  above the medians of the bins to both of its sides, as it is and in bins WIDE times wider: lines and resonances. Its
  power is what stands above the sides of its feet. Told is what adds MATTERS or more of the Allan variance at some τ:
  a line of amplitude A makes A² sin⁴(πfτ) / (m sin(πf/rate))² (the sine of IEEE Std 952, annex C, averaged over m
  samples rather than without pause), and a resonance is taken for a line of the same power.
- **Outliers** lie beyond FAR σ of their stretch, by the distance from the median of BLOCK samples around, and half as
  far from that of the NEXT to both sides, as no slope or curve within the block does; σ is by the median distance,
  which one sample in ten moves by an eighth. A step of the resolution is the least σ.

Not found: lines below FIRST bins of a stretch, and what lasts only for a moment.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats
from monitor.estimation.allan.curve import AllanCurve

Mask = NDArray[np.bool_]

ROWS: Final = 4096
FEWEST_ROWS: Final = 256
LEAST: Final = 8
"""Stretches: with fewer there is no spectrum."""
MOST: Final = 128
MOST_FAR: Final = 32
"""Stretches that are asked for outliers: 131 072 samples, of which a thousandth is counted to a tenth."""
LACKING: Final = 0.05
"""Share of a stretch."""
CLEAR: Final = 6.5
"""σ: none of a thousand recordings each of white, flicker, quantized, walking, low-passed, coarse and held noise has a
line, of 2048 samples or of 20 000."""
RISES: Final = 1.6
"""Factor above both sides: slopes and the edge of a filter rise by less within a side."""
WIDE: Final = 16
FIRST: Final = 6
FEWEST_BINS: Final = 64
"""Of a spectrum: with fewer, a side spans so much that quantization noise rises within it."""
NEAR_BINS: Final = 3
"""Bins to each side that the Hann window may fill with a line; they belong to no side."""
SIDE_BINS: Final = 16
"""Bins of a side; a quarter of it among the wider ones."""
FALLS: Final = 2.0
"""σ by which NEAR_BINS together are below those before while a peak still falls to its foot."""
MATTERS: Final = 0.002
LINES: Final = 3
"""Of an axis, the strongest."""
FAR: Final = 5.0
BLOCK: Final = 63
"""Odd, so that the median is a sample and distances from it are whole steps of the resolution."""
NEXT: Final = 3
"""To each side: up to three outliers in a row are told."""
GAUSSIAN: Final = 1.4826
"""σ over the median distance, of Gaussian noise."""


@dataclass(frozen=True, slots=True)
class Line:
    """A peak of the spectrum of one axis."""

    axis: int  # index into AXES
    frequency_hz: float  # as sampled
    amplitude: float  # of a sine of its power, rad/s or m/s²
    share: float  # of the Allan variance, at the τ where it is largest
    wide: bool  # a resonance, wider than the spectrum resolves


@dataclass(frozen=True, slots=True)
class _Peak:
    """A peak of one spectrum."""

    middle: float  # bins
    power: float  # mean square above the level of its sides, unit² of the axis
    wide: bool


def lines(values: Floats, moving: Mask, rate_hz: float, curve: AllanCurve) -> list[Line]:
    """Peaks of all axes, the strongest of an axis first.

    Args:
        values: recording [n, 6], SI; NaN = missing
        moving: rows [n] to leave out
        rate_hz: samples a second
        curve: its Allan curve, for what matters
    """
    rows = min(ROWS, 1 << (len(values) // LEAST).bit_length() >> 1)
    if rows < FEWEST_ROWS:
        return []
    found = []
    for axis in range(len(AXES)):
        parts = [_filled(part) for part in _stretches(values[:, axis], moving, rows, MOST)]
        if len(parts) < LEAST:
            continue
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # an axis at rest, or beyond all measure
            peaks = _peaks(_spectrum(np.stack(parts)), len(parts))
            of_axis = [_line(axis, peak, rate_hz / rows, rate_hz, curve) for peak in peaks]
        strong = sorted((one for one in of_axis if one.share >= MATTERS), key=lambda one: -one.share)
        found += strong[:LINES]
    return found


def outliers(values: Floats, moving: Mask) -> Floats:
    """Share [6] of the samples [n, 6] beyond FAR σ of those around, without rows ``moving`` [n]; NaN where too few are.

    >>> noise = np.random.default_rng(0).standard_normal((20_000, 6))
    >>> noise[::50, 2] = 30.0
    >>> outliers(noise, np.zeros(20_000, bool)).round(3).tolist()
    [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]
    """
    shares = np.full(len(AXES), np.nan)
    rows = min(ROWS, len(values) // BLOCK * BLOCK)
    for axis in range(len(AXES)) if rows else ():
        far = [_far(part[np.isfinite(part)]) for part in _stretches(values[:, axis], moving, rows, MOST_FAR)]
        if far:
            shares[axis] = np.mean(far)
    return shares


def added(line: Line, curve: AllanCurve) -> Floats:
    """Share [m] of its axis' Allan variance that a line makes at each τ."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _added(line.axis, line.frequency_hz * curve.tau_s[0] / curve.factors[0], line.amplitude, curve)


def _stretches(column: Floats, moving: Mask, rows: int, most: int) -> Iterator[Floats]:
    """Stretches [rows] of an axis that lack little; NaN = missing or moving."""
    begins = np.linspace(0, len(column) - rows, min(most, max(2 * len(column) // rows - 1, 1))).astype(np.int64)
    for begin in begins:
        part = np.where(moving[begin : begin + rows], np.nan, column[begin : begin + rows])
        if np.isfinite(part).mean() >= 1.0 - LACKING:
            yield part


def _filled(part: Floats) -> Floats:
    """A stretch about its mean, 0 in the place of what is missing."""
    there = np.isfinite(part)
    return np.where(there, part - part[there].mean(), 0.0)


def _spectrum(parts: Floats) -> Floats:
    """Mean square a bin [rows / 2], of stretches [k, rows] with a mean of 0: they add up to the variance."""
    window = np.hanning(parts.shape[1])
    turned = np.fft.rfft(parts * window, axis=1)[:, :-1]  # half the rate has but one degree of freedom
    power = (turned.real**2 + turned.imag**2).mean(axis=0)
    return np.asarray(2.0 * power / (parts.shape[1] * (window**2).sum()))


def _peaks(spectrum: Floats, parts: int) -> list[_Peak]:
    """Lines first, then resonances where no line is."""
    taken = np.zeros(spectrum.size, np.bool_)
    found = []
    for width, side in ((1, SIDE_BINS), (WIDE, SIDE_BINS // 4)):
        power = spectrum[: spectrum.size // width * width].reshape(-1, width).mean(axis=1)
        if power.size < FEWEST_BINS:
            continue
        runs = _runs(_clear(power, parts * width, side))
        for first, last in sorted(runs, key=lambda run: -power[slice(*run)].max()):  # flanks belong to their summit
            if first * width < FIRST or taken[first * width : last * width].any():
                continue
            begin, end = _feet(power, first, last, parts * width)
            taken[begin * width : end * width] = True
            sides = np.concatenate([power[max(begin - side, 0) : begin], power[end : end + side]])
            above = power[begin:end] - np.median(sides)
            if above.sum() > 0.0:
                weights = np.maximum(above, 0.0)
                middle = float((np.arange(begin, end) * weights).sum() / weights.sum())
                # the leaks of a strong line are clear far from it, but not high
                high = int((above > above.max() / 4.0).sum())
                wide = width > 1 or high > 2 * NEAR_BINS + 1
                found.append(_Peak(width * (middle + 0.5) - 0.5, width * float(above.sum()), wide))
    return found


def _clear(power: Floats, averaged: int, side: int) -> Mask:
    """Bins that stand above the medians of both sides, by more than chance and by more than a slope."""
    bins, reach = power.size, NEAR_BINS + side
    # beyond the ends the spectrum goes on as in a mirror
    padded = np.pad(power, reach, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, side)
    left, right = (np.median(around[at : at + bins], axis=1) for at in (0, reach + NEAR_BINS + 1))
    level = np.maximum(left, right)
    ratio = power / level
    chi = 2.0 / (9.0 * 2.0 * averaged)  # Wilson & Hilferty 1931, 2 degrees of freedom a periodogram
    sigma = (np.cbrt(ratio) - (1.0 - chi)) / np.sqrt(chi)
    return np.asarray((sigma > CLEAR) & (ratio > RISES) & (level > 0.0))


def _feet(power: Floats, first: int, last: int, averaged: int) -> tuple[int, int]:
    """First bin of a peak and the one after the last: NEAR_BINS beyond what is clear, and on while it still falls."""
    falls, step = 1.0 - FALLS / (NEAR_BINS * averaged) ** 0.5, NEAR_BINS
    first, last = max(first - step, 0), min(last + step, power.size)
    while first >= step and power[first - step : first].sum() < falls * power[first : first + step].sum():
        first -= step
    while last + step <= power.size and power[last : last + step].sum() < falls * power[last - step : last].sum():
        last += step
    return first, last


def _runs(marks: Mask) -> list[tuple[int, int]]:
    """First of each run of marks, and the one after its last."""
    edges = np.flatnonzero(np.diff(marks.astype(np.int8), prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _line(axis: int, peak: _Peak, bin_hz: float, rate_hz: float, curve: AllanCurve) -> Line:
    """What a peak adds to the Allan curve."""
    frequency, amplitude = peak.middle * bin_hz, (2.0 * peak.power) ** 0.5
    shares = _added(axis, frequency / rate_hz, amplitude, curve)
    return Line(axis, frequency, amplitude, float(np.nanmax(shares, initial=0.0)), peak.wide)


def _added(axis: int, turns: float, amplitude: float, curve: AllanCurve) -> Floats:
    """Share [m] of a curve that a line makes, of so many turns a sample."""
    half = np.pi * turns
    made = (amplitude * np.sin(curve.factors * half) ** 2 / np.sin(half)) ** 2 / curve.factors
    return np.asarray(made / (curve.factors * curve.avar[:, axis]))


def _far(part: Floats) -> float:
    """Share of a stretch, of what is there of it, that lies far from the rest."""
    steps = np.abs(np.diff(part))
    step = float(steps[steps > 0.0].min(initial=np.inf))
    part = part[: part.size // BLOCK * BLOCK]
    if not part.size or not np.isfinite(step):
        return 0.0
    blocks = part.reshape(-1, BLOCK)
    away = np.abs(blocks - np.median(blocks, axis=1, keepdims=True))
    least = FAR * max(GAUSSIAN * _median(away, step), step)
    rows = np.flatnonzero(away > least)
    around = np.clip(rows[:, None] + np.arange(-NEXT, NEXT + 1), 0, part.size - 1)
    alone = np.abs(part[rows] - np.median(part[around], axis=1)) > least / 2.0
    return float(alone.sum()) / part.size


def _median(away: Floats, step: float) -> float:
    """Of distances that come in steps: where within its step half of them are reached."""
    middle = float(np.median(away))
    below, upto = (away < middle - step / 4.0).mean(), (away < middle + step / 4.0).mean()
    return middle + step * float((0.5 - below) / max(upto - below, 1.0 / away.size) - 0.5)
