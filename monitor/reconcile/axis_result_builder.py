"""Convert the search on one axis into an ``AxisResult`` with parameters, confidence and justification."""

from dataclasses import replace
from math import erf, exp, inf, log
from typing import Final

import numpy as np

from monitor.common.distributions import Z95
from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import EFFECTS, BandwidthLimit, Outliers, PulseTrain, Sinusoidal, TemperatureBias
from monitor.noise.effects.signal_chain.bandwidth_limit import FILTER_KINDS
from monitor.reconcile.diagnostics.null_distribution import AxisNull, compute_diagnostic_gaps
from monitor.reconcile.effect_properties import (
    EFFECT_PROPERTIES,
    MOST_DIRECT_DIAGNOSTIC,
    SERIES_SIZE_PARAMETERS,
    SIZE_PARAMETERS,
)
from monitor.reconcile.likelihood.effect_roles import effect_size, linear_coefficient_names
from monitor.reconcile.likelihood.hypothesis_fit import Hypothesis, compute_shape_interval, compute_size_interval
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AllanInfluence,
    AlternativeEffect,
    AxisModelDiagnostics,
    AxisResult,
    Decision,
    DiagnosticGap,
    ParameterInterval,
    StepKind,
    comparable_allan_deviations,
)
from monitor.reconcile.search.backward_elimination import changed_sizes
from monitor.reconcile.search.search import AxisSearchResult, HypothesisDiagnostics, SearchRound
from monitor.reconcile.search.trials import RETUNE, Trial
from monitor.reconcile.search.withdrawal_of_contradicted_effects import OSCILLATIONS, share_of_frequencies_covered
from monitor.reconcile.summary.effect_contributions import (
    decompose_explained_gain,
    find_most_influenced_averaging_times,
    find_original_effects,
    measure_remaining_gaps,
)

MAX_RUNNERS_UP: Final = 3
MAX_FREQUENCY_DIFFERENCE: Final = 0.05
"""Largest relative difference of the frequencies of two candidates for the same oscillation."""
MIN_COVERED_SHARE: Final = 0.25
"""Smallest share of the frequencies of a remaining difference that an oscillation of the wrong shape covers."""
MAX_CONFIDENCE_OF_WRONG_SHAPE: Final = 0.5
"""Largest confidence of an effect whose spectrum has probably another shape. This value is empirical: in the
trials, all such effects were wrong."""
SPECTRUM_DIAGNOSTICS: Final = ("psd", "lines")
MOVED_PARAMETERS: Final = {
    "sinusoidal": "frequency",
    "narrowband": "frequency or bandwidth",
    "bandwidth_limit": "cutoff, order or kind",
    "resolution": "step",
}
"""Parameters that differ between the model and the recording if an effect has moved."""
MIN_RUNNER_UP_CONFIDENCE: Final = 0.001
"""Smallest confidence with which an alternative effect is reported."""


def build_axis_result(
    search: AxisSearchResult, null: AxisNull, final_null: AxisNull, fitted_first: bool = False
) -> AxisResult:
    """Build the result of one axis from the search for missing effects.

    Parameters
    ----------
    search : AxisSearchResult
        Result of the search on the axis.
    null : AxisNull
        Null distributions of the diagnostics under the original model.
    final_null : AxisNull
        Null distributions of the diagnostics under the extended model.
    fitted_first : bool, optional
        True if the original model was fitted to the same recording.
    """
    snapshots = [_snapshot(one.before, null) for one in search.rounds]
    end = _snapshot(with_outlier_misfit(search), final_null)
    snapshots.append(end if search.before_withdrawal is None else _snapshot(search.before_withdrawal, null))
    changes = _remaining_changes(search)
    gains = decompose_explained_gain(search, fitted_first)
    influences = _allan_influences(search, {index for _, index, _ in changes}, snapshots[0], end) if changes else {}
    left_over = tuple(gap for gap in end.gaps if gap.is_significant)
    steps = []
    for at, index, kind in changes:
        before = snapshots[0 if search.rounds[at].replaces_effects else at]
        step = _describe_step(search, search.rounds[at], index, kind, before, snapshots[at + 1])
        step = replace(step, gain_nats=gains.get(index, 0.0), allan=influences[index])
        doubt = _doubt_about_shape(search.hypothesis.effects[index], step.gain_nats, left_over)
        if kind == "added" and doubt:
            confidence = min(step.confidence, MAX_CONFIDENCE_OF_WRONG_SHAPE)
            step = replace(step, confidence=confidence, because=f"{step.because} {doubt}")
        steps.append(step)
    decision = _axis_decision(bool(steps), bool(left_over))
    remaining = measure_remaining_gaps(search, left_over)
    return AxisResult(search.hypothesis.axis.name, decision, snapshots[0], tuple(steps), left_over, end, remaining)


