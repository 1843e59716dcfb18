"""CSV files of other programs: recognized layouts, options for columns and units, separators, and mistakes."""

import contextlib
import tracemalloc
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

import imu_monitor
from drivers.data_types import AXES, Floats, Times, concatenate_blocks
from drivers.decoders.messages import samples
from drivers.errors import ConfigError, ImuError, LinkEnded
from drivers.links import replay_link
from drivers.recordings import Recording, load_samples, save_samples
from drivers.recordings.file_formats.csv_format import CsvSource, read_csv_source
from drivers.recordings.reading_options import DEFAULT_OPTIONS, create_reading_options, parse_column_mapping
from drivers.recordings.table_layout import parse_column_name
from drivers.units import DEGREE, G0
from drivers.validation.settings_model import check_table
from monitor.commands.analyze import analyze_recording
from tests.support.recordings import recordings

N = 4000
START_NS = 1_403_636_579_758_555_392


def noise(seed: int = 1) -> Floats:
    """Return samples [N, 6] of a sensor at rest with z upwards, rad/s and m/s²."""
    values = np.random.default_rng(seed).normal(size=(N, 6)) * [1e-3] * 6
    values[:, 5] += G0
    return values


def read(path: Path, text: str | bytes, rate_hz: float | None = None, **options: Any) -> Recording:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    if isinstance(options.get("columns"), str):
        options["columns"] = parse_column_mapping(options["columns"])
    return load_samples(path, rate_hz, options=create_reading_options(options))


