"""Tests of the Aceinna decoder: published commands that fix the CRC, scales, units, clocks and error bits."""

import struct

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, concatenate_blocks
from drivers.decoders.binary_frames.aceinna_dmu import Settings, build, encode_packet
from drivers.units import DEGREE, G0

S1 = struct.pack(">10hHH", -3277, 0, 3277, 52, -104, 0, 8192, 8000, 8384, 9000, 65535, 0)
"""Synthetic payload: (-1.00006, 0, 1.00006) g, (0.99976, -1.99951, 0) °/s, 25 °C on average, packet 65535."""


def decode(data: bytes, **settings: object) -> SampleBlock:
    return concatenate_blocks(build(Settings(**settings)).feed([Chunk(data, 77)]))


@pytest.mark.parametrize(
    ("code", "payload", "published"),
    [
        # DMU380SA manual 7430-0026, section 6.3: the ping command
        (b"PK", "", "5555504B009EF4"),
        # commands in the unit tests of the public OpenIMU driver tidewise/drivers-imu_aceinna_openimu
        (b"pG", "", "55557047005D5F"),
        (b"gV", "", "5555675600ABEE"),
        (b"gP", "02000000", "555567500402000000A6D6"),
        (b"uP", "020000006162636465666768", "555575500C020000006162636465666768459F"),
    ],
)
def test_packets_equal_published_commands(code: bytes, payload: str, published: str) -> None:
    assert encode_packet(code, bytes.fromhex(payload)).hex().upper() == published
    decoder = build(Settings())
    assert decoder.feed([Chunk(bytes.fromhex(published) + encode_packet(b"S1", S1), 0)])[0].lost == 0
    assert decoder.bad == 0


def test_scaled_sensor_packet_1() -> None:
    got = decode(encode_packet(b"S1", S1))
    np.testing.assert_allclose(got.values[0, :3] / DEGREE, [52 * 1260 / 65536, -104 * 1260 / 65536, 0.0], rtol=1e-14)
    np.testing.assert_allclose(got.values[0, 3:] / G0, [-3277 * 20 / 65536, 0.0, 3277 * 20 / 65536], rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(8192 * 200 / 65536)
    assert got.ticks.tolist() == [65535]
    assert build(Settings()).timing == CounterTimedFormat(65536, None)


def test_scaled_sensor_packet_0_has_a_clock_in_milliseconds() -> None:
    payload = S1[:12] + bytes(6) + S1[12:20] + struct.pack(">HH", 1234, 0)
    got = decode(encode_packet(b"S0", payload), packet="S0")
    np.testing.assert_array_equal(got.values, decode(encode_packet(b"S1", S1)).values)
    assert got.temperature_c[0] == pytest.approx(25.0)
    assert got.ticks.tolist() == [1234]
    assert build(Settings(packet="S0")).timing == CounterTimedFormat(65536, 1e-3)


@pytest.mark.parametrize(("unit", "factor"), [("m/s^2", 1.0), ("g", G0)])
def test_openimu_packets(unit: str, factor: float) -> None:
    triples = struct.pack("<9f", 0.5, -0.25, 8.0, 1.0, -2.0, 0.125, 0.2, 0.3, 0.4)
    expected = [DEGREE, -2 * DEGREE, 0.125 * DEGREE, 0.5 * factor, -0.25 * factor, 8.0 * factor]
    got = decode(encode_packet(b"z1", struct.pack("<I", 1_000_005) + triples), packet="z1", accel_unit=unit)
    np.testing.assert_allclose(got.values[0], expected, rtol=1e-14)
    assert np.isnan(got.temperature_c[0])
    assert got.ticks.tolist() == [1_000_005]
    long = struct.pack("<Id", 1_000_005, 1000.005) + triples + struct.pack("<f", 31.5)
    got = decode(encode_packet(b"s1", long), packet="s1", accel_unit=unit)
    np.testing.assert_allclose(got.values[0], expected, rtol=1e-14)
    assert got.temperature_c[0] == 31.5
    assert build(Settings(packet="s1")).timing == CounterTimedFormat(1 << 32, 1e-3)


@pytest.mark.parametrize("bit", [0x0001, 0x1000])
def test_error_bits_make_the_sample_bad(bit: int) -> None:
    decoder = build(Settings())
    good = encode_packet(b"S1", S1)
    blocks = decoder.feed([Chunk(good + encode_packet(b"S1", S1[:-2] + bit.to_bytes(2, "big")), 0)])
    assert [len(block) for block in blocks] == [1]
    assert decoder.bad == 1
    assert "BIT" in decoder.recent_problem
    assert decoder.feed([Chunk(good, 0)])[0].lost == 1
    assert decoder.recent_problem == ""


def test_alert_bits_are_accepted() -> None:
    assert len(decode(encode_packet(b"S1", S1[:-2] + b"\x0f\xfe"))) == 1


def test_not_a_number_makes_the_sample_bad() -> None:
    decoder = build(Settings(packet="z1"))
    assert decoder.feed([Chunk(encode_packet(b"z1", bytes(4) + b"\0\0\xc0\x7f" + bytes(32)), 0)]) == []
    assert decoder.bad == 1


def test_message_names_the_type_that_arrives() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(encode_packet(b"z1", bytes(40)), 0)]) == []
    assert decoder.recent_problem == 'packets of type z1 arrive, not S1: set packet = "z1"'
    assert len(decoder.feed([Chunk(encode_packet(b"S1", S1), 0)])) == 1
    assert decoder.recent_problem == ""
    assert decoder.bad == 0


def test_arrival_clock_ignores_the_counter() -> None:
    assert decode(encode_packet(b"S1", S1), clock="arrival").ticks.tolist() == [-1]
    assert isinstance(build(Settings(clock="arrival")).timing, ArrivalTimedFormat)