def _allan_influences(
    search: AxisSearchResult, changed: set[int], start: AxisModelDiagnostics, end: AxisModelDiagnostics
) -> dict[int, AllanInfluence]:
    """Return the ratio of the plotted Allan deviations at the averaging time that each change influences most.

    The other changes of the model belong to the ratio, because an added effect often replaces the size of another term.
    """
    before, after = comparable_allan_deviations(start, end)
    ratios = after.expected / before.expected
    taus_s = find_most_influenced_averaging_times(search.hypothesis, changed)
    return {at: AllanInfluence(float(np.interp(tau_s, before.x, ratios)), tau_s) for at, tau_s in taus_s.items()}


def with_outlier_misfit(search: AxisSearchResult) -> HypothesisDiagnostics:
    """Return the final diagnostics, including the misfit that the replacement of outliers removes."""
    if not any(isinstance(effect, Outliers) for effect in search.hypothesis.added):
        return search.final
    misfit = max((one.trials[0].misfit_nats for one in search.rounds), default=0.0)
    tails = search.final.findings["tails"]
    findings = {**search.final.findings, "tails": replace(tails, gain=tails.gain + misfit)}
    return replace(search.final, findings=findings)


def _snapshot(diagnostics: HypothesisDiagnostics, null: AxisNull) -> AxisModelDiagnostics:
    return AxisModelDiagnostics(compute_diagnostic_gaps(diagnostics.findings, null), diagnostics.plots)


def _remaining_changes(search: AxisSearchResult) -> list[tuple[int, int, StepKind]]:
    """Return the changes that the search kept: index of the search round, index of the effect, and kind of change."""
    hypothesis = search.hypothesis
    found: list[tuple[int, int, StepKind]] = []
    left = list(range(hypothesis.model_effect_count, len(hypothesis.effects)))
    last_move = {one.trials[0].moved: at for at, one in enumerate(search.rounds)}
    resized = set(changed_sizes(hypothesis)) - last_move.keys()
    for at, one in enumerate(search.rounds):
        last = one.hypothesis.effects[-1]
        index = next((i for i in left if type(hypothesis.effects[i]) is type(last)), None)
        moved = one.trials[0].moved
        if moved is not None:
            if last_move[moved] == at:
                found.append((at, moved, "retuned"))
        elif index is not None and one.hypothesis.added and one.trials[0].effect is not None:
            left.remove(index)
            found.append((at, index, "added"))
        last_round = at == len(search.rounds) - 1
        for noise in sorted(resized):
            if noise not in one.hypothesis.fit.fixed_sizes or last_round:
                found.append((at, noise, "retuned" if effect_size(hypothesis.effects[noise]) != 0.0 else "absent"))
                resized.discard(noise)
    return found


def _gap_of(diagnostic: str, snapshot: AxisModelDiagnostics) -> DiagnosticGap:
    return next(gap for gap in snapshot.gaps if gap.diagnostic == diagnostic)


def _axis_decision(changed: bool, left_over: bool) -> Decision:
    if left_over:
        return "partly_explained" if changed else "unexplained"
    return "explained" if changed else "agrees"


def _describe_step(
    search: AxisSearchResult,
    done: SearchRound,
    index: int,
    kind: StepKind,
    before: AxisModelDiagnostics,
    after: AxisModelDiagnostics,
) -> AddedOrResizedEffect:
    effect, trial = search.hypothesis.effects[index], done.trials[0]
    moved = trial.moved == index
    gap = _triggering_gap(effect, before)
    later = _gap_of(gap.diagnostic, after)
    trials = _trials_not_added_too(search.hypothesis, index, done.trials)
    confidence, others = _confidence_and_runners_up(effect.name if kind == "added" or moved else RETUNE, trials)
    if kind != "added" and trial.name != RETUNE and not moved:  # an effect was added in the same round
        confidence, others = _resize_confidence(search.hypothesis, index), ()
    return AddedOrResizedEffect(
        kind=kind,
        effect=effect.name,
        parameters=_parameters_with_bounds(search.hypothesis, index, trial, "added" if moved else kind),
        confidence=confidence,
        runners_up=others,
        before=gap,
        after=later,
        held_out=None if done.validation.reason else (done.validation.before, done.validation.after),
        held_out_reason=done.validation.reason,
        because=_justification(effect, kind, gap, later, others, trial),
        snapshot_after=after,
        moved_from=find_original_effects(search).get(index) if moved else None,
    )


