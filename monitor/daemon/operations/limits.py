"""The user's limits: when a coefficient has passed one, and when it is back. Estimates in, events out.

A number alone passes a limit by chance every now and then; so what counts is its interval. An upper limit is passed
when ``lo`` is above it, a lower one when ``hi`` is below it: there the ``hi`` of an upper bound counts as well. The
interval has to be beyond at every look while samples of ``hold_s`` came; then the event is ``limit_crossed``. It is
over, ``limit_back``, when the value itself has been back as long: between the two the verdict stays as it is. An upper
bound is back under an upper limit when its ``hi`` is, since nothing less is shown. A look without an answer, as after
an axis began anew, shows neither, and the time begins again.

The time held is counted in samples, not by a clock: what is missing proves nothing, and a recording is judged as it was
lived. Pure: no clock, no thread.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

from drivers.errors import ConfigError
from drivers.sample import AXES, Event
from monitor.common.units import COEFFICIENT_NAMES, kind_of, unit_of
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import LETTERS, Status
from monitor.noise.catalogue import read_model
from monitor.noise.model import NoiseModel
from monitor.publishing.exporters.noise import from_model
from monitor.settings.loading import Device, Limit

CROSSED: Final = "limit_crossed"
BACK: Final = "limit_back"
Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Bound:
    """One limit of one letter on one axis."""

    axis: str
    letter: str
    limit: float  # SI unit of letter and axis
    upper: bool  # else a lower one
    hold_s: float
    times_model: float | None = None  # what it was made from

    @property
    def place(self) -> str:
        """``gz N``."""
        return f"{self.axis} {self.letter}"


@dataclass(frozen=True, slots=True)
class _Seen:
    """What a look says of one coefficient; NaN where it says nothing."""

    value: float
    lo: float
    hi: float

    def beyond(self, bound: Bound) -> bool:
        return self.lo > bound.limit if bound.upper else self.hi < bound.limit

    def back(self, bound: Bound) -> bool:
        if not bound.upper:
            return self.value >= bound.limit
        return (self.value if isfinite(self.value) else self.hi) <= bound.limit


@dataclass(slots=True)
class _State:
    crossed: bool = False
    since: tuple[int, int] | None = None  # samples and t_ns of the first look that contradicts it


class Limits:
    """All limits of one device.

    Raises:
        ConfigError: a limit relative to a model that does not have the letter on the axis
    """

    def __init__(self, limits: Sequence[Limit], model: NoiseModel | None) -> None:
        self.states = {bound: _State() for bound in bounds(limits, model)}

    @property
    def crossed(self) -> tuple[str, ...]:
        """Those that are passed now: ``gz N``."""
        return tuple(bound.place for bound, state in self.states.items() if state.crossed)

    def take_over(self, other: "Limits") -> None:
        """Go on where other limits were: a bound that both have keeps its state."""
        for bound in self.states:
            self.states[bound] = other.states.get(bound, self.states[bound])

    def update(self, estimate: Estimate) -> list[Event]:
        """One look; the events that it brings."""
        events = (self._look(bound, state, estimate) for bound, state in self.states.items())
        return [event for event in events if event is not None]

    def _look(self, bound: Bound, state: _State, estimate: Estimate) -> Event | None:
        seen = _seen(bound, estimate)
        if not (seen.back(bound) if state.crossed else seen.beyond(bound)):
            state.since = None
            return None
        if state.since is None:
            state.since = estimate.samples, estimate.t_ns
        samples, since_ns = state.since
        if estimate.samples - samples < bound.hold_s * estimate.rate_hz:
            return None
        state.crossed, state.since = not state.crossed, None
        return _event(bound, seen, state.crossed, estimate.t_ns, since_ns)


def model_of(device: Device) -> NoiseModel | None:
    """The model in force, where there is one; its limits can be held against it.

    Raises:
        ConfigError: there is none at its place, it is none, or a limit is relative to what it does not have
    """
    model = None if device.model is None else read_model(device.model)
    try:
        bounds(device.limits, model)
    except ConfigError as error:
        raise ConfigError(*(f"device {device.name}: {line}" for line in error.lines)) from None
    return model


def bounds(limits: Sequence[Limit], model: NoiseModel | None) -> list[Bound]:
    """A bound for each axis, of each limit.

    Raises:
        ConfigError: relative to a model that does not have the letter on the axis
    """
    known = {} if model is None else from_model(model).axes
    found, wrong = [], []
    for limit in limits:
        for axis in limit.axes:
            if limit.times_model is not None:
                term = known.get(axis, {}).get(limit.letter)
                if term is None:
                    wrong.append(
                        f"limit of {limit.letter}: times_model = {limit.times_model:g}, but the model in force has "
                        f"no {limit.letter} on {axis}; name the axes that have one, or write above"
                    )
                    continue
                upper = limit.times_model * term.value
                found.append(Bound(axis, limit.letter, upper, True, limit.hold_s, limit.times_model))
            if limit.above is not None:
                found.append(Bound(axis, limit.letter, limit.above, True, limit.hold_s))
            if limit.below is not None:
                found.append(Bound(axis, limit.letter, limit.below, False, limit.hold_s))
    if wrong:
        raise ConfigError(*wrong)
    return found


def _seen(bound: Bound, estimate: Estimate) -> _Seen:
    table, at = estimate.coefficients, (LETTERS.index(bound.letter), AXES.index(bound.axis))
    if Status(int(table.status[at])) == Status.UNESTIMATED:
        return _Seen(float("nan"), float("nan"), float("nan"))
    return _Seen(float(table.value[at]), float(table.lo[at]), float(table.hi[at]))


def _event(bound: Bound, seen: _Seen, crossed: bool, t_ns: int, since_ns: int) -> Event:
    what = {"value": seen.value, "lo": seen.lo, "hi": seen.hi, "limit": bound.limit}
    kind = CROSSED if crossed else BACK
    return Event(
        kind, t_ns, _text(bound, seen, crossed), bound.axis, {bound.letter: what}, since_ns, _sigma(bound, seen)
    )


def _sigma(bound: Bound, seen: _Seen) -> float | None:
    """How many standard errors value and limit are apart, on the side of the limit; None of a bound."""
    if not isfinite(seen.value):
        return None
    error = (seen.value - seen.lo if seen.value > bound.limit else seen.hi - seen.value) / Z95
    return abs(seen.value - bound.limit) / error if error > 0.0 else None


def _text(bound: Bound, seen: _Seen, crossed: bool) -> str:
    unit, name = unit_of(bound.letter, bound.axis), COEFFICIENT_NAMES[kind_of(bound.axis)][bound.letter]
    measured = unit.text(seen.value) if isfinite(seen.value) else f"at most {unit.text(seen.hi)}"
    limit = f"{unit.text(bound.limit)}, its {'upper' if bound.upper else 'lower'} limit"
    if bound.times_model is not None:
        limit += f" ({bound.times_model:g} times its model)"
    if crossed:
        return f"{bound.axis} {name} {measured} is {'above' if bound.upper else 'below'} {limit}"
    return f"{bound.axis} {name} {measured} is no longer {'above' if bound.upper else 'below'} {limit}"
