"""Tests of the VectorNav binary decoder: example messages, all fields with axes, and rejected messages."""

import binascii
import struct

import numpy as np
import pytest

from drivers.data_types import (
    NO_TICK,
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    SampleBlock,
    concatenate_blocks,
    make_block,
)
from drivers.decoders.binary_frames.vectornav_binary import FIELD_SIZES, TICKS, Settings, build, build_message_dtype

EXAMPLE_1 = bytes.fromhex("FA 01 08 00 93 50 2E 42 83 3E F1 3F 48 B5 04 BB 92 88")
EXAMPLE_2_WRONG = bytes.fromhex("FA 05 08 00 01 00" + "00" * 20 + "A8 3A")


def make_message(masks: dict[int, int], payload: bytes) -> bytes:
    """Return a message with the given field mask of each group, the payload and a valid CRC."""
    groups = sum(1 << (g - 1) for g in masks)
    body = bytes([groups]) + b"".join(struct.pack("<H", m) for _, m in sorted(masks.items())) + payload
    return b"\xfa" + body + binascii.crc_hqx(body, 0).to_bytes(2, "big")


def decode_bytes(data: bytes, **settings: object) -> SampleBlock | None:
    decoder = build(Settings(**settings))
    blocks = decoder.feed([Chunk(data, 77)])
    return concatenate_blocks(blocks) if blocks else None


def pack_floats(*numbers: float) -> bytes:
    return struct.pack(f"<{len(numbers)}f", *numbers)


def test_first_example_of_the_manual_is_a_message_without_a_sample() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(EXAMPLE_1, 0)]) == []
    message_dtype = build_message_dtype(EXAMPLE_1[1:4], False)
    assert message_dtype is not None
    assert message_dtype.itemsize == len(EXAMPLE_1)
    assert not {"gyro", "accel"} & {*(message_dtype.names or ())}
    np.testing.assert_allclose(np.frombuffer(EXAMPLE_1, "<f4", 3, 4), [43.578686, 1.8847202, -0.0020249654], rtol=1e-7)
    assert decoder.bad == 0


def test_second_example_of_the_manual_has_a_wrong_crc_and_is_rejected() -> None:
    decoder = build(Settings())
    good = make_message({1: 0x0201}, struct.pack("<Q", 5) + pack_floats(0, 0, -9.8, 0.1, 0.2, 0.3))
    blocks = decoder.feed([Chunk(good + EXAMPLE_2_WRONG + good, 0)])
    assert sum(len(b) for b in blocks) == 2
    assert decoder.bad == 1


def test_recommended_message_is_decoded() -> None:
    data = make_message({1: 0x0201}, struct.pack("<Q", 123_456_789) + pack_floats(0.5, -0.25, -9.75, 0.125, -0.5, 1.0))
    assert data[:4] == bytes.fromhex("FA 01 01 02")
    assert len(data) == 38
    got = decode_bytes(data)
    assert got is not None
    assert got.values.tolist() == [[0.125, -0.5, 1.0, 0.5, -0.25, -9.75]]
    assert got.ticks.tolist() == [123_456_789]
    assert np.isnan(got.temperature_c).all()
    assert build(Settings()).timing == CounterTimedFormat(TICKS, 1e-9)


@pytest.mark.parametrize(
    ("masks", "gyro", "accel", "temperature", "time"),
    [
        ({1: 1 << 5}, 0, None, None, None),
        ({1: 1 << 8}, None, 0, None, None),
        ({1: 1 << 9 | 1 << 10 | 1 << 14}, 12, 0, 36, None),
        ({1: 1 << 0 | 1 << 5 | 1 << 8}, 8, 20, None, 0),
        ({3: 1 << 2 | 1 << 3 | 1 << 4}, 12, 0, 24, None),
        ({3: 1 << 9 | 1 << 10}, 12, 0, None, None),
        ({1: 1 << 0, 2: 1 << 3, 3: 1 << 0 | 1 << 2 | 1 << 3, 5: 1 << 0}, 8 + 2 + 2 + 12, 12, None, 0),
        ({2: 1 << 0, 3: 1 << 3}, 8, None, None, 0),
        ({1: 0x7FFF}, 124, 112, 148, 0),
    ],
)
def test_axes_are_decoded_from_every_field(
    masks: dict[int, int], gyro: int | None, accel: int | None, temperature: int | None, time: int | None
) -> None:
    size = sum(n for g, m in masks.items() for bit, n in enumerate(FIELD_SIZES[g]) if m >> bit & 1)
    payload = bytearray(size)
    nan = [np.nan] * 3
    for offset, numbers in ((gyro, (1.0, 2.0, 3.0)), (accel, (4.0, 5.0, 6.0)), (temperature, (25.5,))):
        if offset is not None:
            struct.pack_into(f"<{len(numbers)}f", payload, offset, *numbers)
    if time is not None:
        struct.pack_into("<Q", payload, time, 9_000)
    got = decode_bytes(make_message(masks, bytes(payload)))
    assert got is not None
    expected = [*(nan if gyro is None else (1.0, 2.0, 3.0)), *(nan if accel is None else (4.0, 5.0, 6.0))]
    np.testing.assert_array_equal(got.values[0], expected)
    np.testing.assert_array_equal(got.temperature_c, [np.nan if temperature is None else 25.5])
    assert got.ticks.tolist() == [NO_TICK if time is None else 9_000]


