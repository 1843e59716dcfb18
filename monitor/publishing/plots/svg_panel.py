"""Panels with curves, drawn directly as SVG elements.

A report contains up to several hundred small figures. Matplotlib takes about 70 ms of processor time for a figure, and
this module takes about 2 ms. All lengths are in points (1/72 inch).
"""

import hashlib
import html
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10
from typing import Final, Literal

import numpy as np

from drivers.data_types import Floats
from monitor.publishing.plots.style import DARK, FEW_DECADES_RATIO, MAX_LABELS, MINOR_GRID_COLOUR, format_tick

GRID_COLOUR: Final = "#d0d0d0"
FRAME_COLOUR: Final = "#999999"
FONT: Final = "DejaVu Sans, Verdana, sans-serif"
TEXT_SIZE: Final = 9.0
TICK_TEXT_SIZE: Final = 8.5
MEAN_CHARACTER_WIDTH: Final = 0.56
"""Approximate width of a character, relative to the size of the text."""
LABEL_DISTANCE: Final = 26.0
"""Distance of the label of the x axis from the panel."""
TITLE_DISTANCE: Final = 6.0
MIN_TICK_DISTANCES: Final = (38.0, 20.0)
"""Smallest distances between the ticks of a linear x axis and of a linear y axis."""
NICE_STEPS: Final = (1.0, 2.0, 2.5, 5.0, 10.0)
COLUMNS_PER_POINT: Final = 2.0
"""Horizontal resolution of curves with many points."""
MAX_DISTANCE: Final = 1e4
"""Largest distance of a drawn point from the figure."""

Anchor = Literal["start", "middle", "end"]


@dataclass(frozen=True, slots=True)
class AxisScale:
    """Linear or logarithmic scale of an axis of a panel."""

    limits: tuple[float, float]
    ends: tuple[float, float]  # positions of the limits
    log: bool

    def positions(self, values: Floats | Sequence[float]) -> Floats:
        """Return the positions of values, NaN for values that have no position on a logarithmic axis."""
        low, high = np.log10(self.limits) if self.log else self.limits
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = np.log10(values) if self.log else np.asarray(values, np.float64)
        found = self.ends[0] + (scaled - low) / (high - low) * (self.ends[1] - self.ends[0])
        return np.where(np.isfinite(found), np.clip(found, -MAX_DISTANCE, MAX_DISTANCE), np.nan)

    def ticks(self, min_distance: float) -> list[float]:
        """Return the values of the ticks, at least ``min_distance`` apart on a linear axis."""
        low, high = self.limits
        found: list[float] = []
        if self.log:
            first, last = floor(log10(low)), ceil(log10(high))
            stride = ceil((last - first) / (MAX_LABELS + 1))
            factors = (1.0, 2.0, 5.0) if high / low < FEW_DECADES_RATIO else (1.0,)
            found = [
                float(f"{factor:g}e{power}") for power in range(first, last + 1, max(stride, 1)) for factor in factors
            ]
            found = [value for value in found if low <= value <= high]
        if len(found) >= 2:
            return found
        least = (high - low) * min_distance / abs(self.ends[1] - self.ends[0])
        unit = 10.0 ** floor(log10(least))
        step = next(unit * nice for nice in NICE_STEPS if unit * nice >= least)
        return [round(k * step / unit, 6) * unit for k in range(ceil(low / step), floor(high / step) + 1)]


