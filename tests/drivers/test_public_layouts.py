"""Every public layout is read rightly, or is refused with a message whose advice leads to the right samples."""

import re
import shlex
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drivers.data_types import AXES
from drivers.errors import ImuError, UnknownColumnsError
from drivers.recordings import Recording
from drivers.recordings.reading_options import create_reading_options, parse_column_mapping
from monitor.commands.recording_loading import LoadingOptions, load_recording
from tests.drivers.public_layouts import LAYOUTS, Layout, Sensor, interleave, join_fields, simulate_sensor, table

OPTION = re.compile(r"--([a-z-]+)((?: (?!--)[^\s]+)?)")


def read(path: Path, options: dict[str, str]) -> Recording:
    """Read a file as ``imu-monitor analyze`` does."""
    values: dict[str, object] = {key.replace("-", "_"): value for key, value in options.items() if key != "rate"}
    if "columns" in options:
        values["columns"] = parse_column_mapping(options["columns"])
    rate_hz = float(options["rate"]) if "rate" in options else None
    return load_recording(path, LoadingOptions(rate_hz, reading=create_reading_options(values)))


def read_by_messages(layout: Layout, path: Path) -> tuple[Recording, dict[str, str]]:
    """Read a file with the options that the messages ask for."""
    known = {name: value.strip() for name, value in OPTION.findall(layout.options)}
    options: dict[str, str] = {}
    for _ in range(4):
        try:
            return read(path, options), options
        except ImuError as error:
            message = str(error)
            if isinstance(error, UnknownColumnsError):
                assert "imu-monitor analyze" in message
        assert str(path) in message
        command = dict(OPTION.findall(message.partition("imu-monitor analyze ")[2]))
        asked = [name for name in known if f"--{name}" in message and name not in options]
        assert asked, message
        for name in asked:
            options[name] = known[name] or command[name].strip().replace("HZ", f"{layout.rate_hz:g}")
        if "topic" in asked:
            assert options["topic"] in message
    raise AssertionError(message)


def measured_rate_hz(found: Recording) -> float:
    if found.rate_hz is not None:
        return found.rate_hz
    assert found.t_s is not None
    return float((len(found) - 1) / (found.t_s[-1] - found.t_s[0]))


def require_samples(found: Recording, layout: Layout, sensor: Sensor) -> None:
    assert found.axes == layout.axes
    assert len(found) == len(sensor.t)
    assert measured_rate_hz(found) == pytest.approx(layout.rate_hz, rel=0.01)
    truth = np.hstack([sensor.gyro, sensor.accel])
    for axis in layout.axes:
        i = AXES.index(axis)
        assert np.abs(found.values[:, i] - truth[:, i]).max() <= layout.resolution, axis


@pytest.mark.parametrize("layout", LAYOUTS, ids=[layout.name for layout in LAYOUTS])
def test_layout(layout: Layout, tmp_path: Path) -> None:
    sensor = simulate_sensor(layout.rate_hz)
    path = layout.write(sensor, tmp_path)
    if layout.refused:
        with pytest.raises(ImuError, match=re.escape(layout.refused)):
            read(path, {})
        return
    found, options = read_by_messages(layout, path)
    assert {*options} == {name for name, _ in OPTION.findall(layout.options)}
    require_samples(found, layout, sensor)


def test_unknown_columns_are_listed_with_a_command_that_can_be_copied(tmp_path: Path) -> None:
    layout = next(one for one in LAYOUTS if one.name == "PAMAP2")
    path = layout.write(simulate_sensor(layout.rate_hz), tmp_path)
    with pytest.raises(UnknownColumnsError) as error:
        read(path, {})
    lines = error.value.column_lines
    assert len(lines) == 1 + 54 + 1
    assert [line.split()[1] for line in lines[5:8]] == ["ax?", "ay?", "az?"]
    assert lines[-1].startswith("Columns 5 to 7, 22 to 24, ")
    assert lines[-1].endswith(" may be the accelerometer as well: choose one.")
    assert lines[4].split()[:3] == ["4", "column", "4"]
    assert [line.split()[1] for line in lines[11:14]] == ["gx", "gy", "gz"]
    command = str(error.value).partition("such as ")[2].partition("such as ")[2]
    assert shlex.split(command)[:3] == ["imu-monitor", "analyze", str(path)]


