"""Tests of the STIM300 decoder: published frame, datagram sizes, CRC, ranges, increments and status bits."""

import numpy as np
import pytest

from drivers.data_types import Chunk, CounterTimedFormat, SampleBlock, concatenate_blocks, make_block
from drivers.decoders.base import MAX_BYTES_WITHOUT_FRAME
from drivers.decoders.binary_frames.stim300 import IDENTIFIERS, SIZES, Settings, build, datagram_crc, has_valid_crc
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from tests.support.settings import read_settings

PUBLISHED = bytes.fromhex(
    "AF 00 01 24 FF FA D6 00 03 5B 00 FF E7 A6 FF DD 36 08 1C 52 00 FF 7E 70 FE BA 0C 3F FA 1D 00"
    "23 A0 23 C0 23 A0 00 23 19 23 0A 23 1C 00 23 95 23 B6 23 95 00 FF EF 02 00 E1 01 FA C6 49 42 C6"
)
GYRO_STATUS, ACCEL_STATUS, INCL_STATUS, TEMPERATURE_STATUS = 10, 20, 30, 37


def replace_byte(at: int, byte: int) -> bytes:
    """Return the published frame with one byte replaced and a valid CRC."""
    body = PUBLISHED[:at] + bytes([byte]) + PUBLISHED[at + 1 : -4]
    return body + datagram_crc(body)


def decode_bytes(data: bytes, **settings: object) -> SampleBlock | None:
    blocks = build(Settings(**settings)).feed([Chunk(data, 77)])
    return concatenate_blocks(blocks) if blocks else None


def test_published_frame_is_decoded() -> None:
    got = decode_bytes(PUBLISHED)
    assert got is not None
    gyro = np.array([0.017822265625, -0.0806884765625, 0.05242919921875]) * DEGREE
    accel = np.array([-0.011890411376953125, -0.016986846923828125, 1.0138282775878906]) * G0
    np.testing.assert_allclose(got.values[0], [*gyro, *accel], rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx((35.625 + 35.75 + 35.625) / 3, abs=1e-12)
    assert got.ticks.tolist() == [225]
    assert build(Settings()).timing == CounterTimedFormat(256, 1 / 2000)


def test_crc_equals_a_bitwise_computation() -> None:
    register = 0xFFFFFFFF
    for byte in PUBLISHED[:-4] + b"\0":
        register ^= byte << 24
        for _ in range(8):
            register = (register << 1 ^ (0x04C11DB7 if register >> 31 else 0)) & 0xFFFFFFFF
    assert register == 0xC64942C6 == 3326689990
    assert datagram_crc(PUBLISHED[:-4]) == PUBLISHED[-4:]
    assert has_valid_crc(PUBLISHED)
    assert not has_valid_crc(PUBLISHED[:-1] + b"\0")


@pytest.mark.parametrize(
    ("identifier", "size"), [(0xAF, 63), (0x91, 28), (0x93, 38), (0xA5, 42), (0x90, 18), (0x97, 59)]
)
def test_datagram_sizes(identifier: int, size: int) -> None:
    assert SIZES[identifier] == size


@pytest.mark.parametrize(
    ("identifier", "padding"),
    [
        *((0x90, 2), (0x91, 0), (0x92, 0), (0x93, 2), (0x94, 3), (0xA5, 2), (0xA6, 2), (0xA7, 1)),
        *((0x98, 2), (0x99, 0), (0x9A, 0), (0x9B, 2), (0x9C, 3), (0xAD, 2), (0xAE, 2), (0xAF, 1)),
    ],
)
def test_padding_makes_the_crc_input_a_multiple_of_four_bytes(identifier: int, padding: int) -> None:
    assert -(SIZES[identifier] - 4) % 4 == padding


@pytest.mark.parametrize("identifier", sorted(IDENTIFIERS))
def test_every_datagram_survives_encoding_and_decoding(identifier: int) -> None:
    rng = np.random.default_rng(identifier)
    n = 5
    samples = make_block(np.arange(n), rng.normal(0, 1, (n, 6)), np.full(n, 20.0), np.arange(253, 253 + n) % 256)
    decoder = build(Settings())
    got = concatenate_blocks(decoder.feed(build(Settings(identifier=identifier)).encode(samples)))
    parts = IDENTIFIERS[identifier]
    np.testing.assert_allclose(got.values[:, :3], samples.values[:, :3], atol=DEGREE / 2**15)
    if parts & 1:
        np.testing.assert_allclose(got.values[:, 3:], samples.values[:, 3:], atol=G0 / 2**20)
    else:
        assert np.isnan(got.values[:, 3:]).all()
    assert (got.temperature_c == 20.0).all() if parts & 4 else np.isnan(got.temperature_c).all()
    assert got.ticks.tolist() == [253, 254, 255, 0, 1]


@pytest.mark.parametrize(("name", "bits"), [("2g", 21), ("5g", 20), ("10g", 19), ("30g", 18), ("80g", 16)])
def test_accelerometer_range_sets_the_scale(name: str, bits: int) -> None:
    got = decode_bytes(PUBLISHED, accelerometer_range=name)
    assert got is not None
    assert got.values[0, 5] == pytest.approx(0x081C52 / 2**bits * G0, rel=1e-14)


def test_increments_are_converted_to_rates() -> None:
    got = decode_bytes(PUBLISHED, gyro_output="increment", accelerometer_output="increment", rate=250.0)
    assert got is not None
    assert got.values[0, 0] == pytest.approx(0x000124 / 2**21 * DEGREE * 250.0, rel=1e-14)
    assert got.values[0, 5] == pytest.approx(0x081C52 / 2**22 * 250.0, rel=1e-14)


@pytest.mark.parametrize("at", [GYRO_STATUS, ACCEL_STATUS])
@pytest.mark.parametrize("bit", [0x80, 0x40, 0x10, 0x08])
def test_error_bit_in_the_status_makes_the_sample_bad(at: int, bit: int) -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(PUBLISHED + replace_byte(at, bit | 1), 0)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0)]
    assert decoder.bad == 1
    assert ("starting" if bit == 0x40 else "status 0x") in decoder.recent_problem
    blocks = decoder.feed([Chunk(PUBLISHED, 0)])
    assert blocks[0].lost == 1
    assert decoder.recent_problem == ""


