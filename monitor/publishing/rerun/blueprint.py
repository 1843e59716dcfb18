"""Layout of the Rerun viewer: health, current noise, and changes.

A single device fills the window. Several devices have an overview and one tab each. A second tab of a device shows
its noise over time, a third its bias and temperature. The time panel follows the newest sample. This module defines
only the layout and handles no data. Importing it imports Rerun.
"""

from collections.abc import Collection, Sequence
from typing import Final

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from monitor.common.units import (
    COEFFICIENT_UNITS,
    DEVIATION_UNITS,
    KIND_NAMES,
    KINDS,
    SAMPLE_UNITS,
    Kind,
    axes_of,
    sensor_kind,
)
from monitor.publishing.plots import colours
from monitor.publishing.rerun import dynamic_surface
from monitor.publishing.rerun.allan_chart import HEIGHT, WIDTH
from monitor.publishing.rerun.scene import TIMELINE

RAW_SPAN_S: Final = 30.0  # time span of raw samples in view, up to the cursor
HALF_LABEL_SHARE: Final = 0.08  # width of half a tick label, as a share of the plot's width
NOW_COEFFICIENTS: Final = ("N", "B")
DYNAMIC_COEFFICIENTS: Final = ("N", "B", "K")
TYPICAL_TAU_COUNT: Final = 17
"""Octaves of one hour at 100 Hz. A surface with another number of τ has a slightly different height."""
MAX_DEVICES_WITH_ACCEL: Final = 4  # largest number of devices for which the overview also shows accelerometers
COLUMNS: Final = 4
SHORT_KIND_NAMES: Final = {"gyro": "Gyro", "accel": "Accel"}


def blueprint(
    devices: Sequence[str],
    with_model: Collection[str] = (),
    with_thermal: Collection[str] = (),
    compensated: Collection[str] = (),
    fleet: bool = False,
) -> rrb.Blueprint:
    """Return the layout for the devices.

    Parameters
    ----------
    devices
        Names of the devices.
    with_model
        Devices that are compared with a noise model.
    with_thermal
        Devices whose bias is compared with their temperature.
    compensated
        Devices whose gyroscope drift is compensated.
    fleet
        True if there are many more devices; the overview is then a table of all devices.
    """
    pages = [_device(d, d in with_model, d in with_thermal, d in compensated) for d in devices]
    if fleet:
        root: rrb.Container = rrb.Tabs(_fleet(devices), *pages, active_tab=0)
    else:
        root = pages[0] if len(pages) == 1 else rrb.Tabs(_overview(devices), *pages, active_tab=0)
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _device(device: str, has_model: bool, has_thermal: bool, compensated: bool) -> rrb.Container:
    """Return the tabs of one device."""
    left = rrb.Vertical(
        rrb.TextDocumentView(origin=f"/{device}/status", name="Is it healthy?"),
        rrb.TextDocumentView(origin=f"/{device}/coefficients", contents="$origin", name="What is its noise now?"),
        rrb.TextLogView(origin=f"/{device}/events", name="Has it changed?", columns=_log_columns()),
        row_shares=[2.35, 6.3, 1.35],
    )
    right = rrb.Vertical(
        rrb.Horizontal(*(_allan(device, kind) for kind in KINDS)),
        rrb.Horizontal(*(_course(device, kind, letter) for kind in KINDS for letter in NOW_COEFFICIENTS)),
        *([rrb.Horizontal(*(_gap(device, kind) for kind in KINDS))] if has_model else []),
        rrb.Horizontal(*(_raw(device, kind) for kind in KINDS), _temperature(device), column_shares=[2, 2, 1]),
        row_shares=[5, 2.2, 1.6, 2.2] if has_model else [5, 2.2, 2.2],
    )
    now = rrb.Horizontal(left, right, column_shares=[3, 7], name="Now")
    pages = [now, _dynamic(device)]
    pages += [_thermal(device)] if has_thermal else []
    pages += [_drift(device)] if compensated else []
    return rrb.Tabs(*pages, active_tab=0, name=device)


def _thermal(device: str) -> rrb.Container:
    """Return the tab with the bias of each axis, its prediction, and the temperature."""
    columns = [rrb.Vertical(*(_bias(device, axis) for axis in axes_of(kind))) for kind in KINDS]
    return rrb.Vertical(rrb.Horizontal(*columns), _temperature(device), row_shares=[4, 1], name="Temperature")


