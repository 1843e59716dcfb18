"""Live table in the terminal: one row per device, devices with problems first.

The input are messages of ``monitor.common.topics``, received over zenoh (``watch``) or from this process (``run``,
``demo``). The output are rich renderables for any width. The most detailed layout that fits is used. At 160 columns a
device has one line with three digits, at 100 columns one line with two digits, and below that three lines, one per
axis. Each state has a word and a symbol in addition to its colour. Numbers have the units of
``monitor.common.units``.
"""

import contextlib
import copy
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final, TextIO, cast

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from drivers.quantities import HOUR_S
from monitor.common import topics
from monitor.common.units import COEFFICIENT_UNITS, KIND_NAMES, KINDS, Kind, axes_of, format_number
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.messages import remote_device
from monitor.publishing.messages.encoding import measured_axes
from monitor.publishing.messages.remote_device import RemoteDevice
from monitor.publishing.rerun.panels import format_duration
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.subscriber import KEYEXPR, ZenohSubscriber

REFRESH_PERIOD_S: Final = 0.5
MAX_DEVICES: Final = 20_000
"""Largest number of devices. A further device replaces one that has been silent for FORGET_S, or is ignored."""
FORGET_AFTER_S: Final = 600.0
MAX_KEY_LENGTH: Final = 200
SILENCE_NOTE_S: Final = 5.0
"""Time without any message after which the note says so, because access control refuses silently."""
STDOUT: Final = "standard output"
PLAIN_PERIOD_S: Final = 1.0
"""Interval between two tables if the output is not a terminal."""
EVENTS: Final = 5
MAX_TROUBLE_LINES: Final = 6
HEADER_LINES: Final = 6
"""Lines of the screen without a table row: summary, note, table head and blank lines."""
TABLE_COEFFICIENTS: Final[tuple[tuple[Kind, str], ...]] = (("gyro", "N"), ("gyro", "B"), ("accel", "N"))
NO_VALUE: Final = "—"
K_OR_R: Final = "K or R"
STATES: Final = {
    "running": ("●", "green"),
    "waiting": ("◌", "yellow"),
    "present": ("○", "yellow"),
    "lost": ("✖", "bold red"),
    "gone": ("✖", "bold red"),
    "silent": ("?", "bold red"),
    "ended": ("■", "cyan"),
}
"""Symbol and colour of each state."""
UNKNOWN_STATE_STYLE: Final = ("?", "yellow")


@dataclass(frozen=True, slots=True)
class Layout:
    """Level of detail of the table."""

    digits: int
    full_counts: bool
    stacked: bool  # True if each axis has a line of its own
    gap: int  # number of blanks between columns


LAYOUTS: Final = (Layout(3, True, False, 2), Layout(3, False, False, 1), Layout(2, False, False, 1))
NARROW_LAYOUT: Final = Layout(3, False, True, 1)


