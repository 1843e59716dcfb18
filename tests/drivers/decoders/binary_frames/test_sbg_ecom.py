"""Tests of the sbgECom decoder: layouts, scales, CRC, status bits and other messages.

No frame of a device is public. The frames are synthetic: they follow the tables of the manual. The CRC is compared with
its published check value.
"""

import struct

import numpy as np
import pytest

from drivers.data_types import Chunk, CounterTimedFormat, SampleBlock, make_block
from drivers.decoders.base import MAX_FRAMES_WITHOUT_SAMPLE
from drivers.decoders.binary_frames.sbg_ecom import Settings, build, encode_frame, frame_crc

VALID = 0x3FF
HIGH_RANGE = 0x400


def imu_short(status: int = VALID, gyro: tuple[int, int, int] = (67108864, -33554432, 671089)) -> bytes:
    data = struct.pack("<IH6ih", 4_000_000_000, status, 1048576, 0, -10276045, *gyro, 256 * 25 + 64)
    return encode_frame(b"\x2c\x00" + len(data).to_bytes(2, "little") + data)


def imu_data(status: int = VALID, z_rate: float = 0.5) -> bytes:
    numbers = (0.25, 0.0, -9.75, 0.125, -0.25, z_rate)
    data = struct.pack("<IH13f", 5_000_000, status, *numbers, 31.5, *numbers)
    return encode_frame(b"\x03\x00" + len(data).to_bytes(2, "little") + data)


def decode_one(frame: bytes, **settings: object) -> SampleBlock:
    (block,) = build(Settings(**settings)).feed([Chunk(frame, 77)])
    assert len(block) == 1
    return block


def test_crc_is_crc_16_kermit() -> None:
    assert frame_crc(b"123456789") == (0x2189).to_bytes(2, "little")


def test_short_message_has_the_documented_size_and_scales() -> None:
    frame = imu_short()
    assert len(frame) == 6 + 32 + 3
    assert (frame[:6], frame[-1]) == (bytes.fromhex("FF 5A 2C 00 20 00"), 0x33)
    got = decode_one(frame)
    np.testing.assert_allclose(got.values[0], [1.0, -0.5, 671089 / 2**26, 1.0, 0.0, -10276045 / 2**20], rtol=1e-15)
    assert got.temperature_c.tolist() == [25.25]
    assert got.ticks.tolist() == [4_000_000_000]
    assert build(Settings()).timing == CounterTimedFormat(1 << 32, 1e-6)


def test_status_bit_selects_the_scale_of_high_rates() -> None:
    got = decode_one(imu_short(VALID | HIGH_RANGE, (12304174 * 40, -12304174, 6152087)))
    np.testing.assert_allclose(got.values[0, :3], [40.0, -1.0, 0.5], rtol=1e-15)


def test_message_with_floats_is_decoded() -> None:
    frame = imu_data()
    assert len(frame) == 6 + 58 + 3
    got = decode_one(frame, message="imu_data")
    assert got.values.tolist() == [[0.125, -0.25, 0.5, 0.25, 0.0, -9.75]]
    assert (got.temperature_c.tolist(), got.ticks.tolist()) == ([31.5], [5_000_000])


@pytest.mark.parametrize("bit", range(10))
def test_status_bit_that_is_not_set_makes_the_sample_bad(bit: int) -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(imu_short() + imu_short(VALID & ~(1 << bit)), 0)])
    assert [(len(block), block.lost) for block in blocks] == [(1, 0)]
    assert decoder.bad == 1
    assert f"0x{1 << bit:03X}" in decoder.recent_problem
    assert decoder.feed([Chunk(imu_short(), 0)])[0].lost == 1
    assert decoder.recent_problem == ""


def test_other_messages_are_ignored() -> None:
    euler = encode_frame(b"\x06\x00\x28\x00" + bytes(40))
    answer = encode_frame(b"\x00\x10\x00\x00")
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(imu_short() + euler + imu_data() + answer + imu_short(), 0)])
    assert [(len(block), block.lost) for block in blocks] == [(2, 0)]
    assert decoder.bad == 0


@pytest.mark.parametrize(
    "content",
    [b"\x2c\x00\x21\x00" + bytes(33), b"\x06\x80\x28\x00" + bytes(40), b"\x06\x00\xf7\x0f" + bytes(4087)],
    ids=["length of imu_short", "large frame", "too long"],
)
def test_frames_with_an_impossible_header_are_rejected(content: bytes) -> None:
    decoder = build(Settings())
    (block,) = decoder.feed([Chunk(encode_frame(content) + imu_short() * 3, 0)])
    assert len(block) == 3
    (block,) = decoder.feed([Chunk(encode_frame(content) + imu_short(), 0)])
    assert block.lost >= 1


def test_longest_frame_is_accepted() -> None:
    decoder = build(Settings())
    frames = imu_short() + encode_frame(b"\x1f\x00\xf6\x0f" + bytes(4086)) + imu_short()
    blocks = decoder.feed([Chunk(frames[:3000], 0), Chunk(frames[3000:], 1)])
    assert [(len(block), block.lost) for block in blocks] == [(2, 0)]


def test_missing_message_is_reported() -> None:
    decoder = build(Settings())
    for _ in range(MAX_FRAMES_WITHOUT_SAMPLE):
        assert decoder.feed([Chunk(imu_data(), 0)]) == []
    assert decoder.recent_problem == ""
    decoder.feed([Chunk(imu_data(), 0)])
    assert "none with imu_short" in decoder.recent_problem
    decoder.feed([Chunk(imu_short(), 0)])
    assert decoder.recent_problem == ""


def test_number_that_is_not_finite_is_bad() -> None:
    decoder = build(Settings(message="imu_data"))
    assert decoder.feed([Chunk(imu_data(z_rate=float("nan")), 0)]) == []
    assert decoder.bad == 1


def test_encoder_changes_the_scale_of_high_rates() -> None:
    values = np.array([[35.0, -1.0, 2.0, 0.0, 0.0, 9.8], [31.9, -1.0, 2.0, 0.0, 0.0, 9.8]])
    frames = build(Settings()).encode(make_block(np.arange(2), values, None, np.arange(2)))
    assert [int.from_bytes(frame.data[10:12], "little") for frame in frames] == [VALID | HIGH_RANGE, VALID]
    (block,) = build(Settings()).feed(frames)
    np.testing.assert_allclose(block.values, values, atol=1e-6)


@pytest.mark.parametrize(("axis", "bit"), [(0, 5), (2, 7), (3, 2), (5, 4)])
def test_missing_axis_is_encoded_as_a_failed_self_test(axis: int, bit: int) -> None:
    values = np.zeros((1, 6))
    values[0, axis] = np.nan
    (frame,) = build(Settings()).encode(make_block(np.arange(1), values, None, np.arange(1)))
    assert int.from_bytes(frame.data[10:12], "little") == VALID & ~(1 << bit)
