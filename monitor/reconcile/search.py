"""The search on one axis: look, try what may be missing, keep the best, look again.

One round: the axis is made white by the model and looked at; if nothing passes its threshold, the round was the last.
Else every candidate is added alone and everything refitted.

- **Courses before noises.** What follows the clock, the temperature or another axis is taken if it is worth its price
  beside whatever slow noise stands in for it: none, a random walk, a correlated noise, a power law, on both sides of
  the comparison. A noise would soak up a drift, and a refit from there would stay there.
- **Noises by their score**: the gain in ln L, less the price of the name, less what other sizes of known noises cost.
- A power law of free exponent stands among them without a name. Where it is the best, nothing known is right, and the
  axis stays unexplained.

What was found earlier and is worth nothing any more is dropped.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasStep,
    ExponentiallyCorrelated,
    NoiseStep,
    Outliers,
    RateRamp,
    RateRandomWalk,
    Resolution,
    SampleHold,
    Saturation,
    ScaleFactor,
)
from monitor.reconcile.axis import Axis, Effects
from monitor.reconcile.bins import bins
from monitor.reconcile.candidates import COURSE_FAMILIES, NOISE_FAMILIES, PRICE, correlated, peaks
from monitor.reconcile.gap import Findings, Null, look
from monitor.reconcile.hypothesis import GOLDEN, RETUNED, Hypothesis, believed, settled
from monitor.reconcile.lenses import MARGIN, Sight, sight
from monitor.reconcile.prepare import again
from monitor.reconcile.proof import Proof, proof
from monitor.reconcile.reconciliation import Bounds
from monitor.reconcile.steady import upheld
from monitor.reconcile.terms import COURSE, NATURAL, NOISE, size
from monitor.reconcile.twins import WORTH, Twin, poisson, telegraph
from monitor.reconcile.values import Size

ROUNDS: Final = 8
CHANCES: Final = 3
"""Candidates of a round that may fail on unseen data before the round gives up."""
NAMELESS: Final = "power_law"
RETUNE: Final = "retuned"
"""No new effect: other sizes of known ones."""
EXPONENTS: Final = (0.5, 1.5, 2.5, 3.0)
BEND: Final = 2.5
"""What a second parameter costs."""
STUDENT: Final = 2.0
"""Nats that outliers must gain over Student's t."""
ODD: Final = 4.0
"""Deviations: outliers that keep together more than this, or whose sizes fit less, are none."""
RIVAL: Final = 1.0
"""Nats by which a step of the noise may be behind its rivals, which have more parameters."""
FAR_MORE: Final = 5.0
"""Nats."""
OPEN: Final = 2.0
"""Nats by which a nameless rival must be better for no name to be given."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A candidate that was tried."""

    name: str
    effect: Effect | None  # None: nameless, or nothing new
    value: float  # nats above its price; of a course beside the slow noise that could best stand in for it
    alone: float = 0.0  # nats above its price, of a course with no such noise beside it
    bounds: Mapping[str, Bounds] = field(default_factory=dict)  # of parameters that no spectrum tells
    events: int = 0  # that were seen


@dataclass(frozen=True, slots=True)
class Round:
    """What one round found."""

    sight: Sight  # before
    seen: Findings  # before
    trials: tuple[Trial, ...]  # the first was taken; the others best first
    state: Hypothesis  # after
    proof: Proof


@dataclass(frozen=True, slots=True)
class Search:
    """All rounds on one axis."""

    start: Hypothesis  # the model as it stands
    rounds: tuple[Round, ...]
    axis: Axis  # mended, with bins as fine as its peaks
    state: Hypothesis
    sight: Sight  # at the end
    seen: Findings
    rivals: tuple[Trial, ...]  # of a round that took nothing


