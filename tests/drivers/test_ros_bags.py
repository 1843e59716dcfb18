"""Recordings in ROS bags and MCAP files, which rosbags has written: samples, topics, damage and memory."""

import bz2
import contextlib
import os
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2.reader import zstd

from drivers.data_types import AXES, concatenate_blocks
from drivers.decoders.messages import samples
from drivers.errors import ConfigError, LinkEnded, LinkUnavailable, RecordingError
from drivers.links import replay_link
from drivers.recordings import ReadingOptions, load_samples, memory_check, save_samples
from drivers.recordings.file_formats import ros_bag_format, ros_bag_readers
from tests.support.program import exit_status
from tests.support.recordings import float32_noise, load_damaged, load_refused
from tests.support.ros_bags import (
    KINDS,
    MakeMessage,
    imu_topic,
    px4_topic,
    storage_file,
    temperature_topic,
    text_topic,
    write_bag,
)

START_NS = 1_763_700_000_123_456_789
GYROS, ACCELS = AXES[:3], AXES[3:]


def times_ns(n: int, rate_hz: float = 100.0) -> np.ndarray:
    return START_NS + np.rint(np.arange(n) / rate_hz * 1e9).astype(np.int64)


def seconds(t_ns: np.ndarray) -> np.ndarray:
    """The stamps in s, as a driver of ROS computes them."""
    return t_ns // 1_000_000_000 + (t_ns % 1_000_000_000) * 1e-9


def noise(n: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 6)) * 1e-2 + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]


def remove_index(file: Path) -> None:
    """Remove the summary section of an MCAP file."""
    data = file.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
    file.write_bytes(data[:summary] + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + data[-8:])


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


class TestSamples:
    def test_bag_gives_the_samples_of_the_npz(self, kind: str, tmp_path: Path) -> None:
        t_ns, values = times_ns(6000), noise(6000)
        bag = write_bag(tmp_path, kind, {"/imu/data": imu_topic(t_ns, values), "/text": text_topic(t_ns[::50], "x")})
        save_samples(tmp_path / "same.npz", t_ns, values)
        found, same = load_samples(bag), load_samples(tmp_path / "same.npz")
        assert found.t_ns is not None
        assert found.t_ns.tolist() == same.t_ns.tolist() == t_ns.tolist()
        assert found.values.tobytes() == same.values.tobytes()
        assert (found.axes, found.notes) == (AXES, ())

    @pytest.mark.parametrize("kind", ["sqlite", "mcap", "mcap-chunk"])
    def test_the_file_alone_is_the_bag(self, kind: str, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(50), noise(50))})
        assert load_samples(storage_file(bag)).values.tobytes() == load_samples(bag).values.tobytes()

    def test_several_chunks(self, kind: str, tmp_path: Path) -> None:
        n = 4500  # 1.4 MB; a chunk has 1 MB
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(n), noise(n))})
        assert load_samples(bag).values.tobytes() == noise(n).tobytes()

    @pytest.mark.parametrize(("missing", "axes"), [(GYROS, ACCELS), (ACCELS, GYROS)])
    def test_what_the_messages_do_not_provide_is_absent(
        self, missing: tuple[str, ...], axes: tuple[str, ...], tmp_path: Path
    ) -> None:
        values = noise(20)
        values[:, [AXES.index(axis) for axis in missing]] = np.nan
        for kind in ("ros1", "sqlite"):
            found = load_samples(write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(20), values)}))
            assert found.axes == axes
            assert found.notes == (f"The messages of /imu do not provide {' '.join(missing)}.",)

    def test_without_header_stamps_the_times_of_the_log_are_used(self, kind: str, tmp_path: Path) -> None:
        t_ns = times_ns(20)
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(0 * t_ns, noise(20), log_ns=t_ns)})
        found = load_samples(bag)
        assert found.t_ns is not None
        assert found.t_ns.tolist() == t_ns.tolist()
        assert found.notes == ("20 of 20 messages of /imu have no header stamp; the times of the log are used.",)

    def test_a_message_without_a_stamp_is_left_out(self, tmp_path: Path) -> None:
        t_ns = times_ns(20)
        stamps = np.where(np.arange(20) == 7, 0, t_ns)
        found = load_samples(write_bag(tmp_path, "mcap", {"/imu": imu_topic(stamps, noise(20), log_ns=t_ns)}))
        assert len(found) == 19
        assert "1 of 20 rows have no usable time" in found.notes[0]

    def test_the_end_alone(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "mcap", {"/imu": imu_topic(times_ns(300), noise(300))})
        assert len(load_samples(bag, last_s=1.0)) == 100

    def test_a_folder_of_ros_1_bags_in_the_order_of_their_numbers(self, tmp_path: Path) -> None:
        t_ns = times_ns(30)
        for number, rows in ((0, slice(0, 10)), (2, slice(10, 20)), (10, slice(20, 30))):
            write_bag(tmp_path, "ros1", {"/imu": imu_topic(t_ns[rows], noise(30)[rows])}, f"run_{number}")
        found = load_samples(tmp_path)
        assert found.t_s is not None
        assert found.t_s.tolist() == seconds(t_ns).tolist()
        assert found.notes == ()


