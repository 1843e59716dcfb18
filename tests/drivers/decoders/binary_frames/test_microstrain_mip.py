"""Tests of the MIP decoder: recorded and documented packets, increments, overrange bits and layouts.

MANUAL is from the section "Data Overview" of the 3DM-CV7 manual. RECORDED is from the file test/data/mip_data.bin of
LORD-MicroStrain/mip_sdk. POLLED and its decoded values are from test/data/packet_example_cpp_check.txt of the same
repository. WITH_GPS_TIME is a packet in a public driver for ArduPilot.
"""

import struct

import numpy as np
import pytest

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, make_block
from drivers.decoders.base import MAX_FRAMES_WITHOUT_SAMPLE, fletcher_checksum
from drivers.decoders.binary_frames.microstrain_mip import Settings, build, encode_packet
from drivers.units import G0

MANUAL = bytes.fromhex("75 65 80 0E 0E 04 3E 7A 63 A0 BB 8E 3B 29 7F E5 BF 7F 84 EE")
RECORDED = bytes.fromhex(
    "75 65 80 30 0A D5 00 00 00 41 D8 BA E0 40 0A D6 00 00 00 00 00 7A 12 00"
    "0E 04 3C 8E AF 72 BB DA 68 18 BF 7C 52 E8 0E 05 BB 46 9C CF 39 A3 4C 8B BB 8B E1 2F D7 71"
)
POLLED = bytes.fromhex(
    "75 65 80 4C 0A D5 00 00 00 05 5E E6 7C C0 0A D6 00 00 00 01 4E 43 4A 00 0E 04 3D 9E E8 8D 38 7F DB 00 BF 7A AF 03"
    "0E 05 BB 0C 1E 30 BB 57 2E 68 BB AA 24 AE 0E 07 BC 8A AC 80 BC 72 C5 0E BC C4 E2 C1"
    "0E 08 3E EE 3D 9F BD 66 DA DD C0 AF DE F5 91 96"
)
WITH_GPS_TIME = bytes.fromhex(
    "75 65 80 2A 0E 04 3E 49 56 65 BB 24 12 C0 BF 7A A0 1D 0E 05 BB C7 35 1D BB 22 CE 02 3B 0E F6 1A"
    "0E 12 40 5C 1A B0 20 C4 9B A6 00 00 00 06 1D 37"
)
ALL_PACKETS = (MANUAL, RECORDED, POLLED, WITH_GPS_TIME)


def decode_one(packet: bytes, **settings: object) -> SampleBlock:
    (block,) = build(Settings(**settings)).feed([Chunk(packet, 77)])
    assert len(block) == 1
    return block


@pytest.mark.parametrize("packet", ALL_PACKETS, ids=["manual", "recorded", "polled", "with GPS time"])
def test_checksum_of_public_packets(packet: bytes) -> None:
    first = second = 0
    for byte in packet[:-2]:
        first = (first + byte) % 256
        second = (second + first) % 256
    assert packet[-2:] == bytes([first, second]) == fletcher_checksum(packet[:-2])


def test_recorded_packet_is_decoded() -> None:
    got = decode_one(RECORDED)
    gyro = np.array([-0.00303059, 0.00031147, -0.00426879])
    accel = np.array([0.01741764, -0.00666524, -0.98564005]) * G0
    np.testing.assert_allclose(got.values[0], [*gyro, *accel], atol=1e-7)
    assert got.ticks.tolist() == [0x00000041D8BAE040]
    assert np.isnan(got.temperature_c).all()
    assert build(Settings()).timing == CounterTimedFormat(1 << 62, 1e-9)


def test_values_of_the_polled_packet_are_those_of_the_sdk() -> None:
    got = decode_one(POLLED)
    np.testing.assert_allclose(got.values[0, :3], [-0.002138, -0.003283, -0.005192], atol=5e-7)
    np.testing.assert_allclose(got.values[0, 3:] / G0, [0.077592, 0.000061, -0.979233], atol=5e-7)
    assert got.ticks.tolist() == [23_067_000_000]


def test_increments_are_divided_by_the_delta_time() -> None:
    got = decode_one(POLLED, increments=True)
    assert int.from_bytes(POLLED[16:24], "big") == 5_608_000_000
    increments = np.array(struct.unpack(">3f", POLLED[54:66]) + struct.unpack(">3f", POLLED[68:80]))
    np.testing.assert_allclose(got.values[0], increments / 5.608 * np.repeat([1.0, G0], 3), rtol=1e-12)
    # the sensor was at rest, so the mean acceleration is close to the last one
    np.testing.assert_allclose(got.values[0, 3:], decode_one(POLLED).values[0, 3:], atol=0.011 * G0)