def search(axis: Axis, model: Effects, null: Mapping[str, Null], rng: np.random.Generator) -> Search:
    """Explain one axis.

    Args:
        axis: prepared by the model
        model: effects of the axis in the model under test
        null: of each lens
        rng: for what fills the place of samples that are found to be wrong
    """
    state = start = believed(axis, model)
    rounds: list[Round] = []
    rivals: tuple[Trial, ...] = ()
    while True:
        view = sight(axis, state.likely)
        seen = look(view)
        closed = not any(one.gain > null[lens].threshold for lens, one in seen.items())
        if len(rounds) == ROUNDS:
            break
        instead = _instead(axis, state, view) if closed and state.freed else []
        if closed and not instead:
            jumps = poisson(axis, state) if rounds else None
            if jumps is None or jumps.gain <= WORTH:
                break
            state = settled(axis, jumps.found, model)
            rounds.append(Round(view, seen, (_twin(jumps, jumps.gain),), state, SHARED))
            continue
        finer = bins(axis.n, axis.rate_hz, peaks(view))
        if finer.count.size > axis.bins.count.size + 8:
            axis = axis.rebinned(finer)
            state = Hypothesis(model, axis.fit(state.effects, state.likely.held))
            start = start if rounds else state
            view = sight(axis, state.likely)
        trials = instead or tried(axis, state, view)
        taken = _taken(axis, state, trials, view, seen, null, rng)
        if taken is None:
            rivals = tuple(trials)
            break
        axis, done = taken
        state = done.state
        rounds.append(done)
    kept = tuple(effect for effect in upheld(state, seen, null) if not _nothing(effect))
    if kept != state.found:
        state = settled(axis, kept, model)
        view = sight(axis, state.likely)
        seen = look(view)
    return Search(start, tuple(rounds), axis, state, view, seen, rivals)


def _instead(axis: Axis, state: Hypothesis, view: Sight) -> list[Trial]:
    """A course or a correlated noise that explains better what other sizes of known noises were bent to explain."""
    found = [one for one in _courses(axis, state, view) if one.alone > 0.0 and one.value > 0.0]
    for effect in correlated(axis, state, view):
        value = settled(axis, (*state.found, effect), state.model).score - state.score - PRICE[effect.name]
        if value > 0.0:
            found.append(Trial(effect.name, effect, value))
    return sorted(found, key=lambda one: -one.value)


def _taken(
    axis: Axis,
    state: Hypothesis,
    trials: list[Trial],
    view: Sight,
    seen: Findings,
    null: Mapping[str, Null],
    rng: np.random.Generator,
) -> tuple[Axis, Round] | None:
    """The best trial that holds on data that did not choose it."""
    strongest = max(seen, key=lambda name: seen[name].gain - null[name].threshold)
    for at, trial in enumerate(trials[:CHANCES]):
        if trial.value <= 0.0 or trial.name == NAMELESS:
            return None
        lens = NATURAL.get(trial.name, strongest)
        found = state.found if trial.effect is None else (*state.found, trial.effect)
        mended = again(axis, (*state.model, *found), rng) if type(trial.effect) in MENDED else axis
        after = pruned(mended, settled(mended, found, state.model))
        if trial.effect is not None and after.found and _nothing(after.found[-1]):
            continue
        after, told = told_apart(mended, after, trials[at:])
        proven = proof(mended, state, after, lens, null[lens], rng)
        if proven.kept:
            return mended, Round(view, seen, tuple(told), after, proven)
    return None


SHARED: Final = Proof(float("nan"), float("nan"), True, "its spectrum is that of what it stands for, and was held out")
"""Of a twin that is told by its distribution."""
MENDED: Final = frozenset({Saturation, SampleHold, Outliers})
"""Effects after which the samples are put right."""


def tried(axis: Axis, state: Hypothesis, seen: Sight) -> list[Trial]:
    """All candidates, best first."""
    for family in (_values, _samples):
        found = family(axis, state, seen)
        if found and found[0].value > 0.0:
            return found
    courses, noises = _courses(axis, state, seen), _noises(axis, state, seen)
    # a noise that explains far more comes first: what is left of a wrong spectrum looks like steps and slopes
    if courses and courses[0].value > 0.0 and courses[0].alone > noises[0].value - FAR_MORE:
        return courses
    return noises


def told_apart(axis: Axis, state: Hypothesis, trials: list[Trial]) -> tuple[Hypothesis, list[Trial]]:
    """The state with what was just found under its right name, where second moments do not tell."""
    last, twin = len(state.effects) - 1, None
    if isinstance(trials[0].effect, ExponentiallyCorrelated) and isinstance(
        state.effects[last], ExponentiallyCorrelated
    ):
        twin = telegraph(axis, state, last)
    elif isinstance(trials[0].effect, BiasStep):
        twin = poisson(axis, state)
    if twin is None:
        return state, trials
    one = _twin(twin, trials[0].value + twin.gain)
    if twin.gain <= WORTH:
        return state, [trials[0], one, *trials[1:]]
    return settled(axis, twin.found, state.model), [one, *trials]


def _nothing(effect: Effect) -> bool:
    """Whether the fit left a noise without any size."""
    return type(effect) in NOISE and size(effect) == 0.0


