"""Candidates tried: each added alone beside what is known of an axis, everything refitted, best first.

- **Values and single samples** first: what they show is certain, or nothing.
- **Courses before noises.** What follows the clock, the temperature or another axis is taken if it is worth its price
  beside whatever slow noise stands in for it: none, a random walk, a correlated noise, a power law, on both sides of
  the comparison. A noise would soak up a drift, and a refit from there would stay there.
- **Noises by their score**: the gain in ln L, less the price of the name, less what other sizes of known noises cost.
- A power law of any exponent stands among the noises without a name, and a curved drift among the courses. Where one
of them
  is the best, nothing known is right.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy.special import chdtrc

from drivers.sample import Floats
from monitor.noise.effect import Effect, Leak
from monitor.noise.effects import (
    AngleRandomWalk,
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
from monitor.reconcile.diagnostics.diagnostics import MARGIN, Sight, unsteady
from monitor.reconcile.likelihood.effect_terms import NOISE
from monitor.reconcile.likelihood.hypothesis import GOLDEN, RESIZE_PENALTY_NATS, Hypothesis, settled
from monitor.reconcile.preparation.axis import Axis, Effects
from monitor.reconcile.preparation.value_statistics import Size
from monitor.reconcile.result import Bounds
from monitor.reconcile.search.candidates import COURSE_FAMILIES, NOISE_FAMILIES, PRICE, correlated

NAMELESS: Final = "power_law"
RETUNE: Final = "retuned"
"""No new effect: other sizes of known ones."""
EXPONENTS: Final = (0.5, 1.5, 2.5, 3.0)
IDLE: Final = 1.0
"""Nats: other sizes that gain less are the same sizes."""
AS_WELL: Final = 3.0
"""Nats by which sizes of their own may be better than one factor, which has fewer."""
GROUPS: Final = 8
"""Of frequencies, in which a leak must have one size."""
UNLIKELY: Final = 1e-5
"""Chance of sizes so different: then something shakes both axes."""
BEND: Final = 2.5
"""What a second parameter costs."""
STUDENT: Final = 2.0
"""Nats that outliers must gain over Student's t."""
ODD: Final = 4.0
"""Deviations: outliers that keep together more than this, or whose sizes fit less, are none."""
RIVAL: Final = 1.0
"""Nats by which a step of the noise may be behind its rivals, which have more parameters."""
BAND: Final = 0.25
"""Of the sample rate, half of all that is seen: what is narrower is a band."""
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


def tried(axis: Axis, state: Hypothesis, seen: Sight) -> Iterator[list[Trial]]:
    """One kind of candidates after the other, each best first."""
    yield _values(axis, state, seen)
    yield _samples(axis, state, seen)
    courses, noises = _courses(axis, state, seen), _noises(axis, state, seen)
    # a noise that explains far more comes first: what is left of a wrong spectrum looks like steps and slopes
    if courses and courses[0].alone > noises[0].value - FAR_MORE:
        yield courses
        yield noises
    else:
        yield noises
        yield courses


def instead(axis: Axis, state: Hypothesis, view: Sight) -> list[Trial]:
    """A course or a correlated noise that explains better what other sizes of known noises were bent to explain."""
    found = [one for one in _courses(axis, state, view) if one.alone > 0.0 and one.value > 0.0]
    for effect in correlated(axis, state, view):
        value = settled(axis, (*state.found, effect), state.model).score - state.score - PRICE[effect.name]
        if value > 0.0:
            found.append(Trial(effect.name, effect, value))
    return sorted(found, key=lambda one: -one.value)


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
        and course.step.gain > _burst(seen) - RIVAL
    ):
        step = NoiseStep(time=course.step.time.value, ratio=course.step.ratio.value)
        bounds = {"time": _bounds(course.step.time), "ratio": _bounds(course.step.ratio)}
        found.append(_trial(step, course.step.gain, bounds))
    return sorted(found, key=lambda one: -one.value)


