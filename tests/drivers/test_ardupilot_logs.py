"""Recordings in ArduPilot logs: logs written by the published layout, which pymavlink reads back; topics and damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import DFReader

from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.links import replay_link
from drivers.recordings import ReadingOptions, load_samples, memory_check, save_samples
from drivers.recordings.file_formats import ardupilot_log_format
from tests.support.dataflash import Messages, batches, dataflash_bytes, imu, raw_sensor, table_of, write_dataflash
from tests.support.recordings import float32_noise, load_damaged, load_refused, recordings

GYROS, ACCELS = AXES[:3], AXES[3:]


def times_us(n: int, rate_hz: float = 50.0) -> np.ndarray[Any, Any]:
    return 7_000_000 + np.rint(np.arange(n) / rate_hz * 1e6).astype(np.int64)


def test_pymavlink_reads_the_written_log(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    values = float32_noise(10)
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
    def test_log_gives_the_samples_of_the_npz(self, tmp_path: Path) -> None:
        t_us, values = times_us(8000), float32_noise(8000)
        path = write_dataflash(tmp_path / "x.BIN", imu(t_us, values))
        save_samples(tmp_path / "same.npz", 1000 * t_us, values, np.full(8000, 35.0))
        found, same = load_samples(path), load_samples(tmp_path / "same.npz")
        assert found.t_ns is not None
        assert found.t_ns.tolist() == same.t_ns.tolist() == (1000 * t_us).tolist()
        assert found.values.tobytes() == same.values.tobytes()
        assert found.temperature_c.tobytes() == same.temperature_c.tobytes()
        assert (found.axes, found.notes) == (AXES, ())

    def test_raw_samples_have_the_times_of_the_sensor(self, tmp_path: Path) -> None:
        t_us, values = times_us(100, 1000.0), float32_noise(100)
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
        assert "contains 3 IMU topics: IMU, IMU2, IMU3" in load_refused(path)
        found = load_samples(path, options=ReadingOptions(topic=f"IMU{number if number > 1 else ''}"))
        assert found.values.tobytes() == flights[number - 1][1].astype(np.float64).tobytes()
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, flights[number - 1][0], rtol=0.0, atol=1e-6)


class TestBatches:
    """Batches of 64 samples at 1000 Hz, which begin every second. Those of the accelerometer begin 0.5 s later."""

    STARTS_US = 7_000_000 + 1_000_000 * np.arange(5)
    RATE_HZ = 1000.0

    def logs(self, instance: int = 0) -> tuple[np.ndarray[Any, Any], tuple[Messages, ...]]:
        """Return the counts [2, 5, 64, 3] of gyroscope and accelerometer, and the messages of the autopilot."""
        counts = np.random.default_rng(instance).integers(-2000, 2000, (2, 5, 64, 3))
        header = {"instance": instance, "smp_rate": self.RATE_HZ}
        first = 65_530 + 100 * instance
        gyro = batches(1, self.STARTS_US, counts[0], first, mul=938, **header)
        accel = batches(0, self.STARTS_US + 500_000, counts[1], first + 50, mul=208, **header)
        return counts, (*gyro, *accel)

    def test_batches_are_pieces_with_gaps(self, tmp_path: Path) -> None:
        """The numbers of the batches start again at 0."""
        counts, messages = self.logs()
        path = write_dataflash(tmp_path / "x.bin", *messages)
        expected_us = (self.STARTS_US[:, None] + 1000 * np.arange(64)).ravel()
        for topic, i, scale, axes, shift_us in (("ISBD_GYR", 0, 938, GYROS, 0), ("ISBD_ACC", 1, 208, ACCELS, 500_000)):
            found = load_samples(path, options=ReadingOptions(topic=topic))
            assert found.axes == axes
            assert found.t_ns is not None
            assert found.t_ns.tolist() == (1000 * (expected_us + shift_us)).tolist()
            np.testing.assert_array_equal(found.values[:, 3 * i : 3 * i + 3], counts[i].reshape(-1, 3) / scale)

    def test_the_continuous_messages_are_read_first(self, tmp_path: Path) -> None:
        path = write_dataflash(tmp_path / "x.bin", imu(times_us(300), float32_noise(300)), *self.logs()[1])
        found = load_samples(path)
        assert found.values.tobytes() == float32_noise(300).tobytes()
        assert found.notes == ("Topic IMU is read; the file also contains ISBD_GYR, ISBD_ACC.",)

    def test_batches_of_two_sensors_are_listed(self, tmp_path: Path) -> None:
        path = write_dataflash(tmp_path / "x.bin", *self.logs()[1], *self.logs(1)[1])
        listed = "ISBD_GYR, ISBD_GYR:1, ISBD_ACC, ISBD_ACC:1"
        assert f"contains 4 IMU topics: {listed}; choose with --topic" in load_refused(path)
        found = load_samples(path, options=ReadingOptions(topic="ISBD_ACC:1"))
        np.testing.assert_array_equal(found.values[:, 3:], self.logs(1)[0][1].reshape(-1, 3) / 208)

    def test_batches_of_both_triads_are_not_joined(self, tmp_path: Path) -> None:
        """The autopilot records the triads one after the other."""
        path = write_dataflash(tmp_path / "x.bin", *self.logs()[1])
        refused = load_refused(path, "ISBD_GYR+ISBD_ACC")
        assert "only 0 of 320 samples of ISBD_GYR have a sample of ISBD_ACC at the same time" in refused

    def test_lost_messages_leave_gaps_and_no_wrong_samples(self, tmp_path: Path) -> None:
        counts, (headers, samples, *_) = self.logs()
        kept_headers, kept = np.arange(5) != 2, np.arange(10) != 1
        path = write_dataflash(
            tmp_path / "x.bin", Messages("ISBH", headers.rows[kept_headers]), Messages("ISBD", samples.rows[kept])
        )
        found = load_samples(path)
        rows = np.delete(np.arange(320), [*range(32, 64), *range(128, 192)])
        np.testing.assert_array_equal(found.values[:, :3], counts[0].reshape(-1, 3)[rows] / 938)
        assert found.t_ns is not None
        expected_us = (self.STARTS_US[:, None] + 1000 * np.arange(64)).ravel()
        assert found.t_ns.tolist() == (1000 * expected_us[rows]).tolist()


class TestTopics:
    def test_two_imus_are_listed(self, tmp_path: Path) -> None:
        path = write_dataflash(tmp_path / "x.bin", *(imu(times_us(30), float32_noise(30, i), i) for i in range(2)))
        assert "contains 2 IMU topics: IMU, IMU:1; choose with --topic" in load_refused(path)
        for topic, seed in (("IMU", 0), ("IMU:0", 0), ("IMU:1", 1)):
            assert (
                load_samples(path, options=ReadingOptions(topic=topic)).values.tobytes()
                == float32_noise(30, seed).tobytes()
            )
        assert load_refused(path, "IMU:2").endswith('contains no topic "IMU:2"; possible are IMU:1, IMU')

    def test_mixed_rates(self, tmp_path: Path) -> None:
        gyro = raw_sensor("GYR", times_us(1000, 1000.0), float32_noise(1000)[:, :3])
        path = write_dataflash(
            tmp_path / "x.bin", gyro, raw_sensor("ACC", times_us(800, 800.0), float32_noise(800)[:, 3:])
        )
        assert "mixed rates: GYR 1000 Hz and ACC 800 Hz" in load_refused(path)
        assert load_samples(path, options=ReadingOptions(topic="GYR")).axes == GYROS

    def test_the_message_imu_is_preferred(self, tmp_path: Path) -> None:
        values = float32_noise(30)
        raw = raw_sensor("GYR", times_us(30), values[:, :3]), raw_sensor("ACC", times_us(30), values[:, 3:])
        found = load_samples(write_dataflash(tmp_path / "x.bin", *raw, imu(times_us(30), values)))
        assert found.notes == ("Topic IMU is read; the file also contains GYR+ACC.",)

    def test_no_imu_at_all(self, tmp_path: Path) -> None:
        rows = table_of(TimeUS=times_us(3).astype("<u8"), Alt=np.ones(3, "<f4"))
        path = write_dataflash(tmp_path / "x.bin", Messages("BARO", rows))
        assert load_refused(path).endswith(
            "contains no samples of an IMU; expected messages IMU, GYR and ACC, or ISBH and ISBD, found no messages"
        )


class TestDamage:
    def test_a_log_that_is_cut_off_is_read_up_to_the_cut(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        data = dataflash_bytes([imu(times_us(300), float32_noise(300))])
        for share in (0.3, 0.6, 0.9, 0.999):
            (tmp_path / "x.bin").write_bytes(data[: int(share * len(data))])
            found = load_samples(tmp_path / "x.bin")
            assert 0 < len(found) < 300
            assert found.values.tobytes() == float32_noise(300)[: len(found)].tobytes()
        (tmp_path / "x.bin").write_bytes(data[:200])
        assert "contains no samples of an IMU" in load_refused(tmp_path / "x.bin")
        assert capfd.readouterr() == ("", "")

    def test_flipped_bytes_end_in_one_line_or_a_recording(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        rng = np.random.default_rng(5)
        raw = batches(1, times_us(2), rng.integers(-9, 9, (2, 32, 3)), 0, instance=0, mul=900, smp_rate=1000.0)
        data = dataflash_bytes([*raw, raw_sensor("GYR", times_us(40), float32_noise(40)[:, :3], 1)])
        for _ in range(300):
            damaged = bytearray(data)
            for at in rng.integers(3, len(data) // (1 + rng.integers(8)), 3):
                damaged[at] = rng.integers(256)
            (tmp_path / "x.bin").write_bytes(damaged)
            load_damaged(tmp_path / "x.bin")
        assert capfd.readouterr() == ("", "")

    def test_a_log_is_read_up_to_an_unknown_message(self, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        log = imu(times_us(300), float32_noise(300))
        data = dataflash_bytes([log])
        at = len(data) - 100 * (3 + log.rows.dtype.itemsize)
        (tmp_path / "x.bin").write_bytes(data[:at] + b"\xa3\x95\x10" + data[at:])
        found = load_samples(tmp_path / "x.bin")
        assert found.values.tobytes() == float32_noise(300)[:200].tobytes()
        assert found.notes == (f"The log is damaged at byte {at} of {len(data) + 3} and was read up to there.",)
        assert capfd.readouterr() == ("", "")

    def test_messages_without_bytes(self, tmp_path: Path) -> None:
        data = bytearray(dataflash_bytes([imu(times_us(300), float32_noise(300))]))
        data[89 + 4] = 0  # the length in the second message, which describes IMU
        (tmp_path / "x.bin").write_bytes(data)
        assert "contains no samples of an IMU" in load_refused(tmp_path / "x.bin")

    def test_a_layout_of_another_length(self, tmp_path: Path) -> None:
        rows = table_of(TimeUS=times_us(3).astype("<u8"), GyrX=np.ones(3, "<f4"))
        path = write_dataflash(tmp_path / "x.bin", Messages("IMU", rows, "Qd"))
        assert "is damaged" in load_refused(path)

    def test_captured_bytes_are_no_log(self, tmp_path: Path) -> None:
        (tmp_path / "x.bin").write_bytes(bytes(range(256)) * 20)
        assert load_refused(tmp_path / "x.bin").endswith("captured bytes are decoded by the link replay")

    def test_a_log_that_does_not_fit_is_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = write_dataflash(tmp_path / "x.bin", imu(times_us(300), float32_noise(300)))
        for free in (path.stat().st_size, 300 * 192 - 1):
            monkeypatch.setattr(memory_check, "available_bytes", lambda free=free: free)
            assert "GB of memory would be needed" in load_refused(path)
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 300 * 192)
        assert len(load_samples(path)) == 300

    def test_blocks_are_bounded(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = write_dataflash(tmp_path / "x.bin", imu(times_us(1000), float32_noise(1000)))
        whole = load_samples(path).values
        monkeypatch.setattr(ardupilot_log_format, "BLOCK_ROWS", 7)
        assert load_samples(path).values.tobytes() == whole.tobytes()


class TestReplay:
    def test_a_log_is_a_recording_and_captured_bytes_are_not(self, tmp_path: Path) -> None:
        write_dataflash(tmp_path / "log.bin", imu(times_us(30), float32_noise(30)))
        (tmp_path / "bytes.bin").write_bytes(bytes(100))
        carriers = {}
        for name in ("log.bin", "bytes.bin"):
            settings = replay_link.Settings.model_validate({"path": str(tmp_path / name)})
            carriers[name] = replay_link.build(settings).carrier
        assert carriers == {"log.bin": "messages", "bytes.bin": "bytes"}

    def test_without_pymavlink_the_configuration_is_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write_dataflash(tmp_path / "log.bin", imu(times_us(30), float32_noise(30)))
        monkeypatch.setattr("drivers.host.extras.find_missing_packages", lambda _: ("pymavlink",))
        with pytest.raises(
            ConfigError, match=r'log\.bin: this recording needs pymavlink: .*pip install "imu-monitor\[ardu'
        ):
            replay_link.build(replay_link.Settings.model_validate({"path": str(tmp_path / "log.bin")}))
