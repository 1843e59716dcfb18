"""Panels of the Rerun viewer, each of which draws one kind of result of one device.

``monitor.publishing.result_kinds`` lists the kinds of results. Importing this module imports Rerun.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from drivers.data_types import AXES, Event, Floats
from monitor.common.device_health import Health
from monitor.common.distributions import Z95
from monitor.common.units import (
    COEFFICIENT_UNITS,
    DEVIATION_UNITS,
    KINDS,
    SAMPLE_UNITS,
    axes_of,
    format_utc,
    sensor_kind,
)
from monitor.drift.compensation.live_compensation import DriftUpdate
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.drift.thermal.online_thermal_model import PredictedAxisInterval
from monitor.estimation.detection.model_comparison import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.history.history_table import HistoryTable
from monitor.publishing.plots import axis_colours
from monitor.publishing.plots.axis_colours import Colour
from monitor.publishing.plots.style import omit_wide_intervals
from monitor.publishing.rerun import allan_drawing, dynamic_heat_map, history_points
from monitor.publishing.rerun.allan_history_table import AllanHistory
from monitor.publishing.rerun.decimation import average_buckets, decimate_extremes
from monitor.publishing.rerun.panel_text import drift_text, health_text, noise_text, overview_text
from monitor.publishing.rerun.shared_views import RAW_SAMPLES_S, markdown_document, temperature_view, time_series_view
from monitor.publishing.rerun.viewer_settings import DeviceInfo

if TYPE_CHECKING:
    from monitor.publishing.rerun.viewer_content import Scene
    from monitor.publishing.result_kinds import CompensatedRows, DeviceTableText, SampleRows

TEMPERATURES_PER_S: Final = 5.0
MAX_INTERMEDIATE_POINTS: Final = 20
"""Largest number of points between two estimates. More points would overload the viewer."""
MAX_PAST_EVENTS: Final = 200
"""Largest number of stored events that are shown."""
WARNING_EVENTS: Final = frozenset({
    "samples_lost",
    "noise_changed",
    "bias_stepped",
    "limit_crossed",
    "model_disagrees",
    "temperature_unexplained",
    "drift_unexplained",
    "clock_jumped",
})  # fmt: skip
"""Kinds of events with the log level WARN."""


class Panel:
    """Base class of the panels that draw one kind of result of one device.

    Parameters
    ----------
    scene
        Scene to which the panel belongs.
    device
        Name of the device.
    """

    def __init__(self, scene: "Scene", device: str) -> None:
        self.scene = scene
        self.device = device

    def log_styles(self) -> None:
        """Log the constant names, colours and widths of the lines."""

    def draw(self, unix_s: Floats, results: Sequence[Any]) -> None:
        """Draw results.

        Parameters
        ----------
        unix_s
            Unix times of the results [s].
        results
            At least one result, in order of time.
        """
        raise NotImplementedError

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored history of the device."""

    @classmethod
    def tab_layout(cls, device: DeviceInfo) -> rrb.Container | None:
        """Return the layout of a separate tab, or None if the panel has no tab."""
        return None

    def entity_path(self, name: str) -> str:
        """Return the path of an entity of the device."""
        return f"{self.device}/{name}"

    def _style_lines(self, name: str, lines: Sequence[tuple[str, Colour, float]]) -> None:
        names, line_colours, widths = zip(*lines, strict=True)
        self.scene.log(
            self.entity_path(name), rr.SeriesLines(colors=line_colours, widths=widths, names=names), static=True
        )

    def _style_samples(self, name: str, axes: Sequence[str]) -> None:
        for axis in axes:
            line = (f"{axis}, {SAMPLE_UNITS[sensor_kind(axis)].name}", axis_colours.AXIS_COLOURS[axis], 1.0)
            self._style_lines(f"{name}/{axis}", [line])

    def _log_samples(self, name: str, axes: Sequence[str], results: "Sequence[SampleRows | CompensatedRows]") -> Floats:
        """Log decimated samples, and return the times of all samples."""
        times, values = np.concatenate([one.unix_s for one in results]), np.concatenate([one.values for one in results])
        for i, axis in enumerate(axes):
            t, y = decimate_extremes(times, values[:, i])
            factor = SAMPLE_UNITS[sensor_kind(axis)].factor
            self.scene.log_scalars(self.entity_path(f"{name}/{axis}"), t, y * factor)
        return times

    def _log_text(self, name: str, unix_s: float, text: str) -> None:
        self.scene.set_log_time(unix_s)
        self.scene.log(self.entity_path(name), markdown_document(text))


