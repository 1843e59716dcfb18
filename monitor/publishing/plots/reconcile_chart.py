"""Views as drawings: measured, what the model expects, and the band that simulated recordings stay in; text to SVG.

In come ``PlotData``s of one lens (before and after a step, or one alone), out goes one SVG element: panels side by side
with a common height, so that a gap that closes is seen to close. The axes are in the field's units; the unit stands
with the name above the panel, where nothing can cover it. A curve of more points than pixels keeps the smallest and
the largest of each pixel. Written by hand, not by matplotlib: a report has dozens of panels, and one takes a
millisecond and a few kilobytes this way. Nested ``svg`` elements cut what leaves a panel, so that no names are needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.common.units import DEVIATION_UNITS, sensor_kind
from monitor.publishing.plots.allan_figure import COLOURS, DARK, GREY
from monitor.publishing.plots.dynamic_figure import TimeUnit
from monitor.publishing.plots.ruler import Ruler, thinned
from monitor.publishing.reports.reconcile_sentences import field_unit, format_range, words_of
from monitor.reconcile.result import Location, PlotData

LEFT, RIGHT, ABOVE, BELOW = 54.0, 16.0, 28.0, 40.0  # px round a panel, for labels
BAND: Final = "#cfd5dd"
PLACE: Final = "#E69F00"  # Okabe & Ito's orange
PLACE_TEXT: Final = "#8a5a00"
MAJOR: Final = "#dcdcdc"
MINOR: Final = "#f0f0f0"
DOTS: Final = 60  # points at most that are drawn as points
ROOM: Final = 0.06  # of the height, above and below all that is shown
REACH: Final = 0.35  # a band further than this share of the curves' height beyond them is cut
LOWEST: Final = 0.02  # of a logarithmic panel's points may lie below it
LEAST_PX: Final = 5.0  # width of a place
NARROW: Final = 0.08  # of the width: a narrower place has a panel of its own
NEAR: Final = 4.0  # times the width of the place, to either side
NEAR_LEAST: Final = 0.01  # of the width, to either side
POINTS: Final = 8  # at least, round a place
LETTER_PX: Final = 6.6  # width of a letter of a label, about


@dataclass(frozen=True, slots=True)
class Plot:
    """A view in the units that people read."""

    title: str
    x_label: str
    y_label: str
    log: bool
    x: Floats  # [k]
    measured: Floats  # [k]
    expected: Floats
    lo: Floats
    hi: Floats
    mark: tuple[float, float] | None  # along x
    mark_label: str


def chart(
    views: Sequence[tuple[str, PlotData]], axis: str, width: float, height: float, where: Location | None = None
) -> str:
    """An SVG element with a panel a view, all of one lens.

    Args:
        views: a few words for each panel ("before"), and what it shows
        axis: whose it is; gives the colour
        width, height: of the whole drawing, px
        where: a place to mark in the first panel
    """
    plots = [plotted(title, view, axis, where if i == 0 else None) for i, (title, view) in enumerate(views)]
    plots[1:] = [replace(plot, y_label="") for plot in plots[1:]]
    ends, share = height_of(plots), width / len(plots)
    colour = COLOURS[AXES.index(axis) % 3]
    panels = [_panel(plot, colour, i * share, share, height, ends) for i, plot in enumerate(plots)]
    label = escape(f"{axis}: {plots[0].y_label} over {plots[0].x_label}")
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}" font-size="12" fill="{DARK}">'
        f"{''.join(panels)}</svg>"
    )


def view_at(views: Sequence[PlotData], lens: str, where: Location) -> PlotData | None:
    """The picture of a lens; of a lens without one, the first that looks along the place that it found."""
    own = [view for view in views if view.lens == lens]
    return next(iter(own or [view for view in views if along(view, where) is not None]), None)


def along(view: PlotData, where: Location) -> tuple[float, float] | None:
    """The place as far as it lies along x of a view, in the view's unit."""
    match view.x_name, view.x_unit:
        case _, "Hz":
            return where.frequency
        case (("averaging time" | "lag"), _):
            return where.tau
        case "time", _:
            return where.time
        case _, "°C":
            return where.temperature
        case _, "rad/s" | "m/s²":
            return where.value
    return None