def _drift(device: str) -> rrb.Container:
    """Return the tab with rates before and after compensation, the predicted drift, and the innovations."""
    rows = [
        rrb.Horizontal(
            rrb.TimeSeriesView(
                origin=f"/{device}",
                contents=[f"+ $origin/samples/{axis}", f"+ $origin/compensated/{axis}"],
                name=f"{axis}: rate as measured, and without drift, {SAMPLE_UNITS['gyro'].name}",
                plot_legend=rrb.PlotLegend(visible=False),
                overrides={f"/{device}/samples/{axis}": rr.SeriesLines(colors=[colours.FRAME], widths=[0.75])},
                axis_x=_last_seconds(RAW_SPAN_S),
            ),
            rrb.TimeSeriesView(
                origin=f"/{device}/drift/{axis}",
                name=f"{axis}: means at rest, and the drift expected, {DEVIATION_UNITS['gyro'].name}",
                plot_legend=rrb.PlotLegend(visible=False),
                axis_x=_until_cursor(),
            ),
            rrb.TimeSeriesView(
                origin=f"/{device}/innovation/{axis}",
                name=f"{axis}: innovation, σ",
                plot_legend=rrb.PlotLegend(visible=False),
                axis_x=_until_cursor(),
            ),
            column_shares=[3, 3, 2],
        )
        for axis in axes_of("gyro")
    ]
    text = rrb.TextDocumentView(origin=f"/{device}/drift", contents="$origin", name="Drift of the gyros")
    return rrb.Vertical(*rows, text, row_shares=[3, 3, 3, 2.5], name="Drift")


def _bias(device: str, axis: str) -> rrb.View:
    """Return the view of the bias of one axis and its prediction."""
    return rrb.TimeSeriesView(
        origin=f"/{device}/thermal/{axis}",
        name=f"{axis}: bias, and what its temperature lets expect, {DEVIATION_UNITS[sensor_kind(axis)].name}",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=_until_cursor(),
    )


def _dynamic(device: str) -> rrb.Container:
    """Return the tab with the Allan surfaces of all axes and, below them, coefficients over time."""
    columns = [
        rrb.Vertical(
            *(_surface(device, axis) for axis in axes_of(kind)),
            rrb.Horizontal(*(_course(device, kind, letter) for letter in DYNAMIC_COEFFICIENTS)),
            row_shares=[3, 3, 3, 2.6],
        )
        for kind in KINDS
    ]
    return rrb.Horizontal(*columns, name="Dynamic")


def _surface(device: str, axis: str) -> rrb.View:
    """Return the view of the Allan surface of one axis."""
    x, y = dynamic_surface.bounds(TYPICAL_TAU_COUNT)
    return rrb.Spatial2DView(
        origin=f"/{device}/dynamic/{axis}",
        contents="$origin/**",
        name=f"{axis}: Allan deviation over time, against its median",
        background=rrb.Background(color=colours.BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=list(x), y_range=list(y)),
    )


def _overview(devices: Sequence[str]) -> rrb.Container:
    """Return the overview of several devices."""
    kinds = KINDS if len(devices) <= MAX_DEVICES_WITH_ACCEL else KINDS[:1]
    charts = [_allan(d, kind, f"{d}: ") for kind in kinds for d in devices]
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/overview", contents="$origin", name="Is it healthy?"),
            rrb.TextLogView(origin="/overview/events", name="Has it changed?", columns=_log_columns()),
            column_shares=[11, 9],
        ),
        rrb.Grid(*charts, grid_columns=min(len(devices), COLUMNS)),
        row_shares=[1, 4],
        name="Overview",
    )


def _fleet(devices: Sequence[str]) -> rrb.Container:
    """Return the overview of many devices: table, events, and Allan plots of the devices shown in detail."""
    table = rrb.TextDocumentView(origin="/overview", contents="$origin", name="Is it healthy?")
    events = rrb.TextLogView(origin="/overview/events", name="Has it changed?", columns=_log_columns())
    charts = [_allan(device, kind, f"{device}: ") for device in devices for kind in KINDS]
    if not charts:
        return rrb.Vertical(table, events, row_shares=[4, 1], name="Fleet")
    left = rrb.Vertical(table, events, row_shares=[4, 1])
    right = rrb.Grid(*charts, grid_columns=1 if len(devices) == 1 else 2)
    return rrb.Horizontal(left, right, column_shares=[6, 5], name="Fleet")


