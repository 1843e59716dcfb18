"""A recorded day whose bias follows its temperature, from the file to zenoh: what is expected of it, and the step that
temperature does not explain."""

import json
from pathlib import Path

import numpy as np
import zenoh

from drivers.recordings import save_samples
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, apply_lag, simulate_temperature
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import patient_file, session
from tests.system.rig import Caught, running

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


def day(path: Path) -> Path:
    """gz follows an hour late, and steps; gx has no temperature in it."""
    rng = np.random.default_rng(11)
    warmth = simulate_temperature(HOURS, rng)
    minutes = np.arange(-48 * 60, HOURS * 60)
    t = np.arange(round(HOURS * 3600 * RATE_HZ)) / RATE_HZ
    values = np.full((t.size, 6), np.nan)
    values[:, 0] = 4e-4 * rng.standard_normal(t.size)
    values[:, 2] = BIAS_SLOPE * np.interp(t / 60.0, minutes, apply_lag(warmth, 1.0)) + 4e-4 * rng.standard_normal(
        t.size
    )
    values[t >= AT_H * 3600.0, 2] += STEP
    save_samples(path, T0 + t, values, np.interp(t / 60.0, minutes, warmth))
    return path


def test_bias_beside_what_its_temperature_lets_expect(tmp_path: Path) -> None:
    endpoint, caught = free_endpoint(), Caught()
    made, recording = day(tmp_path / "made.npz"), tmp_path / "day.npz"
    recording.touch()  # the replay tries until it is a recording
    config = CONFIG.format(path=recording, endpoint=endpoint, patient=patient_file(tmp_path))
    with session(mode="router", listen=[endpoint]) as listener:
        heard = listener.declare_subscriber("imu/oven/thermal", zenoh.handlers.FifoChannel(1000))
        with running(tmp_path, config, caught) as service:
            wait_for(lambda: service.service.zenoh.state == "ok", "zenoh")
            made.replace(recording)
            wait_for(lambda: len(caught.thermals.get("oven", [])) >= 6 * HOURS - 1, "the day")
        looks, sent = caught.thermals["oven"], []

        def last_look() -> bool:
            sent.extend(json.loads(bytes(one.payload)) for one in iter(heard.try_recv, None))
            return bool(sent) and sent[-1]["t"] == looks[-1].t_ns / 1e9

        wait_for(last_look, "the last message over zenoh")
    assert looks[-1].axes["gz"].model.startswith("difference")
    before = [look.axes["gz"] for look in looks[24 : round(6 * AT_H)]]
    assert np.mean([one.one_step is not None and one.one_step.side_of_interval(one.bias) == 0 for one in before]) > 0.75
    told = [event for _, event in caught.events if event.kind == "temperature_unexplained"]
    assert [event.axis for event in told] == ["gz"]
    assert abs(told[0].values["bias"]["size"] / STEP - 1.0) < 0.2
    assert told[0].since_ns is not None
    assert abs(told[0].since_ns / 1e9 - T0 - AT_H * 3600.0) <= 600.0
    last = sent[-1]
    assert (last["schema"], last["device"], last["interval"]) == ("imu-monitor/thermal/1", "oven", 600.0)
    assert last["axes"]["gz"]["one_step"]["bias"] == looks[-1].axes["gz"].one_step.bias