def _triggering_gap(effect: Effect, before: AxisModelDiagnostics) -> DiagnosticGap:
    """Return the difference between recording and model that led to an effect.

    A significant difference in the most sensitive diagnostic of the effect is preferred. Otherwise, the difference with
    the largest ratio to the threshold is returned.
    """
    significant = [gap for gap in before.gaps if gap.is_significant] or list(before.gaps)
    most_direct = MOST_DIRECT_DIAGNOSTIC.get(effect.name)
    for gap in significant:
        if gap.diagnostic == most_direct:
            return gap
    return max(significant, key=lambda gap: gap.gap / max(gap.threshold, 1e-9))


def _doubt_about_shape(effect: Effect, gain_nats: float, left_over: tuple[DiagnosticGap, ...]) -> str:
    """Return why the spectrum of an added effect has probably another shape, or an empty text."""
    if MOST_DIRECT_DIAGNOSTIC.get(effect.name) not in SPECTRUM_DIAGNOSTICS:
        return ""
    spectrum = [gap for gap in left_over if gap.diagnostic in SPECTRUM_DIAGNOSTICS]
    places = (gap.where.frequency for gap in spectrum)
    if any(place and share_of_frequencies_covered(effect, place) > MIN_COVERED_SHARE for place in places):
        return "A difference remains at its frequency, so the effect describes the spectrum only approximately."
    if max((0.5 * gap.gap**2 for gap in spectrum), default=0.0) > gain_nats:
        return "A larger difference of the spectrum remains, so the name is uncertain."
    return ""


def _trials_not_added_too(hypothesis: Hypothesis, index: int, trials: tuple[Trial, ...]) -> tuple[Trial, ...]:
    """Return the selected trial and its alternatives, without effects that were added in other rounds.

    An effect that was added in another round is not an alternative, because it explains another difference.
    """
    added = [
        effect for at, effect in enumerate(hypothesis.effects) if at >= hypothesis.model_effect_count and at != index
    ]
    alternatives = [one for one in trials[1:] if not any(_is_same_effect(one.effect, effect) for effect in added)]
    return (trials[0], *alternatives)


def _is_same_effect(one: Effect | None, other: Effect) -> bool:
    """Return True if both effects have the same type, or are oscillations with nearly the same frequency."""
    if type(one) is not type(other) and not (isinstance(one, OSCILLATIONS) and isinstance(other, OSCILLATIONS)):
        return False
    hz, other_hz = getattr(one, "frequency", None), getattr(other, "frequency", None)
    return not (hz and other_hz) or abs(log(hz / other_hz)) < MAX_FREQUENCY_DIFFERENCE


def _confidence_and_runners_up(name: str, trials: tuple[Trial, ...]) -> tuple[float, tuple[AlternativeEffect, ...]]:
    """Return the probability of the selected effect, and the most probable alternative effects.

    Each probability is proportional to exp(score) and is normalised over all effects tried in the search round. The
    hypothesis without any effect has the score 0.
    """
    best: dict[str, float] = {"": 0.0}
    for trial in trials:
        best[trial.name] = max(best.get(trial.name, -inf), trial.score_with_slow_noise)
    top = max(best.values())
    whole = sum(exp(value - top) for value in best.values())
    chances = {other: exp(value - top) / whole for other, value in best.items()}
    others = sorted(
        (chance, other)
        for other, chance in chances.items()
        if other in EFFECTS and other != name and chance >= MIN_RUNNER_UP_CONFIDENCE
    )
    runners_up = tuple(AlternativeEffect(other, chance) for chance, other in reversed(others[-MAX_RUNNERS_UP:]))
    return chances.get(name, chances[max(best, key=lambda one: best[one])]), runners_up


def _resize_confidence(hypothesis: Hypothesis, index: int) -> float:
    """Return the probability that the true size of an effect differs from the size in the model."""
    if hypothesis.effects[index].name in SERIES_SIZE_PARAMETERS:
        effects = (*hypothesis.effects[:index], hypothesis.model[index], *hypothesis.effects[index + 1 :])
        with_old_size = hypothesis.axis.fit(effects, hypothesis.fit.fixed_sizes | {index})
        return erf(max(hypothesis.fit.log_likelihood - with_old_size.log_likelihood, 0.0) ** 0.5)
    now, before = effect_size(hypothesis.effects[index]), effect_size(hypothesis.model[index])
    error = hypothesis.fit.size_standard_error(index)
    if not (now > 0.0 and before > 0.0 and error > 0.0):
        return 1.0  # one of the sizes is zero
    return erf(abs(log(now / before)) * now / error / 2.0**0.5)