class TestTopics:
    def test_two_imus_are_listed(self, kind: str, tmp_path: Path) -> None:
        t_ns = times_ns(20)
        topics = {name: imu_topic(t_ns, noise(20, seed)) for seed, name in enumerate(("/left/imu", "/right/imu"))}
        bag = write_bag(tmp_path, kind, topics)
        assert load_refused(bag) == (
            f"{bag}: contains 2 IMU topics: /left/imu, /right/imu; "
            "choose with --topic (in a configuration file: topic), such as /left/imu"
        )
        assert load_samples(bag, options=ReadingOptions(topic="/right/imu")).values.tobytes() == noise(20, 1).tobytes()

    def test_an_absent_topic_names_the_nearest_first(self, tmp_path: Path) -> None:
        topics = {"/a": imu_topic(times_ns(5), noise(5)), "/imu/data": imu_topic(times_ns(5), noise(5))}
        bag = write_bag(tmp_path, "mcap", topics)
        assert load_refused(bag, "/imu/dat").endswith('contains no topic "/imu/dat"; possible are /imu/data, /a')

    def test_another_type_of_message(self, tmp_path: Path) -> None:
        topics = {"/imu": imu_topic(times_ns(5), noise(5)), "/odom": text_topic(times_ns(5))}
        bag = write_bag(tmp_path, "sqlite", topics)
        assert load_refused(bag, "/odom").endswith(
            'topic "/odom" contains std_msgs/msg/String, expected messages of type sensor_msgs/Imu or '
            "px4_msgs/SensorCombined; possible are /imu"
        )

    def test_no_imu_at_all(self, kind: str, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, kind, {"/odom": text_topic(times_ns(5))})
        expected = "messages of type sensor_msgs/Imu or px4_msgs/SensorCombined"
        said = f"contains no samples of an IMU; expected {expected}, found /odom"
        assert load_refused(bag).endswith(f"{said} (std_msgs/msg/String)")
        assert load_refused(bag, "/odom").endswith(f"expected {expected}")

    def test_a_bag_without_messages(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "mcap", {"/imu": imu_topic(times_ns(0), noise(0)), "/a": text_topic(times_ns(3))})
        assert "contains no samples of an IMU" in load_refused(bag)
        assert load_refused(bag, "/imu").endswith('topic "/imu" contains no messages')

    def test_a_table_has_no_topic(self, tmp_path: Path) -> None:
        save_samples(tmp_path / "x.csv", np.arange(3.0), noise(3))
        assert load_refused(tmp_path / "x.csv", "/imu").endswith("leave out the topic /imu")


