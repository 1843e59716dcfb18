"""Recordings in ArduPilot logs: logs written by the published layout, which pymavlink reads back; topics and damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import DFReader

from drivers.data_types import AXES
from drivers.errors import ConfigError, ImuError
from drivers.links import replay_link
from drivers.recordings import ReadingOptions, load_samples, memory_check, save_samples
from drivers.recordings.file_formats import ardupilot_log_format
from monitor.commands.analyze import analyze_recording
from monitor.commands.recording_loading import load_recording
from tests.support.dataflash import Messages, dataflash_bytes, imu, raw_sensor, table_of, write_dataflash
from tests.support.recordings import recordings

GYROS, ACCELS = AXES[:3], AXES[3:]


def times_us(n: int, rate_hz: float = 50.0) -> np.ndarray[Any, Any]:
    return 7_000_000 + np.rint(np.arange(n) / rate_hz * 1e6).astype(np.int64)


def noise(n: int, seed: int = 1) -> np.ndarray[Any, Any]:
    """White noise that a 32-bit float holds without loss."""
    values = np.random.default_rng(seed).normal(size=(n, 6)) * 1e-2 + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    return values.astype(np.float32).astype(np.float64)


def refusal(path: Path, topic: str | None = None) -> str:
    with pytest.raises(ImuError) as error:
        load_samples(path, options=ReadingOptions(topic=topic))
    line = str(error.value)
    assert "\n" not in line
    assert line.startswith(f"{path}: ")
    return line


def attempt(path: Path) -> None:
    """Read a log that is damaged: a recording, or an error of one line."""
    try:
        assert len(load_samples(path)) > 0
    except ImuError as error:
        line = str(error)
    else:
        return
    assert line.startswith(f"{path}: ")
    assert "\n" not in line


def test_pymavlink_reads_the_written_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    values = noise(10)
    path = write_dataflash(
        tmp_path / "x.bin", imu(times_us(10), values), raw_sensor("GYR", times_us(10), values[:, :3])
    )
    with DFReader.DFReader_binary(str(path)) as log:
        read = [log.recv_match(type=["IMU"]) for _ in range(10)]
        assert log.recv_match(type=["IMU"]) is None
    assert [one.TimeUS for one in read] == times_us(10).tolist()
    assert [[one.GyrX, one.AccZ, one.T] for one in read] == [[row[0], row[5], 35.0] for row in values.tolist()]
    assert capfd.readouterr() == ("", "")


class TestSamples:
    def test_a_log_gives_the_result_of_the_npz_of_its_samples(self, tmp_path: Path) -> None:
        t_us, values = times_us(8000), noise(8000)
        path = write_dataflash(tmp_path / "x.BIN", imu(t_us, values))
        save_samples(tmp_path / "same.npz", 1000 * t_us, values, np.full(8000, 35.0))
        found, same = load_samples(path), load_samples(tmp_path / "same.npz")
        assert found.t_ns is not None
        assert found.t_ns.tolist() == same.t_ns.tolist() == (1000 * t_us).tolist()
        assert found.values.tobytes() == same.values.tobytes()
        assert found.temperature_c.tobytes() == same.temperature_c.tobytes()
        assert (found.axes, found.notes) == (AXES, ())
        of_log, of_npz = (analyze_recording(load_recording(one)).analysis for one in (path, tmp_path / "same.npz"))
        for field in ("value", "lo", "hi"):
            ours, theirs = (getattr(one.estimate.coefficients, field) for one in (of_log, of_npz))
            np.testing.assert_array_equal(ours, theirs)

    def test_raw_samples_have_the_times_of_the_sensor(self, tmp_path: Path) -> None:
        t_us, values = times_us(100, 1000.0), noise(100)
        gyro = raw_sensor("GYR", t_us, values[:, :3])
        path = write_dataflash(tmp_path / "x.bin", gyro, raw_sensor("ACC", t_us + 100, values[:, 3:]))
        found = load_samples(path)
        assert found.values.tobytes() == values.tobytes()
        assert found.t_ns is not None
        assert found.t_ns.tolist() == (1000 * t_us).tolist()
        assert load_samples(path, options=ReadingOptions(topic="ACC")).axes == ACCELS

    def test_fixed_point_numbers_are_scaled(self, tmp_path: Path) -> None:
        rows = table_of(TimeUS=times_us(3).astype("<u8"), GyrX=np.array([150, -25, 0], "<i2"))
        found = load_samples(write_dataflash(tmp_path / "x.bin", Messages("IMU", rows, "Qc")))
        assert found.axes == ("gx",)
        assert found.values[:, 0].tolist() == [1.5, -0.25, 0.0]

    @pytest.mark.parametrize("number", [1, 2, 3])
    @pytest.mark.data
    def test_the_samples_of_a_real_flight(self, number: int, tmp_path: Path) -> None:
        """Three IMUs, with the names that the autopilot's log of 2015 has."""
        flights = []
        for i in (1, 2, 3):
            with np.load(recordings() / "autopilot-3imu" / f"imu{i}.npz") as file:
                flights.append((file["t"], np.column_stack([file[axis] for axis in AXES])))
        path = write_dataflash(
            tmp_path / "x.bin",
            *(
                imu(np.rint(t_s * 1e6).astype(int), values, None, f"IMU{i if i > 1 else ''}", "Temp")
                for i, (t_s, values) in enumerate(flights, start=1)
            ),
        )
        assert "contains 3 IMU topics: IMU, IMU2, IMU3" in refusal(path)
        found = load_samples(path, options=ReadingOptions(topic=f"IMU{number if number > 1 else ''}"))
        assert found.values.tobytes() == flights[number - 1][1].astype(np.float64).tobytes()
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, flights[number - 1][0], rtol=0.0, atol=1e-6)


