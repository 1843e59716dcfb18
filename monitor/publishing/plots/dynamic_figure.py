"""Plot of the dynamic Allan deviation of one kind of sensor: heat maps over time, and the coefficients Q(t) … R(t).

All panels share one time axis, the end of the window. A heat map shows each τ over time, coloured by the deviation
relative to its median over time, so all τ share one scale. Red is above the median, blue below. Cells whose 95 %
interval contains the median are pale, because their colour is not significant. Coefficients are drawn if they are
estimated for some time on some axis, with their intervals as bands. A line is interrupted where there is no estimate.
A change is a labelled vertical line through the heat map of its axis and, in the colour of the axis, through the
coefficient panels. Changes too close to each other share a label.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.quantities import DAY_S, HOUR_S
from drivers.sample import AXES, Floats
from monitor.common.units import COEFFICIENT_NAMES, COEFFICIENT_UNITS, KIND_NAMES, Kind, axes_of
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.fit.coefficients import SYMBOLS, Status
from monitor.publishing.plots.allan_figure import COLOURS, DARK, GREY, set_log_ticks, style_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure, SubFigure

SURFACE_INCHES: Final = 1.35
LINE_INCHES: Final = 1.6
SPARE_INCHES: Final = 1.2  # height of title, colour bar and time axis
MIN_ESTIMATED_SHARE: Final = 0.05  # smallest share of time steps with an estimate for a coefficient to have a panel
PALE_ALPHA: Final = 0.3
DASHED_LINE: Final = (0, (4, 2))
MIN_LABEL_DISTANCE: Final = 0.13  # smallest distance between two labels, as a share of the width
COLOUR_SCALE_RATIOS: Final = (
    1.25,
    1.5,
    2.0,
    3.0,
    5.0,
    10.0,
)  # possible ends of the colour scale; the first that holds most cells
BANDS: Final = 0.9  # share of the ends of the bands inside a panel; the widest would determine its scale
LOG_SCALE_RATIO: Final = 3.0  # ratio of largest to smallest value above which a logarithmic scale is used
UNITS_S: Final = (("s", 1.0, 600.0), ("min", 60.0, 3.0 * HOUR_S), ("h", HOUR_S, 3.0 * DAY_S), ("d", DAY_S, np.inf))


@dataclass(frozen=True, slots=True)
class ChangeMark:
    """Change of one axis to mark in the plot."""

    t_s: float  # time since the first sample
    axis: str


@dataclass(frozen=True, slots=True)
class TimeUnit:
    """Unit of a time axis."""

    name: str
    seconds: float

    @classmethod
    def of(cls, span_s: float) -> "TimeUnit":
        """Return the unit that suits a time span given in seconds.

        >>> TimeUnit.of(7200.0).name, TimeUnit.of(5e5).name
        ('min', 'd')
        """
        return next(cls(name, seconds) for name, seconds, below in UNITS_S if span_s < below)


def panel_letters(dynamic: DynamicAllan, kind: Kind) -> tuple[str, ...]:
    """Return the coefficients that are estimated often enough to have a panel.

    Parameters
    ----------
    dynamic
        Dynamic curves.
    kind
        Kind of sensor.
    """
    columns = [AXES.index(axis) for axis in axes_of(kind)]
    share = (dynamic.status[:, :, columns] == Status.ESTIMATED).mean(axis=0).max(axis=1)
    return tuple(letter for letter, one in zip(SYMBOLS, share, strict=True) if one >= MIN_ESTIMATED_SHARE)


def axes_shown(dynamic: DynamicAllan, kind: Kind) -> tuple[str, ...]:
    """Return the measured axes of a kind of sensor.

    Parameters
    ----------
    dynamic
        Dynamic curves.
    kind
        Kind of sensor.
    """
    return tuple(a for a in axes_of(kind) if bool(np.isfinite(dynamic.deviation[:, :, AXES.index(a)]).any()))


def height_inches(dynamic: DynamicAllan, kind: Kind) -> float:
    """Return the height of the figure [inches].

    Parameters
    ----------
    dynamic
        Dynamic curves.
    kind
        Kind of sensor.
    """
    surfaces, lines = len(axes_shown(dynamic, kind)), len(panel_letters(dynamic, kind))
    return SPARE_INCHES + SURFACE_INCHES * surfaces + LINE_INCHES * lines


def relative(dynamic: DynamicAllan) -> Floats:
    """Return the deviation divided by its median over time, shape [T, m, 6]; NaN if missing or if the median is 0.

    >>> from monitor.estimation.allan.dynamic_allan import compute_dynamic_allan as of
    >>> steady = of(np.random.default_rng(1).standard_normal((3000, 6)), 10.0, 100.0)
    >>> bool(np.allclose(np.median(relative(steady), axis=0), 1.0))
    True
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return dynamic.deviation / _median(dynamic)


