"""Matching of effects between recordings of one sensor.

An identifying parameter, such as a frequency or a source axis, distinguishes effects of the same name. Two identifying
parameters match if the widened intervals overlap. An effect without an identifying parameter occurs at most once on an
axis.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

from monitor.noise.effect import Effect
from monitor.noise.model import NoiseModel
from monitor.reconcile.effect_properties import EFFECT_PROPERTIES
from monitor.reconcile.result import AddedOrResizedEffect, ParameterInterval

INTERVAL_STRETCH: Final = 2.0
"""Factor that widens a 95 % interval, so that one effect rarely appears as two effects."""
SAMPLE_RATE_EFFECT: Final = "sample_rate_error"
"""Name of the effect that all axes of a recording have in common."""


def identifying_parameter_name(effect: str) -> str:
    """Return the name of the identifying parameter of an effect, or an empty string."""
    return EFFECT_PROPERTIES[effect].identity if effect in EFFECT_PROPERTIES else ""


def find_identifying_parameter(step: AddedOrResizedEffect, axis: str, model: NoiseModel) -> ParameterInterval | None:
    """Return the identifying parameter of an effect, or None.

    The identifying parameter of a resized effect is read from the noise model.

    Parameters
    ----------
    step : AddedOrResizedEffect
        Step of the reconciliation.
    axis : str
        Name of the axis.
    model : NoiseModel
        Model of the same recording, with all effects that were found.
    """
    name = identifying_parameter_name(step.effect)
    return (
        (step.parameters.get(name) or ParameterInterval(getattr(find_effect_of_step(model, axis, step), name)))
        if name
        else None
    )


def distance_if_parameters_match(effect: str, a: ParameterInterval | None, b: ParameterInterval | None) -> float | None:
    """Return the relative distance of two identifying parameters, or None if the parameters do not match.

    The distance is 0 if one of the parameters is None.

    Parameters
    ----------
    effect : str
        Name of the effect.
    a, b : ParameterInterval or None
        Identifying parameters in two recordings.

    Examples
    --------
    >>> distance_if_parameters_match("sinusoidal", ParameterInterval(17.30), ParameterInterval(17.30))
    0.0
    >>> distance_if_parameters_match("sinusoidal", ParameterInterval(17.30), ParameterInterval(19.00))
    """
    if a is None or b is None:
        return 0.0
    if isinstance(a.value, str) or isinstance(b.value, str):
        return 0.0 if a.value == b.value else None
    share = EFFECT_PROPERTIES[effect].tolerance
    (lo, hi), (other_lo, other_hi) = _widened_interval(a, share), _widened_interval(b, share)
    return _relative_difference(a.value, b.value) if lo <= other_hi and other_lo <= hi else None


def find_effect_of_step(model: NoiseModel, axis: str, step: AddedOrResizedEffect) -> Effect:
    """Find the effect that a search step added or resized in the extended noise model.

    Parameters
    ----------
    model : NoiseModel
        Model of the recording, with all effects that were found.
    axis : str
        Name of the axis.
    step : AddedOrResizedEffect
        Step of the reconciliation.
    """
    clock = (
        [effect for _, effect in model if effect.name == SAMPLE_RATE_EFFECT]
        if step.effect == SAMPLE_RATE_EFFECT
        else []
    )
    parameters = {name: one.value for name, one in step.parameters.items()}
    return find_closest_effect(clock or model.effects[axis], step.effect, parameters)


def find_closest_effect(effects: Sequence[Effect], name: str, parameters: Mapping[str, Any]) -> Effect:
    """Find the effect with a given name and the closest parameters.

    Parameters
    ----------
    effects : sequence of Effect
        Effects of an axis.
    name : str
        Name of the effect.
    parameters : mapping of str to float, str or None
        Parameters to compare, in SI units.
    """

    def parameter_distance(effect: Effect) -> float:
        return sum(_relative_difference(getattr(effect, key, None), value) for key, value in parameters.items())

    return min((effect for effect in effects if effect.name == name), key=parameter_distance)


def effect_parameters(effect: Effect) -> dict[str, Any]:
    """Return all parameters of an effect by name."""
    return {f.name: getattr(effect, f.name) for f in fields(effect)}  # type: ignore[arg-type]


def _relative_difference(a: Any, b: Any) -> float:
    """Return a relative difference between 0 (equal) and 1 (different signs or names)."""
    if isinstance(a, str) or isinstance(b, str) or a is None or b is None:
        return float(a != b)
    return min(abs(a - b) / (abs(a) + abs(b)), 1.0) if a != b else 0.0


def _widened_interval(bounds: ParameterInterval, share: float) -> tuple[float, float]:
    assert not isinstance(bounds.value, str)
    below = 0.0 if bounds.lo is None else bounds.value - bounds.lo
    above = 0.0 if bounds.hi is None else bounds.hi - bounds.value
    more = share * abs(bounds.value)
    return bounds.value - INTERVAL_STRETCH * below - more, bounds.value + INTERVAL_STRETCH * above + more
