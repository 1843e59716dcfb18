"""Tests of ``convert``: every readable format to every written format, without changing times or values."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError, RecordingError
from drivers.recordings import WRITABLE, load_samples, save_samples
from drivers.recordings.file_formats.mcap_writer import split_times
from drivers.recordings.reading_options import ReadingOptions
from monitor.commands.convert import BLOCK_ROWS, ConversionRequest, run_conversion
from tests.support import dataflash, ros_bags, ulog
from tests.support.program import exit_status

N = 1500
T0_NS = 1_763_700_000_123_456_789


def make_samples(n: int = N, start_s: float = T0_NS * 1e-9) -> tuple[Floats, Floats, Floats]:
    """Return Unix times with jitter, values that need 64 bits, and temperatures. Some values are missing."""
    rng = np.random.default_rng(5)
    t_s = start_s + np.arange(n) / 200.0 + rng.uniform(0.0, 1e-3, n)
    values = rng.standard_normal((n, 6)) + np.pi
    values[3, 2], values[4, 3:], values[5, :3] = np.nan, np.nan, np.nan
    temperature_c = rng.uniform(20.0, 30.0, n)
    temperature_c[7] = np.nan
    return t_s, values, temperature_c


def write_table(folder: Path, suffix: str) -> Path:
    path = folder / f"in{suffix}"
    save_samples(path, *make_samples())
    return path


def write_ros_bag(folder: Path, kind: str) -> Path:
    _, values, _ = make_samples()
    t_ns = T0_NS + np.arange(N) * 5_000_003
    return ros_bags.write_bag(folder, kind, {"/imu": ros_bags.imu_topic(t_ns, values)}, "in")


def write_px4_log(folder: Path, _kind: str) -> Path:
    _, values, _ = make_samples()
    return ulog.write_ulog(folder / "in.ulg", ulog.sensor_combined(5_000_000 + np.arange(N) * 4001, values))


def write_ardupilot_log(folder: Path, _kind: str) -> Path:
    _, values, _ = make_samples()
    return dataflash.write_dataflash(folder / "in.bin", dataflash.imu(5_000_000 + np.arange(N) * 4001, values))


SOURCES: dict[str, Callable[[Path, str], Path]] = {
    **dict.fromkeys(WRITABLE, write_table),
    **dict.fromkeys(ros_bags.KINDS, write_ros_bag),
    ".ulg": write_px4_log,
    ".bin": write_ardupilot_log,
}


def assert_equal_recordings(found: Any, expected: Any, mcap: bool) -> None:
    assert found.axes == expected.axes
    np.testing.assert_array_equal(found.values, expected.values)
    if not mcap:
        assert found.t_s.tobytes() == expected.t_s.tobytes()
        np.testing.assert_array_equal(found.temperature_c, expected.temperature_c)
    elif expected.t_s[0] > 1e9:  # the resolution of Unix times in float64 is coarser than 1 ns
        assert found.t_s.tobytes() == expected.t_s.tobytes()
    else:
        assert np.abs(found.t_s - expected.t_s).max() <= 0.5e-9 + np.spacing(expected.t_s.max())


@pytest.mark.parametrize("target", WRITABLE)
@pytest.mark.parametrize("source", SOURCES)
def test_every_format_is_converted_without_loss(tmp_path: Path, source: str, target: str) -> None:
    path, out = SOURCES[source](tmp_path, source), tmp_path / f"out{target}"
    expected = run_conversion(ConversionRequest(path, out))
    assert_equal_recordings(load_samples(out), expected, target == ".mcap")
    assert len(expected) == N
    assert {one.name for one in tmp_path.iterdir()} == {path.name, out.name}  # no temporary files remain


@pytest.mark.parametrize("start_s", [0.0, 1.763e9], ids=["since the start", "Unix times"])
def test_mcap_returns_every_row(tmp_path: Path, start_s: float) -> None:
    """The first time is 0, times repeat and step back, and the rows fill several chunks and blocks."""
    n = BLOCK_ROWS + 10
    t_s, values, temperature_c = make_samples(n)
    t_s = start_s + np.arange(n) / 400.0
    t_s[100:110] = t_s[100]
    t_s[20_000:] -= 30.0
    t_s[BLOCK_ROWS - 1] = t_s[BLOCK_ROWS]
    save_samples(tmp_path / "in.npz", t_s, values, temperature_c)
    run_conversion(ConversionRequest(tmp_path / "in.npz", tmp_path / "out.mcap"))
    found = load_samples(tmp_path / "out.mcap")
    np.testing.assert_array_equal(found.values, values)
    assert np.abs(found.t_s - t_s).max() <= (1e-9 if start_s == 0.0 else 0.0)
    assert found.notes == ()


def test_another_program_reads_stamps_to_the_nanosecond(tmp_path: Path) -> None:
    t_s, values, temperature_c = make_samples(start_s=12.0)
    save_samples(tmp_path / "in.npz", t_s, values, temperature_c)
    run_conversion(ConversionRequest(tmp_path / "in.npz", tmp_path / "out.mcap"))
    found: dict[str, list[Any]] = {"/imu/data": [], "/imu/temperature": []}
    with AnyReader([tmp_path / "out.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            found[connection.topic].append(reader.deserialize(data, connection.msgtype))
    for messages in found.values():
        stamps = [one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec for one in messages]
        assert stamps == [round(float(one) * 1e9) for one in t_s]
    np.testing.assert_array_equal([one.temperature for one in found["/imu/temperature"]], temperature_c)
    covariances = [
        (one.angular_velocity_covariance[0], one.linear_acceleration_covariance[0]) for one in found["/imu/data"][:6]
    ]
    assert covariances == [(0.0, 0.0)] * 4 + [(0.0, -1.0), (-1.0, 0.0)]
    assert found["/imu/data"][0].orientation_covariance[0] == -1.0


def test_temperature_of_mcap_is_joined_by_topic(tmp_path: Path) -> None:
    save_samples(tmp_path / "in.npz", *make_samples())
    expected = run_conversion(ConversionRequest(tmp_path / "in.npz", tmp_path / "a.mcap"))
    both = ReadingOptions(topic="/imu/data+/imu/temperature")
    found = run_conversion(ConversionRequest(tmp_path / "a.mcap", tmp_path / "b.csv", reading=both))
    np.testing.assert_array_equal(found.temperature_c, expected.temperature_c)
    assert_equal_recordings(load_samples(tmp_path / "b.csv"), expected, mcap=False)


def test_axes_and_temperature_without_values_are_left_out(tmp_path: Path) -> None:
    t_s, values, _ = make_samples()
    values[:, [0, 1, 3, 4, 5]] = np.nan
    save_samples(tmp_path / "in.csv", t_s, values, np.full(N, np.nan), ["gx", "gz"])
    for suffix in WRITABLE:
        run_conversion(ConversionRequest(tmp_path / "in.csv", tmp_path / f"out{suffix}"))
        assert load_samples(tmp_path / f"out{suffix}").axes == ("gz",)


def test_rate_replaces_missing_times(tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", gx=np.arange(5.0), fs=8.0)
    for request, rate_hz in ((None, 8.0), (4.0, 4.0)):
        run_conversion(ConversionRequest(tmp_path / "in.npz", tmp_path / "out.csv", rate_hz=request))
        assert load_samples(tmp_path / "out.csv").t_s.tolist() == [i / rate_hz for i in range(5)]


def test_progress_of_writing_and_last_part(tmp_path: Path) -> None:
    n = 3 * BLOCK_ROWS
    t_s, values, temperature_c = make_samples(n)
    save_samples(tmp_path / "in.npz", t_s, values, temperature_c)
    steps: list[tuple[str, float | None]] = []
    run_conversion(ConversionRequest(tmp_path / "in.npz", tmp_path / "out.arrow"), lambda *step: steps.append(step))
    shares = [("writing", share) for share in (0.0, 1 / 3, 2 / 3)]
    assert steps == [("reading", None), *shares, ("finishing the file", None)]
    assert len(run_conversion(ConversionRequest(tmp_path / "in.npz", tmp_path / "out.arrow", last_s=1.0))) < 210


@pytest.mark.parametrize("t_s", [-1.0, 2.0**31])
def test_times_beyond_the_range_of_ros_are_refused(tmp_path: Path, t_s: float) -> None:
    save_samples(tmp_path / "in.csv", np.array([0.0, t_s]), np.ones((2, 6)))
    with pytest.raises(RecordingError, match=r"out\.mcap: t = .* s cannot be stored in a ROS 2 message"):
        run_conversion(ConversionRequest(tmp_path / "in.csv", tmp_path / "out.mcap"))
    assert os.listdir(tmp_path) == ["in.csv"]


def test_nanoseconds_carry_into_the_next_second() -> None:
    assert split_times(Path(), np.array([np.nextafter(7.0, 0.0), 7.25])).tolist() == [[7, 0], [7, 250_000_000]]


def test_recording_is_not_overwritten_by_itself(tmp_path: Path) -> None:
    save_samples(tmp_path / "in.csv", *make_samples())
    before = (tmp_path / "in.csv").read_bytes()
    (tmp_path / "link.csv").symlink_to(tmp_path / "in.csv")
    with pytest.raises(ConfigError, match="is the recording itself; choose another name"):
        run_conversion(ConversionRequest(tmp_path / "in.csv", tmp_path / "link.csv"))
    assert (tmp_path / "in.csv").read_bytes() == before


def test_command_prints_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_samples(tmp_path / "in.csv", *make_samples())
    assert exit_status("convert", tmp_path / "in.csv", tmp_path / "out.npz") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.npz'}: 1500 samples of {' '.join(AXES)}, temperature\n"
    assert exit_status("convert", tmp_path / "in.csv", tmp_path / "out.mcap") == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        "note: The temperature has a topic of its own; read both with --topic /imu/data+/imu/temperature."
    ]
    assert exit_status("convert", tmp_path / "in.csv", tmp_path / "out.ulg") == 2
    assert capsys.readouterr().err == (
        f"imu-monitor: {tmp_path / 'out.ulg'}: this format is only read; recordings are written as "
        f"{' '.join(WRITABLE)}\n"
    )
