"""Geometry of a log-log Allan plot for a viewer without logarithmic axes.

The functions convert averaging times and Allan deviations to points and lines in chart units. The chart is a box of
fixed size with a y axis that points down, as in the 2D view of Rerun.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.publishing.plots.style import format_tick

WIDTH: Final = 16.0
HEIGHT: Final = 11.5
MIN_DECADES: Final = 2.0
MIN_DECADES_OF_LONG_AXIS: Final = 4
"""Smallest number of decades of an axis on which a small plot labels every second power of ten only."""
RING_RADIUS: Final = 0.28
MARKER_RADIUS: Final = 0.2
MINOR_TICK: Final = 0.16  # length of the ticks between powers of ten
LABEL_ABOVE: Final = 0.6
"""Distance of the point of a label above the sign that it names, because Rerun draws a label below its point."""


@dataclass(frozen=True, slots=True)
class ChartDecadeRange:
    """Range of averaging times and Allan deviations that the chart shows, as exponents of ten."""

    x: tuple[int, int]
    y: tuple[int, int]

    def to_chart_positions(self, tau: Floats, sigma: Floats) -> Floats:
        """Convert averaging times and Allan deviations to chart positions, shape [n, 2].

        A position is NaN if its deviation is not positive.

        Parameters
        ----------
        tau
            Averaging times [s], shape [n].
        sigma
            Allan deviations in the unit of the plot, shape [n].
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            log_tau, log_sigma = np.log10(tau), np.log10(np.where(sigma > 0, sigma, np.nan))
        left, right = self.x
        bottom, top = self.y
        across = (log_tau - left) / (right - left) * WIDTH
        down = (top - log_sigma) / (top - bottom) * HEIGHT
        return np.column_stack([across, down])


def decade_range(values: Iterable[Floats], min_decades: int = int(MIN_DECADES)) -> tuple[int, int]:
    """Return the exponents of the powers of ten between which all positive finite numbers lie.

    >>> decade_range([np.array([0.02, 300.0])])
    (-2, 3)

    Parameters
    ----------
    values
        Arrays of numbers.
    min_decades
        Smallest number of decades of the range.
    """
    good = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in values])
    if good.size == 0:
        return 0, min_decades
    low = math.floor(math.log10(float(good.min())) + 1e-9)
    high = math.ceil(math.log10(float(good.max())) - 1e-9)
    return low, max(high, low + min_decades)


def clip_to_box(y: Floats) -> Floats:
    """Limit y coordinates to the height of the chart."""
    return np.clip(y, 0.0, HEIGHT)


