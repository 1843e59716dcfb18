"""Live table of devices in the terminal, which lists devices with problems first.

The functions return objects of the package rich, which renders them. The table uses the most detailed layout that fits
the terminal. In a terminal with fewer than 100 columns, each device has three lines, one for each axis. In a wider
terminal, each device has one line. Each state has a word and a symbol in addition to the colour. If there is only one
device and the terminal has enough lines, the Allan deviations are drawn below the coefficients.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from monitor.common.control_characters import remove_control_characters
from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KINDS,
    NO_VALUE,
    CoefficientColumn,
    Kind,
    UnitSystem,
    axes_of,
    format_age,
    format_count,
    format_duration,
    format_number,
    format_short_count,
)
from monitor.estimation.allan.curve import AllanCurve
from monitor.publishing.coefficient_cells import format_coefficient
from monitor.publishing.messages.results import EventMessage
from monitor.publishing.remote_device_states import (
    MAX_DEVICES,
    MAX_EVENTS,
    DeviceCoefficients,
    RemoteDevice,
    RemoteDeviceRegistry,
)
from monitor.publishing.terminal.allan_chart import allan_charts
from monitor.publishing.terminal.coefficient_tables import coefficient_tables
from monitor.publishing.terminal.tables import plain_table, unwrapped_table_width

MAX_PROBLEM_LINES: Final = 6
HEADER_LINES: Final = 6
"""Number of lines for the summary, the note, the table header and blank lines."""
MIN_ROWS: Final = 3
TABLE_COEFFICIENTS: Final[dict[Kind, str]] = {"gyro": "NB", "accel": "N"}
"""Symbols of the coefficients shown in the device table, for each kind of sensor."""
STATES: Final = {
    "running": ("●", "green"),
    "waiting": ("◌", "yellow"),
    "present": ("○", "yellow"),
    "lost": ("✖", "bold red"),
    "gone": ("✖", "bold red"),
    "silent": ("?", "bold red"),
    "ended": ("■", "cyan"),
}
"""Symbol and colour of each device state."""
UNKNOWN_STATE_STYLE: Final = ("?", "yellow")
RUNNING_PROBLEM_STYLE: Final = ("!", "yellow")


@dataclass(frozen=True, slots=True)
class DeviceTableLayout:
    """Layout of the device table with a certain level of detail."""

    digits: int
    full_counts: bool
    stacked: bool  # True if each axis has a separate line
    gap: int  # number of blanks between columns
    brief: bool = False  # True to omit the latency, the age and all counts except the lost samples


LAYOUTS: Final = (
    DeviceTableLayout(3, True, False, 2),
    DeviceTableLayout(3, False, False, 1),
    DeviceTableLayout(2, False, False, 1),
)
NARROW_LAYOUTS: Final = (DeviceTableLayout(3, False, True, 1), DeviceTableLayout(3, False, True, 1, brief=True))
FILE_CHART_LINES: Final = 12
"""Number of lines of the chart in a file."""


class LiveTable:
    """Renderer of the device table for a ``QueuedWriter``.

    If the output is a terminal, the table is redrawn in place. Otherwise, the table is printed once.

    Parameters
    ----------
    console : Console
        Console with the width, height and colours of the terminal.
    states : RemoteDeviceRegistry or None
        State of all devices. If None, only log lines are written.
    units : UnitSystem, optional
        Units of the table.
    begun_s : float, optional
        Start of the service on the monotonic clock [s], whose running time the last table states.
    """

    def __init__(
        self,
        console: Console,
        states: RemoteDeviceRegistry | None = None,
        units: UnitSystem = DEFAULT_UNITS,
        begun_s: float | None = None,
    ) -> None:
        self.states = states
        self._begun_s = begun_s
        self._units = units
        self._console = console
        self._live: Live | None = None
        self._ended = False

    def render(self, log_lines: Sequence[str], is_last: bool) -> str:
        """Return text with control codes that prints log lines above the table and redraws the table.

        Parameters
        ----------
        log_lines : sequence of str
            Lines of the log, with colours as ANSI codes.
        is_last : bool
            True to print the final table and make the cursor visible again.
        """
        with self._console.capture() as captured:
            if self.states is not None and self._live is None and self._console.is_terminal and not is_last:
                live = Live(
                    console=self._console,
                    auto_refresh=False,
                    transient=True,
                    redirect_stdout=False,
                    redirect_stderr=False,
                )
                live.start()
                self._live = live
            if log_lines:
                self._console.print(Text.from_ansi("".join(log_lines)))
            if not is_last and self._live is not None and self.states is not None:
                overview = device_overview(self.states, time.monotonic(), self._units)
                # The blank line receives the ^C that the terminal prints, which would wrap after a full last line.
                self._live.update(Group(overview, Text()), refresh=True)
            if is_last and not self._ended:
                self._ended = True
                if self._live is not None:
                    self._live.stop()
                if self.states is not None:
                    now_s = time.monotonic()
                    ran_s = None if self._begun_s is None else now_s - self._begun_s
                    self._console.print(device_overview(self.states, now_s, self._units, ran_s))
        return captured.get()


def device_overview(
    states: RemoteDeviceRegistry, now_s: float, units: UnitSystem = DEFAULT_UNITS, ran_s: float | None = None
) -> RenderableType:
    """Return a summary, the device table, problems and events. For a single device, add coefficients and a chart.

    Parameters
    ----------
    states
        State of all devices.
    now_s
        Current time [s] on the clock of ``states``.
    units
        Units of the coefficients.
    ran_s
        Running time of a service that has ended [s].
    """
    devices, events = states.devices_with_problems_first(now_s), states.recent_events_in_time_order()
    names = _display_names([*(one.key for one in devices), *(key for key, _ in events)])
    head: list[RenderableType] = [_summary(states, devices, now_s, ran_s)]
    if devices:
        head.append(_FittedDeviceRows(devices, now_s, units))
    head += _with_blank_line(_problem_lines(devices, now_s))
    tail = _with_blank_line([_event_line(names[key], event) for key, event in events])
    if len(devices) == 1 and devices[0].coefficients is not None:
        return _SingleDeviceOverview(head, devices[0].coefficients, devices[0].curve, tail, units)
    return Group(*head, *tail)


@dataclass(frozen=True, slots=True)
class _SingleDeviceOverview:
    """Overview of one device with the most detailed coefficients and the largest chart that fit the terminal."""

    head: list[RenderableType]
    coefficients: DeviceCoefficients
    curve: AllanCurve | None
    tail: list[RenderableType]
    units: UnitSystem

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        def render(parts: Sequence[RenderableType]) -> list[list[Segment]]:
            return console.render_lines(Group(*parts), options, pad=False) if parts else []

        tail, height = render(self.tail), console.size.height
        for with_intervals in (True, False):
            tables = coefficient_tables(self.coefficients, units=self.units, with_intervals=with_intervals)
            lines = render([*self.head, *_with_blank_line(tables)])
            if not console.is_terminal or len(lines) + len(tail) < height:
                break
        space = height - len(lines) - len(tail) - 2 if console.is_terminal else FILE_CHART_LINES
        chart = None if self.curve is None else allan_charts(self.curve, self.units, options.max_width, space)
        lines += render(_with_blank_line([] if chart is None else [chart])) + tail
        for line in lines:
            yield from line
            yield Segment.line()


class _FittedDeviceRows:
    """Device table that chooses the most detailed layout that fits the terminal."""

    def __init__(self, devices: list[RemoteDevice], now_s: float, units: UnitSystem) -> None:
        self._devices = devices
        self._now_s = now_s
        self._units = units

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for layout in (*LAYOUTS, *NARROW_LAYOUTS):
            count = self._visible_rows(layout, console)
            table = _device_rows(self._devices[:count], self._now_s, layout, self._units)
            if unwrapped_table_width(table, console, options) <= options.max_width:
                break
        yield table
        if len(self._devices) > count:
            yield Text(f"… and {len(self._devices) - count} more with fewer problems", style="dim")

    def _visible_rows(self, layout: DeviceTableLayout, console: Console) -> int:
        """Return the number of rows that fit the terminal. Without a terminal, the number is not limited."""
        if not console.is_terminal:
            return len(self._devices)
        lines = console.size.height - MAX_EVENTS - MAX_PROBLEM_LINES - HEADER_LINES
        return max(lines // (3 if layout.stacked else 1), MIN_ROWS)


def _device_rows(devices: Sequence[RemoteDevice], now_s: float, layout: DeviceTableLayout, units: UnitSystem) -> Table:
    table = plain_table("device", "state", gap=layout.gap)
    columns = [
        _coefficient_column(devices, kind, column, layout)
        for kind in KINDS
        if any(_measures(one, kind) for one in devices)
        for symbol in TABLE_COEFFICIENTS[kind]
        for column in units.columns(kind, symbol)[-1:]  # of random walk and noise density, only the density
    ]
    if layout.stacked and columns:
        columns.insert(0, (Text(), [Text("x\ny\nz" if one.coefficients else "", style="bold") for one in devices]))
    counts = ("Hz", "lost") if layout.brief else ("Hz", "received", "lost", "bad")
    for head in (*counts, *(title for title, _ in columns), *(() if layout.brief else ("p99 ms", "age"))):
        table.add_column(head, justify="right", no_wrap=True)
    names = _display_names([one.key for one in devices])
    for i, one in enumerate(devices):
        cells = [Text(names[one.key], style="bold"), _state_cell(one.state(now_s)), *_count_cells(one, layout)]
        cells += [column[i] for _, column in columns]
        if not layout.brief:
            cells += [_latency_cell(one), Text(format_age(now_s - one.last_message_s))]
        table.add_row(*cells)
    return table


def _display_names(keys: Sequence[str]) -> dict[str, str]:
    """Return the last part of each device key if all keys have the same prefix, and the whole keys otherwise."""
    short = len({key.rpartition("/")[0] for key in keys}) == 1
    return {key: remove_control_characters(key.rpartition("/")[2] if short else key) for key in keys}


def _summary(states: RemoteDeviceRegistry, devices: list[RemoteDevice], now_s: float, ran_s: float | None) -> Text:
    line = Text("imu-monitor" if ran_s is None else f"imu-monitor ran for {format_duration(ran_s)}", style="bold")
    line.append(f"  {format_count(len(devices), 'device')}", style="not bold")
    for state, count in Counter(one.state(now_s) for one in devices).items():
        symbol, colour = STATES.get(state, UNKNOWN_STATE_STYLE)
        line.append(f"  {symbol} {count} {state}", style=f"not bold {colour}")
    if states.malformed:
        line.append(f"  {format_count(states.malformed, 'malformed message')}", style="not bold yellow")
    if states.ignored:
        line.append(
            f"  {states.ignored:,} messages of more than {MAX_DEVICES:,} devices ignored", style="not bold yellow"
        )
    if states.note and ran_s is None:
        line.append(f"\n{states.note}", style="not bold yellow")
    return line


def _state_cell(state: str) -> Text:
    symbol, colour = STATES.get(state, UNKNOWN_STATE_STYLE)
    return Text(f"{symbol} {state}", style=colour)


def _count_cells(one: RemoteDevice, layout: DeviceTableLayout) -> list[Text]:
    if one.status is None:
        return [Text(NO_VALUE, style="dim")] * (2 if layout.brief else 4)
    rate = NO_VALUE if one.status.rate_hz is None else format_number(one.status.rate_hz, 4)
    write = "{:,}".format if layout.full_counts else format_short_count
    lost, bad = (Text(write(count), style="yellow" if count else "dim") for count in (one.status.lost, one.status.bad))
    return [Text(rate), lost] if layout.brief else [Text(rate), Text(write(one.status.received)), lost, bad]


def _latency_cell(one: RemoteDevice) -> Text:
    p99_s = None if one.status is None else one.status.latency.p99
    return Text(NO_VALUE, style="dim") if p99_s is None else Text(format_number(p99_s * 1e3, 2))


def _measures(one: RemoteDevice, kind: Kind) -> bool:
    return one.coefficients is not None and bool(set(axes_of(kind)) & set(one.coefficients.axes))


def _coefficient_column(
    devices: Sequence[RemoteDevice], kind: Kind, column: CoefficientColumn, layout: DeviceTableLayout
) -> tuple[Text, list[Text]]:
    axes = axes_of(kind)
    rows = [[_value(one, column, axis, layout.digits) for axis in axes] for one in devices]
    head = f"{column.symbol} {column.unit.name}"
    if layout.stacked:
        return Text(head), [Text("\n".join(row) if any(row) else "") for row in rows]
    widths = [max(map(len, cells)) for cells in zip(axes, *rows, strict=True)]
    lines = [
        " ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in [list(axes), *rows]
    ]
    return Text(f"{head}\n{lines[0]}"), [Text(line) for line in lines[1:]]


def _value(one: RemoteDevice, column: CoefficientColumn, axis: str, digits: int) -> str:
    if one.coefficients is None or axis not in one.coefficients.axes:
        return ""
    text = format_coefficient(one.coefficients.coefficients, column.symbol, axis, digits, column.unit)
    return text.value.replace("≤ ", "≤")


def _with_blank_line(lines: Sequence[RenderableType]) -> list[RenderableType]:
    return [Text(), *lines] if lines else []


def _problem_lines(devices: Sequence[RemoteDevice], now_s: float) -> list[Text]:
    names = _display_names([one.key for one in devices])
    lines = []
    for one in devices:
        state, problems = one.state(now_s), one.describe_device_problems()
        if one.sends_nothing(now_s):
            since = _local_time(time.time() - (now_s - one.last_message_s))
            what = "the daemon has ended or cannot be reached" if state == "gone" else "no messages"
            problems = "; ".join(filter(None, [f"{what} since {since}", problems]))
        if problems:
            symbol, colour = RUNNING_PROBLEM_STYLE if state == "running" else STATES.get(state, UNKNOWN_STATE_STYLE)
            lines.append(Text.assemble((f"{symbol} {names[one.key]}  ", colour), problems))
    if len(lines) > MAX_PROBLEM_LINES:
        more = len(lines) - MAX_PROBLEM_LINES + 1
        lines = [*lines[: MAX_PROBLEM_LINES - 1], Text(f"… and {more} more with problems", style="dim")]
    return lines


def _event_line(name: str, event: EventMessage) -> Text:
    return Text.assemble((f"{_local_time(event.t or 0.0)}  ", "dim"), (f"{name}  ", "bold"), event.text)


def _local_time(unix_s: float) -> str:
    """Format a Unix time as local time of day, or as seconds if it is not a valid date."""
    try:
        return f"{datetime.fromtimestamp(unix_s).astimezone():%H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return f"{unix_s:g} s"
