"""Markdown text of the viewer panels, with device states, noise coefficients and tables of devices."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from monitor.common.device_health import Health
from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KIND_NAMES,
    KINDS,
    Kind,
    Unit,
    UnitSystem,
    axes_of,
    format_duration,
    format_milliseconds,
    format_number,
    format_sample_rate,
)
from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.publishing.coefficient_cells import format_coefficient
from monitor.publishing.messages.message import remove_control_characters
from monitor.publishing.messages.results import measured_axes
from monitor.publishing.remote_device_states import RemoteDevice

FLEET_AXES: Final = ("gx", "gy", "gz")
"""Axes whose angle random walk N is shown in the table of all devices."""
LINE_BREAK: Final = "  \n"
"""Line break of Markdown, which needs less space than a new paragraph."""
STATE_TEXTS: Final = {
    "running": "RUNNING",
    "waiting": "WAITING for the device",
    "lost": "LOST: no connection",
    "ended": "ENDED: the end of the recording was reached",
}


def health_text(device: str, health: Health, about: str = "") -> str:
    """Return Markdown text with the state and the sample counts of one device.

    Parameters
    ----------
    device
        Name of the device.
    health
        State and sample counts of the device.
    about
        Short description of the device.
    """
    unknown = "no samples" if health.state == "lost" else "rate not known yet"
    rate = unknown if health.rate_hz is None else f"{health.rate_hz:.2f} Hz"
    lines = [f"**{device}** {about}".rstrip() + f", **{rate}**", f"## {STATE_TEXTS.get(health.state, health.state)}"]
    if health.text:
        lines.append(f"**{health.text}**")
    if health.crossed:
        lines.append(f"limits exceeded: **{', '.join(health.crossed)}**")
    lines.append(
        f"received **{health.received:,}**, lost **{health.lost:,}**, bad **{health.bad:,}**, "
        f"overflowed **{health.overflowed:,}**"
    )
    outputs = "".join(f", {name} **{state}**" for name, state in health.outputs.items())
    lines.append(f"up **{format_duration(health.uptime_s)}**{outputs}")
    lines.append(
        f"latency **{format_milliseconds(health.latency_p50_s)}** median, "
        f"**{format_milliseconds(health.latency_p99_s)}** at 99 %, memory **{health.memory_bytes / 1e6:.0f} MB**"
    )
    return "\n".join([*lines[:2], LINE_BREAK.join(lines[2:])])


def overview_text(healths: Mapping[str, Health]) -> str:
    """Return a Markdown table of several devices with one line for each device."""
    rows = [
        f"| **{name}** | {h.state} | {format_sample_rate(h.rate_hz)} | {h.received:,} | {h.lost:,} | {h.bad:,} "
        f"| {h.text or 'no problem'} |"
        for name, h in healths.items()
    ]
    head = "| device | state | rate | received | lost | bad | |\n|:--|:--|--:|--:|--:|--:|:--|"
    return "\n".join([head, *rows])


def fleet_text(
    devices: Sequence[RemoteDevice], now_s: float, rows: int, note: str = "", units: UnitSystem = DEFAULT_UNITS
) -> str:
    """Return Markdown text with a table of many devices and the number of devices in each state.

    Parameters
    ----------
    devices
        Devices in the order of the table rows.
    now_s
        Current time [s] on the monotonic clock that gives the age of messages.
    rows
        Largest number of table rows.
    note
        Line of text above the table.
    units
        Units of the noise coefficients.
    """
    counts = Counter(one.state(now_s) for one in devices)
    states = ", ".join(f"**{count:,}** {_escape_cell(state)}" for state, count in counts.most_common())
    unit = units.single("gyro", "N")
    head = [f"**{len(devices):,}** device{'' if len(devices) == 1 else 's'}{': ' if states else ''}{states}"]
    head[0] += f"; N in {unit.name}" if devices else ""
    head += [f"**{remove_control_characters(note)}**"] if note else []
    table = [_fleet_row(one, now_s, unit) for one in devices[:rows]]
    if table:
        columns = [*("device", "state", "rate", "received", "lost", "bad"), *(f"N {axis}" for axis in FLEET_AXES), ""]
        table = [f"| {' | '.join(columns)} |", "|:--|:--|" + "--:|" * (len(columns) - 3) + ":--|", *table]
    left = [f"… and {len(devices) - rows:,} more with fewer problems"] if len(devices) > rows else []
    return "\n\n".join([*head, *(["\n".join(table)] if table else []), *left])


def _fleet_row(one: RemoteDevice, now_s: float, unit: Unit) -> str:
    state, status = one.state(now_s), one.status
    name = _escape_cell(one.key)
    state_text = f"**{state.upper()}**" if one.problems_first_rank(now_s) == 0 else _escape_cell(state)
    noise = [
        ""
        if one.coefficients is None
        else format_coefficient(one.coefficients.coefficients, "N", axis, unit=unit).value
        for axis in FLEET_AXES
    ]
    if status is None:
        return f"| **{name}** | {state_text} | | | | | {' | '.join(noise)} | no data yet |"
    rate = format_sample_rate(status.rate_hz)
    problems = _escape_cell(one.describe_device_problems()) or (
        f"no data for {now_s - one.last_message_s:.1f} s" if state in ("gone", "silent") else ""
    )
    counts = f"{status.received:,} | {status.lost:,} | {status.bad:,}"
    return f"| **{name}** | {state_text} | {rate} | {counts} | {' | '.join(noise)} | {problems} |"


def _escape_cell(text: str) -> str:
    """Escape text from another process, which could otherwise end a table cell or form a link."""
    return re.sub(r"([\\`*_\[\]<>!|#])", r"\\\1", remove_control_characters(text))


def noise_text(estimate: Estimate, units: UnitSystem = DEFAULT_UNITS) -> str:
    """Return Markdown tables with Q, N, B, K and R of the gyroscopes and of the accelerometers.

    Parameters
    ----------
    estimate
        Estimate with the noise coefficients.
    units
        Unit system.
    """
    present = [axis for _, axis in measured_axes(estimate.curve)]
    tables = [_noise_table(estimate, kind, units) for kind in KINDS if set(axes_of(kind)) & set(present)]
    if not tables:
        return "Too few samples yet."
    seen_s = estimate.curve.n / estimate.rate_hz
    head = f"Last **{format_duration(min(seen_s, estimate.window_s))}**, 95 % intervals; ≤ bound; — too few data"
    poor = ", ".join(estimate.poorly_fitted_axes)
    note = [f"**{poor}: the fit does not describe the curve**, so these coefficients are uncertain"] if poor else []
    return "\n\n".join([head, *note, *tables])


def drift_text(update: MeasuredAndSubtractedDrift, units: UnitSystem) -> str:
    """Return a Markdown table with the drift models of the gyroscopes and the drift that is currently subtracted.

    Parameters
    ----------
    update
        Newest measured and predicted drift.
    units
        Unit system.
    """
    unit = units.deviation("gyro")
    rows = ["| axis | drift now | model | φ₁ | φ₂ | θ₁ |", "|---|---|---|---|---|---|"]
    for at, axis in enumerate(axes_of("gyro")):
        expected, model = float(update.expected[at]), update.models[at]
        if not math.isfinite(expected):
            rows.append(f"| {axis} | no estimate yet | | | | |")
            continue
        error = format_number(1.96 * unit.factor * float(update.error[at]), 2)
        now = f"{format_number(unit.factor * expected)} ± {error} {unit.name}"
        if model is None:
            rows.append(f"| {axis} | {now} | learning | | | |")
            continue
        parts = [
            f"{x:.4f}" if there else ""
            for x, there in zip((*model.phi, model.theta), _coefficients_in_model(model), strict=True)
        ]
        rows.append(f"| {axis} | {now} | {model.name} | {' | '.join(parts)} |")
    interval = format_duration(update.interval_s)
    head = f"Learned at rest from means of {interval}. The innovation is the part of a mean that was not predicted."
    return "\n".join([head, "", *rows])


def _coefficients_in_model(model: ArmaModel) -> tuple[bool, bool, bool]:
    """Return three flags that are True if φ₁, φ₂ and θ₁ are part of the ARMA model."""
    return model.order[0] > 0, model.order[0] > 1, model.order[1] > 0


def _noise_table(estimate: Estimate, kind: Kind, units: UnitSystem) -> str:
    axes = axes_of(kind)
    lines = [f"| {KIND_NAMES[kind]} | {' | '.join(axes)} |", "|:--|" + "--:|" * len(axes)]
    for symbol, _, unit in units.columns(kind, SYMBOLS):
        cells = [format_coefficient(estimate.coefficients, symbol, axis, unit=unit) for axis in axes]
        values = " | ".join(f"**{c.value}**" if c.value != "—" else "—" for c in cells)
        lines.append(f"| **{symbol}** {unit.name} | {values} |")
        if any(c.interval for c in cells):
            lines.append("| | " + " | ".join(c.interval for c in cells) + " |")
    return "\n".join(lines)