def _twin(twin: Twin, value: float) -> Trial:
    effect = twin.found[-1]
    return Trial(effect.name, effect, value, bounds=twin.bounds, events=twin.events)


def _values(axis: Axis, state: Hypothesis, seen: Sight) -> list[Trial]:
    """What the values as they were measured show: certain, or nothing."""
    have, shown = {type(effect) for effect in state.effects}, axis.shown
    found: list[Trial] = []
    if shown.levels and Resolution not in have:
        grid = shown.levels
        found.append(_trial(Resolution(step=grid.step.value), grid.gain, {"step": _bounds(grid.step)}, grid.levels))
    if shown.clipped and shown.clipped.symmetric and Saturation not in have:
        ends = shown.clipped
        found.append(_trial(Saturation(limit=ends.limit.value), ends.gain, {"limit": _bounds(ends.limit)}, ends.count))
    if shown.repeats and SampleHold not in have:
        twice = shown.repeats
        hold = SampleHold(fraction=min(twice.fraction.value, 0.999))
        found.append(_trial(hold, twice.gain, {"fraction": _bounds(twice.fraction)}, round(twice.count)))
    return sorted(found, key=lambda one: -one.value)


def _samples(axis: Axis, state: Hypothesis, seen: Sight) -> list[Trial]:
    """Samples far out, and noise that becomes another."""
    found: list[Trial] = []
    far, course = seen.outliers, seen.course
    have = {type(effect) for effect in state.effects}
    if (
        far is not None
        and Outliers not in have
        and far.over_student > STUDENT
        and max(far.clustering_z, far.misfit_z) < ODD
    ):
        # sizes are those of the whitened series: back to the axis
        unit = _unit(axis, state)
        effect = Outliers(fraction=min(far.fraction.value, 1.0), scale=unit * far.scale.value)
        bounds = {"fraction": _bounds(far.fraction), "scale": _bounds(far.scale, unit)}
        found.append(_trial(effect, far.gain, bounds, far.count))
    rival = max(course.trend, course.periodic.gain, course.wander)
    length_s = axis.n / axis.rate_hz
    inside = MARGIN * length_s < course.step.time.value < (1.0 - MARGIN) * length_s
    if (
        inside
        and course.step.gain > rival - RIVAL
        and any(isinstance(effect, AngleRandomWalk) for effect in state.effects)
    ):
        step = NoiseStep(time=course.step.time.value, ratio=course.step.ratio.value)
        bounds = {"time": _bounds(course.step.time), "ratio": _bounds(course.step.ratio)}
        found.append(_trial(step, course.step.gain, bounds))
    return sorted(found, key=lambda one: -one.value)


def _unit(axis: Axis, state: Hypothesis) -> float:
    """Deviation of a sample of the axis for each of the whitened fast series, by their upper halves."""
    half = axis.bins.count.size // 2
    count, variance = axis.bins.count[half:], state.likely.fitted.residual[half:]
    return float(np.sqrt(variance.sum() / count.sum()))


def _trial(effect: Effect, gain: float, bounds: Mapping[str, Bounds], events: int = 0) -> Trial:
    return Trial(effect.name, effect, gain - PRICE[effect.name], bounds=bounds, events=events)


def _bounds(found: Size, unit: float = 1.0) -> Bounds:
    return Bounds(unit * found.value, unit * found.lo, unit * found.hi)


def _noises(axis: Axis, state: Hypothesis, seen: Sight) -> list[Trial]:
    """Noises by their score, a nameless one among them."""
    found = [Trial(RETUNE, None, settled(axis, state.found, state.model).score - state.score)]
    for family in NOISE_FAMILIES:
        for effect in family(axis, state, seen):
            value = settled(axis, (*state.found, effect), state.model).score - state.score - PRICE[effect.name]
            found.append(Trial(effect.name, effect, value))
    found.append(_scaled(axis, state))
    found.sort(key=lambda one: -one.value)
    value = max(_nameless(axis, state, exponent) for exponent in EXPONENTS) - state.score - PRICE[NAMELESS]
    if value > max(found[0].value, 0.0) + OPEN and found[0].name in SMOOTH:
        return [Trial(NAMELESS, None, value), *found]
    return found


SMOOTH: Final = frozenset(
    {
        "quantization_noise",
        "angle_random_walk",
        "bias_instability",
        "rate_random_walk",
        "exponentially_correlated",
        "scale_factor",
    }
)
"""Names that a power law is a rival of."""


