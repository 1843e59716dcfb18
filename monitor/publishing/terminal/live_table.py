"""The live table in the terminal: one row a device, those in trouble first.

In come the payloads of ``monitor.common.topics``, from zenoh (``watch``) or from the daemon this process is (``run``,
``demo``); out goes something that rich can print at any width. Of a few layouts the fullest that fits is taken: at 160
columns a device is one line with three digits, at 100 one line with two, narrower it is three lines, an axis each.
A state has a word and a sign beside its colour. Numbers stand in the field's units of ``monitor.publishing.coefficient_cells``.
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

from monitor.common import topics
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import LETTERS
from monitor.publishing import coefficient_cells
from monitor.publishing.coefficient_cells import Kind
from monitor.publishing.messages import remote_device
from monitor.publishing.messages.encoding import measured_axes
from monitor.publishing.messages.remote_device import Heard
from monitor.publishing.rerun.panels import duration
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.subscriber import KEYEXPR, ZenohIn

REFRESH_S: Final = 0.5
DEVICES: Final = 20_000
"""Known at most; then a new one takes the place of one that has been silent for long, or is passed over."""
FORGET_S: Final = 600.0
KEY_LENGTH: Final = 200
QUIET_S: Final = 5.0
"""Connected for so long without a word of anyone: said, as access control refuses without saying so."""
STDOUT: Final = "standard output"
PLAIN_S: Final = 1.0
"""Between two tables where output is no terminal."""
EVENTS: Final = 5
TROUBLES: Final = 6
HEADS: Final = 6
"""Lines of the screen that are no row: summary, note, heads, and those left empty."""
SHOWN: Final[tuple[tuple[Kind, str], ...]] = (("gyro", "N"), ("gyro", "B"), ("accel", "N"))
NONE: Final = "—"
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
"""State -> its sign and colour."""
UNKNOWN: Final = ("?", "yellow")


@dataclass(frozen=True, slots=True)
class Layout:
    """How much of a row is shown."""

    digits: int
    full_counts: bool
    stacked: bool  # an axis a line
    gap: int  # blanks between columns


LAYOUTS: Final = (Layout(3, True, False, 2), Layout(3, False, False, 1), Layout(2, False, False, 1))
NARROW: Final = Layout(3, False, True, 1)


class Board:
    """What is known of each device, from the payloads of ``monitor.common.topics``. Safe between threads.

    Args:
        clock: seconds on the clock of ``table``'s ``now_s``; for the age of messages
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.note = ""  # a line above the table, e.g. who cannot be reached
        self.malformed = 0  # messages that are not what their key says
        self.passed_over = 0  # messages of devices that found no room
        self._clock = clock
        self._devices: OrderedDict[str, Heard] = OrderedDict()  # longest silent first
        self._events: deque[tuple[str, remote_device.EventMessage]] = deque(maxlen=EVENTS)
        self._lock = threading.Lock()

    def take(self, key: str, payload: bytes) -> None:
        """A message as it was sent; keys of other topics are passed over, malformed payloads counted."""
        found = remote_device.split(key)
        if found is None:
            return
        device, topic = found
        with self._lock:
            try:
                self._read(device, topic, payload)
            except ValueError:
                self.malformed += 1

    def alive(self, key: str, there: bool) -> None:
        """The liveliness token at ``key`` appeared or went."""
        found = remote_device.split(key)
        if found is None or found[1] is not topics.ALIVE:
            return
        with self._lock:
            if known := self._device(found[0]):
                known.there = there

    def forget(self, key: str) -> None:
        """The device of the key has no row any more."""
        found = remote_device.split(key)
        if found is None:
            return
        with self._lock:
            self._devices.pop(found[0], None)
            for one in [one for one in self._events if one[0] == found[0]]:
                self._events.remove(one)

    def table(self, now_s: float) -> RenderableType:
        """All of it, at one moment."""
        with self._lock:
            devices = [copy.copy(one) for one in self._sorted(now_s)]  # drawn later, while messages arrive
            parts: list[RenderableType] = [self._summary(devices, now_s)]
            if devices:
                parts.append(Fleet(devices, now_s))
            parts += _apart(_troubles(devices, now_s))
            if len(devices) == 1 and devices[0].noise is not None:
                parts += _apart(_detail(devices[0].noise))
            names = _names(list(self._devices))
            parts += _apart([_event(names[device], event) for device, event in self._events])
        return Group(*parts)

    def devices(self, now_s: float) -> list[Heard]:
        """All that are known, those in trouble first."""
        with self._lock:
            return self._sorted(now_s)

    def _sorted(self, now_s: float) -> list[Heard]:
        return sorted(self._devices.values(), key=lambda one: (one.rank(now_s), one.key))

    def _read(self, device: str, topic: topics.Topic, payload: bytes) -> None:
        """ValueError for a malformed one, which then leaves no trace."""
        if topic is topics.STATUS:
            status = remote_device.status(payload)
            if known := self._heard(device):
                known.status = status
        elif topic is topics.COEFFICIENTS:
            noise = remote_device.noise(remote_device.read(remote_device.CoefficientsMessage, topic, payload))
            if known := self._heard(device):
                known.noise = noise
        elif topic is topics.GAP:
            gap = remote_device.gap(payload)
            if known := self._heard(device):
                known.gap = gap
        elif topic is topics.EVENT:
            event = remote_device.event(payload)
            if self._heard(device):
                self._events.append((device, event))

    def _heard(self, device: str) -> Heard | None:
        known = self._device(device)
        if known is not None:
            known.heard_s = self._clock()
            self._devices.move_to_end(device)
        return known

    def _device(self, device: str) -> Heard | None:
        """The device, from now on known; None where there is no room for another."""
        known = self._devices.get(device)
        if known is not None:
            return known
        now_s = self._clock()
        full = len(self._devices) >= DEVICES
        if len(device) > KEY_LENGTH or (full and now_s - next(iter(self._devices.values())).heard_s < FORGET_S):
            self.passed_over += 1
            return None
        if full:
            self._devices.popitem(last=False)
        return self._devices.setdefault(device, Heard(device, now_s))

    def _summary(self, devices: list[Heard], now_s: float) -> Text:
        line = Text("imu-monitor", style="bold")
        counts = Counter(one.state(now_s) for one in devices)
        line.append(f"  {len(devices)} device{'' if len(devices) == 1 else 's'}", style="not bold")
        for state, count in counts.items():
            sign, colour = STATES.get(state, UNKNOWN)
            line.append(f"  {sign} {count} {state}", style=f"not bold {colour}")
        if self.malformed:
            line.append(
                f"  {self.malformed:,} malformed message{'' if self.malformed == 1 else 's'}", style="not bold yellow"
            )
        if self.passed_over:
            line.append(f"  {self.passed_over:,} of devices beyond {DEVICES:,}", style="not bold yellow")
        if self.note:
            line.append(f"\n{self.note}", style="not bold yellow")
        return line


