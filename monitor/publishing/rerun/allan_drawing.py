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
    FILL_STEPS,
    HEIGHT,
    WIDTH,
    ChartDecadeRange,
    band_strokes,
    chart_grid,
    dash_line,
    decade_range,
    finite_sections,
    interval_strokes,
    ring_outline,
)

KEY: Final = ("measured", "fit", "95 %", "model", "N, B, K")
KEY_SPACING: Final = 3.4
KEY_TEXT: Final = 1.6
KEY_BELOW: Final = 2.0
"""Distance of the key below the plot [chart units]."""
RING_LETTERS: Final = "NBK"
LETTER_OFFSET: Final = (0.6, -0.35)

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
        self._units = units
        self._scales: dict[Kind, ChartDecadeRange] = {}  # range of the grid that was drawn last

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
            if self._scales.get(kind) != scale:
                self._scales[kind] = scale
                self._draw_grid(kind, scale, [one.axis for one in curves])
            for curve in curves:
                self._draw_curve(scale, curve)
            self._draw_rings(kind, scale, estimate)

    def _draw_grid(self, kind: Kind, scale: ChartDecadeRange, axes: Sequence[str]) -> None:
        path = f"{self._path}/{kind}"
        titles = [
            (WIDTH / 2, HEIGHT + 0.95, "averaging time τ, s"),
            (1.2, -0.85, f"σ(τ), {self._units.deviation(kind).name}"),
        ]
        log_grid(self._log, path, scale, f"{path}/ticks", titles)
        ends = [(axis, WIDTH - 2.0 * (len(axes) - 1 - i) - 0.5) for i, axis in enumerate(axes)]
        strokes = [np.array([[x - 1.15, -0.42], [x - 0.5, -0.42]]) for _, x in ends]
        log_lines(
            self._log, f"{path}/legend/strokes", strokes, [axis_colours.AXIS_COLOURS[axis] for axis in axes], 2.0, 30.0
        )
        self._log(f"{path}/legend", label_points([(x, -0.85, axis) for axis, x in ends]))
        self._draw_key(f"{path}/key")

    def _draw_key(self, path: str) -> None:
        """Draw a legend for points, lines, bands, dashes and rings below the plot."""
        y = HEIGHT + KEY_BELOW
        at = np.column_stack([np.arange(len(KEY)) * KEY_SPACING, np.zeros(len(KEY))])
        sign = np.array([[0.0, y], [0.8, y]])
        grey = axis_colours.KEY
        log_lines(self._log, f"{path}/fit", [sign + at[1]], [grey], 1.25, 10.0)
        log_lines(self._log, f"{path}/band", [sign + at[2]], [axis_colours.blend_colours(grey, 0.4)], 5.0, 10.0)
        log_lines(self._log, f"{path}/model", dash_line(sign + at[3]), [axis_colours.TEXT], 0.75, 10.0)
        log_lines(self._log, f"{path}/ring", [ring_outline(at[4, 0] + 0.4, y)], [grey], 0.9, 10.0)
        self._log(path, rr.Points2D([(0.0, y)], colors=[grey], radii=rr.Radius.ui_points(3.0), draw_order=20.0))
        self._log(
            f"{path}/text", label_points([(x + KEY_TEXT, y - 0.4, text) for (x, _), text in zip(at, KEY, strict=True)])
        )

    def _draw_rings(self, kind: Kind, scale: ChartDecadeRange, estimate: Estimate) -> None:
        """Draw a ring at the averaging time at which N, B or K is read, and a letter at the rings of all axes."""
        factor, minimum_tau_s = self._units.deviation(kind).factor, tau_of_minimum_s(estimate, kind)
        letters: dict[str, list[Floats]] = {}
        for axis in axes_of(kind):
            i = AXES.index(axis)
            rings = coefficient_rings(estimate, i, factor, minimum_tau_s, 0.0)
            at = {
                one.letter: scale.to_chart_positions(np.array([one.tau_s]), np.array([one.sigma]))[0]
                for one in rings
                if one.letter in RING_LETTERS
            }
            inside = {letter: xy for letter, xy in at.items() if 0.0 <= xy[0] <= WIDTH and 0.0 <= xy[1] <= HEIGHT}
            outlines = [ring_outline(*xy) for xy in inside.values()]
            log_lines(self._log, f"{self._path}/{axis}/rings", outlines, [axis_colours.AXIS_COLOURS[axis]], 0.9, 25.0)
            for letter, xy in inside.items():
                letters.setdefault(letter, []).append(xy)
        labels = [(*(np.mean(xy, axis=0) + LETTER_OFFSET), letter) for letter, xy in letters.items()]
        self._log(f"{self._path}/{kind}/letters", label_points(labels))

    def _draw_curve(self, scale: ChartDecadeRange, curve: "_Curve") -> None:
        path, colour = f"{self._path}/{curve.axis}", axis_colours.AXIS_COLOURS[curve.axis]
        low, high, fitted, model, deviation = (
            scale.to_chart_positions(curve.tau, part)
            for part in (curve.lo, curve.hi, curve.fitted, curve.model, curve.deviation)
        )
        fill = fill_band(low, high, axis_colours.blend_colours(colour, 0.22))
        self._log(f"{path}/band", fill)
        log_lines(
            self._log,
            f"{path}/interval",
            list(interval_strokes(low, high)),
            [axis_colours.blend_colours(colour, 0.6)],
            0.75,
            5.0,
        )
        log_lines(self._log, f"{path}/fit", finite_sections(fitted), [colour], 1.25, 10.0)
        dashes = [stroke for section in finite_sections(model) for stroke in dash_line(section)]
        log_lines(self._log, f"{path}/model", dashes, [axis_colours.TEXT], 0.75, 15.0)
        points = rr.Points2D(deviation, colors=[colour], radii=rr.Radius.ui_points(3.0), draw_order=20.0)
        self._log(path, points, rr.AnyValues(drop_untyped_nones=True, **curve.si))


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
        return cls(axis, si["tau"], deviation * f, si["lo"] * f, si["hi"] * f, fitted * f, model * f, si)


def log_grid(
    log: Log, path: str, scale: ChartDecadeRange, labels_path: str, labels: Sequence[tuple[float, float, str]]
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
    """
    lines = chart_grid(scale)
    log_lines(log, f"{path}/minor", lines.minor, [axis_colours.MINOR], 0.5, -30.0)
    log_lines(log, f"{path}/major", lines.major, [axis_colours.MAJOR], 0.5, -29.0)
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


def fill_band(low: Floats, high: Floats, colour: Colour) -> rr.LineStrips2D:
    """Return a Rerun component with vertical lines that fill the area between two curves.

    Parameters
    ----------
    low, high
        Curves in chart units, shape [n, 2].
    colour
        Colour of the area.
    """
    width = WIDTH / FILL_STEPS
    return rr.LineStrips2D(list(band_strokes(low, high)), colors=[colour], radii=[width / 2], draw_order=-20.0)


def label_points(labels: Sequence[tuple[float, float, str]]) -> rr.Points2D:
    """Return labels, each given by x, y and a text, as points of a 2D view."""
    return rr.Points2D(
        [(x, y) for x, y, _ in labels],
        labels=[text for _, _, text in labels],
        colors=[axis_colours.TEXT],
        radii=[0.0],
        show_labels=True,
    )
