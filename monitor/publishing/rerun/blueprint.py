"""Layout of the Rerun viewer.

A single device fills the window of the viewer. With several devices, there is an overview and a tab for each device.
The tab of a device has a page for its present noise, for changes, for the model gap, and for temperature and drift. The
layout contains only views whose entities have data. Importing this module imports Rerun.
"""

import math
import re
from collections.abc import Collection, Sequence
from typing import Any, Final

import rerun.blueprint as rrb

from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KIND_NAMES,
    KINDS,
    SAMPLE_UNITS,
    SHORT_KIND_NAMES,
    Kind,
    UnitSystem,
    axes_of,
)
from monitor.publishing.rerun import allan_history_heat_map
from monitor.publishing.rerun.allan_chart_geometry import HEIGHT, WIDTH
from monitor.publishing.rerun.allan_drawing import FEW_TICKS, KEY_BELOW, KEY_ROW
from monitor.publishing.rerun.shared_views import (
    RAW_SAMPLES_S,
    TIMELINE,
    collapsed_blueprint,
    drawing_view,
    time_series_view,
)
from monitor.publishing.rerun.viewer_scene import PANELS
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription

NOW_COEFFICIENTS: Final = ("N", "B")
DYNAMIC_COEFFICIENTS: Final = ("N", "B", "K")
TYPICAL_TAU_COUNT: Final = 17
"""Number of averaging times of a sliding window of one hour at 100 Hz."""
MAX_DEVICES_WITH_LEGEND: Final = 4
"""Largest number of devices whose Allan plots in the overview have space for a legend and for all tick labels."""
ALWAYS_SHOWN: Final = ("/status", "/waiting", "/overview")
"""Path suffixes of views that are shown before their first data arrive."""
GUIDE: Final = "/guide/"
"""Part of the path of the text that describes the panels of a page."""
DESCRIPTIONS: Final = {
    "(status|waiting)": "**Is it healthy?** State of the device, its rate, and its samples since the start.",
    "overview": "**Are they healthy?** One row for each device, with its state and its lost and bad samples.",
    "coefficients": "**What is its noise now?** Q quantization, N white noise, B bias instability, K random walk and R "
    "ramp, with 95 % intervals.",
    "events": "**Has it changed?** Changes of noise and bias, lost samples and faults of the link, with UTC times.",
    "allan": "**Allan deviation:** noise (up) that remains after averaging for a time (right); lower is better. "
    "Orange ● x, green □ y, blue △ z, line fit, thin lines 95 %, rings N, 0.664 B and K, dashes model, grey poor fit.",
    "coefficients/[NBK]": "**N, B, K over time:** a diamond marks a change, and thin lines are 95 % intervals.",
    "samples": "**Samples:** the last 30 seconds as measured.",
    "temperature": "**Temperature:** as the sensor reports it.",
    "dynamic/..": "**Heat maps:** time runs to the right and averaging time upwards; vermilion is noisier, and blue is "
    "quieter, than the median.",
    "gap": "**Gap to the model:** above the grey threshold, the model does not describe the device. A lasting "
    "difference raises the gap.",
    "thermal/..": "**Bias:** mean of each interval in colour, prediction from temperature and last interval in grey, "
    "and its 95 % interval in thin lines.",
    "compensated": "**Rates:** measured rate in grey; smoothed rate without the predicted drift in colour.",
    "drift/g.": "**Drift:** means at rest in colour, prediction in grey, and its 95 % interval in thin lines.",
    "innovation/g.": "**Innovation:** differences of the means from their predictions, mostly within ±2 σ.",
    "drift": "**Drift of the gyros:** predicted drift of each gyroscope, and its ARMA model with coefficients φ and θ.",
}
"""Sentence that describes each kind of panel; the keys are regular expressions for the end of the path of its view."""


def blueprint(
    devices: Sequence[ViewerDeviceDescription],
    fleet: bool = False,
    entities: Collection[str] | None = None,
    units: UnitSystem = DEFAULT_UNITS,
) -> rrb.Blueprint:
    """Return the Rerun layout for a list of devices.

    Parameters
    ----------
    devices
        Devices to show.
    fleet
        True if the overview is a table that also lists devices that are not shown in detail.
    entities
        Paths of the entities that have data. Views of other entities are omitted. By default, no view is omitted.
    units
        Units of the plots.
    """
    waiting = {one.name for one in devices if entities is not None and f"/{one.name}/waiting" in entities}
    pages, names = [_device(one, one.name in waiting, units) for one in devices], [one.name for one in devices]
    root = pages[0] if len(pages) == 1 and not fleet else rrb.Tabs(_overview(names, units, fleet), *pages, active_tab=0)
    if entities is not None:
        _remove_views_without_data(root, entities)
    return collapsed_blueprint(root, TIMELINE)


