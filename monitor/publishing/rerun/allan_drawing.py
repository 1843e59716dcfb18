"""Allan plots in the viewer, with measured deviations, intervals, fitted deviations and the noise model.

Rerun draws a plot as lines and points in chart units. For programs that read the Rerun recording, the entity of each
axis therefore also contains the Allan deviations in SI units. Importing this module imports Rerun.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import rerun as rr

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import DEFAULT_UNITS, KINDS, Kind, UnitSystem, axes_of
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.publishing.plots import axis_colours
from monitor.publishing.plots.allan_figure import coefficient_rings, tau_of_minimum_s
from monitor.publishing.plots.axis_colours import Colour
from monitor.publishing.rerun.allan_chart_geometry import (
    HEIGHT,
    LABEL_ABOVE,
    RING_RADIUS,
    WIDTH,
    ChartDecadeRange,
    band_outline,
    chart_grid,
    dash_line,
    decade_range,
    few_tick_labels,
    finite_sections,
    marker_outlines,
    ring_outline,
)

KEY: Final = {
    "measured": "measured",
    "fit": "fit",
    "band": "95 %",
    "ring": "N, B, K",
    "model": "model",
    "poor": "poor fit",
}
"""Text shown next to each symbol in the key, indexed by the last part of the symbol's path."""
FIT_COLOURS: Final = (axis_colours.VERMILION, axis_colours.GREEN, axis_colours.BLUE)
KEY_COLUMNS: Final = 3
KEY_SPACING: Final = 6.0
KEY_ROW: Final = 1.25
KEY_BELOW: Final = 2.15
"""Distance of the first row of the key below the plot [chart units]."""
KEY_TEXT: Final = 3.3
GRID_DASH: Final = 0.15
FEW_TICKS: Final = "few_ticks"
"""Last part of the path of the tick labels for small plots."""
LETTER_OFFSETS: Final = {"N": (-0.8, -LABEL_ABOVE), "B": (0.8, -LABEL_ABOVE), "K": (0.8, -LABEL_ABOVE)}
"""Position of each letter relative to its lowest ring, if the plot has no space below this ring."""
FIT_WIDTH: Final = 1.25  # half of the line width [points of the screen]
MODEL_WIDTH: Final = 0.75
RING_WIDTH: Final = 0.9
MARKER_WIDTH: Final = 0.8
DOT_RADIUS: Final = 2.5
MARKER_CORNERS: Final = {"y": 4, "z": 3}
"""Number of corners of each axis's marker. The marker of an x axis is a dot."""
POOR_FIT_TEXT: Final = "fit does not describe the curve"
DISCONNECTED_TEXT: Final = "no connection"

Log = Callable[..., Any]
"""Function that logs components under the path of a Rerun entity."""


