"""Integer times in ns, µs or ms are read exactly. All other times are read as float64 in s."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet

import imu_monitor
from drivers.errors import RecordingError
from drivers.recordings import Recording, load_samples
from drivers.recordings.reading_options import create_reading_options

START_NS = 1_700_000_000_123_456_789


def read_text(path: Path, text: str, **options: Any) -> Recording:
    path.write_text(text)
    return load_samples(path, options=create_reading_options(options))


def write_table(path: Path, table: Any) -> None:
    (parquet.write_table if path.suffix == ".parquet" else feather.write_feather)(table, path)


@pytest.mark.parametrize(
    ("header", "fields", "t_ns"),
    [
        ("timestamp_ns,gx", ["1700000000123456789", "1700000000123456791"], [START_NS, START_NS + 2]),
        ("time (us),gx", ["1700000000123456", "+7"], [START_NS // 1000 * 1000, 7000]),
        ("t_ms,gx", ["-5", " 7 "], [-5_000_000, 7_000_000]),
        ("t,t_ns,gx", ["1.5,1500000001", "2,2000000001"], [1_500_000_001, 2_000_000_001]),
    ],
)
def test_exact(tmp_path: Path, header: str, fields: list[str], t_ns: list[int]) -> None:
    found = read_text(tmp_path / "x.csv", header + "\n" + "".join(f"{field},1.5\n" for field in fields))
    assert found.times is not None
    assert found.times.dtype == np.int64
    assert found.times.tolist() == t_ns


@pytest.mark.parametrize(
    ("header", "fields", "t_s"),
    [
        ("timestamp_ns,gx", ["1000000000", "1500000000.5"], [1.0, 1.5000000005]),
        ("timestamp_ns,gx", ["1000000000", "1.5e9"], [1.0, 1.5]),
        ("t,gx", ["1", "2"], [1.0, 2.0]),
    ],
)
def test_in_seconds(tmp_path: Path, header: str, fields: list[str], t_s: list[float]) -> None:
    found = read_text(tmp_path / "x.csv", header + "\n" + "".join(f"{field},1.5\n" for field in fields))
    assert found.times is not None
    assert found.times.dtype == np.float64
    assert found.times.tolist() == t_s


@pytest.mark.parametrize("field", ["", "nan", "99999999999999999999", "-9223372036854775808", "?"])
def test_a_row_without_a_time_is_left_out(tmp_path: Path, field: str) -> None:
    text = f"timestamp_ns,gx\n{START_NS},1\n{field},2\n{START_NS + 1},3\n"
    found = read_text(tmp_path / "x.csv", text)
    assert found.times is not None
    assert found.times.tolist() == [START_NS, START_NS + 1]
    assert found.values[:, 0].tolist() == [1.0, 3.0]
    assert "1 of 3 rows have no usable time and were left out." in found.notes


def test_a_wrong_unit_is_suggested(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="give --time-unit ns"):
        read_text(tmp_path / "x.csv", f"t,gx\n{START_NS},1\n{START_NS + 1},2\n")
    assert read_text(tmp_path / "x.csv", f"time (ms),gx\n{START_NS},1\n", time_unit="ns").times.tolist() == [START_NS]


def test_arrow_integers_with_missing_times(tmp_path: Path) -> None:
    for integer in (pa.int64(), pa.uint64(), pa.int32()):
        times = [1, None, 3] if integer == pa.int32() else [START_NS, None, START_NS + 1]
        for suffix in (".parquet", ".arrow"):
            write_table(tmp_path / f"x{suffix}", pa.table({"t_ns": pa.array(times, integer), "gx": [1.0, 2.0, 3.0]}))
            found = load_samples(tmp_path / f"x{suffix}")
            assert found.times is not None
            assert found.times.tolist() == [times[0], times[2]]
            assert found.values[:, 0].tolist() == [1.0, 3.0]


@pytest.mark.parametrize("kind", ["<i8", ">i8", "<u8"])
def test_a_truncated_npz_file(tmp_path: Path, kind: str) -> None:
    t_ns = START_NS + np.arange(1000)
    np.savez(tmp_path / "x.npz", gx=1e-3 * np.arange(1000.0), t_ns=t_ns.astype(kind))
    data = (tmp_path / "x.npz").read_bytes()
    (tmp_path / "x.npz").write_bytes(data[: data.index(b"t_ns.npy") + 4200])
    times = load_samples(tmp_path / "x.npz").times
    assert times is not None
    assert 500 < times.size < 600
    assert times.tolist() == t_ns[: times.size].tolist()


def test_segments_in_seconds_and_in_ns_are_joined_in_seconds(tmp_path: Path) -> None:
    (tmp_path / "1.csv").write_text("t,gx\n0.5,1\n")
    (tmp_path / "2.csv").write_text("t_ns,gx\n1000000000,1\n")
    times = load_samples(tmp_path).times
    assert times is not None
    assert times.tolist() == [0.5, 1.0]


def test_python_interface(tmp_path: Path) -> None:
    t_ns = START_NS + 10_000_000 * np.arange(200, dtype=np.uint64) + np.arange(200, dtype=np.uint64)
    columns = {"t": np.zeros(200), "t_ns": t_ns, "gx": np.random.default_rng(0).normal(size=200)}
    np.savez(tmp_path / "x.npz", **columns)
    recording = imu_monitor.read_recording(tmp_path / "x.npz")
    recording.save(tmp_path / "x.csv")
    again = imu_monitor.read_recording(tmp_path / "x.csv", last_s=1.0)
    assert recording.t_ns is not None
    assert again.t_ns is not None
    assert recording.t_ns.tolist() == t_ns.tolist()
    assert again.t_ns.tolist() == t_ns[-100:].tolist()
    assert again.t_s is not None
    assert np.array_equal(again.t_s, again.t_ns // 10**9 + again.t_ns % 10**9 * 1e-9)
    assert imu_monitor.analyze(columns).to_dict()["axes"] == imu_monitor.analyze(recording).to_dict()["axes"]
    with pytest.raises(imu_monitor.ConfigError, match=r"values: t_ns: float64 of shape \(200,\), expected integers"):
        imu_monitor.analyze({"t_ns": columns["t"], "gx": columns["gx"]})
