"""Conversion of a search into readable results: steps with parameters, confidence and a justification."""

from math import erf, exp, inf, log
from typing import Final

from monitor.common.distributions import Z95
from monitor.noise.effect import Effect, Leak
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
from monitor.reconcile.diagnostics.null_distribution import AxisNull, measure_gaps
from monitor.reconcile.likelihood.effect_terms import NATURAL_DIAGNOSTIC, SIZE_PARAMETERS, size
from monitor.reconcile.likelihood.hypothesis import Hypothesis, shape_interval, size_interval
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
from monitor.reconcile.search.search import AxisSearchResult, SearchRound
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
"""Number of alternative effects that are reported."""
MIN_RUNNER_UP_CONFIDENCE: Final = 0.001
"""Smallest confidence of an alternative effect that is reported."""


def describe_axis(search: AxisSearchResult, null: AxisNull, final: AxisNull) -> AxisResult:
    """Return the result of one axis.

    Parameters
    ----------
    search : AxisSearchResult
        Search on the axis.
    null : AxisNull
        Null distributions under the model under test, which decided the search.
    final : AxisNull
        Null distributions under the extended model, which decide which differences are left over.
    """
    looks = [DiagnosticSnapshot(measure_gaps(one.findings, null), one.plots) for one in search.rounds]
    end = DiagnosticSnapshot(measure_gaps(search.findings, final), search.plots)
    if search.before is None:
        looks.append(end)
    else:
        plots, findings = search.before
        looks.append(DiagnosticSnapshot(measure_gaps(findings, null), plots))
    steps = tuple(
        _describe_step(search, search.rounds[at], index, kind, looks[at], looks[at + 1])
        for at, index, kind in _remaining_changes(search)
    )
    left_over = (*(score for score in end.gaps if score.is_significant), *_noise_floor_score(search, end))
    decision = _axis_decision(bool(steps), bool(left_over))
    return AxisResult(search.hypothesis.axis.name, decision, looks[0], steps, left_over, end)


def _remaining_changes(search: AxisSearchResult) -> list[tuple[int, int, StepKind]]:
    """Return the changes that remain at the end: the index of the round, the index of the effect, and the kind."""
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


def _noise_floor_score(search: AxisSearchResult, look: DiagnosticSnapshot) -> tuple[DiagnosticGap, ...]:
    """DiagnosticGap the white noise floor after a low-pass filter that was found.

    No effect produces this noise. A noise floor that is larger than chance is reported as left over. Its gap is the gap
    that the low-pass filter alone would leave, and at most the gap without a low-pass filter.
    """
    hypothesis, axis = search.hypothesis, search.hypothesis.axis
    limit = next((effect for effect in hypothesis.added if isinstance(effect, BandwidthLimit)), None)
    if limit is None or not hypothesis.fit.noise_floor_variance > 0.0:
        return ()
    without = axis.fit(hypothesis.effects, hypothesis.fit.fixed_noise, noise_floor=False)
    most = max(one.findings["psd"].gain for one in search.rounds)
    gain = max(min(hypothesis.fit.log_likelihood - without.log_likelihood, most), 0.0)
    psd = _score_of("psd", look)
    place = Location(frequency=(limit.cutoff, 0.5 * axis.rate_hz))
    score = DiagnosticGap("psd", place, (2.0 * gain) ** 0.5, psd.null95, psd.threshold)
    return (score,) if score.is_significant else ()


def _score_of(lens: str, look: DiagnosticSnapshot) -> DiagnosticGap:
    """Return the score of one diagnostic."""
    return next(score for score in look.gaps if score.lens == lens)


def _axis_decision(steps: bool, left: bool) -> Decision:
    """Return the decision for an axis from the presence of steps and of differences that are left."""
    if left:
        return "partly_explained" if steps else "unexplained"
    return "explained" if steps else "agrees"


def _describe_step(
    search: AxisSearchResult,
    done: SearchRound,
    index: int,
    kind: StepKind,
    before: DiagnosticSnapshot,
    after: DiagnosticSnapshot,
) -> AddedOrResizedEffect:
    """Return the result of one step of the search."""
    effect, trial = search.hypothesis.effects[index], done.trials[0]
    score = _triggering_score(effect, kind, before)
    later = _score_of(score.lens, after)
    confidence, others = _confidence_and_runners_up(effect.name if kind == "added" else RETUNE, done.trials)
    if kind == "retuned" and trial.name != RETUNE:  # the size changed together with an added effect
        confidence, others = _resize_confidence(search.hypothesis, index), ()
    held_out_before, held_out_after = _held_out_scores(done, score, later)
    return AddedOrResizedEffect(
        kind=kind,
        effect=effect.name,
        parameters=_parameters_with_bounds(search.hypothesis, index, trial, kind),
        confidence=confidence,
        runners_up=others,
        before=score,
        after=later,
        held_out_before=held_out_before,
        held_out_after=held_out_after,
        held_out_reason=done.validation.reason,
        because=_justification(effect, kind, score, later, others, trial),
        snapshot_after=after,
    )