class DeviceStates:
    """State of all devices, updated from the messages of ``monitor.common.topics``; thread-safe.

    Parameters
    ----------
    clock
        Clock for the age of messages [s]; it must be the clock of ``now_s`` in ``table``.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.note = ""  # line above the table, e.g. which endpoints cannot be reached
        self.malformed = 0  # number of messages that could not be decoded
        self.passed_over = 0  # number of messages of devices beyond DEVICES
        self._clock = clock
        self._devices: OrderedDict[str, RemoteDevice] = (
            OrderedDict()
        )  # ordered by the time of the last message, oldest first
        self._events: deque[tuple[str, remote_device.EventMessage]] = deque(maxlen=EVENTS)
        self._lock = threading.Lock()

    def process_message(self, key: str, payload: bytes) -> None:
        """Process a message; other topics are ignored and malformed payloads are counted.

        Parameters
        ----------
        key
            Key of the message.
        payload
            Encoded message.
        """
        found = remote_device.split_key(key)
        if found is None:
            return
        device, topic = found
        with self._lock:
            try:
                self._decode(device, topic, payload)
            except ValueError:
                self.malformed += 1

    def set_token(self, key: str, there: bool) -> None:
        """Process the change of a liveliness token.

        Parameters
        ----------
        key
            Key of the token.
        there
            True if the token exists.
        """
        found = remote_device.split_key(key)
        if found is None or found[1] is not topics.ALIVE:
            return
        with self._lock:
            if known := self._device(found[0]):
                known.token_exists = there

    def remove(self, key: str) -> None:
        """Remove the row and the events of the device that ``key`` belongs to."""
        found = remote_device.split_key(key)
        if found is None:
            return
        with self._lock:
            self._devices.pop(found[0], None)
            for one in [one for one in self._events if one[0] == found[0]]:
                self._events.remove(one)

    def table(self, now_s: float) -> RenderableType:
        """Return a renderable of the complete table at time ``now_s`` [s]."""
        with self._lock:
            devices = [
                copy.copy(one) for one in self._sorted(now_s)
            ]  # copied, because messages arrive while it is drawn
            parts: list[RenderableType] = [self._summary(devices, now_s)]
            if devices:
                parts.append(FittedFleetTable(devices, now_s))
            parts += _with_blank_line(_troubles(devices, now_s))
            if len(devices) == 1 and devices[0].noise is not None:
                parts += _with_blank_line(_coefficient_tables(devices[0].noise))
            names = _names(list(self._devices))
            parts += _with_blank_line([_event(names[device], event) for device, event in self._events])
        return Group(*parts)

    def devices(self, now_s: float) -> list[RemoteDevice]:
        """Return all known devices, those with problems first."""
        with self._lock:
            return self._sorted(now_s)

    def _sorted(self, now_s: float) -> list[RemoteDevice]:
        """Return the devices sorted by severity and then by key."""
        return sorted(self._devices.values(), key=lambda one: (one.rank(now_s), one.key))

    def _decode(self, device: str, topic: topics.Topic, payload: bytes) -> None:
        """Decode a message and update the device; ValueError if it is malformed, in which case nothing changes."""
        if topic is topics.STATUS:
            status = remote_device.status(payload)
            if known := self._update_heard(device):
                known.status = status
        elif topic is topics.COEFFICIENTS:
            noise = remote_device.noise(remote_device.read(remote_device.CoefficientsMessage, topic, payload))
            if known := self._update_heard(device):
                known.noise = noise
        elif topic is topics.GAP:
            gap = remote_device.gap(payload)
            if known := self._update_heard(device):
                known.gap = gap
        elif topic is topics.EVENT:
            event = remote_device.event(payload)
            if self._update_heard(device):
                self._events.append((device, event))

    def _update_heard(self, device: str) -> RemoteDevice | None:
        """Return the state of a device and set the time of its newest message; None if the table is full."""
        known = self._device(device)
        if known is not None:
            known.last_message_s = self._clock()
            self._devices.move_to_end(device)
        return known

    def _device(self, device: str) -> RemoteDevice | None:
        """Return the state of a device, which is added if it is new; None if the table is full."""
        known = self._devices.get(device)
        if known is not None:
            return known
        now_s = self._clock()
        full = len(self._devices) >= MAX_DEVICES
        if len(device) > MAX_KEY_LENGTH or (
            full and now_s - next(iter(self._devices.values())).last_message_s < FORGET_AFTER_S
        ):
            self.passed_over += 1
            return None
        if full:
            self._devices.popitem(last=False)
        return self._devices.setdefault(device, RemoteDevice(device, now_s))

    def _summary(self, devices: list[RemoteDevice], now_s: float) -> Text:
        """Return the line above the table: number of devices by state, and the note."""
        line = Text("imu-monitor", style="bold")
        counts = Counter(one.state(now_s) for one in devices)
        line.append(f"  {len(devices)} device{'' if len(devices) == 1 else 's'}", style="not bold")
        for state, count in counts.items():
            sign, colour = STATES.get(state, UNKNOWN_STATE_STYLE)
            line.append(f"  {sign} {count} {state}", style=f"not bold {colour}")
        if self.malformed:
            line.append(
                f"  {self.malformed:,} malformed message{'' if self.malformed == 1 else 's'}", style="not bold yellow"
            )
        if self.passed_over:
            line.append(f"  {self.passed_over:,} of devices beyond {MAX_DEVICES:,}", style="not bold yellow")
        if self.note:
            line.append(f"\n{self.note}", style="not bold yellow")
        return line


class FittedFleetTable:
    """Renderable of the table in the most detailed layout that fits, limited to the height of the terminal."""

    def __init__(self, devices: list[RemoteDevice], now_s: float) -> None:
        self._devices = devices
        self._now_s = now_s

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the table, and a line with the number of devices that are not shown."""
        layout = next((one for one in LAYOUTS if self._fits(one, console, options)), NARROW_LAYOUT)
        room = self._visible_rows(layout, console)
        yield fleet_table(self._devices[:room], self._now_s, layout)
        if len(self._devices) > room:
            yield Text(f"… and {len(self._devices) - room} more with less trouble", style="dim")

    def _visible_rows(self, layout: Layout, console: Console) -> int:
        """Return the number of rows that are shown; all rows if the output is not a terminal."""
        if not console.is_terminal:
            return len(self._devices)
        return max((console.size.height - EVENTS - MAX_TROUBLE_LINES - HEADER_LINES) // (3 if layout.stacked else 1), 3)

    def _fits(self, layout: Layout, console: Console, options: ConsoleOptions) -> bool:
        """Return True if the table in this layout fits into the width."""
        table = fleet_table(self._devices[: self._visible_rows(layout, console)], self._now_s, layout)
        return console.measure(table, options=options.update(max_width=10_000)).maximum <= options.max_width


def fleet_table(devices: Sequence[RemoteDevice], now_s: float, layout: Layout) -> Table:
    """Return the table of devices, one row per device.

    Parameters
    ----------
    devices
        Devices in the order of their rows.
    now_s
        Current time on the clock of the messages [s].
    layout
        Level of detail.
    """
    table = Table(box=None, padding=(0, layout.gap, 0, 0), pad_edge=False, header_style="bold")
    for head in ("device", "state"):
        table.add_column(head, no_wrap=True)
    for head in ("Hz", "received", "lost", "bad"):
        table.add_column(head, justify="right", no_wrap=True)
    shown = [pair for pair in TABLE_COEFFICIENTS if any(_has_axis_of(one, pair[0]) for one in devices)]
    noise = [_noise_column(devices, kind, letter, layout) for kind, letter in shown]
    if layout.stacked and shown:
        noise.insert(0, (Text(), [Text("x\ny\nz" if one.noise else "", style="bold") for one in devices]))
    for title, _ in noise:
        table.add_column(title, justify="right", no_wrap=True)
    for head in ("p99 ms", "age"):
        table.add_column(head, justify="right", no_wrap=True)
    names = _names([one.key for one in devices])
    for i, one in enumerate(devices):
        cells = [Text(names[one.key], style="bold"), _state(one.state(now_s)), *_counts(one, layout)]
        cells += [column[i] for _, column in noise]
        table.add_row(*cells, _latency(one), Text(_age(now_s - one.last_message_s)))
    return table


class LiveTable:
    """Renderer of the table of a board as text for a ``QueuedWriter``: repeatedly on a terminal, otherwise once.

    ``render`` is called by the thread of the writer only. The rich console is used to format text; it writes nothing
    itself.

    Parameters
    ----------
    console : Console
        Width, height and colours of the destination.
    board : Board or None
        Content. While it is None, only lines are written.
    """

    def __init__(self, console: Console, board: DeviceStates | None = None) -> None:
        self.board = board
        self._console = console
        self._live: Live | None = None
        self._ended = False

    def render(self, lines: Sequence[str], last: bool) -> str:
        """Return the text and control codes that print the lines above the table and redraw the table.

        Parameters
        ----------
        lines : sequence of str
            Lines of the log, with colours as ANSI codes.
        last : bool
            True to show the cursor again and leave the final table.
        """
        with self._console.capture() as captured:
            if self.board is not None and self._live is None and self._console.is_terminal and not last:
                live = Live(
                    console=self._console,
                    auto_refresh=False,
                    transient=True,
                    redirect_stdout=False,
                    redirect_stderr=False,
                )
                live.start()
                self._live = live
            if lines:
                self._console.print(Text.from_ansi("".join(lines)))
            if not last and self._live is not None and self.board is not None:
                self._live.update(self.board.table(time.monotonic()), refresh=True)
            if last and not self._ended:
                self._ended = True
                if self._live is not None:
                    self._live.stop()
                if self.board is not None:
                    self._console.print(self.board.table(time.monotonic()))
        return captured.get()


def watch(
    keyexpr: str = KEYEXPR,
    connect: Sequence[str] = (),
    stop: threading.Event | None = None,
    console: Console | None = None,
    once_s: float | None = None,
    file: Path | None = None,
) -> None:
    """Show the table until ``stop`` is set or Ctrl-C is pressed.

    The table is written by a separate thread. A terminal or pipe that is not read delays neither messages nor the exit.

    Parameters
    ----------
    keyexpr
        Key expression that selects the devices.
    connect
        Endpoints of daemons or routers.
    stop
        Event that ends the function.
    console
        Console that formats the table.
    once_s
        Time to collect messages [s], after which the table is printed once. None: show it continuously.
    file
        Configuration file of zenoh.

    Raises
    ------
    ConfigError
        zenoh rejects the key expression, an endpoint or the file with certificates and passwords.
    OSError
        Standard output cannot be written.
    """
    stop, console = stop or threading.Event(), console or Console()
    board = DeviceStates()
    with (
        contextlib.closing(ZenohSubscriber(keyexpr, connect, file)) as arriving,
        contextlib.suppress(KeyboardInterrupt),
    ):
        arriving.start()
        if once_s is not None:
            stop.wait(once_s)
            _take(board, arriving)
            with QueuedWriter(cast("TextIO", console.file), STDOUT, LiveTable(console, board).render) as out:
                out.finish(stop)
        elif console.is_terminal:
            with QueuedWriter(
                cast("TextIO", console.file), STDOUT, LiveTable(console, board).render, REFRESH_PERIOD_S
            ) as screen:
                while not stop.wait(REFRESH_PERIOD_S) and screen.error is None:
                    _take(board, arriving)
                    screen.redraw()
        else:
            with QueuedWriter(cast("TextIO", console.file), STDOUT, limit=1) as out:  # queue at most one table
                while not stop.wait(PLAIN_PERIOD_S) and out.error is None:
                    _take(board, arriving)
                    with console.capture() as captured:
                        console.print(board.table(time.monotonic()))
                    out.put(captured.get())


def _take(board: DeviceStates, arriving: ZenohSubscriber) -> None:
    """Pass all received messages to the board."""
    for message in arriving.take(0.0):
        if message.payload is None:
            board.set_token(message.key, message.there)
        else:
            board.process_message(message.key, message.payload)
    board.note = connection_note(board, arriving)


def connection_note(board: DeviceStates, arriving: ZenohSubscriber) -> str:
    """Return what is wrong with the connection to the daemons; empty if nothing is.

    Parameters
    ----------
    board
        State of the devices.
    arriving
        Subscriber.
    """
    state, dropped = arriving.state, arriving.dropped
    notes = [state] if state != "ok" else []
    if state == "ok" and arriving.open_s > SILENCE_NOTE_S and not board.devices(time.monotonic()):
        notes.append("connected, but nothing comes: no daemon there, or no right to listen")
    notes += [f"{dropped:,} messages dropped: too slow here"] if dropped else []
    return "; ".join(notes)


# --- cells


def _names(keys: Sequence[str]) -> dict[str, str]:
    """Return the display name of each key: its last part if all keys share one prefix, else the whole key."""
    prefixes = {key.rpartition("/")[0] for key in keys}
    short = len(prefixes) == 1
    return {key: remote_device.strip_control_characters(key.rpartition("/")[2] if short else key) for key in keys}


def _state(state: str) -> Text:
    """Return the symbol and name of a state in its colour."""
    sign, colour = STATES.get(state, UNKNOWN_STATE_STYLE)
    return Text(f"{sign} {state}", style=colour)


def _counts(one: RemoteDevice, layout: Layout) -> list[Text]:
    """Return the cells of the rate and of the sample counters."""
    if one.status is None:
        return [Text(NO_VALUE, style="dim")] * 4
    rate = NO_VALUE if one.status.rate is None else format_number(one.status.rate, 4)
    write = _format_full_count if layout.full_counts else _format_short_count
    lost, bad = (Text(write(count), style="yellow" if count else "dim") for count in (one.status.lost, one.status.bad))
    return [Text(rate), Text(write(one.status.received)), lost, bad]


def _latency(one: RemoteDevice) -> Text:
    """Return the cell of the 99th percentile of the latency [ms]."""
    p99_s = None if one.status is None else one.status.latency.p99
    return Text(NO_VALUE, style="dim") if p99_s is None else Text(format_number(p99_s * 1e3, 2))


def _format_full_count(count: int) -> str:
    """Format a count with all digits."""
    return f"{count:,}"


def _format_short_count(count: int) -> str:
    """Format a count with at most five characters.

    >>> _format_short_count(9_999), _format_short_count(123_456), _format_short_count(999_999)
    ('9999', '123k', '1M')
    """
    if count < 10_000:
        return str(count)
    count = int(float(f"{count:.2e}"))  # rounded first, so that 999 999 becomes 1M
    power = min((len(str(count)) - 1) // 3, 4)
    return f"{count / 1000**power:.3g}{'kMGT'[power - 1]}"


def _age(age_s: float) -> str:
    """Format an age given in seconds.

    >>> _age(0.44), _age(75.0), _age(600.0), _age(90_000.0)
    ('0.4 s', '75 s', '10 min', '25 h')
    """
    if age_s < 10:
        return f"{max(age_s, 0.0):.1f} s"
    if age_s < 120:
        return f"{age_s:.0f} s"
    return f"{age_s / 60:.0f} min" if age_s < 2 * HOUR_S else f"{age_s / HOUR_S:.0f} h"


def _has_axis_of(one: RemoteDevice, kind: Kind) -> bool:
    """Return True if the device measures an axis of this kind."""
    return one.noise is not None and bool(set(axes_of(kind)) & set(one.noise.axes))


def _noise_column(devices: Sequence[RemoteDevice], kind: Kind, letter: str, layout: Layout) -> tuple[Text, list[Text]]:
    """Return the header and cells of one coefficient on three axes; values are aligned between rows."""
    axes = axes_of(kind)
    rows = [[_value(one, letter, axis, layout.digits) for axis in axes] for one in devices]
    unit = COEFFICIENT_UNITS[kind][letter].name
    if layout.stacked:
        return Text(f"{letter} {unit}"), [Text("\n".join(row) if any(row) else "") for row in rows]
    widths = [max(map(len, column)) for column in zip(axes, *rows, strict=True)]
    lines = [
        " ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in [list(axes), *rows]
    ]
    return Text(f"{letter} {unit}\n{lines[0]}"), [Text(line) for line in lines[1:]]


def _value(one: RemoteDevice, letter: str, axis: str, digits: int) -> str:
    """Format a coefficient: value, upper bound, a dash if there are too few data, or blank if it is not measured."""
    if one.noise is None or axis not in one.noise.axes:
        return ""
    return format_coefficient(one.noise.coefficients, letter, axis, digits).value.replace("≤ ", "≤")


# --- below the table


def _with_blank_line(lines: Sequence[RenderableType]) -> list[RenderableType]:
    """Return the lines with an empty line above them; nothing if there are no lines."""
    return [Text(), *lines] if lines else []


def _troubles(devices: Sequence[RemoteDevice], now_s: float) -> list[Text]:
    """Return one line per device with problems."""
    names = _names([one.key for one in devices])
    lines = []
    for one in devices:
        if trouble := one.problems():
            sign, colour = STATES.get(one.state(now_s), UNKNOWN_STATE_STYLE)
            sign = "!" if sign == "●" else sign
            lines.append(Text.assemble((f"{sign} {names[one.key]}  ", colour), trouble))
    if len(lines) > MAX_TROUBLE_LINES:
        lines = [
            *lines[: MAX_TROUBLE_LINES - 1],
            Text(f"… and {len(lines) - MAX_TROUBLE_LINES + 1} more with trouble", style="dim"),
        ]
    return lines


def _event(name: str, event: remote_device.EventMessage) -> Text:
    """Return the line of an event."""
    return Text.assemble(
        (f"{_clock_time(event.t)}  ", "dim"), (f"{name}  ", "bold"), remote_device.strip_control_characters(event.text)
    )


def _clock_time(unix_s: float) -> str:
    """Format the local time of day; the time of a recording may not be a valid date and is then shown in seconds."""
    try:
        return f"{datetime.fromtimestamp(unix_s).astimezone():%H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return f"{unix_s:g} s"


def analysis_table(estimate: Estimate, axes_of_temperature: Collection[str] = ()) -> RenderableType:
    """Return the table of coefficients with intervals for ``analyze``.

    Parameters
    ----------
    estimate
        The estimate.
    axes_of_temperature
        Axes to mark because temperature explains most of their slow variance.
    """
    axes = tuple(axis for _, axis in measured_axes(estimate))
    either = tuple(axis for i, axis in measured_axes(estimate) if estimate.k_or_r[i])
    return Group(
        *_coefficient_tables(remote_device.Noise(estimate.coefficients, axes, None), either, axes_of_temperature)
    )


def _coefficient_tables(
    noise: remote_device.Noise, either: Sequence[str] = (), axes_of_temperature: Collection[str] = ()
) -> list[RenderableType]:
    """Return a table per kind of sensor: axes by coefficients with intervals; ``either`` lists the axes with K or R."""
    seen = "" if noise.seen_s is None else f"last {format_duration(noise.seen_s)}; "
    known = f"; {K_OR_R}: one of them" if either else ""
    known += f"; {TEMPERATURE_MARK} {TEMPERATURE_MEANS}" if axes_of_temperature else ""
    parts: list[RenderableType] = [
        Text(f"{seen}[95 % interval]; ≤ bound; {NO_VALUE} too few data yet{known}", style="dim")
    ]
    for kind in KINDS:
        if set(axes_of(kind)) & set(noise.axes):
            wide, narrow = (detail_table(noise, kind, each, either, axes_of_temperature) for each in (False, True))
            parts.append(WidthDependentTable(wide, narrow))
    return parts


def detail_table(
    noise: remote_device.Noise,
    kind: Kind,
    stacked: bool,
    either: Sequence[str] = (),
    axes_of_temperature: Collection[str] = (),
) -> Table:
    """Return the table of the five coefficients for the axes of one kind.

    Parameters
    ----------
    noise
        Coefficients of the device.
    kind
        Kind of sensor.
    stacked
        True to print intervals below the values; False to print them beside the values.
    either
        Axes on which either K or R is present and the data do not show which.
    axes_of_temperature
        Axes to mark because temperature explains most of their slow variance.
    """
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    table.add_column(KIND_NAMES[kind] if not stacked else kind, no_wrap=True)
    for letter in SYMBOLS:
        table.add_column(f"{letter} {COEFFICIENT_UNITS[kind][letter].name}", justify="right", no_wrap=True)
    for axis in axes_of(kind):
        if axis in noise.axes:
            between = "\n" if stacked else " "
            cells = [_interval(noise, letter, axis, between, axis in either) for letter in SYMBOLS]
            table.add_row(Text(mark_temperature_axis(axis, axes_of_temperature), style="bold"), *cells)
    return table


def _interval(noise: remote_device.Noise, letter: str, axis: str, between: str, either: bool) -> Text:
    """Return the cell of one coefficient: value, interval and the mark ``K or R``."""
    one = format_coefficient(noise.coefficients, letter, axis)
    small = [f"[{one.interval}]"] if one.interval else []
    if either and letter in ("K", "R"):
        small.append(K_OR_R)
    return Text.assemble(one.value, *((between + part, "dim") for part in small))


class WidthDependentTable:
    """Renderable that shows the wide table if it fits, and the narrow one otherwise."""

    def __init__(self, wide: Table, narrow: Table) -> None:
        self._wide = wide
        self._narrow = narrow

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield one of the two tables."""
        needed = console.measure(self._wide, options=options.update(max_width=10_000)).maximum
        yield self._wide if needed <= options.max_width else self._narrow
