"""User limits on noise coefficients, and detection of crossed limits.

An upper limit is crossed if the lower end of the confidence interval is above the limit. A lower limit is crossed if
the upper end of the confidence interval is below the limit. If every estimate during ``hold_s`` seconds of samples
crosses the limit, the event ``limit_crossed`` is raised. If the value stays within the limit for ``hold_s`` seconds of
samples, the event ``limit_back`` is raised. An estimate with neither a value nor an upper bound restarts the hold time.

The hold time is counted in samples, so a replayed recording and the live sensor give the same events.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

from drivers.data_types import AXES, Event
from drivers.errors import ConfigError
from monitor.common.distributions import Z95
from monitor.common.unit_formatting import COEFFICIENT_NAMES, coefficient_unit, sensor_kind
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.noise.model import NoiseModel
from monitor.noise.model_loading import read_model
from monitor.publishing.exporters.export_input import from_model
from monitor.settings.loading import Device, Limit

LIMIT_CROSSED: Final = "limit_crossed"
"""Kind of event that is raised when a limit is crossed."""
LIMIT_BACK: Final = "limit_back"
"""Kind of event that is raised when a coefficient that had crossed a limit is within the limit again."""


@dataclass(frozen=True, slots=True)
class AxisLimit:
    """Limit of one coefficient on one axis."""

    axis: str
    letter: str
    limit: float  # SI unit of the coefficient on this axis
    upper: bool  # True for an upper limit, False for a lower one
    hold_s: float
    times_model: float | None = None  # limit as a multiple of the coefficient of the noise model

    @property
    def axis_and_letter(self) -> str:
        """Axis and letter of the coefficient, for example ``gz N``."""
        return f"{self.axis} {self.letter}"


@dataclass(frozen=True, slots=True)
class _Measured:
    """One estimated coefficient with its confidence interval. All values are NaN if the coefficient is unknown."""

    value: float
    lo: float
    hi: float

    def interval_is_beyond_limit(self, bound: AxisLimit) -> bool:
        """Return True if the confidence interval is beyond the limit."""
        return self.lo > bound.limit if bound.upper else self.hi < bound.limit

    def is_value_within_limit(self, bound: AxisLimit) -> bool:
        """Return True if the value is within the limit."""
        if not bound.upper:
            return self.value >= bound.limit
        return (self.value if isfinite(self.value) else self.hi) <= bound.limit


@dataclass(slots=True)
class _State:
    crossed: bool = False
    since: tuple[int, int] | None = None  # samples and t_ns of the first estimate that contradicts ``crossed``


class LimitMonitor:
    """Monitor of all user limits of one device.

    Parameters
    ----------
    limits : sequence of Limit
        User limits in the settings of the device.
    model : NoiseModel or None
        Noise model of the device, for limits that are relative to the model.

    Raises
    ------
    ConfigError
        If a limit is relative to a coefficient that the noise model does not contain.
    """

    def __init__(self, limits: Sequence[Limit], model: NoiseModel | None) -> None:
        self.states = {bound: _State() for bound in make_axis_limits(limits, model)}

    @property
    def coefficients_beyond_limits(self) -> tuple[str, ...]:
        """Axis and letter of each coefficient that has crossed a limit, for example ``gz N``."""
        return tuple(bound.axis_and_letter for bound, state in self.states.items() if state.crossed)

    def copy_states_from(self, other: "LimitMonitor") -> None:
        """Copy the states of the limits that both monitors contain."""
        for bound in self.states:
            self.states[bound] = other.states.get(bound, self.states[bound])

    def check_estimate(self, estimate: Estimate) -> list[Event]:
        """Compare a new estimate with all limits, and return the resulting events."""
        events = (self._test_bound(bound, state, estimate) for bound, state in self.states.items())
        return [event for event in events if event is not None]

    def _test_bound(self, bound: AxisLimit, state: _State, estimate: Estimate) -> Event | None:
        seen = _measured(bound, estimate)
        if not (seen.is_value_within_limit(bound) if state.crossed else seen.interval_is_beyond_limit(bound)):
            state.since = None
            return None
        if state.since is None:
            state.since = estimate.samples, estimate.t_ns
        samples, since_ns = state.since
        if estimate.samples - samples < bound.hold_s * estimate.rate_hz:
            return None
        state.crossed, state.since = not state.crossed, None
        return _event(bound, seen, state.crossed, estimate.t_ns, since_ns)


def read_model_in_force(device: Device) -> NoiseModel | None:
    """Read the noise model of a device, or return None if no model is configured.

    Raises
    ------
    ConfigError
        If the model cannot be read, or if a limit is relative to a coefficient that the model does not contain.
    """
    model = None if device.model is None else read_model(device.model)
    try:
        make_axis_limits(device.limits, model)
    except ConfigError as error:
        raise ConfigError(*(f"device {device.name}: {line}" for line in error.mistake_lines)) from None
    return model


def make_axis_limits(limits: Sequence[Limit], model: NoiseModel | None) -> list[AxisLimit]:
    """Convert the user limits of a device to limits for individual coefficients and axes.

    Parameters
    ----------
    limits : sequence of Limit
        User limits in the settings of a device.
    model : NoiseModel or None
        Noise model of the device.

    Raises
    ------
    ConfigError
        If a limit is relative to a coefficient that the noise model does not contain.
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
                found.append(AxisLimit(axis, limit.letter, upper, True, limit.hold_s, limit.times_model))
            if limit.above is not None:
                found.append(AxisLimit(axis, limit.letter, limit.above, True, limit.hold_s))
            if limit.below is not None:
                found.append(AxisLimit(axis, limit.letter, limit.below, False, limit.hold_s))
    if wrong:
        raise ConfigError(*wrong)
    return found


