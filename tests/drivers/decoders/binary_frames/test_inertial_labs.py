"""Tests of the Inertial Labs decoder with synthetic messages: layouts, scales, status bits and other messages."""

import struct

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, concatenate_blocks
from drivers.decoders.binary_frames.inertial_labs import Settings, build, encode_message
from drivers.units import DEGREE, G0

GYRO, ACCEL = (123_456, -100_000, 7), (-1_000_000, 500_000, 1_000_001)
EXPECTED = [*(1e-5 * DEGREE * x for x in GYRO), *(1e-6 * G0 * x for x in ACCEL)]


def encode_ga(counter: int = 65_535, status: int = 0) -> bytes:
    return encode_message(0x8F, struct.pack("<6iHHHh", *GYRO, *ACCEL, counter, status, 0, 253))


def decode(data: bytes, **settings: object) -> SampleBlock:
    return concatenate_blocks(build(Settings(**settings)).feed([Chunk(data, 77)]))


def test_length_and_checksum_of_a_message() -> None:
    # header, type 1, ID, 6 bytes more than the payload, payload, sum 0x01 + 0x8F + 0x08 + 0xFF + 0x10
    assert encode_message(0x8F, b"\xff\x10").hex() == "aa55018f0800ff10a701"


def test_ga_message() -> None:
    got = decode(encode_ga())
    np.testing.assert_allclose(got.values[0], EXPECTED, rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(25.3)
    assert got.ticks.tolist() == [65_535]
    assert build(Settings()).timing == CounterTimedFormat(1 << 16)


def test_calibrated_hr_message() -> None:
    payload = struct.pack("<9i3hHHHHh", 1, 2, 3, *GYRO, *ACCEL, 4, 5, 6, 1234, 0, 0, 0, -105)
    got = decode(encode_message(0x81, payload))
    np.testing.assert_allclose(got.values[0], EXPECTED, rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(-10.5)
    assert got.ticks.tolist() == [1234]


def test_both_messages_and_others_can_be_mixed() -> None:
    hr = encode_message(0x81, struct.pack("<9i3hHHHHh", 1, 2, 3, *GYRO, *ACCEL, 4, 5, 6, 8, 0, 0, 0, 0))
    other = encode_message(0x82, bytes(34))
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(encode_ga(4) + other + hr + encode_ga(12), 0)])
    assert [(block.ticks.tolist(), block.lost) for block in blocks] == [([4, 8, 12], 0)]
    assert decoder.bad == 0


@pytest.mark.parametrize("bit", [2, 3, 5, 10, 11, 12])
def test_error_bits_make_the_sample_bad(bit: int) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(encode_ga(status=1 << bit | 1), 0)]) == []
    assert decoder.recent_problem == f"the sensor reports an error: status 0x{1 << bit:04X}"
    assert decoder.feed([Chunk(encode_ga(), 0)])[0].lost == 1
    assert decoder.recent_problem == ""


def test_other_status_bits_are_accepted() -> None:
    assert len(decode(encode_ga(status=0xE3D3))) == 1


def test_arrival_clock_ignores_the_counter() -> None:
    assert decode(encode_ga(), clock="arrival").ticks.tolist() == [-1]
    assert isinstance(build(Settings(clock="arrival")).timing, ArrivalTimedFormat)
