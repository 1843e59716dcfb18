"""Tests of ``convert``: every readable format to every written format, without changing times or values."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError, RecordingError
from drivers.recordings import WRITABLE, load_samples, save_samples
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.table import BATCH_ROWS
from monitor.commands.convert import run_conversion
from monitor.commands.recording_loading import DecoderChoice, LoadingOptions
from tests.support import dataflash, ros_bags, ulog
from tests.support.program import exit_status

N = 1500
T0_NS = 1_763_700_000_123_456_789
T_NS = T0_NS + np.arange(N) * 5_000_003
T_US = 5_000_000 + np.arange(N) * 4001


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
    return ros_bags.write_bag(folder, kind, {"/imu": ros_bags.imu_topic(T_NS, values)}, "in")


def write_px4_log(folder: Path, _kind: str) -> Path:
    _, values, _ = make_samples()
    return ulog.write_ulog(folder / "in.ulg", ulog.sensor_combined(T_US, values))


def write_ardupilot_log(folder: Path, _kind: str) -> Path:
    _, values, _ = make_samples()
    return dataflash.write_dataflash(folder / "in.bin", dataflash.imu(T_US, values))


def write_table_in_ns(folder: Path, kind: str) -> Path:
    _, values, temperature_c = make_samples()
    path = folder / f"in{kind.split(maxsplit=1)[0]}"
    save_samples(path, T_NS, values, temperature_c)
    return path


def write_euroc_csv(folder: Path, _kind: str) -> Path:
    _, values, _ = make_samples()
    header = "#timestamp [ns]," + ",".join(f"{kind}_RS_S_{axis}" for kind in "wa" for axis in "xyz")
    rows = (f"{t},{','.join(map(repr, row))}" for t, row in zip(T_NS.tolist(), values.tolist(), strict=True))
    path = folder / "in.csv"
    path.write_text("\n".join((header, *rows, "")))
    return path


def write_matlab_file(folder: Path, _kind: str) -> Path:
    _, values, _ = make_samples()
    savemat(folder / "in.mat", {"t_ns": T_NS, **dict(zip(AXES, values.T, strict=True))})
    return folder / "in.mat"


SOURCES: dict[str, Callable[[Path, str], Path]] = {
    **dict.fromkeys(WRITABLE, write_table),
    **dict.fromkeys(ros_bags.KINDS, write_ros_bag),
    ".ulg": write_px4_log,
    ".bin": write_ardupilot_log,
    **{f"{suffix} in ns": write_table_in_ns for suffix in WRITABLE},
    "EuRoC": write_euroc_csv,
    ".mat": write_matlab_file,
}
IN_SECONDS = set(WRITABLE) - {".mcap"}
"""Sources that contain times in s."""
CONVERSIONS = [
    *((source, ".npz") for source in SOURCES),
    *((source, target) for source in (".npz", ".npz in ns") for target in WRITABLE if target != ".npz"),
]
"""Every source once, and every target with times in s and in ns."""


def assert_equal_recordings(found: Any, expected: Any, mcap: bool) -> None:
    assert found.axes == expected.axes
    np.testing.assert_array_equal(found.values, expected.values)
    if not mcap:
        assert found.times.dtype == expected.times.dtype
        assert found.times.tobytes() == expected.times.tobytes()
        np.testing.assert_array_equal(found.temperature_c, expected.temperature_c)
    else:
        assert found.times.tolist() == expected.t_ns.tolist()


@pytest.mark.parametrize(("source", "target"), CONVERSIONS)
def test_every_format_is_converted_without_loss(tmp_path: Path, source: str, target: str) -> None:
    path, out = SOURCES[source](tmp_path, source), tmp_path / f"out{target}"
    expected = run_conversion(path, out)
    assert_equal_recordings(load_samples(out), expected, target == ".mcap")
    assert len(expected) == N
    if source not in IN_SECONDS:
        stamps = 1000 * T_US if source in (".ulg", ".bin") else expected.t_ns if source == ".mcap" else T_NS
        assert load_samples(out).times.tolist() == stamps.tolist()
    assert {one.name for one in tmp_path.iterdir()} == {path.name, out.name}  # no temporary files remain


@pytest.mark.parametrize("start_s", [0.0, 1.763e9], ids=["since the start", "Unix times"])
def test_mcap_returns_every_row(tmp_path: Path, start_s: float) -> None:
    """The first time is 0, times repeat and step back, and the rows fill several chunks and blocks."""
    n = BATCH_ROWS + 10
    t_s, values, temperature_c = make_samples(n)
    t_s = start_s + np.arange(n) / 400.0
    t_s[100:110] = t_s[100]
    t_s[20_000:] -= 30.0
    t_s[BATCH_ROWS - 1] = t_s[BATCH_ROWS]
    save_samples(tmp_path / "in.npz", t_s, values, temperature_c)
    run_conversion(tmp_path / "in.npz", tmp_path / "out.mcap")
    found = load_samples(tmp_path / "out.mcap")
    np.testing.assert_array_equal(found.values, values)
    assert np.abs(found.t_s - t_s).max() <= (1e-9 if start_s == 0.0 else 0.0)
    assert found.notes == ()


def test_another_program_reads_stamps_to_the_nanosecond(tmp_path: Path) -> None:
    t_s, values, temperature_c = make_samples(start_s=12.0)
    save_samples(tmp_path / "in.npz", t_s, values, temperature_c)
    run_conversion(tmp_path / "in.npz", tmp_path / "out.mcap")
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
    expected = run_conversion(tmp_path / "in.npz", tmp_path / "a.mcap")
    both = ReadingOptions(topic="/imu/data+/imu/temperature")
    found = run_conversion(tmp_path / "a.mcap", tmp_path / "b.csv", loading=LoadingOptions(reading=both))
    np.testing.assert_array_equal(found.temperature_c, expected.temperature_c)
    assert_equal_recordings(load_samples(tmp_path / "b.csv"), found, mcap=False)


def test_axes_and_temperature_without_values_are_left_out(tmp_path: Path) -> None:
    t_s, values, _ = make_samples()
    values[:, [0, 1, 3, 4, 5]] = np.nan
    save_samples(tmp_path / "in.csv", t_s, values, np.full(N, np.nan), ["gx", "gz"])
    for suffix in WRITABLE:
        run_conversion(tmp_path / "in.csv", tmp_path / f"out{suffix}")
        assert load_samples(tmp_path / f"out{suffix}").axes == ("gz",)


def test_a_stamp_survives_every_format_in_turn(tmp_path: Path) -> None:
    t_ns = np.array([1_700_000_000_123_456_789, 1_700_000_000_123_456_790, 1_700_000_000_128_456_788])
    path = write_table_in_ns(tmp_path, ".csv")
    save_samples(path, t_ns, np.ones((3, 6)))
    for i, suffix in enumerate((*WRITABLE, *reversed(WRITABLE))):
        run_conversion(path, tmp_path / f"{i}{suffix}")
        path = tmp_path / f"{i}{suffix}"
        assert load_samples(path).times.tolist() == t_ns.tolist()


def test_decoded_samples_keep_their_nanoseconds(tmp_path: Path) -> None:
    (tmp_path / "in.txt").write_text("".join(f"{i},{i},{i}\n" for i in range(7)))
    choice = DecoderChoice("text", {"columns": ["gx", "gy", "gz"]})
    run_conversion(tmp_path / "in.txt", tmp_path / "out.csv", loading=LoadingOptions(rate_hz=3.0, decoder=choice))
    times = load_samples(tmp_path / "out.csv").times
    assert times is not None
    assert times.tolist() == [round(i * 1e9 / 3.0) for i in range(6)]  # the first line may be incomplete


def test_rate_replaces_missing_times(tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", gx=np.arange(5.0), fs=8.0)
    for request, rate_hz in ((None, 8.0), (4.0, 4.0)):
        run_conversion(tmp_path / "in.npz", tmp_path / "out.csv", loading=LoadingOptions(rate_hz=request))
        assert load_samples(tmp_path / "out.csv").t_s.tolist() == [i / rate_hz for i in range(5)]


def test_progress_of_writing_and_last_part(tmp_path: Path) -> None:
    n = 3 * BATCH_ROWS
    t_s, values, temperature_c = make_samples(n)
    save_samples(tmp_path / "in.npz", t_s, values, temperature_c)
    steps: list[tuple[str, float | None]] = []
    run_conversion(tmp_path / "in.npz", tmp_path / "out.arrow", report_progress=lambda *step: steps.append(step))
    shares = [("writing", share) for share in (0.0, 1 / 3, 2 / 3)]
    assert steps == [("reading", None), *shares, ("writing", 1.0)]
    assert len(run_conversion(tmp_path / "in.npz", tmp_path / "out.arrow", loading=LoadingOptions(last_s=1.0))) < 210


@pytest.mark.parametrize("t_s", [-1.0, 2.0**31])
def test_times_beyond_the_range_of_ros_are_refused(tmp_path: Path, t_s: float) -> None:
    save_samples(tmp_path / "in.csv", np.array([0.0, t_s]), np.ones((2, 6)))
    with pytest.raises(RecordingError, match=r"out\.mcap: t = .* s cannot be stored in a ROS 2 message"):
        run_conversion(tmp_path / "in.csv", tmp_path / "out.mcap")
    assert os.listdir(tmp_path) == ["in.csv"]


def test_recording_is_not_overwritten_by_itself(tmp_path: Path) -> None:
    save_samples(tmp_path / "in.csv", *make_samples())
    before = (tmp_path / "in.csv").read_bytes()
    (tmp_path / "link.csv").symlink_to(tmp_path / "in.csv")
    with pytest.raises(ConfigError, match="is the recording itself; choose another name"):
        run_conversion(tmp_path / "in.csv", tmp_path / "link.csv")
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
        f"imu-monitor: {tmp_path / 'out.ulg'}: this format is not written; recordings are written as "
        f"{' '.join(WRITABLE)}\n"
    )
    assert exit_status("convert", tmp_path / "in.csv", tmp_path / "out.xls") == 2
    assert capsys.readouterr().err == (
        f"imu-monitor: {tmp_path / 'out.xls'}: the suffix is unknown; recordings are written as {' '.join(WRITABLE)}\n"
    )
