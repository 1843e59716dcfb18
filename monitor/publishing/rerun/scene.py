"""Content of the Rerun viewer: samples, estimates, events and health reports as entities of one stream.

Results in SI are logged as columns and drawings under the paths listed in the README, on the timeline ``sample_time``.
Every call may block in Rerun for as long as the viewer does not read, so only the viewer's own thread may call this
module. Importing this module imports Rerun (half a second).

Numbers are shown in the units of the field. ``/<device>/allan/<axis>`` is a drawing. The same entity therefore also
holds tau, deviation, lo and hi in SI, for programs that read the recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import rerun as rr

from drivers.sample import AXES, Event, Floats
from monitor.common.distributions import Z95
from monitor.common.health import Health
from monitor.common.units import (
    COEFFICIENT_UNITS,
    DEVIATION_UNITS,
    KINDS,
    SAMPLE_UNITS,
    Kind,
    axes_of,
    format_utc,
    sensor_kind,
)
from monitor.drift.compensation.live_compensation import DriftUpdate
from monitor.drift.thermal.live_thermal import ThermalUpdate
from monitor.drift.thermal.online_thermal_model import AxisThermalUpdate
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS, Status
from monitor.history.reading import HistoryTable
from monitor.publishing.plots import colours
from monitor.publishing.rerun import dynamic_surface, past_points
from monitor.publishing.rerun.allan_chart import (
    FILL_STEPS,
    HEIGHT,
    WIDTH,
    Scale,
    band,
    dash_line,
    decades,
    finite_sections,
    grid,
    interval_strokes,
)
from monitor.publishing.rerun.allan_history import AllanHistory
from monitor.publishing.rerun.decimation import average_buckets, decimate_extremes
from monitor.publishing.rerun.panels import drift_text, health_text, noise_text, overview_text

TIMELINE: Final = "sample_time"
TEMPERATURES_PER_S: Final = 5.0
POINTS_BETWEEN_ESTIMATES: Final = 20
"""Number of coefficient points between two estimates, if the estimator provides values for every sample."""
MAX_PAST_EVENTS: Final = 200
"""Largest number of stored events that are shown."""
MAX_INTERVAL_RATIO: Final = 1.5  # intervals whose ends differ from the value by more than this factor are not shown
EVENT_LOG_LEVELS: Final = {
    "link_lost": "ERROR",
    "samples_lost": "WARN",
    "noise_changed": "WARN",
    "bias_stepped": "WARN",
    "limit_crossed": "WARN",
    "model_disagrees": "WARN",
    "temperature_unexplained": "WARN",
    "drift_unexplained": "WARN",
    "clock_jumped": "WARN",
}
"""Log level of each kind of event; all others have INFO."""


@dataclass
class _Device:
    """State of one device between two drawings."""

    about: str
    scales: dict[Kind, Scale] = field(default_factory=dict)
    gap: ModelGap | None = None  # newest comparison with the model
    surface: AllanHistory = field(default_factory=AllanHistory)


class Scene:
    """Writer of results to one Rerun stream. Not thread-safe; calls may block, see the module.

    Parameters
    ----------
    stream
        Stream of the viewer.
    devices
        Name and short description of each device.
    fleet
        True if there are many more devices, which have only a row in the overview.
    """

    def __init__(
        self, stream: rr.RecordingStream, devices: Sequence[tuple[str, str]] = (), fleet: bool = False
    ) -> None:
        """Create the state of the devices; nothing is logged yet."""
        self._fleet = fleet
        self._stream = stream
        self._devices = {name: _Device(about) for name, about in devices}
        self._shown = set(self._devices)
        self._healths: dict[str, Health] = {}

    def show(self, devices: Sequence[tuple[str, str]]) -> None:
        """Set the devices to show; known devices keep their state.

        Data of a removed device that still arrive are drawn.

        Parameters
        ----------
        devices
            Name and short description of each device.
        """
        self._shown = {name for name, _ in devices}
        self._healths = {name: health for name, health in self._healths.items() if name in self._shown}
        for name, about in devices:
            self._devices.setdefault(name, _Device(about)).about = about
        self.open()

    def open(self) -> None:
        """Log what does not change: names, colours and widths of the lines."""
        for device in self._devices:
            for axis in AXES:
                self._style_axis(device, axis)
            line = rr.SeriesLines(colors=[colours.TEMPERATURE], widths=[1.5], names=["temperature, °C"])
            self._stream.log(f"{device}/temperature", line, static=True)
            line = rr.SeriesLines(colors=[colours.blend(colours.TEXT, 0.6)], widths=[1.0], names=["threshold"])
            self._stream.log(f"{device}/gap/threshold", line, static=True)

    def samples(self, device: str, wall_s: Floats, values: Floats, temperature_c: Floats) -> None:
        """Log samples, thinned to at most 200 rows per second and axis.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times [s], shape [n].
        values
            Rates [rad/s] and accelerations [m/s²], shape [n, 6].
        temperature_c
            Temperatures [°C], shape [n].
        """
        for i, axis in enumerate(AXES):
            t, y = decimate_extremes(wall_s, values[:, i])
            self._scalars(f"{device}/samples/{axis}", t, y * SAMPLE_UNITS[sensor_kind(axis)].factor)
        self._scalars(f"{device}/temperature", *average_buckets(wall_s, temperature_c, TEMPERATURES_PER_S))

    def estimate(self, device: str, wall_s: float, estimate: Estimate) -> None:
        """Log the Allan plots and the table of an estimate, and the surface over time if it has a new column.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the estimate [s].
        estimate
            The estimate.
        """
        self._set_time(wall_s)
        self._stream.log(f"{device}/coefficients", _markdown(noise_text(estimate)))
        for kind in KINDS:
            self._allan(device, kind, estimate)
        surface = self._devices[device].surface
        if surface.add(wall_s, estimate):
            dynamic_surface.draw(self._stream, device, surface)

    def coefficients(self, device: str, wall_s: Floats, estimates: Sequence[Estimate]) -> None:
        """Log coefficients over time: one point with interval per estimate, and the values between the estimates.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times of the estimates [s].
        estimates
            Estimates in order of time.
        """
        looks = [
            _values_between_estimates(at_s, estimate)
            for at_s, estimate in zip(np.asarray(wall_s), estimates, strict=True)
        ]
        at = np.concatenate([times for times, _ in looks])
        for row, letter in enumerate(SYMBOLS):
            for column, axis in enumerate(AXES):
                parts = []
                for estimate, (_, value) in zip(estimates, looks, strict=True):
                    between = np.full((len(value), 3), np.nan)
                    between[:, 0] = value[:, row, column]
                    between[-1] = _value_with_interval(estimate, row, column)
                    parts.append(between)
                values = np.concatenate(parts)
                if np.isfinite(values).any():
                    factor = COEFFICIENT_UNITS[sensor_kind(axis)][letter].factor
                    self._scalars(f"{device}/coefficients/{letter}/{axis}", at, values * factor)

    def past(self, device: str, past: HistoryTable) -> None:
        """Log the stored history: coefficients and temperature with their extremes, and events.

        Lines have a gap where buckets are missing and after the last bucket, so that live data form a separate line.

        Parameters
        ----------
        device
            Name of the device.
        past
            The history.
        """
        for letter in SYMBOLS:
            for axis in past.axes():
                course, lo, hi = (past.column(f"{axis}.{letter}{end}") for end in ("", ".lo", ".hi"))
                if np.isfinite(course.last).any():
                    at, values = past_points.history_points(past, course, lo.last, hi.last)
                    factor = COEFFICIENT_UNITS[sensor_kind(axis)][letter].factor
                    self._scalars(f"{device}/coefficients/{letter}/{axis}", at, values * factor)
        temperature = past.column("temperature")
        if np.isfinite(temperature.last).any():
            at, values = past_points.history_points(past, temperature, temperature.last, temperature.last)
            self._scalars(f"{device}/temperature", at, values[:, 0])
        for event in past.events[-MAX_PAST_EVENTS:]:
            text = f"{format_utc(event.t_s)[:10]}: {event.text}"  # the log line shows only the time of day
            self.event(device, event.t_s, Event(event.kind, round(event.t_s * 1e9), text, event.axis, event.what))

    def gaps(self, device: str, wall_s: Floats, looks: Sequence[ModelGap]) -> None:
        """Log the gap to the model in use over time: one line per axis, and the threshold.

        The curve of the model is drawn with the next estimate.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times of the comparisons [s].
        looks
            Comparisons in order of time.
        """
        self._devices[device].gap = looks[-1]
        highest = [max((one.threshold for one in look.axes.values()), default=np.nan) for look in looks]
        self._scalars(f"{device}/gap/threshold", wall_s, np.array(highest))
        for axis in AXES:
            gap = np.array([look.axes[axis].gap if axis in look.axes else np.nan for look in looks])
            if np.isfinite(gap).any():
                self._scalars(f"{device}/gap/{axis}", wall_s, gap)

    def thermal(self, device: str, wall_s: Floats, looks: Sequence[ThermalUpdate]) -> None:
        """Log the mean bias of each axis and its prediction with interval.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times of the ends of the intervals [s].
        looks
            Results of the thermal model in order of time.
        """
        for axis in AXES:
            rows = np.array([_thermal(look.axes.get(axis)) for look in looks])
            if np.isfinite(rows).any():
                self._scalars(f"{device}/thermal/{axis}", wall_s, rows * DEVIATION_UNITS[sensor_kind(axis)].factor)

    def compensated(self, device: str, wall_s: Floats, values: Floats) -> None:
        """Log drift-compensated rates, thinned like the samples.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times [s], shape [n].
        values
            Rates [rad/s], shape [n, 3].
        """
        for i, axis in enumerate(axes_of("gyro")):
            t, y = decimate_extremes(wall_s, values[:, i])
            self._scalars(f"{device}/compensated/{axis}", t, y * SAMPLE_UNITS["gyro"].factor)

    def drift(self, device: str, wall_s: Floats, looks: Sequence[DriftUpdate]) -> None:
        """Log means at rest, predicted drift, innovations, and the table of the models.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix times of the ends of the intervals [s].
        looks
            States of the drift compensation in order of time.
        """
        factor = DEVIATION_UNITS["gyro"].factor
        for i, axis in enumerate(axes_of("gyro")):
            rows = np.array([_drift(look, i) for look in looks])
            if np.isfinite(rows).any():
                self._scalars(f"{device}/drift/{axis}", wall_s, rows * factor)
                new = np.array([look.innovation[i] for look in looks])
                self._scalars(f"{device}/innovation/{axis}", wall_s, new)
        self._set_time(float(wall_s[-1]))
        self._stream.log(f"{device}/drift", _markdown(drift_text(looks[-1])))

    def event(self, device: str, wall_s: float, event: Event) -> None:
        """Log an event to the device and to the overview, and mark the changed coefficients.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the event [s].
        event
            The event.
        """
        self._set_time(wall_s)
        level, at = EVENT_LOG_LEVELS.get(event.kind, "INFO"), _clock_time(wall_s)
        if self._fleet or len(self._shown) > 1:
            self._stream.log("overview/events", rr.TextLog(f"{at}  {device}: {event.text}", level=level))
        if device in self._devices:
            self._stream.log(f"{device}/events", rr.TextLog(f"{at}  {event.text}", level=level))
            self._mark_changes(device, wall_s, event)

    def health(self, device: str, wall_s: float, health: Health) -> None:
        """Log the health panel of a device and update the overview.

        Parameters
        ----------
        device
            Name of the device.
        wall_s
            Unix time of the report [s].
        health
            Health of the device.
        """
        self._set_time(wall_s)
        if device in self._shown:
            self._healths[device] = health
        about = self._devices[device].about
        self._stream.log(f"{device}/status", _markdown(health_text(device, health, about)))
        if len(self._shown) > 1 and not self._fleet:
            self._stream.log("overview", _markdown(overview_text(self._healths)))

    def overview(self, wall_s: float, text: str) -> None:
        """Log the table of all devices.

        Parameters
        ----------
        wall_s
            Unix time of the table [s].
        text
            Table as Markdown.
        """
        self._set_time(wall_s)
        self._stream.log("overview", _markdown(text))

    def _style_axis(self, device: str, axis: str) -> None:
        """Log the line styles of one axis."""
        colour = colours.AXIS_COLOURS[axis]
        unit = SAMPLE_UNITS[sensor_kind(axis)].name
        line = rr.SeriesLines(colors=[colour], widths=[1.0], names=[f"{axis}, {unit}"])
        self._stream.log(f"{device}/samples/{axis}", line, static=True)
        line = rr.SeriesLines(colors=[colour], widths=[1.5], names=[f"{axis}, σ from its model"])
        self._stream.log(f"{device}/gap/{axis}", line, static=True)
        dim = colours.blend(colour, 0.45)
        unit = DEVIATION_UNITS[sensor_kind(axis)].name
        names = [f"{axis} bias, {unit}", f"{axis} expected", f"{axis} 95 % low", f"{axis} 95 % high"]
        line = rr.SeriesLines(colors=[colour, colours.TEXT, dim, dim], widths=[2.0, 1.0, 0.75, 0.75], names=names)
        self._stream.log(f"{device}/thermal/{axis}", line, static=True)
        if sensor_kind(axis) == "gyro":
            self._style_drift(device, axis)
        for letter in SYMBOLS:
            unit = COEFFICIENT_UNITS[sensor_kind(axis)][letter].name
            names = [f"{axis}, {unit}", f"{axis} 95 % low", f"{axis} 95 % high"]
            line = rr.SeriesLines(colors=[colour, dim, dim], widths=[2.0, 0.75, 0.75], names=names)
            self._stream.log(f"{device}/coefficients/{letter}/{axis}", line, static=True)
            mark = rr.SeriesPoints(colors=[colour], markers=["diamond"], marker_sizes=[7.0], names=[f"{axis} changed"])
            self._stream.log(f"{device}/coefficients/{letter}/{axis}/changed", mark, static=True)

    def _style_drift(self, device: str, axis: str) -> None:
        """Log the line styles of the drift compensation of one gyroscope axis."""
        colour = colours.AXIS_COLOURS[axis]
        dim = colours.blend(colour, 0.45)
        unit = DEVIATION_UNITS["gyro"].name
        names = [f"{axis} at rest, {unit}", f"{axis} expected", f"{axis} 95 % low", f"{axis} 95 % high"]
        line = rr.SeriesLines(colors=[dim, colours.TEXT, colour, colour], widths=[0.75, 1.5, 1.0, 1.0], names=names)
        self._stream.log(f"{device}/drift/{axis}", line, static=True)
        line = rr.SeriesLines(colors=[colour], widths=[1.0], names=[f"{axis}, σ"])
        self._stream.log(f"{device}/innovation/{axis}", line, static=True)
        line = rr.SeriesLines(colors=[colour], widths=[1.0], names=[f"{axis}, {SAMPLE_UNITS['gyro'].name}"])
        self._stream.log(f"{device}/compensated/{axis}", line, static=True)

    def _mark_changes(self, device: str, wall_s: float, event: Event) -> None:
        """Mark changed coefficients with a diamond at their new value."""
        if event.axis is None:
            return
        for letter, sizes in event.values.items():
            if letter in SYMBOLS and "after" in sizes:
                unit = COEFFICIENT_UNITS[sensor_kind(event.axis)][letter]
                path = f"{device}/coefficients/{letter}/{event.axis}/changed"
                self._scalars(path, np.array([wall_s]), np.array([sizes["after"]]) * unit.factor)

    def _scalars(self, path: str, wall_s: Floats, values: Floats) -> None:
        """Log ``values`` of shape [n] or [n, series] at the Unix times ``wall_s`` of shape [n]."""
        if wall_s.size:
            time = rr.TimeColumn(TIMELINE, timestamp=_timestamps(wall_s))
            self._stream.send_columns(path, [time], rr.Scalars.columns(scalars=values))

    def _set_time(self, wall_s: float) -> None:
        """Set the time of the following log calls."""
        self._stream.set_time(TIMELINE, timestamp=_timestamps(np.array([wall_s]))[0])

    def _allan(self, device: str, kind: Kind, estimate: Estimate) -> None:
        """Log the Allan plot of one kind of sensor."""
        gap = self._devices[device].gap
        curves = [c for axis in axes_of(kind) if (c := _Curve.of(estimate, axis, gap)) is not None]
        if not curves:
            return
        scale = Scale(decades(c.tau for c in curves), decades(part for c in curves for part in c.shown))
        if self._devices[device].scales.get(kind) != scale:
            self._devices[device].scales[kind] = scale
            self._grid(f"{device}/allan/{kind}", kind, scale, [c.axis for c in curves])
        for curve in curves:
            self._curve(f"{device}/allan/{curve.axis}", scale, curve)

    def _grid(self, path: str, kind: Kind, scale: Scale, axes: Sequence[str]) -> None:
        """Log frame, decade lines, tick labels and legend of a plot."""
        lines = grid(scale)
        for name, strips, colour, order in (
            ("minor", lines.minor, colours.MINOR, -30.0),
            ("major", lines.major, colours.MAJOR, -29.0),
            ("frame", lines.frame, colours.FRAME, -10.0),
        ):
            strip = rr.LineStrips2D(strips, colors=[colour], radii=rr.Radius.ui_points(0.5), draw_order=order)
            self._stream.log(f"{path}/{name}", strip)
        ticks = [(x, y, label) for x, y, label in lines.ticks]
        unit = DEVIATION_UNITS[kind].name
        ticks += [(WIDTH / 2, HEIGHT + 0.85, "averaging time τ, s"), (1.2, -0.85, f"σ(τ), {unit}")]
        self._labels(f"{path}/ticks", ticks)
        self._legend(path, axes)

    def _legend(self, path: str, axes: Sequence[str]) -> None:
        """Log a stroke and a name for each axis above the right end of the box."""
        ends = [(axis, WIDTH - 2.0 * (len(axes) - 1 - i) - 0.5) for i, axis in enumerate(axes)]
        strokes = [np.array([[x - 1.15, -0.42], [x - 0.5, -0.42]]) for _, x in ends]
        tints = [colours.AXIS_COLOURS[axis] for axis in axes]
        lines = rr.LineStrips2D(strokes, colors=tints, radii=rr.Radius.ui_points(2.0), draw_order=30.0)
        self._stream.log(f"{path}/legend/strokes", lines)
        self._labels(f"{path}/legend", [(x, -0.85, axis) for axis, x in ends])

    def _labels(self, path: str, labels: list[tuple[float, float, str]]) -> None:
        """Log text labels at chart positions."""
        points = rr.Points2D(
            [(x, y) for x, y, _ in labels],
            labels=[text for _, _, text in labels],
            colors=[colours.TEXT],
            radii=[0.0],
            show_labels=True,
        )
        self._stream.log(path, points)

    def _curve(self, path: str, scale: Scale, curve: "_Curve") -> None:
        """Log band, fitted line, intervals and measured points of one axis, and the model in use as a dashed line."""
        colour = colours.AXIS_COLOURS[curve.axis]
        low, high = scale.to_chart(curve.tau, curve.lo), scale.to_chart(curve.tau, curve.hi)
        fill = rr.LineStrips2D(
            list(band(low, high)),
            colors=[colours.blend(colour, 0.22)],
            radii=[WIDTH / FILL_STEPS / 2],
            draw_order=-20.0,
        )
        self._stream.log(f"{path}/band", fill)
        thin = rr.Radius.ui_points(0.75)
        dim = colours.blend(colour, 0.6)
        strokes = rr.LineStrips2D(list(interval_strokes(low, high)), colors=[dim], radii=thin, draw_order=5.0)
        self._stream.log(f"{path}/interval", strokes)
        fitted = finite_sections(scale.to_chart(curve.tau, curve.fitted))
        fit = rr.LineStrips2D(fitted, colors=[colour], radii=rr.Radius.ui_points(1.25), draw_order=10.0)
        self._stream.log(f"{path}/fit", fit)
        dashed = [
            stroke for run in finite_sections(scale.to_chart(curve.tau, curve.model)) for stroke in dash_line(run)
        ]
        model = rr.LineStrips2D(dashed, colors=[colours.TEXT], radii=rr.Radius.ui_points(0.75), draw_order=15.0)
        self._stream.log(f"{path}/model", model)
        points = rr.Points2D(
            scale.to_chart(curve.tau, curve.deviation),
            colors=[colour],
            radii=rr.Radius.ui_points(3.0),
            draw_order=20.0,
        )
        self._stream.log(path, points, rr.AnyValues(drop_untyped_nones=True, **curve.si))


@dataclass(frozen=True)
class _Curve:
    """Allan curve of one axis at its measured points, in the unit of the field."""

    axis: str
    tau: Floats
    deviation: Floats
    lo: Floats
    hi: Floats
    fitted: Floats
    model: Floats  # deviation of the model in use; NaN if there is none
    si: dict[str, Floats]

    @property
    def shown(self) -> tuple[Floats, ...]:
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


def _values_between_estimates(wall_s: float, estimate: Estimate) -> tuple[Floats, Floats]:
    """Return times [n] and coefficients [n, 5, 6] since the previous estimate; the last entry is the estimate itself.

    The entries are thinned to POINTS_BETWEEN_ESTIMATES points. More could not be distinguished and would overload the
    viewer.
    """
    if estimate.history is None:
        return np.array([wall_s]), np.full((1, 5, 6), np.nan)
    step = -(-estimate.history.t_ns.size // POINTS_BETWEEN_ESTIMATES)
    rows = slice((estimate.history.t_ns.size - 1) % step, None, step)
    before_s = (estimate.history.t_ns[-1] - estimate.history.t_ns[rows]) / 1e9
    return wall_s - before_s, estimate.history.value[rows].copy()


def _value_with_interval(estimate: Estimate, row: int, column: int) -> tuple[float, float, float]:
    """Return value, lo and hi of an estimated coefficient; NaN for upper bounds and for very wide intervals.

    Wide intervals occur in the first seconds of a device and would determine the scale of the plot.
    """
    c = estimate.coefficients
    if c.status[row, column] != Status.ESTIMATED:
        return np.nan, np.nan, np.nan
    value, lo, hi = (float(part[row, column]) for part in (c.value, c.lo, c.hi))
    return (
        (value, lo, hi)
        if lo * MAX_INTERVAL_RATIO > value and hi < value * MAX_INTERVAL_RATIO
        else (value, np.nan, np.nan)
    )


def _thermal(one: AxisThermalUpdate | None) -> tuple[float, float, float, float]:
    """Return measured bias, one-step prediction, and the ends of its interval, which events are based on."""
    if one is None:
        return np.nan, np.nan, np.nan, np.nan
    band = one.one_step
    return (one.bias, np.nan, np.nan, np.nan) if band is None else (one.bias, band.bias, band.lo, band.hi)


def _drift(look: DriftUpdate, axis: int) -> tuple[float, float, float, float]:
    """Return mean at rest, predicted drift, and the ends of its 95 % interval."""
    expected, wide = float(look.expected[axis]), Z95 * float(look.error[axis])
    return float(look.mean[axis]), expected, expected - wide, expected + wide


def _timestamps(wall_s: Floats) -> "np.ndarray[tuple[int, ...], np.dtype[np.datetime64]]":
    """Convert Unix times in seconds to nanosecond timestamps."""
    return np.round(wall_s * 1e9).astype("datetime64[ns]")


def _clock_time(wall_s: float) -> str:
    """Format the time of day in UTC, as on the viewer's time axes; its date column is too narrow to show the time.

    >>> _clock_time(1.76e9)
    '08:53:20'
    """
    return str(np.datetime_as_string(_timestamps(np.array([wall_s]))[0], "s")[-8:])


def _markdown(text: str) -> rr.TextDocument:
    """Return a Markdown document."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
