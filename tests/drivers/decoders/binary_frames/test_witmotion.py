"""Tests of the WitMotion decoder: pairs of packets, gaps, and Bluetooth packets without a checksum."""

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, SampleBlock, concatenate_blocks, make_block
from drivers.decoders.binary_frames.witmotion import Settings, build, encode_packet
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from tests.support.settings import read_settings

ACCEL = bytes.fromhex("55 51 0A 00 EC FF 00 08 D0 09 7C")
RATE = bytes.fromhex("55 52 10 00 E0 FF 05 00 00 00 9B")
ANGLES = encode_packet(0x53, bytes(8))
REGISTER_ANSWER = bytes.fromhex("55 71 3A 00 68 01 69 00 7A 00 00 00 00 00 00 00 00 00 00 00")


def decode_and_count(data: bytes, **settings: object) -> list[tuple[int, int]]:
    """Return the number of rows and of lost samples before them, for each block."""
    return [(len(b), b.lost) for b in build(Settings(**settings)).feed([Chunk(data, 77)])]


def decode_bytes(data: bytes, **settings: object) -> SampleBlock:
    return concatenate_blocks(build(Settings(**settings)).feed([Chunk(data, 77)]))


def test_two_packets_form_a_sample() -> None:
    got = decode_bytes(ACCEL + RATE)
    gyro = np.array([0.9765625, -1.953125, 0.30517578125]) * DEGREE
    accel = np.array([0.0048828125, -0.009765625, 1.0]) * G0
    np.testing.assert_allclose(got.values[0], [*gyro, *accel], rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(25.12)
    assert build(Settings()).timing == ArrivalTimedFormat()


def test_temperature_of_the_jy61_family_is_decoded() -> None:
    assert decode_bytes(ACCEL + RATE, temperature="jy61").temperature_c[0] == pytest.approx(2512 / 340 + 36.53)


def test_configured_ranges_set_the_scale() -> None:
    got = decode_bytes(ACCEL + RATE, accelerometer_range=4.0, gyro_range=250.0)
    assert got.values[0, 5] == pytest.approx(G0 / 4)
    assert got.values[0, 0] == pytest.approx(0.9765625 / 8 * DEGREE)


def test_incomplete_pairs_form_no_sample() -> None:
    decoder = build(Settings())
    assert (
        decoder.feed(
            [
                Chunk(
                    RATE + ANGLES + ACCEL + ANGLES + RATE + ACCEL + ACCEL,
                    0,
                )
            ]
        )
        == []
    )
    blocks = decoder.feed([Chunk(RATE, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0)]
    assert decoder.bad == 0


def test_pair_divided_between_two_feeds_is_decoded() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(ACCEL, 1)]) == []
    (got,) = decoder.feed([Chunk(RATE, 2)])
    assert got.t_ns.tolist() == [2]


def damage_packet(data: bytes) -> bytes:
    return data[:5] + bytes([data[5] ^ 0x10]) + data[6:]


SAMPLE = ACCEL + RATE + ANGLES


@pytest.mark.parametrize(
    ("gap", "expected", "bad"),
    [
        (damage_packet(ACCEL) + RATE + ANGLES, [(3, 0), (2, 1)], 1),
        (ACCEL + damage_packet(RATE) + ANGLES, [(3, 0), (2, 1)], 1),
        (ACCEL + RATE + damage_packet(ANGLES), [(6, 0)], 1),
        (damage_packet(ACCEL) + damage_packet(RATE) + ANGLES, [(3, 0), (2, 1)], 2),
        (damage_packet(ACCEL) + damage_packet(RATE) + damage_packet(ANGLES), [(3, 0), (2, 1)], 3),
        (
            ACCEL + damage_packet(RATE) + ANGLES + damage_packet(ACCEL) + RATE + ANGLES,
            [(3, 0), (2, 2)],
            2,
        ),
    ],
)
def test_gap_counts_the_samples_in_it_as_lost(gap: bytes, expected: list[tuple[int, int]], bad: int) -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(SAMPLE * 3 + gap + SAMPLE * 2, 0)])
    assert [(len(b), b.lost) for b in blocks] == expected
    assert decoder.bad == bad


def test_packets_of_different_samples_are_not_paired() -> None:
    assert decode_and_count(
        (ACCEL + RATE) * 2 + ACCEL + damage_packet(RATE) + damage_packet(ACCEL) + RATE + ACCEL + RATE
    ) == [
        (2, 0),
        (1, 2),
    ]


def test_hint_names_the_missing_packet() -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(ANGLES * 150, 0)])
    assert "0x51" in decoder.recent_problem


def test_packet_of_unknown_type_is_ignored() -> None:
    assert decode_and_count(encode_packet(0x60, bytes(8)) + encode_packet(0x4F, bytes(8))) == []


def encode_bluetooth(n: int) -> bytes:
    rng = np.random.default_rng(2)
    values = rng.normal(0.0, 1.0, (n, 6))
    return b"".join(c.data for c in build(Settings(packet="bluetooth")).encode(make_block(np.arange(n), values)))


def test_bluetooth_sample_is_decoded_with_the_next_packet() -> None:
    data = encode_bluetooth(6)
    assert len(data) == 120
    assert data[:2] == b"\x55\x61"
    got = decode_bytes(data, packet="bluetooth")
    assert len(got) == 5
    values = np.random.default_rng(2).normal(0.0, 1.0, (6, 6))
    np.testing.assert_allclose(got.values[:, :3], values[:5, :3], atol=1000 * DEGREE / 2**15)
    np.testing.assert_allclose(got.values[:, 3:], values[:5, 3:], atol=8 * G0 / 2**15)
    assert np.isnan(got.temperature_c).all()


def test_bluetooth_register_answers_are_ignored() -> None:
    data = encode_bluetooth(6)
    assert decode_and_count(data[:40] + REGISTER_ANSWER + data[40:], packet="bluetooth") == [(5, 0)]


def test_bluetooth_missing_byte_loses_one_sample() -> None:
    data = encode_bluetooth(9)
    assert decode_and_count(data[:65] + data[66:], packet="bluetooth") == [(3, 0), (4, 1)]


@pytest.mark.parametrize("key", ["accelerometer_range", "gyro_range"])
def test_range_of_zero_is_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        build(read_settings(Settings, {key: 0.0}))
