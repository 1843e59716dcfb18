"""Tests of the output to ROS 2: topics, messages and reload, through a router on loopback and an independent codec."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import zenoh

from drivers.data_types import AXES, Event, make_block
from monitor.daemon.outputs.ros2_output import Ros2Output, white_noise_variances
from monitor.drift.compensation.live_compensation import LiveDriftCompensation
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.publishing.ros2.rmw_zenoh_names import DIAGNOSTICS, RosTopic, imu_topic
from monitor.settings.loading import Device, Ros2Table
from tests.monitor.publishing.example_results import make_estimate, make_health
from tests.support.ports import free_endpoint
from tests.support.ros2_messages import DIAGNOSTIC_ARRAY, IMU, decode, stamp_ns
from tests.support.settings import read_settings
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_router, open_session

Kind = Literal["raw", "compensated"]
STAMP_NS = 1_700_000_000_123_456_789
ESTIMATE = make_estimate()
VALUES = np.arange(1.0, 7.0)
BLOCK = make_block(np.array([5]), VALUES[None])
COMPENSATED = make_block(np.array([5]), VALUES[None] - 1.0)


def make_device(name: str, frame_id: str) -> Device:
    table = {"name": name, "frame_id": frame_id, "driver": {"link": "virtual"}}
    device: Device = read_settings(Device, table)
    return device


@contextmanager
def start_output(imu: str, *devices: Device) -> Iterator[tuple[Ros2Output, Any]]:
    """Yield a connected output and a client."""
    endpoint = free_endpoint()
    settings = read_settings(Ros2Table, {"domain": 0, "connect": [endpoint], "imu": imu})
    output = Ros2Output(settings, devices)
    with open_router(endpoint), open_session(connect=[endpoint]) as client:
        output.start()
        try:
            wait_for(lambda: output.state == "ok")
            yield output, client
        finally:
            output.close()


def publish_all(output: Ros2Output, device: str) -> None:
    output.publish_samples(device, 1, BLOCK, STAMP_NS - 5)
    output.publish_drift_compensated_samples(device, 1, COMPENSATED, STAMP_NS - 5)
    output.publish_diagnostics()


def receive_by_topic(output: Ros2Output, client: Any, count: int, *devices: str) -> dict[str, bytes]:
    """Publish until ``count`` topics have been received, and return the newest message of each topic."""
    subscriber = client.declare_subscriber("**", zenoh.handlers.FifoChannel(1000))
    got: dict[str, bytes] = {}

    def publish_and_receive() -> bool:
        for device in devices:
            publish_all(output, device)
        for one in iter(subscriber.try_recv, None):
            got[str(one.key_expr)] = bytes(one.payload)
        return len(got) >= count

    wait_for(publish_and_receive)
    return got


@pytest.mark.parametrize(("imu", "expected"), [("raw", VALUES), ("compensated", VALUES - 1.0)])
def test_samples_have_the_frame_time_values_and_variances_of_their_device(imu: Kind, expected: np.ndarray) -> None:
    devices = make_device("front-1", "front_link"), make_device("rear", "imu_link")
    with start_output(imu, *devices) as (output, client):
        output.publish_result("rear", 1.0, 1, ESTIMATE)
        got = receive_by_topic(output, client, 3, "front-1", "rear")
    names = {
        imu_topic("/", "front-1", imu).zenoh_key(0),
        imu_topic("/", "rear", imu).zenoh_key(0),
        DIAGNOSTICS.zenoh_key(0),
    }
    assert set(got) == names
    front, rear = (decode(got[imu_topic("/", one.name, imu).zenoh_key(0)], IMU) for one in devices)
    assert (front.header.frame_id, rear.header.frame_id) == ("front_link", "imu_link")
    assert stamp_ns(front) == stamp_ns(rear) == STAMP_NS
    vectors = front.angular_velocity, front.linear_acceleration
    assert [getattr(vector, axis) for vector in vectors for axis in "xyz"] == expected.tolist()
    assert not front.angular_velocity_covariance.any()
    variances = white_noise_variances(ESTIMATE)
    if imu == "compensated":
        variances[:3] = 0.0
    assert rear.angular_velocity_covariance.tolist() == np.diag(variances[:3]).ravel().tolist()
    assert rear.linear_acceleration_covariance.tolist() == np.diag(variances[3:]).ravel().tolist()


def test_covariance_belongs_to_the_samples_that_are_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    n = ESTIMATE.coefficients.value[SYMBOLS.index("N")]
    noise = np.random.default_rng(2).normal(size=(12_000, 6)) * n * np.sqrt(ESTIMATE.rate_hz)
    compensation = LiveDriftCompensation(ESTIMATE.rate_hz)
    sent: dict[str, list[Any]] = {}
    tables: list[dict[str, Any]] = [{"domain": 0}, {"domain": 0, "imu": "compensated"}]
    outputs = [Ros2Output(read_settings(Ros2Table, table), [make_device("a", "imu_link")]) for table in tables]

    def decode_messages(topic: RosTopic, count: int, encode: Callable[[], Sequence[bytes]]) -> None:
        sent.setdefault(topic.name, []).extend(decode(message, IMU) for message in encode())

    for output in outputs:
        monkeypatch.setattr(output._publisher, "publish", decode_messages)
        output.publish_result("a", 1.0, 1, ESTIMATE)
    for start in range(0, len(noise), 100):
        t_ns = np.arange(start, start + 100) * round(1e9 / ESTIMATE.rate_hz)
        block = make_block(t_ns, noise[start : start + 100])
        compensated = compensation.compensate_block(block)
        for output in outputs:
            output.publish_samples("a", start + 100, block, STAMP_NS)
            output.publish_drift_compensated_samples("a", start + 100, compensated, STAMP_NS)
    assert set(sent) == {"/a/imu/data_raw", "/a/imu/data_compensated"}
    for name, messages in sent.items():
        for quantity in ("angular_velocity", "linear_acceleration"):
            vectors = [getattr(one, quantity) for one in messages[len(messages) // 2 :]]
            variances = np.var([[one.x, one.y, one.z] for one in vectors], axis=0)
            stated = getattr(messages[-1], f"{quantity}_covariance").reshape(3, 3)
            if (name, quantity) == ("/a/imu/data_compensated", "angular_velocity"):
                assert (variances < 0.1 * white_noise_variances(ESTIMATE)[:3]).all()
                assert not stated.any()
            else:
                np.testing.assert_allclose(np.diag(stated), variances, rtol=0.1)


def test_diagnostics_have_one_status_per_device() -> None:
    with start_output("none", make_device("a", "imu_link"), make_device("b", "imu_link")) as (output, client):
        output.publish_health("a", None, make_health(received=17))
        output.publish_health("b", None, make_health(state="lost", text="unplugged"))
        output.publish_result("a", 1.0, 1, ESTIMATE)
        output.publish_event("b", 90.0, 1, Event("link_lost", 0, "unplugged"))
        got = receive_by_topic(output, client, 1, "a", "b")
        assert set(got) == {DIAGNOSTICS.zenoh_key(0)}
        first, second = decode(got[DIAGNOSTICS.zenoh_key(0)], DIAGNOSTIC_ARRAY).status
        output.remove_device("a")
        assert output._publisher._topics == {DIAGNOSTICS}
    assert (first.name, first.level, first.message) == ("imu_monitor: a", 0, "running")
    assert (second.name, second.level, second.message) == ("imu_monitor: b", 2, "unplugged")
    values = [{pair.key: pair.value for pair in one.values} for one in (first, second)]
    assert values[0]["received (samples)"] == "17"
    assert "N gx (rad/s/√Hz)" in values[0]
    assert "last event" not in values[0]
    assert values[1]["last event"] == "link_lost: unplugged"


def test_added_device_has_a_topic_until_it_is_removed() -> None:
    with start_output("raw") as (output, client):
        output.add_device(make_device("a", "imu_link"))
        assert imu_topic("/", "a", "raw").zenoh_key(0) in receive_by_topic(output, client, 2, "a")
        output.remove_device("a")
        assert output._publisher._topics == {DIAGNOSTICS}


def test_variance_of_simulated_white_noise() -> None:
    n = ESTIMATE.coefficients.value[SYMBOLS.index("N")]
    noise = np.random.default_rng(1).normal(size=(100_000, 6)) * n * np.sqrt(ESTIMATE.rate_hz)
    # Averages over tau have the Allan variance N²/tau, which defines N.
    tau_s = 100 / ESTIMATE.rate_hz
    means = noise.reshape(-1, 100, 6).mean(axis=1)
    np.testing.assert_allclose(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0), n**2 / tau_s, rtol=0.2)
    np.testing.assert_allclose(white_noise_variances(ESTIMATE), noise.var(axis=0), rtol=0.05)


@pytest.mark.parametrize("axis", AXES)
def test_variances_of_a_sensor_are_unknown_if_one_axis_is(axis: str) -> None:
    value = ESTIMATE.coefficients.value.copy()
    value[SYMBOLS.index("N"), AXES.index(axis)] = np.nan
    found = white_noise_variances(replace(ESTIMATE, coefficients=replace(ESTIMATE.coefficients, value=value)))
    known = np.repeat([axis.startswith("a"), axis.startswith("g")], 3)
    assert ((found > 0.0) == known).all()
