"""Plot of the Allan deviation over time (dynamic Allan deviation), with heat maps and noise coefficients.

The time axis shows the end of the sliding window. The colours of a heat map show how far the 95 % interval of the Allan
deviation lies from its median over time. Cells are white if the interval contains the median. A noise coefficient has a
panel if it is estimated in at least 5 % of the time steps. A vertical line marks a detected change.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import COEFFICIENT_NAMES, DEFAULT_UNITS, KIND_NAMES, Kind, Unit, UnitSystem, axes_of
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing.plots import style
from monitor.publishing.plots.change_beyond_chance import log_change_beyond_chance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure, SubFigure

HEAT_MAP_INCHES: Final = 1.35
COEFFICIENT_INCHES: Final = 1.6
SPARE_INCHES: Final = 1.2  # height of title, colour bar and time axis
MIN_ESTIMATED_SHARE: Final = 0.05  # a coefficient that is estimated in a smaller share of the time steps has no panel
MIN_LABEL_DISTANCE: Final = 0.13  # smallest distance between two labels of changes, as a share of the width
COLOUR_SCALE_RATIOS: Final = (2.0, 3.0, 5.0, 10.0)  # possible upper ends; a smaller end would emphasize chance
MIN_CELLS_IN_SCALE: Final = 0.95  # smallest share of the changed cells inside the colour scale
BAND_ENDS_INSIDE: Final = 0.9  # share of the ends of confidence bands that lie inside a panel


@dataclass(frozen=True, slots=True)
class ChangeMark:
    """Time and axis of a detected change that is marked in the plot."""

    t_s: float  # time since the first sample
    axis: str


def _shown_coefficients(dynamic: DynamicAllan, kind: Kind) -> tuple[str, ...]:
    columns = [AXES.index(axis) for axis in axes_of(kind)]
    share = (dynamic.status[:, :, columns] == Status.ESTIMATED).mean(axis=0).max(axis=1)
    return tuple(letter for letter, one in zip(SYMBOLS, share, strict=True) if one >= MIN_ESTIMATED_SHARE)


def _shown_axes(dynamic: DynamicAllan, kind: Kind) -> tuple[str, ...]:
    return tuple(a for a in axes_of(kind) if bool(np.isfinite(dynamic.deviation[:, :, AXES.index(a)]).any()))


def dynamic_figure_height_inches(dynamic: DynamicAllan, kind: Kind) -> float:
    """Return the height of the figure that ``draw_dynamic_panels`` needs [inches].

    Parameters
    ----------
    dynamic
        Allan deviations over time.
    kind
        Kind of sensor: gyro or accel.
    """
    heat_maps, coefficients = len(_shown_axes(dynamic, kind)), len(_shown_coefficients(dynamic, kind))
    return SPARE_INCHES + HEAT_MAP_INCHES * heat_maps + COEFFICIENT_INCHES * coefficients


def log_changes(dynamic: DynamicAllan) -> Floats:
    """Return the changes of the Allan deviations beyond chance, natural logarithms, shape [T, m, 6]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = [np.log(part) for part in (dynamic.deviation, dynamic.lo, dynamic.hi)]
    logs[0] = np.where(np.isfinite(logs[0]), logs[0], np.nan)
    return log_change_beyond_chance(*logs)


def draw_dynamic_panels(
    figure: "Figure | SubFigure",
    dynamic: DynamicAllan,
    kind: Kind,
    marks: Sequence[ChangeMark] = (),
    units: UnitSystem = DEFAULT_UNITS,
) -> None:
    """Draw heat maps and noise coefficients of the gyroscopes or the accelerometers over time.

    Parameters
    ----------
    figure
        Empty figure in which the panels are drawn.
    dynamic
        Allan deviations over time.
    kind
        Kind of sensor: gyro or accel.
    marks
        Detected changes to mark. Changes on axes of the other kind are ignored.
    units
        Units of the coefficients.
    """
    axes, letters = _shown_axes(dynamic, kind), _shown_coefficients(dynamic, kind)
    ratios = [HEAT_MAP_INCHES] * len(axes) + [COEFFICIENT_INCHES] * len(letters)
    panels = list(figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0])
    unit, unit_s = style.select_time_unit(float(dynamic.t_s[-1]))
    edges = _time_edges(dynamic.t_s) / unit_s
    changes, mesh = log_changes(dynamic)[..., [AXES.index(axis) for axis in axes]], None
    ratio = _colour_scale_end(changes)
    for i, (panel, axis) in enumerate(zip(panels, axes, strict=False)):
        mesh = _draw_heat_map(panel, axis, edges, _tau_edges(dynamic.tau_s), changes[..., i].T, ratio)
    for panel, letter in zip(panels[len(axes) :], letters, strict=True):
        _draw_coefficient(panel, dynamic, kind, letter, dynamic.t_s / unit_s, units.coefficients[kind][letter])
    panels[0].set_xlim(edges[0], edges[-1])
    inside = [mark for mark in marks if mark.axis in axes and edges[0] <= mark.t_s / unit_s <= edges[-1]]
    for panel, axis in zip(panels, axes, strict=False):
        _draw_changes(panel, panels[len(axes) :], axis, [mark.t_s / unit_s for mark in inside if mark.axis == axis])
    panels[0].set_title(KIND_NAMES[kind])
    panels[-1].set_xlabel(f"time at the end of the window of {dynamic.window_s:.4g} s, {unit}")
    figure.align_ylabels(panels)
    if mesh is not None:
        _draw_colour_bar(figure, mesh, panels[: len(axes)], ratio)