@pytest.mark.parametrize(("at", "byte"), [(GYRO_STATUS, 0x20), (ACCEL_STATUS, 0x20), (INCL_STATUS, 0x88)])
def test_operating_condition_and_inclinometer_bits_are_accepted(at: int, byte: int) -> None:
    assert decode_bytes(replace_byte(at, byte)) is not None


def test_temperature_with_an_error_bit_becomes_nan() -> None:
    got = decode_bytes(replace_byte(TEMPERATURE_STATUS, 0x08))
    assert got is not None
    assert np.isnan(got.temperature_c).all()


def test_cr_lf_after_a_frame_is_ignored() -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk((PUBLISHED + b"\r\n") * 9, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(9, 0)]
    assert decoder.bad == 0


def test_auto_identifier_follows_a_reconfigured_device() -> None:
    short = [c.data for c in build(Settings(identifier=0x91)).encode(make_block(np.arange(200), np.zeros((200, 6))))]
    decoder = build(Settings())
    assert len(decoder.feed([Chunk(PUBLISHED * 3, 0)])) == 1
    size = len(short[0])
    assert decoder.feed([Chunk(b"".join(short)[:MAX_BYTES_WITHOUT_FRAME], 0)]) == []
    assert "baud rate" in decoder.recent_problem
    got = sum(len(b) for b in decoder.feed([Chunk(b"".join(short)[MAX_BYTES_WITHOUT_FRAME:], 0)]))
    assert got == 200 - MAX_BYTES_WITHOUT_FRAME // size - 1
    once = build(Settings())
    assert sum(len(b) for b in once.feed([Chunk(PUBLISHED * 3 + b"".join(short), 0)])) == 3 + got
    decoder = build(Settings(identifier=0xAF))
    assert decoder.feed([Chunk(b"".join(short), 0)]) == []


def test_missing_axis_is_encoded_as_a_channel_error() -> None:
    values = np.zeros((3, 6))
    values[1, 2] = np.nan
    decoder = build(Settings())
    blocks = decoder.feed(decoder.encode(make_block(np.arange(3), values)))
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"identifier": 0x95}, "0x90"),
        ({"gyro_output": "increment"}, "rate"),
        ({"accelerometer_output": "increment"}, "rate"),
        ({"rate": -1.0}, "rate: -1 Hz is outside"),
    ],
)
def test_error_for_wrong_settings_names_valid_values(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        build(read_settings(Settings, settings))
    assert "\n" not in str(caught.value)
