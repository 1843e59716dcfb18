"""Cross-validation of a new effect on the two halves of a recording.

The hypotheses with and without the effect are fitted to one half and tested on the other half. The effect is kept if
the likelihood of the other half increases and the gap of the diagnostic decreases. If one of these conditions is not
met, the test is repeated after the sizes of all other noise have been fitted to the other half. One-time effects, and
effects with too little evidence in one half, are kept without cross-validation.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from math import sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    HeavyTails,
    Outliers,
    RandomSampleHold,
    Resolution,
    Saturation,
    Sinusoidal,
    VarianceModulation,
    WanderingLine,
    WanderingVariance,
)
from monitor.reconcile.diagnostics.null_distribution import NullDistribution
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS
from monitor.reconcile.effect_properties import ONE_TIME_EFFECTS, SERIES_SIZE_PARAMETERS
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit
from monitor.reconcile.likelihood.effect_roles import regression_coefficients
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, noise_effect_indices
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.preparation.cosine_bins import build_frequency_bins, cosine_transform, inverse_cosine_transform
from monitor.reconcile.preparation.value_artifacts import ValueArtifacts

MIN_HALF_GAIN_NATS: Final = 5.0
"""Smallest log-likelihood gain of an effect in one half of the recording, in nats."""
SAMPLE_EFFECTS: Final = (
    Resolution,
    Saturation,
    RandomSampleHold,
    Outliers,
    HeavyTails,
    VarianceModulation,
    WanderingLine,
    WanderingVariance,
)
"""Effects that do not change the Whittle likelihood. They are validated by the gap of the diagnostic."""
TOO_LITTLE_EVIDENCE: Final = "one half of the recording alone contains too little evidence for the effect"


@dataclass(frozen=True, slots=True)
class CrossValidationResult:
    """Result of the cross-validation of one search step."""

    before: float  # gap without the step, standard deviations
    after: float  # gap with the step, standard deviations
    kept: bool
    reason: str  # reason why the step was not validated, or empty; without validation, the gaps are NaN


def accept_without_validation(reason: str) -> CrossValidationResult:
    """Return a result that accepts a search step without cross-validation."""
    return CrossValidationResult(float("nan"), float("nan"), True, reason)


def cross_validate(
    before: Hypothesis,
    after: Hypothesis,
    added_effect: Effect | None,
    diagnostic: str,
    null: NullDistribution,
) -> CrossValidationResult:
    """Cross-validate a search step on the two halves of an axis.

    Parameters
    ----------
    before, after : Hypothesis
        Hypotheses before and after the step, fitted to the whole axis.
    added_effect : Effect or None
        Added effect, or None if the step changed only sizes.
    diagnostic : str
        Name of the diagnostic that detected the difference.
    null : NullDistribution
        Null distribution of the diagnostic.
    """
    if added_effect is not None and added_effect.name in ONE_TIME_EFFECTS:
        return accept_without_validation("the effect happens only once")
    alters_samples = isinstance(added_effect, SAMPLE_EFFECTS)
    if not alters_samples and after.fit.log_likelihood - before.fit.log_likelihood < 4.0 * MIN_HALF_GAIN_NATS:
        return accept_without_validation(TOO_LITTLE_EVIDENCE)
    n = after.axis.n
    parts = [slice(0, n // 2), slice(n - n // 2, n)]
    sources = {getattr(effect, "source", "") for effect in (*before.effects, *after.effects)}
    repaired = [_half_axis(after.axis, part, sources) for part in parts]
    if alters_samples:
        halves = [_half_axis(before.axis, part, sources) for part in parts]
        gap_before, gap_after = _summed_gap(halves, before, diagnostic), _summed_gap(repaired, after, diagnostic)
        return CrossValidationResult(gap_before, gap_after, gap_after < gap_before, "")
    if added_effect is not None and added_effect.name in SERIES_SIZE_PARAMETERS:
        gains = [_expected_gain(_fit_half(half, after), after.effects[-1]) for half in repaired]
        if min(gains) < MIN_HALF_GAIN_NATS:
            return accept_without_validation(TOO_LITTLE_EVIDENCE)
    learned = _exchange_halves(repaired, before, after, frozenset(), diagnostic, null)
    if learned.kept or added_effect is None:
        return learned
    # a drift that differs between the halves must not outweigh the effect, so the other noise is fitted to each half
    others = frozenset(range(len(after.effects) - 1)) - after.fit.fixed_sizes
    return _exchange_halves(repaired, before, after, others, diagnostic, null)


def _fit_half(half: Axis, hypothesis: Hypothesis) -> AxisFit:
    return half.fit(hypothesis.effects, hypothesis.fit.fixed_sizes)


def _summed_gap(halves: list[Axis], hypothesis: Hypothesis, diagnostic: str) -> float:
    """Return the combined difference in a diagnostic after separate fits to both halves."""
    return sqrt(sum(DIAGNOSTICS[diagnostic](whiten_axis(_fit_half(half, hypothesis))).gain for half in halves))


def _exchange_halves(
    halves: list[Axis],
    before: Hypothesis,
    after: Hypothesis,
    fitted: frozenset[int],
    diagnostic: str,
    null: NullDistribution,
) -> CrossValidationResult:
    """Test each half with the noise sizes of the other half, except for the effects with the indices ``fitted``."""
    gaps = np.zeros(2)
    better = 0.0
    for learn, test in ((0, 1), (1, 0)):
        for at, hypothesis in enumerate((before, after)):
            predicted = _predict_half(halves[test], _fit_half(halves[learn], hypothesis), fitted)
            gaps[at] += DIAGNOSTICS[diagnostic](whiten_axis(predicted)).gain
            better += predicted.log_likelihood * (2 * at - 1)
    gap_before, gap_after = (sqrt(gain) for gain in gaps)
    below = gap_after < max(gap_before, sqrt(2.0 * null.threshold))
    return CrossValidationResult(gap_before, gap_after, bool(better > 0.0 and below), "")


def _half_axis(axis: Axis, part: slice, sources: Collection[str]) -> Axis:
    """Return one half of the samples of an axis, as repaired on the whole axis."""
    raw, y = axis.raw[part], axis.repaired[part]
    temperature_c = None if axis.temperature_c is None else axis.temperature_c[part]
    others = {
        name: cosine_transform(inverse_cosine_transform(one)[part])
        for name, one in axis.leak_sources.items()
        if name in sources
    }
    return Axis(
        axis.name,
        raw,
        y,
        cosine_transform(y),
        build_frequency_bins(raw.size, axis.rate_hz),
        others,
        temperature_c,
        ValueArtifacts(raw),
        axis.regressors.restrict_to_part(part),
    )


def _expected_gain(fit: AxisFit, effect: Effect) -> float:
    """Return the expected log-likelihood gain, in nats, of a deterministic effect, which is the last of the fit.

    The gain is ½ Σ s²/v, where s is the transform of the effect and v is the variance of the noise.
    """
    half = fit.axis
    columns = half.regressor_cosine_transforms(effect)
    weight = half.bins.expand_to_coefficients(half.used_bins / fit.whittle.variance)[: columns[0].size]
    gain = fit.regressor_gains[-1]
    if isinstance(effect, Sinusoidal):
        return 0.5 * (gain * effect.amplitude) ** 2 * float((columns[0] ** 2 * weight).sum())
    factors = gain * regression_coefficients(effect)
    made = sum(factor * column for factor, column in zip(factors, columns, strict=True))
    return 0.5 * float((made**2 * weight).sum())


def _predict_half(half: Axis, learned: AxisFit, fitted: frozenset[int]) -> AxisFit:
    """Apply the fit of one half of an axis to the other half.

    Noise effects keep the learned sizes, except for the effects with the indices ``fitted``. Let β₁ be the learned
    regressor sizes with the covariance C₁, and β₂ the sizes fitted to the other half with the covariance C₂. The
    prediction uses the weighted mean of β₁ and β₂. With the difference Δ = β₂ − β₁, the log-likelihood for β₂ is
    reduced by ½ Δ'(C₁ + C₂)⁻¹Δ + ½ ln(|C₁ + C₂|/|C₂|). A sinusoid keeps the learned amplitude, and the phase is
    fitted again.
    """
    effects = learned.effects
    fixed_sizes = (noise_effect_indices(effects) | learned.fixed_sizes) - fitted
    free = half.fit(effects, fixed_sizes)
    beta = free.whittle.beta.copy()
    known: list[int] = []
    for (at, place), gain in zip(free.regressor_slices, free.regressor_gains, strict=True):
        effect = effects[at]
        if at in fixed_sizes:
            continue
        if isinstance(effect, Sinusoidal):  # keep the fitted phase and use the learned amplitude
            beta[place] *= gain * effect.amplitude / max(float(np.hypot(*beta[place])), 1e-300)
        else:
            known += range(place.start, place.stop)
    free = free.with_regressor_sizes(beta)
    if not known:
        return free
    pick = np.ix_(known, known)
    here, there = (_regularised(one.whittle.beta_covariance[pick]) for one in (free, learned))
    apart = free.whittle.beta[known] - learned.whittle.beta[known]
    both = here + there
    penalty = 0.5 * float(apart @ np.linalg.pinv(both) @ apart)
    penalty += 0.5 * float(np.linalg.slogdet(both)[1] - np.linalg.slogdet(here)[1])
    beta[known] -= here @ np.linalg.pinv(both) @ apart
    return replace(free.with_regressor_sizes(beta), log_likelihood=free.log_likelihood - penalty)


def _regularised(covariance: Floats) -> Floats:
    """Add a small value to the diagonal of a covariance matrix, so that the determinant is positive."""
    return covariance + np.diag(1e-9 * np.diag(covariance) + 1e-300)
