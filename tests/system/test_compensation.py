"""A recording through the whole service: its rates come over zenoh without drift, as ``compensate`` makes them."""

from pathlib import Path

import numpy as np
import zenoh

from drivers.data_types import concatenate_blocks
from drivers.recordings import load_samples, save_samples
from drivers.zenoh.sample_message import DecodedSampleMessage, decode_samples
from monitor.commands.compensate import CompensationRequest, run_compensation
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import patient_file, session
from tests.system.rig import Caught, running

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


def test_rates_come_out_without_drift_live_as_offline(tmp_path: Path) -> None:
    n = round(SECONDS * RATE_HZ)
    values = 0.02 + SIGMA * np.random.default_rng(5).standard_normal((n, 6))
    turning = slice(12_000, 13_000)
    truth = 0.3 * np.sin(np.arange(1000) / 30.0)
    values[turning, 1] += truth
    recording, made = tmp_path / "a.npz", tmp_path / "made.npz"
    recording.touch()  # the replay tries until it is a recording
    save_samples(made, T0 + np.arange(n) / RATE_HZ, values)
    endpoint, caught = free_endpoint(), Caught()
    config = CONFIG.format(path=recording, endpoint=endpoint, patient=patient_file(tmp_path))
    with session(mode="router", listen=[endpoint]) as listener:
        heard = listener.declare_subscriber("imu/bench-1/compensated", zenoh.handlers.FifoChannel(10_000))
        with running(tmp_path, config, caught) as service:
            wait_for(lambda: service.service.zenoh.state == "ok", "zenoh")
            made.replace(recording)
            wait_for(lambda: sum(map(len, caught.rates.get("bench-1", []))) == n, "all samples")
        batches: list[DecodedSampleMessage] = []

        def last_batch() -> bool:
            batches.extend(decode_samples(bytes(one.payload)) for one in iter(heard.try_recv, None))
            return bool(batches) and batches[-1].total_samples == n

        wait_for(last_batch, "the last batch over zenoh")
    rates = concatenate_blocks(caught.rates["bench-1"])
    run_compensation(CompensationRequest(recording, tmp_path / "out.npz"))
    offline = load_samples(tmp_path / "out.npz")
    np.testing.assert_allclose(rates.values, offline.values, rtol=0.0, atol=1e-12)
    assert np.sqrt(np.mean((rates.values[turning, 1] - truth) ** 2)) < 1.05 * SIGMA
    assert np.sqrt(np.mean(rates.values[14_000:, :3] ** 2)) < 0.3 * SIGMA
    last = batches[-1]
    assert (last.device, last.total_samples) == ("bench-1", n)
    np.testing.assert_array_equal(last.block.values, rates.values[-len(last.block) :])
    for k, look in enumerate(caught.drifts["bench-1"][:2], start=1):
        assert abs(look.t_ns - round((T0 + k - 0.01) * 1e9)) < 1000
