"""History of a device as text for the terminal, with tables, sparklines and events.

A sparkline is a small plot on one line of text. Characters of eight heights show the mean value in each time interval,
and a dot marks an interval without data.
"""

import math
from typing import Final

import numpy as np
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from drivers.data_types import Floats
from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KIND_NAMES,
    KINDS,
    NO_VALUE,
    CoefficientColumn,
    Kind,
    Unit,
    UnitSystem,
    axes_of,
    format_duration_in_largest_unit,
    format_number,
    format_utc,
    sensor_kind,
)
from monitor.history.bucketed_history import ColumnStatistics, HistoryTable
from monitor.history.history_row import COUNTS, STATES
from monitor.publishing.terminal.tables import plain_table, print_line

LETTERS: Final = ("N", "B", "K")
"""Noise coefficients in the table of all axes. The table of a single axis shows all five coefficients."""
SPARKLINE_HEIGHTS: Final = "▁▂▃▄▅▆▇█"
GAP: Final = "·"
SPARKLINE_WIDTH: Final = 32
"""Width of a sparkline [characters]."""
MAX_EVENTS: Final = 20
"""Largest number of events that are printed."""


def print_history_summary(
    past: HistoryTable,
    axes: tuple[str, ...],
    symbols: tuple[str, ...],
    console: Console,
    units: UnitSystem = DEFAULT_UNITS,
) -> None:
    """Print a line for each axis and coefficient, followed by the status and the events.

    Parameters
    ----------
    past
        Stored history of the device.
    axes
        Names of the axes to print.
    symbols
        Symbols of the coefficients to print.
    console
        Console that receives the output.
    units
        Units of the coefficients.
    """
    print_line(summary_line(past), console)
    for kind in KINDS:
        shown = [axis for axis in axes_of(kind) if axis in axes and axis in past.list_axes()]
        if shown:
            console.print(Padding(_summary(past, kind, shown, units.columns(kind, symbols)), (1, 0, 0, 0)))
    for line in _temperature_and_loss_lines(past):
        console.print(line, highlight=False)
    _print_events(past, console)


def print_axis_history(
    past: HistoryTable, axis: str, symbols: tuple[str, ...], console: Console, units: UnitSystem = DEFAULT_UNITS
) -> None:
    """Print the history of one axis with one line for each time interval.

    Parameters
    ----------
    past
        Stored history of the device.
    axis
        Axis to print.
    symbols
        Coefficients to print.
    console
        Console that receives the output.
    units
        Units of the coefficients.
    """
    table, columns = plain_table("UTC"), units.columns(sensor_kind(axis), symbols)
    for one in columns:
        table.add_column(f"{one.symbol} {one.unit.name}", justify="right", no_wrap=True)
    for name in ("°C", "lost", "state"):
        table.add_column(name, justify="right")
    temperature = past.select_column("temperature")
    for p in range(len(past)):
        cells = [_cell(past, axis, one, p) for one in columns]
        lost = int(past.counts[p, COUNTS.index("lost")])
        table.add_row(
            format_utc(float(past.start_s[p]))[:16],
            *cells,
            format_number(float(temperature.last[p])),
            f"{lost:,}" if lost else "",
            STATES[int(past.state[p])],
        )
    console.print(Padding(table, (1, 0, 0, 0)))


def _print_events(past: HistoryTable, console: Console) -> None:
    if not past.events:
        return
    shown = past.events[-MAX_EVENTS:]
    more = past.events_in_all - len(shown)
    console.print()
    if more > 0:
        console.print(f"… {more:,} earlier events", style="dim")
    for event in shown:
        times = f" (and {event.represented_events - 1:,} more before it)" if event.represented_events > 1 else ""
        print_line(f"{format_utc(event.t_s)}  {event.text}{times}", console)


def summary_line(past: HistoryTable) -> str:
    """Return one line that states the device, the time range, the number of rows and the number of samples."""
    samples = int(past.counts[:, COUNTS.index("received")].sum())
    if not len(past):
        return f"{past.device}: no rows between {format_utc(past.span.start_s)} and {format_utc(past.span.end_s)} UTC"
    widths = sorted({int(one) for one in past.width_s})
    rows = (" and " if len(widths) < 3 else " to ").join(
        format_duration_in_largest_unit(one) for one in (*widths[:1], *widths[1:][-1:])
    )
    return (
        f"{past.device}: {format_utc(float(past.start_s[0]))[:16]} to {format_utc(float(past.end_s[-1]))[:16]} UTC, "
        f"{len(past):,} rows of {rows}, {samples:,} samples"
    )


