"""The whole walk: a recording and a model in, a ``Reconciliation`` out.

look → simulate the model and look at that → compare → on each axis that disagrees: propose, try, choose, until nothing
is left or nothing known helps → simulate the new model and compare once more. Axes are independent of each other but
for the clock, which is one for all.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.special import expit

from drivers.errors import NotReady
from drivers.sample import AXES, Floats
from monitor.noise.effect import Leak
from monitor.noise.effects import (
    AngleRandomWalk,
    Bias,
    BiasInstability,
    QuantizationNoise,
    RateRamp,
    RateRandomWalk,
    SampleRateError,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.description import described
from monitor.reconcile.diagnostics.diagnostics import sight
from monitor.reconcile.diagnostics.gap import Findings, Null, look, nulls
from monitor.reconcile.likelihood.effect_terms import resized
from monitor.reconcile.likelihood.hypothesis import believed
from monitor.reconcile.preparation.axis import Axis, Courses, Effects
from monitor.reconcile.preparation.prepare import FEWEST, prepared, without_sources
from monitor.reconcile.preparation.sample_rate_test import PRICE as CLOCK_PRICE
from monitor.reconcile.preparation.sample_rate_test import Clock, restated, wrong_clock
from monitor.reconcile.result import AxisResult, Reconciliation, Score, Step, Verdict, Where
from monitor.reconcile.search.candidates import PRICE
from monitor.reconcile.search.search import Search, search

RUNS: Final = 6
"""Simulated recordings behind a null: of six axes, 36 gains a lens."""

SMOOTH: Final = 0.001
"""Of the recording: temperature is averaged over as much, as heat is slow and thermometers are noisy."""

MOSTLY: Final = 0.5
"""Of the samples of an axis must be there."""
SUPPORTED: Final = 3.0
"""Nats that a term of the first fit must be worth."""
Tell = Callable[[str], None]

Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""What ``map`` does, and an executor's ``map`` in threads."""


@dataclass(frozen=True, slots=True)
class Recording:
    """What is compared."""

    values: Mapping[str, Floats]  # axis -> [n] SI; NaN = missing
    rate_hz: float
    temperature_c: Floats | None = None  # [n] °C, without holes

    @property
    def samples(self) -> int:
        """Of each axis."""
        return next(iter(self.values.values())).size


def seen_in(
    model: NoiseModel,
    like: Recording,
    courses: Courses,
    seed: int,
    each: Each = map,
    runs: int = RUNS,
    only: Collection[str] | None = None,
) -> dict[str, list[Findings]]:
    """What the lenses see in recordings simulated from a model, of each axis.

    Args:
        like: the recording that these are as long and as warm as
        only: axes to look at; all
    """
    effects = effects_of(model, like)
    wanted = [name for name in like.values if only is None or name in only]

    def one(run: int) -> dict[str, Findings]:
        drawn = model.simulate(like.samples, like.rate_hz, seed + run, like.temperature_c)
        raw = {axis: drawn[:, AXES.index(axis)] for axis in like.values}
        rng = np.random.default_rng(seed + run)
        axes = prepared(raw, like.rate_hz, effects, like.temperature_c, courses, rng)
        return {name: look(sight(axes[name], believed(axes[name], effects[name]).likely)) for name in wanted}

    seen = list(each(one, range(runs)))
    return {axis: [run[axis] for run in seen] for axis in wanted}


def smooth(temperature_c: Floats) -> Floats:
    """Temperature [n] without its missing samples and without the thermometer's noise."""
    known = np.flatnonzero(np.isfinite(temperature_c))
    whole = np.interp(np.arange(temperature_c.size), known, temperature_c[known])
    half = int(0.5 * SMOOTH * whole.size)
    if half < 1:
        return whole
    sums = np.concatenate([[0.0], np.cumsum(np.pad(whole - whole[0], half, mode="edge"))])
    return np.asarray((sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1) + whole[0])


def effects_of(model: NoiseModel, recording: Recording) -> dict[str, Effects]:
    """Of each recorded axis; a constant bias is no part of the comparison, as a mean is always free."""
    return {
        axis: tuple(effect for effect in model.effects.get(axis, ()) if not isinstance(effect, Bias))
        for axis in recording.values
    }


@dataclass(frozen=True, slots=True)
class Explained:
    """What the search found in one recording."""

    searches: dict[str, Search]
    clock: Clock | None


