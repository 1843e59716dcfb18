"""Comparison of the results of several recordings of one sensor, reconciled with the same noise model.

Two recordings show the same effect if the name, the kind and the identifying parameters of the effect match. A
**common** effect occurs in every recording of the axis and is added to the noise model. All other effects are
**single** effects and may be properties of one recording. The parameters of an effect are averaged over the recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, nan, sqrt
from typing import Final

from drivers.data_types import AXES
from monitor.noise.effect import Effect
from monitor.noise.effects import Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisResult,
    Decision,
    ParameterInterval,
    Reconciliation,
    StepKind,
    combine_decisions,
)
from monitor.reconcile.several_recordings.absence import Absence, ClearestOccurrence, explain_absence
from monitor.reconcile.several_recordings.effect_matching import (
    SAMPLE_RATE_EFFECT,
    distance_if_parameters_match,
    effect_parameters,
    find_closest_effect,
    find_effect_of_step,
    find_identifying_parameter,
    identifying_parameter_name,
)
from monitor.reconcile.several_recordings.pooled_parameters import (
    MIN_AGREEMENT_PROBABILITY,
    PooledParameter,
    agreement_probability,
    distance_in_sigma,
    pool_parameter,
)

NON_SIZE_PARAMETERS: Final = ("phase", "reference", "order", "kind")
"""Parameters that are excluded from the comparison of sizes."""


@dataclass(frozen=True, slots=True)
class NamedResult:
    """Name and result of one recording."""

    name: str
    result: Reconciliation


@dataclass(frozen=True, slots=True)
class EffectInRecordings:
    """Effect that one or more recordings show on one axis."""

    effect: str
    kind: StepKind
    steps: Mapping[str, AddedOrResizedEffect]  # by name of the recording
    parameters: Mapping[str, PooledParameter]
    p: float | None  # probability of an equal or larger scatter if the size is the same in all recordings
    absent: tuple[Absence, ...] = ()

    @property
    def sizes_agree(self) -> bool | None:
        """True if the sizes in all recordings agree, or None if there are fewer than two sizes."""
        return None if self.p is None else self.p >= MIN_AGREEMENT_PROBABILITY

    def step_with_pooled_parameters(self) -> AddedOrResizedEffect:
        """Return the effect of the first recording with the pooled parameters."""
        first = next(iter(self.steps.values()))
        return replace(first, parameters={name: one.bounds for name, one in self.parameters.items()})


@dataclass(frozen=True, slots=True)
class AxisComparison:
    """Comparison of one axis in several recordings."""

    axis: str
    results: Mapping[str, AxisResult]  # by name of the recording
    common: tuple[EffectInRecordings, ...]
    single: tuple[EffectInRecordings, ...]


@dataclass(frozen=True, slots=True)
class RecordingsComparison:
    """Comparison of several recordings of one sensor."""

    verdict: Decision
    runs: tuple[NamedResult, ...]
    without_result: Mapping[str, str]  # reason for each recording without a result
    axes: Mapping[str, AxisComparison]  # in AXES order
    baseline: NoiseModel  # the model under test
    model: NoiseModel  # with the common effects
    fitted_to: str | None  # recording to which the model under test was fitted; None if the model was given
    seed: int


def compare_results(
    runs: Sequence[NamedResult], fitted_to: str | None = None, without_result: Mapping[str, str] | None = None
) -> RecordingsComparison:
    """Compare the results of several recordings that were reconciled with one noise model.

    Parameters
    ----------
    runs : sequence of NamedResult
        Two or more recordings with different names.
    fitted_to : str, optional
        Recording to which the model under test was fitted.
    without_result : mapping of str to str, optional
        Reason for each recording without a result.
    """
    baseline = runs[0].result.baseline
    axes = {axis: _compare_axis(axis, runs) for axis in AXES if any(axis in run.result.axes for run in runs)}
    return RecordingsComparison(
        combine_decisions([run.result.verdict for run in runs]),
        tuple(runs),
        dict(without_result or {}),
        axes,
        baseline,
        _add_common_effects(baseline, axes, {run.name: run.result.model for run in runs}),
        fitted_to,
        runs[0].result.seed,
    )


def _add_common_effects(
    baseline: NoiseModel, axes: Mapping[str, AxisComparison], models: Mapping[str, NoiseModel]
) -> NoiseModel:
    """Return the noise model with the common effects, which have the pooled parameters."""
    effects = dict(baseline.effects)
    for axis, one in axes.items():
        for matched in one.common:
            run, step = next(iter(matched.steps.items()))
            made = _with_pooled_parameters(find_effect_of_step(models[run], axis, step), matched)
            known = effects.get(axis, ())
            if matched.kind == "added":
                effects[axis] = (*known, made)
            else:
                is_known = step.moved_from is not None and step.moved_from in known
                old = (
                    step.moved_from if is_known else find_closest_effect(known, matched.effect, effect_parameters(made))
                )
                effects[axis] = tuple(made if effect is old else effect for effect in known)
    return NoiseModel(effects, baseline.sample_rate_hz, baseline.temperature)


def _with_pooled_parameters(effect: Effect, matched: EffectInRecordings) -> Effect:
    """Return an effect with the pooled parameters. The phase of a sinusoid becomes random."""
    known = {name: one.bounds.value for name, one in matched.parameters.items() if one.bounds.lo is not None}
    made: Effect = replace(effect, **known)  # type: ignore[type-var]
    return replace(made, phase=None) if isinstance(made, Sinusoidal) else made


def _compare_axis(axis: str, runs: Sequence[NamedResult]) -> AxisComparison:
    results = {run.name: run.result.axes[axis] for run in runs if axis in run.result.axes}
    groups: list[dict[str, AddedOrResizedEffect]] = []
    for run in runs:
        for step in _steps_of_axis(run, axis, runs):
            _add_to_group(groups, run.name, step, axis, runs)
    every = [_summarise_group(group, axis, runs) for group in groups]
    common = tuple(one for one in every if not one.absent and len(one.steps) > 1)
    return AxisComparison(axis, results, common, tuple(one for one in every if one not in common))


def _steps_of_axis(run: NamedResult, axis: str, runs: Sequence[NamedResult]) -> list[AddedOrResizedEffect]:
    """Return the added and resized effects of one axis.

    A sample rate error is assigned to the same axis in all recordings.
    """
    found = run.result.axes[axis].steps if axis in run.result.axes else ()
    steps = [step for step in found if step.effect != SAMPLE_RATE_EFFECT]
    return _sample_rate_steps(run) + steps if axis == _sample_rate_axis(runs) else steps


def _sample_rate_steps(run: NamedResult) -> list[AddedOrResizedEffect]:
    return [step for one in run.result.axes.values() for step in one.steps if step.effect == SAMPLE_RATE_EFFECT]


def _sample_rate_axis(runs: Sequence[NamedResult]) -> str:
    """Return the first axis for which one of the recordings has a sample rate error, or an empty string."""
    results = [(axis, run.result.axes.get(axis)) for axis in AXES for run in runs]
    return next((axis for axis, one in results if one and any(s.effect == SAMPLE_RATE_EFFECT for s in one.steps)), "")


def _add_to_group(
    groups: list[dict[str, AddedOrResizedEffect]],
    run: str,
    step: AddedOrResizedEffect,
    axis: str,
    runs: Sequence[NamedResult],
) -> None:
    """Add an effect to the group of the closest matching effect, or start a new group."""
    models = {one.name: one.result.model for one in runs}
    here = find_identifying_parameter(step, axis, models[run])
    best: tuple[float, dict[str, AddedOrResizedEffect]] | None = None
    for group in groups:
        other, first = next(iter(group.items()))
        if run in group or (first.effect, first.kind) != (step.effect, step.kind):
            continue
        apart = distance_if_parameters_match(step.effect, here, find_identifying_parameter(first, axis, models[other]))
        if apart is not None and (best is None or apart < best[0]):
            best = apart, group
    if best is None:
        groups.append({run: step})
    else:
        best[1][run] = step


def _summarise_group(
    group: Mapping[str, AddedOrResizedEffect], axis: str, runs: Sequence[NamedResult]
) -> EffectInRecordings:
    first = next(iter(group.values()))
    parameters = _pool_parameters(group)
    sizes = [
        one
        for name, one in parameters.items()
        if name not in (*NON_SIZE_PARAMETERS, identifying_parameter_name(first.effect))
    ]
    having = [run for run in runs if axis in run.result.axes or first.effect == SAMPLE_RATE_EFFECT]
    strongest = max((run for run in runs if run.name in group), key=lambda run: group[run.name].before.gap)
    step = group[strongest.name]
    # the recording may show the sample rate error on another axis
    axis_result = next(one for one in strongest.result.axes.values() if any(own is step for own in one.steps))
    shown = ClearestOccurrence(
        step, axis_result, _gap_of_effect(step, axis, strongest.result), strongest.result.duration_s
    )
    p = agreement_probability(sizes or parameters.values())  # an effect without a size: compare all parameters
    absent = tuple(Absence(run.name, *explain_absence(shown, run.result)) for run in having if run.name not in group)
    return EffectInRecordings(first.effect, first.kind, dict(group), parameters, p, absent)


def _gap_of_effect(step: AddedOrResizedEffect, axis: str, result: Reconciliation) -> float:
    """Return the difference that an effect causes, in standard deviations."""
    if step.kind == "added":
        return sqrt(max(step.before.gap**2 - step.after.gap**2, 0.0))
    given = find_closest_effect(
        result.baseline.effects[axis], step.effect, effect_parameters(find_effect_of_step(result.model, axis, step))
    )
    known = {name: getattr(given, name) for name in step.parameters if name not in NON_SIZE_PARAMETERS}
    return max(
        (distance_in_sigma(step.parameters[name], value) for name, value in known.items() if value is not None),
        default=0.0,
    )


def _pool_parameters(group: Mapping[str, AddedOrResizedEffect]) -> dict[str, PooledParameter]:
    steps = [_at_common_reference(step, next(iter(group.values()))) for step in group.values()]
    names = dict.fromkeys(name for step in steps for name in step.parameters if name != "phase")
    return {
        name: pool_parameter([step.parameters[name] for step in steps if name in step.parameters]) for name in names
    }


def _at_common_reference(step: AddedOrResizedEffect, first: AddedOrResizedEffect) -> AddedOrResizedEffect:
    """Convert a polynomial of the temperature to the reference temperature T₁ of the first recording.

    With Δ = T₁ − T₀, the coefficients c, q and k at the reference T₀ become c + 2qΔ + 3kΔ², q + 3kΔ and k.
    """
    own = step.parameters
    if "quadratic" not in own or "reference" not in first.parameters:
        return step
    away = _numerical_value(first.parameters["reference"]) - _numerical_value(own["reference"])
    cubic = own.get("cubic", ParameterInterval(0.0, 0.0, 0.0))
    moved = {
        "coefficient": _weighted_sum((1.0, own["coefficient"]), (2.0 * away, own["quadratic"]), (3.0 * away**2, cubic)),
        "quadratic": _weighted_sum((1.0, own["quadratic"]), (3.0 * away, cubic)),
        "reference": first.parameters["reference"],
    }
    return replace(step, parameters={**own, **moved})


def _weighted_sum(*terms: tuple[float, ParameterInterval]) -> ParameterInterval:
    value = sum(weight * _numerical_value(one) for weight, one in terms)
    half = hypot(*(weight * _half_width(one) for weight, one in terms))
    return ParameterInterval(value, value - half, value + half)


def _numerical_value(bounds: ParameterInterval) -> float:
    assert not isinstance(bounds.value, str)
    return bounds.value


def _half_width(bounds: ParameterInterval) -> float:
    return nan if bounds.lo is None or bounds.hi is None else 0.5 * (bounds.hi - bounds.lo)