def guide_texts(part: rrb.Container) -> dict[str, str]:
    """Return the text of each guide by its path in the layout, with one sentence for each kind of panel of the page."""
    texts: dict[str, str] = {}
    for one in part.contents:
        if isinstance(one, rrb.Container):
            texts |= guide_texts(one)
    views = list_views(part) if part.name else []  # only pages have names
    origins = [str(view.origin) for view in views]
    panels, guides = [one for one in origins if GUIDE not in one], [one for one in origins if GUIDE in one]
    found = [text for ending, text in DESCRIPTIONS.items() if any(re.search(f"/{ending}$", one) for one in panels)]
    return dict.fromkeys(guides, "\n".join(f"- {text}" for text in found)) | texts


def list_views(part: rrb.Container | rrb.View) -> list[rrb.View]:
    """Return all views of a layout, from left to right and from top to bottom."""
    return [part] if isinstance(part, rrb.View) else [view for one in part.contents for view in list_views(one)]


def _remove_views_without_data(part: rrb.Container, entities: Collection[str]) -> None:
    """Remove the views whose entities have no data, and the containers that become empty."""
    contents = list(part.contents)
    for one in contents:
        if isinstance(one, rrb.Container):
            _remove_views_without_data(one, entities)
    kept = [i for i, one in enumerate(contents) if _has_data(one, entities)]
    for name in ("column_shares", "row_shares"):
        shares = getattr(part, name, None)
        if shares is not None:
            setattr(part, name, [list(shares)[i] for i in kept])
    part.contents = [contents[i] for i in kept]


def _has_data(part: rrb.Container | rrb.View, entities: Collection[str]) -> bool:
    if isinstance(part, rrb.Container):
        return any(not part.name or GUIDE not in str(view.origin) for view in list_views(part))
    origin = str(part.origin)
    if origin.endswith(ALWAYS_SHOWN) or GUIDE in origin:
        return True
    contents: Any = [part.contents] if isinstance(part.contents, str) else part.contents
    shown = [f"{one.removeprefix('+ ').replace('$origin', origin).removesuffix('/**')}/" for one in contents]
    own = [path for path in shown if path.startswith(origin)]  # a view may add the samples for comparison
    return any(f"{entity}/".startswith(path) for path in own for entity in entities)


def _device(device: ViewerDeviceDescription, waiting: bool, units: UnitSystem) -> rrb.Container:
    pages = [_now(device.name, waiting, units), _changes(device.name, units)]
    guides = ((panel, _guide(device.name, panel.__name__)) for panel in PANELS)
    pages += [page for panel, guide in guides if (page := panel.own_page(device, units, guide)) is not None]
    if device.has_model:
        pages.append(_model_gap(device.name, units))
    return rrb.Tabs(*pages, active_tab=0, name=device.name)


def _now(name: str, waiting: bool, units: UnitSystem) -> rrb.Container:
    left = rrb.Vertical(
        rrb.TextDocumentView(
            origin=f"/{name}/{'waiting' if waiting else 'status'}", contents="$origin", name="Is it healthy?"
        ),
        rrb.Tabs(
            rrb.TextDocumentView(origin=f"/{name}/coefficients", contents="$origin", name="What is its noise now?"),
            _guide(name, "now"),
            active_tab=0,
        ),
        _event_list(f"/{name}/events"),
        row_shares=[1.9, 3.5, 2.4],
    )
    right = rrb.Vertical(
        rrb.Horizontal(*(_allan(name, kind, units) for kind in KINDS)),
        rrb.Horizontal(*(_coefficient(name, kind, symbol, units) for kind in KINDS for symbol in NOW_COEFFICIENTS)),
        rrb.Horizontal(*(_raw(name, kind) for kind in KINDS)),
        row_shares=[5.0, 2.2, 2.2],
    )
    return rrb.Horizontal(left, right, column_shares=[1, 2], name="Device")


def _changes(device: str, units: UnitSystem) -> rrb.Container:
    maps = [rrb.Horizontal(*(_heat_map(device, axis) for axis in axes_of(kind))) for kind in KINDS]
    lines = [_coefficient(device, kind, symbol, units) for kind in KINDS for symbol in DYNAMIC_COEFFICIENTS]
    texts = rrb.Horizontal(_event_list(f"/{device}/events"), _guide(device, "changes"), column_shares=[3, 2])
    return rrb.Vertical(*maps, rrb.Horizontal(*lines), texts, row_shares=[2.1, 2.1, 2.9, 2.9], name="What changed")


