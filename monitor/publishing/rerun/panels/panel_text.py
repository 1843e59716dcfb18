"""Markdown text of the viewer panels, with device states, noise coefficients and tables of devices."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from monitor.common.control_characters import remove_control_characters
from monitor.common.device_health import Health
from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KINDS,
    NO_VALUE,
    SHORT_KIND_NAMES,
    Kind,
    Unit,
    UnitSystem,
    axes_of,
    format_duration,
    format_milliseconds,
    format_number,
    format_sample_rate,
    format_utc,
)
from monitor.drift.compensation.arma import ArmaModel
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients
from monitor.publishing.coefficient_cells import format_coefficient, format_relative_interval
from monitor.publishing.messages.results import measured_axes
from monitor.publishing.remote_device_states import RemoteDevice

FLEET_AXES: Final = ("gx", "gy", "gz")
"""Axes whose angle random walk N is shown in the table of all devices."""
MAX_SHOWN_PROBLEMS: Final = 4
"""Largest number of different problems above the table of all devices."""
PROGRESS_BAR: Final = re.compile(" ?[█░]+")
LINE_BREAK: Final = "  \n"
"""Line break of Markdown, which needs less space than a new paragraph."""
STATE_TEXTS: Final = {
    "running": "RUNNING",
    "waiting": "WAITING for the device",
    "lost": "LOST: no connection",
    "ended": "ENDED: end of the recording",
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
    unknown = "no samples" if health.state in ("lost", "ended") else "rate not known yet"
    rate = unknown if health.rate_hz is None else f"{health.rate_hz:.2f} Hz"
    lines = [f"**{device}** {about}".rstrip() + f", **{rate}**", f"## {STATE_TEXTS.get(health.state, health.state)}"]
    if health.text:
        lines.append(f"**{escape_markdown(health.text)}**")
    if health.crossed:
        lines.append(f"limits exceeded: **{', '.join(health.crossed)}**")
    lines.append(
        f"received **{health.received:,}**, lost **{health.lost:,}**, bad **{health.bad:,}**, "
        f"overflowed **{health.overflowed:,}**"
    )
    if health.loss.share > 0.0:
        lines.append(health.loss.describe())
    memory = f"memory **{health.memory_bytes / 1e6:.0f} MB**"
    if health.latency_p50_s is not None:
        median, high = (format_milliseconds(one) for one in (health.latency_p50_s, health.latency_p99_s))
        memory = f"latency **{median}** median, **{high}** at 99 %, {memory}"
    lines.append(memory)
    outputs = "".join(f", {name} **{state}**" for name, state in health.outputs.items())
    lines.append(f"up **{format_duration(health.uptime_s)}**{outputs}")
    return "\n".join([*lines[:2], LINE_BREAK.join(lines[2:])])


def overview_text(healths: Mapping[str, Health]) -> str:
    """Return the problems of several devices, and a Markdown table with one line for each device."""
    problems = [(escape_markdown(name), escape_markdown(h.text)) for name, h in healths.items() if h.text]
    states = {name: f"**{h.state.upper()}**" if h.state == "lost" else h.state for name, h in healths.items()}
    rows = [
        f"| **{name}** | {states[name]} | {format_sample_rate(h.rate_hz)} | {h.received:,} | {h.lost:,} | {h.bad:,} |"
        for name, h in healths.items()
    ]
    head = "| device | state | rate | received | lost | bad |\n|:--|:--|--:|--:|--:|--:|"
    return "\n".join([*(_problem_list(problems) if problems else ["no problem", ""]), head, *rows])


def _problem_list(problems: Sequence[tuple[str, str]]) -> list[str]:
    """Return Markdown lines with the problems of devices, because the cells of a table do not wrap long texts."""
    devices: dict[str, list[str]] = {}  # by problem
    for name, text in problems:
        devices.setdefault(text, []).append(name)
    lines = [f"- **{', '.join(names)}**: {text}" for text, names in devices.items()]
    more = len(lines) - MAX_SHOWN_PROBLEMS
    return [*lines[:MAX_SHOWN_PROBLEMS], *([f"- … and {more:,} more problems"] if more > 0 else []), ""]


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
    states = ", ".join(f"**{count:,}** {escape_markdown(state)}" for state, count in counts.most_common())
    unit = units.single("gyro", "N")
    head = [f"**{len(devices):,}** device{'' if len(devices) == 1 else 's'}{': ' if states else ''}{states}"]
    head[0] += f"; N in {unit.name}" if devices else ""
    head[0] += f"{LINE_BREAK}**{remove_control_characters(note)}**" if note else ""
    table = [_fleet_row(one, now_s, unit) for one in devices[:rows]]
    if table:
        columns = [*("device", "state", "rate", "received", "lost", "bad"), *(f"N {axis}" for axis in FLEET_AXES)]
        table = [f"| {' | '.join(columns)} |", "|:--|:--|" + "--:|" * (len(columns) - 2), *table]
    found = ((escape_markdown(one.key), _fleet_problem(one, now_s)) for one in devices)
    problems = _problem_list([(name, text) for name, text in found if text])
    left = [f"… and {len(devices) - rows:,} more with fewer problems"] if len(devices) > rows else []
    return "\n\n".join([*head, *(["\n".join([*problems, *table])] if table else []), *left])


def _fleet_row(one: RemoteDevice, now_s: float, unit: Unit) -> str:
    state, status = one.state(now_s), one.status
    name = escape_markdown(one.key)
    state_text = f"**{state.upper()}**" if one.problems_first_rank(now_s) == 0 else escape_markdown(state)
    noise = [
        ""
        if one.coefficients is None
        else format_coefficient(one.coefficients.coefficients, "N", axis, unit=unit).value
        for axis in FLEET_AXES
    ]
    counts = " | | | "
    if status is not None:
        rate = format_sample_rate(status.rate_hz)
        counts = f"{rate} | {status.received:,} | {status.lost:,} | {status.bad:,}"
    return f"| **{name}** | {state_text} | {counts} | {' | '.join(noise)} |"


def _fleet_problem(one: RemoteDevice, now_s: float) -> str:
    """Return the problems of one device, or "" if there are none."""
    if one.status is None:
        return "no data yet"
    silent = f"no data for {now_s - one.last_message_s:.0f} s" if one.sends_nothing(now_s) else ""
    return escape_markdown(one.describe_device_problems()) or silent


def escape_markdown(text: str) -> str:
    """Escape text from another process, which could otherwise end a table cell or form a link.

    Progress bars are removed, because the font of the viewer does not contain their characters.

    >>> escape_markdown("imu_1: compiling 3 of 8: fit ███░░░; no sample is lost")
    'imu\\\\_1: compiling 3 of 8: fit; no sample is lost'
    """
    shown = PROGRESS_BAR.sub("", remove_control_characters(text))
    return re.sub(r"([\\`*_\[\]<>!|#])", r"\\\1", shown)


def events_text(lines: Sequence[tuple[float, str, str]]) -> str:
    """Return a Markdown list of events, newest first. Warnings and errors are bold.

    Parameters
    ----------
    lines
        Unix time [s], level and Markdown text of each event, in order of time. The level of information is "".
    """
    times = [format_utc(at_s)[5:] for at_s, _, _ in lines]  # without the year, to save space
    shown = [
        f"- **{time} {level}** {text}" if level else f"- {time} {text}"
        for time, (_, level, text) in zip(times, lines, strict=True)
    ]
    return "\n".join(reversed(shown))


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
    kinds = [kind for kind in KINDS if set(axes_of(kind)) & set(present)]
    if not kinds:
        return "Too few samples yet."
    seen_s = min(estimate.curve.n / estimate.rate_hz, estimate.window_s)
    head = f"Last **{format_duration(seen_s)}**; ± 95 % interval; ≤ bound; — too few data"
    poor = ", ".join(estimate.poorly_fitted_axes)
    note = [f"**{poor}: the fit does not describe the curve**, so these coefficients are uncertain"] if poor else []
    rows = [row for kind in kinds for row in _noise_rows(estimate, kind, units)]
    return "\n\n".join([head, *note, "\n".join([rows[0], "|:--|" + "--:|" * len(axes_of(kinds[0])), *rows[1:]])])


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


def _noise_rows(estimate: Estimate, kind: Kind, units: UnitSystem) -> list[str]:
    axes = axes_of(kind)
    rows = [[f"**{SHORT_KIND_NAMES[kind]}**", *(f"**{axis}**" for axis in axes)]]
    for symbol, _, unit in units.columns(kind, SYMBOLS):
        rows.append(
            [f"**{symbol}** {unit.name}", *(_noise_cell(estimate.coefficients, symbol, axis, unit) for axis in axes)]
        )
    return [f"| {' | '.join(row)} |" for row in rows]


def _noise_cell(coefficients: Coefficients, symbol: str, axis: str, unit: Unit) -> str:
    value = format_coefficient(coefficients, symbol, axis, unit=unit).value
    return (
        value if value == NO_VALUE else f"**{value}** {format_relative_interval(coefficients, symbol, axis)}".rstrip()
    )