def dynamic_panels(
    figure: "Figure | SubFigure", dynamic: DynamicAllan, kind: Kind, marks: Sequence[ChangeMark] = ()
) -> None:
    """Draw the panels of one kind of sensor.

    Parameters
    ----------
    figure
        Figure to fill.
    dynamic
        Dynamic curves.
    kind
        Kind of sensor.
    marks
        Changes of all axes; those of this kind are drawn.
    """
    axes, shown = axes_shown(dynamic, kind), panel_letters(dynamic, kind)
    ratios = [SURFACE_INCHES] * len(axes) + [LINE_INCHES] * len(shown)
    panels = figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    clock = TimeUnit.of(float(dynamic.t_s[-1]))
    edges = _edges(dynamic.t_s) / clock.seconds
    ratio, mesh = _colour_scale_end(relative(dynamic)[..., [AXES.index(axis) for axis in axes]]), None
    for panel, axis in zip(panels, axes, strict=False):
        mesh = _draw_heat_map(panel, dynamic, axis, edges, ratio)
    for panel, letter in zip(panels[len(axes) :], shown, strict=True):
        _draw_coefficient(panel, dynamic, kind, letter, dynamic.t_s / clock.seconds)
    for panel in panels:
        panel.set_xlim(edges[0], edges[-1])
    own = [mark for mark in marks if mark.axis in axes and edges[0] <= mark.t_s / clock.seconds <= edges[-1]]
    _draw_changes(list(panels), axes, own, clock)
    panels[0].set_title(KIND_NAMES[kind], loc="left", fontsize=12)
    panels[-1].set_xlabel(f"time at the end of the window of {dynamic.window_s:.4g} s, {clock.name}")
    figure.align_ylabels(list(panels))
    if mesh is not None:
        _draw_colour_bar(figure, mesh, list(panels[: len(axes)]), ratio)


def _draw_changes(panels: "Sequence[Axes]", axes: Sequence[str], marks: Sequence[ChangeMark], clock: TimeUnit) -> None:
    """Draw changes as vertical lines, with labels in the heat map of their axis."""
    left, right = panels[0].get_xlim()
    apart = MIN_LABEL_DISTANCE * (right - left)
    for panel, axis in zip(panels, axes, strict=False):
        times = [mark.t_s / clock.seconds for mark in marks if mark.axis == axis]
        for at in times:
            panel.axvline(at, color=DARK, linewidth=1.1, linestyle=DASHED_LINE)
            for course in panels[len(axes) :]:
                course.axvline(at, color=COLOURS[AXES.index(axis) % 3], linewidth=1.1, linestyle=DASHED_LINE)
        for near in _group_times(np.clip(times, left + apart / 2.0, right - apart / 2.0).tolist(), apart):
            panel.annotate(
                "change" if len(near) == 1 else f"{len(near)} changes", (sum(near) / len(near), 1.0), (0, -4),
                xycoords=("data", "axes fraction"), textcoords="offset points",
                ha="center", va="top", fontsize=8, color=DARK,
                bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.9},
            )  # fmt: skip


def _group_times(times: Sequence[float], apart: float) -> list[list[float]]:
    """Group times so that the means of neighbouring groups are at least ``apart`` apart.

    >>> _group_times([1.0, 9.0, 1.5, 2.0], 2.0)
    [[1.0, 1.5, 2.0], [9.0]]
    """
    heaps = [[time] for time in sorted(times)]
    at = 1
    while at < len(heaps):
        before, this = heaps[at - 1], heaps[at]
        if sum(this) / len(this) - sum(before) / len(before) < apart:
            heaps[at - 1 : at + 1] = [before + this]
            at = max(at - 1, 1)  # the mean of the group has changed
        else:
            at += 1
    return heaps


