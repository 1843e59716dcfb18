"""Tests of the decoder for text lines: columns, units, line ends, bad lines and wrong settings."""

import math

import numpy as np
import pytest

from drivers.data_types import AXES, ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, concatenate_blocks
from drivers.decoders.text_lines.text import MAX_LINE_BYTES, Settings, build
from drivers.errors import ConfigError
from tests.support.nmea_sentences import make_sentence
from tests.support.settings import read_settings

LINE = b"1,2,3,4,5,6\n"


def decode_and_count(data: bytes, **settings: object) -> list[tuple[int, int]]:
    """Return the number of rows and of lost samples before them, for each block."""
    decoder = build(Settings(**{"columns": AXES, "first_line": "keep", **settings}))
    return [(len(b), b.lost) for b in decoder.feed([Chunk(data, 77)])]


def decode_bytes(data: bytes, **settings: object) -> SampleBlock:
    decoder = build(Settings(**{"columns": AXES, "first_line": "keep", **settings}))
    return concatenate_blocks(decoder.feed([Chunk(data, 77)]))


@pytest.mark.parametrize(
    "line",
    [
        b"1,2,3,4,5,6",
        b"1;2;3;4;5;6",
        b"1\t2\t3\t4\t5\t6",
        b" 1  2 3 4 5 6 ",
        b"1, 2, 3, 4, 5, 6",
        b"1e0,+2,3.,4.0,5,6",
    ],
)
@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n", b"\n\n"])
def test_all_delimiters_and_line_ends_are_decoded(line: bytes, end: bytes) -> None:
    got = decode_bytes((line + end) * 3)
    assert got.values.tolist() == [[1, 2, 3, 4, 5, 6]] * 3
    assert got.lost == 0


def test_delimiter_can_be_configured() -> None:
    assert decode_bytes(b"1|2|3|4|5|6\n", delimiter="|").values.tolist() == [[1, 2, 3, 4, 5, 6]]
    assert decode_bytes(b"1 2   3 4 5 6\n", delimiter=" ").values.tolist() == [[1, 2, 3, 4, 5, 6]]
    assert decode_and_count(LINE + b"1,2|3|4|5|6\n" + LINE, delimiter="|") == []


def test_columns_units_and_scale_are_applied() -> None:
    got = decode_bytes(
        b"IMU:,1000,180,77,2,298.15\n",
        columns=("-", "az", "gz", "-", "gx", "temperature"),
        gyro_unit="deg/s",
        accel_unit="mg",
        temperature_unit="K",
        scale={"gx": 90.0},
    )
    np.testing.assert_allclose(got.values[0, [0, 2, 5]], [math.pi, math.pi, 9.80665])
    assert np.isnan(got.values[0, [1, 3, 4]]).all()
    assert got.temperature_c[0] == pytest.approx(25.0)


def test_nan_and_empty_columns_become_nan() -> None:
    got = decode_bytes(b"1,nan,,NaN,5, \n" + LINE)
    np.testing.assert_array_equal(got.values[0], [1, np.nan, np.nan, np.nan, 5, np.nan])
    assert got.values[1].tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    "line",
    [
        b"1,2,3,4,5",
        b"1,2,3,4,5,6,7",
        b"1,2,3,4,5,x",
        b"1,2,3,4,5,1_0",
        b"1,2,3,4,5,inf",
        b"1,2,3,4,5,1e9",
        b"1,2,3,4,5,\xff\xfe",
        b"\xc3\x28\x00",
        b"nan,nan,nan,,,",
        b"0x10,2,3,4,5,6",
        b"1 2 3 4 5",
    ],
)
def test_unreadable_line_is_bad_and_counts_as_lost(line: bytes) -> None:
    decoder = build(Settings(columns=AXES, first_line="keep"))
    blocks = decoder.feed([Chunk(LINE * 2 + line + b"\r\n" + LINE * 2, 0)])
    assert [(len(b), b.lost) for b in blocks] == [(2, 0), (2, 1)]
    assert all(b.values.tolist() == [[1, 2, 3, 4, 5, 6]] * 2 for b in blocks)
    assert decoder.bad == 1


def test_recent_problem_describes_the_error_until_lines_are_good() -> None:
    decoder = build(Settings(columns=AXES))
    decoder.feed([Chunk(b"\n1,2,3\n", 0)])
    assert "3 columns, expected 6" in decoder.recent_problem
    decoder.feed([Chunk(b"1,2,3,4,5,gyro\n", 0)])
    assert "not a number" in decoder.recent_problem
    decoder.feed([Chunk(LINE * 1000, 0)])
    assert decoder.recent_problem == ""


def test_first_line_is_dropped_unless_it_is_complete() -> None:
    assert decode_and_count(LINE * 3, first_line="drop") == [(2, 0)]
    assert decode_and_count(LINE * 3, first_line="keep") == [(3, 0)]
    assert decode_and_count(b"\n" + LINE * 3, first_line="drop") == [(3, 0)]
    assert decode_and_count(b"3,4,5\n" + LINE * 3, first_line="keep") == [(3, 0)]
    decoder = build(Settings(columns=AXES))
    decoder.feed([Chunk(b"5,6\n" + LINE, 0)])
    assert decoder.bad == 0
    decoder.forget_stream_state()
    assert decoder.feed([Chunk(LINE, 0)]) == []
    assert decoder.bad == 0


