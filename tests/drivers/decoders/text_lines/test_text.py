"""Tests of the decoder for text lines: columns, units, line ends, bad lines and wrong settings."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from drivers import units
from drivers.data_types import (
    AXES,
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    Floats,
    SampleBlock,
    concatenate_blocks,
)
from drivers.decoders.text_lines.text import MAX_LINE_BYTES, Settings, build
from drivers.errors import ConfigError
from monitor.settings import loading
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


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([b"1,2,", b"3,4,5,6\n", LINE], [(2, 0)]),
        ([LINE, b"garbage", LINE, LINE], [(1, 0), (1, 1)]),
        ([LINE, b"1,2,#,", b"4,5,6\n", LINE], [(1, 0), (1, 1)]),  # the end of a damaged line is not read as a line
    ],
)
def test_end_of_a_datagram_does_not_end_a_line(parts: list[bytes], expected: list[tuple[int, int]]) -> None:
    decoder = build(Settings(columns=AXES, first_line="keep"))
    assert [(len(b), b.lost) for b in decoder.feed([Chunk(part, 77) for part in parts])] == expected


def test_recent_problem_describes_the_error_until_lines_are_good() -> None:
    decoder = build(Settings(columns=AXES))
    decoder.feed([Chunk(b"\n1,2,3\n", 0)])
    assert "3 columns, expected 6" in decoder.recent_problem
    assert decoder.recent_problem.endswith("; correct `columns`, or describe the line with `pattern`")
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


@pytest.mark.parametrize(
    ("configured", "step", "unit"),
    [("s", b"10", "ms"), ("ms", b"10000", "us"), ("us", b"10", "ms"), ("ms", b"0.01", "s")],
)
def test_wrong_time_unit_is_noticed_by_the_arrival_times(
    configured: Literal["s", "ms", "us"], step: bytes, unit: str
) -> None:
    """A board at 100 Hz. The lines that arrive after the check are rejected, and the problem names the key."""
    decoder = build(Settings(columns=("t", "gx"), time_unit=configured))
    blocks, step_count = [], float(step)
    for i in range(500):
        line = b"%r,0.1\n" % (12345.0 + i * step_count)
        blocks += decoder.feed([Chunk(line, i * 10_000_000)])
    assert sum(map(len, blocks)) <= 51
    assert decoder.bad >= 449
    assert f'set time_unit = "{unit}" (' in decoder.recent_problem


@pytest.mark.parametrize("speed", [0.5, 1.0, 30.0, 1e6])
def test_time_of_a_fast_replay_is_no_wrong_unit(speed: float) -> None:
    decoder = build(Settings(columns=("t", "gx")))
    lines = [b"%r,0.1\n" % (i * 0.01) for i in range(3000)]
    blocks = [b for i, line in enumerate(lines) for b in decoder.feed([Chunk(line, round(i * 1e7 / speed))])]
    assert sum(map(len, blocks)) == len(lines) - 1
    assert decoder.bad == 0


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


# --- labels of Arduino's Serial Plotter (arduino/Arduino, build/shared/ArduinoSerialPlotterProtocol.md)


@pytest.mark.parametrize(
    "line",
    [
        b"gx:1,gy:2,gz:3,ax:4,ay:5,az:6",
        b"gx:1\tgy:2\tgz:3\tax:4\tay:5\taz:6",
        b"gx:1 gy:2 gz:3 ax:4 ay:5 az:6",
        b"gx: 1 gy: 2 gz: 3 ax: 4 ay: 5 az: 6",
        b"Gyro X : 1, Gyro Y : 2, Gyro Z : 3, Accel X : 4, Accel Y : 5, Accel Z : 6",
        b"gyro:1,2,3,accel:4,5,6",
        b"1,2,gz:3,4,5,6",
    ],
)
def test_labels_in_front_of_numbers_are_ignored(line: bytes) -> None:
    assert decode_bytes((line + b"\r\n") * 3 + LINE).values.tolist() == [[1, 2, 3, 4, 5, 6]] * 4


@pytest.mark.parametrize(
    "line", [b"gy:1,gx:2,gz:3,ax:4,ay:5,az:6", b"gx:1,gy:2,0:3,4,5,6", b"gx:,gy:x,gz:3,4,5,6", b"gx:1 2 3 4 5 6 7"]
)
def test_line_with_wrong_labels_is_bad(line: bytes) -> None:
    assert decode_and_count(LINE + line + b"\n" + LINE) == [(1, 0), (1, 1)]


def test_label_in_a_field_of_its_own_can_be_skipped() -> None:
    for rest in (b"", b"IMU: 1 2\n"):  # a bad line in the same chunk makes no difference
        decoder = build(Settings(columns=("-", "gx", "gy", "gz"), first_line="keep"))
        (first, *_) = decoder.feed([Chunk(b"IMU: 1 2 3\n" + rest, 1)])
        assert first.values[0, :3].tolist() == [1, 2, 3]


# --- offset and presets


def test_offset_is_added_after_the_scale_and_before_the_unit() -> None:
    got = decode_bytes(
        b"-2000,180\n",
        columns=("temperature", "gx"),
        scale={"temperature": 1 / 340},
        offset={"temperature": 36.53, "gx": -90.0},
        gyro_unit="deg/s",
    )
    assert got.temperature_c[0] == pytest.approx(-2000 / 340 + 36.53)
    assert got.values[0, 0] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(("gyro_range", "gyro_counts"), [(250, 131.0), (500, 65.5), (1000, 32.8), (2000, 16.4)])
@pytest.mark.parametrize(("accelerometer_range", "accel_counts"), [(2, 16384), (4, 8192), (8, 4096), (16, 2048)])
def test_preset_of_the_mpu6050(
    gyro_range: int, gyro_counts: float, accelerometer_range: int, accel_counts: int
) -> None:
    """The lines are those of the sketch MPU6050_raw of jrowberg/i2cdevlib, and of sketches without its label."""
    settings = read_settings(
        Settings, {"preset": "mpu6050_raw", "gyro_range": gyro_range, "accelerometer_range": accelerometer_range}
    )
    row = np.array([131 * 2, 0, -131, 16384, -8192, 4096])
    for line in (b"a/g:\t16384\t-8192\t4096\t262\t0\t-131\r\n", b"16384 -8192 4096 262 0 -131\r\n"):
        (block,) = build(settings).feed([Chunk(b"\n" + line, 1)])
        factors = np.repeat([math.pi / 180 / gyro_counts, 9.80665 / accel_counts], 3)
        np.testing.assert_allclose(block.values[0], row * factors, rtol=1e-12)


def test_given_keys_take_precedence_over_a_preset() -> None:
    columns = ["ax", "ay", "az", "temperature", "gx", "gy", "gz"]  # order of the registers
    settings = read_settings(Settings, {"preset": "mpu6050_raw", "columns": columns, "gyro_unit": "mrad/s"})
    (block,) = build(settings).feed([Chunk(b"\n0,0,16384,-521,1,2,3\n", 1)])
    assert block.values[0].tolist() == pytest.approx([1e-3, 2e-3, 3e-3, 0, 0, 9.80665])
    assert block.temperature_c[0] == pytest.approx(-521 / 340 + 36.53)  # the formula of the register map, 35 °C


# --- patterns

MPU6050_PATTERN = (
    r"AcX = (?P<ax>\S+) \| AcY = (?P<ay>\S+) \| AcZ = (?P<az>\S+) \| Tmp = (?P<temperature>\S+) "
    r"\| GyX = (?P<gx>\S+) \| GyY = (?P<gy>\S+) \| GyZ = (?P<gz>\S+)"
)
"""Lines of the short example sketch of the MPU-6050 in the Arduino Playground."""


def decode_pattern(data: bytes, pattern: str, **settings: object) -> list[SampleBlock]:
    keys = {"pattern": pattern, "first_line": "keep", **settings}
    return build(read_settings(Settings, keys)).feed([Chunk(data, 77)])


def test_named_groups_of_a_pattern_are_the_columns() -> None:
    line = b"AcX = -1024 | AcY = 2048 | AcZ = 16384 | Tmp = 25.50 | GyX = 131 | GyY = -262 | GyZ = 0\r\n"
    blocks = decode_pattern(line * 2 + b"Calibrating...\r\n" + line, MPU6050_PATTERN, preset="mpu6050_raw", scale={
        "temperature": 1.0}, offset={"temperature": 0.0})  # fmt: skip
    assert [(len(b), b.lost) for b in blocks] == [(2, 0), (1, 1)]
    degree, count = math.pi / 180, 9.80665 / 16384
    for block in blocks:
        np.testing.assert_allclose(
            block.values, [[degree, -2 * degree, 0, -1024 * count, 2048 * count, 9.80665]] * len(block), atol=1e-15
        )
        assert block.temperature_c.tolist() == [25.5] * len(block)


def test_group_without_text_means_not_measured() -> None:
    (block,) = decode_pattern(b"g=1;a=\ng=2\n", r"g=(?P<gx>\d+)(;a=(?P<ax>\d*))?")
    assert block.values[:, 0].tolist() == [1, 2]
    assert np.isnan(block.values[:, 3]).all()


def test_clock_and_checksum_can_be_used_with_a_pattern() -> None:
    line = make_sentence(b"IMU t=12 g=1.5")
    (block,) = decode_pattern(line * 2, r"t=(?P<t>\d+) g=(?P<gx>\S+)", nmea=True, time_unit="ms")
    assert block.ticks.tolist() == [12_000_000] * 2


@pytest.mark.parametrize("pattern", [r"^(a+)+(?P<gx>\d)$", r"(?P<gx>.*.*.*.*.*.*)x", r"^(a|aa|aaa)*(?P<gx>b)$"])
def test_pattern_that_would_backtrack_needs_linear_time(pattern: str) -> None:
    """With exponential backtracking, 4096 characters would take longer than the time limit of the tests."""
    decoder = build(read_settings(Settings, {"pattern": pattern}))
    assert decoder.feed([Chunk(b"\n" + b"a" * MAX_LINE_BYTES + b"!\n" + b"a" * (MAX_LINE_BYTES - 1) + b"!\n", 1)]) == []
    assert decoder.bad == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "columns: missing; give columns"),
        ({"columns": ["gx"], "pattern": "(?P<gx>a)"}, "pattern: give either columns or pattern"),
        ({"pattern": "(?P<gx>a"}, "pattern: not a regular expression of RE2 .*missing"),
        ({"pattern": r"(?P<gx>a)\1"}, "not a regular expression of RE2"),
        ({"pattern": "(?P<gyro>a)"}, 'unknown column "gyro"'),
        ({"pattern": "(?P<t>a)"}, "none of gx, gy, gz, ax, ay, az is given"),
        ({"preset": "mpu6051"}, "mpu6050_raw"),
        ({"preset": "mpu6050_raw", "gyro_range": 300}, "gyro_range"),
        ({"columns": ["gx"], "offset": {"gw": 1.0}}, "gw"),
    ],
)
def test_wrong_pattern_preset_or_offset_is_refused(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        read_settings(Settings, settings)
    assert "\n" not in str(raised.value)


def test_pattern_cannot_be_encoded() -> None:
    with pytest.raises(ConfigError, match="use columns instead"):
        build(read_settings(Settings, {"pattern": "(?P<gx>a)"})).encode(decode_bytes(LINE))


def test_simulated_sensor_with_a_pattern_is_refused_by_check(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    driver = '{ link = "virtual", decoder = "text", decoder_options = { pattern = "(?P<gx>.)" } }'
    path.write_text(f'[[device]]\nname = "a"\ndriver = {driver}\n')
    (line,) = loading.examine_config_file(path).wrong
    assert line.endswith("a simulated sensor cannot write lines for a pattern; use columns instead")


def decode_live(values: Floats, rate_hz: float = 50.0, **settings: str) -> tuple[int, str]:
    """Return the number of samples of lines that arrive one by one, and the problem that the decoder reports."""
    decoder = build(Settings.model_validate({"columns": AXES, "first_line": "keep", **settings}))
    lines = [b",".join(b"%.6g" % x for x in row) + b"\n" for row in values]
    count = sum(len(b) for i, line in enumerate(lines) for b in decoder.feed([Chunk(line, int(i / rate_hz * 1e9))]))
    return count, decoder.recent_problem


def live_values(motion: str, seconds: float = 25.0, rate_hz: float = 50.0) -> Floats:
    """Return samples [n, 6] in rad/s and m/s² of a tilted sensor with noise and a bias of 1 °/s."""
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    values = np.random.default_rng(7).normal(size=(len(t), 6)) * np.repeat([math.radians(0.3), 0.05], 3)
    angle = np.full(len(t), 0.6)
    if motion == "tilting":
        angle = 0.6 + 0.5 * np.sin(t)
        values[:, 0] += 0.5 * np.cos(t)
    if motion == "fast rotation about the vertical":
        values[:, 1] += 30.0 * np.sin(angle)
        values[:, 2] += 30.0 * np.cos(angle)
    values[:, 0] += math.radians(1.0)
    values[:, 4] += 9.81 * np.sin(angle)
    values[:, 5] += 9.81 * np.cos(angle)
    if motion == "centrifuge at 100 g":
        values[:, 2] += 100.0
        values[:, 3:] = values[:, 3:] @ np.diag([1, 1, 0]) + [1000.0, 0.0, 9.81]
    if motion == "upside down":
        values[:, 3:] *= -1.0
    if motion == "braking vehicle":  # the direction of the specific force turns with the pitch, but 30 times as far
        values[:, 3] += 3.0 * np.sin(2.0 * t)
        values[:, 1] -= math.radians(1.2) * np.cos(2.0 * t)
    if motion == "tilted rate table":  # one turn per 3 samples about a horizontal axis
        values[:, 0] += math.tau * rate_hz / 3.0
        values[:, 3:] = 9.81 * np.column_stack(
            [0 * t, *(f(math.tau * np.arange(len(t)) / 3.0) for f in (np.sin, np.cos))]
        )
        values[:, 3:] += 0.01 * values[:, [1, 2, 1]]
    if motion == "flipped by hand":
        values[:, 3:] *= np.sign(np.sin(t))[:, np.newaxis]
    if motion == "without gravity":  # of a sensor that subtracts gravity, with a large bias
        values[:, 3:] = 0.005 * values[:, :3] + [0.6, 0.0, 0.8]
    return np.asarray(values)


POSSIBLE_MOTIONS = (
    "rest", "tilting", "upside down", "fast rotation about the vertical", "centrifuge at 100 g", "braking vehicle",
    "tilted rate table", "flipped by hand",
)  # fmt: skip


@pytest.mark.parametrize("motion", POSSIBLE_MOTIONS)
def test_possible_motions_never_cause_doubt_about_units(motion: str) -> None:
    values = live_values(motion)
    assert decode_live(values) == (len(values), "")


@pytest.mark.parametrize("motion", [*POSSIBLE_MOTIONS, "without gravity"])
@pytest.mark.parametrize(("gyro_unit", "accel_unit"), [("rad/s", "m/s²"), ("deg/s", "g"), ("deg/s/131", "g/16384")])
def test_possible_motions_never_cause_doubt_about_stated_units(motion: str, gyro_unit: str, accel_unit: str) -> None:
    values = live_values(motion) / np.repeat(
        [units.angular_rate_factor(gyro_unit), units.acceleration_factor(accel_unit)], 3
    )
    values = np.rint(values) if gyro_unit == "deg/s/131" else values
    assert decode_live(values, gyro_unit=gyro_unit, accel_unit=accel_unit) == (len(values), "")


@pytest.mark.parametrize(
    ("factors", "motion", "stated", "key"),
    [
        ((1.0, 1.0), "rest", ("rad/s", "g"), 'accel_unit = "m/s²"'),
        ((1.0, 1.0), "rest", ("deg/s", "g"), 'accel_unit = "m/s²"'),
        ((1.0, 1000 / 9.80665), "rest", ("rad/s", "g"), 'accel_unit = "mg"'),
        ((1.0, 1 / 9.80665), "tilting", ("rad/s", "m/s²"), 'accel_unit = "g"'),
        ((math.degrees(1), 1.0), "tilting", ("rad/s", "m/s²"), 'gyro_unit = "deg/s"'),
        ((131 * math.degrees(1), 1.0), "rest", ("deg/s", "m/s²"), 'gyro_unit = "deg/s/131"'),
        ((1.0, 16384 / 9.80665), "rest", ("rad/s", "g/8192"), 'accel_unit = "g/16384"'),
    ],
)
def test_lines_are_rejected_if_a_stated_unit_is_impossible(
    factors: tuple[float, float], motion: str, stated: tuple[str, str], key: str
) -> None:
    values = live_values(motion) * np.repeat(factors, 3)
    for triad, factor in ((slice(3), factors[0]), (slice(3, 6), factors[1])):
        values[:, triad] = np.rint(values[:, triad]) if factor > 105.0 else values[:, triad]
    count, problem = decode_live(values, gyro_unit=stated[0], accel_unit=stated[1])
    assert count < 1100
    assert key in problem


@pytest.mark.parametrize("order", [[0, 1], [0, 1, 2], [0, 1, 0, 1, 1, 0, 0, 1]])
def test_lines_of_several_sensors_on_one_wire_are_rejected(order: list[int]) -> None:
    sensors = [live_values("rest"), live_values("upside down"), live_values("rest")[:, [1, 2, 0, 5, 3, 4]]]
    which = np.resize(order, 1250)
    values = np.stack(sensors)[which, np.arange(1250)]
    count, problem = decode_live(values)
    assert count < 1100
    assert f"the samples of {max(order) + 1} sensors alternate" in problem
    assert "connect one sensor, or select its lines with `pattern`" in problem


def test_a_coarse_resolution_is_not_taken_for_two_sensors() -> None:
    values = live_values("rest")
    values[:, :3] = np.rint(values[:, :3] * 200.0) / 200.0
    values[:, 3:] = np.rint(values[:, 3:] * 10.0) / 10.0
    assert decode_live(values) == (len(values), "")


@pytest.mark.parametrize(
    ("factors", "motion", "key"),
    [
        ((math.degrees(1), 1.0), "rest", 'gyro_unit = "deg/s"'),
        ((math.degrees(1), 1.0), "tilting", 'gyro_unit = "deg/s"'),
        ((math.degrees(1), 1 / 9.80665), "rest", 'accel_unit = "g"'),
        ((1.0, 1 / 9.80665), "upside down", 'accel_unit = "g"'),
        ((1.0, 1000 / 9.80665), "rest", 'accel_unit = "mg"'),
        ((16.4 * math.degrees(1), 2048 / 9.80665), "rest", 'accel_unit = "g/2048"'),
    ],
)
def test_lines_are_rejected_if_a_default_unit_is_impossible(
    factors: tuple[float, float], motion: str, key: str
) -> None:
    values = live_values(motion) * np.repeat(factors, 3)
    values = np.rint(values) if max(factors) > 105.0 else values
    count, problem = decode_live(values)
    assert count < 1100
    assert key in problem


def test_aliased_rotation_causes_no_doubt() -> None:
    values = live_values("rest", 600.0, rate_hz=1.0)
    values[:, 0] += math.tau  # one turn per sample about a horizontal axis
    assert decode_live(values, 1.0) == (len(values), "")
