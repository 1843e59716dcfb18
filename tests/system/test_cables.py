"""Test of a device that is unplugged and plugged in again fifty times.

The service leaks no threads, files or memory. Every sample is received, rejected or counted as lost.
"""

import gc
import threading
from pathlib import Path

import numpy as np
import psutil
import pytest

from drivers import driver
from drivers.data_types import concatenate_blocks
from tests.support.waiting import wait_for
from tests.system.rig import RunningService, run_service

WARM_UP, CYCLES, CYCLES_PER_MEASUREMENT = 10, 50, 10
NOISE_BYTES = 2_000_000
"""Tolerance of the memory measurement for all cycles, which is 40 kB per cycle."""
SAMPLE_BYTES = 300
"""Memory of one sample, which this test stores. A slow machine receives more samples per cycle."""
PERIOD_NS = 10_000_000
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


def measure_resources() -> tuple[int, int, int]:
    """Return the number of threads, the number of open files and the resident memory in bytes."""
    gc.collect()
    process = psutil.Process()
    return threading.active_count(), process.num_fds(), process.memory_info().rss


def count_received(run: RunningService) -> int:
    """Return the number of samples that both devices have received since the start."""
    return sum(worker.driver.counts.received for worker in run.service.workers)


def test_fifty_reconnections_leak_no_resources_and_account_for_every_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "MIN_RETRY_PAUSE_S", 0.01)
    monkeypatch.setattr(driver, "MAX_RETRY_PAUSE_S", 0.05)
    with run_service(tmp_path, CONFIG) as run:
        for worker in run.service.workers:
            counts = worker.driver.counts
            wait_for(lambda counts=counts: counts.received >= 10, "the first samples")  # type: ignore[misc]
        for _ in range(WARM_UP):
            unplug_and_plug(run)
        threads, files, memory = measure_resources()
        memories, samples = [memory], [count_received(run)]
        for cycle in range(1, CYCLES + 1):
            unplug_and_plug(run)
            if cycle % CYCLES_PER_MEASUREMENT == 0:
                memories.append(measure_resources()[2])
                samples.append(count_received(run))
        # a running computation of an estimate may still use a thread or a file
        wait_for(lambda: measure_resources()[:2] == (threads, files), "as many threads and files as before")
        # a leak increases the memory in every interval, a single allocation only in one of them
        assert (
            np.median(np.diff(memories) - SAMPLE_BYTES * np.diff(samples))
            < NOISE_BYTES * CYCLES_PER_MEASUREMENT / CYCLES
        )
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
