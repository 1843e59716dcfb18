"""Test that the service publishes the same drift-compensated rates as the command ``compensate``."""

from pathlib import Path

import numpy as np
import zenoh

from drivers.data_types import concatenate_blocks
from drivers.recordings import load_samples, save_samples
from drivers.zenoh.sample_message import DecodedSampleMessage, decode_samples
from monitor.commands.compensate import run_compensation
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_session, patient_file
from tests.system.rig import RecordingOutput, run_service

RATE_HZ, SECONDS, T0 = 100.0, 200.0, 1_763_705_400.0
SIGMA = 1e-3
CONFIG = """
[[device]]
name = "bench-1"
rate = 100.0
driver = {{ link = "replay", path = "{path}", speed = 100 }}

[viewer]
mode = "none"

[zenoh]
config = "{patient}"
mode = "client"
listen = []
connect = ["{endpoint}"]
"""


def test_live_compensation_equals_offline_compensation(tmp_path: Path) -> None:
    n = round(SECONDS * RATE_HZ)
    values = 0.02 + SIGMA * np.random.default_rng(5).standard_normal((n, 6))
    turning = slice(12_000, 13_000)
    truth = 0.3 * np.sin(np.arange(1000) / 30.0)
    values[turning, 1] += truth
    recording, complete = tmp_path / "a.npz", tmp_path / "complete.npz"
    recording.touch()  # the replay retries until the file is a recording
    save_samples(complete, T0 + np.arange(n) / RATE_HZ, values)
    endpoint, output = free_endpoint(), RecordingOutput()
    config = CONFIG.format(path=recording, endpoint=endpoint, patient=patient_file(tmp_path))
    with open_session(mode="router", listen=[endpoint]) as listener:
        subscriber = listener.declare_subscriber("imu/bench-1/compensated", zenoh.handlers.FifoChannel(10_000))
        with run_service(tmp_path, config, output) as run:
            wait_for(lambda: run.service.zenoh.state == "ok", "zenoh")
            complete.replace(recording)
            wait_for(lambda: sum(map(len, output.compensated_blocks.get("bench-1", []))) == n, "all samples")
        batches: list[DecodedSampleMessage] = []

        def last_batch_arrived() -> bool:
            batches.extend(decode_samples(bytes(message.payload)) for message in iter(subscriber.try_recv, None))
            return bool(batches) and batches[-1].total_samples == n

        wait_for(last_batch_arrived, "the last batch over zenoh")
    rates = concatenate_blocks(output.compensated_blocks["bench-1"])
    run_compensation(recording, tmp_path / "out.npz")
    offline = load_samples(tmp_path / "out.npz")
    np.testing.assert_allclose(rates.values, offline.values, rtol=0.0, atol=1e-12)
    assert np.sqrt(np.mean((rates.values[turning, 1] - truth) ** 2)) < 1.05 * SIGMA
    assert np.sqrt(np.mean(rates.values[14_000:, :3] ** 2)) < 0.3 * SIGMA
    last = batches[-1]
    assert (last.device, last.total_samples) == ("bench-1", n)
    np.testing.assert_array_equal(last.block.values, rates.values[-len(last.block) :])
    for k, drift in enumerate(output.drifts["bench-1"][:2], start=1):
        assert abs(drift.t_ns - round((T0 + k - 0.01) * 1e9)) < 1000
