"""Tables as other programs and boards write them: rates, units and samples are those of the sensor.

Each file has the peculiarity of its source. Unless stated otherwise, each axis has white noise of 0.05 °/s and 0.01
m/s² at 100 Hz, so the random walks are 0.300 °/√h and 0.0600 m/s/√h.
"""

from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import times_to_seconds
from drivers.errors import ConfigError, RecordingError
from drivers.recordings import Recording, load_samples
from drivers.recordings.reading_options import ReadingOptions
from drivers.recordings.writing import save_samples
from drivers.units import DEGREE

CASES = Path(__file__).parent / "recording_cases"
ROWS = 400


def random_walks(found: Recording) -> tuple[float, float, float]:
    """Return the rate in Hz, and the random walks of the gyroscopes in °/√h and of the accelerometers in m/s/√h."""
    assert found.times is not None
    rate_hz = 1.0 / float(np.mean(np.diff(times_to_seconds(found.times))))
    sigma = np.std(np.diff(found.values, axis=0), axis=0) / np.sqrt(2.0) / np.sqrt(rate_hz) * 60.0
    return rate_hz, float(np.mean(sigma[:3])) / DEGREE, float(np.mean(sigma[3:]))


@pytest.mark.parametrize(
    ("name", "rate_hz", "gyro", "accel", "said"),
    [
        ("time-in-ms", 100.0, 0.300, 0.060, "time in ms (100 Hz)"),
        ("time-in-us", 100.0, 0.300, 0.060, "time in us (100 Hz)"),
        ("time-iso8601", 100.0, 0.300, 0.060, ""),
        ("unit-in-column-name", 100.0, 0.060, 0.060, ""),
        ("unit-row", 100.0, 0.300, 0.060, "The line after the header states the units."),
        ("trailing-tab", 100.0, 0.300, np.nan, ""),
        ("preamble", 100.0, 0.300, 0.060, "accelerometer in g"),
        ("boot-text", 100.0, 0.300, 0.060, "gyro in deg/s"),
        ("degs-as-rads", 104.0, 0.130, 0.0345, "gyro in deg/s"),  # 0.55 rad/s would turn gravity, which stands still
        ("gyro-only-zero-accel", 100.0, 0.300, 0.0, ""),
    ],
)
def test_case(name: str, rate_hz: float, gyro: float, accel: float, said: str) -> None:
    found = load_samples(CASES / f"{name}.csv")
    assert random_walks(found) == pytest.approx((rate_hz, gyro, accel), rel=0.1, nan_ok=True)
    assert said in " ".join(found.notes)
    assert not any("not samples" in note for note in found.notes)


def table(
    header: str = "t,gx_dps,gy_dps,gz_dps", separator: str = ",", times: list[str] | None = None, end: str = ""
) -> str:
    """Return a table with the noise of the cases, and lines that end with ``end``."""
    rates = np.random.default_rng(1).normal(size=(ROWS, 3)) * 0.05
    listed = times or [f"{i / 100.0:.2f}" for i in range(ROWS)]
    rows = [[time, *(f"{rate:.5f}" for rate in row)] for time, row in zip(listed, rates, strict=True)]
    return "".join(f"{separator.join(row)}{end}\n" for row in [header.split(","), *rows])


