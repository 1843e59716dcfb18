"""Conversion of the search on one axis into an ``AxisResult`` with parameters, confidence and justification."""

from math import erf, exp, inf, log
from typing import Final

from monitor.common.distributions import Z95
from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import (
    EFFECTS,
    BandwidthLimit,
    BiasStep,
    ExponentiallyCorrelated,
    Narrowband,
    ScaleFactor,
    Sinusoidal,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.diagnostics.null_distribution import AxisNull, compute_diagnostic_gaps
from monitor.reconcile.likelihood.effect_roles import MOST_DIRECT_DIAGNOSTIC, SIZE_PARAMETERS, effect_size
from monitor.reconcile.likelihood.hypothesis import Hypothesis, compute_shape_interval, compute_size_interval
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisResult,
    Decision,
    DiagnosticGap,
    DiagnosticSnapshot,
    Location,
    ParameterInterval,
    RunnerUp,
    StepKind,
)
from monitor.reconcile.search.search import AxisDiagnostics, AxisSearchResult, SearchRound
from monitor.reconcile.search.trials import RETUNE, Trial

SHAPE_PARAMETERS: Final[dict[type[Effect], tuple[str, ...]]] = {
    ExponentiallyCorrelated: ("correlation_time",),
    Narrowband: ("frequency", "bandwidth"),
    Sinusoidal: ("frequency",),
    TemperatureLag: ("time_constant",),
    TurnOnTransient: ("time_constant",),
    BiasStep: ("time",),
    BandwidthLimit: ("cutoff",),
    ScaleFactor: ("factor",),
}
"""For each effect, the shape parameters that are reported with an interval."""
MAX_RUNNERS_UP: Final = 3
MIN_RUNNER_UP_CONFIDENCE: Final = 0.001
"""Smallest confidence with which an alternative effect is reported."""


def build_axis_result(search: AxisSearchResult, null: AxisNull, final_null: AxisNull) -> AxisResult:
    """Build the result of one axis from the search for missing effects.

    Parameters
    ----------
    search : AxisSearchResult
        Result of the search on the axis.
    null : AxisNull
        Null distributions of the diagnostics under the original model.
    final_null : AxisNull
        Null distributions of the diagnostics under the extended model.
    """
    snapshots = [_snapshot(one.before, null) for one in search.rounds]
    end = _snapshot(search.final, final_null)
    snapshots.append(end if search.before_withdrawal is None else _snapshot(search.before_withdrawal, null))
    steps = tuple(
        _describe_step(search, search.rounds[at], index, kind, snapshots[at], snapshots[at + 1])
        for at, index, kind in _remaining_changes(search)
    )
    left_over = (*(gap for gap in end.gaps if gap.is_significant), *_noise_floor_gap(search, end))
    decision = _axis_decision(bool(steps), bool(left_over))
    return AxisResult(search.hypothesis.axis.name, decision, snapshots[0], steps, left_over, end)


def _snapshot(diagnostics: AxisDiagnostics, null: AxisNull) -> DiagnosticSnapshot:
    return DiagnosticSnapshot(compute_diagnostic_gaps(diagnostics.findings, null), diagnostics.plots)


def _remaining_changes(search: AxisSearchResult) -> list[tuple[int, int, StepKind]]:
    """Return the changes that the search kept: index of the search round, index of the effect, and kind of change."""
    hypothesis = search.hypothesis
    found: list[tuple[int, int, StepKind]] = []
    left = list(range(hypothesis.given_count, len(hypothesis.effects)))
    resized: tuple[int, ...] = ()
    for at, one in enumerate(search.rounds):
        last = one.hypothesis.effects[-1]
        index = next((i for i in left if type(hypothesis.effects[i]) is type(last)), None)
        if index is not None and one.hypothesis.added and one.trials[0].effect is not None:
            left.remove(index)
            found.append((at, index, "added"))
        for noise in one.hypothesis.fit.fitted_noise:
            if noise < hypothesis.given_count and noise not in resized and noise in hypothesis.fit.fitted_noise:
                found.append((at, noise, "retuned"))
        resized = one.hypothesis.fit.fitted_noise
    return found


def _noise_floor_gap(search: AxisSearchResult, end: DiagnosticSnapshot) -> tuple[DiagnosticGap, ...]:
    """Return the difference in the spectrum due to white noise behind an added low-pass filter, if significant.

    The difference is limited to the largest difference in the spectrum during the search.
    """
    hypothesis, axis = search.hypothesis, search.hypothesis.axis
    limit = next((effect for effect in hypothesis.added if isinstance(effect, BandwidthLimit)), None)
    if limit is None or not hypothesis.fit.noise_floor_variance > 0.0:
        return ()
    without = axis.fit(hypothesis.effects, hypothesis.fit.fixed_noise, noise_floor=False)
    most = max(one.before.findings["psd"].gain for one in search.rounds)
    gain = max(min(hypothesis.fit.log_likelihood - without.log_likelihood, most), 0.0)
    psd = _gap_of("psd", end)
    place = Location(frequency=(limit.cutoff, 0.5 * axis.rate_hz))
    gap = DiagnosticGap("psd", place, (2.0 * gain) ** 0.5, psd.null95, psd.threshold)
    return (gap,) if gap.is_significant else ()


def _gap_of(lens: str, snapshot: DiagnosticSnapshot) -> DiagnosticGap:
    return next(gap for gap in snapshot.gaps if gap.lens == lens)


def _axis_decision(changed: bool, left_over: bool) -> Decision:
    if left_over:
        return "partly_explained" if changed else "unexplained"
    return "explained" if changed else "agrees"