def near(view: PlotData, where: Location) -> PlotData | None:
    """The part of a view round a place that is too narrow to be seen in the whole; None where it is not."""
    at = along(view, where)
    if at is None or view.x.size < 2:
        return None
    good = view.x[np.isfinite(view.x) & ((view.x > 0) | (not view.log))]
    ruler = Ruler(float(good.min()), float(good.max()), view.log, 0.0, 1.0)
    a, b = (float(share) for share in ruler.at(np.array(at)))
    if not b - a < NARROW:
        return None
    middle, half = 0.5 * (a + b), max(NEAR * (b - a), NEAR_LEAST)
    share = ruler.at(view.x)
    rows = (share > middle - half) & (share < middle + half)
    if rows.sum() < POINTS:
        return None
    lines = (line[rows] for line in (view.x, view.measured, view.expected, view.lo, view.hi))
    return PlotData(view.lens, view.x_name, view.x_unit, view.y_name, view.y_unit, view.log, *lines)


def plotted(title: str, view: PlotData, axis: str, where: Location | None) -> Plot:
    """A view of an axis in the units that people read, with the place to mark if it lies along x."""
    x_unit, y_unit = field_unit(view.x_unit, _largest(view.x)), field_unit(view.y_unit, _largest(view.measured))
    if view.x_name == "averaging time":  # a deviation stands in the unit of all Allan plots
        y_unit = DEVIATION_UNITS[sensor_kind(axis)] if view.y_unit in ("rad/s", "m/s²") else y_unit
    factor, x_name = x_unit.factor, x_unit.name
    if view.x_name == "time" and not view.log:
        clock = TimeUnit.of(float(np.ptp(view.x)))
        factor, x_name = 1.0 / clock.seconds, clock.name
    mark = None if where is None else along(view, where)
    measured, expected, lo, hi = (line * y_unit.factor for line in (view.measured, view.expected, view.lo, view.hi))
    return Plot(
        title=title,
        x_label=_label(view.x_name, x_name),
        y_label=_label(view.y_name, y_unit.name),
        log=view.log,
        x=view.x * factor,
        measured=measured,
        expected=expected,
        lo=lo,
        hi=hi,
        mark=None if mark is None else (mark[0] * factor, mark[1] * factor),
        mark_label="" if where is None else format_range(where, axis),
    )


def _label(name: str, unit: str) -> str:
    return f"{words_of(name)}, {unit}" if unit else words_of(name)


def _largest(values: Floats) -> float:
    good = values[np.isfinite(values)]
    return float(np.abs(good).max(initial=0.0))


def height_of(plots: Sequence[Plot]) -> tuple[float, float]:
    """Lower and upper end of all panels: curves in full, bands as far as they stay near."""
    log = plots[0].log
    curves = _finite([line for plot in plots for line in (plot.measured, plot.expected)], log)
    if curves.size == 0:
        return (0.1, 10.0) if log else (-1.0, 1.0)
    low, high = float(curves.min()), float(curves.max())
    if log:  # a bin that happens to be almost empty goes down for decades
        low = float(min(np.quantile(curves, LOWEST), _finite([plot.expected for plot in plots], log).min(initial=high)))
    reach = REACH * (high - low)
    bands = _finite([line for plot in plots for line in (plot.lo, plot.hi)], log).clip(low - reach, high + reach)
    low, high = float(bands.min(initial=low)), float(bands.max(initial=high))
    room = ROOM * (high - low) or max(abs(high) * ROOM, 1e-12)
    return (10.0 ** (low - room), 10.0 ** (high + room)) if log else (low - room, high + room)


def _finite(lines: Sequence[Floats], log: bool) -> Floats:
    """All numbers that a panel can show, as logarithms where it has them."""
    values = np.concatenate(lines)
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    return np.log10(values) if log else values


def _panel(plot: Plot, colour: str, left: float, width: float, height: float, ends: tuple[float, float]) -> str:
    wide, high = width - LEFT - RIGHT, height - ABOVE - BELOW
    good = plot.x[np.isfinite(plot.x) & ((plot.x > 0) | (not plot.log))]
    x_ends = (float(good.min()), float(good.max())) if np.ptp(good) > 0 else (0.5, 1.5)
    x, y = Ruler(*x_ends, plot.log, 0.0, wide), Ruler(*ends, plot.log, high, 0.0)
    grid = [(_lines(x.fine(), y.fine(), wide, high), MINOR)]
    grid.append((_lines([at for at, _ in x.ticks()], [at for at, _ in y.ticks()], wide, high), MAJOR))
    inside = [f'<path d="{d}" stroke="{tint}" fill="none"/>' for d, tint in grid if d]
    inside += [_place(plot, x, wide, high), *_curves(plot, colour, x, y), _place_label(plot, x, wide)]
    box = f'<rect x="{left + LEFT:g}" y="{ABOVE:g}" width="{wide:g}" height="{high:g}" fill="none" stroke="#999"/>'
    return (
        f'<svg x="{left + LEFT:g}" y="{ABOVE:g}" width="{wide:g}" height="{high:g}" viewBox="0 0 {wide:g} {high:g}">'
        f"{''.join(inside)}</svg>{box}{_words(plot, x, y, left, wide, high)}"
    )


