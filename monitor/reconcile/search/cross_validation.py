"""Cross-validation of a new effect on the two halves of a recording.

The effect is fitted to one half of the recording, including all sizes. The other half is examined with the diagnostic
that found the difference, with the model before and with the model after the step. Then the halves are exchanged. The
effect is kept if the difference decreases and the likelihood of the unseen half increases. Some effects cannot be
validated, because they happen once or because one half would gain less than ``MIN_HALF_GAIN_NATS``. They are kept, and
the reason is reported.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from math import sqrt
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Outliers, Resolution, SampleHold, Saturation, Sinusoidal
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS, whiten_axis
from monitor.reconcile.diagnostics.gap import NullDistribution
from monitor.reconcile.likelihood.effect_terms import (
    DETERMINISTIC_SIZE_PARAMETERS,
    NOISE_SIZE_PARAMETERS,
    ONE_TIME_EFFECTS,
    size,
)
from monitor.reconcile.likelihood.hypothesis import Hypothesis
from monitor.reconcile.preparation.axis import Axis, Effects, Likely, RegressorCache
from monitor.reconcile.preparation.cosine_bins import cosine_transform, frequency_bins, inverse_cosine_transform
from monitor.reconcile.preparation.prepare import measure_value_statistics, repair_again

MIN_HALF_GAIN_NATS: Final = 5.0
"""Smallest gain in nats that one half must be able to provide."""
SAMPLE_EFFECTS: Final = (Resolution, Saturation, SampleHold, Outliers)
"""Effects that are visible in single samples and not in the spectrum."""


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """Result of the cross-validation of one step."""

    before: float  # gap without the step, standard deviations
    after: float  # gap with the step, standard deviations
    kept: bool
    reason: str  # why no validation was possible; the gaps are then NaN and the step is kept


def cross_validate(
    axis: Axis,
    before: Hypothesis,
    after: Hypothesis,
    added: Effect | None,
    lens: str,
    null: NullDistribution,
    rng: np.random.Generator,
) -> CrossValidation:
    """Cross-validate a step on the two halves of an axis.

    Parameters
    ----------
    axis : Axis
        Axis, repaired for the effects in ``after``.
    before, after : Hypothesis
        Effects before and after the step, fitted to the whole axis.
    added : Effect or None
        Effect that was added. None means that only sizes of known noise effects were changed.
    lens : str
        Name of the diagnostic that found the difference.
    null : Null
        Null distribution of this diagnostic.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    if added is not None and added.name in ONE_TIME_EFFECTS:
        return _not_applicable("it happens once")
    parts = [slice(0, axis.n // 2), slice(axis.n - axis.n // 2, axis.n)]
    sources = {getattr(effect, "source", "") for effect in (*before.effects, *after.effects)}
    repaired = [_half_axis(axis, part, after.effects, sources, rng) for part in parts]
    if isinstance(added, SAMPLE_EFFECTS):
        halves = [_half_axis(axis, part, before.effects, sources, rng) for part in parts]
        return _validate_sample_effect(halves, repaired, before, after, lens)
    if (
        type(added) in DETERMINISTIC_SIZE_PARAMETERS
        and min(_expected_gain(half, after, len(after.effects) - 1) for half in repaired) < MIN_HALF_GAIN_NATS
    ):
        return _not_applicable("one half of the recording alone shows too little of it")
    gain = after.likely.log_likelihood - before.likely.log_likelihood
    if gain < 4.0 * MIN_HALF_GAIN_NATS:
        return _not_applicable("one half of the recording alone shows too little of it")
    gaps = np.zeros(2)
    better = 0.0
    for learn, test in ((0, 1), (1, 0)):
        for at, state in enumerate((before, after)):
            learned = repaired[learn].fit(state.effects, state.likely.held)
            seen = _predict_half(repaired[test], learned)
            gaps[at] += DIAGNOSTICS[lens](whiten_axis(repaired[test], seen)).gain
            better += seen.log_likelihood * (2 * at - 1)
    gap_before, gap_after = (sqrt(gain) for gain in gaps)
    below = gap_after < max(gap_before, sqrt(2.0 * null.threshold))
    return CrossValidation(gap_before, gap_after, bool(better > 0.0 and below), "")


def _not_applicable(reason: str) -> CrossValidation:
    """Return the result for a step that cannot be validated, with the reason."""
    return CrossValidation(float("nan"), float("nan"), True, reason)


def _half_axis(axis: Axis, part: slice, effects: Effects, sources: Collection[str], rng: np.random.Generator) -> Axis:
    """Return one half of an axis as an axis of its own."""
    raw = axis.raw[part]
    n = raw.size
    warmth = None if axis.temperature_c is None else axis.temperature_c[part]
    others = {
        name: cosine_transform(_part_of_series(one, part)) for name, one in axis.others.items() if name in sources
    }
    y = axis.repaired[part]
    half = Axis(
        axis.name,
        raw,
        y,
        cosine_transform(y),
        frequency_bins(n, axis.rate_hz),
        others,
        warmth,
        measure_value_statistics(raw),
        RegressorCache(n, axis.rate_hz, warmth),
    )
    return repair_again(half, effects, rng)


def _part_of_series(coefficients: Floats, part: slice) -> Floats:
    """Return a part of the series that has the given coefficients."""
    return inverse_cosine_transform(coefficients)[part]


def _expected_gain(half: Axis, state: Hypothesis, index: int) -> float:
    """Return the gain in nats of a deterministic effect with the fitted size in one half: ½ Σ (β R)²/v."""
    learned = half.fit(state.effects, state.likely.held)
    effect = state.effects[index]
    columns = half.columns(effect)
    weight = half.bins.spread(half.used_bins / learned.fitted.variance)
    if isinstance(effect, Sinusoidal):
        return 0.5 * effect.amplitude**2 * float((columns[0] ** 2 * weight).sum())
    quadratic = getattr(effect, "quadratic", None)
    made = size(effect) * columns[0] + (quadratic * columns[1] if quadratic is not None else 0.0)
    return 0.5 * float((made**2 * weight).sum())


def _predict_half(half: Axis, learned: Likely) -> Likely:
    """Return one half of an axis with the fit of the other half.

    Noise effects keep the sizes that were learned. Deterministic effects keep them as far as they are known. The
    learning half gives the sizes β₁ with covariance C₁, and the other half alone gives β₂ with C₂. The log-likelihood
    is that of β₂ less the penalty for their distance Δ, ½ Δ'(C₁ + C₂)⁻¹Δ + ½ ln |C₁ + C₂|/|C₂|. The resulting sizes are
    the weighted mean of both. The phase of a line is fitted anew.
    """
    effects = learned.effects
    held = frozenset(at for at, effect in enumerate(effects) if type(effect) in NOISE_SIZE_PARAMETERS)
    free = half.fit(effects, held)
    beta = free.fitted.beta.copy()
    for at, place in free.courses:
        line = effects[at]
        if isinstance(line, Sinusoidal):  # the phase is fitted anew, the amplitude is kept
            beta[place] *= line.amplitude / max(float(np.hypot(*beta[place])), 1e-300)
    free = half.with_beta(free, beta)
    known = [
        k
        for at, place in free.courses
        for k in range(place.start, place.stop)
        if not isinstance(effects[at], Sinusoidal)
    ]
    if not known:
        return free
    pick = np.ix_(known, known)
    here, there = (_regularised(one.fitted.beta_covariance[pick]) for one in (free, learned))
    apart = free.fitted.beta[known] - learned.fitted.beta[known]
    both = here + there
    price = 0.5 * float(apart @ np.linalg.pinv(both) @ apart)
    price += 0.5 * float(np.linalg.slogdet(both)[1] - np.linalg.slogdet(here)[1])
    beta[known] -= here @ np.linalg.pinv(both) @ apart
    fixed = half.with_beta(free, beta)
    return replace(fixed, log_likelihood=free.log_likelihood - price)


def _regularised(covariance: Floats) -> Floats:
    """Return a covariance with a small addition to its diagonal, so that its determinant exists."""
    return covariance + np.diag(1e-9 * np.diag(covariance) + 1e-300)


def _validate_sample_effect(
    halves: list[Axis], repaired: list[Axis], before: Hypothesis, after: Hypothesis, lens: str
) -> CrossValidation:
    """Compare the halves before and after the repair of single samples."""
    gaps = np.zeros(2)
    for half, put_right in zip(halves, repaired, strict=True):
        for at, (axis, state) in enumerate(((half, before), (put_right, after))):
            gaps[at] += DIAGNOSTICS[lens](whiten_axis(axis, axis.fit(state.effects, state.likely.held))).gain
    one, other = (sqrt(gain) for gain in gaps)
    return CrossValidation(one, other, other < one, "")
