"""Whether two recordings of a sensor show one effect, or two of one kind: by its place.

A place is the parameter that tells effects of one name apart: a frequency, a time constant, a source axis. Two places
are the same where their intervals, stretched and widened by a share that real sensors drift by, overlap. An effect
without a place is there once on an axis.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

from monitor.noise.effect import Effect
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import Bounds, Step

PLACES: Final[Mapping[str, tuple[str, float]]] = {
    "sinusoidal": ("frequency", 0.005),
    "narrowband": ("frequency", 0.05),
    "exponentially_correlated": ("correlation_time", 1 / 3),
    "random_telegraph": ("dwell_time", 1 / 3),
    "temperature_lag": ("time_constant", 1 / 3),
    "turn_on_transient": ("time_constant", 1 / 3),
    "bandwidth_limit": ("cutoff", 0.1),
    "bias_step": ("time", 0.01),
    "noise_step": ("time", 0.01),
    "g_sensitivity": ("source", 0.0),
    "cross_axis": ("source", 0.0),
}
"""Effect -> the parameter that says which one of its kind it is, and the share by which its interval is widened on
both sides: motors and clocks drift by parts in a hundred, time constants within a factor of two."""
STRETCH: Final = 2.0
"""Times a 95 % interval, so that one effect is not taken for two by chance."""
CLOCK: Final = "sample_rate_error"


def place_name(effect: str) -> str:
    """The parameter that is the place of an effect; "" where it has none."""
    return PLACES.get(effect, ("", 0.0))[0]


def place(step: Step, axis: str, model: NoiseModel) -> Bounds | None:
    """Which one of its kind it is; of a retuned term, which tells its size only, its recording's own model knows."""
    name = place_name(step.effect)
    return (step.parameters.get(name) or Bounds(getattr(effect_of(model, axis, step), name))) if name else None


def distance(effect: str, a: Bounds | None, b: Bounds | None) -> float | None:
    """How far two places of an effect are from each other, as a share; None where they are not the same.

    >>> distance("sinusoidal", Bounds(17.30), Bounds(17.32)) is None, distance("sinusoidal", Bounds(17.3), Bounds(19.0))
    (False, None)
    """
    if a is None or b is None:
        return 0.0
    if isinstance(a.value, str) or isinstance(b.value, str):
        return 0.0 if a.value == b.value else None
    share = PLACES[effect][1]
    (lo, hi), (other_lo, other_hi) = _widened(a, share), _widened(b, share)
    return _unlike(a.value, b.value) if lo <= other_hi and other_lo <= hi else None


def effect_of(model: NoiseModel, axis: str, step: Step) -> Effect:
    """What a step left in its recording's own model."""
    clock = [effect for _, effect in model if effect.name == CLOCK] if step.effect == CLOCK else []
    parameters = {name: one.value for name, one in step.parameters.items()}
    return nearest(clock or model.effects[axis], step.effect, parameters)


def nearest(effects: Sequence[Effect], name: str, parameters: Mapping[str, Any]) -> Effect:
    """Of several effects of one name, the one whose parameters are most like these."""

    def apart(effect: Effect) -> float:
        return sum(_unlike(getattr(effect, key, None), value) for key, value in parameters.items())

    return min((effect for effect in effects if effect.name == name), key=apart)


def fields_of(effect: Effect) -> dict[str, Any]:
    """All parameters of an effect."""
    return {f.name: getattr(effect, f.name) for f in fields(effect)}  # type: ignore[arg-type]


def _unlike(a: Any, b: Any) -> float:
    """0 for equal parameters, 1 for those of other signs or words."""
    if isinstance(a, str) or isinstance(b, str) or a is None or b is None:
        return float(a != b)
    return min(abs(a - b) / (abs(a) + abs(b)), 1.0) if a != b else 0.0


def _widened(one: Bounds, share: float) -> tuple[float, float]:
    assert not isinstance(one.value, str)
    below = 0.0 if one.lo is None else one.value - one.lo
    above = 0.0 if one.hi is None else one.hi - one.value
    more = share * abs(one.value)
    return one.value - STRETCH * below - more, one.value + STRETCH * above + more