def test_packet_without_reference_time_is_timed_by_arrival() -> None:
    decoder = build(Settings())
    (block,) = decoder.feed([Chunk(WITH_GPS_TIME, 77)])
    np.testing.assert_allclose(block.values[0, :3], [-0.006079, -0.002484, 0.002181], atol=1e-6)
    np.testing.assert_allclose(block.values[0, 3:] / G0, [0.196619, -0.002503, -0.979006], atol=1e-6)
    assert (block.ticks.tolist(), block.t_ns.tolist()) == ([NO_TICK], [77])
    assert "0xD5" in decoder.recent_problem
    assert build(Settings(clock="arrival")).timing == ArrivalTimedFormat()
    assert decode_one(RECORDED, clock="arrival").ticks.tolist() == [NO_TICK]


def test_documented_acceleration_with_a_nan_is_bad() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(MANUAL, 0)]) == []
    assert decoder.bad == 1
    assert decoder.feed([Chunk(RECORDED, 0)])[0].lost == 1


def test_packets_of_other_sets_and_other_fields_make_no_samples() -> None:
    filter_data = encode_packet(0x82, RECORDED[4:-2])
    magnetic_field = encode_packet(0x80, bytes.fromhex("0E 06") + bytes(12))
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(RECORDED + filter_data + magnetic_field + encode_packet(0x80, b"") + RECORDED, 0)])
    assert [(len(block), block.lost) for block in blocks] == [(2, 0)]
    assert decoder.bad == 0


@pytest.mark.parametrize(("increments", "field"), [(False, "0x04"), (True, "0xD6")])
def test_missing_fields_are_reported(increments: bool, field: str) -> None:
    decoder = build(Settings(increments=increments))
    packet = WITH_GPS_TIME if increments else encode_packet(0x80, bytes.fromhex("0E 06") + bytes(12))
    for _ in range(MAX_FRAMES_WITHOUT_SAMPLE):
        assert decoder.feed([Chunk(packet, 0)]) == []
    assert decoder.recent_problem == ""
    decoder.feed([Chunk(packet, 0)])
    assert field in decoder.recent_problem
    decoder.feed([Chunk(POLLED, 0)])
    assert decoder.recent_problem == ""


@pytest.mark.parametrize(
    "payload",
    [RECORDED[4:-2] + b"\x05\x06\0", RECORDED[4:-2] + b"\0\0", RECORDED[4:-2] + b"\x01\x06", RECORDED[4:-2] + b"\x02"],
    ids=["too long", "length 0", "length 1", "incomplete"],
)
def test_packet_whose_field_lengths_do_not_match_is_bad(payload: bytes) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(encode_packet(0x80, payload), 0)]) == []
    assert decoder.bad == 1


@pytest.mark.parametrize(("bits", "bad"), [(0x0001, 1), (0x0040, 1), (0x0700, 0), (0x1000, 0)])
def test_overrange_of_inertial_sensors_makes_the_sample_bad(bits: int, bad: int) -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(encode_packet(0x80, RECORDED[4:-2] + b"\x04\x18" + bits.to_bytes(2, "big")), 0)])
    assert decoder.bad == bad


def test_overrange_without_samples_is_ignored() -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(encode_packet(0x80, b"\x04\x18\0\x01"), 0)])
    assert decoder.bad == 0


@pytest.mark.parametrize("duration_ns", [0, 1 << 63])
def test_increments_with_an_impossible_duration_are_bad(duration_ns: int) -> None:
    packet = encode_packet(0x80, POLLED[4:14] + b"\x0a\xd6" + duration_ns.to_bytes(8, "big") + POLLED[24:-2])
    decoder = build(Settings(increments=True))
    assert decoder.feed([Chunk(packet, 0)]) == []
    assert decoder.bad == 1


def test_missing_sensor_is_not_measured() -> None:
    values = np.full((2, 6), np.nan)
    values[:, 3:] = 1.0
    samples = make_block(np.arange(2), values, None, np.arange(2))
    (block,) = build(Settings()).feed(build(Settings()).encode(samples))
    np.testing.assert_allclose(block.values, values, rtol=1e-6)
