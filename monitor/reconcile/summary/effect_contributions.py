"""Contribution of each change of the model to the gap of an axis, and averaging time that the change influences most.

The **explained gap** is the gain in log-likelihood of the final hypothesis over the model under test. The gain is
distributed among the changes of the model: in each step, the change whose removal costs least is removed, the remaining
sizes are fitted again, and the loss is the gain of this change. The gains are never negative, and their sum is the
explained gap.

Outliers, heavy tails, changes of the variance, random jumps and wandering lines are not fully visible in the likelihood
of the spectrum. The gain of the test that found them is added. For random jumps, only the gain over Gaussian noise with
the same spectrum is added. The likelihood of quantized, clipped or repeated values is unbounded, because a continuous
distribution never yields equal values. The gain of these effects is the gain of their influence on the noise
(``value_artifact_gain``). If the model was fitted to the same recording, only added effects have a gain, because the
sizes of the model cannot serve as a reference.

The **remaining gap** is the sum over the groups of diagnostics in ``GROUPS``. The diagnostics of a group detect the
same difference, so the gain of a group is that of its strongest significant diagnostic. For the spectrum, the gain from
fitting the power in each of ``SATURATED_BANDS`` frequency bands is used if it is larger.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from math import inf, log
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar_axis
from monitor.noise.effect import Effect, Source
from monitor.noise.effects import (
    CommonVibration,
    HeavyTails,
    NoiseStep,
    Outliers,
    PoissonSteps,
    RandomSampleHold,
    RandomTelegraph,
    Resolution,
    Saturation,
    VarianceModulation,
    WanderingLine,
    WanderingVariance,
)
from monitor.noise.spectrum import allan_variance_of_density
from monitor.reconcile.diagnostics.plot_data import interpolated_density
from monitor.reconcile.diagnostics.whiteness_tests import fitted_variance_gain_nats
from monitor.reconcile.effect_properties import EFFECT_PROPERTIES, SIZE_PARAMETERS
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.effect_roles import regression_coefficients
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, noise_effect_indices
from monitor.reconcile.preparation.cosine_bins import inverse_cosine_transform
from monitor.reconcile.result import DiagnosticGap, RemainingGap
from monitor.reconcile.search.backward_elimination import changed_sizes
from monitor.reconcile.search.search import AxisSearchResult
from monitor.reconcile.search.trials import Trial

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "spectrum": ("psd", "lines", "autocorrelation"),
    "level": ("level", "temperature"),
    "other_axes": ("other_axes",),
    "distribution": ("tails", "variance", "spectrogram"),
    "values": ("values",),
}
"""Diagnostics that detect the same difference, by the name of the group."""
JUMP_PROCESSES: Final = (PoissonSteps, RandomTelegraph)
"""Effects that have the same spectrum as Gaussian noise."""
EFFECTS_OUTSIDE_SPECTRUM: Final = (
    Outliers,
    HeavyTails,
    NoiseStep,
    VarianceModulation,
    WanderingVariance,
    WanderingLine,
    *JUMP_PROCESSES,
)
"""Effects that are not fully visible in the likelihood of the spectrum."""
SATURATED_BANDS: Final = 64
"""Number of frequency bands with a separately fitted power, equally wide on a logarithmic scale."""
MIN_AVAR: Final = 1e-300
"""Smallest Allan variance in a ratio. The variance is zero if the model without the change has no noise."""
LARGEST_INFLUENCE_SHARE: Final = 0.98
"""Share of the largest influence at which an averaging time is preferred because it is shorter."""
MAX_STEP_NOISE_SHARE: Final = 0.9
"""Largest share of the variance that quantization noise is assumed to have."""


def decompose_explained_gain(search: AxisSearchResult, fitted_first: bool) -> dict[int, float]:
    """Return the gain of each change of the model, in nats, by the index of the effect in the hypothesis.

    Parameters
    ----------
    search : AxisSearchResult
        Result of the search on the axis.
    fitted_first : bool
        True if the model was fitted to the same recording. Changed sizes then have no gain.
    """
    hypothesis = search.hypothesis
    left = set(range(hypothesis.model_effect_count, len(hypothesis.effects)))
    originals = find_original_effects(search)
    if not fitted_first:
        left.update(changed_sizes(hypothesis))
        left.update(at for at, effect in originals.items() if not isinstance(effect, Resolution))
    gains: dict[int, float] = {}
    now = hypothesis.fit.log_likelihood
    while left:
        without = {at: fit_without(hypothesis, {at, *gains}, originals).log_likelihood for at in left}
        least = max(without, key=lambda at: without[at])
        gains[least] = max(now - without[least], 0.0)
        now = min(now, without[least])
        left.discard(least)
    for at, gain in _gains_outside_spectrum(search).items():
        gains[at] = gains.get(at, 0.0) + gain
    return gains


def find_original_effects(search: AxisSearchResult) -> dict[int, Effect]:
    """Return the effects of the model under test that the search has moved or changed in shape, by their index."""
    found: dict[int, Effect] = {}
    for trial in (one.trials[0] for one in search.rounds):
        if trial.moved is not None and trial.replaced is not None:
            found.setdefault(trial.moved, trial.replaced)
    return found


def fit_without(
    hypothesis: Hypothesis, removed: Collection[int], originals: Mapping[int, Effect] | None = None
) -> AxisFit:
    """Fit a hypothesis without some of its changes.

    An effect of the model is reset to its old size, and an added effect is left out. The other changed sizes are
    fitted again, even if they were set to zero.

    Parameters
    ----------
    hypothesis : Hypothesis
        Hypothesis with all changes.
    removed : collection of int
        Indices of the effects whose changes are removed.
    originals : mapping of int to Effect, optional
        Original effects of the model that have moved, by their index.
    """
    effects: list[Effect] = []
    fixed: set[int] = set()
    unchanged = hypothesis.fit.fixed_sizes.difference(changed_sizes(hypothesis))
    for at, effect in enumerate(hypothesis.effects):
        if at in removed and at >= hypothesis.model_effect_count:
            continue
        if at in removed or at in unchanged:
            fixed.add(len(effects))
        effects.append((originals or {}).get(at, hypothesis.model[at]) if at in removed else effect)
    return hypothesis.axis.fit(effects, frozenset(fixed))


def _gains_outside_spectrum(search: AxisSearchResult) -> dict[int, float]:
    hypothesis = search.hypothesis
    found: dict[int, float] = {}
    for at in range(hypothesis.model_effect_count, len(hypothesis.effects)):
        effect = hypothesis.effects[at]
        if isinstance(effect, (Resolution, Saturation, RandomSampleHold)):
            found[at] = value_artifact_gain(hypothesis.fit, type(effect))
        elif isinstance(effect, EFFECTS_OUTSIDE_SPECTRUM):
            trials = _trials_of_effect(search, effect)
            # the likelihood of the spectrum already contains the power of jumps
            has_spectrum = isinstance(effect, JUMP_PROCESSES)
            found[at] = max((one.gain_over_same_spectrum if has_spectrum else one.score for one in trials), default=0.0)
        elif isinstance(effect, CommonVibration):
            trials = [one.trials[0] for one in search.rounds]
            found[at] = next((one.score for one in trials if one.effect == effect), 0.0)
    for at, effect in find_original_effects(search).items():
        if isinstance(effect, Resolution):
            found[at] = value_artifact_gain(hypothesis.fit, Resolution)
    return found


def _trials_of_effect(search: AxisSearchResult, effect: Effect) -> list[Trial]:
    """Return the accepted trials whose effect has the same name and is closest in the identity parameter."""
    trials = [one.trials[0] for one in search.rounds if one.trials[0].name == effect.name]
    identity = EFFECT_PROPERTIES[effect.name].identity
    place = getattr(effect, identity, None)
    if place is None:
        return trials
    distances = [abs((getattr(one.effect, identity, None) or inf) - place) for one in trials]
    return [one for one, distance in zip(trials, distances, strict=True) if distance == min(distances)]


def value_artifact_gain(fit: AxisFit, kind: type[Effect]) -> float:
    """Return the gain, in nats, of the influence of quantization, clipping or repeats on the noise.

    Quantization noise of the variance r·v in a total variance v has the gain n/2·(ρ − 1 − ln ρ) with ρ = 1/(1 − r).
    Clipped samples count with one nat each. A fraction f of repeats produces an autocorrelation of f, which has the
    gain −n/2·ln(1 − f²).

    Parameters
    ----------
    fit : AxisFit
        Fit to the axis.
    kind : type
        ``Resolution``, ``Saturation`` or ``RandomSampleHold``.
    """
    axis: Axis = fit.axis
    artifacts = axis.value_artifacts
    if kind is Resolution and artifacts.quantization is not None:
        power = np.repeat(fit.whittle.variance, axis.bins.count.astype(np.int64))
        share = min(artifacts.quantization.step.value**2 / 12.0 / float(np.median(power)), MAX_STEP_NOISE_SHARE)
        return 0.5 * axis.n * (share / (1.0 - share) + log(1.0 - share))
    if kind is Saturation and artifacts.clipping is not None:
        return float(artifacts.clipping.count)
    if kind is RandomSampleHold and artifacts.repeats is not None:
        return -0.5 * axis.n * log(1.0 - min(artifacts.repeats.fraction.value, 0.999) ** 2)
    return 0.0


def measure_remaining_gaps(search: AxisSearchResult, left_over: Sequence[DiagnosticGap]) -> tuple[RemainingGap, ...]:
    """Return the remaining gap of each group of diagnostics, the largest gap first.

    Parameters
    ----------
    search : AxisSearchResult
        Result of the search on the axis.
    left_over : sequence of DiagnosticGap
        Significant differences that remain.
    """
    fit = search.hypothesis.fit
    found = []
    for name, diagnostics in GROUPS.items():
        seen = [one for one in left_over if one.diagnostic in diagnostics]
        if not seen:
            continue
        strongest = max(seen, key=lambda one: one.gap)
        gain = 0.5 * strongest.gap**2
        if name == "spectrum":
            gain = max(gain, _saturated_spectrum_gain(fit))
        if name == "values":
            gain = min(gain, max(value_artifact_gain(fit, kind) for kind in (Resolution, Saturation, RandomSampleHold)))
        found.append(RemainingGap(name, strongest, gain))
    return tuple(sorted(found, key=lambda one: -one.gain_nats))


def _saturated_spectrum_gain(fit: AxisFit) -> float:
    """Return the gain in nats from fitting the power in each frequency band, less the expected gain of a true model."""
    bins, used = fit.axis.bins, np.flatnonzero(fit.axis.used_bins)
    f = np.log(bins.f_hz[used])
    band = np.floor((f - f[0]) / max(f[-1] - f[0], 1e-9) * SATURATED_BANDS)
    first = np.flatnonzero(np.diff(band, prepend=-1.0))
    count = np.add.reduceat(bins.count[used], first)
    power = np.add.reduceat((fit.whittle.residual / fit.whittle.variance)[used], first)
    return float(fitted_variance_gain_nats(power / count, count).sum() - 0.5 * first.size)


def find_most_influenced_averaging_times(hypothesis: Hypothesis, changed: Iterable[int]) -> dict[int, float]:
    """Find the averaging time at which each changed effect influences the Allan deviation most.

    The Allan deviation of the extended model is compared with the Allan deviation of the model without the change. All
    other sizes stay the same. Cross products of deterministic effects are neglected.

    Parameters
    ----------
    hypothesis : Hypothesis
        Hypothesis with all changes.
    changed : iterable of int
        Indices of the changed effects.

    Returns
    -------
    dict of int to float
        Averaging time of each effect in seconds, by its index. A changed size is compared with the old size. For a
        moved line or an added effect, the reference is the model without this line or effect.
    """
    resized = changed_sizes(hypothesis)
    axis, effects = hypothesis.axis, hypothesis.effects
    factors = cluster_sizes(axis.n, axis.rate_hz)
    places = {at: place for place, (at, _) in enumerate(hypothesis.fit.regressor_slices)}
    deterministic = {
        at: _deterministic_avar(hypothesis.fit, place, effects[at], factors) for at, place in places.items()
    }
    total = _noise_avar(hypothesis, effects, factors) + sum(deterministic.values())
    found: dict[int, float] = {}
    for at in changed:
        if at in deterministic:
            without = total - deterministic[at]
            if at in resized:
                without += _deterministic_avar(hypothesis.fit, places[at], hypothesis.model[at], factors)
        else:
            old = (hypothesis.model[at],) if at in resized else ()
            rest = (*effects[:at], *old, *effects[at + 1 :])
            without = _noise_avar(hypothesis, rest, factors) + sum(deterministic.values())
        influence = np.abs(np.log(np.maximum(total, MIN_AVAR) / np.maximum(without, MIN_AVAR)))
        nearly_largest = influence >= LARGEST_INFLUENCE_SHARE * influence.max()  # everywhere, for white noise
        found[at] = float(factors[int(np.argmax(nearly_largest))] / axis.rate_hz)
    return found


def _noise_avar(hypothesis: Hypothesis, effects: Effects, factors: Ints) -> Floats:
    """Return the Allan variance of all noise effects with the given sizes, shape (m,)."""
    axis = hypothesis.axis
    tau0_s = 1.0 / axis.rate_hz
    variance = axis.fit(effects, noise_effect_indices(effects)).whittle.variance
    fitted = interpolated_density(axis.bins, variance)
    others = [one for one in effects if isinstance(one, Source) and one.name not in SIZE_PARAMETERS]

    def density(f_hz: Floats) -> Floats:
        added = sum(np.nan_to_num(one.two_sided_psd(f_hz, tau0_s)) for one in others)
        return np.asarray(fitted(f_hz) + added)

    return allan_variance_of_density(density, np.asarray(factors * tau0_s, np.float64), tau0_s, ())


def _deterministic_avar(fit: AxisFit, place: int, effect: Effect, factors: Ints) -> Floats:
    """Return the Allan variance of a deterministic effect, shape (m,).

    Parameters
    ----------
    fit : AxisFit
        Fit to the axis.
    place : int
        Index of the effect among the deterministic effects of the fit.
    effect : Effect
        Effect, which may have another size than in the fit.
    factors : ndarray of int64, shape (m,)
        Averaging times in samples.
    """
    coefficients = fit.regressor_gains[place] * regression_coefficients(effect)
    columns = fit.axis.regressor_cosine_transforms(effect)
    series = sum(beta * column for beta, column in zip(coefficients.tolist(), columns, strict=True))
    return np.asarray(overlapping_avar_axis(inverse_cosine_transform(np.asarray(series)), factors)[0])