def _draw_changes(heat_map: "Axes", others: "Sequence[Axes]", axis: str, times: Sequence[float]) -> None:
    left, right = heat_map.get_xlim()
    distance = MIN_LABEL_DISTANCE * (right - left)
    for t in times:
        heat_map.axvline(t, color=style.DARK, linewidth=1.1, linestyle=style.DASHES)
        for panel in others:
            panel.axvline(t, color=style.axis_colour(axis), linewidth=1.1, linestyle=style.DASHES)
    for near in _group_times(np.clip(times, left + distance / 2.0, right - distance / 2.0).tolist(), distance):
        heat_map.annotate(
            "change" if len(near) == 1 else f"{len(near)} changes", (sum(near) / len(near), 1.0), (0, -4),
            xycoords=("data", "axes fraction"), textcoords="offset points",
            ha="center", va="top", fontsize=style.SMALL_TEXT, color=style.DARK,
            bbox=style.LABEL_BOX,
        )  # fmt: skip


def _group_times(times: Sequence[float], distance: float) -> list[list[float]]:
    """Group times so that the mean times of neighbouring groups are at least ``distance`` apart.

    >>> _group_times([1.0, 9.0, 1.5, 2.0], 2.0)
    [[1.0, 1.5, 2.0], [9.0]]
    """
    groups: list[list[float]] = []
    for time in sorted(times):
        groups.append([time])
        # The mean time of a merged group may now be too close to that of the previous group.
        while len(groups) > 1 and float(np.mean(groups[-1]) - np.mean(groups[-2])) < distance:
            groups[-2:] = [groups[-2] + groups[-1]]
    return groups


def _draw_heat_map(
    panel: "Axes", axis: str, time_edges: Floats, tau_edges: Floats, changes: Floats, ratio: float
) -> "QuadMesh":
    mesh = panel.pcolormesh(
        time_edges, tau_edges, changes,
        cmap="RdBu_r", vmin=-np.log(ratio), vmax=np.log(ratio), rasterized=True, linewidth=0,
    )  # fmt: skip
    panel.set_yscale("log")
    style.style_log_axis(panel, "y", minor_grid=False)
    panel.grid(False)
    panel.set_facecolor("#f4f4f4")
    panel.set_ylabel(f"{axis}   τ, s")
    return mesh


def _draw_colour_bar(figure: "Figure | SubFigure", mesh: "QuadMesh", panels: "list[Axes]", ratio: float) -> None:
    bar = figure.colorbar(mesh, ax=panels, aspect=30, pad=0.015, fraction=0.05)
    ticks = np.log(ratio) * np.linspace(-1.0, 1.0, 5)
    bar.set_ticks(ticks.tolist(), labels=[f"× {np.exp(tick):.2g}" for tick in ticks])
    bar.ax.tick_params(labelsize=style.SMALL_TEXT)
    bar.set_label("change of the deviation beyond chance", fontsize=style.SMALL_TEXT)
    bar.outline.set_visible(False)


def _draw_coefficient(panel: "Axes", dynamic: DynamicAllan, kind: Kind, letter: str, t: Floats, unit: Unit) -> None:
    row = SYMBOLS.index(letter)
    values, ends = [], []
    for axis in axes_of(kind):
        i, colour = AXES.index(axis), style.axis_colour(axis)
        estimated = dynamic.status[:, row, i] == Status.ESTIMATED
        value, lo, hi = (
            np.where(estimated, part[:, row, i] * unit.factor, np.nan)
            for part in (dynamic.value, dynamic.value_lo, dynamic.value_hi)
        )
        style.draw_band(panel, t, lo, hi, colour, rasterized=True)  # a vector image would be large
        panel.plot(t, value, color=colour, label=axis)
        alone = _isolated(estimated)
        panel.plot(t[alone], value[alone], ".", color=colour, markersize=3.5)
        values.append(value)
        ends.append((lo, hi))
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    style.choose_y_scale_and_limits(panel, low, high, 0.25)
    if not (low > 0 and high > style.LOG_SCALE_RATIO * low):
        lowest, highest = np.nanquantile(ends, [1.0 - BAND_ENDS_INSIDE, BAND_ENDS_INSIDE]).tolist()
        bottom, top = panel.get_ylim()
        panel.set_ylim(max(min(bottom, lowest), 0.0), max(top, highest))
    panel.set_ylabel(f"{letter}, {unit.name}")
    panel.set_title(COEFFICIENT_NAMES[kind][letter], fontsize=9, color=style.GREY, pad=3)
    style.draw_legend_above(panel, 3, fontsize=style.SMALL_TEXT)


def _isolated(estimated: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of estimated points without estimated neighbours, which a line plot does not show."""
    padded = np.concatenate([[False], estimated, [False]])
    return np.asarray(estimated & ~padded[:-2] & ~padded[2:])


def _colour_scale_end(changes: Floats) -> float:
    size = np.abs(changes[np.isfinite(changes) & (changes != 0.0)])
    needed = float(np.exp(np.quantile(size, MIN_CELLS_IN_SCALE))) if size.size else 1.0
    return next((ratio for ratio in COLOUR_SCALE_RATIOS if ratio >= needed), COLOUR_SCALE_RATIOS[-1])


def _time_edges(t: Floats) -> Floats:
    half = (t[1] - t[0]) / 2.0 if t.size > 1 else t[0] / 40.0
    return np.append(t - half, t[-1] + half)


def _tau_edges(tau_s: Floats) -> Floats:
    """Return the edges of the heat map cells, which are geometric means of neighbouring averaging times."""
    if tau_s.size == 1:
        return np.array([0.7, 1.4]) * float(tau_s[0])
    middle = np.sqrt(tau_s[1:] * tau_s[:-1])
    return np.asarray(np.concatenate([[tau_s[0] ** 2 / middle[0]], middle, [tau_s[-1] ** 2 / middle[-1]]]))
