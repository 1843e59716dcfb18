"""Panels of the Rerun viewer for Allan deviations, noise coefficients and the comparison with a noise model.

Importing this module imports Rerun.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import rerun as rr

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import KINDS, axes_of, sensor_kind
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.plots import axis_colours
from monitor.publishing.plots.style import omit_wide_intervals
from monitor.publishing.rerun import allan_drawing, allan_history_heat_map
from monitor.publishing.rerun.allan_history_heat_map import AllanHistory
from monitor.publishing.rerun.panels import history_points
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.panels.panel_text import noise_text

if TYPE_CHECKING:
    from monitor.publishing.rerun.viewer_scene import AllDevicesScene

MAX_INTERMEDIATE_POINTS: Final = 20
"""Largest number of points that are drawn between two estimates. More points would overload the viewer."""


class ModelDifferencePanel(Panel):
    """Difference between measured Allan deviations and the noise model over time."""

    newest: ModelComparison | None = None

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        for kind in KINDS:
            lines = [(f"{axis}, σ from its model", axis_colours.AXIS_COLOURS[axis], 1.5) for axis in axes_of(kind)]
            self._style_lines(f"gap/{kind}", [*lines, ("threshold", axis_colours.GREY, 1.0)])

    def draw(self, unix_s: Floats, results: Sequence[ModelComparison]) -> None:
        """Draw the differences from the noise model for each axis, and the threshold."""
        self.newest = results[-1]
        highest = [max((axis.threshold for axis in one.axes.values()), default=np.nan) for one in results]
        for kind in KINDS:
            gaps = [[one.axes[axis].gap if axis in one.axes else np.nan for axis in axes_of(kind)] for one in results]
            if np.isfinite(gaps).any():
                self.scene.log_scalars(self.entity_path(f"gap/{kind}"), unix_s, np.column_stack([gaps, highest]))


class AllanAndCoefficientPanel(Panel):
    """Allan plots, tables of noise coefficients, and heat maps of the Allan deviation over time."""

    def __init__(self, scene: "AllDevicesScene", device: str) -> None:
        super().__init__(scene, device)
        self._plot = allan_drawing.AllanPlotPair(scene.log, self.entity_path("allan"), scene.units)
        self._history = AllanHistory()

    def draw(self, unix_s: Floats, results: Sequence[Estimate]) -> None:
        """Draw the Allan deviations and coefficients of the newest estimate."""
        at_s, estimate = float(unix_s[-1]), results[-1]
        self._log_text("coefficients", at_s, noise_text(estimate, self.scene.units))
        self._plot.draw(estimate, self.scene.get_or_create_panel(self.device, ModelDifferencePanel).newest)
        if self._history.add_estimate_and_check_column_complete(at_s, estimate):
            allan_history_heat_map.draw_heat_maps(self.scene.log, self.entity_path("dynamic"), self._history)

    def show_connection(self, unix_s: float, connected: bool) -> None:
        """Show in the Allan plots whether the device is connected at a Unix time [s]."""
        self.scene.set_log_time(unix_s)
        self._plot.show_connection(connected)


class CoefficientsPanel(Panel):
    """Noise coefficients with 95 % intervals over time."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        for axis in AXES:
            colour, dim = (
                axis_colours.AXIS_COLOURS[axis],
                axis_colours.blend_colours(axis_colours.AXIS_COLOURS[axis], 0.45),
            )
            for symbol in SYMBOLS:
                unit = self.scene.units.single(sensor_kind(axis), symbol).name
                lines = [(f"{axis}, {unit}", colour, 2.0), (f"{axis} 95 % low", dim, 0.75)]
                self._style_lines(f"coefficients/{symbol}/{axis}", [*lines, (f"{axis} 95 % high", dim, 0.75)])

    def draw(self, unix_s: Floats, results: Sequence[Estimate]) -> None:
        """Draw the noise coefficients of all given estimates."""
        parts = [_points_until(at_s, estimate) for at_s, estimate in zip(unix_s.tolist(), results, strict=True)]
        times, values = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        for row, symbol in enumerate(SYMBOLS):
            for column, axis in enumerate(AXES):
                if np.isfinite(values[:, row, column]).any():
                    self.log_coefficient(symbol, axis, times, values[:, row, column])

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored noise coefficients of the device."""
        for symbol in SYMBOLS:
            for axis in history.list_axes():
                value, lo, hi = (history.select_column(f"{axis}.{symbol}{end}") for end in ("", ".lo", ".hi"))
                if np.isfinite(value.last).any():
                    at, values = history_points.history_points(history, value, lo.last, hi.last)
                    self.log_coefficient(symbol, axis, at, values)

    def mark_change(self, symbol: str, axis: str, unix_s: float, value: float) -> None:
        """Mark the new value of a changed coefficient with a diamond.

        Parameters
        ----------
        symbol
            Symbol of the coefficient: Q, N, B, K or R.
        axis
            Name of the axis.
        unix_s
            Unix time of the change [s].
        value
            New value of the coefficient in SI units.
        """
        path = self.entity_path(f"coefficients/{symbol}/{axis}/changed")
        if f"/{path}" not in self.scene.entities:
            colour = axis_colours.AXIS_COLOURS[axis]
            mark = rr.SeriesPoints(colors=[colour], markers=["diamond"], marker_sizes=[7.0], names=[f"{axis} changed"])
            self.scene.log(path, mark, static=True)
        self.log_coefficient(symbol, axis, np.array([unix_s]), np.array([value]), "/changed")

    def log_coefficient(self, symbol: str, axis: str, unix_s: Floats, values: Floats, name: str = "") -> None:
        """Log a noise coefficient over time.

        Parameters
        ----------
        symbol
            Symbol of the coefficient: Q, N, B, K or R.
        axis
            Name of the axis.
        unix_s
            Unix times [s], shape [n].
        values
            Values, shape [n], or values with the ends of their intervals, shape [n, 3], in SI units.
        name
            Suffix of the path of the entity.
        """
        factor = self.scene.units.single(sensor_kind(axis), symbol).factor
        self.scene.log_scalars(self.entity_path(f"coefficients/{symbol}/{axis}{name}"), unix_s, values * factor)


def _points_until(unix_s: float, estimate: Estimate) -> tuple[Floats, Floats]:
    """Return the times, shape [n], and the coefficients since the previous estimate, shape [n, 5, 6, 3].

    Only the newest coefficients have confidence intervals.
    """
    c, history = estimate.coefficients, estimate.history
    newest = np.stack([c.value, *omit_wide_intervals(c.value, c.lo, c.hi)], axis=-1)
    newest[c.status != Status.ESTIMATED] = np.nan
    if history is None:
        return np.array([unix_s]), newest[None]
    step = -(-history.t_ns.size // MAX_INTERMEDIATE_POINTS)
    rows = slice((history.t_ns.size - 1) % step, None, step)
    before_s = (history.t_ns[-1] - history.t_ns[rows]) / 1e9
    values = np.full((before_s.size, *newest.shape), np.nan)
    values[..., 0] = history.value[rows]
    values[-1] = newest
    return unix_s - before_s, values
