"""Several recordings of one sensor beside one model: effects that all of them show, and effects of some.

In come the reconciliations of the recordings with the same model; out goes a ``Comparison``. Steps of two recordings
are one effect where they have the same name, the same kind, and the same place, if the effect has one: a frequency, a
time constant, a source axis. Places are the same where their intervals, stretched and widened by a share that real
sensors drift by, overlap. An effect that every recording with the axis shows is common, and its parameters are pooled;
any other is single, with what its absence means in each of the others. The clock is one for all axes of a recording.

The model that comes out is the one under test with the common effects: what one recording alone shows is no property
of the sensor yet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, nan, sqrt
from typing import Final

from drivers.sample import AXES
from monitor.noise.effect import Effect
from monitor.noise.effects import Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.reconcile import overall
from monitor.reconcile.result import AxisResult, Bounds, Kind, Reconciliation, Step, Verdict
from monitor.reconcile.several_recordings.absence import Absence, Shown, absence
from monitor.reconcile.several_recordings.effect_matching import (
    CLOCK,
    distance,
    effect_of,
    fields_of,
    nearest,
    place,
    place_name,
)
from monitor.reconcile.several_recordings.pooled_parameters import DISAGREE, Pooled, agreement, deviations, pooled

APART: Final = ("phase", "reference", "order")
"""Parameters that are no size: of no meaning in another recording, or chosen."""


@dataclass(frozen=True, slots=True)
class Run:
    """One recording by its name, beside the model."""

    name: str
    result: Reconciliation


@dataclass(frozen=True, slots=True)
class Seen:
    """One effect on one axis, in one recording or more."""

    effect: str
    kind: Kind
    steps: Mapping[str, Step]  # recording -> its step
    parameters: Mapping[str, Pooled]
    p: float | None  # probability that sizes as different as these are of one size; None: nothing to compare
    absent: tuple[Absence, ...] = ()

    @property
    def consistent(self) -> bool | None:
        """Whether the recordings agree in size."""
        return None if self.p is None else self.p >= DISAGREE

    def step(self) -> Step:
        """The step of the first recording, with the pooled parameters."""
        first = next(iter(self.steps.values()))
        return replace(first, parameters={name: one.bounds for name, one in self.parameters.items()})


@dataclass(frozen=True, slots=True)
class AxisRuns:
    """One axis in all recordings that have it."""

    axis: str
    results: Mapping[str, AxisResult]  # recording -> what was found there
    common: tuple[Seen, ...]
    single: tuple[Seen, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """What several recordings show together."""

    verdict: Verdict
    runs: tuple[Run, ...]
    silent: Mapping[str, str]  # recording that supports no answer -> why
    axes: Mapping[str, AxisRuns]  # in AXES order
    baseline: NoiseModel  # the model under test
    model: NoiseModel  # with the common effects
    fitted_to: str | None  # the recording that the five terms were fitted to; None: the model was given
    seed: int


def compare(runs: Sequence[Run], fitted_to: str | None = None, silent: Mapping[str, str] | None = None) -> Comparison:
    """What is common to recordings that were compared with one model.

    Args:
        runs: two or more, with names that differ
        fitted_to: the recording whose five terms are the model
        silent: recordings that no answer was found for, and why
    """
    baseline = runs[0].result.baseline
    axes = {axis: _axis(axis, runs) for axis in AXES if any(axis in run.result.axes for run in runs)}
    return Comparison(
        overall([run.result.verdict for run in runs]),
        tuple(runs),
        dict(silent or {}),
        axes,
        baseline,
        augmented(baseline, axes, {run.name: run.result.model for run in runs}),
        fitted_to,
        runs[0].result.seed,
    )


def augmented(baseline: NoiseModel, axes: Mapping[str, AxisRuns], models: Mapping[str, NoiseModel]) -> NoiseModel:
    """The model under test with the common effects, their parameters pooled.

    Args:
        models: recording -> its own model, with everything that was found there
    """
    effects = dict(baseline.effects)
    for axis, one in axes.items():
        for seen in one.common:
            run, step = next(iter(seen.steps.items()))
            made = _with(effect_of(models[run], axis, step), seen)
            known = effects.get(axis, ())
            if seen.kind == "added":
                effects[axis] = (*known, made)
            else:
                old = nearest(known, seen.effect, fields_of(made))
                effects[axis] = tuple(made if effect is old else effect for effect in known)
    return NoiseModel(effects, baseline.sample_rate_hz, baseline.temperature)


def _with(effect: Effect, seen: Seen) -> Effect:
    """With the pooled value of all that has an interval; the phase of a line is drawn anew."""
    known = {name: one.bounds.value for name, one in seen.parameters.items() if one.bounds.lo is not None}
    made: Effect = replace(effect, **known)  # type: ignore[type-var]
    return replace(made, phase=None) if isinstance(made, Sinusoidal) else made


def _axis(axis: str, runs: Sequence[Run]) -> AxisRuns:
    results = {run.name: run.result.axes[axis] for run in runs if axis in run.result.axes}
    groups: list[dict[str, Step]] = []
    for run in runs:
        for step in _steps(run, axis, runs):
            _join(groups, run.name, step, axis, runs)
    every = [_seen(group, axis, runs) for group in groups]
    common = tuple(one for one in every if not one.absent and len(one.steps) > 1)
    return AxisRuns(axis, results, common, tuple(one for one in every if one not in common))


def _steps(run: Run, axis: str, runs: Sequence[Run]) -> list[Step]:
    """Of one axis; that of the clock, wherever it was found, stands on the first axis where any recording has it."""
    found = run.result.axes[axis].steps if axis in run.result.axes else ()
    steps = [step for step in found if step.effect != CLOCK]
    return _clock(run) + steps if axis == _clock_axis(runs) else steps


def _clock(run: Run) -> list[Step]:
    return [step for one in run.result.axes.values() for step in one.steps if step.effect == CLOCK]


def _clock_axis(runs: Sequence[Run]) -> str:
    shown = {axis for run in runs for axis, one in run.result.axes.items() if any(s.effect == CLOCK for s in one.steps)}
    return next((axis for axis in AXES if axis in shown), "")


def _join(groups: list[dict[str, Step]], run: str, step: Step, axis: str, runs: Sequence[Run]) -> None:
    """Put a step to the nearest of the same name, kind and place that another recording has, or begin with it."""
    models = {one.name: one.result.model for one in runs}
    here = place(step, axis, models[run])
    best: tuple[float, dict[str, Step]] | None = None
    for group in groups:
        other, first = next(iter(group.items()))
        if run in group or (first.effect, first.kind) != (step.effect, step.kind):
            continue
        apart = distance(step.effect, here, place(first, axis, models[other]))
        if apart is not None and (best is None or apart < best[0]):
            best = apart, group
    if best is None:
        groups.append({run: step})
    else:
        best[1][run] = step


def _seen(group: Mapping[str, Step], axis: str, runs: Sequence[Run]) -> Seen:
    first = next(iter(group.values()))
    parameters = _pooled(group)
    sizes = [one for name, one in parameters.items() if name not in (*APART, place_name(first.effect))]
    having = [run for run in runs if axis in run.result.axes or first.effect == CLOCK]
    strongest = max((run for run in runs if run.name in group), key=lambda run: group[run.name].before.gap)
    step = group[strongest.name]
    # the clock may stand on another axis there
    of = next(one for one in strongest.result.axes.values() if any(own is step for own in one.steps))
    shown = Shown(step, of, _own_gap(step, axis, strongest.result), strongest.result.seconds)
    absent = tuple(absence(shown, run.name, run.result) for run in having if run.name not in group)
    return Seen(first.effect, first.kind, dict(group), parameters, _size_p(sizes, parameters), absent)


def _own_gap(step: Step, axis: str, result: Reconciliation) -> float:
    """What the effect itself opened; of a retuned term, how far the size in the model is from its interval's middle."""
    if step.kind == "added":
        return sqrt(max(step.before.gap**2 - step.after.gap**2, 0.0))
    given = nearest(result.baseline.effects[axis], step.effect, fields_of(effect_of(result.model, axis, step)))
    return max(deviations(one, getattr(given, name)) for name, one in step.parameters.items())


