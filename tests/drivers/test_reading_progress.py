"""Progress that the readers of recordings report while they read."""

from pathlib import Path

import numpy as np
import pytest

from drivers.recordings import load_samples, reading_progress, save_samples
from monitor.commands.recording_loading import DecoderChoice, LoadingOptions, load_recording
from tests.support import dataflash, ros_bags, ulog

N = 20_000
T_US = 5_000_000 + 4000 * np.arange(N)
VALUES = np.random.default_rng(1).standard_normal((N, 6)).astype(np.float32).astype(np.float64)


def write_recording(folder: Path, name: str) -> Path:
    if name in ros_bags.KINDS:
        return ros_bags.write_bag(folder, name, {"/imu": ros_bags.imu_topic(1000 * T_US, VALUES)})
    path = folder / name
    if name == "x.ulg":
        return ulog.write_ulog(path, ulog.sensor_combined(T_US, VALUES))
    if name == "x.bin":
        return dataflash.write_dataflash(path, dataflash.imu(T_US, VALUES))
    save_samples(path, 1e-6 * T_US, VALUES)
    return path


@pytest.mark.parametrize("name", ["x.csv", "x.csv.gz", "ros1", "sqlite", "mcap-chunk", "x.ulg", "x.bin"])
def test_share_increases_to_the_end_of_the_file(tmp_path: Path, name: str) -> None:
    path = write_recording(tmp_path, name)
    shares: list[float] = []
    with reading_progress.listen_to_reading_progress(shares.append):
        load_samples(path)
    assert len(shares) > 2
    assert shares == sorted(shares)
    assert 0.0 < shares[0] < 0.5
    assert 0.95 < shares[-1] <= 1.0
    reported = len(shares)
    load_samples(path)
    assert len(shares) == reported  # nobody listens any more


@pytest.mark.parametrize("suffix", [".txt", ".csv"])
def test_commands_receive_the_share(tmp_path: Path, suffix: str) -> None:
    steps: list[tuple[str, float | None]] = []
    if suffix == ".csv":
        load_recording(write_recording(tmp_path, "x.csv"), report_progress=lambda *step: steps.append(step))
    else:
        (tmp_path / "x.txt").write_text("".join(f"{x:.6f} {y:.6f}\n" for x, y in VALUES[:, :2]))
        choice = DecoderChoice("text", {"columns": ["gx", "gy"], "gyro_unit": "rad/s"})
        load_recording(
            tmp_path / "x.txt", LoadingOptions(100.0, decoder=choice), report_progress=lambda *step: steps.append(step)
        )
    word = "reading" if suffix == ".csv" else "decoding"
    assert {step for step, _ in steps} == {word}
    assert steps[0] == (word, None)
    share = steps[-1][1]
    assert share is not None
    assert share > 0.99
    assert len(steps) > 3
