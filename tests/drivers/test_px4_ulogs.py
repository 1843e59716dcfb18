"""Recordings in PX4 logs: logs written by the published layout, which pyulog reads back; topics, damage and memory."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyulog

from drivers.data_types import AXES
from drivers.recordings import ReadingOptions, load_samples, memory_check, save_samples
from tests.support.recordings import float32_noise, load_damaged, load_refused, recordings
from tests.support.ulog import (
    UlogTopic,
    batches,
    message,
    one_sensor,
    rows_of,
    sensor_combined,
    ulog_bytes,
    vehicle_imu,
    write_ulog,
)

GYROS, ACCELS = AXES[:3], AXES[3:]


def times_us(n: int, rate_hz: float = 250.0) -> np.ndarray[Any, Any]:
    return 5_000_000 + np.rint(np.arange(n) / rate_hz * 1e6).astype(np.int64)


def test_pyulog_reads_the_written_log(tmp_path: Path) -> None:
    t_us, values = times_us(100), float32_noise(100)
    path = write_ulog(tmp_path / "x.ulg", sensor_combined(t_us, values), vehicle_imu(t_us, values, 4000, instance=1))
    log = pyulog.ULog(str(path))
    assert not log.file_corruption
    assert [(one.name, one.multi_id) for one in log.data_list] == [("sensor_combined", 0), ("vehicle_imu", 1)]
    data = log.get_dataset("sensor_combined").data
    assert data["timestamp"].tolist() == t_us.tolist()
    assert [data[f"gyro_rad[{i}]"].tolist() for i in range(3)] == values[:, :3].T.tolist()


class TestSamples:
    def test_log_gives_the_samples_of_the_npz(self, tmp_path: Path) -> None:
        t_us, values = times_us(8000), float32_noise(8000)
        path = write_ulog(tmp_path / "x.ulg", sensor_combined(t_us, values))
        save_samples(tmp_path / "same.npz", 1000 * t_us, values)
        found, same = load_samples(path), load_samples(tmp_path / "same.npz")
        assert found.t_ns is not None
        assert found.t_ns.tolist() == same.t_ns.tolist() == (1000 * t_us).tolist()
        assert found.values.tobytes() == same.values.tobytes()
        assert (found.axes, found.notes) == (AXES, ())

    def test_integrals_become_rates(self, tmp_path: Path) -> None:
        """The time is that of the sample, not that of the message."""
        t_us, values = times_us(100), float32_noise(100)
        found = load_samples(write_ulog(tmp_path / "x.ulg", vehicle_imu(t_us, values, 4000)))
        assert found.t_ns is not None
        assert found.t_ns.tolist() == (1000 * t_us).tolist()
        np.testing.assert_allclose(found.values, values, rtol=2e-7, atol=0.0)

    def test_an_integral_over_no_time_is_missing(self, tmp_path: Path) -> None:
        found = load_samples(write_ulog(tmp_path / "x.ulg", vehicle_imu(times_us(9), float32_noise(9), 0)))
        assert np.isnan(found.values).all()

    def test_the_status_of_vehicle_imu_brings_the_temperature(self, tmp_path: Path) -> None:
        t_us = times_us(100)
        warm = rows_of(t_us[10::50] + 1, temperature_gyro=np.array([31.5, 32.5], "<f4"))
        status = UlogTopic("vehicle_imu_status", warm)
        path = write_ulog(tmp_path / "x.ulg", vehicle_imu(t_us, float32_noise(100), 4000), status)
        expected = np.repeat([np.nan, 31.5, 32.5], [11, 50, 39])
        np.testing.assert_array_equal(load_samples(path).temperature_c, expected)

    def test_gyroscope_and_accelerometer_of_one_number_are_an_imu(self, tmp_path: Path) -> None:
        t_us, values = times_us(100), float32_noise(100)
        gyro = one_sensor("sensor_gyro", t_us, values[:, :3], 40.0)
        path = write_ulog(tmp_path / "x.ulg", gyro, one_sensor("sensor_accel", t_us + 300, values[:, 3:], 41.0))
        found = load_samples(path)
        assert found.values.tobytes() == values.tobytes()
        assert set(found.temperature_c) == {41.0}
        alone = load_samples(path, options=ReadingOptions(topic="sensor_gyro"))
        assert alone.axes == GYROS
        assert set(alone.temperature_c) == {40.0}

    def test_batches_become_samples(self, tmp_path: Path) -> None:
        rng, n = np.random.default_rng(3), 8000
        t_us = 5_000_000 + 125 * np.arange(n)
        gyro, accel = rng.integers(-300, 300, (2, n, 3))
        scales = (0.0010652644, 0.0047884033)
        path = write_ulog(
            tmp_path / "x.ulg",
            batches("sensor_gyro_fifo", t_us, gyro, scales[0]),
            batches("sensor_accel_fifo", t_us, accel, scales[1]),
        )
        found = load_samples(path)
        assert len(found) > 7900
        assert found.t_ns is not None
        assert found.t_ns.tolist() == (1000 * t_us[: len(found)]).tolist()
        wanted = np.concatenate([gyro * scales[0], accel * scales[1]], axis=1)[: len(found)]
        np.testing.assert_allclose(found.values, wanted, rtol=1e-6)
        assert found.notes == ()

    def test_batches_of_different_rates(self, tmp_path: Path) -> None:
        counts = np.random.default_rng(3).integers(-300, 300, (8000, 3))
        gyro = batches("sensor_gyro_fifo", 5_000_000 + 125 * np.arange(8000), counts, 1e-3)
        accel = batches("sensor_accel_fifo", 5_000_000 + 250 * np.arange(4000), counts[:4000], 1e-3)
        path = write_ulog(tmp_path / "x.ulg", gyro, accel)
        assert "mixed rates: sensor_gyro_fifo 8000 Hz and sensor_accel_fifo 4000 Hz" in load_refused(path)
        alone = load_samples(path, options=ReadingOptions(topic="sensor_gyro_fifo"))
        assert alone.axes == GYROS

    def test_messages_without_a_new_acceleration(self, tmp_path: Path) -> None:
        topic = sensor_combined(times_us(10), float32_noise(10))
        topic.rows["accelerometer_timestamp_relative"][4] = 0x7FFFFFFF
        found = load_samples(write_ulog(tmp_path / "x.ulg", topic))
        assert np.argwhere(np.isnan(found.values)).tolist() == [[4, 3], [4, 4], [4, 5]]

    def test_lost_messages_are_noted(self, tmp_path: Path) -> None:
        path = write_ulog(tmp_path / "x.ulg", sensor_combined(times_us(10), float32_noise(10)), dropouts_ms=(20, 30))
        assert load_samples(path).notes == ("The logger lost messages 2 times, for 0.05 s in total.",)

    @pytest.mark.data
    def test_the_samples_of_a_real_flight_controller(self, tmp_path: Path) -> None:
        with np.load(recordings() / "px4-bench" / "bench-69s.npz") as file:
            t_s, values = file["t"], np.column_stack([file[axis] for axis in AXES])
        found = load_samples(write_ulog(tmp_path / "x.ulg", sensor_combined(np.rint(t_s * 1e6).astype(int), values)))
        assert found.values.tobytes() == values.astype(np.float64).tobytes()
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, t_s, rtol=0.0, atol=1e-6)


class TestTopics:
    def test_the_imu_of_the_autopilot_is_preferred(self, tmp_path: Path) -> None:
        t_us = times_us(50)
        other = vehicle_imu(t_us, float32_noise(50, 2), 4000)
        path = write_ulog(tmp_path / "x.ulg", other, sensor_combined(t_us, float32_noise(50, 1)))
        found = load_samples(path)
        assert found.values.tobytes() == float32_noise(50, 1).tobytes()
        assert found.notes == ("Topic sensor_combined is read; the file also contains vehicle_imu.",)

    def test_two_imus_are_listed(self, tmp_path: Path) -> None:
        t_us = times_us(50)
        imus = [vehicle_imu(t_us, float32_noise(50, i), 4000, instance=i) for i in range(2)]
        path = write_ulog(tmp_path / "x.ulg", sensor_combined(t_us, float32_noise(50)), *imus)
        assert (
            "contains 3 IMU topics: sensor_combined, vehicle_imu, vehicle_imu:1; choose with --topic"
            in load_refused(path)
        )
        np.testing.assert_allclose(
            load_samples(path, options=ReadingOptions(topic="vehicle_imu:1")).values, float32_noise(50, 1), rtol=2e-7
        )
        for name in ("vehicle_imu", "vehicle_imu:0"):
            np.testing.assert_allclose(
                load_samples(path, options=ReadingOptions(topic=name)).values, float32_noise(50, 0), rtol=2e-7
            )
        assert 'contains no topic "vehicle_imu:2"; possible are vehicle_imu:1' in load_refused(path, "vehicle_imu:2")

    def test_mixed_rates(self, tmp_path: Path) -> None:
        gyro = one_sensor("sensor_gyro", times_us(1000, 1000.0), float32_noise(1000)[:, :3], 40.0)
        accel = one_sensor("sensor_accel", times_us(800, 800.0), float32_noise(800)[:, 3:], 40.0)
        path = write_ulog(tmp_path / "x.ulg", gyro, accel)
        assert "mixed rates: sensor_gyro 1000 Hz and sensor_accel 800 Hz" in load_refused(path)
        assert load_samples(path, options=ReadingOptions(topic="sensor_accel")).axes == ACCELS

    def test_no_imu_at_all(self, tmp_path: Path) -> None:
        path = write_ulog(tmp_path / "x.ulg", UlogTopic("cpuload", rows_of(times_us(3), load=np.ones(3, "<f4"))))
        assert "contains no samples of an IMU; expected one of the topics sensor_combined, vehicle_imu" in load_refused(
            path
        )

    def test_a_gyroscope_alone(self, tmp_path: Path) -> None:
        path = write_ulog(tmp_path / "x.ulg", one_sensor("sensor_gyro", times_us(9), float32_noise(9)[:, :3], 40.0))
        assert load_samples(path).axes == GYROS


class TestDamage:
    def test_a_log_that_is_cut_off_is_read_up_to_the_cut(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        data = ulog_bytes([sensor_combined(times_us(300), float32_noise(300))])
        for share in (0.3, 0.6, 0.9, 0.999):
            (tmp_path / "x.ulg").write_bytes(data[: int(share * len(data))])
            found = load_samples(tmp_path / "x.ulg")
            assert 0 < len(found) < 300
            assert found.values.tobytes() == float32_noise(300)[: len(found)].tobytes()
        (tmp_path / "x.ulg").write_bytes(data[:200])
        assert "contains no samples of an IMU" in load_refused(tmp_path / "x.ulg")
        assert capfd.readouterr() == ("", "")

    def test_flipped_bytes_end_in_one_line_or_a_recording(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        t_us, rng = times_us(40), np.random.default_rng(5)
        gyro = one_sensor("sensor_gyro", t_us, float32_noise(40)[:, :3], 40.0)
        raw = batches("sensor_gyro_fifo", t_us, rng.integers(-9, 9, (40, 3)), 1e-3)
        kinds = ([sensor_combined(t_us, float32_noise(40)), gyro], [raw])
        for data in (ulog_bytes(topics) for topics in kinds for _ in range(150)):
            damaged = bytearray(data)
            for at in rng.integers(0, len(data), 3):
                damaged[at] = rng.integers(256)
            (tmp_path / "x.ulg").write_bytes(damaged)
            load_damaged(tmp_path / "x.ulg")
        assert capfd.readouterr() == ("", "")

    def test_what_is_no_log(self, tmp_path: Path) -> None:
        (tmp_path / "x.ulg").write_bytes(b"#ROSBAG V2.0\n" + bytes(1000))
        assert load_refused(tmp_path / "x.ulg").endswith("its content is a ROS 1 bag: rename it to end in .bag")

    @pytest.mark.parametrize(
        "formats",
        [("a:b[60000] x;", "b:c[60000] x;", "c:uint64_t[60000] x;"), ("a:a[2] x;",), ("a:b x;", "b:a[9] x;a[9] y;")],
    )
    def test_nested_messages_are_not_expanded(self, formats: tuple[str, ...], tmp_path: Path) -> None:
        parts = [message("F", text.encode()) for text in formats]
        parts.append(message("A", struct.pack("<BH", 0, 0) + b"a"))
        (tmp_path / "x.ulg").write_bytes(ulog_bytes([]) + b"".join(parts))
        tracemalloc.start()
        assert "a message has more than 65535 bytes" in load_refused(tmp_path / "x.ulg")
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
        tracemalloc.stop()

    def test_a_log_that_does_not_fit_is_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = write_ulog(tmp_path / "x.ulg", sensor_combined(times_us(300), float32_noise(300)))
        for free in (path.stat().st_size - 1, 300 * 192 - 1):
            monkeypatch.setattr(memory_check, "available_bytes", lambda free=free: free)
            assert "GB of memory would be needed" in load_refused(path)
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 300 * 192)
        assert len(load_samples(path)) == 300
