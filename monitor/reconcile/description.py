"""From a search to what people read: each step with its sizes, its confidence, and a sentence that can be checked."""

from collections.abc import Mapping
from math import erf, exp, inf, log
from typing import Final

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
from monitor.reconcile.diagnostics.gap import Null, scores
from monitor.reconcile.likelihood.effect_terms import COURSE, NATURAL, NOISE, size
from monitor.reconcile.likelihood.hypothesis import Z95, Hypothesis, shape_bounds, size_bounds
from monitor.reconcile.preparation.axis import Axis
from monitor.reconcile.result import AxisResult, Bounds, Kind, Look, RunnerUp, Score, Step, Verdict, Where
from monitor.reconcile.search.search import Round, Search
from monitor.reconcile.search.trials import RETUNE, Trial

SHAPES: Final[dict[type[Effect], tuple[str, ...]]] = {
    ExponentiallyCorrelated: ("correlation_time",),
    Narrowband: ("frequency", "bandwidth"),
    Sinusoidal: ("frequency",),
    TemperatureLag: ("time_constant",),
    TurnOnTransient: ("time_constant",),
    BiasStep: ("time",),
    BandwidthLimit: ("cutoff",),
    ScaleFactor: ("factor",),
}
SHOWN: Final = 3
"""Runners-up that are told."""
LEAST: Final = 0.001
"""Confidence of a runner-up that is told."""


def described(found: Search, null: Mapping[str, Null], final: Mapping[str, Null]) -> AxisResult:
    """One axis.

    Args:
        null: of the model under test, which decided
        final: of the model with everything found, which decides what is left
    """
    looks = [Look(scores(one.seen, null), one.views) for one in found.rounds]
    end = Look(scores(found.seen, final), found.views)
    looks.append(end if found.before is None else Look(scores(found.before[1], null), found.before[0]))
    steps: list[Step] = []
    left = sorted(range(found.state.given, len(found.state.effects)))
    for at, one in enumerate(found.rounds):
        last = one.state.effects[-1]
        index = next((i for i in left if type(found.state.effects[i]) is type(last)), None)
        if index is not None and len(one.state.effects) > one.state.given and one.trials[0].effect is not None:
            left.remove(index)
            steps.append(_step(found, one, index, "added", looks[at], looks[at + 1]))
        before = found.rounds[at - 1].state.likely.noises if at else ()
        for noise in one.state.likely.noises:
            if noise < found.state.given and noise not in before and noise in found.state.likely.noises:
                steps.append(_step(found, one, noise, "retuned", looks[at], looks[at + 1]))
    left_over = (*(score for score in end.scores if score.passes), *_behind(found, end))
    return AxisResult(found.axis.name, _verdict(bool(steps), bool(left_over)), looks[0], tuple(steps), left_over, end)


def _behind(found: Search, look: Look) -> tuple[Score, ...]:
    """White noise behind a low-pass that was found: no effect makes it, and it is left over where it is no chance.

    Its gap is what the low-pass alone would leave, and never more than what there was without one.
    """
    state, axis = found.state, found.axis
    limit = next((effect for effect in state.found if isinstance(effect, BandwidthLimit)), None)
    if limit is None or not state.likely.behind > 0.0:
        return ()
    without = axis.fit(state.effects, state.likely.held, floor=False)
    most = max(one.seen["psd"].gain for one in found.rounds)
    gain = max(min(state.likely.log_likelihood - without.log_likelihood, most), 0.0)
    psd = next(score for score in look.scores if score.lens == "psd")
    place = Where(frequency=(limit.cutoff, 0.5 * axis.rate_hz))
    score = Score("psd", place, (2.0 * gain) ** 0.5, psd.null95, psd.threshold)
    return (score,) if score.passes else ()


def _verdict(steps: bool, left: bool) -> Verdict:
    if left:
        return "partly_explained" if steps else "unexplained"
    return "explained" if steps else "agrees"


def _step(found: Search, one: Round, index: int, kind: Kind, before: Look, after: Look) -> Step:
    effect = found.state.effects[index]
    score = _found(effect, kind, before)
    later = next(other for other in after.scores if other.lens == score.lens)
    proof = one.proof
    unseen: tuple[Score | None, Score | None] = None, None
    if not proof.reason:
        unseen = (
            Score(score.lens, score.where, proof.before, score.null95, score.threshold),
            Score(score.lens, score.where, proof.after, later.null95, later.threshold),
        )
    confidence, others = _confidence(effect.name if kind == "added" else RETUNE, one.trials)
    if kind == "retuned" and one.trials[0].name != RETUNE:  # it moved beside something that was added
        confidence, others = _moved(found.state, index), ()
    return Step(
        found=score,
        kind=kind,
        effect=effect.name,
        parameters=_parameters(found.axis, found.state, index, one.trials[0], kind),
        confidence=confidence,
        runners_up=others,
        before=score,
        after=later,
        held_out_before=unseen[0],
        held_out_after=unseen[1],
        held_out_reason=proof.reason,
        because=_because(effect, kind, score, later, others, one.trials[0]),
        look=after,
    )