def finite_sections(positions: Floats) -> list[Floats]:
    """Split a line at NaN, and return the sections with at least two points."""
    good = np.isfinite(positions).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [positions[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def dash_line(line: Floats, length: float = 0.22) -> list[Floats]:
    """Divide a line into dashes and gaps of equal length, and return the dashes.

    >>> [stroke.tolist() for stroke in dash_line(np.array([[0.0, 0.0], [4.0, 0.0]]), 1.0)]
    [[[0.0, 0.0], [1.0, 0.0]], [[2.0, 0.0], [3.0, 0.0]]]

    Parameters
    ----------
    line
        Points of the line, shape [n, 2].
    length
        Length of dashes and gaps [chart units].
    """
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    edges = np.arange(0.0, along[-1] + 1e-9, length)
    points = np.column_stack([np.interp(edges, along, line[:, 0]), np.interp(edges, along, line[:, 1])])
    return [points[i : i + 2] for i in range(0, len(points) - 1, 2)]


def band_outline(low: Floats, high: Floats) -> list[Floats]:
    """Return the lines along the lower and the upper end of a confidence band, within the height of the chart.

    Parameters
    ----------
    low, high
        Chart positions of the ends, shape [n, 2]; NaN where an end is unknown.
    """
    edges = [np.column_stack([edge[:, 0], clip_to_box(edge[:, 1])]) for edge in (low, high)]
    return [section for edge in edges for section in finite_sections(edge)]


def marker_outlines(positions: Floats, corners: int) -> list[Floats]:
    """Return a closed polygon around each chart position.

    Parameters
    ----------
    positions
        Chart positions, shape [n, 2].
    corners
        Number of corners of the polygon.
    """
    # One side is horizontal and at the bottom, because y points down.
    angle = np.pi / 2.0 + np.pi / corners + 2.0 * np.pi * np.arange(corners + 1) / corners
    polygon = MARKER_RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
    return [position + polygon for position in positions[np.isfinite(positions).all(axis=1)]]


def ring_outline(x: float, y: float) -> Floats:
    """Return a closed line around a chart position, shape [n, 2]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    return np.column_stack([x + RING_RADIUS * np.cos(angle), y + RING_RADIUS * np.sin(angle)])


@dataclass(frozen=True, slots=True)
class ChartGrid:
    """Grid lines, ticks and tick labels of a chart."""

    frame: list[Floats]
    major: list[Floats]
    minor: list[Floats]
    ticks: list[tuple[float, float, str]]  # x, y, label


def chart_grid(scale: ChartDecadeRange, x_unit: str = "") -> ChartGrid:
    """Return grid lines at powers of ten, ticks at their multiples, and labels outside the box of the chart.

    Parameters
    ----------
    scale
        Range of averaging times and Allan deviations.
    x_unit
        Text after the last number of the x axis.
    """
    x_at, x_minor = _line_positions(scale.x, WIDTH)
    y_at, y_minor = _line_positions(scale.y, HEIGHT)
    flip = HEIGHT
    ticks = [
        (x, HEIGHT + 0.15, format_tick(10.0**p) + (x_unit if p == scale.x[1] else ""))
        for x, p in zip(x_at, range(scale.x[0], scale.x[1] + 1), strict=True)
    ]
    ticks += [
        (-1.5, flip - y - LABEL_ABOVE, format_tick(10.0**p))
        for y, p in zip(y_at, range(scale.y[0], scale.y[1] + 1), strict=True)
    ]
    return ChartGrid(
        frame=[np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT], [0, 0]], float)],
        major=[_vertical(x) for x in x_at[1:-1]] + [_horizontal(flip - y) for y in y_at[1:-1]],
        minor=[np.array([[x, HEIGHT - MINOR_TICK], [x, HEIGHT]]) for x in x_minor]
        + [np.array([[0.0, flip - y], [MINOR_TICK, flip - y]]) for y in y_minor],
        ticks=ticks,
    )


def few_tick_labels(scale: ChartDecadeRange, x_unit: str = "") -> list[tuple[float, float, str]]:
    """Return tick labels for a small plot, each given by x, y and text, at every second power of ten of a long axis.

    >>> [text for _, _, text in few_tick_labels(ChartDecadeRange((-2, 2), (1, 3)), " s")]
    ['0.01', '1', '100 s', '10', '100', '1000']

    Parameters
    ----------
    scale
        Range of averaging times and Allan deviations.
    x_unit
        Text after the last number of the x axis.
    """
    (left, right), (bottom, top) = scale.x, scale.y
    x_powers, y_powers = (
        range(low, high + 1, 1 if high - low < MIN_DECADES_OF_LONG_AXIS else 2) for low, high in (scale.x, scale.y)
    )
    across = [
        (
            (power - left) / (right - left) * WIDTH,
            HEIGHT + 0.15,
            format_tick(10.0**power) + (x_unit if power == x_powers[-1] else ""),
        )
        for power in x_powers
    ]
    return across + [
        (-2.5, (top - power) / (top - bottom) * HEIGHT - 2.0 * LABEL_ABOVE, format_tick(10.0**power))
        for power in y_powers
    ]


def _line_positions(span: tuple[int, int], length: float) -> tuple[list[float], list[float]]:
    """Return the positions of the powers of ten along an axis, and the positions of 2 to 9 times each power."""
    per_decade = length / (span[1] - span[0])
    at = [i * per_decade for i in range(span[1] - span[0] + 1)]
    between = [a + math.log10(k) * per_decade for a in at[:-1] for k in range(2, 10)]
    return at, between


def _vertical(x: float) -> Floats:
    return np.array([[x, 0.0], [x, HEIGHT]])


def _horizontal(y: float) -> Floats:
    return np.array([[0.0, y], [WIDTH, y]])
