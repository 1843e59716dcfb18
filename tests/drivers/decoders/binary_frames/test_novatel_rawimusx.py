"""Tests of the NovAtel decoder: published logs in binary and as text, headers, scales, error bits and GPS time."""

import struct

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, SampleBlock, concatenate_blocks, make_block
from drivers.decoders.binary_frames.novatel_rawimusx import (
    PAYLOAD,
    SCALES,
    Settings,
    build,
    compute_crc,
    encode_short_log,
)
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from tests.support.settings import read_settings

# The same log of a HG1700 in binary and as text, from the unit tests of NovAtel's library EDIE
HG1700_BINARY = bytes.fromhex(
    "AA441328 B605 9C06 78B9E21C 00 0B 9C06 0B9755A832941D41 03158000 EBD09102 A687F3FF 38EAFCFF"
    "66B7FCFF 1C5FFFFF 59D9FFFF 475FAFBA"
)
HG1700_TEXT = (
    b"RAWIMUSXA,1692,484620.664;00,11,1692,484620.664389000,00801503,43110635,-817242,-202184,-215194,-41188,-9895"
)
# A log of a STIM300 at rest, from the unit tests of the public Holo SDK
STIM300_BINARY = bytes.fromhex(
    "AA441328 B605 2908 18677A01 00 20 2908 3D26F7E0BE37D840 00000B0F AF060500 62080000 30E8FFFF"
    "6F000000 3E000000 54FFFFFF 8BE5610C"
)
# Example of the OEM7 manual, RAWIMUSX
EPSON_TEXT = (
    b"RAWIMUSXA,2209,491674.014;04,41,2209,491674.013699,ea59fe00,329308016,-2706935,4508389,196192,417138,-1000837"
)


def decode(data: bytes, **settings: object) -> SampleBlock:
    return concatenate_blocks(build(Settings(**settings)).feed([Chunk(data, 77)]))


def payload_of(text: bytes) -> bytes:
    """Return the binary payload of a log that is given as text."""
    info, kind, week, seconds, status, *numbers = text.partition(b";")[2].split(b",")
    head = struct.pack("<BBHdI", int(info, 16), int(kind), int(week), float(seconds), int(status, 16))
    return head + struct.pack("<6i", *map(int, numbers))


def replace(**fields: float) -> bytes:
    """Return the log of the STIM300 with other fields and a valid CRC."""
    log = np.frombuffer(STIM300_BINARY[12:-4], PAYLOAD).copy()
    for name, value in fields.items():
        log[name] = value
    return encode_short_log(1462, 2089, 24_798_982, log.tobytes())


def test_binary_log_equals_the_same_log_as_text() -> None:
    assert payload_of(HG1700_TEXT) == HG1700_BINARY[12:-4]
    assert compute_crc(HG1700_TEXT) == 0xA5DB8C7B
    assert encode_short_log(1462, 1692, 484_620_664, HG1700_BINARY[12:-4]) == HG1700_BINARY
    got = decode(HG1700_BINARY)
    foot = 0.3048
    expected_gyro = np.array([-9895, 41188, -215194]) * 2.0**-33 * 100
    expected_accel = np.array([-202184, 817242, 43110635]) * 2.0**-27 * foot * 100
    np.testing.assert_allclose(got.values[0], [*expected_gyro, *expected_accel], rtol=1e-14)
    assert got.values[0, 5] == pytest.approx(G0, rel=2e-3)
    assert got.ticks.tolist() == [(1692 * 604_800 + 484_620) * 1_000_000 + 664_389]


def test_log_of_a_stim300() -> None:
    got = decode(STIM300_BINARY)
    np.testing.assert_allclose(got.values[0, :3], np.array([-172, -62, 111]) / 2**21 * DEGREE * 125, rtol=1e-14)
    np.testing.assert_allclose(got.values[0, 3:], np.array([-6096, -2146, 329391]) / 2**22 * 125, rtol=1e-14)
    assert got.values[0, 5] == pytest.approx(G0, rel=2e-3)


