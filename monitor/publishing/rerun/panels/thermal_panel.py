"""Panel of the Rerun viewer for the bias that is predicted from temperature.

Importing this module imports Rerun.
"""

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import (
    DEVIATION_UNITS,
    KINDS,
    axes_of,
    sensor_kind,
)
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.drift.thermal.online_thermal_model import MeasuredAndPredictedMean
from monitor.publishing.plots import axis_colours
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.shared_views import temperature_view, time_series_view
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription


class ThermalPredictionPanel(Panel):
    """Mean bias of each axis, with the one-step prediction and the prediction interval that triggers events."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        for axis in AXES:
            colour, dim = (
                axis_colours.AXIS_COLOURS[axis],
                axis_colours.blend_colours(axis_colours.AXIS_COLOURS[axis], 0.45),
            )
            unit = DEVIATION_UNITS[sensor_kind(axis)].name
            lines = [(f"{axis} bias, {unit}", colour, 2.0), (f"{axis} expected", axis_colours.TEXT, 1.0)]
            self._style_lines(
                f"thermal/{axis}", [*lines, (f"{axis} 95 % low", dim, 0.75), (f"{axis} 95 % high", dim, 0.75)]
            )

    def draw(self, unix_s: Floats, results: Sequence[ThermalIntervalResult]) -> None:
        """Draw the measured and the predicted mean biases."""
        for axis in AXES:
            rows = np.array([self._row(one.axes.get(axis)) for one in results])
            if np.isfinite(rows).any():
                factor = DEVIATION_UNITS[sensor_kind(axis)].factor
                self.scene.log_scalars(self.entity_path(f"thermal/{axis}"), unix_s, rows * factor)

    @staticmethod
    def _row(one: MeasuredAndPredictedMean | None) -> tuple[float, float, float, float]:
        """Return the measured mean bias, the predicted bias, and the lower and upper end of the prediction interval."""
        if one is None or one.one_step is None:
            return (np.nan if one is None else one.bias), np.nan, np.nan, np.nan
        return one.bias, one.one_step.bias, one.one_step.lo, one.one_step.hi

    @classmethod
    def tab_layout(cls, device: ViewerDeviceDescription) -> rrb.Container | None:
        """Return the layout of the Temperature tab, or None if the bias is not predicted from temperature."""
        if not device.has_thermal:
            return None
        columns = []
        for kind in KINDS:
            title = f"bias, and prediction from temperature, {DEVIATION_UNITS[kind].name}"
            views = [time_series_view(f"/{device.name}/thermal/{axis}", f"{axis}: {title}") for axis in axes_of(kind)]
            columns.append(rrb.Vertical(*views))
        temperature = temperature_view(device.name)
        return rrb.Vertical(rrb.Horizontal(*columns), temperature, row_shares=[4, 1], name="Temperature")
