"""Tests of the entities that the viewer receives."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.data_types import Event
from tests.monitor.publishing import example_results

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.rerun import viewer_scene
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription

T0 = 1.76e9
DURATION_S = 60


class LoggingCalls:
    """Rerun stream that lists the path and the Unix time of each call that logs an entity."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, float]] = []
        self.static: list[str] = []  # paths of static entities
        self._unix_s = 0.0

    def set_time(self, _timeline: str, timestamp: np.datetime64) -> None:
        self._unix_s = timestamp.astype("int64") / 1e9

    def log(self, path: str, *_components: Any, static: bool) -> None:
        if static:
            self.static.append(path)
        else:
            self.calls.append((path, self._unix_s))

    def send_columns(self, *_arguments: Any) -> None:
        """Ignore time series, because a viewer that joins late receives their older points afterwards."""


@pytest.mark.parametrize("devices", [["left"], ["left", "right"]])
def test_newest_messages_contain_every_entity(devices: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(viewer_scene, "time", SimpleNamespace(monotonic=lambda: now_s))
    stream = LoggingCalls()
    scene = viewer_scene.AllDevicesScene(stream)  # type: ignore[arg-type]
    scene.set_detailed_devices([ViewerDeviceDescription(name) for name in devices])
    estimates = [example_results.make_estimate(T0 + i) for i in range(DURATION_S)]
    newest_messages = 0  # number of messages before the last seconds
    for i, estimate in enumerate(estimates):
        now_s = float(i)
        if now_s + viewer_scene.REPEAT_PERIOD_S < DURATION_S:
            newest_messages = len(stream.calls)
        for name in devices:
            if i == 0:
                scene.draw(name, "EventsPanel", [(T0, Event("noise_changed", 0, "gz noise rose by 47 %", axis="gz"))])
            scene.draw(name, "AllanAndCoefficientPanel", [(T0 + i, estimate)])
            scene.draw(name, "HealthPanel", [(T0 + i, example_results.make_health())])
    paths = {path for path, _ in stream.calls}
    assert {f"{name}/{part}" for name in devices for part in ("events", "allan/gyro/ticks", "allan/gyro/key")} < paths
    assert paths - {path for path, _ in stream.calls[newest_messages:]} == set()
    first_s = DURATION_S - viewer_scene.REPEAT_PERIOD_S - 1.0
    assert min(unix_s for _, unix_s in stream.calls[newest_messages:]) >= T0 + first_s


@pytest.mark.parametrize(("state", "noted"), [("running", False), ("ended", False), ("lost", True), ("waiting", True)])
def test_plots_of_a_disconnected_device_are_marked(state: str, noted: bool) -> None:
    stream = LoggingCalls()
    scene = viewer_scene.AllDevicesScene(stream)  # type: ignore[arg-type]
    scene.set_detailed_devices([ViewerDeviceDescription("left")])
    scene.draw("left", "AllanAndCoefficientPanel", [(T0, example_results.make_estimate(T0))])
    scene.draw("left", "HealthPanel", [(T0 + 5.0, replace(example_results.make_health(), state=state))])
    marked = {(f"left/allan/{kind}/disconnected", T0 + 5.0) for kind in ("gyro", "accel")}
    assert marked & set(stream.calls) == (marked if noted else set())


def test_repeated_entity_does_not_replace_a_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(viewer_scene, "time", SimpleNamespace(monotonic=lambda: now_s))
    stream = LoggingCalls()
    scene = viewer_scene.AllDevicesScene(stream)  # type: ignore[arg-type]
    scene.set_log_time(T0 + 10.0)
    scene.log("left/events", "text")
    now_s = viewer_scene.REPEAT_PERIOD_S
    scene.repeat_unchanged_entities("right", T0 + 20.0)
    scene.repeat_unchanged_entities("left", T0 + 5.0)
    scene.repeat_unchanged_entities("left", T0 + 20.0)
    assert stream.calls == [("left/events", T0 + 10.0)] * 2


def test_event_found_late_replaces_the_repeated_list() -> None:
    stream = LoggingCalls()
    scene = viewer_scene.AllDevicesScene(stream)  # type: ignore[arg-type]
    for at_s in (T0 + 20.0, T0 + 5.0):
        scene.set_log_time(at_s)
        scene.log("left/events", "text")
    scene.log("left/other", "text")
    assert stream.calls == [("left/events", T0 + 20.0)] * 2 + [("left/other", T0 + 5.0)]


def test_static_text_is_logged_again_only_if_it_changes() -> None:
    stream = LoggingCalls()
    scene = viewer_scene.AllDevicesScene(stream)  # type: ignore[arg-type]
    for text in ("one", "one", "two", "two"):
        scene.log_static_text("left/guide/now", text)
    assert stream.static == ["left/guide/now"] * 2
    assert scene.entities == {"/left/guide/now"}
