"""Tests of the decoder for VectorNav ASCII sentences: example sentences, both checksums and ignored sentences."""

import binascii
import gzip

import numpy as np
import pytest

from drivers.data_types import Chunk, SampleBlock, concatenate_blocks
from drivers.decoders.text_lines.vectornav_ascii import Settings, build
from tests.support.nmea_sentences import make_sentence
from tests.support.recordings import recordings

IMU_SENTENCE = (
    b"$VNIMU,-00.0350,+00.4222,-00.6643,-00.015,+00.019,+09.948,+00.002066,-00.008442,-00.044656,+20.7,+084.322*66\r\n"
)
YMR_SENTENCE = (
    b"$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,"
    b"-01.258,-00.100,-09.701,-00.000018,+00.001122,-00.000551*69\r\n"
)
YMR_SENTENCE_2 = (
    b"$VNYMR,-078.104,+005.642,+023.096,+00.0125,+00.1252,-00.1042,"
    b"+00.878,-03.762,-08.854,-00.010387,-00.028062,-00.061305*68\r\n"
)
REGISTER_SENTENCE = b"$VNRRG,08,-114.314,+000.058,-001.773*5F\r\n"


def decode_bytes(data: bytes, **settings: object) -> SampleBlock | None:
    blocks = build(Settings(**settings)).feed([Chunk(data, 77)])
    return concatenate_blocks(blocks) if blocks else None


def test_imu_sentence_is_decoded() -> None:
    got = decode_bytes(IMU_SENTENCE)
    assert got is not None
    assert got.values.tolist() == [[0.002066, -0.008442, -0.044656, -0.015, 0.019, 9.948]]
    assert got.temperature_c.tolist() == [20.7]


@pytest.mark.parametrize(
    ("line", "row"),
    [
        (YMR_SENTENCE, [-0.000018, 0.001122, -0.000551, -1.258, -0.100, -9.701]),
        (YMR_SENTENCE_2, [-0.010387, -0.028062, -0.061305, 0.878, -3.762, -8.854]),
    ],
)
def test_ymr_sentence_is_decoded(line: bytes, row: list[float]) -> None:
    got = decode_bytes(line)
    assert got is not None
    assert got.values.tolist() == [row]
    assert np.isnan(got.temperature_c).all()


@pytest.mark.parametrize(("line", "noted"), [(YMR_SENTENCE, True), (IMU_SENTENCE, False)], ids=["VNYMR", "VNIMU"])
def test_note_says_that_the_filter_has_corrected_the_rates(line: bytes, noted: bool) -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(line, 77)])
    assert ("select $VNIMU" in decoder.on_board_filter_note) == noted


def test_auto_uses_only_the_first_kind_of_sentence() -> None:
    first = decode_bytes(YMR_SENTENCE + IMU_SENTENCE + YMR_SENTENCE_2)
    assert first is not None
    assert len(first) == 2
    chosen = decode_bytes(YMR_SENTENCE + IMU_SENTENCE + YMR_SENTENCE_2, sentence="VNIMU")
    assert chosen is not None
    assert chosen.temperature_c.tolist() == [20.7]


def test_auto_chooses_again_after_a_reset() -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(YMR_SENTENCE, 0)])
    assert decoder.feed([Chunk(IMU_SENTENCE, 0)]) == []
    decoder.forget_stream_state()
    assert len(decoder.feed([Chunk(IMU_SENTENCE, 0)])) == 1


def test_other_sentences_are_ignored() -> None:
    decoder = build(Settings())
    blocks = decoder.feed(
        [Chunk(REGISTER_SENTENCE + b"$VNRRG,8*4B\r\n" + IMU_SENTENCE + REGISTER_SENTENCE + IMU_SENTENCE, 0)]
    )
    assert [(len(b), b.lost) for b in blocks] == [(2, 0)]
    assert decoder.bad == 0
    decoder.feed([Chunk(REGISTER_SENTENCE * 150, 0)])
    assert "async output" in decoder.recent_problem


def test_crc_of_four_digits_is_checked() -> None:
    body = IMU_SENTENCE[1:-5]
    assert decode_bytes(b"$%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))) is not None
    assert decode_bytes(b"$%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0) ^ 1)) is None


@pytest.mark.parametrize("end", [b"*XX\r\n", b"*\r\n", b"*6\r\n", b"*066\r\n", b"*67\r\n", b"\r\n", b"* 6\r\n"])
def test_invalid_checksum_field_is_rejected(end: bytes) -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(IMU_SENTENCE + IMU_SENTENCE[:-5] + end + IMU_SENTENCE, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]
    assert decoder.bad == 1


def test_line_feed_alone_ends_a_sentence() -> None:
    assert decode_bytes(IMU_SENTENCE.replace(b"\r", b"")) is not None


def test_additional_fields_are_ignored() -> None:
    got = decode_bytes(make_sentence(IMU_SENTENCE[1:-5] + b",T0012345"))
    assert got is not None
    assert got.values[0, 5] == 9.948


@pytest.mark.parametrize(
    "body", [b"VNIMU,1,2,3", b"VNIMU," + b",".join([b"x"] * 11), b"VNIMU," + b",".join([b"nan"] * 11)]
)
def test_invalid_numbers_with_a_valid_checksum_are_bad(body: bytes) -> None:
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(IMU_SENTENCE + make_sentence(body) + IMU_SENTENCE, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]


def test_encoded_numbers_have_the_format_of_the_device() -> None:
    got = decode_bytes(IMU_SENTENCE)
    assert got is not None
    (chunk,) = build(Settings()).encode(got)
    kept = IMU_SENTENCE[IMU_SENTENCE.index(b",-00.015") : IMU_SENTENCE.index(b",+084")]
    assert kept in chunk.data


@pytest.mark.data
def test_recorded_stream_gives_the_recorded_samples() -> None:
    folder = recordings()
    wire = gzip.decompress((folder / "vn100-serial" / "vnymr-sentences.txt.gz").read_bytes())
    decoder = build(Settings())
    got = concatenate_blocks(
        [b for i in range(0, len(wire), 4096) for b in decoder.feed([Chunk(wire[i : i + 4096], i)])]
    )
    with np.load(folder / "vn100-serial" / "static-12min.npz") as known:
        expected = np.column_stack([known[axis] for axis in ("gx", "gy", "gz", "ax", "ay", "az")])
    assert len(got) == 30_178
    np.testing.assert_allclose(got.values, expected, rtol=1e-6, atol=1e-9)
    assert got.lost == decoder.bad == 0
