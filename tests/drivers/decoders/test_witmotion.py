"""WitMotion: both packets of a sample, what a hole swallowed, and the packet without a checksum."""

import math

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, SampleBlock, concatenate_blocks, make_block
from drivers.decoders.witmotion import Settings, build, encode_packet
from drivers.errors import ConfigError
from tests.support.settings import read_settings

DEGREE, G = math.pi / 180.0, 9.80665
ACCEL = bytes.fromhex("55 51 0A 00 EC FF 00 08 D0 09 7C")
RATE = bytes.fromhex("55 52 10 00 E0 FF 05 00 00 00 9B")
ANGLES = encode_packet(0x53, bytes(8))
REGISTER = bytes.fromhex("55 71 3A 00 68 01 69 00 7A 00 00 00 00 00 00 00 00 00 00 00")


def blocks_of(data: bytes, **settings: object) -> list[tuple[int, int]]:
    return [(len(b), b.lost) for b in build(Settings(**settings)).feed([Chunk(data, 77)])]


def decoded(data: bytes, **settings: object) -> SampleBlock:
    return concatenate_blocks(build(Settings(**settings)).feed([Chunk(data, 77)]))


def test_a_sample_is_both_packets() -> None:
    got = decoded(ACCEL + RATE)
    gyro = np.array([0.9765625, -1.953125, 0.30517578125]) * DEGREE
    accel = np.array([0.0048828125, -0.009765625, 1.0]) * G
    np.testing.assert_allclose(got.values[0], [*gyro, *accel], rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(25.12)
    assert build(Settings()).timing == ArrivalTimedFormat()


def test_the_other_familys_temperature() -> None:
    assert decoded(ACCEL + RATE, temperature="jy61").temperature_c[0] == pytest.approx(2512 / 340 + 36.53)


def test_ranges() -> None:
    got = decoded(ACCEL + RATE, accelerometer_range=4.0, gyro_range=250.0)
    assert got.values[0, 5] == pytest.approx(G / 4)
    assert got.values[0, 0] == pytest.approx(0.9765625 / 8 * DEGREE)


def test_halves_alone_make_no_sample() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(RATE + ANGLES + ACCEL + ANGLES + RATE + ACCEL + ACCEL, 0)]) == []
    blocks = decoder.feed([Chunk(RATE, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0)]
    assert decoder.bad == 0


def test_a_pair_cut_between_two_feeds() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(ACCEL, 1)]) == []
    (got,) = decoder.feed([Chunk(RATE, 2)])
    assert got.t_ns.tolist() == [2]


def damaged(data: bytes) -> bytes:
    return data[:5] + bytes([data[5] ^ 0x10]) + data[6:]


SAMPLE = ACCEL + RATE + ANGLES


@pytest.mark.parametrize(
    ("hole", "expected", "bad"),
    [
        (damaged(ACCEL) + RATE + ANGLES, [(3, 0), (2, 1)], 1),
        (ACCEL + damaged(RATE) + ANGLES, [(3, 0), (2, 1)], 1),
        (ACCEL + RATE + damaged(ANGLES), [(6, 0)], 1),
        (damaged(ACCEL) + damaged(RATE) + ANGLES, [(3, 0), (2, 1)], 2),
        (damaged(ACCEL) + damaged(RATE) + damaged(ANGLES), [(3, 0), (2, 1)], 3),
        (ACCEL + damaged(RATE) + ANGLES + damaged(ACCEL) + RATE + ANGLES, [(3, 0), (2, 2)], 2),
    ],
)
def test_a_hole_costs_the_samples_in_it(hole: bytes, expected: list[tuple[int, int]], bad: int) -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(SAMPLE * 3 + hole + SAMPLE * 2, 0)])
    assert [(len(b), b.lost) for b in blocks] == expected
    assert decoder.bad == bad


def test_halves_of_two_samples_are_not_married() -> None:
    assert blocks_of((ACCEL + RATE) * 2 + ACCEL + damaged(RATE) + damaged(ACCEL) + RATE + ACCEL + RATE) == [
        (2, 0),
        (1, 2),
    ]


def test_packets_without_pairs_are_told() -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(ANGLES * 150, 0)])
    assert "0x51" in decoder.recent_problem


def test_a_type_out_of_the_range_is_no_packet() -> None:
    assert blocks_of(encode_packet(0x60, bytes(8)) + encode_packet(0x4F, bytes(8))) == []


def bluetooth(n: int) -> bytes:
    rng = np.random.default_rng(2)
    values = rng.normal(0.0, 1.0, (n, 6))
    return b"".join(c.data for c in build(Settings(packet="bluetooth")).encode(make_block(np.arange(n), values)))


def test_bluetooth_comes_one_packet_late() -> None:
    data = bluetooth(6)
    assert len(data) == 120
    assert data[:2] == b"\x55\x61"
    got = decoded(data, packet="bluetooth")
    assert len(got) == 5
    values = np.random.default_rng(2).normal(0.0, 1.0, (6, 6))
    np.testing.assert_allclose(got.values[:, :3], values[:5, :3], atol=1000 * DEGREE / 2**15)
    np.testing.assert_allclose(got.values[:, 3:], values[:5, 3:], atol=8 * G / 2**15)
    assert np.isnan(got.temperature_c).all()


def test_bluetooth_register_answers_are_passed_over() -> None:
    data = bluetooth(6)
    assert blocks_of(data[:40] + REGISTER + data[40:], packet="bluetooth") == [(5, 0)]


def test_bluetooth_a_missing_byte_costs_one_sample() -> None:
    data = bluetooth(9)
    assert blocks_of(data[:65] + data[66:], packet="bluetooth") == [(3, 0), (4, 1)]


@pytest.mark.parametrize("key", ["accelerometer_range", "gyro_range"])
def test_a_range_that_is_none(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        build(read_settings(Settings, {key: 0.0}))
