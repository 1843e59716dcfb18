"""Tests of the layout of the viewer: pages, views without data, and descriptions."""

import re

import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.rerun.blueprint import (
    DESCRIPTIONS,
    GUIDE,
    MAX_DEVICES_WITH_LEGEND,
    blueprint,
    guide_texts,
    list_views,
)
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription

FULL = ViewerDeviceDescription("b", has_model=True, has_thermal=True, compensated=True)
PAGES = ["Device", "What changed", "Temperature", "Drift", "Model gap"]


def list_pages(device: ViewerDeviceDescription, entities: set[str] | None = None) -> list[str]:
    return [page.name for page in blueprint([device], entities=entities).root_container.contents]


def list_origins(*devices: ViewerDeviceDescription, entities: set[str] | None = None) -> list[str]:
    return [str(view.origin) for view in list_views(blueprint(devices, entities=entities).root_container)]


def test_device_has_the_pages_of_its_features() -> None:
    assert list_pages(ViewerDeviceDescription("a")) == PAGES[:3]
    assert "/a/thermal/gx" not in list_origins(ViewerDeviceDescription("a"))
    assert "/a/thermal/gx" in list_origins(ViewerDeviceDescription("a", has_thermal=True))
    assert list_pages(ViewerDeviceDescription("a", compensated=True)) == PAGES[:4]
    assert list_pages(FULL) == PAGES
    several = blueprint([ViewerDeviceDescription("nose"), ViewerDeviceDescription("tail")]).root_container
    assert [page.name for page in several.contents] == ["Overview", "nose", "tail"]


def test_events_are_below_the_coefficients() -> None:
    """The table of the coefficients needs less than half of the height of its column."""
    left, right = blueprint([FULL]).root_container.contents[0].contents
    assert [str(view.origin) for view in list_views(left)] == [
        *("/b/status", "/b/coefficients", "b/guide/now", "/b/events")
    ]
    assert "/b/events" not in [str(view.origin) for view in list_views(right)]


def test_device_without_data_has_its_state_and_a_guide() -> None:
    assert list_origins(FULL, entities=set()) == ["/b/status", "b/guide/now"]
    assert list_origins(FULL, entities={"/b/waiting"}) == ["/b/waiting", "b/guide/now"]


def test_views_and_pages_appear_with_their_data() -> None:
    entities = {"/b/status", "/b/samples/gx", "/b/allan/gx", "/b/coefficients", "/b/coefficients/N/gx"}
    assert list_pages(FULL, entities) == ["Device", "What changed", "Model gap"]
    assert list_pages(FULL, entities | {"/b/drift/gx", "/b/temperature"}) == PAGES
    origins = list_origins(FULL, entities=entities)
    assert {"/b/allan", "/b/samples", "/b/coefficients/N"} <= set(origins)
    assert not {"/b/temperature", "/b/gap", "/b/events", "/b/dynamic/gx", "/b/coefficients/B"} & set(origins)
    assert "/b/gap" in list_origins(FULL, entities=entities | {"/b/gap/gyro"})


def test_data_of_another_device_show_no_views() -> None:
    origins = list_origins(ViewerDeviceDescription("b"), ViewerDeviceDescription("bb"), entities={"/bb/allan/gx"})
    assert "/bb/allan" in origins
    assert "/b/allan" not in origins


def test_every_panel_has_one_sentence() -> None:
    for layout in (blueprint([FULL]), blueprint([FULL, ViewerDeviceDescription("c")]), blueprint([], fleet=True)):
        for view in list_views(layout.root_container):
            if GUIDE not in str(view.origin):
                found = [ending for ending in DESCRIPTIONS if re.search(f"/{ending}$", str(view.origin))]
                assert len(found) == 1, view.origin


def test_guide_describes_only_the_panels_of_its_page() -> None:
    texts = guide_texts(blueprint([FULL]).root_container)
    pages = ("DriftPanel", "ThermalPredictionPanel", "changes", "gap", "now")
    assert sorted(texts) == [f"b/guide/{page}" for page in pages]
    assert "Heat maps" in texts["b/guide/changes"]
    assert "Heat maps" not in texts["b/guide/now"]
    assert "Temperature" in texts["b/guide/ThermalPredictionPanel"]
    assert "Temperature" not in texts["b/guide/DriftPanel"]


@pytest.mark.parametrize("count", [2, 3, 12])
def test_overview_has_one_plot_of_each_kind_per_device(count: int) -> None:
    layout = blueprint([ViewerDeviceDescription(f"d{i}") for i in range(count)]).root_container.contents[0]
    plots = [view for view in list_views(layout) if str(view.origin).endswith("/allan")]
    assert [view.name for view in plots] == [f"d{i}" for i in range(count)] * 2
    legends = [view for view in plots if not any("legend" in one and one.startswith("-") for one in view.contents)]
    assert len(legends) == (2 * count if count <= MAX_DEVICES_WITH_LEGEND else 0)