def _found(effect: Effect, kind: Kind, before: Look) -> Score:
    passing = [score for score in before.scores if score.passes] or list(before.scores)
    natural = NATURAL.get(effect.name) if kind == "added" else "psd"
    for score in passing:
        if score.lens == natural:
            return score
    return max(passing, key=lambda score: score.gap / max(score.threshold, 1e-9))


def _confidence(name: str, trials: tuple[Trial, ...]) -> tuple[float, tuple[RunnerUp, ...]]:
    """Probabilities of the names, by their gains above their prices; one of them is that there is nothing."""
    best: dict[str, float] = {"": 0.0}
    for trial in trials:
        best[trial.name] = max(best.get(trial.name, -inf), trial.value)
    top = max(best.values())
    whole = sum(exp(value - top) for value in best.values())
    chances = {other: exp(value - top) / whole for other, value in best.items()}
    others = sorted((c, other) for other, c in chances.items() if other in EFFECTS and other != name and c >= LEAST)
    return chances.get(name, chances[max(best, key=lambda one: best[one])]), tuple(
        RunnerUp(other, chance) for chance, other in reversed(others[-SHOWN:])
    )


def _moved(state: Hypothesis, index: int) -> float:
    """Probability that a size is another than the model's, by its distance in standard errors of its logarithm."""
    now, before = size(state.effects[index]), size(state.model[index])
    error = state.likely.error(index)
    if not (now > 0.0 and before > 0.0 and error > 0.0):
        return 1.0  # gone, or where none was
    return erf(abs(log(now / before)) * now / error / 2.0**0.5)


def _parameters(axis: Axis, state: Hypothesis, index: int, trial: Trial, kind: Kind) -> dict[str, Bounds]:
    effect = state.effects[index]
    if kind == "added" and trial.bounds and trial.name == effect.name:
        return dict(trial.bounds)
    found: dict[str, Bounds] = {}
    if isinstance(effect, Leak):
        found["source"] = Bounds(effect.source)
    named = (NOISE | COURSE).get(type(effect))
    if named is not None:
        found[named] = size_bounds(state.likely, index)
    if isinstance(effect, TemperatureBias):
        found["reference"] = Bounds(effect.reference)
        if effect.quadratic is not None:
            found["quadratic"] = _quadratic(state, index)
    for shape in SHAPES.get(type(effect), ()) if kind == "added" else ():
        found[shape] = shape_bounds(axis, state, index, shape)
    if isinstance(effect, BandwidthLimit):
        found["order"] = Bounds(float(effect.order))
    if isinstance(effect, Sinusoidal) and effect.phase is not None and effect.amplitude > 0.0:
        # at the start of a recording a frequency that is fitted too doubles the error (Rife & Boorstyn 1974)
        error = 2.0 * Z95 * state.likely.error(index) / effect.amplitude
        found["phase"] = Bounds(effect.phase, effect.phase - error, effect.phase + error)
    return found


def _quadratic(state: Hypothesis, index: int) -> Bounds:
    place = next(place for at, place in state.likely.courses if at == index)
    value = float(state.likely.fitted.beta[place.start + 1])
    error = Z95 * float(state.likely.fitted.beta_covariance[place.start + 1, place.start + 1]) ** 0.5
    return Bounds(value, value - error, value + error)


WHAT: Final = {
    "values": "the values themselves show it",
    "psd": "power stands apart from the model's spectrum",
    "lines": "a steady oscillation stands out of the spectrum",
    "autocorrelation": "neighbouring samples are not independent once the model is taken out",
    "level": "the level moves more than the model allows",
    "temperature": "the level follows the temperature",
    "other_axes": "another axis is seen in this one",
    "tails": "samples lie further out than Gaussian noise puts them",
    "variance": "the strength of the noise changes in time",
    "spectrogram": "power changes in time within a band",
}


def _because(effect: Effect, kind: Kind, score: Score, after: Score, others: tuple[RunnerUp, ...], trial: Trial) -> str:
    where = _where(score)
    seen = f"{WHAT[score.lens]}{where}, {score.gap:.1f} where a true model stays below {score.threshold:.1f}"
    if kind == "retuned":
        done = f"with another size of {effect.name}, which the model has, {after.gap:.1f} is left"
    else:
        done = f"with {effect.name} {after.gap:.1f} is left"
    rival = ""
    if others and kind == "added":
        rival = f"; {others[0].effect} explains it {_less(others[0].confidence)}"
    events = f" ({trial.events} seen)" if kind == "added" and trial.events and trial.name == effect.name else ""
    return f"{seen[0].upper()}{seen[1:]}; {done}{events}{rival}."


def _less(confidence: float) -> str:
    return "nearly as well" if confidence > 0.2 else "less well" if confidence > 0.01 else "clearly less well"


def _where(score: Score) -> str:
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
