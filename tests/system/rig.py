"""A service that runs in a thread of the test process, with an output that records all results."""

import os
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivers.data_types import Event, SampleBlock, concatenate_blocks
from monitor.common.device_health import Health
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.outputs.output import Output
from monitor.daemon.service import Service
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.publishing.messages.results import TotalAndHadamardCurves
from monitor.settings import loading
from tests.support.waiting import PATIENCE_S


class RecordingOutput(Output):
    """Output of the service that stores all blocks, results, events and states for each device."""

    def __init__(self) -> None:
        self.blocks: dict[str, list[SampleBlock]] = {}
        self.estimates: dict[str, Estimate] = {}
        self.totals: dict[str, TotalAndHadamardCurves] = {}
        self.comparisons: dict[str, ModelComparison] = {}
        self.thermal_results: dict[str, list[ThermalIntervalResult]] = {}
        self.compensated_blocks: dict[str, list[SampleBlock]] = {}
        self.drifts: dict[str, list[MeasuredAndSubtractedDrift]] = {}
        self.events: list[tuple[str, Event]] = []
        self.healths: dict[str, Health] = {}

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: int) -> None:
        self.blocks.setdefault(device, []).append(samples)

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        match result:
            case Estimate():
                self.estimates[device] = result
            case ModelComparison():
                self.comparisons[device] = result
            case ThermalIntervalResult():
                self.thermal_results.setdefault(device, []).append(result)
            case MeasuredAndSubtractedDrift():
                self.drifts.setdefault(device, []).append(result)
            case TotalAndHadamardCurves():
                self.totals[device] = result

    def publish_drift_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: int
    ) -> None:
        self.compensated_blocks.setdefault(device, []).append(samples)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        self.events.append((device, event))

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        self.healths[device] = health

    def values(self, device: str) -> np.ndarray:
        return concatenate_blocks(self.blocks[device]).values


class RunningService:
    """Service in a thread of this process. ``prepare`` is called with the service before the thread starts."""

    def __init__(self, path: Path, output: RecordingOutput, prepare: Callable[[Service], None] | None = None) -> None:
        self.service = Service(loading.load_config(path))
        if prepare is not None:
            prepare(self.service)
        self.output = output
        self.service.outputs.append(self.output)
        self._thread = threading.Thread(target=self.service.run)
        self._thread.start()

    def worker(self, name: str) -> DeviceWorker:
        return next(worker for worker in self.service.workers if worker.name == name)

    def stop(self) -> None:
        self.service.request_stop()
        self.join()

    def join(self) -> None:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), "the service did not stop in time"


@contextmanager
def run_service(
    folder: Path, text: str, output: RecordingOutput | None = None, prepare: Callable[[Service], None] | None = None
) -> Iterator[RunningService]:
    """Run a service with this configuration until the end of the ``with`` block."""
    path = folder / "config.toml"
    path.write_text(text)
    run = RunningService(path, output or RecordingOutput(), prepare)
    try:
        yield run
    finally:
        run.stop()


class PluggableTerminal:
    """Pseudo-terminal that can be unplugged and plugged in again under the same path."""

    def __init__(self, folder: Path) -> None:
        self.port = folder / "tty"
        self.master = -1
        self.plug()

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(slave)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(slave))
        os.close(slave)

    def pull(self) -> None:
        self.port.unlink(missing_ok=True)
        os.close(self.master)
        self.master = -1

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(self.master, view) :]


def send_at_rate(send: Callable[[bytes], None], frames: list[bytes], per_second: float, burst: int = 40) -> None:
    """Send ``per_second`` frames per second in bursts, or as many as the machine can."""
    begun = time.monotonic()
    for start in range(0, len(frames), burst):
        early = begun + start / per_second - time.monotonic()
        if early > 0.0:
            time.sleep(early)
        send(b"".join(frames[start : start + burst]))


def check_deviations_equal_batch(output: RecordingOutput, device: str, index: np.ndarray) -> None:
    """Check that the last Allan deviations of a device equal those of a batch computation.

    Parameters
    ----------
    output : RecordingOutput
        Blocks and results of a service whose window has contained all samples.
    device : str
        Name of the device.
    index : ndarray of int, shape (n,)
        Number of each received sample in the order of sending. Samples that were lost or rejected have no number here.
    """
    grid = np.full((index[-1] - index[0] + 1, 6), np.nan)
    grid[index - index[0]] = output.values(device)
    curve = output.estimates[device].curve
    assert curve.n == len(grid)
    avar, terms = overlapping_avar(grid, curve.factors)
    np.testing.assert_array_equal(curve.terms, terms)
    np.testing.assert_allclose(np.sqrt(curve.avar), np.sqrt(avar), rtol=1e-9)
