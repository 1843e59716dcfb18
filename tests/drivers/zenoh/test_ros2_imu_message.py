"""Tests of the encoding of ROS 2 Imu messages and their attachments, with an independent codec."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.zenoh.rmw_attachment import encode_attachment
from drivers.zenoh.ros2_imu_message import encode_imu_messages
from tests.drivers.decoders.messages.test_ros2_imu import ACCEL, CAPTURED_ATTACHMENT, GOLDEN, GYRO
from tests.support.ros2_messages import IMU, decode, stamp_ns

STAMP_NS = 1_700_000_000_123_456_789
VARIANCES = np.array([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
SECOND_NS = 1_000_000_000


def vector(message: object) -> list[float]:
    return [getattr(message, axis) for axis in "xyz"]


def diagonal(variances: np.ndarray) -> list[float]:
    return np.diag(variances).ravel().tolist()


def test_golden_message_is_encoded() -> None:
    [payload] = encode_imu_messages(np.array([STAMP_NS]), np.array([[*GYRO, *ACCEL]]))
    assert payload == GOLDEN


def test_attachment_equals_a_captured_attachment() -> None:
    t_ns = int.from_bytes(CAPTURED_ATTACHMENT[8:16], "little")
    assert encode_attachment(9, t_ns, CAPTURED_ATTACHMENT[-16:]) == CAPTURED_ATTACHMENT


@given(
    st.lists(st.integers(-(2**31) * SECOND_NS, 2**31 * SECOND_NS - 1), min_size=1, max_size=5),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40),
    st.integers(0, 1000),
)
def test_every_field_of_every_message_is_decoded(times_ns: list[int], frame_id: str, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=(len(times_ns), 6))
    payloads = encode_imu_messages(np.array(times_ns), values, frame_id, VARIANCES)
    assert len(payloads) == len(times_ns)
    for t_ns, row, payload in zip(times_ns, values, payloads, strict=True):
        message = decode(payload, IMU)
        assert stamp_ns(message) == t_ns
        assert message.header.frame_id == frame_id
        assert [*vector(message.angular_velocity), *vector(message.linear_acceleration)] == row.tolist()
        assert message.angular_velocity_covariance.tolist() == diagonal(VARIANCES[:3])
        assert message.linear_acceleration_covariance.tolist() == diagonal(VARIANCES[3:])
        assert [*vector(message.orientation), message.orientation.w] == [0.0, 0.0, 0.0, 1.0]
        assert message.orientation_covariance.tolist() == [-1.0, *[0.0] * 8]


def test_missing_sensor_is_not_provided() -> None:
    values = np.array([[*GYRO, *[np.nan] * 3], [*[np.nan] * 3, *ACCEL]])
    first, second = (decode(one, IMU) for one in encode_imu_messages(np.array([1, 2]), values, "f", VARIANCES))
    assert first.angular_velocity_covariance.tolist() == diagonal(VARIANCES[:3])
    assert first.linear_acceleration_covariance.tolist() == [-1.0, *[0.0] * 8]
    assert vector(first.linear_acceleration) == [0.0] * 3
    assert second.angular_velocity_covariance.tolist() == [-1.0, *[0.0] * 8]
    assert vector(second.linear_acceleration) == list(ACCEL)


@pytest.mark.parametrize("seconds", [-(2**31) - 1, 2**31])
def test_time_beyond_32_bits_is_refused(seconds: int) -> None:
    with pytest.raises(ValueError, match="2038"):
        encode_imu_messages(np.array([STAMP_NS, seconds * SECOND_NS]), np.zeros((2, 6)))