class Fleet:
    """The table of all devices in the fullest layout that fits, as many rows as the terminal has."""

    def __init__(self, devices: list[Heard], now_s: float) -> None:
        self._devices = devices
        self._now_s = now_s

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table, and how many did not find room."""
        layout = next((one for one in LAYOUTS if self._fits(one, console, options)), NARROW)
        room = self._room(layout, console)
        yield fleet_table(self._devices[:room], self._now_s, layout)
        if len(self._devices) > room:
            yield Text(f"… and {len(self._devices) - room} more with less trouble", style="dim")

    def _room(self, layout: Layout, console: Console) -> int:
        """Rows that are shown: all of them where the output is no terminal."""
        if not console.is_terminal:
            return len(self._devices)
        return max((console.size.height - EVENTS - TROUBLES - HEADS) // (3 if layout.stacked else 1), 3)

    def _fits(self, layout: Layout, console: Console, options: ConsoleOptions) -> bool:
        table = fleet_table(self._devices[: self._room(layout, console)], self._now_s, layout)
        return console.measure(table, options=options.update(max_width=10_000)).maximum <= options.max_width


def fleet_table(devices: Sequence[Heard], now_s: float, layout: Layout) -> Table:
    """One row a device."""
    table = Table(box=None, padding=(0, layout.gap, 0, 0), pad_edge=False, header_style="bold")
    for head in ("device", "state"):
        table.add_column(head, no_wrap=True)
    for head in ("Hz", "received", "lost", "bad"):
        table.add_column(head, justify="right", no_wrap=True)
    shown = [pair for pair in SHOWN if any(_measures(one, pair[0]) for one in devices)]
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
        table.add_row(*cells, _latency(one), Text(_age(now_s - one.heard_s)))
    return table


class LiveTable:
    """Draws the table of a board as text for a ``QueuedWriter``: again and again on a terminal, else once at the end.

    ``render`` is called by the thread of the writer only. The rich console is used to format text; it writes nothing
    itself.

    Parameters
    ----------
    console : Console
        Width, height and colours of the destination.
    board : Board or None
        Content. While it is None, only lines are written.
    """

    def __init__(self, console: Console, board: Board | None = None) -> None:
        self.board = board
        self._console = console
        self._live: Live | None = None
        self._ended = False

    def render(self, lines: Sequence[str], last: bool) -> str:
        """Return control codes and text that put the lines above the table and redraw the table below them.

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
    """Show the table until ``stop`` or Ctrl-C; with ``once_s`` listen for so long and print it once.

    A thread writes the table, so that a terminal or pipe that nobody reads neither delays messages nor the end.

    Raises:
        ConfigError: zenoh refuses the key expression, an endpoint or the ``file`` with certificates and passwords
        OSError: standard output cannot be written
    """
    stop, console = stop or threading.Event(), console or Console()
    board = Board()
    with contextlib.closing(ZenohIn(keyexpr, connect, file)) as arriving, contextlib.suppress(KeyboardInterrupt):
        arriving.start()
        if once_s is not None:
            stop.wait(once_s)
            _take(board, arriving)
            with QueuedWriter(cast("TextIO", console.file), STDOUT, LiveTable(console, board).render) as out:
                out.finish(stop)
        elif console.is_terminal:
            with QueuedWriter(
                cast("TextIO", console.file), STDOUT, LiveTable(console, board).render, REFRESH_S
            ) as screen:
                while not stop.wait(REFRESH_S) and screen.error is None:
                    _take(board, arriving)
                    screen.redraw()
        else:
            with QueuedWriter(cast("TextIO", console.file), STDOUT, limit=1) as out:  # at most one table waits
                while not stop.wait(PLAIN_S) and out.error is None:
                    _take(board, arriving)
                    with console.capture() as captured:
                        console.print(board.table(time.monotonic()))
                    out.put(captured.get())


