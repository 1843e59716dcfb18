"""Diagnostic status of a device for ROS 2, in the SI units of REP 103, as a message of ``diagnostic_msgs``.

The message ``diagnostic_msgs/msg/DiagnosticArray`` is encoded as XCDR1 (OMG DDSI-RTPS 10.5). Every integer is aligned
to its size, counted from the end of the encapsulation.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from drivers.data_types import AXES, Event
from drivers.zenoh.ros2_imu_message import LITTLE_ENDIAN, S_TO_NS
from monitor.common.device_health import Health
from monitor.common.unit_formatting import UNIT_SYSTEMS, format_number, format_utc, sensor_kind
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status
from monitor.publishing.coefficient_cells import format_coefficient
from monitor.publishing.ros2.rmw_zenoh_names import NODE


class Level(IntEnum):
    """Level of a diagnostic status."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """Status of one device, as in ``diagnostic_msgs/msg/DiagnosticStatus``."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: Sequence[tuple[str, str]]  # keys and values


def encode_diagnostic_array(t_ns: int, statuses: Sequence[DiagnosticStatus]) -> bytes:
    """Return a little-endian message with an empty frame_id.

    Parameters
    ----------
    t_ns
        Time of the status in nanoseconds since 1970.
    statuses
        Status of each device.
    """
    body = bytearray(struct.pack("<iI", *divmod(t_ns, S_TO_NS)))
    _append_text(body, "")
    _append_count(body, len(statuses))
    for one in statuses:
        body.append(one.level)
        for text in (one.name, one.message, one.hardware_id):
            _append_text(body, text)
        _append_count(body, len(one.values))
        for pair in one.values:
            for text in pair:
                _append_text(body, text)
    return LITTLE_ENDIAN + bytes(body)


def _append_count(body: bytearray, count: int) -> None:
    body += bytes(-len(body) % 4) + struct.pack("<I", count)


def _append_text(body: bytearray, text: str) -> None:
    encoded = text.encode("utf-8", "replace") + b"\0"
    _append_count(body, len(encoded))
    body += encoded


COEFFICIENTS: Final = ("N", "B", "K")
"""Coefficients in the diagnostics. Filters use these coefficients as process and measurement noise."""
RATE_DIGITS: Final = 6
LEVELS: Final = {"waiting": Level.STALE, "lost": Level.ERROR, "ended": Level.STALE}
"""Level of each state in which no samples arrive."""


def build_device_status(
    device: str, health: Health, coefficients: Coefficients | None, event: Event | None, event_unix_s: float
) -> DiagnosticStatus:
    """Return the diagnostic status of a device.

    The level is OK while samples arrive, and WARN if there is also a message or a crossed limit. The level is ERROR if
    the link is lost, and STALE before the first sample and after the end of a replay.

    Parameters
    ----------
    device
        Name of the device.
    health
        Newest status of the device.
    coefficients
        Newest noise coefficients, or None if there are none yet.
    event
        Newest event, or None if there was none.
    event_unix_s
        Unix time of the event in seconds.
    """
    problems = [health.text] if health.text else []
    problems += [f"crossed limits: {', '.join(health.crossed)}"] if health.crossed else []
    level = LEVELS.get(health.state, Level.WARN if problems else Level.OK)
    values = [("state", health.state), *_sample_values(health)]
    if coefficients is not None:
        values += _coefficient_values(coefficients)
    if event is not None:
        values += [("last event", f"{event.kind}: {event.text}"), ("last event time (UTC)", format_utc(event_unix_s))]
    return DiagnosticStatus(level, f"{NODE}: {device}", "; ".join(problems) or health.state, device, values)


def _sample_values(health: Health) -> Iterator[tuple[str, str]]:
    if health.rate_hz is not None:
        yield "rate (Hz)", format_number(health.rate_hz, RATE_DIGITS)
    yield "received (samples)", str(health.received)
    yield "lost (samples)", str(health.lost)
    yield "bad (samples)", str(health.bad)
    if health.loss.share > 0.0:
        yield "missing samples", health.loss.describe()
    yield "moving", str(health.moving)


def _coefficient_values(coefficients: Coefficients) -> Iterator[tuple[str, str]]:
    """Yield the estimated coefficients and upper bounds of all axes."""
    for symbol in COEFFICIENTS:
        for column, axis in enumerate(AXES):
            if coefficients.status[SYMBOLS.index(symbol), column] != Status.UNESTIMATED:
                unit = UNIT_SYSTEMS["si"].coefficients[sensor_kind(axis)][symbol]
                yield f"{symbol} {axis} ({unit.name})", format_coefficient(coefficients, symbol, axis, unit=unit).value
