"""Panels of the Rerun viewer for gyroscope drift and for the dependence of the bias on temperature.

Importing this module imports Rerun.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from drivers.data_types import AXES, Floats
from monitor.common.distributions import Z95
from monitor.common.unit_formatting import (
    KINDS,
    SAMPLE_UNITS,
    UnitSystem,
    axes_of,
    sensor_kind,
)
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.drift.thermal.online_thermal_model import MeasuredAndPredictedMean
from monitor.publishing.plots import axis_colours
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.panels.panel_text import drift_text
from monitor.publishing.rerun.shared_views import RAW_SAMPLES_S, temperature_view, time_series_view
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription


class DriftPanel(Panel):
    """Measured and predicted gyroscope drift over time, with a table of the drift models."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        unit = self.scene.units.deviation("gyro").name
        for axis in axes_of("gyro"):
            colour, dim = (
                axis_colours.AXIS_COLOURS[axis],
                axis_colours.blend_colours(axis_colours.AXIS_COLOURS[axis], 0.45),
            )
            lines = [(f"{axis} at rest, {unit}", colour, 1.0), (f"{axis} expected", axis_colours.GREY, 1.5)]
            lines += [(f"{axis} 95 % low", dim, 0.75), (f"{axis} 95 % high", dim, 0.75)]
            self._style_lines(f"drift/{axis}", lines)
            self._style_lines(f"innovation/{axis}", [(f"{axis}, σ", colour, 1.0)])

    def draw(self, unix_s: Floats, results: Sequence[MeasuredAndSubtractedDrift]) -> None:
        """Draw the measured and predicted drift of the given updates, and the newest drift models."""
        factor = self.scene.units.deviation("gyro").factor
        for i, axis in enumerate(axes_of("gyro")):
            expected = np.array([one.expected[i] for one in results])
            half = Z95 * np.array([one.error[i] for one in results])
            mean = np.array([one.mean[i] for one in results])
            rows = np.column_stack([mean, expected, expected - half, expected + half])
            if np.isfinite(rows).any():
                self.scene.log_scalars(self.entity_path(f"drift/{axis}"), unix_s, rows * factor)
                innovation = np.array([one.innovation[i] for one in results])
                self.scene.log_scalars(self.entity_path(f"innovation/{axis}"), unix_s, innovation)
        self._log_text("drift", float(unix_s[-1]), drift_text(results[-1], self.scene.units))

    @classmethod
    def own_page(cls, device: ViewerDeviceDescription, units: UnitSystem, guide: rrb.View) -> rrb.Container | None:
        """Return the page of the drift, or None if the gyroscope drift of the device is not compensated."""
        if not device.compensated:
            return None
        name = device.name
        rows = []
        for axis in axes_of("gyro"):
            title = f"{axis}: rate, {SAMPLE_UNITS['gyro'].name}"
            contents = (f"/{name}/samples/{axis}", f"$origin/{axis}")
            dimmed = {f"/{name}/samples/{axis}": rr.SeriesLines(colors=[axis_colours.FRAME], widths=[0.75])}
            rates = time_series_view(f"/{name}/compensated", title, contents, RAW_SAMPLES_S, styles=dimmed)
            title = f"{axis}: drift, {units.deviation('gyro').name}"
            drift = time_series_view(f"/{name}/drift/{axis}", title)
            innovation = time_series_view(f"/{name}/innovation/{axis}", f"{axis}: innovation, σ")
            rows.append(rrb.Horizontal(rates, drift, innovation))
        text = rrb.TextDocumentView(origin=f"/{name}/drift", contents="$origin", name="Drift of the gyros")
        return rrb.Vertical(*rows, rrb.Horizontal(text, guide), row_shares=[3, 3, 3, 4.4], name="Drift")


class ThermalPredictionPanel(Panel):
    """Mean bias of each axis, with the one-step prediction and the prediction interval that triggers events."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        for axis in AXES:
            colour, dim = (
                axis_colours.AXIS_COLOURS[axis],
                axis_colours.blend_colours(axis_colours.AXIS_COLOURS[axis], 0.45),
            )
            unit = self.scene.units.deviation(sensor_kind(axis)).name
            lines = [(f"{axis} bias, {unit}", colour, 2.0), (f"{axis} expected", axis_colours.GREY, 1.0)]
            self._style_lines(
                f"thermal/{axis}", [*lines, (f"{axis} 95 % low", dim, 0.75), (f"{axis} 95 % high", dim, 0.75)]
            )

    def draw(self, unix_s: Floats, results: Sequence[ThermalIntervalResult]) -> None:
        """Draw the measured and the predicted mean biases."""
        for axis in AXES:
            rows = np.array([self._row(one.axes.get(axis)) for one in results])
            if np.isfinite(rows).any():
                factor = self.scene.units.deviation(sensor_kind(axis)).factor
                self.scene.log_scalars(self.entity_path(f"thermal/{axis}"), unix_s, rows * factor)

    @staticmethod
    def _row(one: MeasuredAndPredictedMean | None) -> tuple[float, float, float, float]:
        """Return the measured mean bias, the predicted bias, and the lower and upper end of the prediction interval."""
        if one is None or one.one_step is None:
            return (np.nan if one is None else one.bias), np.nan, np.nan, np.nan
        return one.bias, one.one_step.bias, one.one_step.lo, one.one_step.hi

    @classmethod
    def own_page(cls, device: ViewerDeviceDescription, units: UnitSystem, guide: rrb.View) -> rrb.Container | None:
        """Return the page of the temperature, and of the bias if it is predicted from temperature."""
        temperature = temperature_view(device.name)
        if not device.has_thermal:
            return rrb.Horizontal(temperature, guide, name="Temperature")
        columns = []
        for kind in KINDS:
            title = f"bias, {units.deviation(kind).name}"
            views = [time_series_view(f"/{device.name}/thermal/{axis}", f"{axis}: {title}") for axis in axes_of(kind)]
            columns.append(rrb.Vertical(*views))
        # Rerun labels an axis only if there is enough space, so the temperature has a high plot.
        columns.append(rrb.Vertical(temperature, guide, row_shares=[2, 1]))
        return rrb.Horizontal(*columns, column_shares=[3, 3, 2], name="Temperature")