CLOCK = [f"{(23 * 3600 + 59 * 60 + 58 + i // 100) % 86_400 // 3600:02}:{(59 + (58 + i // 100) // 60) % 60:02}:"
         f"{(58 + i // 100) % 60:02}.{i % 100 * 10:03}" for i in range(ROWS)]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (table(end=","), "utf-8"),
        (table(separator="\t", end="\t"), "utf-8"),
        (table(separator=";", end=";"), "utf-8"),
        ("// start\n// range 250 dps\n" + table(), "utf-8"),
        ("; made by a logger\n;\n" + table(separator=";"), "utf-8"),
        ("! gain 4\n* bench\n-- x --\n" + table(), "utf-8"),
        ("Logger 3.1\nrate,100,Hz\nrange,250,dps\n\n" + table(), "utf-8"),
        ("% gyro of the left arm\n" + table(), "utf-8"),
        ("sep=,\n" + table(), "utf-8-sig"),
        (table(), "utf-16"),
        (table("t,gx,gy,gz\ns,deg/s,deg/s,deg/s").replace("\ns,", "\ns,"), "utf-8"),
        (table("Time (s),X Gyro [dps],Y Gyro [dps],Z Gyro [dps]"), "utf-8"),
        (table("Time,gx_dps,gy_dps,gz_dps", times=CLOCK), "utf-8"),
        (table("Timestamp,gx_dps,gy_dps,gz_dps", times=[f"01/03/2024 {one}" for one in CLOCK]), "utf-8"),
        (table("date,time,gx_dps,gy_dps,gz_dps", times=[f"2024-03-01,{one}" for one in CLOCK]), "utf-8"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("suffix", [".csv", ".txt", ".log", ".dat", ".gcsv"])
def test_text_layouts(tmp_path: Path, text: str, encoding: str, suffix: str) -> None:
    if suffix != ".csv" and encoding == "utf-16":
        return
    path = tmp_path / f"x{suffix}"
    path.write_bytes(text.encode(encoding))
    found = load_samples(path)
    assert len(found) == ROWS
    assert random_walks(found)[:2] == pytest.approx((100.0, 0.300), rel=0.1)


def test_an_unknown_unit_in_the_row_of_units(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(table("t,gx,gy,gz\ns,furlong,deg/s,deg/s"))
    with pytest.raises(ConfigError, match='column of gx: "furlong" is not a unit of angular rate'):
        load_samples(tmp_path / "x.csv")


def test_rows_of_three_sensors() -> None:
    path = CASES / "three-imus-in-rows.csv"
    with pytest.raises(ConfigError, match=r"3 sensors: I=0 \(403 rows\), I=1 .*; choose with --topic .*, such as I=0"):
        load_samples(path)
    for topic in ("I=1", "1"):
        found = load_samples(path, options=ReadingOptions(topic=topic))
        assert len(found) == 403
        assert random_walks(found) == pytest.approx((100.0, 0.300, 0.060), rel=0.1)
        assert found.values[:, 0].mean() == pytest.approx(0.018, abs=0.002)
    with pytest.raises(ConfigError, match=r'no rows of "7"; it has I=0, I=1, I=2'):
        load_samples(path, options=ReadingOptions(topic="7"))


def test_rows_of_two_sensors_with_names(tmp_path: Path) -> None:
    lines = table(times=[f"{i // 2 / 100.0:.2f}" for i in range(ROWS)]).splitlines()
    rows = [f"{line},{['left', 'right'][i % 2]}" for i, line in enumerate(lines[1:])]
    (tmp_path / "x.csv").write_text("\n".join([f"{lines[0]},imu_id", *rows]) + "\n")
    with pytest.raises(ConfigError, match=r"imu_id=left \(200 rows\), imu_id=right \(200 rows\)"):
        load_samples(tmp_path / "x.csv")
    found = load_samples(tmp_path / "x.csv", options=ReadingOptions(topic="right"))
    assert random_walks(found)[:2] == pytest.approx((100.0, 0.300), rel=0.15)


@pytest.mark.parametrize(
    ("first", "second", "topic"),
    [("imu0_gyro_{}_dps", "imu1_gyro_{}_dps", "imu1"), ("left gyro {} (dps)", "right gyro {} (dps)", "right"),
     ("gyro1_{} [dps]", "gyro2_{} [dps]", "2")],
)  # fmt: skip
def test_columns_of_two_sensors(tmp_path: Path, first: str, second: str, topic: str) -> None:
    rates = np.random.default_rng(2).normal(size=(ROWS, 6)) * 0.05 + np.repeat([0.0, 1.0], 3)
    header = ",".join(["t", *(pattern.format(axis) for pattern in (first, second) for axis in "xyz")])
    rows = np.c_[np.arange(ROWS) / 100.0, rates]
    np.savetxt(tmp_path / "x.csv", rows, "%.6f", ",", header=header, comments="")
    with pytest.raises(ConfigError, match=rf"the columns of 2 sensors: .*{topic} \(gx gy gz\); choose with --topic"):
        load_samples(tmp_path / "x.csv")
    found = load_samples(tmp_path / "x.csv", options=ReadingOptions(topic=topic))
    assert found.values[:, :3].mean() == pytest.approx(DEGREE, rel=0.05)


@pytest.mark.parametrize("sensors", [2, 3])
def test_alternating_rows_without_a_name(tmp_path: Path, sensors: int) -> None:
    rates = np.random.default_rng(2).normal(size=(2000, 3)) * 0.001
    rates[::sensors, 1] += 0.01
    rows = enumerate(rates.tolist())
    text = "".join(f"{i // sensors * 0.01:.2f},{x:.6f},{y:.6f},{z:.6f}\n" for i, (x, y, z) in rows)
    (tmp_path / "x.csv").write_text(f"t,gx,gy,gz\n{text}")
    with pytest.raises(RecordingError, match=f"the rows of {sensors} sensors alternate"):
        load_samples(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", "a pointer of Git LFS: fetch .* `git lfs"),
        ("\n<!DOCTYPE html>\n<html>\n<body>\n", "an HTML page: download the file itself"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("suffix", [".csv", ".npz", ".bag", ".ulg"])
def test_a_file_in_place_of_a_recording(tmp_path: Path, text: str, expected: str, suffix: str) -> None:
    (tmp_path / f"x{suffix}").write_text(text)
    with pytest.raises(RecordingError, match=expected):
        load_samples(tmp_path / f"x{suffix}")


def test_needed_columns_are_not_hidden(tmp_path: Path) -> None:
    names = [f"flag_{i}" for i in range(40)] + ["p", "q", "r"]
    (tmp_path / "x.csv").write_text(",".join(names) + "\n" + ",".join("1" * len(names)) + "\n")
    with pytest.raises(RecordingError, match=r"flag_39, p, q, r\)"):
        load_samples(tmp_path / "x.csv")


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_only_tables_of_other_programs_are_doubted_because_of_their_noise(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    values = 0.1 * np.random.default_rng(1).standard_normal((6000, 6))  # 0.6 °/s/√Hz, more than any MEMS gyroscope
    values[:, 5] += 9.81
    save_samples(path, 10_000_000 * np.arange(6000), values)
    np.testing.assert_allclose(load_samples(path).values, values)
    save_samples(path, np.arange(6000) / 100.0, values)
    with pytest.raises(ConfigError, match=r"fit several: gyro in .*rad/s .*--gyro-unit"):
        load_samples(path)


def test_line_at_a_quarter_of_the_rate_is_one_sensor(tmp_path: Path) -> None:
    times_s = np.arange(4000) / 100.0
    values = 1e-3 * np.random.default_rng(3).standard_normal((4000, 6))
    values[:, 5] += 9.81
    values[:, 2] += 0.01 * np.sin(2.0 * np.pi * 25.0 * times_s + 0.3)
    save_samples(tmp_path / "x.csv", times_s, values)
    np.testing.assert_allclose(load_samples(tmp_path / "x.csv").values, values)
    values[:, 3:] += 0.02 * np.sin(2.0 * np.pi * 25.0 * times_s + 0.3)[:, None]
    save_samples(tmp_path / "x.csv", times_s, values)
    with pytest.raises(RecordingError, match="fourth row agrees"):
        load_samples(tmp_path / "x.csv")
    assert len(load_samples(tmp_path / "x.csv", options=ReadingOptions(assume=True))) == 4000
