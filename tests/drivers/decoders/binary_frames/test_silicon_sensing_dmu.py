"""Tests of the DMU11 decoder: both message lengths, units, order of the axes, checksum and flags.

No message of a device is public. The messages are synthetic: they follow the table of the data sheet DMU11-00-0100-132
revision 3, as quoted in public drivers for ArduPilot.
"""

import struct

import numpy as np
import pytest

from drivers.data_types import Chunk, CounterTimedFormat, SampleBlock, make_block
from drivers.decoders.binary_frames.silicon_sensing_dmu import Settings, append_checksum, build
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from tests.support.settings import read_settings

LONG = bytes.fromhex(
    "55 AA 00 07 3F 00 00 00 3C 23 D7 0A BE 80 00 00 BC A3 D7 0A 3E 00 00 00 BF 80 00 00"
    "00 00 00 00 41 C8 00 00" + "00" * 24 + "00 00 00 00 00 00 C6 AD"
)
SHORT = append_checksum(LONG[:28] + LONG[32:36] + bytes(6))


def decode_one(message: bytes, **settings: object) -> SampleBlock:
    (block,) = build(Settings(**settings)).feed([Chunk(message, 77)])
    assert len(block) == 1
    return block


@pytest.mark.parametrize(("message", "length"), [(LONG, 68), (SHORT, 40)])
def test_rates_and_accelerations_are_interleaved(message: bytes, length: int) -> None:
    assert len(message) == length
    got = decode_one(message, length=length)
    np.testing.assert_allclose(got.values[0, :3], np.array([0.5, -0.25, 0.125]) * DEGREE, rtol=1e-15)
    np.testing.assert_allclose(got.values[0, 3:], np.array([0.01, -0.02, -1.0]) * G0, rtol=1e-7)
    assert (got.temperature_c.tolist(), got.ticks.tolist()) == ([25.0], [7])
    assert build(Settings()).timing == CounterTimedFormat(1 << 16)


@pytest.mark.parametrize("message", [LONG, SHORT])
def test_words_sum_to_zero(message: bytes) -> None:
    words = struct.unpack(f">{len(message) // 2}H", message)
    assert sum(words) % 65536 == 0


@pytest.mark.parametrize("length", [68, 40])
def test_message_of_the_other_length_is_rejected(length: int) -> None:
    decoder = build(Settings(length=length))
    assert decoder.feed([Chunk((SHORT if length == 68 else LONG) * 50, 0)]) == []


@pytest.mark.parametrize(("message", "length"), [(LONG, 68), (SHORT, 40)])
def test_error_flags_are_reported_and_other_flags_are_not(message: bytes, length: int) -> None:
    decoder = build(Settings(length=length))
    body = message[:-8] + bytes.fromhex("00 10 00 20")
    assert len(decoder.feed([Chunk(append_checksum(body + b"\0\0"), 0)])[0]) == 1
    assert decoder.recent_problem == ""
    assert len(decoder.feed([Chunk(append_checksum(body + b"\x08\x01"), 0)])[0]) == 1
    assert "0x0801" in decoder.recent_problem
    decoder.feed([Chunk(message, 0)])
    assert decoder.recent_problem == ""


def test_number_that_is_not_finite_is_bad() -> None:
    decoder = build(Settings())
    values = np.zeros((3, 6))
    values[1, 4] = np.nan
    blocks = decoder.feed(decoder.encode(make_block(np.arange(3), values, np.zeros(3), np.arange(3))))
    assert [(len(block), block.lost) for block in blocks] == [(1, 0), (1, 1)]
    assert decoder.bad == 1


def test_error_for_a_wrong_length_names_the_valid_lengths() -> None:
    with pytest.raises(ConfigError, match="68") as caught:
        read_settings(Settings, {"length": 60})
    assert "\n" not in str(caught.value)
