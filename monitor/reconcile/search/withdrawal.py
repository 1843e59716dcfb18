"""Withdrawal of effects that are contradicted once the search is complete.

A line with a varying amplitude or frequency is well described by several lines or by a resonance that does not exist. A
chirp is described by a wide resonance, and a pulse by its harmonics. Each of these effects would be reported with high
confidence and be wrong. Effects that were found at a frequency are therefore withdrawn in these cases:

- Several lines or resonances overlap.
- ``MIN_COMB_LINES`` or more lines are harmonics of one frequency.
- The power at the frequency still changes in time, or still differs from the model, by more than a share of the
  original difference.

Leaks are withdrawn if more than half of the original dependence on other axes remains. Then something shakes several
axes, and no coefficient is right. Single steps are withdrawn if the level continues to change. Smooth spectra are
withdrawn if there is ``MAX_FOREIGN_RATIO`` times as much non-stationary, non-Gaussian or shared noise, because this
noise has a spectrum too.

A withdrawn effect is reported as a difference without a name.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from monitor.noise.effect import Effect, Leak
from monitor.noise.effects import BandwidthLimit, BiasStep, ExponentiallyCorrelated, Narrowband, Sinusoidal
from monitor.reconcile.diagnostics.gap import Findings, NullDistribution
from monitor.reconcile.likelihood.hypothesis import Hypothesis
from monitor.reconcile.preparation.axis import Effects

MIN_COMB_LINES: Final = 4
"""Smallest number of lines that form a harmonic comb."""
MAX_HARMONIC: Final = 60
"""Highest harmonic that is considered."""
DIFFERENCE_DIVISORS: Final = (1, 2, 3)
"""Divisors of the difference of two lines that are tried as fundamental frequency."""
HARMONIC_TOLERANCE: Final = 2e-4
"""Largest distance of a line from a multiple of the fundamental, relative to the highest line."""
RESONANCE_REACH_HALF_WIDTHS: Final = 2.0
"""Range of a resonance to each side, in half widths. Another feature in this range overlaps with it."""
LINE_REACH_HZ: Final = 0.1
"""Range of a line to each side, in Hz."""
MAX_REMAINING_SHARE: Final = 0.1
"""Largest remaining gain relative to the gain that an effect was to remove. Below it, the effect is kept although its
shape is not exact.
"""
MAX_REMAINING_LEAK_SHARE: Final = 0.5
"""The same limit for leaks."""
MAX_FOREIGN_RATIO: Final = 100.0
"""Gain of the ``NON_SPECTRAL_DIAGNOSTICS``, relative to the gain that a smooth spectrum was to remove, above which the
smooth spectrum is withdrawn.
"""
SMOOTH_SPECTRA: Final = (BandwidthLimit, ExponentiallyCorrelated)
"""Effects with a smooth spectrum."""
NON_SPECTRAL_DIAGNOSTICS: Final = ("tails", "variance", "other_axes")
"""Diagnostics of departures that no stationary Gaussian spectrum explains."""
FREQUENCY_DIAGNOSTICS: Final = ("psd", "lines", "spectrogram")
"""Diagnostics that locate a departure in frequency."""


def supported_effects(
    state: Hypothesis, closing: Mapping[type[Effect], float], seen: Findings, null: Mapping[str, NullDistribution]
) -> Effects:
    """Return the effects that were found on an axis and pass all checks.

    Parameters
    ----------
    state : Hypothesis
        Fitted effects.
    closing : mapping of type to float
        For each type of effect, the gain in nats that it was to remove.
    seen : Findings
        Remaining findings on the axis.
    null : mapping of str to Null
        Null distribution of each diagnostic.
    """
    found = range(state.given, len(state.effects))
    tones = [at for at in found if isinstance(state.effects[at], (Sinusoidal, Narrowband))]
    fallen = set(_overlapping_features([(at, state.effects[at]) for at in tones]))
    fallen |= set(_harmonic_comb([(at, e.frequency) for at in tones if isinstance(e := state.effects[at], Sinusoidal)]))
    for lens in FREQUENCY_DIAGNOSTICS:
        place = seen[lens].where.frequency
        if place is None or seen[lens].gain <= null[lens].threshold:
            continue
        much = {at for at in found if seen[lens].gain > MAX_REMAINING_SHARE * closing.get(type(state.effects[at]), 0.0)}
        fallen |= {at for at in much if _overlaps(state.effects[at], place)}
    others = seen["other_axes"]
    if others.gain > null["other_axes"].threshold:
        leaks = {at for at in found if isinstance(state.effects[at], Leak)}
        fallen |= {
            at for at in leaks if others.gain > MAX_REMAINING_LEAK_SHARE * closing.get(type(state.effects[at]), 0.0)
        }
    if seen["level"].gain > max(null["level"].threshold, MAX_REMAINING_SHARE * closing.get(BiasStep, 0.0)):
        fallen |= {at for at in found if isinstance(state.effects[at], BiasStep)}
    rest = max(
        (seen[lens].gain for lens in NON_SPECTRAL_DIAGNOSTICS if seen[lens].gain > null[lens].threshold), default=0.0
    )
    smooth = {at for at in found if isinstance(state.effects[at], SMOOTH_SPECTRA)}
    fallen |= {at for at in smooth if rest > MAX_FOREIGN_RATIO * closing.get(type(state.effects[at]), 0.0)}
    return tuple(effect for at, effect in enumerate(state.found, state.given) if at not in fallen)


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


def _overlapping_features(features: Sequence[tuple[int, Effect]]) -> list[int]:
    """Return the indices of lines and resonances that overlap each other."""
    fallen: set[int] = set()
    for at, one in features:
        lo, hi = _frequency_range(one)
        near = {other for other, two in features if other != at and lo < two.frequency < hi}  # type: ignore[attr-defined]
        fallen |= near | {at} if near else set()
    return sorted(fallen)


def _harmonic_comb(lines: Sequence[tuple[int, float]]) -> list[int]:
    """Return the indices of lines that are harmonics of one fundamental: one of the lines, or a fraction of a
    difference of two.
    """
    f = np.array([one for _, one in lines])
    if f.size < MIN_COMB_LINES:
        return []
    apart = np.abs(f[:, None] - f[None, :])[np.triu_indices(f.size, 1)]
    best: list[int] = []
    for fundamental in np.concatenate([f, *(apart / part for part in DIFFERENCE_DIVISORS)]):
        if fundamental < f.max() / MAX_HARMONIC:
            continue
        order = np.rint(f / fundamental)
        near = (np.abs(f - order * fundamental) < HARMONIC_TOLERANCE * f.max()) & (order > 0)
        if near.sum() > len(best):
            best = [at for (at, _), one in zip(lines, near.tolist(), strict=True) if one]
    return best if len(best) >= MIN_COMB_LINES else []
