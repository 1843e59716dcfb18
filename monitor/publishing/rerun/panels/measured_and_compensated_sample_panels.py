"""Panels of the Rerun viewer for measured and compensated samples.

Importing this module imports Rerun.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import axes_of
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.plots import axis_colours
from monitor.publishing.rerun.panels import history_points
from monitor.publishing.rerun.panels.decimation import average_buckets
from monitor.publishing.rerun.panels.panel import Panel

if TYPE_CHECKING:
    from monitor.publishing.result_kinds import CompensatedRateBatch, SampleBatch

TEMPERATURES_PER_S: Final = 5.0


class SamplesAndTemperaturePanel(Panel):
    """Samples, decimated for display, and temperature over time."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        self._style_samples("samples", AXES)
        self._style_lines("temperature", [("temperature, °C", axis_colours.TEMPERATURE, 1.5)])

    def draw(self, unix_s: Floats, results: "Sequence[SampleBatch]") -> None:
        """Draw the samples and the temperature."""
        times = self._log_samples("samples", AXES, results)
        temperature_c = np.concatenate([one.temperature_c for one in results])
        self.scene.log_scalars(
            self.entity_path("temperature"), *average_buckets(times, temperature_c, TEMPERATURES_PER_S)
        )

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored temperature of the device."""
        temperature = history.select_column("temperature")
        if np.isfinite(temperature.last).any():
            at, values = history_points.history_points(history, temperature, temperature.last, temperature.last)
            self.scene.log_scalars(self.entity_path("temperature"), at, values[:, 0])


class CompensatedPanel(Panel):
    """Angular rates after drift removal over time, decimated for display."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        self._style_samples("compensated", axes_of("gyro"))

    def draw(self, unix_s: Floats, results: "Sequence[CompensatedRateBatch]") -> None:
        """Draw the angular rates after drift removal."""
        self._log_samples("compensated", axes_of("gyro"), results)
