"""Tests of the replay link: kinds of files, replay speed, end of the file, and damaged files."""

import gzip
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.data_types import ANY_SOURCE, EXTENDED_ID, Chunk, concatenate_blocks
from drivers.decoders.messages import samples
from drivers.errors import ConfigError, LinkEnded, LinkUnavailable
from drivers.links import base, replay_link
from drivers.links.base import Link
from drivers.recordings import load_samples
from tests.support.settings import read_settings

FRAMES = [(0x9, False, bytes(range(8))), (0x0CF02AE2, True, b"\x00\x7d\x00\x7d\x00\x7d\x00\x05")] * 20


def build(path: Path, speed: str | float = "max", **keys: Any) -> Link:
    return replay_link.build(read_settings(replay_link.Settings, {"path": str(path), "speed": speed, **keys}))


def read_all(link: Link) -> tuple[list[Chunk], str]:
    """Return all chunks and the text of ``LinkEnded``."""
    chunks: list[Chunk] = []
    link.open()
    try:
        for _ in range(10_000):
            chunks += link.wait_for_chunks_or_timeout(1.0) or []
    except LinkEnded as end:
        return chunks, str(end)
    finally:
        link.close()
    raise AssertionError("the replay did not end")


class SimulatedClock:
    """Clock that replaces the clock of the replay. It advances only while the replay waits."""

    def __init__(self, link: Link, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        monkeypatch.setattr(replay_link, "time", self)
        monkeypatch.setattr(base, "time", self)
        monkeypatch.setattr(link._closing, "wait", self._wait)  # type: ignore[attr-defined]

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)

    def _wait(self, seconds: float) -> bool:
        self.now_s += seconds
        return False


def write_recording(path: Path, n: int = 1000, rate_hz: float = 100.0) -> None:
    rng = np.random.default_rng(1)
    columns = {a: rng.normal(size=n) for a in ("gx", "gy", "gz", "ax", "ay", "az", "temperature")}
    np.savez(path, fs=rate_hz, **columns)  # type: ignore[arg-type]


# --- recordings ----------------------------------------------------------------------------------


