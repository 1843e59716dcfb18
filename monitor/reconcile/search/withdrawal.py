"""Withdrawal of effects that are contradicted once the search is complete.

A line with a varying amplitude or frequency is well described by several lines or by a resonance that does not exist. A
chirp is described by a wide resonance, and a pulse by its harmonics. Each of these effects would be reported with high
confidence and be wrong. Effects that were found at a frequency are therefore withdrawn in these cases:

- Several lines or resonances overlap.
- ``MIN_COMB_LINES`` or more lines are harmonics of one frequency.
- The power at the frequency still changes in time, or still differs from the model, by more than a share of the
  original difference.

Leaks are withdrawn if more than half of the original dependence on other axes remains. In this case, vibration acts on
several axes, and no coefficient is right. Single steps are withdrawn if the level continues to change. Smooth spectra
are withdrawn if there is ``MAX_FOREIGN_RATIO`` times as much non-stationary, non-Gaussian or shared noise, because this
noise has a spectrum too.

A withdrawn effect is reported as a difference without a name.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from monitor.noise.effect import Effect, Leak
from monitor.noise.effects import BandwidthLimit, BiasStep, ExponentiallyCorrelated, Narrowband, Sinusoidal
from monitor.reconcile.diagnostics.null_distribution import AxisNull, Findings
from monitor.reconcile.likelihood.axis import Effects

MIN_COMB_LINES: Final = 4
"""Smallest number of lines that form a harmonic comb."""
MAX_HARMONIC: Final = 60
"""Highest harmonic that is considered."""
DIFFERENCE_DIVISORS: Final = (1, 2, 3)
"""Divisors of the difference of two lines that are tried as fundamental frequency."""
HARMONIC_TOLERANCE: Final = 2e-4
"""Largest distance of a line from a multiple of the fundamental, relative to the highest line."""
RESONANCE_REACH_HALF_WIDTHS: Final = 2.0
"""Range of a resonance to each side, in half widths. Another feature in this range overlaps with the resonance."""
LINE_REACH_HZ: Final = 0.1
"""Range of a line to each side, in Hz."""
MAX_REMAINING_SHARE: Final = 0.1
"""Largest remaining gain relative to the gain that an effect was to remove. Up to this limit, an effect is kept even if
the shape is not exact.
"""
MAX_REMAINING_LEAK_SHARE: Final = 0.5
"""Largest remaining gain of a leak, relative to the gain that the leak was to remove."""
MAX_FOREIGN_RATIO: Final = 100.0
"""Largest gain of the ``NON_SPECTRAL_DIAGNOSTICS`` relative to the gain that a smooth spectrum was to remove."""
SMOOTH_SPECTRA: Final = (BandwidthLimit, ExponentiallyCorrelated)
"""Effects with a smooth spectrum."""
NON_SPECTRAL_DIAGNOSTICS: Final = ("tails", "variance", "other_axes")
"""Diagnostics of departures that no stationary Gaussian spectrum explains."""
FREQUENCY_DIAGNOSTICS: Final = ("psd", "lines", "spectrogram")
"""Diagnostics that locate a departure in frequency."""


def keep_supported_effects(
    found: Effects, removed: Mapping[type[Effect], float], findings: Findings, null: AxisNull
) -> Effects:
    """Return the effects that were found on an axis and pass all checks.

    Parameters
    ----------
    found : tuple of Effect
        Effects that were found.
    removed : mapping of type to float
        For each type of effect, the gain in nats that the effect was to remove.
    findings : Findings
        Remaining findings on the axis.
    null : AxisNull
        Null distribution of each diagnostic.
    """

    def remaining(lens: str) -> float:
        gain = findings[lens].gain
        return gain if gain > null[lens].threshold else 0.0

    def contradicted(kinds: type[Effect] | tuple[type[Effect], ...], gain: float, share: float) -> set[int]:
        return {at for at, e in enumerate(found) if isinstance(e, kinds) and gain > share * removed.get(type(e), 0.0)}

    withdrawn = _overlapping_features(found) | _harmonic_comb(found)
    for lens in FREQUENCY_DIAGNOSTICS:
        place = findings[lens].where.frequency
        if place is not None:
            candidates = contradicted(Effect, remaining(lens), MAX_REMAINING_SHARE)
            withdrawn |= {at for at in candidates if _overlaps(found[at], place)}
    withdrawn |= contradicted(Leak, remaining("other_axes"), MAX_REMAINING_LEAK_SHARE)
    withdrawn |= contradicted(BiasStep, remaining("level"), MAX_REMAINING_SHARE)
    withdrawn |= contradicted(SMOOTH_SPECTRA, max(map(remaining, NON_SPECTRAL_DIAGNOSTICS)), MAX_FOREIGN_RATIO)
    return tuple(effect for at, effect in enumerate(found) if at not in withdrawn)


def _frequency_range(effect: Effect) -> tuple[float, float]:
    """Return the range of frequencies, in Hz, that a line or resonance occupies."""
    if isinstance(effect, Narrowband):
        half = max(RESONANCE_REACH_HALF_WIDTHS * 0.5 * effect.bandwidth, LINE_REACH_HZ)
        return effect.frequency - half, effect.frequency + half
    assert isinstance(effect, Sinusoidal)
    return effect.frequency - LINE_REACH_HZ, effect.frequency + LINE_REACH_HZ


def _overlaps(effect: Effect, place: tuple[float, float]) -> bool:
    """Return True if an effect acts in a range of frequencies."""
    if isinstance(effect, BandwidthLimit):
        return place[1] > 0.5 * effect.cutoff
    if not isinstance(effect, (Narrowband, Sinusoidal)):
        return False
    lo, hi = _frequency_range(effect)
    return lo < place[1] and place[0] < hi


def _overlapping_features(found: Effects) -> set[int]:
    """Return the indices of lines and resonances that overlap each other."""
    features = {at: effect for at, effect in enumerate(found) if isinstance(effect, (Sinusoidal, Narrowband))}
    overlapping: set[int] = set()
    for at, one in features.items():
        lo, hi = _frequency_range(one)
        near = {other for other, two in features.items() if other != at and lo < two.frequency < hi}
        overlapping |= near | {at} if near else set()
    return overlapping


def _harmonic_comb(found: Effects) -> set[int]:
    """Return the indices of lines that are harmonics of one fundamental frequency.

    The fundamental is one of the lines, or a fraction of the difference of two lines.
    """
    lines = {at: effect.frequency for at, effect in enumerate(found) if isinstance(effect, Sinusoidal)}
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