def _describe_step(
    search: AxisSearchResult,
    done: SearchRound,
    index: int,
    kind: StepKind,
    before: DiagnosticSnapshot,
    after: DiagnosticSnapshot,
) -> AddedOrResizedEffect:
    effect, trial = search.hypothesis.effects[index], done.trials[0]
    gap = _triggering_gap(effect, kind, before)
    later = _gap_of(gap.lens, after)
    confidence, others = _confidence_and_runners_up(effect.name if kind == "added" else RETUNE, done.trials)
    if kind == "retuned" and trial.name != RETUNE:  # an effect was added in the same round
        confidence, others = _resize_confidence(search.hypothesis, index), ()
    held_out_before, held_out_after = _held_out_gaps(done, gap, later)
    return AddedOrResizedEffect(
        kind=kind,
        effect=effect.name,
        parameters=_parameters_with_bounds(search.hypothesis, index, trial, kind),
        confidence=confidence,
        runners_up=others,
        before=gap,
        after=later,
        held_out_before=held_out_before,
        held_out_after=held_out_after,
        held_out_reason=done.validation.reason,
        because=_justification(effect, kind, gap, later, others, trial),
        snapshot_after=after,
    )


def _held_out_gaps(
    done: SearchRound, gap: DiagnosticGap, later: DiagnosticGap
) -> tuple[DiagnosticGap | None, DiagnosticGap | None]:
    validation = done.validation
    if validation.reason:
        return None, None
    return (
        DiagnosticGap(gap.lens, gap.where, validation.before, gap.null95, gap.threshold),
        DiagnosticGap(gap.lens, gap.where, validation.after, later.null95, later.threshold),
    )


def _triggering_gap(effect: Effect, kind: StepKind, before: DiagnosticSnapshot) -> DiagnosticGap:
    """Return the difference between recording and model that led to an effect.

    A significant difference in the most sensitive diagnostic of the effect is preferred. Otherwise, the difference with
    the largest ratio to the threshold is returned.
    """
    significant = [gap for gap in before.gaps if gap.is_significant] or list(before.gaps)
    most_direct = MOST_DIRECT_DIAGNOSTIC.get(effect.name) if kind == "added" else "psd"
    for gap in significant:
        if gap.lens == most_direct:
            return gap
    return max(significant, key=lambda gap: gap.gap / max(gap.threshold, 1e-9))


def _confidence_and_runners_up(name: str, trials: tuple[Trial, ...]) -> tuple[float, tuple[RunnerUp, ...]]:
    """Return the probability of the selected effect, and the most probable alternative effects.

    Each probability is proportional to exp(score). The hypothesis without any effect has the score 0.
    """
    best: dict[str, float] = {"": 0.0}
    for trial in trials:
        best[trial.name] = max(best.get(trial.name, -inf), trial.score)
    top = max(best.values())
    whole = sum(exp(value - top) for value in best.values())
    chances = {other: exp(value - top) / whole for other, value in best.items()}
    others = sorted(
        (chance, other)
        for other, chance in chances.items()
        if other in EFFECTS and other != name and chance >= MIN_RUNNER_UP_CONFIDENCE
    )
    runners_up = tuple(RunnerUp(other, chance) for chance, other in reversed(others[-MAX_RUNNERS_UP:]))
    return chances.get(name, chances[max(best, key=lambda one: best[one])]), runners_up


def _resize_confidence(hypothesis: Hypothesis, index: int) -> float:
    """Return the probability that the true size of an effect differs from the size in the model."""
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
    size_name = SIZE_PARAMETERS.get(type(effect))
    if size_name is not None:
        found[size_name] = compute_size_interval(hypothesis.fit, index)
    if isinstance(effect, TemperatureBias):
        found["reference"] = ParameterInterval(effect.reference)
        if effect.quadratic is not None:
            found["quadratic"] = _quadratic_bounds(hypothesis, index)
    for shape in SHAPE_PARAMETERS.get(type(effect), ()) if kind == "added" else ():
        found[shape] = compute_shape_interval(hypothesis.fit, index, shape)
    if isinstance(effect, BandwidthLimit):
        found["order"] = ParameterInterval(float(effect.order))
    if isinstance(effect, Sinusoidal) and effect.phase is not None and effect.amplitude > 0.0:
        # the frequency is fitted too, which doubles the phase error at the start of a recording (Rife & Boorstyn 1974)
        error = 2.0 * Z95 * hypothesis.fit.size_standard_error(index) / effect.amplitude
        found["phase"] = ParameterInterval(effect.phase, effect.phase - error, effect.phase + error)
    return found


def _quadratic_bounds(hypothesis: Hypothesis, index: int) -> ParameterInterval:
    fitted = hypothesis.fit.whittle
    column = next(place for at, place in hypothesis.fit.regressor_slices if at == index).start + 1
    value = float(fitted.beta[column])
    error = Z95 * float(fitted.beta_covariance[column, column]) ** 0.5
    return ParameterInterval(value, value - error, value + error)


EVIDENCE_TEXT: Final = {
    "values": "The measured values are quantized, clipped or repeated",
    "psd": "The power differs from the spectrum of the model",
    "lines": "The spectrum contains a steady oscillation",
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
    others: tuple[RunnerUp, ...],
    trial: Trial,
) -> str:
    gaps = f"the gap is {gap.gap:.1f}, and a true model stays below {gap.threshold:.1f}"
    sentences = [f"{EVIDENCE_TEXT[gap.lens]}{_location_text(gap)}: {gaps}."]
    if kind == "retuned":
        sentences.append(f"With another size of {effect.name}, which the model has, the gap is {after.gap:.1f}.")
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
    if place.time is not None and gap.lens in ("level", "variance") and place.time[1] - place.time[0] < 1e3:
        return f" near {0.5 * (place.time[0] + place.time[1]):.5g} s"
    return ""
