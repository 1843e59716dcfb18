"""Allan deviations in a terminal, as curves of braille characters on logarithmic axes."""

from itertools import groupby
from math import ceil, floor, log10
from typing import Final

import numpy as np
from rich.color import Color
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import KIND_NAMES, KINDS, Kind, UnitSystem, axes_of
from monitor.estimation.allan.curve import AllanCurve
from monitor.publishing.plots.axis_colours import AXIS_COLOURS

MIN_WIDTH: Final = 36
MAX_WIDTH: Final = 76
MIN_LINES: Final = 8
MAX_LINES: Final = 15
LABEL_WIDTH: Final = 7
"""Width of the tick labels of the vertical axis."""
NAME_WIDTH: Final = 3
"""Width of the axis names to the right of the curves."""
FRAME_LINES: Final = 2
"""Number of lines for the title and for the averaging times."""
DOTS: Final = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bit of each dot of a braille character, by line and column."""
BRAILLE: Final = 0x2800
MIN_RANGE: Final = 1e-9
"""Smallest extent of an axis in decades, which avoids a division by zero."""
MIN_DECADES: Final = 2
"""Smallest number of decades whose ticks are labelled at powers of ten only."""


def allan_charts(curve: AllanCurve, units: UnitSystem, width: int, lines: int) -> RenderableType | None:
    """Return charts of the gyroscopes and the accelerometers, side by side if they fit, or None if there is not enough
    space.

    Parameters
    ----------
    curve
        Allan variances at m averaging times.
    units
        Units of the deviations.
    width, lines
        Space for all charts, in characters and lines.
    """
    deviation = np.sqrt(np.where(curve.avar > 0.0, curve.avar, np.nan))
    kinds = [kind for kind in KINDS if np.isfinite(_select_axes(deviation, kind)).sum() > 1]
    if not kinds:
        return None
    beside = width >= len(kinds) * MIN_WIDTH
    width = min(width // len(kinds) if beside else width, MAX_WIDTH)
    lines = min(lines if beside else lines // len(kinds), MAX_LINES)
    if width < MIN_WIDTH or lines < MIN_LINES:
        return None
    charts = [_draw_chart(curve.tau_s, deviation, kind, units, width, lines) for kind in kinds]
    if not beside:
        return Group(*charts)
    row = Table.grid()
    row.add_row(*charts)
    return row


def _select_axes(deviation: Floats, kind: Kind) -> Floats:
    return deviation[:, [AXES.index(axis) for axis in axes_of(kind)]]


def _draw_chart(tau_s: Floats, deviation: Floats, kind: Kind, units: UnitSystem, width: int, lines: int) -> Text:
    unit = units.deviation(kind)
    values = _select_axes(deviation, kind) * unit.factor
    shown = np.isfinite(values).any(axis=1)
    x, y = np.log10(tau_s[shown]), np.log10(values[shown])
    rows, columns = lines - FRAME_LINES, width - LABEL_WIDTH - NAME_WIDTH
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    range_y = max(high - low, MIN_RANGE)
    across = (x - x[0]) / max(x[-1] - x[0], MIN_RANGE) * (2 * columns - 1)
    down = (high - y) / range_y * (4 * rows - 1)
    bits, colours = np.zeros((rows, columns), np.int64), np.full((rows, columns), -1)
    names: dict[int, str] = {}
    styles = [*(f"not bold {Color.from_rgb(*AXIS_COLOURS[axis]).name}" for axis in axes_of(kind)), "not bold"]
    for i, axis in enumerate(axes_of(kind)):
        known = np.isfinite(down[:, i])
        if known.sum() > 1:
            _draw_line(across[known], down[known, i], i, bits, colours)
            names[_free_row(names, round(float(down[known, i][-1])) // 4, rows)] = axis
    ticks = {round((high - log10(tick)) / range_y * (rows - 1)): f"{tick:g}" for tick in _ticks(low, high)}
    chart = Text(f"{KIND_NAMES[kind]}: Allan deviation, {unit.name}".ljust(width)[:width], style="bold", no_wrap=True)
    for row in range(rows):
        chart.append(f"\n{ticks.get(row, ''):>{LABEL_WIDTH - 1}}{'┤' if row in ticks else '│'}", style="not bold dim")
        dots = [chr(BRAILLE + int(cell)) if cell else " " for cell in bits[row]]
        for axis, cells in groupby(range(columns), key=colours[row].__getitem__):
            chart.append("".join(dots[column] for column in cells), styles[axis])
        name = names.get(row, "")
        chart.append(f" {name}".ljust(NAME_WIDTH), styles[axes_of(kind).index(name) if name else -1])
    chart.append(f"\n{_label_averaging_times(x, columns)}".ljust(width), style="not bold dim")
    return chart


def _draw_line(across: Floats, down: Floats, axis: int, bits: np.ndarray, colours: np.ndarray) -> None:
    """Draw straight lines between points, whose coordinates are in dots from the top left corner."""
    steps = np.maximum(np.abs(np.diff(across)), np.abs(np.diff(down))).astype(int) + 2
    for i, count in enumerate(steps):
        for share in np.linspace(0.0, 1.0, count):
            dot_x = round(float(across[i] + share * (across[i + 1] - across[i])))
            dot_y = round(float(down[i] + share * (down[i + 1] - down[i])))
            bits[dot_y // 4, dot_x // 2] |= DOTS[dot_y % 4][dot_x % 2]
            colours[dot_y // 4, dot_x // 2] = axis


def _free_row(names: dict[int, str], row: int, rows: int) -> int:
    """Return the unnamed row nearest to the given row."""
    return min((one for one in range(rows) if one not in names), key=lambda one: abs(one - row))


def _ticks(low: float, high: float) -> list[float]:
    """Return the ticks between two decimal logarithms. A short range also has ticks at 2 and 5 times a power of ten.

    >>> _ticks(-0.1, 2.2), _ticks(1.2, 2.1)
    ([1.0, 10.0, 100.0], [20.0, 50.0, 100.0])
    """
    steps = (1.0,) if floor(high) - ceil(low) >= MIN_DECADES - 1 else (1.0, 2.0, 5.0)
    ticks = [step * 10.0**decade for decade in range(floor(low), ceil(high) + 1) for step in steps]
    return [tick for tick in ticks if low <= log10(tick) <= high]


def _label_averaging_times(log_tau: Floats, columns: int) -> str:
    """Return the line below a chart with the averaging times in seconds."""
    line = [" "] * (LABEL_WIDTH + columns + NAME_WIDTH)
    low, high = float(log_tau[0]), float(log_tau[-1])
    for tick in _ticks(low, high):
        label = f"{tick:g}"
        begin = LABEL_WIDTH + round((log10(tick) - low) / max(high - low, MIN_RANGE) * (columns - 1)) - len(label) // 2
        if (
            begin + len(label) < len(line) - NAME_WIDTH - 1
            and not "".join(line[begin - 1 : begin + len(label)]).strip()
        ):
            line[begin : begin + len(label)] = label
    line[-NAME_WIDTH - 1 :] = "τ, s"
    return "".join(line)