def _size_p(sizes: Sequence[Pooled], parameters: Mapping[str, Pooled]) -> float | None:
    """Of the sizes; of an effect that has none, such as a bandwidth, of all."""
    return agreement(sizes or parameters.values())


def _pooled(group: Mapping[str, Step]) -> dict[str, Pooled]:
    steps = [_at_reference(step, next(iter(group.values()))) for step in group.values()]
    names = dict.fromkeys(name for step in steps for name in step.parameters if name != "phase")
    return {name: pooled([step.parameters[name] for step in steps if name in step.parameters]) for name in names}


def _at_reference(step: Step, first: Step) -> Step:
    """A curved dependence on temperature has another slope at another reference: c + 2 q (T₁ − T₀)."""
    own = step.parameters
    if "quadratic" not in own or "reference" not in first.parameters:
        return step
    twice = 2.0 * (_value(first.parameters["reference"]) - _value(own["reference"]))
    value = _value(own["coefficient"]) + twice * _value(own["quadratic"])
    half = hypot(_half(own["coefficient"]), twice * _half(own["quadratic"]))
    moved = {"coefficient": Bounds(value, value - half, value + half), "reference": first.parameters["reference"]}
    return replace(step, parameters={**own, **moved})


def _value(one: Bounds) -> float:
    assert not isinstance(one.value, str)
    return one.value


def _half(one: Bounds) -> float:
    """Of the interval; NaN where there is none."""
    return nan if one.lo is None or one.hi is None else 0.5 * (one.hi - one.lo)
