"""A sensor beside its model, from the wire to the event: it agrees, takes on an effect, and disagrees; asked over zenoh
why, the window goes through the command while samples go on."""

import json
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from drivers.data_types import AXES, Event
from drivers.recordings import load_samples
from monitor.common import topics
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.daemon.operations.reconcile_on_request import Reconciler
from monitor.daemon.service import Service
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.settings.loading import Config, VirtualTable, ZenohTable
from monitor.simulator.demo_config import build_demo_config
from tests.support.paced_sensor import follow_reader
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import session
from tests.system.rig import Caught

MODEL = CONFIG_FOLDER / "models" / "consumer-mems.toml"
RATE_HZ = 100.0
SPEED = 50.0
AT_S = 80.0
LOOK_SAMPLES = 1000
"""The sensor waits until the window has been looked at again, which a loaded machine does rarely."""
VIBRATION = "gz.sinusoidal:amplitude=4e-3,frequency=17"


def watched(zenoh_table: ZenohTable, effects: tuple[str, ...] = (), folder: Path | None = None) -> Config:
    """The demo, fifty times as fast, with its own model in force."""
    config = build_demo_config(effects=effects, effect_at_s=AT_S)
    (device,) = config.devices
    assert isinstance(device.link, VirtualTable)
    fast = device.link.model_copy(update={"speed": SPEED})
    update = {"driver": replace(device.driver, link=fast), "model": MODEL, "reconcile_folder": folder}
    device = device.model_copy(update=update)
    viewer = config.viewer.model_copy(update={"mode": "none"})
    return replace(config, devices=(device,), zenoh=zenoh_table, viewer=viewer)


class Watching(Caught):
    """Ends the service when the model is contradicted."""

    service: Service | None = None
    before: ModelComparison | None = None  # the last look without the effect
    told_s = 0.0  # of the sensor's time
    looked = 0  # samples that have been looked at

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        super().publish_result(device, unix_s, received, result)
        if isinstance(result, ModelComparison):
            self.looked = result.samples
            if result.samples / RATE_HZ < AT_S:
                self.before = result

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        super().publish_event(device, unix_s, received, event)
        if event.kind == "model_disagrees" and self.service is not None:
            self.told_s = self.looked / RATE_HZ  # the look that the event is of came just before
            self.service.request_stop()


def test_the_moment_a_sensor_stops_agreeing_with_its_model_is_an_event() -> None:
    service = Service(watched(ZenohTable(mode="none"), (VIBRATION,)))
    caught = Watching()
    caught.service = service
    service.outputs.append(caught)
    follow_reader(service.workers[0].simulated, service.workers[0].driver, lambda: caught.looked + LOOK_SAMPLES)
    service.run(PATIENCE_S)
    assert caught.before is not None
    assert caught.before.agrees == dict.fromkeys(AXES, True)
    told = [event for _, event in caught.events if event.kind == "model_disagrees"]
    assert [event.axis for event in told] == ["gz"]
    (event,) = told
    assert AT_S + 1.0 < caught.told_s < AT_S + 40.0
    what = event.values["model"]
    assert what["agrees"] is False
    assert what["gap"] > 2.0 * what["threshold"]
    assert what["tau_lo"] <= 0.04 <= what["tau_hi"]  # a vibration of 17 Hz is largest at half its period
    assert what["ratio"] > 1.5
    assert "gz disagrees with its model at τ" in event.text
    assert caught.gaps["demo"].agrees["gz"] is False
    counts = service.workers[0].driver.counts
    assert (counts.lost, counts.bad) == (0, 0)


def stand_in(go: Path, kept: Path) -> tuple[str, ...]:
    """In the place of the command: keeps the recording, and answers when it is told to."""
    text = f"""
import json, os, shutil, sys, time
shutil.copy(sys.argv[1], {str(kept)!r})
while not os.path.exists({str(go)!r}):
    time.sleep(0.01)
found = {{"kind": "added", "effect": "sinusoidal", "confidence": 0.99}}
print(json.dumps({{"verdict": "explained", "axes": {{"gz": {{"steps": [found]}}}}, "arguments": sys.argv[2:]}}))
"""
    return (sys.executable, "-c", text)


def test_reconcile_is_asked_for_over_zenoh_and_holds_nothing_up(tmp_path: Path) -> None:
    endpoint, go, kept = free_endpoint(), tmp_path / "go", tmp_path / "kept.npz"
    table = ZenohTable(listen=(endpoint,))
    service = Service(watched(table), reconciler=Reconciler(stand_in(go, kept)))
    caught = Caught()
    service.outputs.append(caught)
    follow_reader(service.workers[0].simulated, service.workers[0].driver)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        wait_for(lambda: "demo" in caught.gaps and caught.gaps["demo"].samples > 3000, "samples")
        wait_for(lambda: service.zenoh.state == "ok", "zenoh")
        with session(connect=[endpoint]) as client:
            gaps = client.declare_subscriber("imu/demo/gap", zenoh.handlers.FifoChannel(1000))
            asked = client.get("imu/demo/command/reconcile", timeout=PATIENCE_S)
            wait_for(kept.exists, "the program")
            (again,) = wait_for(lambda: list(client.get("imu/demo/command/reconcile", timeout=PATIENCE_S)))
            assert json.loads(bytes(again.err.payload)) == {
                "error": "busy: a reconciliation of this device is already running"
            }
            (reset,) = wait_for(lambda: list(client.get("imu/demo/command/reset", timeout=PATIENCE_S)))
            assert reset.ok is not None  # another command is answered meanwhile
            before = caught.healths["demo"].received
            wait_for(lambda: caught.healths["demo"].received > before + 2000, "samples that go on")
            go.touch()
            (reply,) = list(asked)
            found: dict[str, Any] = json.loads(bytes(reply.ok.payload))
            told = wait_for(lambda: [event for _, event in caught.events if event.kind == "reconciled"])
            shown = wait_for(gaps.try_recv)
    finally:
        go.touch()
        service.request_stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert str(reply.ok.encoding) == topics.JSON
    assert (found["schema"], found["device"], found["verdict"]) == ("imu-monitor/reconcile/1", "demo", "explained")
    assert found["arguments"][-2:] == ["--model", str(MODEL)]
    assert [event.text for event in told] == ["reconcile: explained: gz sinusoidal added (0.990)"]
    gap = json.loads(bytes(shown.payload))
    assert (gap["schema"], gap["device"]) == ("imu-monitor/gap/1", "demo")
    recording = load_samples(kept)
    sent = caught.values("demo")
    assert recording.rate_hz == RATE_HZ
    n = len(recording)
    assert n >= 3000
    counts = service.workers[0].driver.counts
    assert (counts.lost, counts.bad) == (0, 0)
    np.testing.assert_allclose(recording.values, sent[:n], rtol=0.0, atol=1e-9)  # from the first sample on
    assert np.isfinite(recording.temperature_c).all()
