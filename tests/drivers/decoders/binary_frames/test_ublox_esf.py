"""Tests of the u-blox decoder: recorded ESF-MEAS messages, assembly of samples, NMEA sentences and time tags."""

import struct

import numpy as np
import pytest

from drivers.data_types import (
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    SampleBlock,
    concatenate_blocks,
    make_block,
)
from drivers.decoders.base import Decoder
from drivers.decoders.binary_frames.ublox_esf import AXIS_TYPES, MESSAGES, Settings, build, encode_message
from drivers.units import DEGREE

# Recorded messages from the unit tests of the public library pyubx2
GYRO = bytes.fromhex("B562 1002 1C00 6DD80700 1820 0000 CD06000E E4FEFF0D 03FAFF05 090B000C 6DD80700 EE51")
ACCEL = bytes.fromhex("B562 1002 1800 72D80700 1818 0000 4BFDFF10 40020011 23280012 72D80700 039C")
SENTENCE = b"$GPGLL,4717.11634,N,00833.91297,E,124923.00,A,A*6E\r\n"
EXPECTED_GYRO = np.array([1741, -284, -1533]) / 4096 * DEGREE
EXPECTED_ACCEL = np.array([-693, 576, 10275]) / 1024


def decode(decoder: Decoder, data: bytes) -> list[SampleBlock]:
    return decoder.feed([Chunk(data, 77)])


def encode_raw(tag: int, numbers: dict[int, int]) -> bytes:
    """Return an ESF-RAW message with one time tag for all measurements."""
    words = [struct.pack("<II", kind << 24 | number & 0xFFFFFF, tag) for kind, number in numbers.items()]
    return encode_message(MESSAGES["esf-raw"], bytes(4) + b"".join(words))


ALL_AXES = dict(zip(AXIS_TYPES, (4096, -4096, 2048, 1024, -1024, 8192), strict=True))


def test_recorded_esf_meas_messages_make_a_sample() -> None:
    decoder = build(Settings(message="esf-meas"))
    got = concatenate_blocks(decode(decoder, GYRO + ACCEL))
    np.testing.assert_allclose(got.values[0], [*EXPECTED_GYRO, *EXPECTED_ACCEL], rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(28.25)
    assert got.ticks.tolist() == [514157]
    assert (got.lost, decoder.bad) == (0, 0)
    assert decoder.timing == CounterTimedFormat(1 << 32, 1e-3)


def test_measurements_with_distant_time_tags_are_not_joined() -> None:
    decoder = build(Settings(message="esf-meas", window=0.004))
    assert decode(decoder, (GYRO + ACCEL) * 60) == []
    assert decoder.recent_problem == "measurements arrive, but never all six axes within window = 0.004 s"


def test_message_without_its_partner_is_a_missing_sample() -> None:
    decoder = build(Settings(message="esf-meas"))
    moved = encode_message(GYRO[2:4], struct.pack("<I", 514256) + GYRO[10:-2])
    blocks = decode(decoder, ACCEL + GYRO + moved + ACCEL + GYRO)
    assert [(len(block), block.lost) for block in blocks] == [(1, 0), (1, 1)]


def test_damaged_half_of_a_sample_is_counted_once() -> None:
    decoder = build(Settings(message="esf-meas"))
    damaged = ACCEL[:20] + b"\xff" + ACCEL[21:]
    later = encode_message(GYRO[2:4], struct.pack("<I", 514256) + GYRO[10:-2])
    accel = encode_message(ACCEL[2:4], struct.pack("<I", 514261) + ACCEL[10:-2])
    blocks = decode(decoder, GYRO + ACCEL + GYRO + damaged + later + accel)
    assert [(len(block), block.lost) for block in blocks] == [(1, 0), (1, 1)]
    assert decoder.bad == 1


def test_esf_raw_message_contains_several_samples() -> None:
    decoder = build(Settings(tick=39.0625e-6))
    sets = [(0x1FFFFF0, 2500), (0x20000F0, -1)]
    body = b"".join(encode_raw(tag, {12: warm, **ALL_AXES})[10:-2] for tag, warm in sets)
    got = concatenate_blocks(decode(decoder, encode_message(MESSAGES["esf-raw"], b"\1\2\3\4" + body)))
    np.testing.assert_allclose(got.values, [[DEGREE, -DEGREE, 0.5 * DEGREE, 1.0, -1.0, 8.0]] * 2, rtol=1e-14)
    np.testing.assert_allclose(got.temperature_c, [25.0, -0.01], atol=1e-12)
    assert got.ticks.tolist() == [0xFFFFF0, 0xF0]  # only the low 24 bits count
    assert decoder.timing == CounterTimedFormat(1 << 24, 39.0625e-6)
    assert build(Settings()).timing == CounterTimedFormat(1 << 24, None)


def test_wheel_ticks_and_other_messages_are_ignored() -> None:
    wheel = encode_raw(999, {8: 5, 11: -7})
    navigation = encode_message(b"\x01\x07", bytes(92))
    decoder = build(Settings())
    blocks = decode(decoder, (encode_raw(5, ALL_AXES) + wheel + SENTENCE + navigation) * 3)
    assert [(len(block), block.lost) for block in blocks] == [(3, 0)]
    assert decoder.bad == 0


def test_sentence_with_a_wrong_checksum_is_rejected() -> None:
    decoder = build(Settings())
    blocks = decode(decoder, encode_raw(5, ALL_AXES) + SENTENCE.replace(b"6E", b"6F") + encode_raw(6, ALL_AXES))
    assert [(len(block), block.lost) for block in blocks] == [(1, 0), (1, 1)]


def test_missing_temperature_keeps_the_last_one() -> None:
    decoder = build(Settings())
    data = encode_raw(5, ALL_AXES) + encode_raw(6, {12: 2500, **ALL_AXES}) + encode_raw(7, ALL_AXES)
    np.testing.assert_allclose(decode(decoder, data)[0].temperature_c, [np.nan, 25.0, 25.0])


def test_missing_axis_is_reported() -> None:
    decoder = build(Settings())
    assert decode(decoder, b"".join(encode_raw(tag, {5: 1, 12: 2500}) for tag in range(200))) == []
    assert decoder.recent_problem == "measurements arrive, but never all six axes with equal time tags"


def test_message_names_the_option_for_the_message_that_arrives() -> None:
    decoder = build(Settings())
    assert decode(decoder, GYRO + ACCEL) == []
    assert decoder.recent_problem == 'ESF-MEAS arrives, not ESF-RAW: set message = "esf-meas"'
    decode(decoder, encode_raw(5, ALL_AXES))
    assert decoder.recent_problem == ""


def test_arrival_clock_ignores_the_time_tag() -> None:
    decoder = build(Settings(clock="arrival"))
    assert isinstance(decoder.timing, ArrivalTimedFormat)
    assert decode(decoder, encode_raw(5, ALL_AXES))[0].ticks.tolist() == [-1]


def test_temperature_that_is_not_measured_is_not_sent() -> None:
    decoder = build(Settings())
    chunk = decoder.encode(make_block(np.arange(1), np.zeros((1, 6)), None, np.array([3])))[0]
    assert len(chunk.data) == 8 + 4 + 8 * 6