def _take(board: Board, arriving: ZenohIn) -> None:
    """Pass all messages that have arrived to the board."""
    for message in arriving.take(0.0):
        if message.payload is None:
            board.alive(message.key, message.there)
        else:
            board.take(message.key, message.payload)
    board.note = note(board, arriving)


def note(board: Board, arriving: ZenohIn) -> str:
    """What is wrong between here and the daemons; empty while all is well."""
    state, dropped = arriving.state, arriving.dropped
    notes = [state] if state != "ok" else []
    if state == "ok" and arriving.open_s > QUIET_S and not board.devices(time.monotonic()):
        notes.append("connected, but nothing comes: no daemon there, or no right to listen")
    notes += [f"{dropped:,} messages dropped: too slow here"] if dropped else []
    return "; ".join(notes)


# --- cells


def _names(keys: Sequence[str]) -> dict[str, str]:
    """Key -> what a row is called: the last part, where that tells all devices apart and nothing is lost by it."""
    prefixes = {key.rpartition("/")[0] for key in keys}
    short = len(prefixes) == 1
    return {key: remote_device.clean(key.rpartition("/")[2] if short else key) for key in keys}


def _state(state: str) -> Text:
    sign, colour = STATES.get(state, UNKNOWN)
    return Text(f"{sign} {state}", style=colour)


