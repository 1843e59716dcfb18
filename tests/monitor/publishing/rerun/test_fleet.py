"""Tests of the viewer for several daemons: detailed devices, table of other devices and hostile messages."""

import contextlib
import threading
import time
from pathlib import Path

import pytest

from drivers.data_types import Event, make_block
from drivers.zenoh.sample_message import encode_samples
from monitor.common import topics
from monitor.common.device_health import Health
from monitor.publishing.messages.results import AllanMessage, CoefficientsMessage, EventMessage, StatusMessage
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.rerun.fleet import FleetView, full_device_key
from monitor.publishing.rerun.panels.panel_text import fleet_text
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.publishing.zenoh.subscriber import ReceivedMessageOrLiveliness, ZenohSubscriber
from monitor.settings.loading import ZenohTable
from tests.monitor.publishing import example_results
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_router

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from monitor.publishing.rerun.queued_view import RerunView
from tests.monitor.publishing.rerun.test_queued_view import read_entities


def test_keys_of_detailed_devices_are_completed() -> None:
    assert full_device_key("nose", "**") == "nose"
    assert full_device_key("imu/nose", "imu/**") == "imu/nose"
    assert full_device_key("nose", "fleet/*/**") == "fleet/nose"
    assert full_device_key("nose", "imu/nose") == "imu/nose"


def test_detailed_devices_are_drawn_and_others_are_in_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, path = free_endpoint(), tmp_path / "fleet.rrd"
    stop, messages = threading.Event(), []
    viewer = RerunView(ViewerSettings(mode=str(path)), [ViewerDeviceDescription("imu/nose", "over zenoh")], fleet=True)
    out = ZenohPublisher(ZenohTable(listen=(), connect=(endpoint,)), ["nose", "tail"])
    with (
        open_router(endpoint),
        contextlib.closing(out),
        contextlib.closing(ZenohSubscriber("imu/**", [endpoint], None, ["imu/nose"])) as subscriber,
        contextlib.closing(viewer),
    ):
        fleet = FleetView(subscriber, viewer, ["imu/nose"])
        take, draw = fleet.process_message, fleet.draw_device_table
        taken: set[str] = set()
        drawn: list[float] = []
        monkeypatch.setattr(fleet, "process_message", lambda message: take(message) or taken.add(message.key))
        monkeypatch.setattr(
            fleet, "draw_device_table", lambda wall_s, now_s: draw(wall_s, now_s) or drawn.append(now_s)
        )
        fleet_thread = threading.Thread(target=fleet.run, args=(stop, messages.append))
        out.start()
        subscriber.start()
        viewer.start()
        fleet_thread.start()
        wait_for(lambda: out.state == subscriber.state == viewer.state == "ok")
        t_s, values, temperature_c = example_results.simulate_samples(1.76e9, 0.1)
        rows = make_block((t_s * 1e9).astype("int64"), values, temperature_c)

        def publish() -> None:
            for device in ("nose", "tail"):
                out.set_alive(device, True)
                out.put(
                    topics.STATUS,
                    device,
                    StatusMessage.from_result(device, time.time(), 0, example_results.make_health()).encode(),
                )
                out.put(
                    topics.COEFFICIENTS,
                    device,
                    CoefficientsMessage.from_result(device, 1.76e9, 0, example_results.make_estimate()).encode(),
                )
                out.put(
                    topics.ALLAN,
                    device,
                    AllanMessage.from_result(device, 1.76e9, 0, example_results.make_estimate()).encode(),
                )
                out.put(topics.SAMPLES, device, encode_samples(device, 10, rows))
            stop.wait(0.2)

        topics_shown = ("samples", "coefficients", "allan", "status")
        wait_for(lambda: publish() or taken >= {f"imu/nose/{topic}" for topic in topics_shown} | {"imu/tail/status"})
        publish()  # an Allan curve before the first coefficients is not drawn
        out.put(
            topics.EVENT,
            "tail",
            EventMessage.from_result("tail", 1.76e9, 5, Event("moved", 0, "gz moved", "gz")).encode(),
        )
        wait_for(
            lambda: "imu/tail/event" in taken and len(fleet.board.devices_with_problems_first(time.monotonic())) == 2
        )
        tables = len(drawn)
        wait_for(lambda: len(drawn) >= tables + 2, "two more tables")
        stop.set()
        fleet_thread.join(PATIENCE_S)
    entities = read_entities(path)
    assert {"/imu/nose/samples/gz", "/imu/nose/allan/gx", "/imu/nose/coefficients/N/gz", "/overview"} <= entities.keys()
    assert not [name for name in entities if name.startswith("/imu/tail")]
    table = str(entities["/overview"])
    assert "imu/nose" in table
    assert "imu/tail" in table
    assert "imu/tail: gz moved" in str(entities["/overview/events"])
    assert fleet.malformed == 0