def _measured(bound: AxisLimit, estimate: Estimate) -> _Measured:
    table, at = estimate.coefficients, (SYMBOLS.index(bound.letter), AXES.index(bound.axis))
    if Status(int(table.status[at])) == Status.UNESTIMATED:
        return _Measured(float("nan"), float("nan"), float("nan"))
    return _Measured(float(table.value[at]), float(table.lo[at]), float(table.hi[at]))


def _event(bound: AxisLimit, seen: _Measured, crossed: bool, t_ns: int, since_ns: int) -> Event:
    what = {"value": seen.value, "lo": seen.lo, "hi": seen.hi, "limit": bound.limit}
    kind = LIMIT_CROSSED if crossed else LIMIT_BACK
    return Event(
        kind, t_ns, _text(bound, seen, crossed), bound.axis, {bound.letter: what}, since_ns, _sigma(bound, seen)
    )


def _sigma(bound: AxisLimit, seen: _Measured) -> float | None:
    """Return the distance between value and limit in standard errors, or None for an upper bound."""
    if not isfinite(seen.value):
        return None
    error = (seen.value - seen.lo if seen.value > bound.limit else seen.hi - seen.value) / Z95
    return abs(seen.value - bound.limit) / error if error > 0.0 else None


def _text(bound: AxisLimit, seen: _Measured, crossed: bool) -> str:
    unit, name = coefficient_unit(bound.letter, bound.axis), COEFFICIENT_NAMES[sensor_kind(bound.axis)][bound.letter]
    measured = unit.format_si_value(seen.value) if isfinite(seen.value) else f"at most {unit.format_si_value(seen.hi)}"
    limit = f"{unit.format_si_value(bound.limit)}, its {'upper' if bound.upper else 'lower'} limit"
    if bound.times_model is not None:
        limit += f" ({bound.times_model:g} times its model)"
    if crossed:
        return f"{bound.axis} {name} {measured} is {'above' if bound.upper else 'below'} {limit}"
    return f"{bound.axis} {name} {measured} is no longer {'above' if bound.upper else 'below'} {limit}"