def test_header_and_comments_are_ignored() -> None:
    head = b"# made by a board\r\ngx,gy,gz,ax,ay,az\r\n"
    assert decode_and_count(head + LINE + b"#\n" + LINE, header=1) == [(2, 0)]
    assert decode_and_count(b"\n% note\n" + LINE, comment="%") == [(1, 0)]
    assert decode_and_count(b"\n# note\n" + LINE, comment="") == [(1, 1)]


def test_overlong_line_counts_as_one_bad_line() -> None:
    decoder = build(Settings(columns=AXES, first_line="keep"))
    feeds = [LINE, *[b"7" * 1000] * (3 * MAX_LINE_BYTES // 1000), b"\n", LINE]
    blocks = [b for data in feeds for b in decoder.feed([Chunk(data, 0)])]
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]
    assert "line end" in decoder.recent_problem
    assert decode_and_count(LINE + b"7" * (MAX_LINE_BYTES + 1) + b"\n" + LINE) == [(1, 0), (1, 1)]


def test_sentence_with_wrong_nmea_checksum_is_bad() -> None:
    good = make_sentence(b"1,2,3,4,5,6")
    assert decode_and_count(good * 3, nmea=True, first_line="drop") == [(3, 0)]
    assert decode_and_count(good[5:] + good * 2, nmea=True) == [(2, 0)]
    assert decode_and_count(good + good.lower() + b"noise" + good, nmea=True) == [(3, 0)]
    for wrong in (good.replace(b"3", b"4", 1), b"1,2,3,4,5,6\n", good.replace(b"*", b"+"), b"$*00\n"):
        assert decode_and_count(good + wrong + good, nmea=True) == [(1, 0), (1, 1)]


@pytest.mark.parametrize(
    ("unit", "text", "ticks", "modulus"),
    [
        ("s", b"1.25", 1_250_000_000, 2**62),
        ("ms", b"1234.5", 1_234_500_000, 2**32 * 1_000_000),
        ("us", b"4294967295", 4_294_967_295_000, 2**32 * 1000),
        ("ns", b"17", 17, 2**62),
    ],
)
def test_time_column_gives_ticks(unit: str, text: bytes, ticks: int, modulus: int) -> None:
    settings = {"columns": ("t", *AXES), "time_unit": unit}
    assert decode_bytes(text + b"," + LINE, **settings).ticks.tolist() == [ticks]
    assert build(Settings(**settings)).timing == CounterTimedFormat(modulus, 1e-9)


def test_counter_column_gives_ticks() -> None:
    settings = {"columns": (*AXES, "counter"), "counter_modulus": 100}
    got = decode_bytes(b"1,2,3,4,5,6,99\n1,2,3,4,5,6,0\n", **settings)
    assert got.ticks.tolist() == [99, 0]
    assert build(Settings(**settings)).timing == CounterTimedFormat(100)
    assert build(Settings(columns=AXES)).timing == ArrivalTimedFormat()
    assert decode_and_count(b"1,2,3,4,5,6,1\n1,2,3,4,5,6,nan\n1,2,3,4,5,6,3\n", **settings) == [(1, 0), (1, 1)]


@pytest.mark.parametrize(
    ("settings", "expected_parts"),
    [
        ({"gyro_unit": "deg/sek"}, ('"deg/sek"', "deg/s")),
        ({"gyro_unit": "LSB"}, ("gyro_unit: ", "rad/s, ", "deg/s", "for raw counts", "scale = { gx = 0.0305 }")),
        ({"accel_unit": "counts"}, ("accel_unit: ", "m/s², ", "for raw counts", "scale = { ax = 0.0305 }")),
        ({"accel_unit": "furlong"}, ('"furlong"', "m/s²", "mg")),
        ({"columns": (*AXES, "temperature"), "temperature_unit": "Re"}, ('"Re"', "°C")),
        ({"columns": ("gx", "temprature")}, ('"temprature"', "possible are temperature, ")),
        ({"columns": ("gx", "gx")}, ("twice",)),
        ({"columns": ("-", "temperature")}, ("gx", "az")),
        ({"columns": ("gx", "t", "counter")}, ("one of t and counter",)),
        ({"scale": {"gw": 2.0}}, ("scale.gw", "possible are gx, ")),
        ({"scale": {"gx": 0.0}}, ("gx", "0")),
        ({"delimiter": ""}, ("delimiter",)),
        ({"counter_modulus": 1}, ("counter_modulus",)),
    ],
)
def test_error_for_wrong_settings_names_valid_values(
    settings: dict[str, object], expected_parts: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigError) as caught:
        build(read_settings(Settings, {"columns": AXES, **settings}))
    assert all(part in str(caught.value) for part in expected_parts), caught.value
    assert "\n" not in str(caught.value)


def test_all_wrong_settings_are_reported() -> None:
    settings = {"columns": ["gx", "gx", "qz"], "gyro_unit": "LSB", "scale": {"gw": 1.0, "gx": 0.0}, "delimiter": ""}
    with pytest.raises(ConfigError) as caught:
        read_settings(Settings, settings)
    keys = [line.partition(": ")[0] for line in caught.value.mistake_lines]
    assert sorted(keys) == ["columns", "columns", "delimiter", "gyro_unit", "scale.gw", "scale.gx"]