def test_status_without_a_time_is_in_the_table_but_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = RerunView(ViewerSettings(mode="none"), [ViewerDeviceDescription("imu/a")], fleet=True)
    drawn: list[float] = []
    monkeypatch.setattr(viewer, "put", lambda _device, unix_s, _health: drawn.append(unix_s))
    fleet = FleetView(ZenohSubscriber("imu/**", [free_endpoint()], None, ["imu/a"]), viewer, ["imu/a"])
    fleet.process_message(
        ReceivedMessageOrLiveliness(
            "imu/a/status",
            StatusMessage.from_result("a", None, 0, example_results.make_health(state="waiting")).encode(),
        )
    )
    (device,) = fleet.board.devices_with_problems_first(time.monotonic())
    assert device.status is not None
    assert device.status.state == "waiting"
    assert drawn == []
    fleet.process_message(
        ReceivedMessageOrLiveliness(
            "imu/a/status", StatusMessage.from_result("a", 5.0, 0, example_results.make_health()).encode()
        )
    )
    assert drawn == [5.0]
    assert fleet.malformed == fleet.board.malformed == 0


def test_page_of_a_device_whose_daemon_sends_nothing_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = RerunView(ViewerSettings(mode="none"), [ViewerDeviceDescription("imu/a")], fleet=True)
    drawn: list[tuple[float, Health]] = []
    monkeypatch.setattr(
        viewer, "put", lambda _device, unix_s, one: drawn.append((unix_s, one)) if isinstance(one, Health) else None
    )
    fleet = FleetView(ZenohSubscriber("imu/**", [free_endpoint()], None, ["imu/a"]), viewer, ["imu/a"])
    for name in "ab":
        status = StatusMessage.from_result(name, 100.0, 0, example_results.make_health()).encode()
        fleet.process_message(ReceivedMessageOrLiveliness(f"imu/{name}/status", status))
    (heard_s,) = (one.last_message_s for one in fleet.board.devices_with_problems_first(0.0) if one.key == "imu/a")
    drawn.clear()
    fleet.draw_device_table(0.0, heard_s + 1.0)
    assert not drawn
    fleet.draw_device_table(0.0, heard_s + 7.0)
    ((unix_s, health),) = drawn
    assert unix_s == pytest.approx(107.0)
    assert (health.state, health.rate_hz, health.text) == ("lost", None, "the daemon sends no data")
    fleet.draw_device_table(0.0, heard_s + 8.0)
    assert len(drawn) == 1


def test_hostile_messages_are_counted_and_change_nothing() -> None:
    viewer = RerunView(ViewerSettings(mode="none"), [ViewerDeviceDescription("imu/a")], fleet=True)
    fleet = FleetView(ZenohSubscriber("imu/**", [free_endpoint()], None, ["imu/a"]), viewer, ["imu/a"])
    fleet.process_message(
        ReceivedMessageOrLiveliness(
            "imu/a/coefficients", CoefficientsMessage.from_result("a", 1.0, 0, example_results.make_estimate()).encode()
        )
    )
    for key, payload in {
        "imu/a/samples": b"\x81" * 10_000,
        "imu/a/allan": b'{"schema":"imu-monitor/allan/1","tau":[1]}',
        "imu/a/event": b"[" * 60_000,
        "other": b"",
    }.items():
        fleet.process_message(ReceivedMessageOrLiveliness(key, payload))
    assert (fleet.malformed, fleet.board.malformed) == (2, 1)
    assert [device.key for device in fleet.board.devices_with_problems_first(time.monotonic())] == ["imu/a"]


def test_table_shows_problems_first_and_escapes_texts() -> None:
    registry = RemoteDeviceRegistry(lambda: 10.0)
    for device, changed in {
        "well": {},
        "bad": {"state": "lost", "text": "gone | <img src=x> [a](http://b)\n\n# head"},
    }.items():
        registry.process_message(
            f"imu/{device}/status",
            StatusMessage.from_result(device, 1.0, 0, example_results.make_health(**changed)).encode(),
        )
        registry.process_message(
            f"imu/{device}/coefficients",
            CoefficientsMessage.from_result(device, 1.0, 0, example_results.make_estimate()).encode(),
        )
    text = fleet_text(registry.devices_with_problems_first(10.0), 10.0, 40, "1 of 2 there")
    lines = [line.rstrip() for line in text.splitlines()]
    assert lines[0] == "**2** devices: **1** lost, **1** running; N in °/√h"
    assert "**1 of 2 there**" in lines
    table = [line for line in lines if line.startswith("|")]
    assert table[2].startswith("| **imu/bad** | **LOST** |")
    assert table[3].startswith("| **imu/well** | running | 99.98 Hz | 360,000 | 3 | 1 | 0.515 |")
    assert r"- **imu/bad**: gone \| \<img src=x\> \[a\](http://b)  \# head" in lines
    assert not [line for line in lines if line.startswith("- **imu/well**")]
    assert "… and 1 more with fewer problems" in fleet_text(registry.devices_with_problems_first(10.0), 10.0, 1)