def _held_out_scores(
    done: SearchRound, score: DiagnosticGap, later: DiagnosticGap
) -> tuple[DiagnosticGap | None, DiagnosticGap | None]:
    """Return the scores of the cross-validation before and after a step, or None without cross-validation."""
    validation = done.validation
    if validation.reason:
        return None, None
    return (
        DiagnosticGap(score.lens, score.where, validation.before, score.null95, score.threshold),
        DiagnosticGap(score.lens, score.where, validation.after, later.null95, later.threshold),
    )


def _triggering_score(effect: Effect, kind: StepKind, before: DiagnosticSnapshot) -> DiagnosticGap:
    """Return the score that led to an effect.

    This is the natural diagnostic of the effect if it passes its threshold, otherwise the strongest diagnostic.
    """
    passing = [score for score in before.gaps if score.is_significant] or list(before.gaps)
    natural = NATURAL_DIAGNOSTIC.get(effect.name) if kind == "added" else "psd"
    for score in passing:
        if score.lens == natural:
            return score
    return max(passing, key=lambda score: score.gap / max(score.threshold, 1e-9))


def _confidence_and_runners_up(name: str, trials: tuple[Trial, ...]) -> tuple[float, tuple[RunnerUp, ...]]:
    """Return the probability of an effect and of its alternatives.

    The probabilities follow from the log-likelihood gains less the penalties of the effects. One alternative is that
    there is no effect.
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
    """Return the probability that the size of an effect differs from its size in the model.

    It follows from the distance of the logarithms of the two sizes, in standard errors.
    """
    now, before = size(hypothesis.effects[index]), size(hypothesis.model[index])
    error = hypothesis.fit.size_error(index)
    if not (now > 0.0 and before > 0.0 and error > 0.0):
        return 1.0  # the effect vanished, or the model had none
    return erf(abs(log(now / before)) * now / error / 2.0**0.5)


def _parameters_with_bounds(
    hypothesis: Hypothesis, index: int, trial: Trial, kind: StepKind
) -> dict[str, ParameterInterval]:
    """Return the parameters of an effect with their 95 % intervals."""
    effect = hypothesis.effects[index]
    if kind == "added" and trial.intervals and trial.name == effect.name:
        return dict(trial.intervals)
    found: dict[str, ParameterInterval] = {}
    if isinstance(effect, Leak):
        found["source"] = ParameterInterval(effect.source)
    size_name = SIZE_PARAMETERS.get(type(effect))
    if size_name is not None:
        found[size_name] = size_interval(hypothesis.fit, index)
    if isinstance(effect, TemperatureBias):
        found["reference"] = ParameterInterval(effect.reference)
        if effect.quadratic is not None:
            found["quadratic"] = _quadratic_bounds(hypothesis, index)
    for shape in SHAPE_PARAMETERS.get(type(effect), ()) if kind == "added" else ():
        found[shape] = shape_interval(hypothesis.fit, index, shape)
    if isinstance(effect, BandwidthLimit):
        found["order"] = ParameterInterval(float(effect.order))
    if isinstance(effect, Sinusoidal) and effect.phase is not None and effect.amplitude > 0.0:
        # fitting the frequency as well doubles the phase error at the start of a recording (Rife & Boorstyn 1974)
        error = 2.0 * Z95 * hypothesis.fit.size_error(index) / effect.amplitude
        found["phase"] = ParameterInterval(effect.phase, effect.phase - error, effect.phase + error)
    return found


def _quadratic_bounds(hypothesis: Hypothesis, index: int) -> ParameterInterval:
    """Return the quadratic temperature coefficient with its 95 % interval."""
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
    score: DiagnosticGap,
    after: DiagnosticGap,
    others: tuple[RunnerUp, ...],
    trial: Trial,
) -> str:
    """Return the sentences that justify a step."""
    gaps = f"the gap is {score.gap:.1f}, and a true model stays below {score.threshold:.1f}"
    sentences = [f"{EVIDENCE_TEXT[score.lens]}{_location_text(score)}: {gaps}."]
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
    """Return a phrase that compares an alternative with the chosen effect."""
    return "nearly as well" if confidence > 0.2 else "less well" if confidence > 0.01 else "clearly less well"


def _location_text(score: DiagnosticGap) -> str:
    """Return a phrase for the location of a score, or an empty string."""
    place = score.where
    if place.frequency is not None:
        lo, hi = place.frequency
        middle, wide = 0.5 * (lo + hi), hi - lo
        return f" at {middle:.5g} Hz" if wide < 0.05 * middle else f" from {lo:.3g} to {hi:.3g} Hz"
    if place.source is not None:
        return f" ({place.source})"
    if place.time is not None and score.lens in ("level", "variance") and place.time[1] - place.time[0] < 1e3:
        return f" near {0.5 * (place.time[0] + place.time[1]):.5g} s"
    return ""
