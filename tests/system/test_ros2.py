"""Test of the output to ROS 2: the decoder of this program and an independent codec read what the service publishes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from drivers.data_types import SampleBlock, concatenate_blocks
from drivers.decoders.messages import ros2_imu
from drivers.links import zenoh_link
from tests.support.ports import free_endpoint
from tests.support.ros2_messages import DIAGNOSTIC_ARRAY, decode
from tests.support.settings import read_settings
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_router, session_config
from tests.system.rig import run_service

SAMPLES = 300
TOKENS = "@ros2_lv/3/**"
DEVICE = """
[[device]]
name = "{}"
rate = 100.0
driver = {{ link = "virtual" }}
"""
CONFIG = """
[zenoh]
mode = "none"
[viewer]
mode = "none"
[ros2]
domain = 3
namespace = "/robot1"
connect = ["{endpoint}"]
imu = "{imu}"
"""


def open_session_of_rmw_zenoh(router: str) -> Any:
    """Open a peer with gossip that listens on a free port, as each ROS 2 program does (rmw_zenoh, docs/design.md)."""
    config = session_config("peer", listen=["tcp/127.0.0.1:0"], connect=[router])
    config.insert_json5("scouting/gossip/enabled", "true")
    return zenoh.open(config)


def list_topics(client: Any) -> set[str]:
    """Return the topics of all publishers, from their liveliness tokens."""
    tokens = [str(reply.ok.key_expr).split("/") for reply in client.liveliness().get(TOKENS)]
    return {token[9].replace("%", "/") for token in tokens if token[5] == "MP"}


@pytest.mark.parametrize("imu", ["raw", "compensated"])
def test_subscribers_receive_every_sample_and_the_diagnostics(tmp_path: Path, imu: str) -> None:
    endpoint = free_endpoint()
    key = f"3/robot1/bench_1/imu/data_{imu}/sensor_msgs::msg::dds_::Imu_/**"
    link = zenoh_link.build(read_settings(zenoh_link.Settings, {"key": key, "connect": [endpoint]}))
    decoder = ros2_imu.build(ros2_imu.Settings())
    received: list[SampleBlock] = []
    status: dict[str, str] = {}
    with open_router(endpoint), open_session_of_rmw_zenoh(endpoint) as client:
        diagnostics = client.declare_subscriber("3/diagnostics/**", zenoh.handlers.FifoChannel(100))
        link.open()
        try:
            with run_service(tmp_path, DEVICE.format("bench-1") + CONFIG.format(endpoint=endpoint, imu=imu)) as run:

                def receive() -> bool:
                    received.extend(decoder.feed(link.wait_for_chunks_or_timeout(0.1) or []))
                    for sample in iter(diagnostics.try_recv, None):
                        [one] = decode(bytes(sample.payload), DIAGNOSTIC_ARRAY).status
                        status.update({"name": one.name} | {pair.key: pair.value for pair in one.values})
                    return sum(map(len, received)) >= SAMPLES and "rate (Hz)" in status

                wait_for(receive)
                assert run.service.output_states()["ros2"] == "ok"
                assert list_topics(client) == {"/diagnostics", f"/robot1/bench_1/imu/data_{imu}"}
        finally:
            link.close()
    published = run.output.blocks if imu == "raw" else run.output.compensated_blocks
    sent, got = concatenate_blocks(published["bench-1"]).values, concatenate_blocks(received)
    assert decoder.bad == 0
    assert np.all(np.diff(got.t_ns) > 0)
    [first] = np.flatnonzero((sent == got.values[0]).all(axis=1))
    # zenoh may drop messages on a busy machine, which leaves gaps in the sequence numbers
    assert got.lost == got.ticks[-1] - got.ticks[0] + 1 - len(got)
    np.testing.assert_array_equal(got.values, sent[first + got.ticks - got.ticks[0]])
    assert (status["name"], status["state"]) == ("imu_monitor: bench-1", "running")
    assert float(status["rate (Hz)"]) == pytest.approx(100.0, rel=0.1)


def test_topics_follow_the_devices_of_a_reloaded_configuration(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    tables = CONFIG.format(endpoint=endpoint, imu="raw")
    topics = {name: f"/robot1/{name}/imu/data_raw" for name in ("a", "b")}
    with open_router(endpoint), open_session_of_rmw_zenoh(endpoint) as client:
        with run_service(tmp_path, DEVICE.format("a") + tables) as run:
            wait_for(lambda: list_topics(client) == {"/diagnostics", topics["a"]})
            (tmp_path / "config.toml").write_text(DEVICE.format("b") + tables)
            run.service.request_reload()
            wait_for(lambda: list_topics(client) == {"/diagnostics", topics["b"]})
        wait_for(lambda: list_topics(client) == set())
