"""Folders and zip archives with one CSV file per sensor, as phyphox and Sensor Logger write them."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES, Floats
from drivers.errors import ImuError
from drivers.recordings import ReadingOptions, Recording, is_recording, load_samples, memory_check
from monitor.commands.analyze import analyze_recording
from tests.drivers.test_csv_tables import START_NS, N, lines, noise

T_S = np.arange(N) / 100.0


def sensor_logger(values: Floats, t_s: Floats = T_S) -> str:
    t_ns = START_NS + (1e9 * t_s).astype(np.int64)
    return lines("time,seconds_elapsed,z,y,x", t_ns, t_s, *values.T[::-1])


def phyphox(sensor: str, unit: str, values: Floats, t_s: Floats = T_S) -> str:
    header = ",".join(['"Time (s)"', *(f'"{sensor} {axis} ({unit})"' for axis in "xyz")])
    return lines(header, t_s, *values.T)


PHYPHOX = {
    "Gyroscope.csv": phyphox("Gyroscope", "rad/s", noise()[:, :3]),
    "Accelerometer.csv": phyphox("Acceleration", "m/s^2", noise()[:, 3:], T_S + 0.002),
    "meta/device.csv": '"property","value"\n"version","1.1.9"\n',
    "meta/time.csv": '"event","experiment time"\n"START",0.0\n',
}
SENSOR_LOGGER = {
    "Gyroscope.csv": sensor_logger(noise()[:, :3]),
    "TotalAcceleration.csv": sensor_logger(noise()[:, 3:]),
    "Accelerometer.csv": sensor_logger(noise(2)[:, 3:]),
    "Magnetometer.csv": sensor_logger(noise(3)[:, 3:]),
    "Metadata.csv": "version,device name\n3,x\n",
}


def write(path: Path, files: Mapping[str, str]) -> Path:
    if path.suffix == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, text in files.items():
                archive.writestr(name, text)
        return path
    for name, text in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(text)
    return path


def read(path: Path, topic: str | None = None) -> Recording:
    return load_samples(path, options=ReadingOptions(topic=topic))


def refusal(path: Path, topic: str | None = None) -> str:
    with pytest.raises(ImuError) as error:
        read(path, topic)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("name", ["run.zip", "run"])
@pytest.mark.parametrize("files", [PHYPHOX, SENSOR_LOGGER], ids=["phyphox", "sensor-logger"])
def test_both_sensors_are_one_recording(tmp_path: Path, name: str, files: Mapping[str, str]) -> None:
    path = write(tmp_path / name, files)
    found = read(path)
    np.savez(tmp_path / "same.npz", t=T_S, **dict(zip(AXES, noise().T, strict=True)))
    same = load_samples(tmp_path / "same.npz")
    assert is_recording(path)
    assert found.t_s is not None
    assert found.t_s.tobytes() == T_S.tobytes()
    assert found.values.tobytes() == same.values.tobytes()
    first, second = (analyze_recording(one, "octave").analysis.estimate for one in (found, same))
    assert np.array_equal(first.coefficients.value, second.coefficients.value, equal_nan=True)


def test_the_sensor_with_gravity_is_preferred_and_others_can_be_chosen(tmp_path: Path) -> None:
    path = write(tmp_path / "run.zip", SENSOR_LOGGER)
    found = read(path)
    assert found.notes[0] == (
        "Topic Gyroscope+TotalAcceleration is read; the file also contains Gyroscope+Accelerometer."
    )
    chosen = read(path, "Gyroscope+Accelerometer")
    assert chosen.values[:, 3:].tobytes() == noise(2)[:, 3:].tobytes()
    assert read(path, "Gyroscope").axes == AXES[:3]


def test_a_single_sensor(tmp_path: Path) -> None:
    files = {"Raw Data.csv": PHYPHOX["Gyroscope.csv"], "meta/device.csv": PHYPHOX["meta/device.csv"]}
    assert read(write(tmp_path / "run.zip", files)).values[:, :3].tobytes() == noise()[:, :3].tobytes()


def test_mistakes(tmp_path: Path) -> None:
    path = write(tmp_path / "run.zip", SENSOR_LOGGER)
    assert 'contains no topic "Gyroskope"; possible are Gyroscope' in refusal(path, "Gyroskope")
    assert "contains no samples of an IMU; expected CSV files of sensors" in refusal(
        write(tmp_path / "none.zip", {"Metadata.csv": "a,b\n1,2\n"})
    )
    slow = {
        "Gyroscope.csv": SENSOR_LOGGER["Gyroscope.csv"],
        "Accelerometer.csv": sensor_logger(noise()[:, 3:], 2 * T_S),
    }
    assert "mixed rates: Gyroscope 100 Hz and Accelerometer 50 Hz" in refusal(write(tmp_path / "slow.zip", slow))
    (tmp_path / "cut.zip").write_bytes(path.read_bytes()[:-100])
    assert "is no complete zip archive" in refusal(tmp_path / "cut.zip")
    damaged = bytearray(path.read_bytes())
    damaged[2000:2100] = bytes(100)
    (tmp_path / "damaged.zip").write_bytes(damaged)
    assert "Gyroscope.csv cannot be read: Error -3 while decompressing data" in refusal(tmp_path / "damaged.zip")


def test_an_archive_that_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_check, "MIN_UNPACKED_LIMIT_BYTES", 100_000)
    monkeypatch.setattr(memory_check, "MAX_UNPACKING_RATIO", 1)
    message = refusal(write(tmp_path / "run.zip", {"Gyroscope.csv": "time,x,y,z\n" + "0,0,0,0\n" * 50_000}))
    assert "unpacks to more than" in message
