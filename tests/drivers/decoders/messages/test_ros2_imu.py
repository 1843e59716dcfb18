"""Tests of the decoder for ROS 2 Imu messages: byte orders, attachments, missing and rejected messages.

Two independent codecs agreed on the bytes of the golden message.
"""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import NO_TICK, Chunk, SenderTimedFormat, concatenate_blocks, make_block
from drivers.decoders.base import HINT_FRAMES, Decoder
from drivers.decoders.messages import ros2_imu

GOLDEN_HEAD = bytes.fromhex("0001000000F1536515CD5B0709000000696D755F6C696E6B00000000")
GYRO, ACCEL = (0.01, -0.02, 0.03), (0.1, 0.2, 9.81)
CAPTURED_ATTACHMENT = bytes.fromhex("0900000000000000DF8AB6F7E735D31810FE98E4A3B54B6E599C5934F4CFC25343")
"""Attachment recorded from rmw_zenoh 0.10.5."""


def make_doubles(gyro_covariance: float = 0.0, accel_covariance: float = 0.0) -> list[float]:
    orientation = [0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8]
    return [*orientation, *GYRO, gyro_covariance, *[0.0] * 8, *ACCEL, accel_covariance, *[0.0] * 8]


GOLDEN = GOLDEN_HEAD + struct.pack("<37d", *make_doubles())


def make_payload(frame_id: str = "imu_link", end: str = "<", **covariances: float) -> bytes:
    name = frame_id.encode() + b"\0"
    head = struct.pack(f"{end}iII", 1_700_000_000, 123_456_789, len(name)) + name
    head += b"\xcc" * (-len(head) % 8)  # the content of the padding is ignored
    body = struct.pack(f"{end}37d", *make_doubles(**covariances))
    return (b"\0\1" if end == "<" else b"\0\0") + b"\0\0" + head + body


def make_labelled_attachment(sequence: int, gid: bytes = bytes(16)) -> bytes:
    def encode_text(word: bytes) -> bytes:
        return bytes([len(word)]) + word

    numbers = struct.pack("<q", sequence), struct.pack("<q", 17)
    names = encode_text(b"sequence_number"), encode_text(b"source_timestamp"), encode_text(b"source_gid")
    return names[0] + numbers[0] + names[1] + numbers[1] + names[2] + b"\x10" + gid


def make_bare_attachment(sequence: int, gid: bytes = bytes(16)) -> bytes:
    return struct.pack("<qqB", sequence, 17, 16) + gid


@pytest.fixture
def decoder() -> Decoder:
    return ros2_imu.build(ros2_imu.Settings())


def test_golden_message_is_decoded(decoder: Decoder) -> None:
    assert len(GOLDEN) == 324
    [got] = decoder.feed([Chunk(GOLDEN, 5, attachment=CAPTURED_ATTACHMENT)])
    assert got.t_ns.tolist() == [1_700_000_000_123_456_789]
    assert got.values[0].tolist() == [*GYRO, *ACCEL]
    assert got.ticks.tolist() == [9]
    assert np.isnan(got.temperature_c).all()
    assert decoder.timing == SenderTimedFormat()
    assert make_payload().replace(b"\xcc", b"\0") == GOLDEN


@pytest.mark.parametrize("end", ["<", ">"])
@pytest.mark.parametrize("frame_id", ["", "imu", "imu_", "imu_link", "a/very/long/frame/name"])
def test_all_byte_orders_and_frame_names_are_decoded(decoder: Decoder, end: str, frame_id: str) -> None:
    data = make_payload(frame_id, end)
    assert len(data) == (316 if len(frame_id) <= 3 else len(data))
    got = concatenate_blocks(decoder.feed([Chunk(data, 0), Chunk(GOLDEN, 0), Chunk(data + bytes(3), 0)]))
    assert got.values.tolist() == [[*GYRO, *ACCEL]] * 3
    assert got.t_ns.tolist() == [1_700_000_000_123_456_789] * 3


def test_quantities_that_are_not_provided_become_nan(decoder: Decoder) -> None:
    no_gyro, no_accel = make_payload(gyro_covariance=-1.0), make_payload(accel_covariance=-1.0)
    got = concatenate_blocks(decoder.feed([Chunk(no_gyro, 0), Chunk(no_accel, 0)]))
    assert np.isnan(got.values).tolist() == [[True] * 3 + [False] * 3, [False] * 3 + [True] * 3]
    assert decoder.feed([Chunk(make_payload(gyro_covariance=-1.0, accel_covariance=-1.0), 0)]) == []
    assert decoder.bad == 1


