"""Tests of the Grafana dashboard in config/grafana: its schema, and the metrics that its panels query.

The classes state the fields of a dashboard as in Grafana's schema ``kinds/dashboard/dashboard_kind.cue`` (repository
grafana/grafana, commit 00139e84). Fields without a default are required there. Dashboards, panels and positions have
no other fields there. Fields with a default are required here if the dashboard states them.
"""

import re
from itertools import combinations
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from drivers.data_types import Event
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.daemon.operations.prometheus_metrics import MetricsOutput
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.settings.loading import MetricsAddress
from tests.monitor.publishing import example_results

DASHBOARD = CONFIG_FOLDER / "grafana" / "imu-monitor.json"
UInt = Annotated[int, Meta(ge=0, lt=2**32)]


class DataSource(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    uid: str


class GridPos(msgspec.Struct, forbid_unknown_fields=True):
    h: Annotated[int, Meta(gt=0)]
    w: Annotated[int, Meta(gt=0, le=24)]
    x: Annotated[int, Meta(ge=0, lt=24)]
    y: UInt


class Target(msgspec.Struct):
    """Query of the Prometheus data source. The schema leaves its fields to the data source."""

    refId: str  # noqa: N815 - name of the schema
    expr: str
    datasource: DataSource
    legendFormat: str  # noqa: N815


class Threshold(msgspec.Struct, forbid_unknown_fields=True):
    color: str
    value: float | None = None


class Thresholds(msgspec.Struct, forbid_unknown_fields=True):
    mode: Literal["absolute", "percentage"]
    steps: list[Threshold]


class FieldConfig(msgspec.Struct, forbid_unknown_fields=True):
    unit: str
    thresholds: Thresholds | None = None
    min: float | None = None
    custom: dict[str, Any] | None = None


class FieldConfigSource(msgspec.Struct, forbid_unknown_fields=True):
    defaults: FieldConfig
    overrides: list[Any]


class Panel(msgspec.Struct, forbid_unknown_fields=True):
    type: Annotated[str, Meta(min_length=1)]
    id: UInt
    title: str
    datasource: DataSource
    gridPos: GridPos  # noqa: N815
    targets: list[Target]
    transparent: bool
    transformations: list[Any]
    options: dict[str, Any]
    fieldConfig: FieldConfigSource  # noqa: N815
    description: str = ""


class Variable(msgspec.Struct):
    type: Literal["query", "adhoc", "constant", "datasource", "interval", "textbox", "custom", "system"]
    name: str
    hide: Literal[0, 1, 2]
    query: str | dict[str, str]
    skipUrlSync: bool  # noqa: N815
    label: str
    datasource: DataSource | None = None


class Templating(msgspec.Struct, forbid_unknown_fields=True):
    list: list[Variable]


class TimeRange(msgspec.Struct, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}):
    start: str
    end: str


class Dashboard(msgspec.Struct, forbid_unknown_fields=True):
    id: None
    uid: Annotated[str, Meta(min_length=8, max_length=40)]
    title: str
    description: str
    tags: list[str]
    timezone: str
    editable: bool
    graphTooltip: Literal[0, 1, 2]  # noqa: N815
    time: TimeRange
    refresh: str
    schemaVersion: Annotated[int, Meta(ge=36, lt=2**16)]  # noqa: N815
    version: UInt
    links: list[Any]
    annotations: dict[str, list[Any]]
    templating: Templating
    panels: list[Panel]


@pytest.fixture(scope="module")
def dashboard() -> Dashboard:
    return msgspec.json.decode(DASHBOARD.read_bytes(), type=Dashboard)


@pytest.fixture(scope="module")
def exported() -> dict[str, set[str]]:
    """Return the names of all metrics, as Prometheus stores them, with the names of their labels."""
    pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")
    output = MetricsOutput(MetricsAddress("127.0.0.1", 0))
    output.publish_health("a", 0.0, example_results.make_health(outputs={"zenoh": "ok"}))
    output.publish_result("a", 0.0, 0, example_results.make_estimate())
    output.publish_event("a", 0.0, 1, Event("link_lost", 0, ""))
    return {sample.name: set(sample.labels) for family in output.collect() for sample in family.samples}


def expressions(dashboard: Dashboard) -> list[str]:
    """Return all PromQL expressions of the panels and of the variables."""
    queries = [one.query for one in dashboard.templating.list if one.type == "query"]
    found = [target.expr for panel in dashboard.panels for target in panel.targets]
    return [*found, *(str(query["query"]) for query in queries if isinstance(query, dict))]


def test_the_dashboard_shows_every_metric_of_the_exporter(dashboard: Dashboard, exported: dict[str, set[str]]) -> None:
    queried = {name for text in expressions(dashboard) for name in re.findall(r"imu_monitor_\w+", text)}
    assert queried == set(exported)


def test_labels_of_the_queries_exist(dashboard: Dashboard, exported: dict[str, set[str]]) -> None:
    added = {"instance", "job"}  # Prometheus adds these labels to every metric
    variables = {one.name for one in dashboard.templating.list} | {"__rate_interval"}
    for text in expressions(dashboard):
        assert {*re.findall(r"\$(\w+)", text)} <= variables, text
        for name, matchers in re.findall(r"(imu_monitor_\w+)\{([^}]*)\}", text):
            assert {*re.findall(r"(\w+)=", matchers)} <= exported[name], text
        for name, label in re.findall(r"label_values\((\w+), (\w+)\)", text):
            assert label in exported[name], text
    for panel in dashboard.panels:
        for target in panel.targets:
            (name,) = re.findall(r"imu_monitor_\w+", target.expr)
            assert {*re.findall(r"\{\{(\w+)\}\}", target.legendFormat)} <= exported[name] | added, target.legendFormat


def test_identifiers_are_unique_and_panels_do_not_overlap(dashboard: Dashboard) -> None:
    assert len({panel.id for panel in dashboard.panels}) == len(dashboard.panels)
    for panel in dashboard.panels:
        assert len({target.refId for target in panel.targets}) == len(panel.targets) > 0
        assert panel.gridPos.x + panel.gridPos.w <= 24
        assert {target.datasource.uid for target in panel.targets} == {panel.datasource.uid} == {"${datasource}"}
    for one, other in combinations([panel.gridPos for panel in dashboard.panels], 2):
        apart = (
            one.x + one.w <= other.x
            or other.x + other.w <= one.x
            or one.y + one.h <= other.y
            or other.y + other.h <= one.y
        )
        assert apart, (one, other)


def test_coefficients_of_the_variable_are_those_of_the_program(dashboard: Dashboard) -> None:
    (letters,) = (one.query for one in dashboard.templating.list if one.name == "letter")
    assert letters == ",".join(SYMBOLS)
