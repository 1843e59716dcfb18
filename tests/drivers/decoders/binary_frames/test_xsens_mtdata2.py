"""Tests of the Xsens MTData2 decoder: documented frames, number formats, slow temperature and mixed packets."""

import struct

import numpy as np
import pytest

from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, SampleBlock, concatenate_blocks
from drivers.decoders.binary_frames.xsens_mtdata2 import MAX_PAYLOAD, Settings, _match_message, build, encode_message

DOCUMENTED_FRAME = bytes.fromhex(
    "FA FF 36 31 10 20 02 DF C5 10 60 04 00 45 9D A0 40 20 0C BE DC 9A FA 3F 54 9F 37 41 1C BB 70"
    "80 20 0C BB AA 5C 80 3B 8C 55 01 BB 81 33 00 E0 20 04 00 00 00 81 45"
)
HIGH_RATE_FRAME = bytes.fromhex("FA FF 36 0F 80 40 0C 3B 8B BC 00 BB E2 4F 00 3B 4E 4A 00 AF")
LONG_FRAME = bytes.fromhex(
    "FA FF 36 4E 10 60 04 02 53 35 CB 20 10 10 3F 7F FA 66 BB 40 34 B8 3C 49 96 2D 3B 5A 1F 82"
    "80 20 0C 39 FF 91 01 BA EC DD 81 BA 86 53 80 40 20 0C BE 64 DB 99 BC E7 FF 83 41 1D C2 CF"
    "C0 20 0C BE 90 48 80 3F 67 32 04 BF 54 89 04 E0 20 04 00 00 00 03 C9"
)
COMMAND_FRAMES = bytes.fromhex("FA FF 30 00 D1 FA FF 31 00 D0 FA FF 10 00 F1")


def pack_item(data_id: int, data: bytes) -> bytes:
    return struct.pack(">HB", data_id, len(data)) + data


def pack_floats_item(data_id: int, *numbers: float) -> bytes:
    return pack_item(data_id, struct.pack(f">{len(numbers)}f", *numbers))


def decode_bytes(data: bytes, **settings: object) -> SampleBlock | None:
    blocks = build(Settings(**settings)).feed([Chunk(data, 77)])
    return concatenate_blocks(blocks) if blocks else None


def test_documented_frame_is_decoded() -> None:
    got = decode_bytes(DOCUMENTED_FRAME)
    assert got is not None
    expected = [-0.00519902, 0.00428259, -0.00394285, -0.43086988, 0.83055443, 9.79576111]
    np.testing.assert_allclose(got.values[0], expected, atol=5e-9)
    assert got.ticks.tolist() == [4562336]
    assert np.isnan(got.temperature_c).all()


def test_clock_setting_selects_the_ticks() -> None:
    got = decode_bytes(DOCUMENTED_FRAME, clock="packet_counter")
    assert got is not None
    assert got.ticks.tolist() == [57285]
    assert build(Settings()).timing == CounterTimedFormat(2**32, 1e-4)
    assert build(Settings(clock="packet_counter")).timing == CounterTimedFormat(65536)
    free = decode_bytes(DOCUMENTED_FRAME, clock="arrival")
    assert free is not None
    assert free.ticks.tolist() == [NO_TICK]


def test_high_rate_frame_without_acceleration_gives_nan() -> None:
    got = decode_bytes(HIGH_RATE_FRAME, high_rate=True)
    assert got is not None
    np.testing.assert_allclose(got.values[0, :3], struct.unpack(">3f", HIGH_RATE_FRAME[7:19]), rtol=1e-7)
    assert np.isnan(got.values[0, 3:]).all()
    assert decode_bytes(HIGH_RATE_FRAME) is None


def test_long_frame_is_decoded() -> None:
    got = decode_bytes(LONG_FRAME)
    assert got is not None
    assert got.ticks.tolist() == [0x025335CB]
    np.testing.assert_allclose(got.values[0, :3], [4.8745e-4, -1.80715e-3, -1.02482e-3], rtol=1e-4)
    np.testing.assert_allclose(got.values[0, 3:], [-0.223494, -0.028320, 9.860061], rtol=1e-4)


def test_commands_and_answers_are_ignored() -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(DOCUMENTED_FRAME + COMMAND_FRAMES + DOCUMENTED_FRAME, 0)])
    assert sum(len(b) for b in blocks) == 2
    assert decoder.bad == 0


def test_free_acceleration_is_never_used() -> None:
    assert decode_bytes(encode_message(pack_floats_item(0x4030, 0.1, 0.2, 0.3))) is None