def _parameters_with_bounds(
    hypothesis: Hypothesis, index: int, trial: Trial, kind: StepKind
) -> dict[str, ParameterInterval]:
    effect = hypothesis.effects[index]
    if kind == "added" and trial.intervals and trial.name == effect.name:
        return dict(trial.intervals)
    found: dict[str, ParameterInterval] = {}
    if isinstance(effect, AxisLeak):
        found["source"] = ParameterInterval(effect.source)
    size_name = SIZE_PARAMETERS.get(effect.name)
    if size_name is not None and getattr(effect, size_name) is not None:
        found[size_name] = compute_size_interval(hypothesis.fit, index)
    for name in linear_coefficient_names(effect)[1:] if effect.name in SERIES_SIZE_PARAMETERS else ():
        found[name] = _coefficient_bounds(hypothesis, index, name)
    if isinstance(effect, TemperatureBias):
        found["reference"] = ParameterInterval(effect.reference)
    for shape in EFFECT_PROPERTIES[effect.name].shapes if kind == "added" else ():
        if getattr(effect, shape) is not None:
            found[shape] = compute_shape_interval(hypothesis.fit, index, shape)
    if isinstance(effect, PulseTrain):
        found |= {name: ParameterInterval(getattr(effect, name)) for name in ("period", "width", "delay")}
    if isinstance(effect, BandwidthLimit) and kind == "added":
        found["order"] = ParameterInterval(float(effect.stages))
        found["kind"] = ParameterInterval(effect.kind or FILTER_KINDS[0])
    if isinstance(effect, Sinusoidal) and effect.phase is not None and index not in hypothesis.fit.fixed_sizes:
        # the frequency is fitted too, which doubles the phase error at the start of a recording (Rife & Boorstyn 1974)
        error = 2.0 * Z95 * hypothesis.fit.size_standard_error(index) / effect.amplitude
        found["phase"] = ParameterInterval(effect.phase, effect.phase - error, effect.phase + error)
    return found


def _coefficient_bounds(hypothesis: Hypothesis, index: int, name: str) -> ParameterInterval:
    effect = hypothesis.effects[index]
    value = float(getattr(effect, name))
    if index in hypothesis.fit.fixed_sizes:
        return ParameterInterval(value)
    error = hypothesis.fit.coefficient_standard_errors(index)[linear_coefficient_names(effect).index(name)]
    return ParameterInterval(value, value - Z95 * float(error), value + Z95 * float(error))


EVIDENCE_TEXT: Final = {
    "values": "The measured values are quantized, clipped or repeated",
    "psd": "The power differs from the spectrum of the model",
    "lines": "The spectrum contains a steady oscillation or the harmonics of pulses",
    "autocorrelation": "Successive samples are correlated more than the model allows",
    "level": "The level changes more than the model allows",
    "temperature": "The level depends on the temperature",
    "other_axes": "The axis contains a share of another axis",
    "tails": "The samples have heavier tails than Gaussian noise",
    "variance": "The variance of the noise changes in time",
    "spectrogram": "The power in a frequency band changes in time",
}
"""For each diagnostic, the text that describes its evidence."""


def _justification(
    effect: Effect,
    kind: StepKind,
    gap: DiagnosticGap,
    after: DiagnosticGap,
    others: tuple[AlternativeEffect, ...],
    trial: Trial,
) -> str:
    gaps = f"the gap is {gap.gap:.1f}, and a true model stays below {gap.threshold:.1f}"
    sentences = [f"{EVIDENCE_TEXT[gap.diagnostic]}{_location_text(gap)}: {gaps}."]
    if not gap.is_significant:
        sentences = [f"{effect.name} explains a difference that no diagnostic alone detects: {gaps}."]
    if kind != "added":
        is_moved = trial.moved is not None and trial.name == effect.name
        parameter = MOVED_PARAMETERS[effect.name] if is_moved else "size"
        change = f"another {parameter} of" if kind == "retuned" else "no"
        sentences.append(f"With {change} {effect.name}, which the model has, the gap is {after.gap:.1f}.")
        return " ".join(sentences)
    sentences.append(f"With {effect.name}, the gap is {after.gap:.1f}.")
    if trial.event_count and trial.name == effect.name:
        sentences.append(f"The number of detected events is {trial.event_count}.")
    if others:
        phrase = _comparison_phrase(others[0].confidence)
        sentences.append(f"The effect {others[0].effect} explains the difference {phrase}.")
    return " ".join(sentences)


def _comparison_phrase(confidence: float) -> str:
    return "nearly as well" if confidence > 0.2 else "less well" if confidence > 0.01 else "clearly less well"


def _location_text(gap: DiagnosticGap) -> str:
    place = gap.where
    if place.frequency is not None:
        lo, hi = place.frequency
        middle, wide = 0.5 * (lo + hi), hi - lo
        return f" at {middle:.5g} Hz" if wide < 0.05 * middle else f" from {lo:.3g} to {hi:.3g} Hz"
    if place.source is not None:
        return f" ({place.source})"
    if place.time is not None and gap.diagnostic in ("level", "variance") and place.time[1] - place.time[0] < 1e3:
        return f" near {0.5 * (place.time[0] + place.time[1]):.5g} s"
    return ""