def test_delay_between_joined_sensors_is_stated(tmp_path: Path) -> None:
    layout = next(one for one in LAYOUTS if one.name == "GnssLogger")
    notes = read(layout.write(simulate_sensor(layout.rate_hz), tmp_path), {}).notes
    assert any("of UncalAccel have the times of UncalGyro, although they are 1 ms later" in note for note in notes)


def test_sensor_is_chosen_as_it_is_written_in_the_column_names(tmp_path: Path) -> None:
    layout = next(one for one in LAYOUTS if one.name == "Shimmer Consensys")
    sensor = simulate_sensor(layout.rate_hz)
    require_samples(read(layout.write(sensor, tmp_path), {"topic": "LN"}), layout, sensor)


SENSOR = simulate_sensor(100.0)
AXIS_NAMES = "gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"
COUNTER = np.arange(len(SENSOR.t))


def refusal(path: Path, **options: str) -> str:
    with pytest.raises(ImuError) as error:
        read(path, options)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("name", "numbers", "possible"),
    [
        ("packet_counter", 2 * COUNTER, False),
        ("k", COUNTER, False),
        ("k", COUNTER + (COUNTER > 7), False),  # one row is lost
        ("k", 10 * COUNTER, True),
        ("theta", 0.1 * COUNTER + 1e-3 * SENSOR.gyro[:, 0], True),  # angle of a rate table
    ],
)
def test_other_numbers_that_increase_are_no_times(
    tmp_path: Path, name: str, numbers: npt.NDArray[Any], possible: bool
) -> None:
    path = tmp_path / "x.csv"
    path.write_text(table(f"{name},{AXIS_NAMES}", numbers, SENSOR.gyro, SENSOR.accel))
    message = refusal(path)
    assert "give it with --rate HZ" in message
    assert ("if it contains the time, give --columns t=1" in message) == possible