class SvgPanel:
    """Panel with two axes and a grid.

    Parameters
    ----------
    box
        Left, top, width and height of the panel.
    x_limits, y_limits
        Values at the left and right ends, and at the lower and upper ends.
    log
        True for a logarithmic x axis and a logarithmic y axis.
    """

    def __init__(
        self,
        box: tuple[float, float, float, float],
        x_limits: tuple[float, float],
        y_limits: tuple[float, float],
        log: tuple[bool, bool],
    ) -> None:
        self.left, self.top, width, height = box
        self.right, self.bottom = self.left + width, self.top + height
        self.x = AxisScale(x_limits, (self.left, self.right), log[0])
        self.y = AxisScale(y_limits, (self.bottom, self.top), log[1])
        self._grid: list[str] = []
        self._curves: list[str] = []
        self._labels: list[str] = []

    def draw_axes(self, x_label: str, y_ticks: Sequence[tuple[float, str]] | None = None) -> None:
        """Draw the grid, the labels of the ticks, the label of the x axis, and the frame.

        ``y_ticks`` contains the value and the label of each tick of the y axis. By default, the ticks are chosen.
        """
        for value in self.x.ticks(MIN_TICK_DISTANCES[0]):
            at = float(self.x.positions([value])[0])
            self._grid.append(_path([(at, self.bottom), (at, self.top)], GRID_COLOUR, 0.7))
            self.write(at, self.bottom + 3.5 + TICK_TEXT_SIZE, format_tick(value), "middle", size=TICK_TEXT_SIZE)
        row_colour = GRID_COLOUR if y_ticks is None else MINOR_GRID_COLOUR
        for value, label in y_ticks or [(one, format_tick(one)) for one in self.y.ticks(MIN_TICK_DISTANCES[1])]:
            at = float(self.y.positions([value])[0])
            self._grid.append(_path([(self.left, at), (self.right, at)], row_colour, 0.7))
            self.write(self.left - 4.0, at + 0.35 * TICK_TEXT_SIZE, label, "end", size=TICK_TEXT_SIZE)
        frame = [(self.left, self.top), (self.left, self.bottom), (self.right, self.bottom)]
        self._grid.append(_path(frame, FRAME_COLOUR, 0.8))
        middle = 0.5 * (self.left + self.right)
        self.write(middle, self.bottom + LABEL_DISTANCE, x_label, "middle", size=TEXT_SIZE + 0.5)

    def write(
        self, x: float, y: float, text: str, anchor: Anchor, *, size: float = TEXT_SIZE, colour: str = DARK,
        bold: bool = False,
    ) -> None:  # fmt: skip
        """Write a text at a position of the figure. A white outline keeps the text legible over curves."""
        style = f"font: {'bold ' if bold else ''}{size:g}px {FONT}; text-anchor: {anchor}; fill: {colour}"
        outline = "stroke: white; stroke-width: 2px; stroke-opacity: 0.8; paint-order: stroke"
        self._labels.append(
            f'<text x="{x:.1f}" y="{y:.1f}" style="{style}; {outline}">{html.escape(text, quote=False)}</text>'
        )

    def write_titles(self, left: str, left_colour: str, right: str, right_colour: str, bold: bool = False) -> None:
        """Write a text above the left end of the panel and a text above the right end."""
        self.write(self.left, self.top - TITLE_DISTANCE, left, "start", colour=left_colour)
        self.write(self.right, self.top - TITLE_DISTANCE, right, "end", colour=right_colour, bold=bold)

    def draw_line(
        self, x: Floats, y: Floats, colour: str, width: float, *, dashes: str = "", markers: bool = False
    ) -> None:
        """Draw a curve, with gaps where a value is not finite or has no position."""
        columns, at = self.x.positions(x), self.y.positions(y)
        for run in _finite_runs(columns, at):
            points = _thinned(columns[run], at[run])
            self._curves.append(_path(points.tolist(), colour, width, dashes))
            if markers:
                self._curves += [_disc(px, py, 2.25, colour) for px, py in points.tolist()]

    def fill_band(self, x: Floats, lo: Floats, hi: Floats, colour: str) -> None:
        """Fill the area between two curves."""
        columns, lower, upper = self.x.positions(x), self.y.positions(lo), self.y.positions(hi)
        for run in _finite_runs(columns, lower, upper):
            there, back = _thinned(columns[run], lower[run]), _thinned(columns[run], upper[run])
            corners = [*there.tolist(), *back[::-1].tolist()]
            self._curves.append(f'<path d="{_path_data(corners)} z" style="fill: {colour}; stroke: none"/>')

    def mark_range(self, low: float, high: float, colour: str) -> None:
        """Mark a range along x over the whole height. The outline keeps a very narrow range visible."""
        a, b = self.x.positions(np.clip([low, high], *self.x.limits)).tolist()
        corners, colour = [(a, self.bottom), (a, self.top), (b, self.top), (b, self.bottom)], colour.lower()
        self._curves.append(
            f'<path d="{_path_data(corners)} z" style="fill: {colour}; stroke: {colour}; stroke-width: 3; '
            'opacity: 0.35"/>'
        )

    def mark_position(self, x: float, label: str, line_colour: str, text_colour: str) -> None:
        """Draw a vertical line at a value of x, with a label at the top."""
        (at,) = self.x.positions([x]).tolist()
        self._grid.append(_path([(at, self.bottom), (at, self.top)], line_colour, 1.2))
        self.write(at, self.top + TEXT_SIZE + 2.0, label, "middle", colour=text_colour, bold=True)

    def draw_disc(self, x: float, y: float, colour: str, hollow: bool = False) -> None:
        """Draw a disc or a circle at a point of the panel."""
        at, row = float(self.x.positions([x])[0]), float(self.y.positions([y])[0])
        self._curves.append(_disc(at, row, 3.0, colour, hollow))

    def draw_legend(self, entries: Sequence[tuple[str, str, str]]) -> None:
        """Draw the legend above the right end of the panel. Each entry has a name, a colour and the dashes."""
        sample, gap, y = 16.0, 5.0, self.top - TITLE_DISTANCE
        x = self.right
        for name, colour, dashes in reversed(entries):
            self.write(x, y, name, "end", size=TICK_TEXT_SIZE)
            x -= text_width(name, TICK_TEXT_SIZE) + gap
            line = [(x - sample, y - 0.35 * TICK_TEXT_SIZE), (x, y - 0.35 * TICK_TEXT_SIZE)]
            self._labels.append(_path(line, colour, 1.4, dashes))
            x -= sample + 2.0 * gap

    def elements(self, clip_id: str) -> str:
        """Return the SVG elements of the panel. The curves are clipped at the frame."""
        size = f'width="{self.right - self.left:.1f}" height="{self.bottom - self.top:.1f}"'
        clip = f'<clipPath id="{clip_id}"><rect x="{self.left:.1f}" y="{self.top:.1f}" {size}/></clipPath>'
        grid, curves, labels = map("".join, (self._grid, self._curves, self._labels))
        return f'{grid}{clip}<g clip-path="url(#{clip_id})">{curves}</g>{labels}'