def searched(
    recording: Recording,
    model: NoiseModel,
    null: Mapping[str, Mapping[str, Null]],
    courses: Courses,
    seed: int,
    each: Each,
) -> Explained:
    """Every axis explained as far as it goes."""
    effects = effects_of(model, recording)
    rng = np.random.default_rng(seed)
    axes = prepared(recording.values, recording.rate_hz, effects, recording.temperature_c, courses, rng)
    clock = wrong_clock(axes, effects)
    if clock is not None:
        ratio = float(clock.ratio.value)
        effects = {name: tuple(restated(effect, ratio) for effect in of_axis) for name, of_axis in effects.items()}

    def one(name: str) -> Search:
        return search(axes[name], effects[name], null[name], np.random.default_rng([seed, AXES.index(name)]))

    found = dict(zip(axes, each(one, axes), strict=True))
    for name, innocent in _wrongly_accused(found, null).items():
        axes[name] = without_sources(axes[name], innocent)
        found[name] = one(name)
    return Explained(found, clock)


def reconcile(
    recording: Recording, model: NoiseModel | None, seed: int, each: Each = map, tell: Tell = lambda _what: None
) -> Reconciliation:
    """The whole walk.

    Args:
        recording: at least FEWEST samples of each axis
        model: under test; None: the five classic terms are fitted first
        seed: of all that is simulated and drawn; the same seed gives the same result
        each: maps work over axes and simulated recordings
        tell: told what is being done
    Raises:
        NotReady: too few samples, or no axis that the model has
    """
    recording, notes = usable(recording, model)
    courses = Courses(recording.samples, recording.rate_hz, recording.temperature_c)
    if model is None:
        tell("fitting the five terms")
    tested = model or five_terms(recording, courses, seed)
    tell("simulating the model")
    simulated = seen_in(tested, recording, courses, seed, each)
    null = nulls(simulated, len(simulated))
    tell("looking for what is missing")
    found = searched(recording, tested, null, courses, seed, each)
    rounds = {name: one for name, one in found.searches.items() if one.rounds}
    augmented = with_found(tested, found)
    final = null
    if rounds or found.clock:
        tell("simulating the new model")
        changed = None if found.clock else rounds
        simulated |= seen_in(augmented, recording, courses, seed + RUNS, each, only=changed)
        final = nulls(simulated, len(simulated))
    tell("writing down")
    axes = {name: described(one, null[name], final[name]) for name, one in found.searches.items()}
    if found.clock is not None:
        axes = with_clock(axes, found.clock, null)
    return Reconciliation(
        verdict=overall([one.verdict for one in axes.values()]),
        axes=axes,
        baseline=tested,
        model=augmented,
        fitted_first=model is None,
        rate_hz=recording.rate_hz,
        samples=recording.samples,
        seconds=recording.samples / recording.rate_hz,
        seed=seed,
        notes=notes,
    )


def usable(recording: Recording, model: NoiseModel | None) -> tuple[Recording, tuple[str, ...]]:
    """The axes that can be compared, and what is said of the others."""
    if recording.samples < FEWEST:
        raise NotReady(
            f"{recording.samples} samples; {FEWEST} are the least that anything can be said of "
            f"({FEWEST / recording.rate_hz:.0f} s at {recording.rate_hz:g} Hz)"
        )
    notes, kept = [], {}
    for name, y in recording.values.items():
        there = y[np.isfinite(y)]
        if there.size < FEWEST or there.size < MOSTLY * y.size:
            notes.append(f"{name}: {there.size} of {y.size} samples are there; left out")
        elif np.ptp(there) == 0.0:
            notes.append(f"{name}: all samples are the same; left out")
        elif model is not None and not model.effects.get(name):
            notes.append(f"{name}: the model says nothing of it; left out")
        else:
            kept[name] = y
    if not kept:
        raise NotReady("no axis to compare: " + "; ".join(notes))
    warmth = recording.temperature_c
    if warmth is not None:
        warmth = smooth(warmth) if np.isfinite(warmth).any() else None
    return Recording(kept, recording.rate_hz, warmth), tuple(notes)


def five_terms(recording: Recording, courses: Courses, seed: int) -> NoiseModel:
    """Q, N, B, K and R of each axis, those of them that the data support."""
    start = (QuantizationNoise(Q=1.0), AngleRandomWalk(N=1.0), BiasInstability(B=1.0), RateRandomWalk(K=1.0))
    rng = np.random.default_rng(seed)
    none: dict[str, Effects] = dict.fromkeys(recording.values, ())
    axes = prepared(recording.values, recording.rate_hz, none, recording.temperature_c, courses, rng)
    return NoiseModel({name: _terms(axis, start) for name, axis in axes.items()}, recording.rate_hz)