def _allan(device: str, kind: Kind, prefix: str = "") -> rrb.View:
    """Return the view of the Allan plot of one kind of sensor."""
    paths = [f"+ /{device}/allan/{kind}/**", *(f"+ /{device}/allan/{axis}/**" for axis in axes_of(kind))]
    bounds = rrb.VisualBounds2D(x_range=[-1.6, WIDTH + 0.6], y_range=[-1.3, HEIGHT + 1.7])
    return rrb.Spatial2DView(
        origin=f"/{device}/allan",
        contents=paths,
        name=f"{prefix}{KIND_NAMES[kind]}: Allan deviation, {DEVIATION_UNITS[kind].name}",
        background=rrb.Background(color=colours.BACKGROUND),
        visual_bounds=bounds,
    )


def _course(device: str, kind: Kind, letter: str) -> rrb.View:
    """Return the view of one coefficient over time."""
    unit = COEFFICIENT_UNITS[kind][letter].name
    return rrb.TimeSeriesView(
        origin=f"/{device}/coefficients/{letter}",
        contents=[f"+ $origin/{axis}/**" for axis in axes_of(kind)],
        name=f"{SHORT_KIND_NAMES[kind]} {letter}, {unit}",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=_until_cursor(),
    )


def _raw(device: str, kind: Kind) -> rrb.View:
    """Return the view of the raw samples."""
    return rrb.TimeSeriesView(
        origin=f"/{device}/samples",
        contents=[f"+ $origin/{axis}" for axis in axes_of(kind)],
        name=f"{KIND_NAMES[kind]}: samples, {SAMPLE_UNITS[kind].name}",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        axis_x=_last_seconds(RAW_SPAN_S),
    )


def _temperature(device: str) -> rrb.View:
    """Return the view of the temperature."""
    return rrb.TimeSeriesView(
        origin=f"/{device}/temperature",
        name="Temperature, °C",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=_until_cursor(),
    )


def _gap(device: str, kind: Kind) -> rrb.View:
    """Return the view of the gap to the model."""
    return rrb.TimeSeriesView(
        origin=f"/{device}/gap",
        contents=["+ $origin/threshold", *(f"+ $origin/{axis}" for axis in axes_of(kind))],
        name=f"{KIND_NAMES[kind]}: gap to the model, σ, and its threshold",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=_until_cursor(),
    )


def _log_columns() -> rrb.TextLogColumns:
    """Return the columns of the event log; the time of day is part of the text, as its column would be cut off."""
    hidden = TimelineColumn(timeline=TIMELINE, visible=False)
    return rrb.TextLogColumns(timeline_columns=[hidden], text_log_columns=["LogLevel", "Body"])


def _last_seconds(seconds: float) -> rrb.TimeAxis:
    """Return a time axis of the last seconds, with space on the right for a tick label at the cursor."""
    first, last = (rr.TimeRangeBoundary.cursor_relative(seconds=s) for s in (-seconds, HALF_LABEL_SHARE * seconds))
    return rrb.TimeAxis(view_range=rr.TimeRange(first, last))


def _until_cursor() -> rrb.TimeAxis:
    """Return a time axis from the beginning to the cursor."""
    now = rr.TimeRangeBoundary.cursor_relative()
    return rrb.TimeAxis(view_range=rr.TimeRange(rr.TimeRangeBoundary.infinite(), now))


def send(
    stream: rr.RecordingStream,
    devices: Sequence[str],
    with_model: Collection[str] = (),
    with_thermal: Collection[str] = (),
    compensated: Collection[str] = (),
    fleet: bool = False,
) -> None:
    """Send the layout to the viewer of a stream and activate it.

    Parameters
    ----------
    stream
        Stream of the viewer.
    devices, with_model, with_thermal, compensated, fleet
        See ``blueprint``.
    """
    stream.send_blueprint(
        blueprint(devices, with_model, with_thermal, compensated, fleet), make_active=True, make_default=True
    )