def _counts(one: Heard, layout: Layout) -> list[Text]:
    if one.status is None:
        return [Text(NONE, style="dim")] * 4
    rate = NONE if one.status.rate is None else coefficient_cells.number(one.status.rate, 4)
    write = _full if layout.full_counts else _short
    lost, bad = (Text(write(count), style="yellow" if count else "dim") for count in (one.status.lost, one.status.bad))
    return [Text(rate), Text(write(one.status.received)), lost, bad]


def _latency(one: Heard) -> Text:
    p99_s = None if one.status is None else one.status.latency.p99
    return Text(NONE, style="dim") if p99_s is None else Text(coefficient_cells.number(p99_s * 1e3, 2))


def _full(count: int) -> str:
    return f"{count:,}"


def _short(count: int) -> str:
    """A count in at most five characters.

    >>> _short(9_999), _short(123_456), _short(999_999)
    ('9999', '123k', '1M')
    """
    if count < 10_000:
        return str(count)
    count = int(float(f"{count:.2e}"))  # rounded first: 999 999 are 1M
    power = min((len(str(count)) - 1) // 3, 4)
    return f"{count / 1000**power:.3g}{'kMGT'[power - 1]}"


def _age(age_s: float) -> str:
    """
    >>> _age(0.44), _age(75.0), _age(600.0), _age(90_000.0)
    ('0.4 s', '75 s', '10 min', '25 h')
    """
    if age_s < 10:
        return f"{max(age_s, 0.0):.1f} s"
    if age_s < 120:
        return f"{age_s:.0f} s"
    return f"{age_s / 60:.0f} min" if age_s < 7200 else f"{age_s / 3600:.0f} h"


def _measures(one: Heard, kind: Kind) -> bool:
    return one.noise is not None and bool(set(coefficient_cells.axes_of(kind)) & set(one.noise.axes))


def _noise_column(devices: Sequence[Heard], kind: Kind, letter: str, layout: Layout) -> tuple[Text, list[Text]]:
    """Head and cells of one coefficient on three axes; side by side they stand under each other in every row."""
    axes = coefficient_cells.axes_of(kind)
    rows = [[_value(one, letter, axis, layout.digits) for axis in axes] for one in devices]
    unit = coefficient_cells.COEFFICIENT_UNITS[kind][letter].name
    if layout.stacked:
        return Text(f"{letter} {unit}"), [Text("\n".join(row) if any(row) else "") for row in rows]
    widths = [max(map(len, column)) for column in zip(axes, *rows, strict=True)]
    lines = [
        " ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in [list(axes), *rows]
    ]
    return Text(f"{letter} {unit}\n{lines[0]}"), [Text(line) for line in lines[1:]]


def _value(one: Heard, letter: str, axis: str, digits: int) -> str:
    """A coefficient, its bound, a dash where there are too few data, nothing where the axis is not measured."""
    if one.noise is None or axis not in one.noise.axes:
        return ""
    return coefficient_cells.reading(one.noise.coefficients, letter, axis, digits).value.replace("≤ ", "≤")


# --- below the table


def _apart(lines: Sequence[RenderableType]) -> list[RenderableType]:
    """A section with an empty line above it, if there is anything in it."""
    return [Text(), *lines] if lines else []


def _troubles(devices: Sequence[Heard], now_s: float) -> list[Text]:
    """What is wrong in words, a line a device."""
    names = _names([one.key for one in devices])
    lines = []
    for one in devices:
        if trouble := one.trouble():
            sign, colour = STATES.get(one.state(now_s), UNKNOWN)
            sign = "!" if sign == "●" else sign
            lines.append(Text.assemble((f"{sign} {names[one.key]}  ", colour), trouble))
    if len(lines) > TROUBLES:
        lines = [*lines[: TROUBLES - 1], Text(f"… and {len(lines) - TROUBLES + 1} more with trouble", style="dim")]
    return lines


def _event(name: str, event: remote_device.EventMessage) -> Text:
    return Text.assemble((f"{_clock_time(event.t)}  ", "dim"), (f"{name}  ", "bold"), remote_device.clean(event.text))


def _clock_time(unix_s: float) -> str:
    """Local time of the day; a recording's own time may be no date at all."""
    try:
        return f"{datetime.fromtimestamp(unix_s).astimezone():%H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return f"{unix_s:g} s"


def analysis_table(estimate: Estimate, axes_of_temperature: Collection[str] = ()) -> RenderableType:
    """Coefficients of every measured axis with their intervals, for ``analyze``.

    Axes of which temperature explains most of the slow variance are marked.
    """
    axes = tuple(axis for _, axis in measured_axes(estimate))
    either = tuple(axis for i, axis in measured_axes(estimate) if estimate.k_or_r[i])
    return Group(*_detail(remote_device.Noise(estimate.coefficients, axes, None), either, axes_of_temperature))


def _detail(
    noise: remote_device.Noise, either: Sequence[str] = (), axes_of_temperature: Collection[str] = ()
) -> list[RenderableType]:
    """Axis by letter with intervals, a table a kind of sensor; ``either``: axes whose drift is K or R."""
    seen = "" if noise.seen_s is None else f"last {duration(noise.seen_s)}; "
    known = f"; {K_OR_R}: one of them" if either else ""
    known += (
        f"; {coefficient_cells.TEMPERATURE_MARK} {coefficient_cells.TEMPERATURE_MEANS}" if axes_of_temperature else ""
    )
    parts: list[RenderableType] = [Text(f"{seen}[95 % interval]; ≤ bound; {NONE} too few data yet{known}", style="dim")]
    for kind in coefficient_cells.KINDS:
        if set(coefficient_cells.axes_of(kind)) & set(noise.axes):
            wide, narrow = (detail_table(noise, kind, each, either, axes_of_temperature) for each in (False, True))
            parts.append(Fitting(wide, narrow))
    return parts


def detail_table(
    noise: remote_device.Noise,
    kind: Kind,
    stacked: bool,
    either: Sequence[str] = (),
    axes_of_temperature: Collection[str] = (),
) -> Table:
    """The five coefficients of the axes of one kind, intervals beside the values or below them."""
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    table.add_column(coefficient_cells.KIND_NAMES[kind] if not stacked else kind, no_wrap=True)
    for letter in LETTERS:
        table.add_column(
            f"{letter} {coefficient_cells.COEFFICIENT_UNITS[kind][letter].name}", justify="right", no_wrap=True
        )
    for axis in coefficient_cells.axes_of(kind):
        if axis in noise.axes:
            between = "\n" if stacked else " "
            cells = [_interval(noise, letter, axis, between, axis in either) for letter in LETTERS]
            table.add_row(Text(coefficient_cells.marked(axis, axes_of_temperature), style="bold"), *cells)
    return table


def _interval(noise: remote_device.Noise, letter: str, axis: str, between: str, either: bool) -> Text:
    one = coefficient_cells.reading(noise.coefficients, letter, axis)
    small = [f"[{one.interval}]"] if one.interval else []
    if either and letter in ("K", "R"):
        small.append(K_OR_R)
    return Text.assemble(one.value, *((between + part, "dim") for part in small))


class Fitting:
    """The wide table where it fits, else the narrow one."""

    def __init__(self, wide: Table, narrow: Table) -> None:
        self._wide = wide
        self._narrow = narrow

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """One of the two."""
        needed = console.measure(self._wide, options=options.update(max_width=10_000)).maximum
        yield self._wide if needed <= options.max_width else self._narrow