@pytest.mark.parametrize("attachment", [make_labelled_attachment, make_bare_attachment])
def test_sequence_numbers_show_lost_messages(decoder: Decoder, attachment: object) -> None:
    assert (len(make_labelled_attachment(1)), len(make_bare_attachment(1))) == (77, 33)
    assert callable(attachment)
    chunks = [Chunk(GOLDEN, 0, attachment=attachment(i)) for i in (5, 6, 10, 11)]
    blocks = decoder.feed(chunks)
    assert [(len(b), b.lost, b.ticks.tolist()) for b in blocks] == [(2, 0, [5, 6]), (2, 3, [10, 11])]
    assert decoder.bad == 0
    [later] = decoder.feed([Chunk(GOLDEN, 0, attachment=attachment(13))])
    assert later.lost == 1


def test_rejected_message_counts_as_lost_once(decoder: Decoder) -> None:
    chunks = [Chunk(GOLDEN if i != 2 else b"x", 0, attachment=make_bare_attachment(i)) for i in range(5)]
    blocks = decoder.feed(chunks)
    assert [(len(b), b.lost) for b in blocks] == [(2, 0), (2, 1)]
    assert decoder.bad == 1
    assert "XCDR1" in decoder.recent_problem
    decoder.feed([Chunk(GOLDEN, 0)] * HINT_FRAMES)
    assert decoder.recent_problem == ""


def test_change_of_publisher_or_counter_is_no_loss(decoder: Decoder) -> None:
    numbers = [(5, b"a"), (900, b"b"), (901, b"b"), (1, b"b"), (2**62, b"b"), (-(2**63), b"b")]
    chunks = [Chunk(GOLDEN, 0, attachment=make_bare_attachment(i, gid * 16)) for i, gid in numbers]
    assert concatenate_blocks(decoder.feed(chunks)).lost == 0


def test_without_attachment_there_are_no_ticks(decoder: Decoder) -> None:
    [got] = decoder.feed([Chunk(GOLDEN, 0), Chunk(GOLDEN, 0, attachment=b"other")])
    assert got.ticks.tolist() == [NO_TICK, NO_TICK]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        GOLDEN[:-1],
        GOLDEN + bytes(4),
        b"\x00\x07" + GOLDEN[2:],  # XCDR2
        GOLDEN[:12] + b"\xff\xff\xff\xff" + GOLDEN[16:],  # frame_id without end
        GOLDEN[:8] + b"\xff\xff\xff\xff" + GOLDEN[12:],  # nanoseconds beyond a second
    ],
)
def test_payload_that_is_no_imu_message_is_bad(decoder: Decoder, data: bytes) -> None:
    assert decoder.feed([Chunk(data, 0)]) == []
    assert decoder.bad == 1
    assert decoder.recent_problem


def test_feeding_encoded_samples_returns_them(decoder: Decoder) -> None:
    values = np.random.default_rng(0).normal(size=(40, 6))
    values[7, :3] = np.nan
    sent = make_block(1_700_000_000_000_000_001 + np.arange(40) * 7, values, ticks=np.arange(3, 43))
    got = concatenate_blocks(decoder.feed(decoder.encode(sent)))
    np.testing.assert_array_equal(got.values, values)
    np.testing.assert_array_equal(got.t_ns, sent.t_ns)
    np.testing.assert_array_equal(got.ticks, sent.ticks)


@given(st.binary(max_size=400), st.binary(max_size=80))
def test_noise_raises_no_error(data: bytes, attachment: bytes) -> None:
    decoder = ros2_imu.build(ros2_imu.Settings())
    for body in (data, GOLDEN_HEAD + data, GOLDEN_HEAD + (data * 300)[:296]):
        for got in decoder.feed([Chunk(body, 0, attachment=attachment)]):
            assert len(got) == 1


@given(st.sampled_from([33, 77]), st.data())
def test_invalid_attachments_lose_no_message(size: int, data: st.DataObject) -> None:
    decoder = ros2_imu.build(ros2_imu.Settings())
    attachments = data.draw(st.lists(st.binary(min_size=size, max_size=size), min_size=2, max_size=4))
    blocks = decoder.feed([Chunk(GOLDEN, 0, attachment=a) for a in attachments])
    assert sum(len(b) for b in blocks) == len(attachments)
    assert decoder.bad == 0
