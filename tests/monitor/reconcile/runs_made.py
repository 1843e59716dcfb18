"""Reconciliations of one sensor without a search, with the spectral line from ``samples`` on gz plus other effects."""

from collections.abc import Sequence
from dataclasses import replace

from monitor.noise.effect import Effect
from monitor.noise.effects import EFFECTS, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AlternativeEffect,
    AxisModelDiagnostics,
    AxisResult,
    Decision,
    DiagnosticGap,
    Location,
    ParameterInterval,
)
from monitor.reconcile.several_recordings.comparison import NamedResult
from tests.monitor.reconcile import samples

DIAGNOSTIC = DiagnosticGap("lines", Location(frequency=(17.0, 18.0)), 1.2, 2.0, 4.0)
"""Result of a diagnostic on an axis without findings."""


def step(
    effect: str, gap: float = 30.0, rivals: Sequence[str] = (), kind: str = "added", **given: ParameterInterval | float
) -> AddedOrResizedEffect:
    """Return a step that ``DIAGNOSTIC`` found with this gap. A plain number gets an interval of one percent."""
    before = replace(DIAGNOSTIC, gap=gap)
    parameters = {
        name: one if isinstance(one, ParameterInterval) else around(one, 0.01 * abs(one)) for name, one in given.items()
    }
    return AddedOrResizedEffect(
        kind, effect, parameters, 0.99, tuple(AlternativeEffect(one, 0.01) for one in rivals),  # type: ignore[arg-type]
        before, DIAGNOSTIC, None, None, "made by hand", "it was made by hand", AxisModelDiagnostics((DIAGNOSTIC,), ()),
    )  # fmt: skip


def around(value: float, half: float) -> ParameterInterval:
    return ParameterInterval(value, value - half, value + half)


def line(amplitude: float = 1.5e-4, frequency: float = 17.3, half: float = 3e-6) -> AddedOrResizedEffect:
    return step(
        "sinusoidal",
        amplitude=around(amplitude, half),
        frequency=around(frequency, 1e-3),
        phase=around(1.0, 0.1),
    )


def run(
    name: str,
    *steps: AddedOrResizedEffect,
    axis: str = "gz",
    seconds: float = 600.0,
    left: Sequence[DiagnosticGap] = (),
) -> NamedResult:
    """Return the result for one axis with these steps. Its model contains their effects."""
    verdict: Decision = ("partly_explained" if steps else "unexplained") if left else "explained" if steps else "agrees"
    result = AxisResult(
        axis,
        verdict,
        AxisModelDiagnostics((DIAGNOSTIC,), ()),
        steps,
        tuple(left),
        AxisModelDiagnostics((DIAGNOSTIC,), ()),
    )
    whole = samples.agrees()
    given = whole.baseline.effects[axis]
    baseline = NoiseModel({axis: given}, samples.RATE_HZ)
    added = [made(one) for one in steps if one.kind == "added"]
    retuned = {one.effect: made(one) for one in steps if one.kind == "retuned"}
    effects = (*(retuned.get(effect.name, effect) for effect in given), *added)
    return NamedResult(
        name,
        replace(
            whole, verdict=verdict, axes={axis: result}, baseline=baseline, duration_s=seconds,
            model=NoiseModel({axis: effects}, samples.RATE_HZ),
        ),
    )  # fmt: skip


def made(one: AddedOrResizedEffect) -> Effect:
    extra = {"reference": 25.0} if one.effect == "temperature_lag" else {}
    values = {name: bounds.value for name, bounds in one.parameters.items()}
    return EFFECTS[one.effect](**extra, **values)


def with_axes(first: NamedResult, *others: NamedResult) -> NamedResult:
    """Return one result with the axes of all results."""
    axes = {axis: one for run in (first, *others) for axis, one in run.result.axes.items()}
    models = [
        NoiseModel(
            {axis: effects for run in (first, *others) for axis, effects in getattr(run.result, which).effects.items()},
            samples.RATE_HZ,
        )
        for which in ("baseline", "model")
    ]
    return replace(first, result=replace(first.result, axes=axes, baseline=models[0], model=models[1]))


def known_lines(models: Sequence[Sinusoidal], one: NamedResult) -> NamedResult:
    """Return the result for a model that also contains these lines."""
    effects = {axis: (*given, *models) for axis, given in one.result.baseline.effects.items()}
    return replace(one, result=replace(one.result, baseline=NoiseModel(effects, samples.RATE_HZ)))