class TestTopics:
    def test_two_imus_are_listed(self, tmp_path: Path) -> None:
        path = write_dataflash(tmp_path / "x.bin", *(imu(times_us(30), noise(30, i), i) for i in range(2)))
        assert "contains 2 IMU topics: IMU, IMU:1; choose with --topic" in refusal(path)
        for topic, seed in (("IMU", 0), ("IMU:0", 0), ("IMU:1", 1)):
            assert load_samples(path, options=ReadingOptions(topic=topic)).values.tobytes() == noise(30, seed).tobytes()
        assert refusal(path, "IMU:2").endswith('contains no topic "IMU:2"; possible are IMU:1, IMU')

    def test_mixed_rates(self, tmp_path: Path) -> None:
        gyro = raw_sensor("GYR", times_us(1000, 1000.0), noise(1000)[:, :3])
        path = write_dataflash(tmp_path / "x.bin", gyro, raw_sensor("ACC", times_us(800, 800.0), noise(800)[:, 3:]))
        assert "mixed rates: GYR 1000 Hz and ACC 800 Hz" in refusal(path)
        assert load_samples(path, options=ReadingOptions(topic="GYR")).axes == GYROS

    def test_the_message_imu_is_preferred(self, tmp_path: Path) -> None:
        values = noise(30)
        raw = raw_sensor("GYR", times_us(30), values[:, :3]), raw_sensor("ACC", times_us(30), values[:, 3:])
        found = load_samples(write_dataflash(tmp_path / "x.bin", *raw, imu(times_us(30), values)))
        assert found.notes == ("Topic IMU is read; the file also contains GYR+ACC.",)

    def test_no_imu_at_all(self, tmp_path: Path) -> None:
        rows = table_of(TimeUS=times_us(3).astype("<u8"), Alt=np.ones(3, "<f4"))
        path = write_dataflash(tmp_path / "x.bin", Messages("BARO", rows))
        assert refusal(path).endswith(
            "contains no samples of an IMU; expected messages IMU, or GYR and ACC, found no messages"
        )