def test_example_of_the_manual() -> None:
    assert compute_crc(EPSON_TEXT) == 0x038422A7
    got = decode(encode_short_log(1462, 2209, 491_674_014, payload_of(EPSON_TEXT)))
    np.testing.assert_allclose(
        got.values[0, :3] / DEGREE, np.array([-1000837, -417138, 196192]) * 0.008 / 65536, rtol=1e-12
    )
    assert got.values[0, 5] == pytest.approx(329308016 * 0.2e-3 / 65536 * G0)


@pytest.mark.parametrize("message_id", [1461, 1462])
def test_log_with_the_long_header(message_id: int) -> None:
    body = b"\xaa\x44\x12\x1c" + struct.pack("<HBBH", message_id, 0, 0x20, 40) + bytes(18) + STIM300_BINARY[12:-4]
    log = body + compute_crc(body).to_bytes(4, "little")
    np.testing.assert_array_equal(decode(log).values, decode(STIM300_BINARY).values)


def test_other_logs_are_ignored() -> None:
    other = encode_short_log(508, 2089, 0, bytes(88))
    decoder = build(Settings())
    blocks = decoder.feed([Chunk((STIM300_BINARY + other) * 3, 0)])
    assert [(len(block), block.lost) for block in blocks] == [(3, 0)]
    assert decoder.bad == 0


@pytest.mark.parametrize(
    ("imu_type", "rate_hz", "velocity"), [(31, 200, 200 / 2**31), (58, 100, 2**-29), (69, 400, 2**-29)]
)
def test_scales_contain_the_data_rate(imu_type: int, rate_hz: int, velocity: float) -> None:
    assert SCALES[imu_type][1] == pytest.approx(velocity * rate_hz, rel=1e-14)


def test_unknown_type_needs_scales() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(replace(imu_type=200), 0)]) == []
    assert decoder.recent_problem == (
        "IMU type 200 has no known scale: set gyro_scale and accel_scale in decoder_options"
    )
    assert decoder.bad == 1
    got = decode(replace(imu_type=200), gyro_scale=1e-6, accel_scale=1e-5)
    np.testing.assert_allclose(got.values[0], [-172e-6, -62e-6, 111e-6, -6096e-5, -2146e-5, 329391e-5], rtol=1e-12)


@pytest.mark.parametrize(("info", "words"), [(1, "IMU error"), (2, "encrypted"), (3, "encrypted")])
def test_error_bits_make_the_sample_bad(info: int, words: str) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(replace(info=info), 0)]) == []
    assert words in decoder.recent_problem
    assert decoder.feed([Chunk(STIM300_BINARY, 0)])[0].lost == 1
    assert decoder.recent_problem == ""


@pytest.mark.parametrize("seconds", [-1.0, 604_800.0, float("nan"), float("inf")])
def test_invalid_time_makes_the_sample_bad(seconds: float) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(replace(seconds=seconds), 0)]) == []
    assert decoder.bad == 1


def test_end_of_a_week_is_no_step() -> None:
    first, second = replace(seconds=604_799.995), replace(week=2090, seconds=0.003)
    assert np.diff(decode(first + second).ticks).tolist() == [8000]


def test_arrival_clock_ignores_the_gps_time() -> None:
    assert decode(STIM300_BINARY, clock="arrival").ticks.tolist() == [-1]
    assert isinstance(build(Settings(clock="arrival")).timing, ArrivalTimedFormat)


@pytest.mark.parametrize("imu_type", SCALES)
def test_every_type_survives_encoding_and_decoding(imu_type: int) -> None:
    values = np.array([[0.1, -0.2, 0.3, 1.0, -2.0, 9.8]])
    decoder = build(Settings(imu_type=imu_type))
    got = concatenate_blocks(decoder.feed(decoder.encode(make_block(np.arange(1), values, None, np.array([5])))))
    assert (np.abs(got.values - values) <= 0.5001 * np.repeat(SCALES[imu_type], 3)).all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"gyro_scale": 1e-6}, "accel_scale: missing"),
        ({"accel_scale": 1e-6}, "gyro_scale: missing"),
        ({"imu_type": 99}, "imu_type: 99 needs gyro_scale and accel_scale"),
        ({"imu_type": 256}, "imu_type: 256 is outside"),
    ],
)
def test_error_for_wrong_settings_names_the_key(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        build(read_settings(Settings, settings))
