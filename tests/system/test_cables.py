"""Fifty times unplugged and put back: nothing grows, and every sample is received, rejected or known to be missing."""

import gc
import threading
from pathlib import Path

import numpy as np
import psutil
import pytest

from drivers import driver
from drivers.data_types import concatenate_blocks
from tests.support.waiting import wait_for
from tests.system.rig import Running, running

WARM_UP, CYCLES, TEN = 10, 50, 10
NOISE_BYTES = 2_000_000
"""40 kB a cycle."""
SAMPLE_BYTES = 300
"""A sample is kept by this test, and is the first in its place of the ring: more come where the machine is slow."""
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


def pull_and_put_back(run: Running) -> None:
    """A few samples are sent into the air, and some come after it."""
    imu, station = run.station("loose").simulated, run.station("loose")
    imu.port.unplug()
    wait_for(lambda: station.driver.state == "lost", "the loss")
    before = imu.fault_counts.dropped
    wait_for(lambda: imu.fault_counts.dropped >= before + 3, "samples that find no cable")
    received = station.driver.counts.received
    imu.port.plug()
    wait_for(lambda: station.driver.counts.received >= received + 3, "samples after the pause")
    wait_for(lambda: station.driver.state == "running", "the state")


def measured() -> tuple[int, int, int]:
    """Threads, open files, resident bytes."""
    gc.collect()
    process = psutil.Process()
    return threading.active_count(), process.num_fds(), process.memory_info().rss


def received(run: Running) -> int:
    """Samples of both devices since the start."""
    return sum(station.driver.counts.received for station in run.service.workers)


def test_fifty_pulled_cables_leave_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "MIN_RETRY_PAUSE_S", 0.01)
    monkeypatch.setattr(driver, "MAX_RETRY_PAUSE_S", 0.05)
    with running(tmp_path, CONFIG) as run:
        for station in run.service.workers:
            counts = station.driver.counts
            wait_for(lambda counts=counts: counts.received >= 10, "the first samples")  # type: ignore[misc]
        for _ in range(WARM_UP):
            pull_and_put_back(run)
        threads, files, memory = measured()
        memories, samples = [memory], [received(run)]
        for cycle in range(1, CYCLES + 1):
            pull_and_put_back(run)
            if cycle % TEN == 0:
                memories.append(measured()[2])
                samples.append(received(run))
        # the estimate is the service's last chance to be in the middle of something
        wait_for(lambda: measured()[:2] == (threads, files), "as many threads and files as before")
        # what leaks grows with every ten cables; what the service takes once, in one of them
        assert np.median(np.diff(memories) - SAMPLE_BYTES * np.diff(samples)) < NOISE_BYTES * TEN / CYCLES
    kinds = [event.kind for device, event in run.caught.events if device == "loose"]
    assert (kinds.count("link_lost"), kinds.count("link_back")) == (WARM_UP + CYCLES, WARM_UP + CYCLES)
    assert [device for device, event in run.caught.events if event.kind.startswith("link")].count("firm") == 0
    for station in run.service.workers:
        counts, blocks = station.driver.counts, run.caught.blocks[station.name]
        # TimeStartup tells which sample each one was
        number = concatenate_blocks(blocks).ticks // PERIOD_NS
        assert counts.received == number.size == sum(map(len, blocks))
        assert counts.received + counts.bad + counts.lost == number[-1] - number[0] + 1
        missing = np.concatenate([np.r_[one.lost, np.zeros(len(one) - 1, int)] for one in blocks])
        np.testing.assert_array_equal(missing[1:], np.diff(number) - 1)
        assert station.ring.overflowed == 0
    loose, firm = (run.station(name).driver.counts for name in ("loose", "firm"))
    assert loose.lost >= 3 * (WARM_UP + CYCLES)
    # the simulated sensor drops what a reader does not fetch in time on a loaded machine; nothing else may be missing
    assert firm.lost + firm.bad <= run.station("firm").simulated.fault_counts.dropped
