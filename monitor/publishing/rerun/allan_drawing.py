"""Allan plots of the viewer: measured points with intervals, fitted curves, and the model in force.

The plot of an axis is a drawing. Its entity therefore also holds tau, deviation, lo and hi in SI, for programs that
read the recording. Importing this module imports Rerun.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from drivers.sample import AXES, Floats
from monitor.common.units import DEVIATION_UNITS, KINDS, Kind, axes_of, sensor_kind
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate
from monitor.publishing.plots import colours
from monitor.publishing.plots.colours import Colour
from monitor.publishing.rerun.allan_chart import (
    FILL_STEPS,
    HEIGHT,
    WIDTH,
    Scale,
    band_strokes,
    dash_line,
    decade_range,
    finite_sections,
    grid_lines,
    interval_strokes,
)

Log = Callable[..., Any]
"""Function that logs an entity, given its path and its components."""


class AllanPlot:
    """Allan plots of a device, one for each kind of sensor.

    Parameters
    ----------
    log
        Function that logs an entity.
    path
        Path of the plots.
    """

    def __init__(self, log: Log, path: str) -> None:
        self._log = log
        self._path = path
        self._scales: dict[Kind, Scale] = {}  # scale of the grid that was drawn last

    def draw(self, estimate: Estimate, gap: ModelGap | None) -> None:
        """Draw the curves of an estimate.

        Parameters
        ----------
        estimate
            The estimate.
        gap
            Comparison with the model in force, whose curves are dashed; None if there is no model.
        """
        for kind in KINDS:
            curves = [curve for axis in axes_of(kind) if (curve := _Curve.of(estimate, axis, gap)) is not None]
            if not curves:
                continue
            scale = Scale(
                decade_range(one.tau for one in curves),
                decade_range(part for one in curves for part in one.curves_for_height),
            )
            if self._scales.get(kind) != scale:
                self._scales[kind] = scale
                self._draw_grid(kind, scale, [one.axis for one in curves])
            for curve in curves:
                self._draw_curve(scale, curve)

    def _draw_grid(self, kind: Kind, scale: Scale, axes: Sequence[str]) -> None:
        """Log frame, decade lines and tick labels of a plot, and a legend above the right end of the box."""
        path, lines = f"{self._path}/{kind}", grid_lines(scale)
        for name, strips, colour, order in (
            ("minor", lines.minor, colours.MINOR, -30.0),
            ("major", lines.major, colours.MAJOR, -29.0),
            ("frame", lines.frame, colours.FRAME, -10.0),
        ):
            self._log_lines(f"{path}/{name}", strips, [colour], 0.5, order)
        titles = [
            (WIDTH / 2, HEIGHT + 0.85, "averaging time τ, s"),
            (1.2, -0.85, f"σ(τ), {DEVIATION_UNITS[kind].name}"),
        ]
        self._log(f"{path}/ticks", label_points([*lines.ticks, *titles]))
        ends = [(axis, WIDTH - 2.0 * (len(axes) - 1 - i) - 0.5) for i, axis in enumerate(axes)]
        strokes = [np.array([[x - 1.15, -0.42], [x - 0.5, -0.42]]) for _, x in ends]
        self._log_lines(f"{path}/legend/strokes", strokes, [colours.AXIS_COLOURS[axis] for axis in axes], 2.0, 30.0)
        self._log(f"{path}/legend", label_points([(x, -0.85, axis) for axis, x in ends]))

    def _draw_curve(self, scale: Scale, curve: "_Curve") -> None:
        """Log band, fitted line, intervals and measured points of one axis, and the model in force as a dashed line."""
        path, colour = f"{self._path}/{curve.axis}", colours.AXIS_COLOURS[curve.axis]
        low, high, fitted, model, deviation = (
            scale.to_chart(curve.tau, part) for part in (curve.lo, curve.hi, curve.fitted, curve.model, curve.deviation)
        )
        fill = rr.LineStrips2D(
            list(band_strokes(low, high)),
            colors=[colours.blend(colour, 0.22)],
            radii=[WIDTH / FILL_STEPS / 2],
            draw_order=-20.0,
        )
        self._log(f"{path}/band", fill)
        self._log_lines(f"{path}/interval", list(interval_strokes(low, high)), [colours.blend(colour, 0.6)], 0.75, 5.0)
        self._log_lines(f"{path}/fit", finite_sections(fitted), [colour], 1.25, 10.0)
        dashes = [stroke for section in finite_sections(model) for stroke in dash_line(section)]
        self._log_lines(f"{path}/model", dashes, [colours.TEXT], 0.75, 15.0)
        points = rr.Points2D(deviation, colors=[colour], radii=rr.Radius.ui_points(3.0), draw_order=20.0)
        self._log(path, points, rr.AnyValues(drop_untyped_nones=True, **curve.si))

    def _log_lines(
        self, path: str, strips: Sequence[Floats], line_colours: Sequence[Colour], radius: float, order: float
    ) -> None:
        """Log lines, given their colours, radius in points and drawing order."""
        radii = rr.Radius.ui_points(radius)
        self._log(path, rr.LineStrips2D(strips, colors=line_colours, radii=radii, draw_order=order))


@dataclass(frozen=True)
class _Curve:
    """Allan curve of one axis at its measured points, in the unit of the field."""

    axis: str
    tau: Floats
    deviation: Floats
    lo: Floats
    hi: Floats
    fitted: Floats
    model: Floats  # deviation of the model in force; NaN if there is none
    si: dict[str, Floats]

    @property
    def curves_for_height(self) -> tuple[Floats, ...]:
        """Curves that determine the height of the plot; intervals may extend beyond it."""
        return self.deviation, self.fitted, self.model

    @classmethod
    def of(cls, estimate: Estimate, axis: str, gap: ModelGap | None) -> "_Curve | None":
        """Return the curve of an axis; None if it has fewer than two points."""
        curve, i = estimate.curve, AXES.index(axis)
        rows = np.isfinite(curve.avar[:, i]) & (curve.avar[:, i] > 0)
        if int(rows.sum()) < 2:
            return None
        deviation, fitted = (np.sqrt(a[rows, i]) for a in (curve.avar, estimate.fitted))
        si = {"tau": curve.tau_s[rows], "deviation": deviation, "lo": curve.lo[rows, i], "hi": curve.hi[rows, i]}
        model = np.full(fitted.shape, np.nan)
        if gap is not None and axis in gap.axes and gap.axes[axis].model.shape == rows.shape:
            model = gap.axes[axis].model[rows]
        f = DEVIATION_UNITS[sensor_kind(axis)].factor
        return cls(axis, si["tau"], deviation * f, si["lo"] * f, si["hi"] * f, fitted * f, model * f, si)


def label_points(labels: Sequence[tuple[float, float, str]]) -> rr.Points2D:
    """Return labels as points of a 2D view, each given by x, y and text."""
    return rr.Points2D(
        [(x, y) for x, y, _ in labels],
        labels=[text for _, _, text in labels],
        colors=[colours.TEXT],
        radii=[0.0],
        show_labels=True,
    )