def render_svg(width: float, height: float, panels: Sequence[SvgPanel], description: str) -> str:
    """Return panels as one SVG element without a fixed width and height.

    Equal figures are equal texts.

    Parameters
    ----------
    width, height
        Size of the figure.
    panels
        Panels of the figure.
    description
        Text alternative for people who cannot see the figure.
    """
    # figures on the same page need different identifiers
    prefix = hashlib.sha256("".join(panel.elements("") for panel in panels).encode()).hexdigest()[:8]
    content = "".join(panel.elements(f"{prefix}{at}") for at, panel in enumerate(panels))
    return (
        f'<svg role="img" aria-label="{html.escape(description)}" viewBox="0 0 {width:g} {height:g}" '
        f'xmlns="http://www.w3.org/2000/svg">{content}</svg>'
    )


def text_width(text: str, size: float) -> float:
    """Return the approximate width of a text."""
    return MEAN_CHARACTER_WIDTH * size * len(text)


def _finite_runs(*lines: Floats) -> list[slice]:
    """Return the parts of at least two points in which all values are finite."""
    finite = np.isfinite(lines).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], finite, [0]]).astype(np.int8)))
    return [slice(first, end) for first, end in edges.reshape(-1, 2).tolist() if end - first > 1]


def _thinned(x: Floats, y: Floats) -> Floats:
    """Return the points of a curve, shape (k, 2), without points that cannot be distinguished.

    In each column of a point's width, the first, lowest, highest and last point remain.
    """
    columns = np.floor(COLUMNS_PER_POINT * x)
    first = np.flatnonzero(np.diff(columns, prepend=-np.inf))
    if x.size <= 4 * first.size:
        return np.column_stack([x, y])
    last = np.append(first[1:], x.size) - 1
    order = np.lexsort((y, np.repeat(np.arange(first.size), last - first + 1)))
    kept: Floats = np.column_stack([x, y])[np.unique(np.concatenate([first, order[first], order[last], last]))]
    return kept


def _path(points: Sequence[Sequence[float]], colour: str, width: float, dashes: str = "") -> str:
    pattern = f"; stroke-dasharray: {dashes}" if dashes else ""
    style = f"fill: none; stroke: {colour.lower()}; stroke-width: {width:g}{pattern}; stroke-linejoin: round"
    return f'<path d="{_path_data(points)}" style="{style}"/>'


def _path_data(points: Sequence[Sequence[float]]) -> str:
    return "M " + " L ".join(f"{x:.1f} {y:.1f}" for x, y in points)


def _disc(x: float, y: float, radius: float, colour: str, hollow: bool = False) -> str:
    style = f"fill: white; stroke: {colour}; stroke-width: 1.4" if hollow else f"fill: {colour}"
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" style="{style}"/>'
