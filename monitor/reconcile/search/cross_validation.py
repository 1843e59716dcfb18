"""Does a step hold on data that did not choose it?

The recording is cut in halves. What the step adds is fitted on one, sizes and all, and the other is looked at through
the lens that found the gap, beside the model before and the model after; then the other way round. The step is kept if
the gap shrinks and the likelihood of the unseen half grows. Where one half alone would show less than FAINT of it, as
of what happens once, there is nothing to hold out, and the reason is told.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from math import sqrt
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Outliers, Resolution, SampleHold, Saturation, Sinusoidal
from monitor.reconcile.diagnostics.diagnostics import LENSES, sight
from monitor.reconcile.diagnostics.gap import Null
from monitor.reconcile.likelihood.effect_terms import COURSE, NOISE, ONCE, size
from monitor.reconcile.likelihood.hypothesis import Hypothesis
from monitor.reconcile.preparation.axis import Axis, Courses, Effects, Likely
from monitor.reconcile.preparation.cosine_bins import bins, series, transform
from monitor.reconcile.preparation.prepare import again, look_at_values

FAINT: Final = 5.0
"""Nats that a half must be able to show."""
PER_SAMPLE: Final = (Resolution, Saturation, SampleHold, Outliers)
"""Seen in single samples, not in the spectrum."""


@dataclass(frozen=True, slots=True)
class Proof:
    """A step beside unseen data."""

    before: float  # gap
    after: float  # gap
    kept: bool
    reason: str  # why there is no such data; then the gaps are NaN and the step is kept


def proof(
    axis: Axis,
    before: Hypothesis,
    after: Hypothesis,
    added: Effect | None,
    lens: str,
    null: Null,
    rng: np.random.Generator,
) -> Proof:
    """Hold out one half of the axis, then the other.

    Args:
        axis: mended for ``after``
        before, after: fitted to the whole axis
        added: what was tried; None: other sizes of known noises
        lens: that found the gap
        null: of that lens
    """
    if added is not None and added.name in ONCE:
        return _nothing("it happens once")
    parts = [slice(0, axis.n // 2), slice(axis.n - axis.n // 2, axis.n)]
    sources = {getattr(effect, "source", "") for effect in (*before.effects, *after.effects)}
    mended = [_half(axis, part, after.effects, sources, rng) for part in parts]
    if isinstance(added, PER_SAMPLE):
        halves = [_half(axis, part, before.effects, sources, rng) for part in parts]
        return _of_samples(halves, mended, before, after, lens)
    if type(added) in COURSE and min(_shown(half, after, len(after.effects) - 1) for half in mended) < FAINT:
        return _nothing("one half of the recording alone shows too little of it")
    gain = after.likely.log_likelihood - before.likely.log_likelihood
    if gain < 4.0 * FAINT:
        return _nothing("one half of the recording alone shows too little of it")
    gaps = np.zeros(2)
    better = 0.0
    for learn, test in ((0, 1), (1, 0)):
        for at, state in enumerate((before, after)):
            learned = mended[learn].fit(state.effects, state.likely.held)
            seen = _beside(mended[test], learned)
            gaps[at] += LENSES[lens](sight(mended[test], seen)).gain
            better += seen.log_likelihood * (2 * at - 1)
    gap_before, gap_after = (sqrt(gain) for gain in gaps)
    below = gap_after < max(gap_before, sqrt(2.0 * null.threshold))
    return Proof(gap_before, gap_after, bool(better > 0.0 and below), "")


def _nothing(reason: str) -> Proof:
    return Proof(float("nan"), float("nan"), True, reason)


def _half(axis: Axis, part: slice, effects: Effects, sources: Collection[str], rng: np.random.Generator) -> Axis:
    raw = axis.raw[part]
    n = raw.size
    warmth = None if axis.temperature_c is None else axis.temperature_c[part]
    others = {name: transform(_part(one, part)) for name, one in axis.others.items() if name in sources}
    y = axis.y[part]
    half = Axis(
        axis.name,
        raw,
        y,
        transform(y),
        bins(n, axis.rate_hz),
        others,
        warmth,
        look_at_values(raw),
        Courses(n, axis.rate_hz, warmth),
    )
    return again(half, effects, rng)


def _part(coefficients: Floats, part: slice) -> Floats:
    return series(coefficients)[part]


def _shown(half: Axis, state: Hypothesis, at: int) -> float:
    """Nats that a course of the size found would gain in one half: ½ Σ (β R)²/v."""
    learned = half.fit(state.effects, state.likely.held)
    effect = state.effects[at]
    columns = half.columns(effect)
    weight = half.bins.spread(half.heard / learned.fitted.variance)
    if isinstance(effect, Sinusoidal):
        return 0.5 * effect.amplitude**2 * float((columns[0] ** 2 * weight).sum())
    quadratic = getattr(effect, "quadratic", None)
    made = size(effect) * columns[0] + (quadratic * columns[1] if quadratic is not None else 0.0)
    return 0.5 * float((made**2 * weight).sum())


def _beside(half: Axis, learned: Likely) -> Likely:
    """A half beside what the other half taught.

    Noises have the sizes learned there. So have courses, as far as they are known there: with sizes β₁ of covariance C₁
    from the one half, and β₂, C₂ from this one alone, the evidence is that of β₂ less the price of their distance,
    ½ Δ'(C₁ + C₂)⁻¹Δ + ½ ln |C₁ + C₂|/|C₂|, and the sizes are the mean of both by their weights. Of a line the phase
    begins anew.
    """
    effects = learned.effects
    held = frozenset(at for at, effect in enumerate(effects) if type(effect) in NOISE)
    free = half.fit(effects, held)
    beta = free.fitted.beta.copy()
    for at, place in free.courses:
        line = effects[at]
        if isinstance(line, Sinusoidal):  # its phase begins anew, its amplitude does not
            beta[place] *= line.amplitude / max(float(np.hypot(*beta[place])), 1e-300)
    free = half.at(free, beta)
    known = [
        k
        for at, place in free.courses
        for k in range(place.start, place.stop)
        if not isinstance(effects[at], Sinusoidal)
    ]
    if not known:
        return free
    pick = np.ix_(known, known)
    here, there = (_regular(one.fitted.beta_covariance[pick]) for one in (free, learned))
    apart = free.fitted.beta[known] - learned.fitted.beta[known]
    both = here + there
    price = 0.5 * float(apart @ np.linalg.pinv(both) @ apart)
    price += 0.5 * float(np.linalg.slogdet(both)[1] - np.linalg.slogdet(here)[1])
    beta[known] -= here @ np.linalg.pinv(both) @ apart
    fixed = half.at(free, beta)
    return replace(fixed, log_likelihood=free.log_likelihood - price)


def _regular(covariance: Floats) -> Floats:
    """With a little on its diagonal, so that what one half cannot tell has a determinant."""
    return covariance + np.diag(1e-9 * np.diag(covariance) + 1e-300)


def _of_samples(halves: list[Axis], mended: list[Axis], before: Hypothesis, after: Hypothesis, lens: str) -> Proof:
    gaps = np.zeros(2)
    for half, put_right in zip(halves, mended, strict=True):
        for at, (axis, state) in enumerate(((half, before), (put_right, after))):
            gaps[at] += LENSES[lens](sight(axis, axis.fit(state.effects, state.likely.held))).gain
    one, other = (sqrt(gain) for gain in gaps)
    return Proof(one, other, other < one, "")
