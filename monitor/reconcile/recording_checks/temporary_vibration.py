"""Check for a vibration that lasts for a part of the recording, such as a machine that was switched on and off again.

The spectrum of short blocks is compared with the median spectrum of all blocks. A temporary vibration increases the
power in a narrow frequency band during a few blocks in succession, and the band is quiet at all other times. Changes of
the power at all frequencies indicate motion or a step of the noise. They are handled by other checks and by the search
for noise effects. If the same change occurs in a simulation of the model, the vibration cannot be distinguished from
noise.

The band is replaced with random noise during the vibration. The noise has the power of the neighbouring frequencies.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, median_filter
from scipy.special import gammaincinv

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import format_axis_value
from monitor.reconcile.likelihood.wandering_line_likelihood import expand_band, extract_band
from monitor.reconcile.recording_checks.recording_under_test import CheckResult, RecordingUnderTest
from monitor.reconcile.result import ParameterInterval, RecordingFinding

BLOCKS: Final = 64
"""Approximate number of blocks of a recording."""
BLOCK_SAMPLES: Final = (64, 4096)
"""Smallest and largest number of samples in a block."""
MIN_BLOCKS: Final = 16
FIRST_USED_BIN: Final = 4
"""First bin of a block spectrum that is used. Lower bins contain the drift."""
LAST_BINS: Final = 3
"""Number of unused bins below half the sample rate."""
BACKGROUND_BINS: Final = 31
"""Number of bins of the running median that gives the power beside a band."""
FALSE_ALARM_PROBABILITY: Final = 1e-5
"""Probability of a false alarm of one axis."""
GAP_BINS: Final = 2
"""Largest number of bins between two cells of one vibration."""
MIN_LENGTH_BLOCKS: Final = 3
MAX_SHARE: Final = 0.5
"""Largest share of the recording."""
MAX_EPISODES: Final = 3
"""Largest number of episodes of one band. A line with a varying amplitude has more episodes."""
MAX_WIDTH: Final = 0.15
"""Largest width of the band, relative to half the sample rate."""
NEIGHBOUR_WIDTHS: Final = 3
"""Width of the region on each side of the band that must be quiet at other times, in widths of the band.

A moving resonance is not quiet in this region.
"""
MIN_NEIGHBOUR_BINS: Final = 12
MAX_QUIET_RATIO: Final = 1.5
"""Largest mean power of a quiet bin, relative to the background, if it is averaged over many blocks. During the
vibration, this limit applies to the median of all other frequencies. At other times, it applies to the neighbouring
frequencies."""
MIN_CONTRAST: Final = 4.0
"""Smallest ratio of the mean power in the band during and outside the vibration."""
MIN_Z: Final = 5.0
"""Smallest significant increase of a mean power, in standard deviations."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class TemporaryVibration:
    """Vibration in a frequency band during a part of the recording."""

    axis: str  # axis with the largest increase
    first_hz: float  # lower end of the band
    last_hz: float  # upper end of the band
    frequency_hz: float  # frequency with the largest power
    active: Mask  # [blocks] True during the vibration
    contrast: float  # mean power in the band, relative to the background


@dataclass(frozen=True, slots=True)
class _BlockSpectra:
    """Power of one axis in blocks and frequency bins, relative to the background."""

    ratio: Floats  # [blocks, bins]
    block_samples: int
    bin_hz: float

    def band(self, found: TemporaryVibration) -> slice:
        """Return the bins of a band."""
        return slice(round(found.first_hz / self.bin_hz), round(found.last_hz / self.bin_hz) + 1)


def check_temporary_vibration(recording: RecordingUnderTest) -> CheckResult:
    """Replace vibrations that last for a part of the recording with noise, which is independent on each axis."""
    values, rate_hz, simulated = recording.values, recording.rate_hz, recording.simulated
    spectra = {axis: found for axis, y in values.items() if (found := _block_spectra(y, rate_hz)) is not None}
    vibrations = [one for axis, spectrum in spectra.items() for one in _find_vibrations(axis, spectrum)]
    if vibrations and simulated is not None:
        drawn = {axis: _block_spectra(simulated[axis], rate_hz) for axis in {one.axis for one in vibrations}}
        false = [one for axis, spectrum in drawn.items() if spectrum for one in _find_vibrations(axis, spectrum)]
        vibrations = [one for one in vibrations if not any(_have_common_band(one, other) for other in false)]
    corrected = dict(values)
    findings: list[RecordingFinding] = []
    while vibrations:
        largest = max(vibrations, key=lambda one: one.contrast)
        vibrations = [one for one in vibrations if not _is_same_vibration(one, largest)]
        axes = tuple(axis for axis in AXES if axis in spectra and _is_affected(spectra[axis], largest))
        amplitude = 0.0
        for axis in axes:
            rng = np.random.default_rng([recording.seed, len(findings), AXES.index(axis)])
            corrected[axis], size = _remove_vibration(corrected[axis], rate_hz, spectra[axis], largest, rng)
            amplitude = size if axis == largest.axis else amplitude
        findings.append(_describe(largest, axes, amplitude, spectra[largest.axis].block_samples / rate_hz))
    return corrected, findings