def _terms(axis: Axis, start: Effects) -> Effects:
    scale = float(np.sqrt(np.mean(axis.coefficients**2)))
    best = axis.fit([resized(effect, scale) for effect in start])
    with_ramp = axis.fit((*best.effects, RateRamp(R=scale)))
    if with_ramp.log_likelihood - best.log_likelihood > PRICE["rate_ramp"]:
        best = with_ramp
    for at in range(len(best.effects) - 1, -1, -1):
        effect = best.effects[at]
        if isinstance(effect, (AngleRandomWalk, RateRamp)):
            continue
        less = axis.fit(best.effects[:at] + best.effects[at + 1 :])
        if best.log_likelihood - less.log_likelihood < SUPPORTED:
            best = less
    return best.effects


def with_found(model: NoiseModel, found: Explained) -> NoiseModel:
    """The model with all that was found."""
    ratio = float(found.clock.ratio.value) if found.clock else 1.0
    effects = dict(model.effects)
    for name, one in found.searches.items():
        if not one.rounds:
            continue
        bias = tuple(effect for effect in model.effects.get(name, ()) if isinstance(effect, Bias))
        effects[name] = bias + tuple(restated(effect, 1.0 / ratio) for effect in one.state.effects)
    if found.clock is not None:
        effects[found.clock.axis] = (*effects[found.clock.axis], SampleRateError(ratio=ratio))
    return NoiseModel(effects, model.sample_rate_hz, model.temperature)


def with_clock(
    axes: Mapping[str, AxisResult], clock: Clock, null: Mapping[str, Mapping[str, Null]]
) -> dict[str, AxisResult]:
    """The step of a wrong clock, first on the axis that shows it most."""
    one = axes[clock.axis]
    half = abs(clock.frequency[1] - clock.frequency[0])
    where = Where(frequency=(min(clock.frequency) - 0.01 * half, max(clock.frequency) + 0.01 * half))
    limit = null[clock.axis]["lines"]
    before, null95, threshold = (float(np.sqrt(2.0 * x)) for x in (clock.gain, limit.null95, limit.threshold))
    after = next(score for score in one.start.scores if score.lens == "lines")
    score = Score("lines", where, before, null95, threshold)
    step = Step(
        found=score,
        kind="added",
        effect=SampleRateError.name,
        parameters={"ratio": clock.ratio},
        confidence=float(expit(clock.gain - CLOCK_PRICE)),
        runners_up=(),
        before=score,
        after=after,
        held_out_before=None,
        held_out_after=None,
        held_out_reason="the clock is one for the whole recording",
        because=(
            f"What the model has at {clock.frequency[0]:.6g} Hz is seen at {clock.frequency[1]:.6g} Hz, and all axes "
            f"agree with one ratio of the clocks."
        ),
        look=one.start,
    )
    verdict = one.verdict if one.verdict in ("explained", "partly_explained") else "explained"
    if one.left_over:
        verdict = "partly_explained"
    return {**axes, clock.axis: replace(one, steps=(step, *one.steps), verdict=verdict)}


def overall(verdicts: Iterable[Verdict]) -> Verdict:
    """Of a recording, from those of its axes."""
    every = set(verdicts)
    if every <= {"agrees"}:
        return "agrees"
    if every <= {"agrees", "explained"}:
        return "explained"
    return "unexplained" if every <= {"agrees", "unexplained"} else "partly_explained"


def _wrongly_accused(found: Mapping[str, Search], null: Mapping[str, Mapping[str, Null]]) -> dict[str, frozenset[str]]:
    """Axis -> axes that do not leak into it, though they seem to: it is the axis that leaks into them, and more."""
    gains = {
        (name, effect.source): step.trials[0].value
        for name, one in found.items()
        for step in one.rounds
        if isinstance(effect := step.trials[0].effect, Leak)
    }
    back: dict[str, frozenset[str]] = {}
    for (name, source), gain in gains.items():
        if source not in found:
            continue
        seen = found[source].seen["other_axes"]
        suspected = seen.where.source == name and seen.gain > null[source]["other_axes"].threshold
        if suspected or gains.get((source, name), np.inf) < gain:
            back[source] = back.get(source, frozenset()) | {name}
    return back
