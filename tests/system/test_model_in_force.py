"""Tests of the comparison of a simulated sensor with its noise model, and of ``reconcile`` on request over zenoh."""

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
from tests.support.zenoh_sessions import open_session
from tests.system.rig import RecordingOutput

MODEL = CONFIG_FOLDER / "models" / "consumer-mems.toml"
RATE_HZ = 100.0
SPEED = 50.0
AT_S = 80.0
COMPARISON_SAMPLES = 1000
"""Number of samples that the sensor may send before the next comparison, which a loaded machine may delay."""
VIBRATION = "gz.sinusoidal:amplitude=4e-3,frequency=17"


def build_config(zenoh_table: ZenohTable, effects: tuple[str, ...] = (), folder: Path | None = None) -> Config:
    """Return the configuration of the demo at fifty times its speed, compared with its own noise model."""
    config = build_demo_config(effects=effects, effect_at_s=AT_S)
    (device,) = config.devices
    assert isinstance(device.link, VirtualTable)
    fast = device.link.model_copy(update={"speed": SPEED})
    update = {"driver": replace(device.driver, link=fast), "model": MODEL, "reconcile_folder": folder}
    device = device.model_copy(update=update)
    viewer = config.viewer.model_copy(update={"mode": "none"})
    return replace(config, devices=(device,), zenoh=zenoh_table, viewer=viewer)


class StopAtDisagreementOutput(RecordingOutput):
    """Output that stops the service when the sensor disagrees with its model."""

    service: Service | None = None
    before: ModelComparison | None = None  # the last comparison without the effect
    disagreement_s = 0.0  # time of the sensor
    compared_samples = 0  # samples in the newest comparison

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        super().publish_result(device, unix_s, received, result)
        if isinstance(result, ModelComparison):
            self.compared_samples = result.samples
            if result.samples / RATE_HZ < AT_S:
                self.before = result

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        super().publish_event(device, unix_s, received, event)
        if event.kind == "model_disagrees" and self.service is not None:
            self.disagreement_s = self.compared_samples / RATE_HZ  # the comparison was published just before
            self.service.request_stop()


def test_event_reports_when_a_sensor_stops_agreeing_with_its_model() -> None:
    service = Service(build_config(ZenohTable(mode="none"), (VIBRATION,)))
    output = StopAtDisagreementOutput()
    output.service = service
    service.outputs.append(output)
    follow_reader(
        service.workers[0].simulated, service.workers[0].driver, lambda: output.compared_samples + COMPARISON_SAMPLES
    )
    service.run(PATIENCE_S)
    assert output.before is not None
    assert output.before.agrees == dict.fromkeys(AXES, True)
    events = [event for _, event in output.events if event.kind == "model_disagrees"]
    assert [event.axis for event in events] == ["gz"]
    (event,) = events
    assert AT_S + 1.0 < output.disagreement_s < AT_S + 40.0
    comparison = event.values["model"]
    assert comparison["agrees"] is False
    assert comparison["gap"] > 2.0 * comparison["threshold"]
    assert comparison["tau_lo"] <= 0.04 <= comparison["tau_hi"]  # a vibration of 17 Hz is largest at half its period
    assert comparison["ratio"] > 1.5
    assert "gz disagrees with its model at τ" in event.text
    assert output.comparisons["demo"].agrees["gz"] is False
    counts = service.workers[0].driver.counts
    assert (counts.lost, counts.bad) == (0, 0)


def build_reconcile_command(go: Path, copy: Path) -> tuple[str, ...]:
    """Return a substitute for the command: it copies the recording, and answers when the file ``go`` exists."""
    text = f"""
import json, os, shutil, sys, time
shutil.copy(sys.argv[1], {str(copy)!r})
while not os.path.exists({str(go)!r}):
    time.sleep(0.01)
found = {{"kind": "added", "effect": "sinusoidal", "confidence": 0.99}}
print(json.dumps({{"verdict": "explained", "axes": {{"gz": {{"steps": [found]}}}}, "arguments": sys.argv[2:]}}))
"""
    return (sys.executable, "-c", text)


def test_reconcile_on_request_over_zenoh_delays_neither_samples_nor_other_commands(tmp_path: Path) -> None:
    endpoint, go, copy = free_endpoint(), tmp_path / "go", tmp_path / "copy.npz"
    table = ZenohTable(listen=(endpoint,))
    service = Service(build_config(table), reconciler=Reconciler(build_reconcile_command(go, copy)))
    output = RecordingOutput()
    service.outputs.append(output)
    follow_reader(service.workers[0].simulated, service.workers[0].driver)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        wait_for(lambda: "demo" in output.comparisons and output.comparisons["demo"].samples > 3000, "samples")
        wait_for(lambda: service.zenoh.state == "ok", "zenoh")
        with open_session(connect=[endpoint]) as client:
            subscriber = client.declare_subscriber("imu/demo/gap", zenoh.handlers.FifoChannel(1000))
            first_request = client.get("imu/demo/command/reconcile", timeout=PATIENCE_S)
            wait_for(copy.exists, "the program")
            (second_reply,) = wait_for(lambda: list(client.get("imu/demo/command/reconcile", timeout=PATIENCE_S)))
            assert json.loads(bytes(second_reply.err.payload)) == {
                "error": "busy: a reconciliation of this device is already running"
            }
            (reset,) = wait_for(lambda: list(client.get("imu/demo/command/reset", timeout=PATIENCE_S)))
            assert reset.ok is not None  # another command is answered while reconcile runs
            before = output.healths["demo"].received
            wait_for(lambda: output.healths["demo"].received > before + 2000, "samples that go on")
            go.touch()
            (reply,) = list(first_request)
            found: dict[str, Any] = json.loads(bytes(reply.ok.payload))
            events = wait_for(lambda: [event for _, event in output.events if event.kind == "reconciled"])
            message = wait_for(subscriber.try_recv)
    finally:
        go.touch()
        service.request_stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert str(reply.ok.encoding) == topics.JSON
    assert (found["schema"], found["device"], found["verdict"]) == ("imu-monitor/reconcile/1", "demo", "explained")
    assert found["arguments"][-2:] == ["--model", str(MODEL)]
    assert [event.text for event in events] == ["reconcile: explained: gz sinusoidal added (0.990)"]
    gap = json.loads(bytes(message.payload))
    assert (gap["schema"], gap["device"]) == ("imu-monitor/gap/1", "demo")
    recording = load_samples(copy)
    sent = output.values("demo")
    assert recording.rate_hz == RATE_HZ
    n = len(recording)
    assert n >= 3000
    counts = service.workers[0].driver.counts
    assert (counts.lost, counts.bad) == (0, 0)
    np.testing.assert_allclose(recording.values, sent[:n], rtol=0.0, atol=1e-9)  # from the first sample on
    assert np.isfinite(recording.temperature_c).all()
