"""Decoding of many ROS messages at once, compared with rosbags."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from drivers.recordings import memory_check
from drivers.recordings.file_formats import ros_bag_format
from drivers.recordings.file_formats.ros_message_arrays import (
    BLOCK_BYTES,
    IMU_TYPE,
    TEMPERATURE_TYPE,
    decode_messages,
    encode_messages,
    iter_message_blocks,
)
from drivers.recordings.topic_selection import RecordedTopic
from tests.support import ros2_messages
from tests.support.ros_bags import imu_topic, temperature_topic

T_NS = 1_763_700_000_123_456_789 + np.arange(6) * 5_000_001


def serialize(frame_ids: list[str], cdr: bool = True, little: bool = True) -> tuple[list[bytes], np.ndarray]:
    """Return messages of an IMU with the given frame_ids, and their values."""
    values = np.random.default_rng(2).normal(size=(len(frame_ids), 6))
    store = get_typestore(Stores.ROS2_HUMBLE if cdr else Stores.ROS1_NOETIC)
    _, _, make = imu_topic(T_NS, values)
    messages = []
    for i, frame_id in enumerate(frame_ids):
        message = make(store.types, i)
        message.header.frame_id = frame_id
        if cdr:
            messages.append(bytes(store.serialize_cdr(message, IMU_TYPE, little_endian=little)))
        else:
            messages.append(bytes(store.serialize_ros1(message, IMU_TYPE)))
    return messages, values


@pytest.mark.parametrize(("cdr", "little"), [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("length", range(10))
def test_every_alignment_of_the_text(cdr: bool, little: bool, length: int) -> None:
    messages, values = serialize(["x" * length] * 6, cdr, little)
    stamps_ns, numbers = decode_messages(messages, IMU_TYPE, cdr)
    assert stamps_ns.tolist() == T_NS.tolist()
    assert numbers.tobytes() == values.tobytes()


@pytest.mark.parametrize("cdr", [True, False])
def test_texts_that_change_within_a_topic(cdr: bool) -> None:
    """With CDR, the messages have the same size, because the padding replaces missing characters."""
    messages, values = serialize(["a", "bcd", "ab", "", "a", "abc"], cdr)
    assert (len({len(one) for one in messages}) == 1) == cdr
    blocks = list(iter_message_blocks((None, i, one) for i, one in enumerate(messages)))
    decoded = [decode_messages(block, IMU_TYPE, cdr) for _, block in blocks]
    assert np.concatenate([stamps_ns for stamps_ns, _ in decoded]).tolist() == T_NS.tolist()
    assert np.concatenate([numbers for _, numbers in decoded]).tobytes() == values.tobytes()
    assert [t for times, _ in blocks for t in times] == list(range(6))


def test_a_temperature() -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    _, _, make = temperature_topic(T_NS, np.arange(6.0))
    messages = [bytes(store.serialize_cdr(make(store.types, i), TEMPERATURE_TYPE)) for i in range(6)]
    stamps_ns, numbers = decode_messages(messages, TEMPERATURE_TYPE, cdr=True)
    assert stamps_ns.tolist() == T_NS.tolist()
    assert numbers.tolist() == [[float(i)] for i in range(6)]


def test_rosbags_decodes_the_encoded_messages() -> None:
    (template, *_), _ = serialize(["imu"])
    values = np.random.default_rng(3).normal(size=(3, 6))
    values[1, :3], values[2, 4] = np.nan, np.nan  # no angular rates; one missing acceleration
    stamps = np.array([[1_763_700_000, 123_456_789], [1_763_700_001, 0], [0, 999_999_999]])
    found = [ros2_messages.decode(one, IMU_TYPE) for one in encode_messages(template, IMU_TYPE, stamps, values)]
    assert [[one.header.stamp.sec, one.header.stamp.nanosec] for one in found] == stamps.tolist()
    for kind, axes in (("angular_velocity", values[:, :3]), ("linear_acceleration", values[:, 3:])):
        vectors = [getattr(one, kind) for one in found]
        np.testing.assert_array_equal([[one.x, one.y, one.z] for one in vectors], axes)
    assert [one.angular_velocity_covariance[0] for one in found] == [0.0, -1.0, 0.0]
    assert [one.linear_acceleration_covariance[0] for one in found] == [0.0, 0.0, 0.0]
    assert {one.header.frame_id for one in found} == {"imu"}


def test_a_message_that_is_too_short() -> None:
    (message,), _ = serialize(["imu"])
    for length in (0, 3, 15, 19, len(message) - 1):
        with pytest.raises(ValueError, match=rf"a message of {IMU_TYPE} has {length} bytes, expected"):
            decode_messages([message[:length]], IMU_TYPE, cdr=True)


def test_blocks_are_bounded() -> None:
    blocks = [block for _, block in iter_message_blocks((None, 0, bytes(300)) for _ in range(10_000))]
    assert sum(map(len, blocks)) == 10_000
    assert max(map(len, blocks)) * 300 <= BLOCK_BYTES + 300
    large = bytes(BLOCK_BYTES + 1)
    assert [len(block) for _, block in iter_message_blocks((None, 0, large) for _ in range(3))] == [1, 1, 1]


@pytest.mark.parametrize("stated", [0, 2, 6, 9])
def test_the_index_states_another_number_of_messages(stated: int, tmp_path: object) -> None:
    messages, values = serialize(["a", "bcd", "imu_link_1", "imu_link_1", "x", "y"])
    connection = type("Connection", (), {"topic": "/imu", "msgtype": IMU_TYPE})
    topic = RecordedTopic("/imu", IMU_TYPE, ("gx",), stated)
    bag = ros_bag_format._Bag([connection], [topic], lambda _: ((None, 0, one) for one in messages), cdr=True)
    limit = memory_check.RecordingSizeLimits(tmp_path, 1_000_000, None)  # type: ignore[arg-type]
    columns = ros_bag_format._read_topic(bag, "/imu", limit, [])
    assert columns["t_ns"].tolist() == T_NS.tolist()
    assert np.column_stack([columns[axis] for axis in ("gx", "gy", "gz", "ax", "ay", "az")]).tolist() == values.tolist()