def _lines(across: Sequence[float], down: Sequence[float], wide: float, high: float) -> str:
    return "".join([f"M{px:.1f} 0V{high:g}" for px in across] + [f"M0 {px:.1f}H{wide:g}" for px in down])


def _curves(plot: Plot, colour: str, x: Ruler, y: Ruler) -> list[str]:
    """Band, measured, expected: the later stands before the earlier."""
    px, floor_px = x.at(plot.x), y.start
    # what has no logarithm is below the panel
    low, high = (np.nan_to_num(y.at(line), nan=floor_px + 9.0) for line in (plot.lo, plot.hi))
    there = np.isfinite(plot.hi)
    edge = [thinned(px[there], line[there]) for line in (low, high)]
    outline = [*zip(*edge[0], strict=True), *zip(*(part[::-1] for part in edge[1]), strict=True)]
    parts = [f'<path d="{_path(outline)}Z" fill="{BAND}"/>'] if outline else []
    shown = thinned(px, y.at(plot.measured))
    points = list(zip(*shown, strict=True))
    wide = 1.1 if len(points) > DOTS else 1.4
    parts.append(f'<path d="{_path(points)}" stroke="{colour}" fill="none" stroke-width="{wide}"/>')
    if len(points) <= DOTS:
        parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.2" fill="{colour}"/>' for a, b in points]
    expected = list(zip(*thinned(px, y.at(plot.expected)), strict=True))
    parts.append(f'<path d="{_path(expected)}" stroke="{DARK}" fill="none" stroke-width="1.3" stroke-dasharray="6 3"/>')
    return parts


def _path(points: Sequence[tuple[float, float]]) -> str:
    """To a tenth of a pixel, each point from the one before: half as long as places would be."""
    if not points:
        return ""
    tenths = np.rint(10.0 * np.array(points)).astype(np.int64)
    ways = " ".join(f"{a / 10:g} {b / 10:g}" for a, b in np.diff(tenths, axis=0).tolist())
    return f"M{tenths[0, 0] / 10:g} {tenths[0, 1] / 10:g}l{ways}" if ways else ""


def _place(plot: Plot, x: Ruler, wide: float, high: float) -> str:
    if plot.mark is None:
        return ""
    a, b = _mark_px(plot.mark, x, wide)
    return f'<rect x="{a:.1f}" y="0" width="{b - a:.1f}" height="{high:g}" fill="{PLACE}" opacity="0.35"/>'


def _place_label(plot: Plot, x: Ruler, wide: float) -> str:
    """On the side of the place that has room."""
    if plot.mark is None:
        return ""
    a, b = _mark_px(plot.mark, x, wide)
    at, anchor = (b + 6, "start") if wide - b > a else (a - 6, "end")
    return (
        f'<text x="{at:.1f}" y="17" text-anchor="{anchor}" fill="{PLACE_TEXT}" font-weight="600" stroke="#fff" '
        f'stroke-width="4" paint-order="stroke">{escape(plot.mark_label)}</text>'
    )


def _mark_px(mark: tuple[float, float], x: Ruler, wide: float) -> tuple[float, float]:
    """Left and right end, never too narrow to be seen."""
    a, b = (float(px) for px in np.nan_to_num(x.at(np.array(mark))).clip(0.0, wide))
    spare = max(0.0, LEAST_PX - (b - a)) / 2
    return a - spare, b + spare


def _words(plot: Plot, x: Ruler, y: Ruler, left: float, wide: float, high: float) -> str:
    """Names above and below, and the ticks' labels, of those along x none that touches the one before."""
    foot = ABOVE + high
    texts = [
        (left + 8, ABOVE - 10, "start", GREY, plot.y_label),
        (left + LEFT + wide, ABOVE - 10, "end", DARK, plot.title),
        (left + LEFT + wide / 2, foot + 33, "middle", GREY, plot.x_label),
    ]
    texts += [(left + LEFT - 6, ABOVE + px + 4, "end", DARK, label) for px, label in y.ticks()]
    free = -np.inf
    for px, label in x.ticks():
        half = 0.5 * LETTER_PX * len(label)
        if px - half > free:
            texts.append((left + LEFT + px, foot + 16, "middle", DARK, label))
            free = px + half + LETTER_PX
    return "".join(
        f'<text x="{a:.1f}" y="{b:.1f}" text-anchor="{anchor}" fill="{tint}">{escape(text)}</text>'
        for a, b, anchor, tint, text in texts
        if text
    )