@pytest.mark.parametrize("frame", [0x0, 0x4, 0x8])
def test_coordinate_frame_bits_of_the_identifier_are_ignored(frame: int) -> None:
    got = decode_bytes(
        encode_message(pack_floats_item(0x4020 | frame, 1, 2, 3) + pack_floats_item(0x8020 | frame, 4, 5, 6))
    )
    assert got is not None
    assert got.values.tolist() == [[4, 5, 6, 1, 2, 3]]


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        (1, struct.pack(">3i", -(5 << 19), 1 << 18, 9 << 20)),
        (2, struct.pack(">IhIhIh", 1 << 31, -3, 1 << 30, 0, 0, 9)),
        (3, struct.pack(">3d", -2.5, 0.25, 9.0)),
    ],
)
def test_number_formats(kind: int, data: bytes) -> None:
    got = decode_bytes(encode_message(pack_item(0x4020 | kind, data)))
    assert got is not None
    assert got.values[0, 3:].tolist() == [-2.5, 0.25, 9.0]


def test_last_temperature_is_repeated_until_the_next_one() -> None:
    def make_sample(tick: int) -> bytes:
        return encode_message(
            pack_item(0x1060, struct.pack(">I", tick))
            + pack_floats_item(0x4020, 0, 0, 9.8)
            + pack_floats_item(0x8020, 0, 0, 0)
        )

    decoder = build(Settings())
    data = (
        make_sample(0)
        + encode_message(pack_floats_item(0x0810, 25.5))
        + make_sample(1)
        + make_sample(2)
        + encode_message(pack_floats_item(0x0810, 26.0))
        + make_sample(3)
    )
    blocks = decoder.feed([Chunk(data, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(4, 0)]
    np.testing.assert_array_equal(blocks[0].temperature_c, [np.nan, 25.5, 25.5, 26.0])
    assert decoder.feed([Chunk(make_sample(4), 0)])[0].temperature_c.tolist() == [26.0]
    decoder.forget_stream_state()
    assert np.isnan(decoder.feed([Chunk(make_sample(5), 0)])[0].temperature_c).all()
    assert decoder.bad == 0


def test_packets_of_different_layouts_stay_in_order() -> None:
    a = [encode_message(pack_item(0x1060, struct.pack(">I", i)) + pack_floats_item(0x4020, i, 0, 0)) for i in range(6)]
    b = [encode_message(pack_item(0x1060, struct.pack(">I", i)) + pack_floats_item(0x8020, i, 0, 0)) for i in range(6)]
    c = [encode_message(pack_floats_item(0x8020, i, 0, 0) + pack_item(0x1060, struct.pack(">I", i))) for i in range(6)]
    got = decode_bytes(b"".join(x for trio in zip(a, b, c, strict=True) for x in trio))
    assert got is not None
    assert got.ticks.tolist() == [i for i in range(6) for _ in range(3)]
    np.testing.assert_array_equal(got.values[:, 0], [x for i in range(6) for x in (np.nan, i, i)])
    np.testing.assert_array_equal(got.values[:, 3], [x for i in range(6) for x in (i, np.nan, np.nan)])


def test_packet_with_an_incomplete_item_is_bad() -> None:
    decoder = build(Settings())
    wrong = encode_message(pack_floats_item(0x4020, 1, 2, 3) + b"\x40\x20")
    blocks = decoder.feed([Chunk(DOCUMENTED_FRAME + wrong + DOCUMENTED_FRAME, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_sample_with_nan_or_infinity_is_bad(wrong: float) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(encode_message(pack_floats_item(0x4020, 1, wrong, 3)), 0)]) == []
    assert decoder.bad == 1


def test_hint_names_the_missing_clock() -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(encode_message(pack_floats_item(0x4020, 1, 2, 3)), 0)])
    assert "sample_time_fine" in decoder.recent_problem


def test_packet_with_extended_length_is_decoded() -> None:
    payload = pack_floats_item(0x4020, 1, 2, 3) + pack_item(0x2010, bytes(250)) + pack_item(0xC020, bytes(12))
    data = encode_message(payload)
    assert data[3] == 0xFF
    got = decode_bytes(data)
    assert got is not None
    assert got.values[0, 3:].tolist() == [1, 2, 3]
    too_long = b"\xfa\xff\x36\xff" + (MAX_PAYLOAD + 1).to_bytes(2, "big")
    assert _match_message(too_long, 0) == -1