class SamplesPanel(Panel):
    """Time series of temperature and decimated samples."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        self._style_samples("samples", AXES)
        self._style_lines("temperature", [("temperature, °C", axis_colours.TEMPERATURE, 1.5)])

    def draw(self, unix_s: Floats, results: "Sequence[SampleRows]") -> None:
        """Draw samples."""
        times = self._log_samples("samples", AXES, results)
        temperature_c = np.concatenate([one.temperature_c for one in results])
        self.scene.log_scalars(
            self.entity_path("temperature"), *average_buckets(times, temperature_c, TEMPERATURES_PER_S)
        )

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored temperature."""
        temperature = history.select_column("temperature")
        if np.isfinite(temperature.last).any():
            at, values = history_points.history_points(history, temperature, temperature.last, temperature.last)
            self.scene.log_scalars(self.entity_path("temperature"), at, values[:, 0])


class CompensatedPanel(Panel):
    """Time series of the angular rates after drift removal, decimated for display."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        self._style_samples("compensated", axes_of("gyro"))

    def draw(self, unix_s: Floats, results: "Sequence[CompensatedRows]") -> None:
        """Draw compensated angular rates."""
        self._log_samples("compensated", axes_of("gyro"), results)


class DriftPanel(Panel):
    """Time series of the gyroscope drift, with a table of the drift models."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        unit = DEVIATION_UNITS["gyro"].name
        for axis in axes_of("gyro"):
            colour, dim = (
                axis_colours.AXIS_COLOURS[axis],
                axis_colours.blend_colours(axis_colours.AXIS_COLOURS[axis], 0.45),
            )
            lines = [(f"{axis} at rest, {unit}", dim, 0.75), (f"{axis} expected", axis_colours.TEXT, 1.5)]
            lines += [(f"{axis} 95 % low", colour, 1.0), (f"{axis} 95 % high", colour, 1.0)]
            self._style_lines(f"drift/{axis}", lines)
            self._style_lines(f"innovation/{axis}", [(f"{axis}, σ", colour, 1.0)])

    def draw(self, unix_s: Floats, results: Sequence[DriftUpdate]) -> None:
        """Draw updates of the drift models."""
        for i, axis in enumerate(axes_of("gyro")):
            expected = np.array([one.expected[i] for one in results])
            half = Z95 * np.array([one.error[i] for one in results])
            mean = np.array([one.mean[i] for one in results])
            rows = np.column_stack([mean, expected, expected - half, expected + half])
            if np.isfinite(rows).any():
                self.scene.log_scalars(self.entity_path(f"drift/{axis}"), unix_s, rows * DEVIATION_UNITS["gyro"].factor)
                innovation = np.array([one.innovation[i] for one in results])
                self.scene.log_scalars(self.entity_path(f"innovation/{axis}"), unix_s, innovation)
        self._log_text("drift", float(unix_s[-1]), drift_text(results[-1]))

    @classmethod
    def tab_layout(cls, device: DeviceInfo) -> rrb.Container | None:
        """Return the drift tab if the drift of the device is compensated."""
        if not device.compensated:
            return None
        name = device.name
        rows = []
        for axis in axes_of("gyro"):
            title = f"{axis}: measured rate, and rate without drift, {SAMPLE_UNITS['gyro'].name}"
            contents = (f"$origin/samples/{axis}", f"$origin/compensated/{axis}")
            dimmed = {f"/{name}/samples/{axis}": rr.SeriesLines(colors=[axis_colours.FRAME], widths=[0.75])}
            rates = time_series_view(f"/{name}", title, contents, RAW_SAMPLES_S, styles=dimmed)
            title = f"{axis}: means at rest, and predicted drift, {DEVIATION_UNITS['gyro'].name}"
            drift = time_series_view(f"/{name}/drift/{axis}", title)
            innovation = time_series_view(f"/{name}/innovation/{axis}", f"{axis}: innovation, σ")
            rows.append(rrb.Horizontal(rates, drift, innovation, column_shares=[3, 3, 2]))
        text = rrb.TextDocumentView(origin=f"/{name}/drift", contents="$origin", name="Drift of the gyros")
        return rrb.Vertical(*rows, text, row_shares=[3, 3, 3, 2.5], name="Drift")


