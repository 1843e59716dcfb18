"""Metrics of the newest status and estimate of each device, for the outputs to Prometheus and InfluxDB.

All values are in SI units. A coefficient with only an upper bound has ``hi`` and no value. A coefficient that is not
estimated has no entry.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from drivers.data_types import AXES, Event
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.noise.effect import gyro_and_accel_units
from monitor.noise.standard_terms import STANDARD_TERMS

STATES: Final = ("running", "waiting", "lost", "ended")
"""Possible states of a device."""
_GYRO_UNITS: Final = ", ".join(
    f"{symbol} {gyro_and_accel_units(term)[symbol][0]}" for symbol, term in STANDARD_TERMS.items()
)
UNITS: Final = f"gyroscopes {_GYRO_UNITS}; accelerometers with m/s for rad"
"""Units of the coefficients in the descriptions."""

Numbers = Callable[[Health], float | None]
"""Function that reads one value from the health of a device."""

COUNTERS: Final[dict[str, tuple[str, Numbers]]] = {
    "received": ("Samples received", lambda one: one.received),
    "lost": ("Samples missing on the wire", lambda one: one.lost),
    "bad": ("Samples rejected because of a failed check or an impossible value", lambda one: one.bad),
    "overflowed": ("Samples overwritten before they were used", lambda one: one.overflowed),
    "repeated": ("Repeated samples, which were discarded", lambda one: one.repeated),
    "late": ("Samples that arrived too late and were discarded", lambda one: one.late),
}
"""Descriptions and values of the counters ``imu_monitor_samples_<name>_total``."""
GAUGES: Final[dict[str, tuple[str, Numbers]]] = {
    "sample_rate_hertz": ("Measured sample rate", lambda one: one.rate_hz),
    "uptime_seconds": ("Time since the device was started", lambda one: one.uptime_s),
    "moving": ("1 while the device is moved", lambda one: float(one.moving)),
    "limits_crossed": ("Number of crossed user limits", lambda one: float(len(one.crossed))),
}
"""Descriptions and values of the gauges ``imu_monitor_<name>``."""


class LabelledValue(NamedTuple):
    """Value of a metric for one combination of label values."""

    label_values: tuple[str, ...]
    value: float
    unix_s: float | None  # time of the status or estimate; None if unknown


@dataclass(frozen=True, slots=True)
class NamedMetric:
    """Current values of one metric."""

    name: str
    description: str
    labels: tuple[str, ...]
    values: tuple[LabelledValue, ...]  # finite values only
    is_counter: bool


class _TimedHealth(NamedTuple):
    health: Health
    unix_s: float | None


class _TimedEstimate(NamedTuple):
    estimate: Estimate
    unix_s: float


class NewestMetrics(Output):
    """Base class of the outputs that report the newest status, estimate and event counts of each device."""

    def __init__(self) -> None:
        self._healths: dict[str, _TimedHealth] = {}
        self._estimates: dict[str, _TimedEstimate] = {}
        self._events: Counter[tuple[str, str]] = Counter()

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Store the newest estimate of a device."""
        if isinstance(result, Estimate):
            self._estimates[device] = _TimedEstimate(result, unix_s)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Count an event of a device."""
        self._events[device, event.kind] += 1

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Store the newest status of a device."""
        self._healths[device] = _TimedHealth(health, unix_s)

    def remove_device(self, device: str) -> None:
        """Remove the stored values of a device."""
        self._healths.pop(device, None)
        self._estimates.pop(device, None)
        for key in [key for key in self._events if key[0] == device]:
            del self._events[key]

    def read_metrics(self) -> Iterator[NamedMetric]:
        """Yield all current metrics. Another thread may call this method."""
        healths, estimates, events = dict(self._healths), dict(self._estimates), dict(self._events)
        yield from _device_metrics(healths)
        yield from _process_metrics(healths)
        yield from _coefficient_metrics(estimates)
        counts = (
            ((device, kind), count, healths[device].unix_s if device in healths else None)
            for (device, kind), count in events.items()
        )
        yield _metric("events_total", "Number of events", ("device", "kind"), counts, is_counter=True)


def _device_metrics(healths: Mapping[str, _TimedHealth]) -> Iterator[NamedMetric]:
    def read_health_value_of_each_device(read: Numbers) -> Iterator[tuple[tuple[str, ...], float | None, float | None]]:
        return (((device,), read(one.health), one.unix_s) for device, one in healths.items())

    for name, (description, read) in COUNTERS.items():
        yield _metric(
            f"samples_{name}_total", description, ("device",), read_health_value_of_each_device(read), is_counter=True
        )
    for name, (description, read) in GAUGES.items():
        yield _metric(name, description, ("device",), read_health_value_of_each_device(read))
    states = (
        ((device, state), float(one.health.state == state), one.unix_s)
        for device, one in healths.items()
        for state in STATES
    )
    yield _metric("state", "1 for the present state of the device", ("device", "state"), states)
    latencies = (
        ((device, quantile), latency_s, one.unix_s)
        for device, one in healths.items()
        for quantile, latency_s in (("0.5", one.health.latency_p50_s), ("0.99", one.health.latency_p99_s))
    )
    description = "Latency from reception to publication, over the last second"
    yield _metric("latency_seconds", description, ("device", "quantile"), latencies)


def _process_metrics(healths: Mapping[str, _TimedHealth]) -> Iterator[NamedMetric]:
    if not healths:
        return
    newest, unix_s = list(healths.values())[-1]
    yield _metric("memory_bytes", "Resident memory of the service", (), [((), newest.memory_bytes, unix_s)])
    working = (
        ((output,), float(state == "ok" or state.startswith("ok,")), unix_s)
        for output, state in newest.outputs.items()
        if state != "off"
    )
    yield _metric("output_up", "1 while the output works", ("output",), working)


def _coefficient_metrics(estimates: Mapping[str, _TimedEstimate]) -> Iterator[NamedMetric]:
    for name, meaning in (
        ("value", "of the window"),
        ("lo", "lower end of the 95 % interval"),
        ("hi", "upper end of the 95 % interval, or the one-sided 95 % bound if there is no value"),
    ):
        coefficients = (
            ((device, axis, letter), getattr(one.estimate.coefficients, name)[row, column], one.unix_s)
            for device, one in estimates.items()
            for column, axis in enumerate(AXES)
            for row, letter in enumerate(SYMBOLS)
        )
        full_name = "coefficient" if name == "value" else f"coefficient_{name}"
        description = f"Coefficient of IEEE Std 952, {meaning}; SI: {UNITS}"
        yield _metric(full_name, description, ("device", "axis", "letter"), coefficients)


def _metric(
    name: str,
    description: str,
    labels: tuple[str, ...],
    values: Iterable[tuple[tuple[str, ...], float | None, float | None]],
    is_counter: bool = False,
) -> NamedMetric:
    """Return a metric without unknown and non-finite values."""
    known = tuple(
        LabelledValue(label_values, float(value), unix_s)
        for label_values, value, unix_s in values
        if value is not None and np.isfinite(value)
    )
    return NamedMetric(f"imu_monitor_{name}", description, labels, known, is_counter)