def _model_gap(device: str, units: UnitSystem) -> rrb.Container:
    plots = rrb.Horizontal(*(_allan(device, kind, units) for kind in KINDS))
    gaps = rrb.Horizontal(*(_gap(device, kind) for kind in KINDS), _guide(device, "gap"), column_shares=[2, 2, 1])
    return rrb.Vertical(gaps, plots, row_shares=[3, 5], name="Model gap")


def _overview(devices: Sequence[str], units: UnitSystem, fleet: bool) -> rrb.Container:
    texts = rrb.Vertical(
        rrb.Tabs(
            rrb.TextDocumentView(origin="/overview", contents="$origin", name="Are they healthy?"),
            _guide("", "overview"),
            active_tab=0,
        ),
        _event_list("/overview/events"),
        row_shares=[3, 1],
    )
    name = "Fleet" if fleet else "Overview"
    if not devices:
        return rrb.Vertical(texts, name=name)
    columns = math.ceil(math.sqrt(len(devices)))
    grids = [
        rrb.Grid(
            *(_small_allan(device, kind, len(devices)) for device in devices),
            grid_columns=columns,
            name=_allan_title(kind, units),
        )
        for kind in KINDS
    ]
    return rrb.Horizontal(texts, rrb.Tabs(*grids, active_tab=0), column_shares=[2, 3], name=name)


def _guide(device: str, page: str) -> rrb.View:
    return rrb.TextDocumentView(origin=f"{device}{GUIDE}{page}", contents="$origin", name="How to read this page")


def _event_list(origin: str) -> rrb.View:
    return rrb.TextDocumentView(origin=origin, contents="$origin", name="Has it changed?")


def _heat_map(device: str, axis: str) -> rrb.View:
    x, y = allan_history_heat_map.heat_map_bounds(TYPICAL_TAU_COUNT)
    name = f"{axis}: Allan deviation relative to its median"
    return drawing_view(f"/{device}/dynamic/{axis}", name, "$origin/**", x, y)


def _allan(device: str, kind: Kind, units: UnitSystem) -> rrb.View:
    bottom = HEIGHT + KEY_BELOW + 2.0 * KEY_ROW
    contents = [*_allan_contents(device, kind), f"- /{device}/allan/{kind}/{FEW_TICKS}"]
    return drawing_view(f"/{device}/allan", _allan_title(kind, units), contents, (-3.1, WIDTH + 1.8), (-1.8, bottom))


def _small_allan(device: str, kind: Kind, device_count: int) -> rrb.View:
    """Return an Allan plot of the overview, without the parts for which it has no space."""
    left_out: Sequence[str] = ("key/**", FEW_TICKS)
    x_range, y_range = (-3.1, WIDTH + 1.8), (-1.8, HEIGHT + 1.6)
    if device_count > MAX_DEVICES_WITH_LEGEND:
        left_out = ("key/**", "ticks", "legend/**", "letters")
        x_range, y_range = (-4.6, WIDTH + 2.8), (-1.2, HEIGHT + 3.0)
    contents = [*_allan_contents(device, kind), *(f"- /{device}/allan/{kind}/{one}" for one in left_out)]
    return drawing_view(f"/{device}/allan", device, contents, x_range, y_range)


def _allan_contents(device: str, kind: Kind) -> list[str]:
    return [f"+ /{device}/allan/{kind}/**", *(f"+ /{device}/allan/{axis}/**" for axis in axes_of(kind))]


def _allan_title(kind: Kind, units: UnitSystem) -> str:
    return f"{KIND_NAMES[kind]}: Allan deviation, {units.deviation(kind).name}"


def _coefficient(device: str, kind: Kind, symbol: str, units: UnitSystem) -> rrb.View:
    name = f"{SHORT_KIND_NAMES[kind]} {symbol}, {units.single(kind, symbol).name}"
    return time_series_view(f"/{device}/coefficients/{symbol}", name, [f"$origin/{axis}/**" for axis in axes_of(kind)])


def _raw(device: str, kind: Kind) -> rrb.View:
    name = f"{SHORT_KIND_NAMES[kind]}: samples, {SAMPLE_UNITS[kind].name}"
    contents = [f"$origin/{axis}" for axis in axes_of(kind)]
    return time_series_view(f"/{device}/samples", name, contents, RAW_SAMPLES_S, legend=True)


def _gap(device: str, kind: Kind) -> rrb.View:
    name = f"{SHORT_KIND_NAMES[kind]}: gap to the model and its threshold, σ"
    return time_series_view(f"/{device}/gap", name, [f"$origin/{kind}"])