def test_recording_is_replayed_without_changes(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    write_recording(path)
    link = build(path)
    assert (link.carrier, link.epoch) == ("messages", "unix")
    chunks, _ = read_all(link)
    got = concatenate_blocks(samples.build(samples.Settings()).feed(chunks))
    recording = load_samples(path)
    np.testing.assert_array_equal(got.values, recording.values)
    np.testing.assert_array_equal(got.temperature_c, recording.temperature_c)
    np.testing.assert_allclose(got.t_ns, np.arange(1000) * 1e7, atol=500)
    assert got.lost == 0


def test_size_of_one_read_is_limited(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    write_recording(path, 200_000)
    link = build(path)
    link.open()
    sizes = []
    while sum(sizes) < 8_000_000:
        sizes.append(sum(len(chunk.data) for chunk in link.wait_for_chunks_or_timeout(1.0) or []))
    link.close()
    assert max(sizes) < 1_300_000  # 56 bytes a sample, 4096 samples a message


def test_uneven_times_of_a_recording_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    rows = ["t,gz,ax", "1700000000.0,1,2", "1700000000.013,3,", "1700000000.011,5,6", "1700000007.5,7,8"]
    path.write_text("\n".join(rows) + "\n")
    chunks, _ = read_all(build(path))
    got = concatenate_blocks(samples.build(samples.Settings()).feed(chunks))
    assert got.t_ns - 1_700_000_000_000_000_000 == pytest.approx([0, 13e6, 11e6, 7.5e9], abs=500)
    np.testing.assert_array_equal(got.values[:, 2], [1, 3, 5, 7])
    np.testing.assert_array_equal(got.values[:, 3], [2, np.nan, 6, 8])


def test_recording_without_times_needs_a_rate(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("gz\n1\n2\n3\n")
    with pytest.raises(LinkUnavailable, match="rate"):
        build(path).open()
    chunks, _ = read_all(build(path, rate=50.0))
    got = concatenate_blocks(samples.build(samples.Settings()).feed(chunks))
    assert got.t_ns.tolist() == [0, 20_000_000, 40_000_000]


@pytest.mark.parametrize(("speed", "expected_s"), [("recorded", 0.99), (4, 0.2475)])
def test_replay_follows_the_recorded_times_divided_by_the_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: str | float, expected_s: float
) -> None:
    path = tmp_path / "r.npz"
    write_recording(path, n=100)
    link = build(path, speed)
    clock = SimulatedClock(link, monkeypatch)
    chunks, _ = read_all(link)
    assert clock.now_s == pytest.approx(expected_s, abs=1e-6)
    # each read returns about 20 ms of data and not the whole file
    assert len(chunks) >= 10


def test_opening_again_restarts_the_replay(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    write_recording(path, n=10)
    link = build(path)
    assert read_all(link)[0] == read_all(link)[0]


# --- CAN logs ------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log", ".trc", ".csv", ".log.gz", ".asc.gz"])
def test_logs_of_python_can_are_replayed(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    with can.Logger(path) as logger:
        for i, (identifier, extended, data) in enumerate(FRAMES):
            logger.on_message_received(
                can.Message(
                    timestamp=1_700_000_000.0 + 0.01 * i,
                    arbitration_id=identifier,
                    is_extended_id=extended,
                    data=data,
                    channel=1,
                )
            )
    link = build(path)
    assert (link.carrier, link.epoch) == ("frames", "unix")
    chunks, _ = read_all(link)
    assert [(c.address, c.data) for c in chunks] == [
        (identifier | (EXTENDED_ID if extended else 0), data) for identifier, extended, data in FRAMES
    ]
    assert np.diff([c.t_ns for c in chunks]) == pytest.approx(np.full(len(FRAMES) - 1, 1e7), abs=2e5)


@pytest.mark.parametrize(("flags", "end"), [("", ""), ("RX - - ", "   '.p..'"), ("TX B E ", "")])
def test_screen_text_of_candump_is_replayed(tmp_path: Path, flags: str, end: str) -> None:
    path = tmp_path / "screen.log"
    lines = [
        f" ({1_700_000_000.0 + 0.01 * i:.6f})  can0  {flags}{identifier:0{8 if extended else 3}X}   [{len(data)}]  "
        f"{data.hex(' ').upper()}{end}\n"
        for i, (identifier, extended, data) in enumerate(FRAMES)
    ]
    path.write_text("".join(lines))
    chunks, _ = read_all(build(path))
    assert [(c.address, c.data) for c in chunks] == [
        (identifier | (EXTENDED_ID if extended else 0), data) for identifier, extended, data in FRAMES
    ]
    assert np.diff([c.t_ns for c in chunks]) == pytest.approx(np.full(len(FRAMES) - 1, 1e7), abs=2e5)


IMU_ADDRESSES = [0x100, 0x0CF02AFE | EXTENDED_ID | ANY_SOURCE]


@pytest.mark.parametrize(("own", "other"), [("100", "100"), ("0CF02AE2", "0CF02A11")])
def test_sensors_on_two_buses_are_not_mixed(tmp_path: Path, own: str, other: str) -> None:
    path = tmp_path / "drive.log"
    rows = [f"({i / 100:.6f}) {bus} {name}#00\n" for i in range(9) for bus, name in (("can0", own), ("can1", other))]
    path.write_text("".join(rows))
    link = build(path)
    link.set_address_filter(IMU_ADDRESSES)
    with pytest.raises(LinkUnavailable, match=r"several channels, can0 and can1, .*--option channel=can0"):
        link.open()
    for channel in ("can0", "can1"):
        chosen = build(path, channel=channel)
        chosen.set_address_filter(IMU_ADDRESSES)
        assert len(read_all(chosen)[0]) == 9
    absent = build(path, channel="can2")
    with pytest.raises(LinkUnavailable, match=r"no frame of the channel can2; the channels are can0, can1"):
        absent.open()


def test_one_sensor_beside_equal_addresses_of_other_devices(tmp_path: Path) -> None:
    """The sensor has two messages on two buses, and both buses carry a message 555 of something else."""
    path = tmp_path / "drive.log"
    frames = (("can0", "100"), ("can0", "555"), ("can1", "555"), ("can1", "0CF02AE2"))
    path.write_text("".join(f"({i / 100:.6f}) {bus} {name}#00\n" for i in range(9) for bus, name in frames))
    link = build(path)
    link.set_address_filter(IMU_ADDRESSES)
    assert {chunk.address for chunk in read_all(link)[0]} == {0x100, 0x0CF02AE2 | EXTENDED_ID}


def test_frames_before_damage_are_replayed(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    path.write_text("(0.0) can0 100#00\n(0.1) can0 100#01\n(0.2) can0 1#zz\n")
    chunks, end = read_all(build(path))
    assert [chunk.data for chunk in chunks] == [b"\x00", b"\x01"]
    assert "cut off or damaged" in str(end)


def write_frames(path: Path) -> None:
    with gzip.open(path, "wt") as stream:
        stream.write("t,channel,id_hex,extended,dlc,data_hex\n")
        for i, (identifier, extended, data) in enumerate(FRAMES):
            stream.write(f"{0.01 * i:.6f},{1 + i % 2},{identifier:x},{int(extended)},{len(data)},{data.hex()}\n")


def test_csv_file_of_frames_is_replayed(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv.gz"
    write_frames(path)
    chunks, _ = read_all(build(path))
    assert [c.data for c in chunks] == [f[2] for f in FRAMES]
    assert [c.t_ns for c in chunks] == [i * 10_000_000 for i in range(len(FRAMES))]
    selected, _ = read_all(build(path, channel="2"))
    assert {c.address for c in selected} == {0x0CF02AE2 | EXTENDED_ID}


def test_optional_columns_of_a_csv_file_of_frames_may_be_missing(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("t,bus,id_hex,data_hex\n0.5,0,7ff,00ff\n0.6,0,800,\n")
    chunks, _ = read_all(build(path))
    assert [(c.address, c.data) for c in chunks] == [(0x7FF, b"\x00\xff"), (0x800 | EXTENDED_ID, b"")]


def test_truncated_log_is_replayed_up_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv.gz"
    rows = [f"{0.01 * i:.6f},9,{i * 2654435761 % (1 << 32):08x}" for i in range(5000)]
    compressed = gzip.compress(("t,id_hex,data_hex\n" + "\n".join(rows) + "\n").encode())
    path.write_bytes(compressed[: len(compressed) // 2])
    chunks, end = read_all(build(path))
    assert 100 < len(chunks) < 5000
    assert "cut off" in end
    assert [c.data.hex() for c in chunks] == [row[-8:] for row in rows[: len(chunks)]]


def test_damaged_line_ends_the_replay(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("t,id_hex,data_hex\n0.1,9,00\n0.2,9,0x\n0.3,9,02\n")
    chunks, end = read_all(build(path))
    assert len(chunks) == 1
    assert "damaged" in end


def test_log_is_replayed_at_the_recorded_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frames.csv.gz"
    write_frames(path)
    link = build(path, "recorded")
    clock = SimulatedClock(link, monkeypatch)
    chunks, _ = read_all(link)
    assert clock.now_s == pytest.approx(0.39, abs=1e-6)
    assert len(chunks) == len(FRAMES)


# --- captured bytes ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.bin", "a.raw", "a.txt", "a.txt.gz"])
def test_file_of_bytes_is_replayed(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    data = np.random.default_rng(2).bytes(20_000)
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    link = build(path)
    assert (link.carrier, link.epoch) == ("bytes", "monotonic")
    chunks, _ = read_all(link)
    assert b"".join(c.data for c in chunks) == data


@pytest.mark.parametrize(("speed", "expected_s"), [("recorded", 0.5), ("max", 0.0)])
def test_bytes_are_replayed_at_the_configured_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: str, expected_s: float
) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(10_000))
    link = build(path, speed, bytes_per_second=20_000.0)
    clock = SimulatedClock(link, monkeypatch)
    chunks, _ = read_all(link)
    assert clock.now_s == pytest.approx(expected_s, abs=1e-6)
    # the times are those of the serial line and do not depend on the replay speed
    spacing = np.diff([c.t_ns for c in chunks]) / [len(c.data) for c in chunks[1:]]
    assert spacing == pytest.approx(np.full(len(chunks) - 1, 1e9 / 20_000), rel=1e-4)


# --- wrong settings and files -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("a.npx", {}),
        ("a", {}),
        ("a.npz", {"speed": "fast"}),
        ("a.npz", {"speed": 0.0}),
        ("a.npz", {"speed": -1}),
        ("a.npz", {"rate": 0.0}),
        ("a.bin", {"bytes_per_second": -5.0}),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, name: str, keys: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as raised:
        build(tmp_path / name, **keys)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["a.npz", "a.csv", "a.log", "a.blf", "a.bin", "a.txt.gz"])
def test_missing_file_raises_link_unavailable(tmp_path: Path, name: str) -> None:
    with pytest.raises(LinkUnavailable, match=r"a\.") as raised:
        build(tmp_path / name).open()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["a.npz", "a.blf", "a.bin.gz"])
def test_file_of_another_kind_raises_link_unavailable(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"this is none of it, " * 20)
    with pytest.raises(LinkUnavailable):
        build(tmp_path / name).open()