def test_labels_of_activities_name_no_sensors(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    labels = ["acceleration" if i % 50 < 25 else "braking" for i in range(len(SENSOR.t))]
    path.write_text(table("time,x,y,z,label", SENSOR.t, SENSOR.accel, labels))
    assert "no axis among its columns" in refusal(path)


def test_rows_of_sensors_without_column_names(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    rows = [
        [
            (float(t), f"{name};{t:.3f};{join_fields(*values).replace(',', ';')}")
            for t, values in zip(t_s, triad.tolist(), strict=True)
        ]
        for name, t_s, triad in (("GYR", SENSOR.t, SENSOR.gyro), ("ACC", SENSOR.t + 0.001, SENSOR.accel))
    ]  # fmt: skip
    path.write_text(interleave(*rows))
    found = read(path, {})
    np.testing.assert_allclose(found.values, np.hstack([SENSOR.gyro, SENSOR.accel]), atol=1e-6)


def test_sensors_with_times_at_different_rates_are_not_mixed(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    header = "gyro_timestamp,gyro_x,gyro_y,gyro_z,accel_timestamp,acc_x,acc_y,acc_z"
    path.write_text(table(header, SENSOR.t, SENSOR.gyro, 1.6 * SENSOR.t, SENSOR.accel))
    assert "--columns t=5,gx=-,gy=-,gz=-" in refusal(path)
    found = read(path, {"columns": "t=5,gx=-,gy=-,gz=-"})
    assert found.axes == AXES[3:]
    assert measured_rate_hz(found) == pytest.approx(62.5)
    path.write_text(table(header, SENSOR.t, SENSOR.gyro, SENSOR.t + 0.002, SENSOR.accel))
    assert read(path, {}).axes == AXES


def test_files_of_different_axes_are_no_segments(tmp_path: Path) -> None:
    for name, axes, values in (("a", AXES[:3], SENSOR.gyro), ("b", AXES[3:], SENSOR.accel)):
        (tmp_path / f"{name}.csv").write_text(table(",".join(("t", *axes)), SENSOR.t, values))
    assert "such as gyro.csv and accel.csv, to join them" in refusal(tmp_path)
    (tmp_path / "a.csv").rename(tmp_path / "gyro.csv")
    (tmp_path / "b.csv").rename(tmp_path / "accel.csv")
    found = read(tmp_path, {})
    np.testing.assert_allclose(found.values, np.hstack([SENSOR.gyro, SENSOR.accel]), atol=1e-6)
    (tmp_path / "gyro.csv").write_text(table("", SENSOR.gyro, SENSOR.gyro[:, 0]))  # four columns, but no times
    assert "gyro.csv: " in refusal(tmp_path)


def test_recordings_with_all_axes_are_not_joined_because_of_their_names(tmp_path: Path) -> None:
    for name in ("run_gyro_test", "run_accel_test"):
        (tmp_path / f"{name}.csv").write_text(table(f"t,{AXIS_NAMES}", SENSOR.t, SENSOR.gyro, SENSOR.accel))
    assert "contains 2 IMU topics: run_accel_test, run_gyro_test" in refusal(tmp_path)


def test_field_of_a_magnetometer_is_no_acceleration(tmp_path: Path) -> None:
    header = "time,X [G],Y [G],Z [G]"
    (tmp_path / "field.csv").write_text(table(header, SENSOR.t, SENSOR.accel / 20.0))
    assert "no axis among its columns" in refusal(tmp_path / "field.csv")
    (tmp_path / "Magnetometer.csv").write_text(table(header.replace("G", "g"), SENSOR.t, SENSOR.accel / 20.0))
    assert "no axis among its columns" in refusal(tmp_path / "Magnetometer.csv")


def test_angular_acceleration_is_not_taken_for_acceleration(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    alpha = 100.0 * np.gradient(SENSOR.gyro, axis=0)
    path.write_text(table("time,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z", SENSOR.t, SENSOR.gyro, alpha))
    assert "its numbers fit several" in refusal(path)


def test_lines_before_the_header_state_units_and_the_rate(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    before = "# gyro unit: deg/s\n# acc_unit = g\n# Sampling rate: 100 Hz\n"
    path.write_text(table(AXIS_NAMES, SENSOR.deg, SENSOR.g, before=before))
    found = read(path, {})
    assert found.rate_hz == 100.0
    assert "Lines before the header state a sample rate of 100 Hz." in found.notes
    np.testing.assert_allclose(found.values, np.hstack([SENSOR.gyro, SENSOR.accel]), atol=2e-5)
    path.write_text(table(AXIS_NAMES, SENSOR.deg, SENSOR.g, before="# acc_unit = furlong\n"))
    assert '"furlong" is not a unit of acceleration' in refusal(path, rate="100")


def test_cut_archive_with_matrices(tmp_path: Path) -> None:
    np.savez(tmp_path / "whole.npz", t=SENSOR.t, gyro=SENSOR.gyro, accel=SENSOR.accel)
    content = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: 4 * len(content) // 5])
    found = read(tmp_path / "cut.npz", {})
    assert "cut off inside accel" in found.notes[0]
    np.testing.assert_array_equal(found.values[:, :3], SENSOR.gyro)
    present = np.isfinite(found.values[:, 3:]).all(axis=1)
    assert 500 < np.count_nonzero(present) < 1400
    np.testing.assert_array_equal(found.values[present, 3:], SENSOR.accel[present])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.xlsx", b"PK\3\4" + bytes(26) + b"[Content_Types].xml", "an Excel workbook: save the sheet as CSV"),
        ("x.npy", b"\x93NUMPY\x01\x00", "a single NumPy array: save it with numpy.savez"),
        ("x.json", b'[{"t": 1}]', "JSON: convert it to CSV"),
        ("x.csv", b"  can0  21A   [8]  FE 36 12 FE 69 05 07 AD\n" * 9, "CAN frames as candump prints them: rename it"),
    ],
)
def test_other_files_are_called_what_they_are(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    assert message in refusal(tmp_path / name)


def test_arrays_of_other_types_are_listed_without_values(tmp_path: Path) -> None:
    huge = np.full(len(SENSOR.t), 1e308) * np.where(COUNTER % 2, 1.0, -1.0)
    path = tmp_path / "x.npz"
    np.savez(
        path, label=np.array(["a"] * 3), fs=np.float64(100.0), huge=huge, data=np.hstack([SENSOR.gyro, SENSOR.accel])
    )
    with pytest.raises(UnknownColumnsError, match=r"--columns gx=4,gy=5,gz=6,ax=7,ay=8,az=9$"):
        read(path, {})
    assert read(path, {"columns": "gx=4,gy=5,gz=6,ax=7,ay=8,az=9"}).rate_hz == 100.0


def test_a_line_without_end_does_not_fill_the_memory(tmp_path: Path) -> None:
    layout = next(one for one in LAYOUTS if one.name == "FlySight 2")
    path = layout.write(simulate_sensor(layout.rate_hz), tmp_path)
    with path.open("a") as file:
        file.write("$IMU," + "1" * 30_000_000)
    tracemalloc.start()
    found = read(path, {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found) == len(SENSOR.t)
    assert peak < 10e6