class ThermalPanel(Panel):
    """Mean bias of each axis, and the one-step prediction with the interval that triggers events."""

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
        """Draw measured and predicted biases."""
        for axis in AXES:
            rows = np.array([self._row(one.axes.get(axis)) for one in results])
            if np.isfinite(rows).any():
                factor = DEVIATION_UNITS[sensor_kind(axis)].factor
                self.scene.log_scalars(self.entity_path(f"thermal/{axis}"), unix_s, rows * factor)

    @staticmethod
    def _row(one: PredictedAxisInterval | None) -> tuple[float, float, float, float]:
        """Return the measured bias, the predicted bias and the ends of the prediction interval."""
        if one is None or one.one_step is None:
            return (np.nan if one is None else one.bias), np.nan, np.nan, np.nan
        return one.bias, one.one_step.bias, one.one_step.lo, one.one_step.hi

    @classmethod
    def tab_layout(cls, device: DeviceInfo) -> rrb.Container | None:
        """Return the thermal tab if the bias of the device is predicted from temperature."""
        if not device.has_thermal:
            return None
        columns = []
        for kind in KINDS:
            title = f"bias, and prediction from temperature, {DEVIATION_UNITS[kind].name}"
            views = [time_series_view(f"/{device.name}/thermal/{axis}", f"{axis}: {title}") for axis in axes_of(kind)]
            columns.append(rrb.Vertical(*views))
        temperature = temperature_view(device.name)
        return rrb.Vertical(rrb.Horizontal(*columns), temperature, row_shares=[4, 1], name="Temperature")


class GapPanel(Panel):
    """Time series of the difference between measurement and noise model."""

    newest: ModelComparison | None = None

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        for axis in AXES:
            self._style_lines(f"gap/{axis}", [(f"{axis}, σ from its model", axis_colours.AXIS_COLOURS[axis], 1.5)])
        self._style_lines("gap/threshold", [("threshold", axis_colours.blend_colours(axis_colours.TEXT, 0.6), 1.0)])

    def draw(self, unix_s: Floats, results: Sequence[ModelComparison]) -> None:
        """Draw comparisons with the noise model."""
        self.newest = results[-1]
        highest = [max((axis.threshold for axis in one.axes.values()), default=np.nan) for one in results]
        self.scene.log_scalars(self.entity_path("gap/threshold"), unix_s, np.array(highest))
        for axis in AXES:
            gap = np.array([one.axes[axis].gap if axis in one.axes else np.nan for one in results])
            if np.isfinite(gap).any():
                self.scene.log_scalars(self.entity_path(f"gap/{axis}"), unix_s, gap)


class AllanPanel(Panel):
    """Allan plots, tables of coefficients, and heat maps of the Allan deviation over time."""

    def __init__(self, scene: "Scene", device: str) -> None:
        super().__init__(scene, device)
        self._plot = allan_drawing.AllanPlot(scene.log, self.entity_path("allan"))
        self._history = AllanHistory()

    def draw(self, unix_s: Floats, results: Sequence[Estimate]) -> None:
        """Draw the newest estimate."""
        at_s, estimate = float(unix_s[-1]), results[-1]
        self._log_text("coefficients", at_s, noise_text(estimate))
        self._plot.draw(estimate, self.scene.get_or_create_panel(self.device, GapPanel).newest)
        if self._history.add_estimate(at_s, estimate):
            dynamic_heat_map.draw_heat_maps(self.scene.log, self.entity_path("dynamic"), self._history)


