"""Decomposition of the gap between an axis and the model under test, in nats.

The **explained gap** is the gain in log-likelihood of the final hypothesis over the model under test. The gain is
distributed among the changes of the model: in each step, the change whose removal costs least is removed, the remaining
sizes are fitted again, and the loss is the gain of this change. The gains are never negative, and their sum is the
explained gap.

Outliers, heavy tails, changes of the variance, random jumps and wandering lines are not fully visible in the likelihood
of the spectrum. The gain of the test that found them is added. For random jumps, only the gain over Gaussian noise with
the same spectrum is added. The gain of a moved line is the score of its trial. The likelihood of quantized, clipped or
repeated values is unbounded, because a continuous distribution never yields equal values. The gain of these effects is
the gain of their influence on the noise (``value_artifact_gain``). If the model was fitted to the same recording, only
added effects have a gain, because the sizes of the model cannot serve as a reference.

The **remaining gap** is the sum over the groups of diagnostics in ``GROUPS``. The diagnostics of a group detect the
same difference, so the gain of a group is that of its strongest significant diagnostic. For the spectrum, the gain from
fitting the power in each of ``SATURATED_BANDS`` frequency bands is used if it is larger.
"""

from collections.abc import Collection, Mapping, Sequence
from math import log
from typing import Final

import numpy as np

from monitor.noise.effect import Effect
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
)
from monitor.reconcile.diagnostics.whiteness_tests import fitted_variance_gain_nats
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis
from monitor.reconcile.result import DiagnosticGap, RemainingGap
from monitor.reconcile.search.backward_elimination import changed_sizes
from monitor.reconcile.search.search import AxisSearchResult

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
EFFECTS_OUTSIDE_SPECTRUM: Final = (Outliers, HeavyTails, NoiseStep, VarianceModulation, WanderingLine, *JUMP_PROCESSES)
"""Effects that are not fully visible in the likelihood of the spectrum."""
SATURATED_BANDS: Final = 64
"""Number of frequency bands with a separately fitted power, equally wide on a logarithmic scale."""
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
    left = set(range(hypothesis.given_count, len(hypothesis.effects)))
    if not fitted_first:
        left.update(changed_sizes(hypothesis))
    gains: dict[int, float] = {}
    now = hypothesis.fit.log_likelihood
    while left:
        without = {at: fit_without(hypothesis, {at, *gains}).log_likelihood for at in left}
        least = max(without, key=lambda at: without[at])
        gains[least] = max(now - without[least], 0.0)
        now = min(now, without[least])
        left.discard(least)
    for at, gain in _gains_outside_spectrum(search).items():
        gains[at] = gains.get(at, 0.0) + gain
    return gains


def fit_without(hypothesis: Hypothesis, removed: Collection[int]) -> AxisFit:
    """Fit a hypothesis without some of its changes.

    An effect of the model is reset to its old size, and an added effect is left out.

    Parameters
    ----------
    hypothesis : Hypothesis
        Hypothesis with all changes.
    removed : collection of int
        Indices of the effects whose changes are removed.
    """
    effects: list[Effect] = []
    fixed: set[int] = set()
    for at, effect in enumerate(hypothesis.effects):
        if at in removed and at >= hypothesis.given_count:
            continue
        if at in removed or at in hypothesis.fit.fixed_noise:
            fixed.add(len(effects))
        effects.append(hypothesis.model[at] if at in removed else effect)
    return hypothesis.axis.fit(effects, frozenset(fixed))


def _gains_outside_spectrum(search: AxisSearchResult) -> dict[int, float]:
    hypothesis = search.hypothesis
    found: dict[int, float] = {}
    for at in range(hypothesis.given_count, len(hypothesis.effects)):
        effect = hypothesis.effects[at]
        if isinstance(effect, (Resolution, Saturation, RandomSampleHold)):
            found[at] = value_artifact_gain(hypothesis.fit, type(effect))
        elif isinstance(effect, EFFECTS_OUTSIDE_SPECTRUM):
            trials = [one.trials[0] for one in search.rounds if one.trials[0].name == effect.name]
            # the likelihood of the spectrum already contains the power of jumps
            has_spectrum = isinstance(effect, JUMP_PROCESSES)
            found[at] = max((one.gain_over_same_spectrum if has_spectrum else one.score for one in trials), default=0.0)
        elif isinstance(effect, CommonVibration):
            trials = [one.trials[0] for one in search.rounds]
            found[at] = next((one.score for one in trials if one.effect == effect), 0.0)
    moved = {one.trials[0].moved: one.trials[0].score for one in search.rounds if one.trials[0].moved is not None}
    return found | {at: score for at, score in moved.items() if at is not None}


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