def _block_spectra(y: Floats, rate_hz: float) -> _BlockSpectra | None:
    """Return the spectra of the blocks, or None if the recording is too short or contains no noise."""
    size = int(np.clip(2 ** int(np.log2(max(y.size / BLOCKS, 1.0))), *BLOCK_SAMPLES))
    if y.size // size < MIN_BLOCKS or not np.isfinite(y).any():
        return None
    blocks = _interpolate_missing(y)[: y.size // size * size].reshape(-1, size)
    t = np.linspace(-1.0, 1.0, size)
    blocks = blocks - blocks.mean(axis=1, keepdims=True)
    blocks = blocks - np.outer(blocks @ t / (t @ t), t)
    power = np.abs(np.fft.rfft(blocks * np.hanning(size), axis=1)) ** 2
    background = median_filter(np.median(power, axis=0) / np.log(2.0), BACKGROUND_BINS, mode="nearest")
    if not (background > 0.0).all():
        return None
    ratio = power / background
    ratio[:, :FIRST_USED_BIN] = ratio[:, -LAST_BINS:] = 1.0
    return _BlockSpectra(ratio, size, rate_hz / size)


def _interpolate_missing(y: Floats) -> Floats:
    known = np.isfinite(y)
    at = np.arange(y.size)
    return y if known.all() else np.interp(at, at[known], y[known])


def _find_vibrations(axis: str, spectra: _BlockSpectra) -> list[TemporaryVibration]:
    """Return the temporary vibrations of one axis."""
    ratio = spectra.ratio
    loud = ratio > np.log(ratio.size / FALSE_ALARM_PROBABILITY)
    widened = loud.any(axis=0)
    for shift in range(1, GAP_BINS + 1):
        widened[shift:] |= loud[:, :-shift].any(axis=0)
        widened[:-shift] |= loud[:, shift:].any(axis=0)
    bands, count = label(widened)
    found = []
    for number in range(1, count + 1):
        bins = np.flatnonzero(bands == number)
        if bins.size > MAX_WIDTH * ratio.shape[1] + 2 * GAP_BINS:
            continue
        one = _examine_band(axis, spectra, int(bins[0]), int(bins[-1]) + 1)
        if one is not None:
            found.append(one)
    return found


def _examine_band(axis: str, spectra: _BlockSpectra, first: int, last: int) -> TemporaryVibration | None:
    """Return the vibration around the bins from ``first`` to ``last``, or None if the band is not quiet at other times.

    The band is widened until the power beside the band is small during the vibration.
    """
    ratio = spectra.ratio
    while last - first <= MAX_WIDTH * ratio.shape[1]:
        active = _find_active_blocks(ratio, first, last)
        if active is None:
            return None
        during, limit = ratio[active].mean(axis=0), MAX_QUIET_RATIO + MIN_Z / np.sqrt(active.sum())
        wider = max(first - GAP_BINS, 0), min(last + GAP_BINS, ratio.shape[1])
        wider_first = wider[0] if during[wider[0] : first].max(initial=0.0) > limit else first
        wider_last = wider[1] if during[last : wider[1]].max(initial=0.0) > limit else last
        if (wider_first, wider_last) == (first, last):
            return _describe_band(axis, spectra, first, last, active)
        first, last = wider_first, wider_last
    return None


def _find_active_blocks(ratio: Floats, first: int, last: int) -> Mask | None:
    """Return the blocks with large power in a band, or None if they do not form a few episodes."""
    # successive bins of a Hann window are correlated, with two thirds of the degrees of freedom
    width = last - first
    freedom = 2.0 / 3.0 * width
    limit = float(gammaincinv(freedom, 1.0 - FALSE_ALARM_PROBABILITY / ratio.size)) / freedom
    active = _close_gaps(ratio[:, first:last].mean(axis=1) > limit)
    episodes, count = label(active)
    if not 1 <= count <= MAX_EPISODES or active.mean() > MAX_SHARE or _widen(active).all():
        return None
    return active if np.bincount(episodes.ravel())[1:].max() >= MIN_LENGTH_BLOCKS else None


def _describe_band(axis: str, spectra: _BlockSpectra, first: int, last: int, active: Mask) -> TemporaryVibration | None:
    """Return the vibration in a band, or None if the band is not quiet at other times or the change is not narrow."""
    ratio, bin_hz, width = spectra.ratio, spectra.bin_hz, last - first
    quiet = ~_widen(active)
    during, outside = float(ratio[active, first:last].mean()), float(ratio[quiet, first:last].mean())
    others = np.ones(ratio.shape[1], np.bool_)
    others[:FIRST_USED_BIN] = others[-LAST_BINS:] = others[first:last] = False
    beside = max(NEIGHBOUR_WIDTHS * width, MIN_NEIGHBOUR_BINS)
    neighbours = ratio[quiet, max(first - beside, 0) : last + beside].mean(axis=0)
    if (
        during < MIN_CONTRAST * outside
        or float(np.median(ratio[active][:, others].mean(axis=0))) > MAX_QUIET_RATIO
        or neighbours.max() > MAX_QUIET_RATIO + MIN_Z / np.sqrt(quiet.sum())
    ):
        return None
    peak = first + int(ratio[active, first:last].mean(axis=0).argmax())
    return TemporaryVibration(axis, first * bin_hz, (last - 1) * bin_hz, peak * bin_hz, active, during)


def _close_gaps(active: Mask) -> Mask:
    """Return the active blocks, and single quiet blocks between two active blocks."""
    closed = active.copy()
    closed[1:-1] |= active[:-2] & active[2:]
    return closed


def _widen(active: Mask) -> Mask:
    """Return the active blocks, with each episode extended by one block at both ends."""
    wide = active.copy()
    wide[1:] |= active[:-1]
    wide[:-1] |= active[1:]
    return wide


def _have_common_band(one: TemporaryVibration, other: TemporaryVibration) -> bool:
    return one.first_hz <= other.last_hz and other.first_hz <= one.last_hz


def _is_same_vibration(one: TemporaryVibration, other: TemporaryVibration) -> bool:
    return _have_common_band(one, other) and bool((one.active & other.active).any())


def _is_affected(spectra: _BlockSpectra, found: TemporaryVibration) -> bool:
    """Return True if the power in a known band of an axis increases during the vibration."""
    band = spectra.ratio[:, spectra.band(found)]
    quiet = ~_widen(found.active)
    width = band.shape[1]
    error = 1.2 * np.sqrt(1.0 / (width * found.active.sum()) + 1.0 / (width * quiet.sum()))
    base = float(band[quiet].mean())
    return bool(band[found.active].mean() > base * (1.0 + MIN_Z * error))


def _remove_vibration(
    y: Floats, rate_hz: float, spectra: _BlockSpectra, found: TemporaryVibration, rng: np.random.Generator
) -> tuple[Floats, float]:
    """Return the axis without the vibration, and the amplitude of the vibration."""
    missing, whole = ~np.isfinite(y), _interpolate_missing(y)
    half_hz = 0.5 * (found.last_hz - found.first_hz) + 2.0 * spectra.bin_hz
    band = extract_band(whole, rate_hz, 0.5 * (found.first_hz + found.last_hz), half_hz)
    if band is None:
        return y, 0.0
    blocks = np.minimum(np.arange(band.z.size) * (y.size / band.z.size) // spectra.block_samples, found.active.size - 1)
    during = _widen(found.active)[blocks.astype(np.int64)]
    noise = (rng.standard_normal(band.z.size) + 1j * rng.standard_normal(band.z.size)) * np.sqrt(0.5)
    vibration = np.where(during, band.z - noise, 0.0)
    power = float(np.mean(np.abs(band.z[found.active[blocks.astype(np.int64)]]) ** 2)) - 1.0
    return np.where(missing, np.nan, whole - expand_band(band, vibration, y.size)), band.to_amplitude(max(power, 0.0))


def _describe(found: TemporaryVibration, axes: tuple[str, ...], amplitude: float, block_s: float) -> RecordingFinding:
    starts = np.flatnonzero(np.diff(found.active.astype(np.int8), prepend=0) == 1) * block_s
    ends = (np.flatnonzero(np.diff(found.active.astype(np.int8), append=0) == -1) + 1) * block_s
    times = " and ".join(f"from {start:.4g} to {end:.4g} s" for start, end in zip(starts, ends, strict=True))
    return RecordingFinding(
        "temporary_vibration",
        axes,
        f"A vibration at {found.frequency_hz:.4g} Hz lasts {times}, with an amplitude of "
        f"{format_axis_value(found.axis, amplitude)} on {found.axis}. The band from {found.first_hz:.4g} to "
        f"{found.last_hz:.4g} Hz was replaced with noise during this time.",
        {
            "frequency": ParameterInterval(found.frequency_hz, found.first_hz, found.last_hz),
            "time": ParameterInterval(float(starts[0])),
        },
        {
            "end_s": float(ends[-1]),
            "share": float(found.active.mean()),
            "power_ratio": found.contrast,
            "amplitude": amplitude,
        },
        corrected=True,
    )