def _temperature_and_loss_lines(past: HistoryTable) -> list[str]:
    lines = []
    temperature = past.select_column("temperature")
    if temperature.n.any():
        low, high = np.nanmin(temperature.low), np.nanmax(temperature.high)
        lines.append(f"temperature {format_number(float(low))} … {format_number(float(high))} °C")
    counts = past.counts.sum(axis=0)
    wrong = [f"{int(counts[i]):,} {name}" for i, name in enumerate(COUNTS) if i and counts[i]]
    if wrong:
        lines.append("samples " + ", ".join(wrong))
    for state in ("waiting", "lost"):
        at = past.state == STATES.index(state)
        if at.any():
            lines.append(f"{state} at some time in {int(at.sum()):,} of {len(past):,} rows")
    return lines


def sparkline(values: Floats, t_s: Floats, range_s: tuple[float, float], width: int = SPARKLINE_WIDTH) -> str:
    """Return a text in which each character shows the mean value in one time interval.

    >>> steps = np.arange(8.0)
    >>> sparkline(steps, 60.0 * steps, (0.0, 480.0), 8)
    '▁▂▃▄▅▆▇█'

    Parameters
    ----------
    values
        Values, shape [p]; NaN if missing.
    t_s
        Times of the values [s], shape [p].
    range_s
        Times at the start and at the end of the sparkline [s].
    width
        Number of characters.
    """
    there = np.isfinite(values)
    if not there.any() or range_s[1] <= range_s[0]:
        return GAP * width
    at = np.clip(((t_s - range_s[0]) / (range_s[1] - range_s[0]) * width).astype(np.int64), 0, width - 1)[there]
    count = np.bincount(at, minlength=width)
    means = np.bincount(at, values[there], width)[count > 0] / count[count > 0]
    low, wide = means.min(), np.ptp(means)
    heights = ((means - low) / wide if wide > 0.0 else np.full(means.size, 0.5)) * len(SPARKLINE_HEIGHTS)
    marks = iter([SPARKLINE_HEIGHTS[min(int(one), len(SPARKLINE_HEIGHTS) - 1)] for one in heights])
    return "".join(next(marks) if some else GAP for some in count)


def _summary(past: HistoryTable, kind: Kind, axes: list[str], columns: list[CoefficientColumn]) -> Table:
    table = plain_table(KIND_NAMES[kind])
    for name in ("first", "last", "lowest", "highest"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("course", no_wrap=True)
    span = (float(past.start_s[0]), float(past.end_s[-1])) if len(past) else (0.0, 0.0)
    middle_s = past.start_s + 0.5 * past.width_s
    for axis in axes:
        for symbol, _, unit in columns:
            column = past.select_column(f"{axis}.{symbol}")
            label = Text.assemble((f"{axis} {symbol}", "bold"), f"  {unit.name}")
            there = column.last[np.isfinite(column.last)]
            if not there.size:
                table.add_row(label, NO_VALUE, *_bound(past, axis, symbol, unit), "")
                continue
            numbers = [float(one) * unit.factor for one in (there[0], there[-1], *_extremes(column))]
            table.add_row(label, *(format_number(one) for one in numbers), sparkline(column.last, middle_s, span))
    return table


def _bound(past: HistoryTable, axis: str, symbol: str, unit: Unit) -> tuple[str, str, str]:
    bound = past.select_column(f"{axis}.{symbol}.bound")
    there = bound.last[np.isfinite(bound.last)]
    if not there.size:
        return NO_VALUE, NO_VALUE, NO_VALUE
    return f"≤ {format_number(float(there[-1]) * unit.factor)}", NO_VALUE, NO_VALUE


def _cell(past: HistoryTable, axis: str, shown: CoefficientColumn, p: int) -> str:
    column, unit = past.select_column(f"{axis}.{shown.symbol}"), shown.unit
    low, high, last = (float(part[p]) * unit.factor for part in (column.low, column.high, column.last))
    if math.isfinite(last):
        alike = format_number(low) == format_number(high)
        return format_number(last) if alike else f"{format_number(last)} [{format_number(low)} … {format_number(high)}]"
    bound = float(past.select_column(f"{axis}.{shown.symbol}.bound").last[p]) * unit.factor
    return f"≤ {format_number(bound)}" if math.isfinite(bound) else NO_VALUE


def _extremes(column: ColumnStatistics) -> tuple[float, float]:
    return float(np.nanmin(column.low)), float(np.nanmax(column.high))