class TestJoin:
    def test_gyroscope_of_one_topic_and_accelerometer_of_another(self, tmp_path: Path) -> None:
        t_ns, gyro, accel = times_ns(50), noise(50, 1), noise(50, 2)
        topics = {"/gyro": imu_topic(t_ns, gyro), "/accel": imu_topic(t_ns + 2_000_000, accel)}
        bag = write_bag(tmp_path, "mcap", topics)
        found = load_samples(bag, options=ReadingOptions(topic="/gyro+/accel"))
        assert found.values.tobytes() == np.hstack([gyro[:, :3], accel[:, 3:]]).tobytes()
        assert found.t_s is not None
        assert found.t_s.tolist() == seconds(t_ns).tolist()

    def test_a_lost_message_leaves_a_gap_and_moves_no_other(self, tmp_path: Path) -> None:
        t_ns, values = times_ns(50), noise(50)
        kept = np.arange(50) != 20
        topics = {"/gyro": imu_topic(t_ns, values), "/accel": imu_topic(t_ns[kept] + 1_000_000, values[kept])}
        found = load_samples(write_bag(tmp_path, "mcap", topics), options=ReadingOptions(topic="/gyro+/accel"))
        values[20, 3:] = np.nan
        np.testing.assert_array_equal(found.values, values)

    def test_mixed_rates(self, tmp_path: Path) -> None:
        topics = {
            "/gyro": imu_topic(times_ns(200, 200.0), noise(200)),
            "/accel": imu_topic(times_ns(63, 63.0), noise(63)),
        }
        bag = write_bag(tmp_path, "sqlite", topics)
        for topic in ("/gyro+/accel", None):
            refused = load_refused(bag, topic)
            assert "mixed rates: /gyro 200 Hz and /accel 63 Hz, and samples are never resampled" in refused
            assert f"`imu-monitor analyze {bag} --topic /gyro --json 1.json`" in refused
            assert f"`imu-monitor analyze {bag} --topic /accel --json 2.json`" in refused

    @pytest.mark.parametrize("kind", ["ros1", "mcap"])
    def test_a_camera_publishes_zeros_for_the_other_triad(self, kind: str, tmp_path: Path) -> None:
        t_ns, gyro, accel = times_ns(50), noise(50, 1), noise(50, 2)
        gyro[:, 3:] = accel[:, :3] = 0.0
        names = ("/camera/gyro/sample", "/camera/accel/sample")
        topics = {names[0]: imu_topic(t_ns, gyro), names[1]: imu_topic(t_ns + 1_000_000, accel)}
        bag = write_bag(tmp_path, kind, topics)
        both = load_samples(bag)
        assert both.values.tobytes() == np.hstack([gyro[:, :3], accel[:, 3:]]).tobytes()
        for name, axes in zip(names, (GYROS, ACCELS), strict=True):
            alone = load_samples(bag, options=ReadingOptions(topic=name))
            assert alone.axes == axes
            assert f"The messages of {name} do not provide" in alone.notes[0]

    def test_a_temperature_applies_until_the_next(self, tmp_path: Path) -> None:
        t_ns = times_ns(50)
        warm = temperature_topic(t_ns[5::20], np.array([20.0, 21.0, 22.0]))
        bag = write_bag(tmp_path, "ros1", {"/imu": imu_topic(t_ns, noise(50)), "/imu/temperature": warm})
        assert np.isnan(load_samples(bag).temperature_c).all()
        found = load_samples(bag, options=ReadingOptions(topic="/imu+/imu/temperature"))
        assert found.values.tobytes() == noise(50).tobytes()
        expected = np.repeat([np.nan, 20.0, 21.0, 22.0], [5, 20, 20, 5])
        np.testing.assert_array_equal(found.temperature_c, expected)

    def test_a_temperature_alone_is_no_recording(self, tmp_path: Path) -> None:
        topics = {"/imu": imu_topic(times_ns(9), noise(9)), "/warm": temperature_topic(times_ns(9), np.ones(9))}
        bag = write_bag(tmp_path, "ros1", topics)
        assert load_refused(bag, "/warm").endswith("add one, as in --topic /imu+/warm")