def _courses(axis: Axis, state: Hypothesis, seen: Sight) -> list[Trial]:
    free = axis.fit(state.effects).log_likelihood
    kept: list[Effect] = []
    for family in COURSE_FAMILIES:
        for effect in family(axis, state, seen):
            if axis.fit((*state.effects, effect)).log_likelihood - free > 0.3 * PRICE[effect.name]:
                kept.append(effect)
    if not kept:
        return []
    beside = _slow(axis, state)
    without = max(settled(axis, state.found, state.model).score, *(one(state.effects) for one in beside))
    trials = []
    for effect in kept:
        with_it = (*state.effects, effect)
        alone = settled(axis, (*state.found, effect), state.model).score
        gain = max(alone, *(one(with_it) for one in beside)) - without
        price = PRICE[effect.name] + _beyond(effect)
        trials.append(Trial(effect.name, effect, gain - price, alone - state.score - price))
    trials.sort(key=lambda one: -one.value)
    curved = _curved(axis, state) - without
    if curved > max(0.0, trials[0].value) + OPEN:
        return [Trial(NAMELESS, None, curved, curved + without - state.score), *trials]
    return trials


def _curved(axis: Axis, state: Hypothesis) -> float:
    """Score of a drift that is a curve and nothing else, less its price."""
    ramp = RateRamp(R=1e-3 * float(np.sqrt(np.mean(axis.coefficients**2))))
    bent = axis.fit((*state.effects, ramp), state.likely.held, curved=True)
    return bent.log_likelihood - RETUNED * state.freed - PRICE["rate_ramp"] - BEND


def _beyond(effect: Effect) -> float:
    """What a second parameter costs."""
    return BEND if getattr(effect, "quadratic", None) is not None else 0.0


def _slow(axis: Axis, state: Hypothesis) -> list[Callable[[Effects], float]]:
    """Fits beside each slow noise that could stand in for a course; sizes of the model's noises as they are."""
    small = 1e-3 * float(np.sqrt(np.mean(axis.coefficients**2)))
    held = state.likely.held
    length_s = axis.n / axis.rate_hz
    stand_ins: list[Effect] = []
    if not any(isinstance(effect, RateRandomWalk) for effect in state.effects):
        stand_ins.append(RateRandomWalk(K=small))
    for time_s in np.geomspace(10.0 / axis.rate_hz, 0.1 * length_s, 8):
        stand_ins.append(ExponentiallyCorrelated(sigma=small, correlation_time=float(time_s)))
    cost = RETUNED * state.freed
    fits: list[Callable[[Effects], float]] = [
        lambda effects, one=one: axis.fit((*effects, one), held).log_likelihood - cost  # type: ignore[misc]
        for one in stand_ins
    ]
    for exponent in EXPONENTS:
        row = _power_law(axis, exponent)
        fits.append(lambda effects, row=row: axis.fit(effects, held, row).log_likelihood - cost)  # type: ignore[misc]
    return fits


def _nameless(axis: Axis, state: Hypothesis, exponent: float) -> float:
    """Score beside a power law."""
    return axis.fit(state.effects, state.likely.held, _power_law(axis, exponent)).log_likelihood - RETUNED * state.freed


def _power_law(axis: Axis, exponent: float) -> Floats:
    return np.asarray((axis.bins.f_hz / axis.bins.f_hz[0]) ** -exponent)[None, :]


def _scaled(axis: Axis, state: Hypothesis) -> Trial:
    """All noises of the model by one factor, their sizes held to each other."""
    effects = (*state.model, *state.found)
    held = frozenset(at for at, effect in enumerate(state.model) if type(effect) in NOISE)

    def value(x: float) -> float:
        return axis.fit((*effects, ScaleFactor(factor=float(np.exp(x)))), held).log_likelihood

    x = float(max(np.linspace(-3.0, 3.0, 13), key=value))
    lo, hi = x - 0.5, x + 0.5
    for _ in range(16):
        a, b = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
        lo, hi = (lo, b) if value(a) > value(b) else (a, hi)
    x = 0.5 * (lo + hi)
    return Trial("scale_factor", ScaleFactor(factor=float(np.exp(x))), value(x) - state.score - PRICE["scale_factor"])


def pruned(axis: Axis, state: Hypothesis) -> Hypothesis:
    """Without what was found before and is worth nothing any more."""
    for at in range(len(state.found) - 2, -1, -1):
        effect = state.found[at]
        less = settled(axis, state.found[:at] + state.found[at + 1 :], state.model)
        if state.score - less.score < 0.5 * PRICE.get(effect.name, 0.0) and type(effect) in NOISE | COURSE:
            state = less
    return state
