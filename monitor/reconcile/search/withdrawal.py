"""Names that do not stand once everything is found: an oscillation that is not steady, a comb of lines, a band that
moves.

A line whose amplitude or frequency wanders is well described by several lines, or by a resonance that is none; a chirp
by a wide one; a pulse by its harmonics. Each would be a name with high confidence, and wrong. So of what was found at
some frequency, the names are withdrawn where

- several lines or resonances stand in one place;
- COMB or more lines are harmonics of one frequency, and it is that of none of the model's;
- power at that very place still changes in time, or is still not what it should be, by more than a share of what it
was.

Leaks are withdrawn where more than half of what the other axes explain is open still: something shakes several axes,
and no coefficient is right. So are single steps of a level that goes on moving, and smooth spectra where what is not
steady, not Gaussian or shared with other axes is DROWNED times as much: it has a spectrum too.

What is withdrawn is left over at its place, without a name.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from monitor.noise.effect import Effect, Leak
from monitor.noise.effects import BandwidthLimit, BiasStep, ExponentiallyCorrelated, Narrowband, Sinusoidal
from monitor.reconcile.diagnostics.gap import Findings, Null
from monitor.reconcile.likelihood.hypothesis import Hypothesis
from monitor.reconcile.preparation.axis import Effects

COMB: Final = 4
HIGHEST: Final = 60
"""Harmonic that is still thought of."""
PARTS: Final = (1, 2, 3)
HARMONIC: Final = 2e-4
"""Of the fundamental: lines that near to a multiple are harmonics."""
WIDTHS: Final = 2.0
"""Of a resonance, to each side: what stands there is in one place with it."""
NEAR_HZ: Final = 0.1
"""The same for lines."""
SHARE: Final = 0.1
"""Of what an effect was to close: with less left at its place the name stands, though not its shape."""
OPEN: Final = 0.5
"""The same for leaks."""
DROWNED: Final = 100.0
"""Times what a smooth spectrum was to close: with as much left of what is FOREIGN to any spectrum it does not stand."""
SMOOTH: Final = (BandwidthLimit, ExponentiallyCorrelated)
FOREIGN: Final = ("tails", "variance", "other_axes")
LOCAL: Final = ("psd", "lines", "spectrogram")


def upheld(
    state: Hypothesis, closing: Mapping[type[Effect], float], seen: Findings, null: Mapping[str, Null]
) -> Effects:
    """What was found on an axis without those whose names do not stand.

    Args:
        closing: kind of effect -> the gain, in nats, that it was to close
    """
    found = range(state.given, len(state.effects))
    tones = [at for at in found if isinstance(state.effects[at], (Sinusoidal, Narrowband))]
    fallen = set(_crowded([(at, state.effects[at]) for at in tones]))
    fallen |= set(_comb([(at, e.frequency) for at in tones if isinstance(e := state.effects[at], Sinusoidal)]))
    for lens in LOCAL:
        place = seen[lens].where.frequency
        if place is None or seen[lens].gain <= null[lens].threshold:
            continue
        much = {at for at in found if seen[lens].gain > SHARE * closing.get(type(state.effects[at]), 0.0)}
        fallen |= {at for at in much if _covers(state.effects[at], place)}
    others = seen["other_axes"]
    if others.gain > null["other_axes"].threshold:
        leaks = {at for at in found if isinstance(state.effects[at], Leak)}
        fallen |= {at for at in leaks if others.gain > OPEN * closing.get(type(state.effects[at]), 0.0)}
    if seen["level"].gain > max(null["level"].threshold, SHARE * closing.get(BiasStep, 0.0)):
        fallen |= {at for at in found if isinstance(state.effects[at], BiasStep)}
    rest = max((seen[lens].gain for lens in FOREIGN if seen[lens].gain > null[lens].threshold), default=0.0)
    smooth = {at for at in found if isinstance(state.effects[at], SMOOTH)}
    fallen |= {at for at in smooth if rest > DROWNED * closing.get(type(state.effects[at]), 0.0)}
    return tuple(effect for at, effect in enumerate(state.found, state.given) if at not in fallen)


def _reach(effect: Effect) -> tuple[float, float]:
    """Hz, from and to."""
    if isinstance(effect, Narrowband):
        half = max(WIDTHS * 0.5 * effect.bandwidth, NEAR_HZ)
        return effect.frequency - half, effect.frequency + half
    assert isinstance(effect, Sinusoidal)
    return effect.frequency - NEAR_HZ, effect.frequency + NEAR_HZ


def _covers(effect: Effect, place: tuple[float, float]) -> bool:
    if isinstance(effect, BandwidthLimit):
        return place[1] > 0.5 * effect.cutoff
    if not isinstance(effect, (Narrowband, Sinusoidal)):
        return False
    lo, hi = _reach(effect)
    return lo < place[1] and place[0] < hi


def _crowded(tones: Sequence[tuple[int, Effect]]) -> list[int]:
    """Those that stand within each other's reach."""
    fallen: set[int] = set()
    for at, one in tones:
        lo, hi = _reach(one)
        near = {other for other, two in tones if other != at and lo < two.frequency < hi}  # type: ignore[attr-defined]
        fallen |= near | {at} if near else set()
    return sorted(fallen)


def _comb(lines: Sequence[tuple[int, float]]) -> list[int]:
    """Harmonics of one fundamental: it is one of them, or a whole part of a difference of two."""
    f = np.array([one for _, one in lines])
    if f.size < COMB:
        return []
    apart = np.abs(f[:, None] - f[None, :])[np.triu_indices(f.size, 1)]
    best: list[int] = []
    for fundamental in np.concatenate([f, *(apart / part for part in PARTS)]):
        if fundamental < f.max() / HIGHEST:
            continue
        order = np.rint(f / fundamental)
        near = (np.abs(f - order * fundamental) < HARMONIC * f.max()) & (order > 0)
        if near.sum() > len(best):
            best = [at for (at, _), one in zip(lines, near.tolist(), strict=True) if one]
    return best if len(best) >= COMB else []