class TestDamage:
    def test_a_log_that_is_cut_off_is_read_up_to_the_cut(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        data = dataflash_bytes([imu(times_us(300), noise(300))])
        for share in (0.3, 0.6, 0.9, 0.999):
            (tmp_path / "x.bin").write_bytes(data[: int(share * len(data))])
            found = load_samples(tmp_path / "x.bin")
            assert 0 < len(found) < 300
            assert found.values.tobytes() == noise(300)[: len(found)].tobytes()
        (tmp_path / "x.bin").write_bytes(data[:200])
        assert "contains no samples of an IMU" in refusal(tmp_path / "x.bin")
        assert capfd.readouterr() == ("", "")

    def test_flipped_bytes_end_in_one_line_or_a_recording(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        rng = np.random.default_rng(5)
        data = dataflash_bytes([imu(times_us(40), noise(40)), raw_sensor("GYR", times_us(40), noise(40)[:, :3], 1)])
        for _ in range(300):
            damaged = bytearray(data)
            for at in rng.integers(3, len(data) // (1 + rng.integers(8)), 3):
                damaged[at] = rng.integers(256)
            (tmp_path / "x.bin").write_bytes(damaged)
            attempt(tmp_path / "x.bin")
        assert capfd.readouterr() == ("", "")

    def test_a_log_is_read_up_to_an_unknown_message(self, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        log = imu(times_us(300), noise(300))
        data = dataflash_bytes([log])
        at = len(data) - 100 * (3 + log.rows.dtype.itemsize)
        (tmp_path / "x.bin").write_bytes(data[:at] + b"\xa3\x95\x10" + data[at:])
        found = load_samples(tmp_path / "x.bin")
        assert found.values.tobytes() == noise(300)[:200].tobytes()
        assert found.notes == (f"The log is damaged at byte {at} of {len(data) + 3} and was read up to there.",)
        assert capfd.readouterr() == ("", "")

    def test_messages_without_bytes(self, tmp_path: Path) -> None:
        data = bytearray(dataflash_bytes([imu(times_us(300), noise(300))]))
        data[89 + 4] = 0  # the length in the second message, which describes IMU
        (tmp_path / "x.bin").write_bytes(data)
        assert "contains no samples of an IMU" in refusal(tmp_path / "x.bin")

    def test_a_layout_of_another_length(self, tmp_path: Path) -> None:
        rows = table_of(TimeUS=times_us(3).astype("<u8"), GyrX=np.ones(3, "<f4"))
        path = write_dataflash(tmp_path / "x.bin", Messages("IMU", rows, "Qd"))
        assert "is damaged" in refusal(path)

    def test_captured_bytes_are_no_log(self, tmp_path: Path) -> None:
        (tmp_path / "x.bin").write_bytes(bytes(range(256)) * 20)
        assert refusal(tmp_path / "x.bin").endswith("captured bytes are decoded by the link replay")

    def test_a_log_that_does_not_fit_is_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = write_dataflash(tmp_path / "x.bin", imu(times_us(300), noise(300)))
        for free in (path.stat().st_size, 300 * 192 - 1):
            monkeypatch.setattr(memory_check, "available_bytes", lambda free=free: free)
            assert "GB of memory would be needed" in refusal(path)
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 300 * 192)
        assert len(load_samples(path)) == 300

    def test_blocks_are_bounded(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = write_dataflash(tmp_path / "x.bin", imu(times_us(1000), noise(1000)))
        whole = load_samples(path).values
        monkeypatch.setattr(ardupilot_log_format, "BLOCK_ROWS", 7)
        assert load_samples(path).values.tobytes() == whole.tobytes()


class TestReplay:
    def test_a_log_is_a_recording_and_captured_bytes_are_not(self, tmp_path: Path) -> None:
        write_dataflash(tmp_path / "log.bin", imu(times_us(30), noise(30)))
        (tmp_path / "bytes.bin").write_bytes(bytes(100))
        carriers = {}
        for name in ("log.bin", "bytes.bin"):
            settings = replay_link.Settings.model_validate({"path": str(tmp_path / name)})
            carriers[name] = replay_link.build(settings).carrier
        assert carriers == {"log.bin": "messages", "bytes.bin": "bytes"}

    def test_without_pymavlink_the_configuration_is_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write_dataflash(tmp_path / "log.bin", imu(times_us(30), noise(30)))
        monkeypatch.setattr("drivers.extras.find_missing_packages", lambda _: ("pymavlink",))
        with pytest.raises(
            ConfigError, match=r'log\.bin: this recording needs pymavlink: .*pip install "imu-monitor\[ardu'
        ):
            replay_link.build(replay_link.Settings.model_validate({"path": str(tmp_path / "log.bin")}))