class TestPx4:
    """Messages of PX4, whose definitions are in the bag."""

    T_US = times_ns(300, 250.0) // 1000

    @pytest.mark.parametrize("kind", ["sqlite", "sqlite-message", "mcap", "mcap-chunk"])
    def test_sensor_combined(self, kind: str, tmp_path: Path) -> None:
        values = float32_noise(300)
        relative = np.where(np.arange(300) == 7, 0x7FFFFFFF, 0)
        fields = {"gyro_rad": values[:, :3].astype("f4"), "accelerometer_m_s2": values[:, 3:].astype("f4")}
        topic = px4_topic("SensorCombined", self.T_US, **fields, accelerometer_timestamp_relative=relative)
        found = load_samples(write_bag(tmp_path, kind, {"/fmu/out/sensor_combined": topic}))
        values[7, 3:] = np.nan
        assert found.values.tobytes() == values.tobytes()
        assert found.t_ns is not None
        assert found.t_ns.tolist() == (1000 * self.T_US).tolist()
        assert (found.axes, found.notes) == (AXES, ())

    def test_integrals_become_rates_at_the_time_of_the_sample(self, tmp_path: Path) -> None:
        """The integration times of the gyroscope and of the accelerometer differ."""
        values = float32_noise(300)
        integrals = {
            name: (part * dt_us * 1e-6).astype("f4")
            for name, part, dt_us in (("delta_angle", values[:, :3], 4000), ("delta_velocity", values[:, 3:], 3750))
        }
        intervals = {"delta_angle_dt": np.full(300, 4000), "delta_velocity_dt": np.full(300, 3750)}
        topic = px4_topic("VehicleImu", self.T_US + 500, timestamp_sample=self.T_US, **integrals, **intervals)
        found = load_samples(write_bag(tmp_path, "mcap", {"/fmu/out/vehicle_imu": topic}))
        np.testing.assert_allclose(found.values, values, rtol=2e-7, atol=0.0)
        assert found.t_ns is not None
        assert found.t_ns.tolist() == (1000 * self.T_US).tolist()

    def test_gyroscopes_and_accelerometers_of_two_sensors(self, tmp_path: Path) -> None:
        topics = {}
        for i in range(2):
            for kind, part in (("SensorGyro", slice(3)), ("SensorAccel", slice(3, 6))):
                xyz = dict(zip("xyz", float32_noise(300, i)[:, part].astype("f4").T, strict=True))
                warm = {"timestamp_sample": self.T_US, "temperature": np.full(300, 40.0 + i)}
                topics[f"/{kind.lower()}{i}"] = px4_topic(kind, self.T_US, **xyz, **warm)
        bag = write_bag(tmp_path, "mcap", topics)
        pairs = [f"/sensorgyro{i}+/sensoraccel{i}" for i in range(2)]
        assert f"contains 2 IMU topics: {', '.join(pairs)}; choose with --topic" in load_refused(bag)
        found = load_samples(bag, options=ReadingOptions(topic=pairs[1]))
        assert found.values.tobytes() == float32_noise(300, 1).tobytes()
        assert set(found.temperature_c) == {41.0}

    def test_batches_become_samples(self, tmp_path: Path) -> None:
        counts = np.random.default_rng(3).integers(-300, 300, (3200, 3))
        t_us = self.T_US[0] + 125 * np.arange(3200)
        xyz = {name: counts[:, i].reshape(100, 32).astype("i2") for i, name in enumerate("xyz")}
        sizes = {"samples": np.full(100, 32), "dt": np.full(100, 125.0), "scale": np.full(100, 2.0**-10)}
        topic = px4_topic("SensorGyroFifo", t_us[31::32] + 90, timestamp_sample=t_us[31::32], **xyz, **sizes)
        found = load_samples(write_bag(tmp_path, "mcap", {"/fmu/out/sensor_gyro_fifo": topic}))
        assert found.axes == GYROS
        np.testing.assert_array_equal(found.values[:, :3], counts * 2.0**-10)
        assert found.t_ns is not None
        assert found.t_ns.tolist() == (1000 * t_us).tolist()

    def test_without_a_definition_the_line_names_the_remedy(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "sqlite", {"/fmu/out/sensor_combined": self._any_topic()})
        with contextlib.closing(sqlite3.connect(storage_file(bag))) as database, database:
            database.execute("DELETE FROM message_definitions")
        refused = load_refused(bag)
        assert "contains no definition of px4_msgs/msg/SensorCombined; in a workspace with px4_msgs" in refused
        assert "storage_id: mcap, topics: [/fmu/out/sensor_combined]" in refused

    def test_messages_that_do_not_fit_their_definition(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "sqlite", {"/imu": self._any_topic()})
        with contextlib.closing(sqlite3.connect(storage_file(bag))) as database, database:
            database.execute(
                "UPDATE message_definitions SET encoded_message_definition = "
                "encoded_message_definition || 'float32[3] added' || char(10)"
            )
        assert (
            "topic /imu: a message has 52 bytes, expected 64 according to the definition in the bag; record it with"
            in load_refused(bag)
        )

    def _any_topic(self) -> tuple[str, np.ndarray, MakeMessage]:
        values = float32_noise(300).astype("f4")
        fields = {"gyro_rad": values[:, :3], "accelerometer_m_s2": values[:, 3:]}
        return px4_topic("SensorCombined", self.T_US, **fields)