def refusal(path: Path, text: str, **options: Any) -> str:
    with pytest.raises(ImuError) as error:
        read(path, text, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def lines(header: str, *columns: Any, separator: str = ",", comma: bool = False) -> str:
    rows = (separator.join(map(repr, row)) for row in zip(*(np.asarray(c).tolist() for c in columns), strict=True))
    body = "\n".join(rows)
    return f"{header}\n{body.replace('.', ',') if comma else body}\n"


def require_same_analysis(found: Recording, times: Times, values: Floats, tmp_path: Path) -> None:
    """Require that a recording is bit by bit that of an .npz file with the samples, and has the same analysis."""
    measured = [AXES.index(axis) for axis in found.axes]
    path = tmp_path / "same.npz"
    name = "t" if times.dtype == np.float64 else "t_ns"
    np.savez(path, **{name: times}, **{axis: values[:, AXES.index(axis)] for axis in found.axes})
    same = load_samples(path)
    assert found.times is not None
    assert same.times is not None
    assert found.times.dtype == same.times.dtype == times.dtype
    assert found.times.tobytes() == same.times.tobytes() == times.tobytes()
    assert found.values[:, measured].tobytes() == same.values[:, measured].tobytes()
    first, second = (analyze_recording(one, "octave").analysis.estimate for one in (found, same))
    assert np.array_equal(first.coefficients.value, second.coefficients.value, equal_nan=True)
    assert np.array_equal(first.curve.avar, second.curve.avar, equal_nan=True)


ASL_HEADER = "#timestamp [ns]," + ",".join(
    [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
)


class TestLayouts:
    """Layouts as published; the sources are named in ``drivers/recordings/table_layout.py``."""

    def test_euroc_and_tum_vi(self, tmp_path: Path) -> None:
        t_ns, values = START_NS + 5_000_064 * np.arange(N), noise()
        found = read(tmp_path / "data.csv", lines(ASL_HEADER, t_ns, *values.T))
        assert found.notes == ()
        require_same_analysis(found, t_ns, values, tmp_path)

    @pytest.mark.parametrize(("separator", "comma"), [(",", False), ("\t", False), (";", True), ("\t", True)])
    def test_phyphox(self, tmp_path: Path, separator: str, comma: bool) -> None:
        names = ["Time (s)", *(f"Gyroscope {axis} (rad/s)" for axis in "xyz"), "Absolute (rad/s)"]
        t_s, values = np.arange(N) / 100.0, noise()
        header = separator.join(f'"{name}"' for name in names)
        text = lines(header, t_s, *values.T[:3], t_s, separator=separator, comma=comma)
        found = read(tmp_path / "Raw Data.csv", text)
        assert found.notes == ("Other columns are not used: Absolute (rad/s).",)
        require_same_analysis(found, t_s, values, tmp_path)

    @pytest.mark.parametrize(("name", "axes"), [("Gyroscope", AXES[:3]), ("TotalAcceleration", AXES[3:])])
    def test_one_file_of_sensor_logger(self, tmp_path: Path, name: str, axes: tuple[str, ...]) -> None:
        t_s, values = np.arange(N) / 100.0, noise()
        of_axes = values.T[:3] if name == "Gyroscope" else values.T[3:]
        text = lines("time,seconds_elapsed,z,y,x", START_NS + 10**7 * np.arange(N), t_s, *of_axes[::-1])
        found = read(tmp_path / f"{name}.csv", text)
        assert found.axes == axes
        require_same_analysis(found, t_s, values, tmp_path)

    def test_betaflight_without_units(self, tmp_path: Path) -> None:
        header = (
            "loopIteration, time (us), axisP[0], gyroADC[0], gyroADC[1], gyroADC[2], accSmooth[0], accSmooth[1], "
            "accSmooth[2], flightModeFlags (flags)"
        )
        rng = np.random.default_rng(1)
        t_us, counts = 55_158_008 + 500 * np.arange(N), rng.integers(-9, 9, (N, 6)) + np.array([0, 0, 0, 0, 0, 2048])
        text = "".join(
            f"{i}, {t}, 3, {', '.join(map(str, row))}, ANGLE_MODE|ARM\n"
            for i, (t, row) in enumerate(zip(t_us.tolist(), counts.tolist(), strict=True))
        )
        found = read(tmp_path / "LOG00007.01.csv", f"{header}\n{text}")
        assert any("gyroADC is read in deg/s and accSmooth in g/2048" in note for note in found.notes)
        values = counts * np.repeat([DEGREE, G0 / 2048], 3)
        require_same_analysis(found, 1000 * t_us, values, tmp_path)
        given = read(tmp_path / "y.csv", f"{header}\n{text}", gyro_unit="deg/s/10", accel_unit="g/4096")
        assert not any("Betaflight" in note for note in given.notes)
        assert np.allclose(given.values, values / [10, 10, 10, 2, 2, 2], rtol=1e-15)

    def test_betaflight_with_units(self, tmp_path: Path) -> None:
        text = "loopIteration, time (s), gyroADC[0] (deg/s), accSmooth[2] (g)\n1, 0.5, 180.0, 1.0\n"
        found = read(tmp_path / "x.csv", text)
        assert found.values[0, [0, 5]].tolist() == [np.pi, G0]
        assert found.notes == ("Other columns are not used: loopIteration.",)

    def test_androsensor(self, tmp_path: Path) -> None:
        names = [f"{sensor} {axis} (m/s²)" for sensor in ("ACCELEROMETER", "LINEAR ACCELERATION") for axis in "XYZ"]
        names += [*(f"GYROSCOPE {axis} (rad/s)" for axis in "XYZ"), "TIME SINCE START (ms)", "YYYY-MO-DD HH-MI-SS_SSS"]
        row = "0.1;0.2;9.8;0.0;0.0;0.0;0.01;0.02;0.03;1250;2018-04-04 21:39:36:123"
        found = read(tmp_path / "x.csv", f"sep=;\n{';'.join(names)}\n{row}\n".encode("cp1252"))
        assert found.values[0].tolist() == [0.01, 0.02, 0.03, 0.1, 0.2, 9.8]
        assert found.t_s is not None
        assert found.t_s.tolist() == [1.25]

    def test_rostopic_echo(self, tmp_path: Path) -> None:
        header = "%time,field.header.seq,field.header.stamp,field.angular_velocity.x,field.linear_acceleration.z"
        found = read(tmp_path / "x.csv", f"{header}\n5,1,1400000000000000000,0.1,9.8\n", time_unit="ns")
        assert found.values[0, [0, 5]].tolist() == [0.1, 9.8]
        assert found.t_s is not None
        assert found.t_s.tolist() == [1.4e9]

    def test_real_recording_with_its_temperature(self, tmp_path: Path) -> None:
        path = recordings() / "lego-hub-temp" / "hub-RB.csv"
        found = load_samples(path)
        header, _, rest = path.read_text().partition("\n")
        renamed = {"gx": "gyro_x (rad/s)", "gy": "wy [rad s^-1]", "gz": "omega_z", "t": "time_s", "temp": "Temp [°C]"}
        other = ";".join(renamed.get(name, name) for name in header.split(","))
        same = read(tmp_path / "x.csv", f"{other}\n{rest.replace(',', ';').replace('.', ',')}")
        assert same.values.tobytes() == found.values.tobytes()
        assert same.temperature_c.tobytes() == found.temperature_c.tobytes()


@pytest.mark.parametrize(
    ("name", "quantity", "unit"),
    [
        ("gyro_x [deg/s]", "gx", "deg/s"),
        ("wx (rad/s)", "gx", "rad/s"),
        ("acc_x_g", "ax", "g"),
        ("GyroZ_dps", "gz", "dps"),
        ("accel_y_m_s2", "ay", "m/s²"),
        ("AccX", "ax", None),
        ("imu.angular_velocity.z", "gz", None),
        ("gyroADC[2]", "gz", None),
        ("timestamp_ns", "t", "ns"),
        ("Time since start in ms ", "t", "ms"),
        ("temp_c", "temperature", "°C"),
        ("Temperature (K)", "temperature", "K"),
        ("gyro_deg_s_x", "gx", "deg/s"),
        ("accel_m_s2_z", "az", "m/s²"),
        ("X_GYRO_OUT", "gx", None),
        ("RollRate (deg/s)", "gx", "deg/s"),
        ("yaw_rate", "gz", None),
        ("linacc_y", "ay", None),
        ("GForceZ (g)", "az", "g"),
        ("AsX(°/s)", "gx", "°/s"),
    ],
)
def test_column_names(name: str, quantity: str, unit: str | None) -> None:
    found = parse_column_name(name)
    assert found is not None
    assert (found.quantity, found.unit) == (quantity, unit)


def test_position_names_the_sensor() -> None:
    found = parse_column_name("gyro_x_left")
    assert found is not None
    assert (found.quantity, found.unit, found.sensor) == ("gx", None, "left")


@pytest.mark.parametrize(
    "name",
    [
        "mx",
        "T",
        "mag_x",
        "roll_rate_setpoint",
        "yaw_rate_bias",
        "gx_raw",
        "x",
        "roll_deg",
        "q",
        "",
        "speed",
        "max",
        "gyro_x_std",
        "acc_bias_x",
    ],
)
def test_other_column_names(name: str) -> None:
    assert parse_column_name(name) is None


class TestOptions:
    TEXT = "stamp,omega_x,q,T\n0,180,1,300\n1000,90,2,301\n"

    def test_columns_by_name_and_number_with_units(self, tmp_path: Path) -> None:
        found = read(
            tmp_path / "x.csv", self.TEXT, columns="gx=omega_x,ax=3,temperature=T", gyro_unit="deg/s", accel_unit="g",
            temperature_unit="K", time_unit="ms",
        )  # fmt: skip
        assert found.axes == ("gx", "ax")
        assert found.values[:, 0].tolist() == [180 * DEGREE, 90 * DEGREE]
        assert found.values[:, 3].tolist() == [G0, 2 * G0]
        assert found.temperature_c == pytest.approx([26.85, 27.85])
        assert found.t_s is not None
        assert found.t_s.tolist() == [0.0, 1.0]

    def test_a_name_without_its_unit(self, tmp_path: Path) -> None:
        found = read(tmp_path / "x.csv", "time,yaw rate [deg/s]\n0,180\n", columns="gz=yaw rate")
        assert found.values[0, 2] == 180 * DEGREE

    def test_numbers_for_a_file_without_header(self, tmp_path: Path) -> None:
        text = "# a remark\n1.0 2.5  3\n2.0 3.5  4\n"
        found = read(tmp_path / "x.csv", text, columns="gx=2,t=1")
        assert found.values[:, 0].tolist() == [2.5, 3.5]
        assert found.t_s is not None
        assert found.t_s.tolist() == [1.0, 2.0]

    def test_a_comment_with_as_many_names_as_columns_is_the_header(self, tmp_path: Path) -> None:
        found = read(tmp_path / "x.csv", "# stamp, rate, q\n1,2,3\n", columns="gx=rate")
        assert found.values[0, 0] == 2.0

    def test_a_quantity_can_be_left_out(self, tmp_path: Path) -> None:
        text = "timestamp,gx\n2024-01-01 10:00:00,1\n2024-01-01 10:00:01,2\n"
        found = read(tmp_path / "x.csv", text, 100.0, columns="t=-")
        assert found.t_s is None
        assert found.values[:, 0].tolist() == [1.0, 2.0]

    def test_an_option_precedes_the_unit_in_the_file(self, tmp_path: Path) -> None:
        found = read(tmp_path / "x.csv", "t,gx [deg/s]\n0,2\n", gyro_unit="rad/s")
        assert found.values[0, 0] == 2.0
        assert found.notes == ("The file states deg/s; the requested rad/s is used.",)

    @pytest.mark.parametrize("suffix", [".npz", ".parquet", ".arrow"])
    def test_other_tables_have_the_same_options(self, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"x{suffix}"
        columns = {"stamp": np.array([0.0, 10.0]), "omega": np.array([180.0, 90.0])}
        if suffix == ".npz":
            np.savez(path, **columns)
        else:
            pa = pytest.importorskip("pyarrow")
            from pyarrow import feather, parquet

            table = pa.table(columns)
            parquet.write_table(table, path) if suffix == ".parquet" else feather.write_feather(
                table, str(path), compression="uncompressed"
            )
        options = create_reading_options({"columns": {"gx": "omega"}, "gyro_unit": "deg/s", "time_unit": "ms"})
        found = load_samples(path, options=options)
        assert found.values[:, 0].tolist() == [180 * DEGREE, 90 * DEGREE]
        assert found.t_s is not None
        assert found.t_s.tolist() == [0.0, 0.01]

    def test_numbers_that_overflow_in_si_units_are_missing(self, tmp_path: Path) -> None:
        found = read(tmp_path / "x.csv", "t,ax [g]\n0,1e308\n1,1\n")
        assert np.array_equal(found.values[:, 3], [np.nan, G0], equal_nan=True)

    def test_the_python_interface_has_the_same_arguments(self, tmp_path: Path) -> None:
        path = tmp_path / "x.csv"
        path.write_text(self.TEXT)
        found = imu_monitor.read_recording(path, columns={"gx": 2}, gyro_unit="deg/s", time_unit="ms")
        assert found["gx"].tolist() == [180 * DEGREE, 90 * DEGREE]
        with pytest.raises(ConfigError, match='gyro_unit: "grad/s" is not a unit of angular rate'):
            imu_monitor.read_recording(path, gyro_unit="grad/s")
        with pytest.raises(ConfigError, match=r"columns gx=7: there is no column 7"):
            imu_monitor.read_recording(path, columns={"gx": 7})


class TestSeparators:
    @pytest.mark.parametrize(
        "text",
        [
            "t;gx\n0,5;1,5\n1,0;2,5\n",
            "t;gx;\n0.5;1,5;\n1;2.5;\n",
            "t\tgx\n0,5\t1,5\n1\t2,5\n",
            "t gx\n0.5  1.5\n 1 2.5 \n",
            "# t gx\n0.5 1.5\n1 2.5\n",
            "t,gx\n0.5,1.5\n# remark\n\n1,2.5\n",
            '"t";"gx"\n"0,5";"1,5"\n"1";"2,5"\n',
            "sep=;\nt;gx\n0,5;1,5\n1;2,5\n",
            "t;gx\r\n% remark\r\n0,5;1,5\r\n1;2,5\r\n",
        ],
    )
    def test_every_separator(self, tmp_path: Path, text: str) -> None:
        found = read(tmp_path / "x.csv", text)
        assert found.t_s is not None
        assert found.t_s.tolist() == [0.5, 1.0]
        assert found.values[:, 0].tolist() == [1.5, 2.5]
        assert found.notes == ()

    def test_a_header_longer_than_one_piece_of_text(self, tmp_path: Path) -> None:
        remarks = "# remark\n" * 150_000  # more than one piece between header and samples
        found = read(tmp_path / "x.csv", f"t;gx\n{remarks}0,5;1,5\nx;1\n")
        assert found.values[:, 0].tolist() == [1.5]
        assert "(line 150003: t is 'x')" in found.notes[0]


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("time,omega_r\n0,1\n", {"columns": "gx=omga_r"}, '--columns gx=omga_r: there is no column "omga_r"; did you '),
        ("time,gx\n0,1\n", {"columns": "gx=5"}, "there is no column 5; the file has 2 columns"),
        ("time,gx\n0,1\n", {"columns": "gx=2,gy=2"}, "column 2 (gx) is given for gx and gy"),
        ("time,q\n0,1\n", {"columns": "gq=2"}, '--columns: "gq"; possible are g'),
        ("time,q\n0,1\n", {"columns": "gx"}, '"gx": expected QUANTITY=COLUMN, such as gx=omega_x'),
        ("time,q\n0,1\n", {"columns": "gx=q,gx=q"}, "gx is given twice"),
        ("time,q,q\n0,1,1\n", {"columns": "gx=q"}, "2 columns have this name; give a number"),
        (
            "time,gx\n0,1\n",
            {"gyro_unit": "grad/s"},
            '--gyro-unit: "grad/s" is not a unit of angular rate; possible',
        ),
        ("time,gx\n0,1\n", {"topic": "/imu"}, "no topics; leave out the topic /imu"),
        ("time,gx [grad/s]\n0,1\n", {}, 'column of gx: "grad/s" is not a unit of angular rate; possible are'),
        ("time,gyro_x_furlong\n0,1\n", {}, '"furlong" is not a unit of angular rate'),
        ("time,gyro_x,gyr_x\n0,1,2\n", {}, "2 columns fit gx: gyro_x, gyr_x; choose one, such as --columns gx=gyro_x"),
        ("time,stamp,gx\n0,1,2\n", {}, "2 columns fit t: time, stamp; choose one"),
        ("time,omega_r\n0,1\n", {}, "x.csv --columns gx=omega_r"),
        ("1,2\n2,3\n", {"columns": "gx=q"}, "header line is missing: line 1 consists of numbers"),
        (
            "t,gx\n0 1\n",
            {},
            "mixed separators: the fields of line 1 are separated by commas, those of the",
        ),
        (
            "t gx\n0, 1\n",
            {},
            "mixed separators: the fields of line 1 are separated by blanks, those of the",
        ),
        ("# log\nt;gx\n0,1\n", {}, "mixed separators: the fields of line 2 are separated by semicolons"),
        ("t,gx,gy\n0,1,5,2,5\n", {}, "decimal commas cannot be told from the commas between the fields"),
        ("0,1 1,5\n0,2 1,6\n", {"columns": "gx=2"}, "line 1 has commas and blanks, and either can be the separator"),
        ("t;gx\n0;1.234,5\n", {}, "1 of 1 lines are not samples (line 2: gx is '1.234,5')"),
        ("t,gx\n0,x\n1,y\n", {}, "2 of 2 lines are not samples (line 2: gx is 'x')"),
        ("stamp,gx\n1400000000000,1\n1400000000010,1\n", {}, "they fit Unix times in ms: give --time-unit ms"),
    ],
)
def test_each_mistake_is_one_line(tmp_path: Path, text: str, options: dict[str, Any], message: str) -> None:
    assert message in refusal(tmp_path / "x.csv", text, **options)


def test_logs_have_no_columns_to_choose(tmp_path: Path) -> None:
    (tmp_path / "x.ulg").write_bytes(b"ULog\x01\x12\x35")
    with pytest.raises(ConfigError, match="determine columns and times; leave out --columns"):
        load_samples(tmp_path / "x.ulg", options=create_reading_options({"columns": {"gx": 1}}))
    with pytest.raises(ConfigError, match="determine columns and times; leave out --time-unit"):
        load_samples(tmp_path / "x.ulg", options=create_reading_options({"time_unit": "ms"}))


def test_the_replay_has_the_same_keys(tmp_path: Path) -> None:
    values = noise()
    (tmp_path / "x.csv").write_text(lines("stamp omega", 10 * np.arange(N), values[:, 0] / DEGREE, separator=" "))
    keys = {"path": str(tmp_path / "x.csv"), "speed": "max", "columns": {"gx": "omega", "t": 1}}
    units = {"gyro_unit": "deg/s", "time_unit": "ms"}
    link = replay_link.build(replay_link.Settings.model_validate({**keys, **units}))
    chunks = []
    with contextlib.closing(link), contextlib.suppress(LinkEnded):
        link.open()
        while True:
            chunks += link.wait_for_chunks_or_timeout(0.1) or []
    got = concatenate_blocks(samples.build(samples.Settings()).feed(chunks))
    np.testing.assert_allclose(got.values[:, 0], values[:, 0], rtol=1e-15)
    assert got.t_ns.tolist() == (10_000_000 * np.arange(N)).tolist()
    wrong = check_table(replay_link.Settings, {**keys, "gyro_unit": "grad/s", "columns": {"gx": True}}).problems
    assert [problem.key_path for problem in wrong] == ["columns.gx", "gyro_unit"]


def test_memory_does_not_grow_with_the_text(tmp_path: Path) -> None:
    """Reading keeps the samples, and the text only piece by piece."""
    t_s, values = np.arange(N) / 100.0, noise()
    body = lines("", t_s, *values.T, separator=";", comma=True).partition("\n")[2]
    path = tmp_path / "x.csv"
    path.write_text("t;gx;gy;gz;ax;ay;az\n" + body * 20)  # 10 MB

    tracemalloc.start()
    load_samples(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    rows = 20 * N
    assert path.stat().st_size > 9e6
    assert peak < 4 * 8 * 8 * rows + 6e6  # copies of the samples, and pieces of 1 MiB


def test_rows_that_a_logger_appends_meanwhile_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    rows = lines("t,gx", np.arange(N) / 100.0, noise()[:, 0])
    path.write_text(rows)

    def open_and_append() -> IO[bytes]:
        opened = path.open("rb")
        with path.open("a") as file:
            file.write(rows.partition("\n")[2])
        return opened

    found = read_csv_source(CsvSource(path, str(path), "", open_and_append), DEFAULT_OPTIONS)
    np.testing.assert_allclose(found.columns["gx"][:N], noise()[:, 0])
    assert N <= found.columns["gx"].size <= 2 * N + 1


def test_own_header_is_unchanged(tmp_path: Path) -> None:
    save_samples(tmp_path / "x.csv", np.arange(N) / 100.0, noise())
    found = load_samples(tmp_path / "x.csv")
    assert found.values.tobytes() == noise().tobytes()
    assert found.notes == ()
