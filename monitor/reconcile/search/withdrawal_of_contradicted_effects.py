"""Withdrawal of added effects that the final diagnostics contradict.

Lines and resonances can fit an oscillation with a varying frequency, although the fitted model is wrong. Lines,
resonances, low-pass filters and power laws are withdrawn in these cases:

- Several lines or resonances overlap.
- ``MIN_COMB_LINES`` or more lines are harmonics of one frequency.
- A significant difference remains at the frequency of the effect. If a line or resonance at this frequency is kept, the
  difference is attributed to it and does not contradict a filter or a power law.

A leak is withdrawn if more than half of the dependence on other axes remains. Pulses are withdrawn if more than a tenth
of the harmonics remains, or if several lines are harmonics of the pulses. A step or a curve is withdrawn if the mean
level still changes. A smooth spectrum is withdrawn if the noise is mainly non-Gaussian, non-stationary or common to
several axes.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import (
    BandwidthLimit,
    BiasCurve,
    BiasStep,
    ExponentiallyCorrelated,
    Narrowband,
    PowerLaw,
    PulseTrain,
    Sinusoidal,
    WanderingLine,
)
from monitor.reconcile.diagnostics.null_distribution import AxisNull, Findings
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS, WhitenessDeparture
from monitor.reconcile.likelihood.axis_fit import Effects
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.search.trials import MAX_BAND_FRACTION

MIN_COMB_LINES: Final = 4
MAX_HARMONIC: Final = 60
MIN_PULSE_LINES: Final = 2
"""Smallest number of additional harmonic lines that rules out rectangular pulses."""
MAX_PULSE_DIVISOR: Final = 4
"""Largest divisor of the pulse frequency. The lines may be harmonics of the divided frequency."""
PULSE_ORDER_TOLERANCE: Final = 0.005
"""Largest distance of a line from a multiple of the divided pulse frequency, in units of this frequency."""
DIFFERENCE_DIVISORS: Final = (1, 2, 3)
"""Divisors that convert the distance between two lines to a possible fundamental frequency."""
HARMONIC_TOLERANCE: Final = 2e-4
"""Largest distance of a line from a harmonic, relative to the highest line frequency."""
RESONANCE_REACH_HALF_WIDTHS: Final = 2.0
"""Largest distance of an overlapping line or resonance from a resonance, in half widths."""
WANDERING_REACH_DEVIATIONS: Final = 3.0
"""Largest distance of an overlapping effect from the mean frequency of a wandering line, in standard deviations."""
LINE_REACH_HZ: Final = 0.1
MAX_REMAINING_SHARE: Final = 0.1
"""Largest remaining gain, relative to the gain that an effect should explain."""
MAX_REMAINING_LEAK_SHARE: Final = 0.5
"""Largest remaining gain, relative to the gain that a leak should explain."""
MAX_FOREIGN_RATIO: Final = 100.0
"""Largest gain of the non-spectral diagnostics, relative to the gain that a smooth spectrum should explain."""
PEAKS: Final = (Narrowband, Sinusoidal)
OSCILLATIONS: Final = (*PEAKS, WanderingLine)
SMOOTH_SPECTRA: Final = (BandwidthLimit, ExponentiallyCorrelated, PowerLaw)
NON_SPECTRAL_DIAGNOSTICS: Final = ("tails", "variance", "other_axes")
"""Diagnostics of non-Gaussian, non-stationary or common noise."""
FREQUENCY_DIAGNOSTICS: Final = ("psd", "lines", "spectrogram")
"""Diagnostics that resolve the frequency."""


def keep_uncontradicted_effects(
    added: Effects, explained_gains: Mapping[type[Effect], float], findings: Findings, null: AxisNull, rate_hz: float
) -> Effects:
    """Return the added effects that the final diagnostics do not contradict.

    Parameters
    ----------
    added : tuple of Effect
        Effects that the search added.
    explained_gains : mapping of type to float
        For each type of effect, the gain in nats that the effect should explain.
    findings : Findings
        Findings on the axis at the end of the search.
    null : AxisNull
        Null distribution of each diagnostic.
    rate_hz : float
        Sample rate in Hz.
    """

    def significant_gain_or_zero(diagnostic: str) -> float:
        gain = findings[diagnostic].gain
        return gain if gain > null[diagnostic].threshold else 0.0

    def contradicted_effects(kinds: type[Effect] | tuple[type[Effect], ...], gain: float, share: float) -> set[int]:
        return {
            at
            for at, e in enumerate(added)
            if isinstance(e, kinds) and gain > share * explained_gains.get(type(e), 0.0)
        }

    withdrawn = _overlapping_features(added) | _harmonic_comb(added) | _pulses_with_lines(added)
    for diagnostic in FREQUENCY_DIAGNOSTICS:
        place = _resolved_frequency(diagnostic, findings[diagnostic], rate_hz)
        if place is not None:
            candidates = contradicted_effects(Effect, significant_gain_or_zero(diagnostic), MAX_REMAINING_SHARE)
            overlapping = {at for at, effect in enumerate(added) if _overlaps(effect, place)}
            peaks = {at for at in overlapping if isinstance(added[at], PEAKS)}
            # a small difference at a peak that is kept comes from this peak and not from the smooth spectrum below
            withdrawn |= candidates & (peaks if peaks - candidates else overlapping)
    withdrawn |= contradicted_effects(AxisLeak, significant_gain_or_zero("other_axes"), MAX_REMAINING_LEAK_SHARE)
    withdrawn |= contradicted_effects(PulseTrain, significant_gain_or_zero("lines"), MAX_REMAINING_SHARE)
    withdrawn |= contradicted_effects((BiasStep, BiasCurve), significant_gain_or_zero("level"), MAX_REMAINING_SHARE)
    withdrawn |= contradicted_effects(
        SMOOTH_SPECTRA, max(map(significant_gain_or_zero, NON_SPECTRAL_DIAGNOSTICS)), MAX_FOREIGN_RATIO
    )
    return tuple(effect for at, effect in enumerate(added) if at not in withdrawn)


def difference_remains_near_line(line: WanderingLine, before: Findings, whitened: WhitenedAxis, null: AxisNull) -> bool:
    """Return True if a significant difference remains in the frequency range of a wandering line.

    Parameters
    ----------
    line : WanderingLine
        Line that was subtracted from the axis.
    before : Findings
        Findings before the subtraction.
    whitened : WhitenedAxis
        Axis after the subtraction.
    null : AxisNull
        Null distribution of each diagnostic.
    """
    largest = max(before[diagnostic].gain for diagnostic in FREQUENCY_DIAGNOSTICS)
    for diagnostic in FREQUENCY_DIAGNOSTICS:
        one = DIAGNOSTICS[diagnostic](whitened)
        place = _resolved_frequency(diagnostic, one, whitened.axis.rate_hz)
        if place and one.gain > max(null[diagnostic].threshold, MAX_REMAINING_SHARE * largest):
            lo, hi = _frequency_range(line)
            if lo < place[1] and place[0] < hi:
                return True
    return False


def _resolved_frequency(diagnostic: str, finding: WhitenessDeparture, rate_hz: float) -> tuple[float, float] | None:
    """Return the frequency range of a difference, or None if the diagnostic does not resolve its frequency.

    If the power changes over time in a wide band, as it does during a knock, the spectrogram is still consistent with
    an effect at one frequency.
    """
    place = finding.where.frequency
    is_wide = place is not None and np.ptp(place) >= MAX_BAND_FRACTION * rate_hz
    return None if diagnostic == "spectrogram" and is_wide else place


def share_of_frequencies_covered(effect: Effect, place: tuple[float, float]) -> float:
    """Return the share of a frequency range that a line, wandering line or resonance covers. It is 0 for other effects.

    Examples
    --------
    >>> share_of_frequencies_covered(Narrowband(sigma=1.0, frequency=10.0, bandwidth=2.0), (11.0, 15.0))
    0.25
    """
    if not isinstance(effect, OSCILLATIONS):
        return 0.0
    lo, hi = _frequency_range(effect)
    if place[0] == place[1]:
        return float(lo < place[0] < hi)
    return max(min(hi, place[1]) - max(lo, place[0]), 0.0) / (place[1] - place[0])


def _frequency_range(effect: Effect) -> tuple[float, float]:
    if isinstance(effect, Narrowband):
        half = max(RESONANCE_REACH_HALF_WIDTHS * 0.5 * effect.bandwidth, LINE_REACH_HZ)
        return effect.frequency - half, effect.frequency + half
    if isinstance(effect, WanderingLine):
        half = max(WANDERING_REACH_DEVIATIONS * effect.frequency_deviation, LINE_REACH_HZ)
        return effect.frequency - half, effect.frequency + half
    assert isinstance(effect, Sinusoidal)
    return effect.frequency - LINE_REACH_HZ, effect.frequency + LINE_REACH_HZ


def _overlaps(effect: Effect, place: tuple[float, float]) -> bool:
    """Return True if an effect acts in a frequency range."""
    if isinstance(effect, PowerLaw):
        return True
    if isinstance(effect, BandwidthLimit):
        return place[1] > 0.5 * effect.cutoff
    if not isinstance(effect, PEAKS):
        return False
    lo, hi = _frequency_range(effect)
    return lo < place[1] and place[0] < hi


def _overlapping_features(added: Effects) -> set[int]:
    features = {at: effect for at, effect in enumerate(added) if isinstance(effect, PEAKS)}
    overlapping: set[int] = set()
    for at, one in features.items():
        lo, hi = _frequency_range(one)
        near = {other for other, two in features.items() if other != at and lo < two.frequency < hi}
        overlapping |= near | {at} if near else set()
    return overlapping


def _pulses_with_lines(added: Effects) -> set[int]:
    """Return the indices of pulses and lines if several lines are harmonics of a fraction of the pulse frequency.

    Such pulses and lines belong to a periodic signal with a different shape.
    """
    found: set[int] = set()
    for at, pulses in enumerate(added):
        if not isinstance(pulses, PulseTrain):
            continue
        for part in range(1, MAX_PULSE_DIVISOR + 1):
            lines = {
                other: line.frequency * pulses.period * part
                for other, line in enumerate(added)
                if isinstance(line, Sinusoidal)
            }
            near = {other for other, order in lines.items() if abs(order - round(order)) < PULSE_ORDER_TOLERANCE}
            found |= near | {at} if len(near) >= MIN_PULSE_LINES else set()
    return found


def _harmonic_comb(added: Effects) -> set[int]:
    """Return the indices of lines that are harmonics of one fundamental frequency."""
    lines = {at: effect.frequency for at, effect in enumerate(added) if isinstance(effect, Sinusoidal)}
    f = np.array(list(lines.values()))
    if f.size < MIN_COMB_LINES:
        return set()
    apart = np.abs(f[:, None] - f[None, :])[np.triu_indices(f.size, 1)]
    best: set[int] = set()
    for fundamental in np.concatenate([f, *(apart / part for part in DIFFERENCE_DIVISORS)]):
        if fundamental < f.max() / MAX_HARMONIC:
            continue
        order = np.rint(f / fundamental)
        near = (np.abs(f - order * fundamental) < HARMONIC_TOLERANCE * f.max()) & (order > 0)
        if near.sum() > len(best):
            best = {at for at, harmonic in zip(lines, near.tolist(), strict=True) if harmonic}
    return best if len(best) >= MIN_COMB_LINES else set()
