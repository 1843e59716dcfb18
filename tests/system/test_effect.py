"""Test that the service detects an effect that the simulated sensor of the demo adds while it runs."""

from dataclasses import replace

import pytest
from structlog.testing import capture_logs

from drivers.data_types import Event
from drivers.decoders.messages import samples
from monitor.daemon.service import Service
from monitor.settings.loading import VirtualTable
from monitor.simulator.demo_config import build_demo_config
from tests.support.paced_sensor import follow_reader
from tests.support.waiting import PATIENCE_S
from tests.system.rig import RecordingOutput

SPEED = 20.0
AT_S = 80.0
VIBRATION = "gz.sinusoidal:amplitude=4e-3,frequency=17"


class StopAtChangeOutput(RecordingOutput):
    """Output that stops the service at the first change of the noise."""

    service: Service | None = None

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        super().publish_event(device, unix_s, received, event)
        if event.kind == "noise_changed" and self.service is not None:
            self.service.request_stop()


def test_effect_that_starts_during_a_run_is_reported_on_its_axis() -> None:
    config = build_demo_config(effects=[VIBRATION], effect_at_s=AT_S)
    (device,) = config.devices
    assert isinstance(device.link, VirtualTable)
    # messages carry the time of the sensor, so the time of an event refers to the clock of the sensor
    decoder = samples.build(samples.Settings())
    link = device.link.model_copy(update={"speed": SPEED})
    fast = device.model_copy(update={"driver": replace(device.driver, link=link, decoder=decoder)})
    quiet = config.zenoh.model_copy(update={"mode": "none"}), config.viewer.model_copy(update={"mode": "none"})
    service = Service(replace(config, devices=(fast,), zenoh=quiet[0], viewer=quiet[1]))
    output = StopAtChangeOutput()
    output.service = service
    service.outputs.append(output)
    follow_reader(service.workers[0].simulated, service.workers[0].driver)
    with capture_logs() as lines:
        service.run(PATIENCE_S)
    added = [line for line in lines if line["event"] == "effect added"]
    assert [(line["device"], line["axis"], line["effect"], line["at_s"]) for line in added] == [
        ("demo", "gz", VIBRATION, AT_S)
    ]
    changes = [event for _, event in output.events if event.kind == "noise_changed"]
    assert [event.axis for event in changes] == ["gz"]
    (change,) = changes
    first_ns = int(output.blocks["demo"][0].t_ns[0])
    assert AT_S <= (change.t_ns - first_ns) / 1e9 <= AT_S + 40.0
    assert change.since_ns is not None
    assert (change.since_ns - first_ns) / 1e9 == pytest.approx(AT_S, abs=2.0)
    counts = service.workers[0].driver.counts
    assert (counts.lost, counts.bad) == (0, 0)
    assert "gz" in change.text
