"""Test of a daemon that is killed at random moments while it records a sensor at 1 kHz.

According to docs/how-to/recording.md, a crash loses at most half a second of samples and the samples in transit. The
test compares the number of samples that the sensor has sent with the batches and rows on the disk. A loaded machine
delays single batches and kills, so the test compares medians with a factor of four.
"""

import re
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from tests.experiments.benchmarks.kill import RATE, Bench, Kill

pytest.importorskip("pyarrow", reason="recording needs the extra arrow")

MAX_BATCH_INTERVAL_S = 0.5
"""Time between two batches according to docs/how-to/recording.md. It is not imported, because it is the code under
test."""
LOAD_FACTOR = 4.0
KILLS = 3
"""Number of kills of daemons that have recorded for at least two seconds."""


def test_kills_lose_no_sample_that_was_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    bench = Bench(tmp_path)
    kills: list[Kill] = []
    try:
        for _ in range(KILLS):
            moment = bench.after(bench.recorded(2 * RATE), float(rng.uniform(0.0, 2.0)))
            kills.append(bench.kill_when(moment))
            bench.check_files()
        bench.kill_when(bench.after(bench.has_port, float(rng.uniform(0.0, 1.0))))  # before or in its first batch
        bench.check_files()
        before, rebuilds = bench.ticks(), len(rebuilt_durations_s(tmp_path))
        status = bench.run_until(
            lambda: len(bench.ticks()) > len(before) + RATE and len(rebuilt_durations_s(tmp_path)) > rebuilds
        )
        ticks = bench.ticks()
    finally:
        bench.close()
    assert status == 0
    assert np.array_equal(ticks[: len(before)], before)
    assert median(length_s for kill in kills for length_s in kill.batches_s) <= LOAD_FACTOR * MAX_BATCH_INTERVAL_S
    assert median(kill.missing_s for kill in kills) <= LOAD_FACTOR * MAX_BATCH_INTERVAL_S
    assert "Traceback" not in (tmp_path / "daemon.log").read_text()
    # the window of five minutes is longer than the recording including its gaps, so it must be rebuilt completely,
    # however long the start takes
    assert rebuilt_durations_s(tmp_path)[-1] == pytest.approx((before[-1] - before[0] + 1) / RATE, rel=0.01)
    bench.check_files()


def rebuilt_durations_s(folder: Path) -> list[float]:
    """Return the durations of the windows that the daemons rebuilt [s], in the order of the log."""
    log = (folder / "daemon.log").read_text()
    return [float(found) for found in re.findall(r"([\d.]+) s of the window were rebuilt from the recording", log)]