class CoefficientsPanel(Panel):
    """Time series of the noise coefficients with intervals."""

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines."""
        for axis in AXES:
            colour, dim = (
                axis_colours.AXIS_COLOURS[axis],
                axis_colours.blend_colours(axis_colours.AXIS_COLOURS[axis], 0.45),
            )
            for symbol in SYMBOLS:
                unit = COEFFICIENT_UNITS[sensor_kind(axis)][symbol].name
                lines = [(f"{axis}, {unit}", colour, 2.0), (f"{axis} 95 % low", dim, 0.75)]
                self._style_lines(f"coefficients/{symbol}/{axis}", [*lines, (f"{axis} 95 % high", dim, 0.75)])
                mark = rr.SeriesPoints(
                    colors=[colour], markers=["diamond"], marker_sizes=[7.0], names=[f"{axis} changed"]
                )
                self.scene.log(self.entity_path(f"coefficients/{symbol}/{axis}/changed"), mark, static=True)

    def draw(self, unix_s: Floats, results: Sequence[Estimate]) -> None:
        """Draw the coefficients of estimates."""
        parts = [_points_until(at_s, estimate) for at_s, estimate in zip(unix_s.tolist(), results, strict=True)]
        times, values = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        for row, symbol in enumerate(SYMBOLS):
            for column, axis in enumerate(AXES):
                if np.isfinite(values[:, row, column]).any():
                    self.log_coefficient(symbol, axis, times, values[:, row, column])

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored coefficients."""
        for symbol in SYMBOLS:
            for axis in history.list_axes():
                value, lo, hi = (history.select_column(f"{axis}.{symbol}{end}") for end in ("", ".lo", ".hi"))
                if np.isfinite(value.last).any():
                    at, values = history_points.history_points(history, value, lo.last, hi.last)
                    self.log_coefficient(symbol, axis, at, values)

    def log_coefficient(self, symbol: str, axis: str, unix_s: Floats, values: Floats, name: str = "") -> None:
        """Log a noise coefficient over time.

        Parameters
        ----------
        symbol
            Symbol of the coefficient.
        axis
            Name of the axis.
        unix_s
            Unix times [s], shape [n].
        values
            Values, shape [n], or values with interval ends, shape [n, 3], in SI units.
        name
            End of the name of the entity.
        """
        factor = COEFFICIENT_UNITS[sensor_kind(axis)][symbol].factor
        self.scene.log_scalars(self.entity_path(f"coefficients/{symbol}/{axis}{name}"), unix_s, values * factor)


class EventsPanel(Panel):
    """Log of events. A diamond marks the new value of a changed coefficient."""

    def draw(self, unix_s: Floats, results: Sequence[Event]) -> None:
        """Log events and mark changed coefficients."""
        for at_s, event in zip(unix_s.tolist(), results, strict=True):
            level = "ERROR" if event.kind == "link_lost" else "WARN" if event.kind in WARNING_EVENTS else "INFO"
            clock_time = format_utc(at_s)[-8:]  # the time column of the viewer is too narrow for the time of day
            self.scene.set_log_time(at_s)
            if self.scene.fleet or len(self.scene.devices) > 1:
                line = rr.TextLog(f"{clock_time}  {self.device}: {event.text}", level=level)
                self.scene.log("overview/events", line)
            if self.device in self.scene.devices:
                self.scene.log(self.entity_path("events"), rr.TextLog(f"{clock_time}  {event.text}", level=level))
                self._mark_changes(at_s, event)

    def draw_history(self, history: HistoryTable) -> None:
        """Log the stored events."""
        for one in history.events[-MAX_PAST_EVENTS:]:
            text = f"{format_utc(one.t_s)[:10]}: {one.text}"  # a log line shows only the time of day
            self.draw(np.array([one.t_s]), [Event(one.kind, round(one.t_s * 1e9), text, one.axis, one.what)])

    def _mark_changes(self, unix_s: float, event: Event) -> None:
        if event.axis is None:
            return
        coefficients = self.scene.get_or_create_panel(self.device, CoefficientsPanel)
        for symbol, sides in event.values.items():
            if symbol in SYMBOLS and "after" in sides:
                at, after = np.array([unix_s]), np.array([sides["after"]])
                coefficients.log_coefficient(symbol, event.axis, at, after, "/changed")


class HealthPanel(Panel):
    """Health of the device. The panel also updates the table of all devices."""

    def draw(self, unix_s: Floats, results: Sequence[Health]) -> None:
        """Draw the newest health of the device."""
        at_s, health, devices = float(unix_s[-1]), results[-1], self.scene.devices
        if self.device in devices:
            self.scene.healths[self.device] = health
        about = devices[self.device].about if self.device in devices else ""
        self._log_text("status", at_s, health_text(self.device, health, about))
        if len(devices) > 1 and not self.scene.fleet:
            self.scene.get_or_create_panel("", DeviceTablePanel).log_device_table(
                at_s, overview_text(self.scene.healths)
            )


class DeviceTablePanel(Panel):
    """Table of all devices."""

    def draw(self, unix_s: Floats, results: "Sequence[DeviceTableText]") -> None:
        """Draw the newest table of devices."""
        self.log_device_table(float(unix_s[-1]), results[-1].text)

    def log_device_table(self, unix_s: float, text: str) -> None:
        """Log the table of devices.

        Parameters
        ----------
        unix_s
            Unix time of the table [s].
        text
            Table as Markdown.
        """
        self.scene.set_log_time(unix_s)
        self.scene.log("overview", markdown_document(text))


def _points_until(unix_s: float, estimate: Estimate) -> tuple[Floats, Floats]:
    """Return times [n] and coefficients [n, 5, 6, 3] since the previous estimate.

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
