"""Test of the thermal model in the service on a simulated day with a bias that follows the temperature."""

import json
from pathlib import Path

import numpy as np
import zenoh

from drivers.recordings import save_samples
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, apply_lag, simulate_temperature
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_session, patient_file
from tests.system.rig import RecordingOutput, run_service

RATE_HZ = 5.0
HOURS, AT_H = 16, 13.0
STEP = 2e-4
T0 = 1_763_705_400.0
CONFIG = """
[[device]]
name = "oven"
rate = 5.0
window = "10min"
driver = {{ link = "replay", path = "{path}", speed = "max" }}

[viewer]
mode = "none"

[zenoh]
config = "{patient}"
mode = "client"
listen = []
connect = ["{endpoint}"]
"""


def write_recording(path: Path) -> Path:
    """Write a recording in which gz follows the temperature with a lag of 1 h and has a step, and gx is white noise."""
    rng = np.random.default_rng(11)
    temperature_c = simulate_temperature(HOURS, rng)
    minutes = np.arange(-48 * 60, HOURS * 60)
    t = np.arange(round(HOURS * 3600 * RATE_HZ)) / RATE_HZ
    values = np.full((t.size, 6), np.nan)
    values[:, 0] = 4e-4 * rng.standard_normal(t.size)
    values[:, 2] = BIAS_SLOPE * np.interp(
        t / 60.0, minutes, apply_lag(temperature_c, 1.0)
    ) + 4e-4 * rng.standard_normal(t.size)
    values[t >= AT_H * 3600.0, 2] += STEP
    save_samples(path, T0 + t, values, np.interp(t / 60.0, minutes, temperature_c))
    return path


def test_bias_step_that_temperature_does_not_explain_is_reported(tmp_path: Path) -> None:
    endpoint, output = free_endpoint(), RecordingOutput()
    complete, recording = write_recording(tmp_path / "complete.npz"), tmp_path / "day.npz"
    recording.touch()  # the replay retries until the file is a recording
    config = CONFIG.format(path=recording, endpoint=endpoint, patient=patient_file(tmp_path))
    with open_session(mode="router", listen=[endpoint]) as listener:
        subscriber = listener.declare_subscriber("imu/oven/thermal", zenoh.handlers.FifoChannel(1000))
        with run_service(tmp_path, config, output) as run:
            wait_for(lambda: run.service.zenoh.state == "ok", "zenoh")
            complete.replace(recording)
            wait_for(lambda: len(output.thermal_results.get("oven", [])) >= 6 * HOURS - 1, "the day")
        results, messages = output.thermal_results["oven"], []

        def last_message_arrived() -> bool:
            messages.extend(json.loads(bytes(message.payload)) for message in iter(subscriber.try_recv, None))
            return bool(messages) and messages[-1]["t"] == results[-1].t_ns / 1e9

        wait_for(last_message_arrived, "the last message over zenoh")
    assert results[-1].axes["gz"].model.startswith("difference")
    before = [result.axes["gz"] for result in results[24 : round(6 * AT_H)]]
    assert np.mean([one.one_step is not None and one.one_step.side_of_interval(one.bias) == 0 for one in before]) > 0.75
    events = [event for _, event in output.events if event.kind == "temperature_unexplained"]
    assert [event.axis for event in events] == ["gz"]
    assert abs(events[0].values["bias"]["size"] / STEP - 1.0) < 0.2
    assert events[0].since_ns is not None
    assert abs(events[0].since_ns / 1e9 - T0 - AT_H * 3600.0) <= 600.0
    last = messages[-1]
    assert (last["schema"], last["device"], last["interval"]) == ("imu-monitor/thermal/1", "oven", 600.0)
    assert last["axes"]["gz"]["one_step"]["bias"] == results[-1].axes["gz"].one_step.bias