def test_setting_selects_compensated_or_uncompensated_values() -> None:
    data = make_message({1: 1 << 5 | 1 << 8 | 1 << 9}, pack_floats(1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4))
    raw, corrected = decode_bytes(data), decode_bytes(data, compensated=True)
    assert raw is not None
    assert corrected is not None
    assert raw.values.tolist() == [[4, 4, 4, 3, 3, 3]]
    assert corrected.values.tolist() == [[1, 1, 1, 2, 2, 2]]


@pytest.mark.parametrize(
    ("fields", "compensated", "noted"),
    [
        (1 << 5 | 1 << 8, False, True),
        (1 << 5 | 1 << 9, False, False),
        (1 << 5 | 1 << 9, True, True),
        (1 << 9, True, False),
    ],
    ids=["only compensated", "raw of both", "compensated of both", "only raw"],
)
def test_note_says_that_the_filter_has_corrected_the_rates(fields: int, compensated: bool, noted: bool) -> None:
    decoder = build(Settings(compensated=compensated))
    assert decoder.on_board_filter_note == ""
    decoder.feed(
        [Chunk(make_message({1: fields}, pack_floats(*range(9 if fields & 1 << 5 and fields & 1 << 9 else 6))), 0)]
    )
    assert ("hides bias instability" in decoder.on_board_filter_note) == noted


@pytest.mark.parametrize("masks", [{4: 1}, {6: 3}, {1: 0x8001}, {1: 0}, {3: 0x0800}])
def test_messages_with_fields_of_unknown_size_are_ignored(masks: dict[int, int]) -> None:
    assert decode_bytes(make_message(masks, bytes(30))) is None


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_sample_with_nan_or_infinity_is_bad(wrong: float) -> None:
    decoder = build(Settings())
    data = make_message({1: 1 << 9}, pack_floats(0, wrong, 0, 0, 0, 0))
    assert decoder.feed([Chunk(data, 0)]) == []
    assert decoder.bad == 1


def test_other_messages_between_samples_are_ignored() -> None:
    good = make_message({1: 0x0201}, struct.pack("<Q", 5) + pack_floats(0, 0, -9.8, 0.1, 0.2, 0.3))
    decoder = build(Settings())
    blocks = decoder.feed([Chunk((good + EXAMPLE_1) * 5, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(5, 0)]


def test_hint_asks_for_the_time_if_it_is_missing() -> None:
    data = make_message({1: 1 << 9}, pack_floats(0, 0, -9.8, 0, 0, 0))
    decoder = build(Settings())
    decoder.feed([Chunk(data, 0)])
    assert "TimeStartup" in decoder.recent_problem
    decoder = build(Settings(clock="arrival"))
    decoder.feed([Chunk(data, 0)])
    assert decoder.recent_problem == ""
    assert decoder.timing == ArrivalTimedFormat()


def test_time_beyond_62_bits_wraps_around() -> None:
    decoder = build(Settings())
    data = make_message({1: 0x0201}, struct.pack("<Q", TICKS + 3) + pack_floats(0, 0, -9.8, 0, 0, 0))
    assert decoder.feed([Chunk(data, 0)])[0].ticks.tolist() == [3]


def test_encode_writes_the_recommended_message() -> None:
    samples = make_block(np.array([9]), np.zeros((1, 6)), ticks=np.array([7]))
    (chunk,) = build(Settings()).encode(samples)
    assert chunk.data[:4] == bytes.fromhex("FA 01 01 02")
    assert len(chunk.data) == 38
    assert chunk.t_ns == 9
