"""Tests of the BNO08x RVC decoder: example frame of the data sheet, counter and missing gyroscope."""

import numpy as np

from drivers.data_types import Chunk, CounterTimedFormat, concatenate_blocks, make_block
from drivers.decoders.binary_frames.bno08x_rvc import Settings, build, encode_frame
from drivers.units import G0

PUBLISHED = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")
"""Example in the BNO080 data sheet 1000-3927: index 222, acceleration (-371, -20, 977) mg."""


def test_published_frame_is_decoded() -> None:
    decoder = build(Settings())
    got = concatenate_blocks(decoder.feed([Chunk(PUBLISHED, 77)]))
    np.testing.assert_allclose(got.values[0, 3:], np.array([-0.371, -0.020, 0.977]) * G0, rtol=1e-14)
    assert np.isnan(got.values[0, :3]).all()
    assert np.isnan(got.temperature_c[0])
    assert got.ticks.tolist() == [222]
    assert decoder.timing == CounterTimedFormat(256)


def test_published_frame_is_encoded() -> None:
    assert encode_frame(0xDE, PUBLISHED[3:15]) == PUBLISHED


def test_header_inside_a_frame_is_not_a_frame() -> None:
    frames = b"".join(encode_frame(0xAA, b"\xaa\xaa\xaa" * 4) for _ in range(6))
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(PUBLISHED + frames, 0)])
    assert [(len(block), block.lost) for block in blocks] == [(7, 0)]


def test_axis_that_is_not_measured_is_sent_as_zero() -> None:
    values = np.full((2, 6), np.nan)
    decoder = build(Settings())
    chunks = decoder.encode(make_block(np.arange(2), values, None, np.array([255, 0])))
    got = concatenate_blocks(decoder.feed(chunks))
    assert got.values[:, 3:].tolist() == [[0.0] * 3] * 2
    assert got.ticks.tolist() == [255, 0]