class TestDamage:
    def test_a_file_that_is_cut_off(self, kind: str, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(2000), noise(2000))})
        file = storage_file(bag)
        data = file.read_bytes()
        for share in (0.02, 0.3, 0.6, 0.9, 0.999):
            file.write_bytes(data[: int(share * len(data))])
            said = load_refused(bag)
            assert "cut off" in said or "is no complete bag" in said, share

    @pytest.mark.parametrize(
        ("kind", "remedy"),
        [
            ("ros1", "`rosbag reindex run.bag`"),
            ("mcap", "`mcap recover run.mcap -o indexed.mcap`"),
            ("sqlite", "`sqlite3 run.db3 .recover | sqlite3 recovered.db3`"),
        ],
    )
    def test_the_line_names_the_remedy(self, kind: str, remedy: str, tmp_path: Path) -> None:
        file = storage_file(write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(2000), noise(2000))}))
        file.write_bytes(file.read_bytes()[:50_000])
        assert remedy in load_refused(file)

    def test_the_remedy_names_the_damaged_file_of_several(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "sqlite", {"/imu": imu_topic(times_ns(2000), noise(2000))})
        (bag / "run_1.db3").write_bytes((bag / "run.db3").read_bytes()[:50_000])
        metadata = bag / "metadata.yaml"
        metadata.write_text(metadata.read_text().replace("- run.db3", "- run.db3\n  - run_1.db3"))
        assert "`sqlite3 run_1.db3 .recover" in load_refused(bag)

    def test_a_ros_1_bag_without_an_index(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "ros1", {"/imu": imu_topic(times_ns(20), noise(20))})
        data = bag.read_bytes()
        at = data.index(b"index_pos=") + len(b"index_pos=")
        bag.write_bytes(data[:at] + bytes(8) + data[at + 8 :])  # as a recorder leaves it after a crash
        assert "Bag is not indexed" in load_refused(bag)

    def test_an_mcap_file_without_an_index(self, tmp_path: Path) -> None:
        file = storage_file(write_bag(tmp_path, "mcap", {"/imu": imu_topic(times_ns(20), noise(20))}))
        remove_index(file)
        assert load_refused(file).endswith(
            "is not indexed; expected an MCAP file with a summary section that lists schemas and chunks; "
            "`mcap recover run.mcap -o indexed.mcap` writes an indexed copy"
        )

    def test_a_missing_file(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "sqlite", {"/imu": imu_topic(times_ns(20), noise(20))})
        storage_file(bag).unlink()
        assert "files are missing" in load_refused(bag)

    def test_a_fifo_in_a_bag_is_not_waited_for(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "sqlite", {"/imu": imu_topic(times_ns(20), noise(20))})
        file = storage_file(bag)
        file.unlink()
        os.mkfifo(file)
        with pytest.raises(RecordingError, match="is a FIFO, not a regular file"):
            load_samples(bag)

    def test_other_content_is_named(self, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, "ros1", {"/imu": imu_topic(times_ns(20), noise(20))})
        other = bag.rename(tmp_path / "run.mcap")
        assert load_refused(other).endswith("its content is a ROS 1 bag: rename it to end in .bag")

    def test_flipped_bytes_end_in_one_line_or_a_recording(self, kind: str, tmp_path: Path) -> None:
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(60), noise(60))})
        file, rng = storage_file(bag), np.random.default_rng(5)
        data = file.read_bytes()
        for _ in range(60):
            damaged = bytearray(data)
            for at in rng.integers(0, len(data), 3):
                damaged[at] = rng.integers(256)
            file.write_bytes(damaged)
            load_damaged(bag)


