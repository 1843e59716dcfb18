"""The same samples in every format: the analysis is the same, and every command accepts the same options."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcap_ros2.writer
import numpy as np
import pytest
import pyulog
import typer
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

import imu_monitor
from drivers.data_types import AXES, Floats
from drivers.recordings.reading_options import ReadingOptions, create_reading_options, parse_column_mapping
from drivers.units import DEGREE, G0
from monitor.cli import app
from monitor.cli.shared.options import READING_OPTIONS
from monitor.commands.analyze import analyze_recording
from monitor.commands.recording_loading import LoadingOptions, load_recording
from monitor.estimation.estimate import Estimate
from tests.drivers.test_csv_tables import ASL_HEADER, lines
from tests.drivers.test_sensor_csv_files import phyphox, sensor_logger, write
from tests.support import dataflash, ros_bags, ulog

N = 6000
T_US = 5_000_000 + 10_000 * np.arange(N)
T_S = T_US * 1e-6
TABLE_OPTIONS = {
    "columns": parse_column_mapping("t=stamp,gx=omega_x,gy=omega_y,gz=omega_z,ax=f_x,ay=f_y,az=f_z"),
    "gyro_unit": "deg/s",
    "accel_unit": "g",
    "time_unit": "ns",
}
Write = Callable[[Path, Floats], Path]


def write_ulog(folder: Path, values: Floats) -> Path:
    """Write a PX4 log with pyulog, from messages in the published layout."""
    own = ulog.write_ulog(folder / "own.ulg", ulog.sensor_combined(T_US, values))
    pyulog.ULog(str(own)).write_ulog(str(folder / "x.ulg"))
    return folder / "x.ulg"


def write_matlab(folder: Path, values: Floats) -> Path:
    savemat(folder / "x.mat", {"t": T_S, "gyro": values[:, :3], "acc": values[:, 3:]})
    return folder / "x.mat"


def write_text(name: str, header: str, separator: str, *columns: Any) -> Callable[[Path], Path]:
    def write_file(folder: Path) -> Path:
        (folder / name).write_text(lines(header, *columns, separator=separator))
        return folder / name

    return write_file


def write_betaflight(folder: Path, values: Floats) -> Path:
    gyros, accels = ([f"{name}[{i}]" for i in range(3)] for name in ("gyroADC", "accSmooth"))
    header = ", ".join(["loopIteration", "time (us)", *gyros, *accels])
    counts = values[:, 3:].T / G0 * 2048.0
    return write_text("LOG.csv", header, ", ", range(N), T_US, *values[:, :3].T / DEGREE, *counts)(folder)


def write_androsensor(folder: Path, values: Floats) -> Path:
    names = [f"GYROSCOPE {axis} (rad/s)" for axis in "XYZ"] + [f"ACCELEROMETER {axis} (m/s²)" for axis in "XYZ"]
    header = ";".join([*names, "TIME SINCE START (ms)"])
    return write_text("sensors.csv", header, ";", *values.T, T_US * 1e-3)(folder)


def write_other_table(folder: Path, values: Floats) -> Path:
    columns = (*values[:, :3].T / DEGREE, *values[:, 3:].T / G0)
    return write_text("x.csv", "stamp;omega_x;omega_y;omega_z;f_x;f_y;f_z", ";", 1000 * T_US, *columns)(folder)


def write_phyphox(folder: Path, values: Floats) -> Path:
    files = {
        "Gyroscope.csv": phyphox("Gyroscope", "rad/s", values[:, :3], T_S),
        "Accelerometer.csv": phyphox("Acceleration", "m/s^2", values[:, 3:], T_S),
    }
    return write(folder / "run.zip", files)


def write_sensor_logger(folder: Path, values: Floats) -> Path:
    files = {
        "Gyroscope.csv": sensor_logger(values[:, :3], T_S),
        "TotalAcceleration.csv": sensor_logger(values[:, 3:], T_S),
    }
    return write(folder / "run", files)


def write_asl(folder: Path, values: Floats) -> Path:
    return write_text("data.csv", ASL_HEADER, ",", 1000 * T_US, *values.T)(folder)


def bag_writer(kind: str) -> Write:
    return lambda folder, values: ros_bags.write_bag(folder, kind, {"/imu": ros_bags.imu_topic(1000 * T_US, values)})


def write_mcap(folder: Path, values: Floats) -> Path:
    """Write an MCAP file with the libraries of the format, which have no code in common with rosbags."""
    definition, _ = get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(ros_bags.IMU, ros_version=2)
    names = ("linear_acceleration", "angular_velocity")
    zeros = {f"{name}_covariance": [0.0] * 9 for name in (*names, "orientation")}
    with (folder / "x.mcap").open("wb") as file:
        writer = mcap_ros2.writer.Writer(file)
        schema = writer.register_msgdef(ros_bags.IMU, definition)
        for t_us, row in zip(T_US.tolist(), values.tolist(), strict=True):
            gyro, accel = (dict(zip("xyz", part, strict=True)) for part in (row[:3], row[3:]))
            stamp = {"sec": t_us // 1_000_000, "nanosec": t_us % 1_000_000 * 1000}
            content = {
                "header": {"stamp": stamp, "frame_id": "imu"},
                "orientation": dict.fromkeys("xyzw", 0.0),
                **zeros,
            }
            content |= {"angular_velocity": gyro, "linear_acceleration": accel}
            writer.write_message("/imu", schema, content, 1000 * t_us, 1000 * t_us)
        writer.finish()
    return folder / "x.mcap"


FORMATS: dict[str, tuple[Write, dict[str, Any]]] = {
    **{kind: (bag_writer(kind), {"topic": "/imu"}) for kind in ros_bags.KINDS},
    "MCAP": (write_mcap, {}),
    "PX4": (write_ulog, {"topic": "sensor_combined"}),
    "ArduPilot": (lambda folder, x: dataflash.write_dataflash(folder / "x.bin", dataflash.imu(T_US, x)), {}),
    "Betaflight": (write_betaflight, {}),
    "EuRoC and TUM VI": (write_asl, {}),
    "phyphox": (write_phyphox, {}),
    "Sensor Logger": (write_sensor_logger, {"topic": "Gyroscope+TotalAcceleration"}),
    "AndroSensor": (write_androsensor, {}),
    "MATLAB": (write_matlab, {}),
    "other table": (write_other_table, TABLE_OPTIONS),
}
"""Function that writes a recording in each format, and the options that read it."""


def estimate_of(path: Path, options: ReadingOptions) -> Estimate:
    return analyze_recording(load_recording(path, LoadingOptions(reading=options))).analysis.estimate


@pytest.fixture(scope="module")
def values() -> Floats:
    """Return samples that 32-bit floats, as in the logs of autopilots, contain without rounding."""
    found = imu_monitor.simulate("consumer-mems", duration_s=N / 100.0).values
    return found.astype(np.float32).astype(np.float64)


@pytest.fixture(scope="module")
def expected(values: Floats, tmp_path_factory: pytest.TempPathFactory) -> Estimate:
    path = tmp_path_factory.mktemp("npz") / "same.npz"
    np.savez(path, t=T_S, **dict(zip(AXES, values.T, strict=True)))
    return estimate_of(path, ReadingOptions())


@pytest.mark.parametrize("name", FORMATS)
def test_analysis_is_that_of_the_npz_of_the_same_samples(
    name: str, values: Floats, expected: Estimate, tmp_path: Path
) -> None:
    write_recording, options = FORMATS[name]
    found = estimate_of(write_recording(tmp_path, values), create_reading_options(options))
    assert found.rate_hz == pytest.approx(expected.rate_hz, rel=1e-12)
    np.testing.assert_array_equal(found.coefficients.status, expected.coefficients.status)
    for field in ("value", "lo", "hi"):
        ours, theirs = (getattr(one.coefficients, field) for one in (found, expected))
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)  # the conversion of units rounds the samples
    np.testing.assert_allclose(found.curve.avar, expected.curve.avar, rtol=1e-9)


@pytest.mark.parametrize(
    "command", ["analyze", "reconcile", "compensate", "convert", "simulate", "thermal fit", "thermal predict"]
)
def test_every_command_that_reads_recordings_has_all_reading_options(command: str) -> None:
    found: Any = typer.main.get_command(app)
    for name in command.split():
        found = found.commands[name]
    assert {*READING_OPTIONS, "decoder", "option"} <= {one.name for one in found.params}
    assert set(READING_OPTIONS) == set(inspect.signature(imu_monitor.read_recording).parameters) & set(READING_OPTIONS)
