"""What no sum of five Gaussian noises has: steady lines and resonances in the spectrum, and outliers.

Comes in: a recording on its grid, and its Allan curve. Goes out: ``Line`` for each peak that matters to the curve, and
the share of outliers of each axis. Both are asked of at most MOST stretches of ROWS samples, spread over the recording,
so that the longest costs no more than a second of it; stretches with more than LACKING missing are passed over.

- **Lines.** Periodograms (Hann) of the stretches are averaged (Welch 1967). A peak stands CLEAR σ and a factor RISES
  above the medians of the bins to both of its sides, as it is and in bins WIDE times wider: lines and resonances. Told
  is what adds MATTERS or more of the Allan variance at some τ: a line of amplitude A makes A² sin⁴(πfτ)/(πfτ)² (IEEE
  Std 952, annex C), and a resonance is taken for one of the same power.
- **Outliers** lie beyond FAR σ of their stretch, by the distance from the median of BLOCK samples around; σ is by the
  median distance, which one sample in ten does not move. Where the resolution is coarse, σ is a step of it at least.

Not found: lines below FIRST bins of a stretch, and what lasts only for a moment.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats, Ints
from monitor.estimate.curve import AllanCurve

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
RISES: Final = 1.6
"""Factor above both sides: slopes and the edge of a filter rise by less within a side."""
WIDE: Final = 16
FIRST: Final = 6
FEWEST_BINS: Final = 64
"""Of a spectrum: with fewer, a side spans so much that quantization noise rises within it."""
NEAR_BINS: Final = 3
"""Bins to each side that the Hann window may fill with a line; they belong to no side."""
SIDE_BINS: Final = 16
"""Bins of a side."""
MATTERS: Final = 0.002
LINES: Final = 3
"""Of an axis, the strongest."""
FAR: Final = 5.0
BLOCK: Final = 64
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
        parts = list(_whole(values[:, axis], moving, rows, MOST))
        if len(parts) >= LEAST:
            spectrum = _spectrum(np.stack(parts))
            peaks = _peaks(spectrum, len(parts), rows)
            of_axis = [_line(axis, *peak, spectrum, rows, rate_hz, curve) for peak in peaks]
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
        far = [_far(part) for part in _whole(values[:, axis], moving, rows, MOST_FAR)]
        if far:
            shares[axis] = np.mean(far)
    return shares


def _whole(column: Floats, moving: Mask, rows: int, most: int) -> Iterator[Floats]:
    """Stretches of an axis with their mean in the place of what is missing."""
    begins = np.linspace(0, len(column) - rows, min(most, max(2 * len(column) // rows - 1, 1))).astype(np.int64)
    for begin in begins:
        part = column[begin : begin + rows]
        there = np.isfinite(part) & ~moving[begin : begin + rows]
        if there.mean() >= 1.0 - LACKING:
            yield np.where(there, part, part[there].mean())


def _spectrum(parts: Floats) -> Floats:
    """Mean power [bins] of stretches [k, rows]: of a bin, twice over, the mean square it adds to white noise."""
    window = np.hanning(parts.shape[1])
    turned = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * window, axis=1)
    power = (turned.real**2 + turned.imag**2).mean(axis=0)
    return np.asarray(2.0 * power / (parts.shape[1] * (window**2).sum()))


def _peaks(spectrum: Floats, parts: int, rows: int) -> list[tuple[int, int, bool]]:
    """First bin, the one after the last, and whether it is wide: of each peak, lines before resonances."""
    taken = np.zeros(spectrum.size, np.bool_)
    found = []
    for width in (1, WIDE):
        bins = spectrum.size // width
        power = spectrum[: bins * width].reshape(bins, width).mean(axis=1)
        if bins < FEWEST_BINS:
            continue
        side = SIDE_BINS if width == 1 else SIDE_BINS // 4
        clear = _clear(power, parts * width, side)
        for first, last in _runs(clear):
            begin, end = first * width, last * width
            if begin < FIRST or taken[begin:end].any():
                continue
            taken[max(begin - NEAR_BINS, 0) : end + NEAR_BINS] = True
            found.append((begin, end, width > 1))
    return found


def _clear(power: Floats, averaged: int, side: int) -> Ints:
    """Bins that stand above the medians of both sides, by more than chance and by more than a slope."""
    bins, reach = power.size, NEAR_BINS + side
    result = np.zeros(bins, np.int64)
    # beyond the ends the spectrum goes on as in a mirror
    padded = np.pad(power, reach, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, side)
    left, right = (np.median(around[at : at + bins], axis=1) for at in (0, reach + NEAR_BINS + 1))
    level = np.maximum(left, right)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = power / level
    chi = 2.0 / (9.0 * 2.0 * averaged)  # Wilson & Hilferty 1931, 2 degrees of freedom a periodogram
    sigma = (np.cbrt(ratio) - (1.0 - chi)) / np.sqrt(chi)
    result[(sigma > CLEAR) & (ratio > RISES) & (level > 0.0)] = 1
    return result


def _runs(marks: Ints) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(marks, prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _line(
    axis: int, begin: int, end: int, wide: bool, spectrum: Floats, rows: int, rate_hz: float, curve: AllanCurve
) -> Line:
    """Of a peak: its middle, its power above the sides, and what that adds to the Allan curve."""
    near = slice(max(begin - NEAR_BINS, 0), end + NEAR_BINS)
    sides = np.concatenate(
        [spectrum[max(begin - NEAR_BINS - SIDE_BINS, 0) : near.start], spectrum[near.stop :][:SIDE_BINS]]
    )
    above = np.maximum(spectrum[near] - np.median(sides), 0.0)
    power = float(above.sum())  # mean square
    bins = np.arange(spectrum.size)[near]
    frequency = float((bins * above).sum() / above.sum()) * rate_hz / rows
    turns = np.pi * frequency * curve.tau_s
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = 2.0 * power * (np.sin(turns) ** 2 / turns) ** 2 / curve.avar[:, axis]
    return Line(axis, frequency, (2.0 * power) ** 0.5, float(np.nanmax(shares, initial=0.0)), wide)


def _far(part: Floats) -> float:
    """Share of a stretch that lies far from the rest."""
    blocks = part[: part.size // BLOCK * BLOCK].reshape(-1, BLOCK)
    away = np.abs(blocks - np.median(blocks, axis=1, keepdims=True))
    steps = np.abs(np.diff(part))
    sigma = max(GAUSSIAN * float(np.median(away)), float(steps[steps > 0.0].min(initial=np.inf)))
    return float((away > FAR * sigma).mean())