class TestMemory:
    @pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap-chunk"])
    def test_a_longer_bag_needs_no_more_memory(self, kind: str, tmp_path: Path) -> None:
        peaks = []
        for n in (8_000, 32_000):
            path = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(n), noise(n))}, f"run{n}")
            tracemalloc.start()
            with ros_bag_format._open_bag(path) as (bag, _):
                assert sum(1 for _ in bag.messages(bag.connections)) == n
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert peaks[1] - peaks[0] < 100_000  # 4 bytes per message

    @pytest.mark.parametrize("kind", ["ros1-bz2", "ros1-lz4", "mcap-chunk", "sqlite-message", "mcap-message"])
    def test_messages_that_unpack_to_more_than_the_limit(
        self, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(500), noise(500))})
        load_samples(bag)
        for name in ("MAX_CHUNK_BYTES", "MAX_MESSAGE_BYTES"):
            monkeypatch.setattr(ros_bag_readers, name, 300)
        assert "messages unpack to more than 0.0003 MB at a time" in load_refused(bag)

    def test_a_file_that_unpacks_to_more_than_the_limit(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        bag = write_bag(tmp_path, "sqlite-file", {"/imu": imu_topic(times_ns(500), np.zeros((500, 6)))})
        monkeypatch.setattr(memory_check, "MIN_UNPACKED_LIMIT_BYTES", 1000)
        monkeypatch.setattr(memory_check, "MAX_UNPACKING_RATIO", 1)
        assert "unpacks to more than" in load_refused(bag)

    @pytest.mark.parametrize("pack", [bz2.compress, zstd.compress])
    def test_unpacking_stops_at_the_limit(self, pack: object, tmp_path: Path) -> None:
        packed = pack(bytes(50_000_000))  # type: ignore[operator]
        name = "bz2" if pack is bz2.compress else "zstd"
        tracemalloc.start()
        with pytest.raises(RecordingError, match="more than 2 MB"):
            ros_bag_readers.unpack(tmp_path, packed, name, 2_000_000)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 5_000_000
        assert ros_bag_readers.unpack(tmp_path, pack(b"a") + pack(b"b"), name, 2) == b"ab"  # type: ignore[operator]

    def test_chunks_whose_times_overlap_count_together(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        n = 20_000
        bag = write_bag(tmp_path, "mcap", {"/imu": imu_topic(times_ns(n), noise(n))})
        monkeypatch.setattr(ros_bag_readers, "MAX_CHUNK_BYTES", 1_500_000)
        load_samples(bag)
        file = storage_file(bag)
        data = bytearray(file.read_bytes())
        (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
        at = summary
        while data[at] != 0x02:
            if data[at] == 0x08:
                struct.pack_into("<QQ", data, at + 9, START_NS, START_NS + 1_000_000_000_000)
            at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
        file.write_bytes(data)
        assert "messages unpack to more than 1.5 MB at a time" in load_refused(bag)

    def test_rows_that_do_not_fit_are_refused(self, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        bag = write_bag(tmp_path, kind, {"/imu": imu_topic(times_ns(500), noise(500))})
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 50_000)
        with pytest.raises(ConfigError, match=r"more than 0\.0 GB of memory would be needed"):
            load_samples(bag)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        (None, "run.mcap: contains 3 IMU topics: /left/imu, /right/imu, /slow/imu; choose with --topic"),
        ("/left/im", 'contains no topic "/left/im"; possible are /left/imu, '),
        ("/text", 'topic "/text" contains std_msgs/msg/String, expected messages of type sensor_msgs/Imu or'),
        ("/left/imu+/slow/imu", "mixed rates: /left/imu 100 Hz and /slow/imu 50 Hz, and samples"),
        ("truncated", "run.mcap: is cut off: the end of the MCAP file is missing; `mcap recover run.mcap"),
        ("unindexed", "run.mcap: is not indexed; expected an MCAP file with a summary section"),
    ],
)
def test_commands_print_one_line(
    topic: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    topics = {
        **{name: imu_topic(times_ns(100), noise(100)) for name in ("/left/imu", "/right/imu")},
        "/slow/imu": imu_topic(times_ns(50, 50.0), noise(50)),
        "/text": text_topic(times_ns(5)),
    }
    file = storage_file(write_bag(tmp_path, "mcap", topics))
    if topic == "truncated":
        file.write_bytes(file.read_bytes()[:20_000])
    elif topic == "unindexed":
        remove_index(file)
    options = [] if topic is None or "/" not in topic else ["--topic", topic]
    for command in (["analyze", file], ["convert", file, tmp_path / "out.csv"]):
        assert exit_status(*command, *options) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        (line,) = printed.err.splitlines()
        assert line.startswith(f"imu-monitor: {file}: ")
        assert message in line
    assert not (tmp_path / "out.csv").exists()


def test_the_replay_of_a_bag(tmp_path: Path) -> None:
    t_ns = times_ns(500)
    topics = {"/left/imu": imu_topic(t_ns, noise(500, 1)), "/right/imu": imu_topic(t_ns, noise(500, 2))}
    bag = write_bag(tmp_path, "mcap", topics)
    keys = {"path": str(bag), "speed": "max"}
    link = replay_link.build(replay_link.Settings.model_validate({**keys, "topic": "/right/imu"}))
    chunks = []
    with contextlib.closing(link), contextlib.suppress(LinkEnded):
        link.open()
        while True:
            chunks += link.wait_for_chunks_or_timeout(0.1) or []
    got = concatenate_blocks(samples.build(samples.Settings()).feed(chunks))
    assert got.values.tobytes() == noise(500, 2).tobytes()
    np.testing.assert_allclose(got.t_ns, t_ns, rtol=0.0, atol=500)
    with pytest.raises(LinkUnavailable, match=r"contains 2 IMU topics: /left/imu, /right/imu"):
        replay_link.build(replay_link.Settings.model_validate(keys)).open()
