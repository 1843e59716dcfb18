"""Test of a device that is unplugged and plugged in again fifty times.

The service leaks no threads, files or memory. Every sample is received, rejected or counted as lost.
"""

import gc
import subprocess
import sys
import threading
from pathlib import Path

import msgspec
import numpy as np
import psutil
import pytest

from drivers import driver
from drivers.data_types import concatenate_blocks
from tests.support.waiting import PATIENCE_S, wait_for
from tests.system.rig import RunningService, run_service

WARM_UP, CYCLES, CYCLES_PER_MEASUREMENT = 10, 50, 10
NOISE_BYTES = 2_000_000
"""Tolerance of the memory measurement for all cycles, which is 40 kB per cycle."""
SAMPLE_BYTES = 300
"""Memory of one sample, which this test stores. A slow machine receives more samples per cycle."""
PERIOD_NS = 10_000_000
MIN_RETRY_PAUSE_S, MAX_RETRY_PAUSE_S = 0.01, 0.05
CONFIG = """
[[device]]
name = "loose"
rate = 100.0
window = 10.0
driver = { link = "virtual", silence = 0.0 }
[[device]]
name = "firm"
rate = 100.0
window = 10.0
driver = { link = "virtual", seed = 2, silence = 0.0 }
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""


def unplug_and_plug(run: RunningService) -> None:
    """Unplug the device until it has dropped three samples, plug it in, and wait for three received samples."""
    imu, worker = run.worker("loose").simulated, run.worker("loose")
    imu.port.unplug()
    wait_for(lambda: worker.driver.state == "lost", "the loss")
    before = imu.fault_counts.dropped
    wait_for(lambda: imu.fault_counts.dropped >= before + 3, "samples that the unplugged device drops")
    received = worker.driver.counts.received
    imu.port.plug()
    wait_for(lambda: worker.driver.counts.received >= received + 3, "samples after the pause")
    wait_for(lambda: worker.driver.state == "running", "the state")


def count_threads_and_files() -> tuple[int, int]:
    gc.collect()
    return threading.active_count(), psutil.Process().num_fds()


def count_received(run: RunningService) -> int:
    """Return the number of samples that both devices have received since the start."""
    return sum(worker.driver.counts.received for worker in run.service.workers)


def wait_for_first_samples(run: RunningService) -> None:
    for worker in run.service.workers:
        counts = worker.driver.counts
        wait_for(lambda counts=counts: counts.received >= 10, "the first samples")  # type: ignore[misc]


def measure_memory_between_reconnections(folder: Path) -> tuple[list[int], list[int]]:
    """Return the resident memory in bytes and the number of stored samples before and during fifty reconnections."""
    memory, samples = [], []
    with run_service(folder, CONFIG) as run:
        wait_for_first_samples(run)
        for cycle in range(WARM_UP + CYCLES + 1):
            if cycle >= WARM_UP and cycle % CYCLES_PER_MEASUREMENT == 0:
                gc.collect()
                memory.append(psutil.Process().memory_info().rss)
                samples.append(count_received(run))
            unplug_and_plug(run)
    return memory, samples


def test_fifty_reconnections_leak_no_memory(tmp_path: Path) -> None:
    # other tests in this process may leave threads whose memory still grows, so the service runs in a new process
    command = [sys.executable, "-m", "tests.system.test_cables", str(tmp_path)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=PATIENCE_S).stdout
    memory, samples = msgspec.json.decode(output.splitlines()[-1])
    assert len(memory) == 1 + CYCLES // CYCLES_PER_MEASUREMENT
    # a leak increases the memory in every interval, a single allocation only in one of them
    increases = np.diff(memory) - SAMPLE_BYTES * np.diff(samples)
    assert np.median(increases) < NOISE_BYTES * CYCLES_PER_MEASUREMENT / CYCLES


def test_fifty_reconnections_leak_no_threads_or_files_and_account_for_every_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "MIN_RETRY_PAUSE_S", MIN_RETRY_PAUSE_S)
    monkeypatch.setattr(driver, "MAX_RETRY_PAUSE_S", MAX_RETRY_PAUSE_S)
    with run_service(tmp_path, CONFIG) as run:
        wait_for_first_samples(run)
        for _ in range(WARM_UP):
            unplug_and_plug(run)
        before = count_threads_and_files()
        for _ in range(CYCLES):
            unplug_and_plug(run)
        # a running computation of an estimate may still use a thread or a file
        wait_for(lambda: count_threads_and_files() == before, "as many threads and files as before")
    kinds = [event.kind for device, event in run.output.events if device == "loose"]
    assert (kinds.count("link_lost"), kinds.count("link_back")) == (WARM_UP + CYCLES, WARM_UP + CYCLES)
    assert [device for device, event in run.output.events if event.kind.startswith("link")].count("firm") == 0
    for worker in run.service.workers:
        counts, blocks = worker.driver.counts, run.output.blocks[worker.name]
        # the ticks (TimeStartup) give the number of each sample
        number = concatenate_blocks(blocks).ticks // PERIOD_NS
        assert counts.received == number.size == sum(map(len, blocks))
        assert counts.received + counts.bad + counts.lost == number[-1] - number[0] + 1
        missing = np.concatenate([np.r_[one.lost, np.zeros(len(one) - 1, int)] for one in blocks])
        np.testing.assert_array_equal(missing[1:], np.diff(number) - 1)
        assert worker.ring.overflowed == 0
    loose, firm = (run.worker(name).driver.counts for name in ("loose", "firm"))
    assert loose.lost >= 3 * (WARM_UP + CYCLES)
    # the simulated sensor drops samples that a loaded machine does not read in time; no other sample may be missing
    assert firm.lost + firm.bad <= run.worker("firm").simulated.fault_counts.dropped


if __name__ == "__main__":
    driver.MIN_RETRY_PAUSE_S, driver.MAX_RETRY_PAUSE_S = MIN_RETRY_PAUSE_S, MAX_RETRY_PAUSE_S  # type: ignore[misc]
    print(msgspec.json.encode(measure_memory_between_reconnections(Path(sys.argv[1]))).decode())