class AllanPlotPair:
    """Allan plots of one device, one for the gyroscopes and one for the accelerometers.

    Parameters
    ----------
    log
        Function that logs a Rerun entity.
    path
        Path of the entities in the Rerun recording.
    units
        Units of the plots.
    """

    def __init__(self, log: Log, path: str, units: UnitSystem = DEFAULT_UNITS) -> None:
        self._log = log
        self._path = path
        self._drawn: dict[Kind, tuple[ChartDecadeRange, list[str], list[str]]] = {}  # grid, signs, poorly fitted axes
        self._units = units
        self._disconnected: set[Kind] = set()  # plots that show DISCONNECTED_TEXT

    def draw(self, estimate: Estimate, gap: ModelComparison | None) -> None:
        """Draw the Allan deviations of an estimate.

        Parameters
        ----------
        estimate
            Estimate with the measured and fitted Allan deviations.
        gap
            Comparison with the noise model, which is drawn as dashed lines. None if the device has no model.
        """
        for kind in KINDS:
            factor = self._units.deviation(kind).factor
            found = (_Curve.from_estimate(estimate, axis, gap, factor) for axis in axes_of(kind))
            curves = [curve for curve in found if curve is not None]
            if not curves:
                continue
            scale = ChartDecadeRange(
                decade_range(one.tau for one in curves),
                decade_range(part for one in curves for part in one.curves_that_set_y_range),
            )
            poor = [one.axis for one in curves if one.poorly_fitted]
            signs = _signs_in_use(curves)
            frame = scale, signs, poor
            if self._drawn.get(kind) != frame:
                self._drawn[kind] = frame
                self._draw_grid(kind, scale, [one.axis for one in curves])
                self._draw_key(kind, signs, poor)
            lines = [line for curve in curves for line in self._draw_points_and_list_lines(scale, curve)]
            rings, letters = self._rings_and_letters(kind, scale, estimate)
            lines += rings
            self._log(
                f"{self._path}/{kind}/curves",
                rr.LineStrips2D(
                    [line.points for line in lines],
                    colors=[line.colour for line in lines],
                    radii=rr.Radius.ui_points([line.radius for line in lines]),
                    draw_order=10.0,
                ),
            )
            self._log(f"{self._path}/{kind}/letters", letters)

    def show_connection(self, connected: bool) -> None:
        """Write into each drawn plot that it is not updated while the device is not connected."""
        for kind in self._drawn:
            if connected == (kind in self._disconnected):
                self._disconnected ^= {kind}
                text = [] if connected else [(WIDTH / 2, 1.5, DISCONNECTED_TEXT)]
                self._log(f"{self._path}/{kind}/disconnected", label_points(text))

    def _draw_grid(self, kind: Kind, scale: ChartDecadeRange, axes: Sequence[str]) -> None:
        path = f"{self._path}/{kind}"
        log_grid(self._log, path, scale, f"{path}/ticks", x_unit=" s")
        self._log(f"{path}/{FEW_TICKS}", label_points(few_tick_labels(scale, " s")))
        at = {axis: np.array([4.0 * i + 4.6, -0.9]) for i, axis in enumerate(axes)}
        strokes = [position + np.array([[-0.7, 0.0], [0.7, 0.0]]) for position in at.values()]
        log_lines(
            self._log, f"{path}/legend/strokes", strokes, [axis_colours.AXIS_COLOURS[axis] for axis in at], 1.25, 30.0
        )
        for axis, position in at.items():
            log_markers(self._log, f"{path}/legend/{axis}", position[None], axis)
        self._log(f"{path}/legend", label_points([(x + 1.6, y - LABEL_ABOVE, axis) for axis, (x, y) in at.items()]))

    def _draw_key(self, kind: Kind, signs: Sequence[str], poor: Sequence[str]) -> None:
        """Draw a key of the signs below the plot, and name the axes with a poor fit inside the plot."""
        path, grey = f"{self._path}/{kind}/key", axis_colours.GREY
        at = {
            sign: np.array([KEY_SPACING * (i % KEY_COLUMNS), HEIGHT + KEY_BELOW + KEY_ROW * (i // KEY_COLUMNS)])
            for i, sign in enumerate(signs)
        }
        line = np.array([[0.0, 0.0], [1.2, 0.0]])
        strokes: dict[str, Callable[[Floats], list[Floats]]] = {
            "fit": lambda xy: [xy + line / 3.0 + [0.4 * i, 0.0] for i in range(3)],
            "band": lambda xy: [xy + line - [0.0, 0.2], xy + line + [0.0, 0.2]],
            "ring": lambda xy: [ring_outline(xy[0] + 0.6, xy[1])],
            "model": lambda xy: dash_line(xy + line),
            "poor": lambda xy: [xy + line],
        }
        for sign, draw in strokes.items():
            colours = FIT_COLOURS if sign == "fit" else [grey]
            log_lines(self._log, f"{path}/{sign}", draw(at[sign]) if sign in at else [], colours, 1.0, 10.0)
        dot = at["measured"] + [0.6, 0.0]
        self._log(path, rr.Points2D([dot], colors=[grey], radii=rr.Radius.ui_points(3.0), draw_order=20.0))
        self._log(
            f"{path}/text", label_points([(x + KEY_TEXT, y - LABEL_ABOVE, KEY[sign]) for sign, (x, y) in at.items()])
        )
        note = [(WIDTH / 2, 0.2, f"{', '.join(poor)}: {POOR_FIT_TEXT}")] if poor else []
        self._log(f"{self._path}/{kind}/note", label_points(note))

    def _rings_and_letters(
        self, kind: Kind, scale: ChartDecadeRange, estimate: Estimate
    ) -> "tuple[list[_Line], rr.Points2D]":
        """Return rings where N, B or K is read, and one label for the rings of all axes."""
        factor, minimum_tau_s = self._units.deviation(kind).factor, tau_of_minimum_s(estimate, kind)
        letters: dict[str, list[Floats]] = {}
        lines: list[_Line] = []
        for axis in axes_of(kind):
            i = AXES.index(axis)
            rings = coefficient_rings(estimate, i, factor, minimum_tau_s, 0.0)
            at = {
                one.letter: scale.to_chart_positions(np.array([one.tau_s]), np.array([one.sigma]))[0]
                for one in rings
                if one.letter in LETTER_OFFSETS
            }
            inside = {letter: xy for letter, xy in at.items() if 0.0 <= xy[0] <= WIDTH and 0.0 <= xy[1] <= HEIGHT}
            for letter, xy in inside.items():
                lines.append(_Line(ring_outline(*xy), axis_colours.AXIS_COLOURS[axis], RING_WIDTH))
                letters.setdefault(letter, []).append(xy)
        labels = []
        for letter, positions in letters.items():
            lowest = max(positions, key=lambda xy: float(xy[1]))
            space_below = HEIGHT - lowest[1] > RING_RADIUS + 2.0 * LABEL_ABOVE
            x, y = lowest + ((0.0, RING_RADIUS) if space_below else LETTER_OFFSETS[letter])
            labels.append((float(x), float(y), letter))
        return lines, label_points(labels)

    def _draw_points_and_list_lines(self, scale: ChartDecadeRange, curve: "_Curve") -> "list[_Line]":
        """Draw the measured deviations of one axis, and return its confidence band, fit, model and markers as lines."""
        colour, grey = axis_colours.AXIS_COLOURS[curve.axis], axis_colours.GREY
        low, high, fitted, model, deviation = (
            scale.to_chart_positions(curve.tau, part)
            for part in (curve.lo, curve.hi, curve.fitted, curve.model, curve.deviation)
        )
        corners = MARKER_CORNERS.get(curve.axis[-1])
        dot = rr.Radius.ui_points(DOT_RADIUS if corners is None else 0.0)
        points = rr.Points2D(deviation, colors=[colour], radii=dot, draw_order=20.0)
        self._log(f"{self._path}/{curve.axis}", points, rr.AnyValues(drop_untyped_nones=True, **curve.si))
        dashes = [stroke for section in finite_sections(model) for stroke in dash_line(section)]
        markers = [] if corners is None else marker_outlines(deviation, corners)
        styles = (
            (band_outline(low, high), colour, 0.4),
            (finite_sections(fitted), grey if curve.poorly_fitted else colour, FIT_WIDTH),
            (dashes, grey, MODEL_WIDTH),
            (markers, colour, MARKER_WIDTH),
        )
        return [_Line(strip, tint, width) for strips, tint, width in styles for strip in strips]


@dataclass(frozen=True, slots=True)
class _Line:
    """Line with its colour and half of its width in points of the screen."""

    points: Floats  # [n, 2]
    colour: Colour
    radius: float


@dataclass(frozen=True)
class _Curve:
    """Measured, fitted and modelled Allan deviations of one axis in the unit of the plot."""

    axis: str
    tau: Floats
    deviation: Floats
    lo: Floats
    hi: Floats
    fitted: Floats
    model: Floats  # Allan deviation of the noise model; NaN without a model
    si: dict[str, Floats]
    poorly_fitted: bool  # True if the fit does not describe the measured curve

    @property
    def curves_that_set_y_range(self) -> tuple[Floats, ...]:
        """Curves that determine the range of the y axis. Confidence intervals may extend beyond this range."""
        return self.deviation, self.fitted, self.model

    @classmethod
    def from_estimate(
        cls, estimate: Estimate, axis: str, gap: ModelComparison | None, factor: float
    ) -> "_Curve | None":
        """Return the curves of one axis, or None if the axis has fewer than two Allan deviations."""
        curve, i = estimate.curve, AXES.index(axis)
        rows = np.isfinite(curve.avar[:, i]) & (curve.avar[:, i] > 0)
        if int(rows.sum()) < 2:
            return None
        deviation, fitted = (np.sqrt(a[rows, i]) for a in (curve.avar, estimate.fitted))
        si = {"tau": curve.tau_s[rows], "deviation": deviation, "lo": curve.lo[rows, i], "hi": curve.hi[rows, i]}
        model = np.full(fitted.shape, np.nan)
        if gap is not None and axis in gap.axes and gap.axes[axis].model.shape == rows.shape:
            model = gap.axes[axis].model[rows]
        f = factor
        poor = axis in estimate.poorly_fitted_axes
        return cls(axis, si["tau"], deviation * f, si["lo"] * f, si["hi"] * f, fitted * f, model * f, si, poor)


def _signs_in_use(curves: Sequence[_Curve]) -> list[str]:
    """Return the signs that the plot of the curves contains, in the order of KEY."""
    missing = {"model"} if not any(np.isfinite(one.model).any() for one in curves) else set()
    missing |= {"fit", "ring"} if not any(np.isfinite(one.fitted).any() for one in curves) else set()
    missing |= {"poor"} if not any(one.poorly_fitted for one in curves) else set()
    return [sign for sign in KEY if sign not in missing]


def log_grid(
    log: Log,
    path: str,
    scale: ChartDecadeRange,
    labels_path: str,
    labels: Sequence[tuple[float, float, str]] = (),
    x_unit: str = "",
) -> None:
    """Log the grid lines, tick labels and further labels of a plot.

    Parameters
    ----------
    log
        Function that logs a Rerun entity.
    path
        Path of the entity with the grid lines.
    scale
        Range of averaging times and Allan deviations.
    labels_path
        Path of the entity with the labels.
    labels
        Further labels, each given by x, y and text.
    x_unit
        Text after the last number of the x axis.
    """
    lines = chart_grid(scale, x_unit)
    log_lines(log, f"{path}/minor", lines.minor, [axis_colours.FRAME], 0.5, -30.0)
    dots = [dash for line in lines.major for dash in dash_line(line, GRID_DASH)]
    log_lines(log, f"{path}/major", dots, [axis_colours.FRAME], 0.2, -29.0)
    log_lines(log, f"{path}/frame", lines.frame, [axis_colours.FRAME], 0.5, -10.0)
    log(labels_path, label_points([*lines.ticks, *labels]))


def log_lines(
    log: Log, path: str, strips: Sequence[Floats], line_colours: Sequence[Colour], radius: float, order: float
) -> None:
    """Log lines with the given colours and width.

    Parameters
    ----------
    log
        Function that logs a Rerun entity.
    path
        Path of the entity.
    strips
        Points of each line, shape [n, 2].
    line_colours
        One colour for each line, or one for all lines.
    radius
        Half of the line width, in points of the screen.
    order
        Drawing order. Lines with higher values are in front.
    """
    radii = rr.Radius.ui_points(radius)
    log(path, rr.LineStrips2D(strips, colors=line_colours, radii=radii, draw_order=order))


def log_markers(log: Log, path: str, positions: Floats, axis: str) -> None:
    """Log a dot, a square or a triangle at each position, for an x, y or z axis.

    Parameters
    ----------
    log
        Function that logs a Rerun entity.
    path
        Path of the entity.
    positions
        Chart positions, shape [n, 2].
    axis
        Name of the axis, which selects the shape and the colour.
    """
    colours, corners = [axis_colours.AXIS_COLOURS[axis]], MARKER_CORNERS.get(axis[-1])
    if corners is None:
        log(path, rr.Points2D(positions, colors=colours, radii=rr.Radius.ui_points(DOT_RADIUS), draw_order=20.0))
    else:
        log_lines(log, path, marker_outlines(positions, corners), colours, MARKER_WIDTH, 20.0)


def label_points(labels: Sequence[tuple[float, float, str]]) -> rr.Points2D:
    """Return labels, each given by x, y and a text, as points of a 2D view."""
    return rr.Points2D(
        [(x, y) for x, y, _ in labels],
        labels=[text for _, _, text in labels],
        colors=[axis_colours.GREY],
        radii=[0.0],
        show_labels=True,
    )