def _draw_heat_map(panel: "Axes", dynamic: DynamicAllan, axis: str, edges: Floats, ratio: float) -> "QuadMesh":
    """Draw the heat map of one axis, time by τ."""
    from matplotlib.ticker import NullLocator

    i = AXES.index(axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        colour = np.log(relative(dynamic)[:, :, i].T)
    median = _median(dynamic)[:, :, i]
    usual = (dynamic.lo[:, :, i] <= median) & (median <= dynamic.hi[:, :, i])
    end = np.log(ratio)
    pale: Any = np.where(usual.T, PALE_ALPHA, 1.0)  # matplotlib accepts an array, but its type hints do not
    mesh = panel.pcolormesh(
        edges, _edges_of_tau(dynamic.tau_s), colour,
        cmap="RdBu_r", vmin=-end, vmax=end, alpha=pale, rasterized=True, linewidth=0,
    )  # fmt: skip
    panel.set_yscale("log")
    panel.yaxis.set_minor_locator(NullLocator())
    panel.set_facecolor("#f4f4f4")
    panel.spines[["top", "right"]].set_visible(False)
    panel.set_ylabel(f"{axis}   τ, s")
    return mesh


def _draw_colour_bar(figure: "Figure | SubFigure", mesh: "QuadMesh", panels: "list[Axes]", ratio: float) -> None:
    """Draw the colour scale, labelled with factors."""
    from matplotlib.cm import ScalarMappable

    # A separate mappable is used, because the colour bar of the mesh would be as pale as its cells.
    bar = figure.colorbar(ScalarMappable(mesh.norm, mesh.cmap), ax=panels, aspect=30, pad=0.015, fraction=0.05)
    ticks = [-np.log(ratio), -np.log(ratio) / 2, 0.0, np.log(ratio) / 2, np.log(ratio)]
    bar.set_ticks(ticks, labels=[f"× {np.exp(tick):.2g}" for tick in ticks])
    bar.ax.tick_params(labelsize=8)
    bar.set_label("deviation over its median; pale: within 95 %", fontsize=8)
    bar.outline.set_visible(False)


def _draw_coefficient(panel: "Axes", dynamic: DynamicAllan, kind: Kind, letter: str, t: Floats) -> None:
    """Draw one coefficient of three axes over time."""
    row, unit = SYMBOLS.index(letter), COEFFICIENT_UNITS[kind][letter]
    held, ends = [], []
    for axis, colour in zip(axes_of(kind), COLOURS, strict=True):
        i = AXES.index(axis)
        estimated = dynamic.status[:, row, i] == Status.ESTIMATED
        value, lo, hi = (
            np.where(estimated, part[:, row, i] * unit.factor, np.nan)
            for part in (dynamic.value, dynamic.value_lo, dynamic.value_hi)
        )
        # Bands have hundreds of corners; rasterized, they do not enlarge a report.
        panel.fill_between(t, lo, hi, color=colour, alpha=0.15, linewidth=0, rasterized=True)
        panel.plot(t, value, "-", color=colour, linewidth=1.4, label=axis)
        alone = _isolated(estimated)
        panel.plot(t[alone], value[alone], ".", color=colour, markersize=3.5)
        held.append(value)
        ends.append((lo, hi))
    low, high = np.nanmin(held), np.nanmax(held)
    if low > 0 and high > LOG_SCALE_RATIO * low:
        panel.set_yscale("log")
        panel.set_ylim(low / 1.5, high * 1.5)
        set_log_ticks(panel)
    else:
        room = 0.25 * (high - low) + 0.02 * high
        lowest, highest = np.nanquantile(ends, [1.0 - BANDS, BANDS]).tolist()
        panel.set_ylim(max(min(low - room, lowest), 0.0), max(high + room, highest))
    panel.set_ylabel(f"{letter}, {unit.name}")
    panel.set_title(COEFFICIENT_NAMES[kind][letter], loc="left", fontsize=9, color=GREY, pad=3)
    style_grid(panel)
    panel.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, frameon=False,
        ncols=3, fontsize=8, handlelength=1.2, columnspacing=1.0,
    )  # fmt: skip


def _isolated(there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the points without a neighbour, which no line shows."""
    padded = np.concatenate([[False], there, [False]])
    return np.asarray(there & ~padded[:-2] & ~padded[2:])


def _median(dynamic: DynamicAllan) -> Floats:
    """Return the median of the deviation over time, shape [1, m, 6]; NaN if there is none."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # raised for an axis that is not measured
        median = np.nanmedian(dynamic.deviation, axis=0, keepdims=True)
    return np.asarray(np.where(median > 0.0, median, np.nan))


def _colour_scale_end(ratios: Floats) -> float:
    """Return the end of the colour scale, which holds 95 % of the cells."""
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.abs(np.log(ratios))
    size = size[np.isfinite(size)]
    most = float(np.exp(np.quantile(size, 0.95))) if size.size else COLOUR_SCALE_RATIOS[0]
    return next((ratio for ratio in COLOUR_SCALE_RATIOS if ratio >= most), COLOUR_SCALE_RATIOS[-1])


def _edges(t: Floats) -> Floats:
    """Return the edges of the cells around equally spaced times."""
    half = (t[1] - t[0]) / 2.0 if t.size > 1 else t[0] / 40.0
    return np.append(t - half, t[-1] + half)


def _edges_of_tau(tau_s: Floats) -> Floats:
    """Return the edges of the cells around the τ, at the means of their logarithms."""
    if tau_s.size == 1:
        return np.array([0.7, 1.4]) * float(tau_s[0])
    middle = np.sqrt(tau_s[1:] * tau_s[:-1])
    return np.asarray(np.concatenate([[tau_s[0] ** 2 / middle[0]], middle, [tau_s[-1] ** 2 / middle[-1]]]))
