"""Layout of the Rerun viewer.

A single device fills the window of the viewer. With several devices, there is an overview and a tab for each device.
The tab of a device contains panels for its present noise and for the noise over time. Importing this module imports
Rerun.
"""

from collections.abc import Sequence
from typing import Final

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KIND_NAMES,
    KINDS,
    SAMPLE_UNITS,
    Kind,
    UnitSystem,
    axes_of,
)
from monitor.publishing.rerun import dynamic_heat_map
from monitor.publishing.rerun.allan_chart_geometry import HEIGHT, WIDTH
from monitor.publishing.rerun.shared_views import (
    RAW_SAMPLES_S,
    TIMELINE,
    collapsed_blueprint,
    drawing_view,
    temperature_view,
    time_series_view,
)
from monitor.publishing.rerun.viewer_scene import PANELS
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription

NOW_COEFFICIENTS: Final = ("N", "B")
DYNAMIC_COEFFICIENTS: Final = ("N", "B", "K")
TYPICAL_TAU_COUNT: Final = 17
"""Number of averaging times of a sliding window of one hour at 100 Hz."""
MAX_DEVICES_WITH_ACCEL: Final = 4
"""Largest number of devices for which the overview shows accelerometers as well as gyroscopes."""
MAX_GRID_COLUMNS: Final = 4
SHORT_KIND_NAMES: Final = {"gyro": "Gyro", "accel": "Accel"}


def blueprint(
    devices: Sequence[ViewerDeviceDescription], fleet: bool = False, units: UnitSystem = DEFAULT_UNITS
) -> rrb.Blueprint:
    """Return the Rerun layout for a list of devices.

    Parameters
    ----------
    devices
        Devices to show.
    fleet
        True if the overview is a table that also lists devices that are not shown in detail.
    units
        Units of the plots.
    """
    pages, names = [_device(one, units) for one in devices], [one.name for one in devices]
    if fleet:
        root: rrb.Container = rrb.Tabs(_fleet(names, units), *pages, active_tab=0)
    else:
        root = pages[0] if len(pages) == 1 else rrb.Tabs(_overview(names, units), *pages, active_tab=0)
    return collapsed_blueprint(root, TIMELINE)


def _device(device: ViewerDeviceDescription, units: UnitSystem) -> rrb.Container:
    tabs = [tab for panel in PANELS if (tab := panel.tab_layout(device, units)) is not None]
    return rrb.Tabs(_now(device, units), _dynamic(device.name, units), *tabs, active_tab=0, name=device.name)


def _now(device: ViewerDeviceDescription, units: UnitSystem) -> rrb.Container:
    name = device.name
    left = rrb.Vertical(
        rrb.TextDocumentView(origin=f"/{name}/status", name="Is it healthy?"),
        rrb.TextDocumentView(origin=f"/{name}/coefficients", contents="$origin", name="What is its noise now?"),
        _event_log(f"/{name}/events"),
        row_shares=[2.35, 6.3, 1.35],
    )
    rows = [
        (5.0, rrb.Horizontal(*(_allan(name, kind, units) for kind in KINDS))),
        (2.2, rrb.Horizontal(*(_coefficient(name, kind, one, units) for kind in KINDS for one in NOW_COEFFICIENTS))),
        (1.6, rrb.Horizontal(*(_gap(name, kind) for kind in KINDS))),
        (2.2, rrb.Horizontal(*(_raw(name, kind) for kind in KINDS), temperature_view(name), column_shares=[2, 2, 1])),
    ]
    if not device.has_model:
        del rows[2]
    right = rrb.Vertical(*(row for _, row in rows), row_shares=[share for share, _ in rows])
    return rrb.Horizontal(left, right, column_shares=[3, 7], name="Now")


def _dynamic(device: str, units: UnitSystem) -> rrb.Container:
    columns = [
        rrb.Vertical(
            *(_heat_map(device, axis) for axis in axes_of(kind)),
            rrb.Horizontal(*(_coefficient(device, kind, symbol, units) for symbol in DYNAMIC_COEFFICIENTS)),
            row_shares=[3, 3, 3, 2.6],
        )
        for kind in KINDS
    ]
    return rrb.Horizontal(*columns, name="Dynamic")


def _overview(devices: Sequence[str], units: UnitSystem) -> rrb.Container:
    kinds = KINDS if len(devices) <= MAX_DEVICES_WITH_ACCEL else KINDS[:1]
    charts = [_allan(device, kind, units, f"{device}: ") for kind in kinds for device in devices]
    return rrb.Vertical(
        rrb.Horizontal(*_overview_texts(), column_shares=[11, 9]),
        rrb.Grid(*charts, grid_columns=min(len(devices), MAX_GRID_COLUMNS)),
        row_shares=[1, 4],
        name="Overview",
    )


def _fleet(devices: Sequence[str], units: UnitSystem) -> rrb.Container:
    charts = [_allan(device, kind, units, f"{device}: ") for device in devices for kind in KINDS]
    if not charts:
        return rrb.Vertical(*_overview_texts(), row_shares=[4, 1], name="Fleet")
    left = rrb.Vertical(*_overview_texts(), row_shares=[4, 1])
    right = rrb.Grid(*charts, grid_columns=1 if len(devices) == 1 else 2)
    return rrb.Horizontal(left, right, column_shares=[6, 5], name="Fleet")


def _overview_texts() -> tuple[rrb.View, rrb.View]:
    table = rrb.TextDocumentView(origin="/overview", contents="$origin", name="Is it healthy?")
    return table, _event_log("/overview/events")


def _event_log(origin: str) -> rrb.View:
    hidden = TimelineColumn(timeline=TIMELINE, visible=False)
    columns = rrb.TextLogColumns(timeline_columns=[hidden], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin=origin, name="Has it changed?", columns=columns)


def _heat_map(device: str, axis: str) -> rrb.View:
    x, y = dynamic_heat_map.heat_map_bounds(TYPICAL_TAU_COUNT)
    name = f"{axis}: Allan deviation over time, divided by its median"
    return drawing_view(f"/{device}/dynamic/{axis}", name, "$origin/**", x, y)


def _allan(device: str, kind: Kind, units: UnitSystem, prefix: str = "") -> rrb.View:
    paths = [f"+ /{device}/allan/{kind}/**", *(f"+ /{device}/allan/{axis}/**" for axis in axes_of(kind))]
    name = f"{prefix}{KIND_NAMES[kind]}: Allan deviation, {units.deviation(kind).name}"
    return drawing_view(f"/{device}/allan", name, paths, (-1.6, WIDTH + 0.6), (-1.3, HEIGHT + 2.5))


def _coefficient(device: str, kind: Kind, symbol: str, units: UnitSystem) -> rrb.View:
    name = f"{SHORT_KIND_NAMES[kind]} {symbol}, {units.single(kind, symbol).name}"
    return time_series_view(f"/{device}/coefficients/{symbol}", name, [f"$origin/{axis}/**" for axis in axes_of(kind)])


def _raw(device: str, kind: Kind) -> rrb.View:
    name = f"{KIND_NAMES[kind]}: samples, {SAMPLE_UNITS[kind].name}"
    contents = [f"$origin/{axis}" for axis in axes_of(kind)]
    return time_series_view(f"/{device}/samples", name, contents, RAW_SAMPLES_S, legend=True)


def _gap(device: str, kind: Kind) -> rrb.View:
    name = f"{KIND_NAMES[kind]}: gap to the model, σ, and its threshold"
    contents = ["$origin/threshold", *(f"$origin/{axis}" for axis in axes_of(kind))]
    return time_series_view(f"/{device}/gap", name, contents)