def _burst(seen: Sight) -> float:
    """Nats of the least steady place of the spectrogram where it is a band: then no white noise has changed."""
    found = unsteady(seen)
    return found.gain if np.ptp(found.frequency) < BAND * seen.axis.rate_hz else 0.0


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
    resized = settled(axis, state.found, state.model)
    found = [Trial(RETUNE, None, resized.score - state.score - IDLE)]
    for family in NOISE_FAMILIES:
        for effect in family(axis, state, seen):
            value = settled(axis, (*state.found, effect), state.model).score - state.score - PRICE[effect.name]
            found.append(Trial(effect.name, effect, value))
    found.append(_scaled(axis, state, resized))
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
            gain = axis.fit((*state.effects, effect)).log_likelihood - free
            if gain > 0.3 * PRICE[effect.name] and (not isinstance(effect, Leak) or _everywhere(seen, effect)):
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


def _everywhere(seen: Sight, leak: Leak) -> bool:
    """Whether one coefficient serves all frequencies, as it does for a leak, and not for what shakes both axes.

    Coefficients of GROUPS bands of equal width, each of variance one over its Σ X²/v, about their mean: χ².
    """
    column = seen.axis.others[leak.source] * seen.weight
    edges = np.linspace(0, column.size, GROUPS + 1).astype(np.int64)[:-1]
    length = np.maximum(np.add.reduceat(column**2, edges), 1e-300)
    product = np.add.reduceat(column * seen.whitened, edges)
    spread = float((length * (product / length - product.sum() / length.sum()) ** 2).sum())
    return bool(chdtrc(GROUPS - 1, spread) > UNLIKELY)


def _curved(axis: Axis, state: Hypothesis) -> float:
    """Score of a drift that is a curve and nothing else, less its price."""
    ramp = RateRamp(R=1e-3 * float(np.sqrt(np.mean(axis.coefficients**2))))
    bent = axis.fit((*state.effects, ramp), state.likely.held, curved=True)
    return bent.log_likelihood - RESIZE_PENALTY_NATS * state.freed - PRICE["rate_ramp"] - BEND


def _beyond(effect: Effect) -> float:
    """What a second parameter costs."""
    return BEND if getattr(effect, "quadratic", None) is not None else 0.0


def _slow(axis: Axis, state: Hypothesis) -> list[Callable[[Effects], float]]:
    """Scores beside each slow noise that could stand in for a course; sizes of the model's noises as they are."""
    small = 1e-3 * float(np.sqrt(np.mean(axis.coefficients**2)))
    held, cost, length_s = state.likely.held, RESIZE_PENALTY_NATS * state.freed, axis.n / axis.rate_hz

    def beside(one: Effect) -> Callable[[Effects], float]:
        return lambda effects: axis.fit((*effects, one), held).log_likelihood - cost - PRICE[one.name]

    def beside_law(exponent: float) -> Callable[[Effects], float]:
        row = _power_law(axis, exponent)
        return lambda effects: axis.fit(effects, held, row).log_likelihood - cost - PRICE[NAMELESS]

    times_s = np.geomspace(10.0 / axis.rate_hz, 0.1 * length_s, 8)
    stand_ins: list[Effect] = [ExponentiallyCorrelated(sigma=small, correlation_time=float(t)) for t in times_s]
    if not any(isinstance(effect, RateRandomWalk) for effect in state.effects):
        stand_ins.append(RateRandomWalk(K=small))
    return [*(beside(one) for one in stand_ins), *(beside_law(exponent) for exponent in EXPONENTS)]


def _nameless(axis: Axis, state: Hypothesis, exponent: float) -> float:
    """Score beside a power law."""
    return (
        axis.fit(state.effects, state.likely.held, _power_law(axis, exponent)).log_likelihood
        - RESIZE_PENALTY_NATS * state.freed
    )


def _power_law(axis: Axis, exponent: float) -> Floats:
    return np.asarray((axis.bins.f_hz / axis.bins.f_hz[0]) ** -exponent)[None, :]


def _scaled(axis: Axis, state: Hypothesis, resized: Hypothesis) -> Trial:
    """All noises of the model by one factor, their sizes held to each other.

    One size that is off says nothing of the others, and stays one size. Where two or more are off, and by one factor
    as well as by two, it is one factor.
    """
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
    worth = value(x) - state.score - PRICE["scale_factor"]
    if resized.freed > 1 and value(x) > resized.likely.log_likelihood - AS_WELL:
        worth = max(worth, resized.score - state.score)
    return Trial("scale_factor", ScaleFactor(factor=float(np.exp(x))), worth)
