"""Tests that the driver counts the faults of a simulated sensor correctly at the far end of its real link."""

import threading
import time
from pathlib import Path
from types import TracebackType

import numpy as np
import pytest

from drivers.data_types import SampleBlock
from drivers.driver import Driver
from drivers.timing.sample_clock import SampleClock
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.settings.loading import FaultsTable, VirtualTable
from monitor.simulator.faults import FaultKind, Faults
from monitor.simulator.ports import CanPort, PtyPort, ZenohPort
from monitor.simulator.simulated_device import SimulatedDevice
from tests.contracts.decoder_examples import EXAMPLES, Example
from tests.support.paced_sensor import follow_reader, is_open
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("tty", reason="pseudo-terminals need a POSIX system")

MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")
EXAMPLES_BY_NAME = {str(example): example for example in EXAMPLES}
PORTS = {"bytes": PtyPort, "frames": CanPort, "messages": ZenohPort}
SILENCE_S = 0.4
DRAWN_FAULTS = 5000
MIN_FAULTS = 20
INTACT_AT_END = 5


class SensorHarness:
    """A sensor and its driver; the sensor starts once the link of the driver is open.

    Args:
        samples: minimum number of samples at the pace of the reader; None means endless samples by the host clock
        fault: at least MIN_FAULTS samples have this fault
    """

    def __init__(
        self,
        example: Example,
        folder: Path,
        speed: float = 10.0,
        seed: int = 3,
        samples: int | None = 150,
        fault: FaultKind = FaultKind.WHOLE,
        **faults: float,
    ) -> None:
        decoder = example.build(folder)
        shares = FaultsTable(**faults)
        silence_s = SILENCE_S if samples is None else 0.0  # a thread that waits for a processor also appears silent
        table = VirtualTable(model=MODEL, seed=seed, speed=speed, silence=silence_s, faults=shares)
        self.imu = SimulatedDevice(table, decoder)
        self.truth = self.imu.fault_counts
        self.blocks: list[SampleBlock] = []
        self.pushed_s: list[float] = []
        clock = SampleClock(decoder.timing, 100.0)
        self.driver = Driver("v", self.imu.port.link, decoder, clock, self._push, silence_s=silence_s)
        self.counts = self.driver.counts
        self._thread = threading.Thread(target=self.driver.run, daemon=True)
        self.kinds: list[str] = []
        self.samples = samples and count_needed_samples(
            Faults(shares, seed, decoder.carrier).draw_faults(DRAWN_FAULTS).kind, samples, fault
        )
        if self.samples is not None:
            allowed = float(self.samples)
            follow_reader(self.imu, self.driver, lambda: allowed)

    def _push(self, samples: SampleBlock) -> None:
        self.blocks.append(samples)
        self.pushed_s.append(time.monotonic())

    def __enter__(self) -> "SensorHarness":
        self.imu.port.plug()
        self._thread.start()
        self.wait(lambda: is_open(self.imu))
        self.imu.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.imu.stop()
        self.driver.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    def wait(self, condition) -> None:
        def collect_events_and_check() -> bool:
            self.kinds += [event.kind for event in self.driver.take_events()]
            return condition()

        wait_for(
            collect_events_and_check,
            lambda: (self.truth, self.driver.state, self.driver.text, self.counts, self.samples),
        )

    def read_all(self) -> None:
        """Wait until the sensor has made all samples and the reader has counted each of them correctly."""
        truth, counts = self.truth, self.counts
        self.wait(
            lambda: (
                truth.total_simulated_samples == self.samples
                and self.received == truth.sent + truth.repeated
                and counts.lost + counts.bad == truth.lost + truth.flipped + truth.cut
            )
        )
        assert truth.dropped == 0

    @property
    def received(self) -> int:
        """Number of received samples, including repeated samples that were left out."""
        return self.counts.received + self.driver.clock.dropped_repeated_rows


def count_needed_samples(kinds: np.ndarray, samples: int, fault: FaultKind) -> int:
    """Return the number of samples that contain MIN_FAULTS faults of one kind and end with intact samples.

    A decoder recognizes a damaged frame by the following frames.
    """
    enough_faults = np.cumsum(kinds == fault) >= MIN_FAULTS
    intact = np.convolve(kinds == FaultKind.WHOLE, np.ones(INTACT_AT_END, int))[: kinds.size] == INTACT_AT_END
    return samples + int(np.flatnonzero((enough_faults & intact)[samples - 1 :])[0])


WITH_COUNTER = (
    *("aceinna_dmu", "bno08x_rvc", "epson_uart-g366pdg0", "inertial_labs", "inertial_sense", "mavlink"),
    "microstrain_mip",
    *(
        "novatel_rawimusx",
        "sbg_ecom",
        "silicon_sensing_dmu",
        "stim300",
        "ublox_esf",
        "vectornav_binary",
        "xsens_mtdata2",
    ),
    *("ros2_imu", "samples"),
)
WITH_CHECKSUM = (
    *("aceinna_dmu", "bno08x_rvc", "epson_uart-g366pdg0", "inertial_labs", "inertial_sense", "mavlink"),
    "microstrain_mip",
    *(
        "novatel_rawimusx",
        "sbg_ecom",
        "silicon_sensing_dmu",
        "stim300",
        "ublox_esf",
        "vectornav_binary",
        "xsens_mtdata2",
    ),
    *("vectornav_ascii", "witmotion"),
)


@pytest.fixture(params=("vectornav_binary", "dbc", "ros2_imu", "samples", "text"))
def link_example(request: pytest.FixtureRequest) -> Example:
    return next(example for example in EXAMPLES if example.name == request.param)


def test_all_samples_arrive_without_faults(link_example: Example, tmp_path: Path) -> None:
    with SensorHarness(link_example, tmp_path) as harness:
        assert isinstance(harness.imu.port, PORTS[link_example.carrier])
        harness.read_all()
    assert harness.truth.sent == harness.counts.received == harness.samples


@pytest.mark.parametrize("name", WITH_COUNTER)
def test_lost_samples_are_counted_exactly_with_a_counter(name: str, tmp_path: Path) -> None:
    with SensorHarness(EXAMPLES_BY_NAME[name], tmp_path, fault=FaultKind.LOST, lost=0.1) as harness:
        harness.read_all()
    assert harness.counts.bad == 0


@pytest.mark.parametrize("name", ["vectornav_binary", "stim300", "ros2_imu", "samples"])
def test_repeated_samples_are_left_out(name: str, tmp_path: Path) -> None:
    """The first repeated samples arrive before the clock can recognize them."""
    with SensorHarness(EXAMPLES_BY_NAME[name], tmp_path, fault=FaultKind.REPEATED, repeated=0.1) as harness:
        harness.read_all()
        assert harness.truth.repeated >= MIN_FAULTS
        assert 0 <= harness.truth.repeated - harness.driver.clock.dropped_repeated_rows <= 5
        harness.wait(lambda: "samples_repeated" in harness.kinds)


@pytest.mark.parametrize("name", WITH_CHECKSUM)
def test_sample_with_a_flipped_bit_is_rejected(name: str, tmp_path: Path) -> None:
    with SensorHarness(EXAMPLES_BY_NAME[name], tmp_path, fault=FaultKind.FLIPPED, flipped=0.1) as harness:
        harness.read_all()
    assert harness.counts.bad > 0.8 * harness.truth.flipped


@pytest.mark.parametrize("name", ["vectornav_binary", "xsens_mtdata2", "dbc", "ros2_imu"])
def test_sample_with_a_truncated_frame_is_rejected(name: str, tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if str(example) == name or example.name == name)
    with SensorHarness(example, tmp_path, fault=FaultKind.CUT, cut=0.1) as harness:
        harness.read_all()


def test_flipped_can_frame_is_rejected_by_the_bus(tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == "dbc")
    with SensorHarness(example, tmp_path, fault=FaultKind.FLIPPED, flipped=0.1) as harness:
        harness.read_all()
    assert harness.counts.bad == harness.truth.flipped


def test_delayed_bursts_lose_nothing(tmp_path: Path) -> None:
    with SensorHarness(EXAMPLES_BY_NAME["vectornav_binary"], tmp_path, speed=1.0, jitter=0.1) as harness:
        harness.read_all()
    assert harness.truth.held_s > 0.05
    gaps = [b - a for a, b in zip(harness.pushed_s, harness.pushed_s[1:], strict=False)]
    assert max(gaps) > 0.05


def test_clock_error_changes_the_measured_rate(tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == "dbc")  # this protocol has no counter
    with SensorHarness(example, tmp_path, speed=1.0, samples=None, clock=1.25) as harness:
        harness.wait(lambda: harness.truth.total_simulated_samples >= 350)
        # The measured rate converges. Late arrivals on a loaded machine only delay the convergence.
        harness.wait(lambda: harness.driver.clock.measured_hz == pytest.approx(125.0, rel=0.03))


@pytest.mark.parametrize("name", ["vectornav_binary", "dbc", "ros2_imu"])
def test_unplugged_sensor_is_lost_and_found_again(name: str, tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == name)
    faults = {"unplugged": 0.002, "unplugged_for": 1.5}
    seed = next(seed for seed in range(5000) if is_unplugged_once(seed, FaultsTable(**faults)))
    with SensorHarness(example, tmp_path, speed=1.0, seed=seed, samples=None, **faults) as harness:
        harness.wait(lambda: harness.counts.received > 0 and harness.truth.unplugged >= 1)
        harness.wait(lambda: {"link_lost", "link_back"} <= set(harness.kinds))
        harness.wait(lambda: harness.truth.dropped >= 150)
        before = harness.counts.received
        harness.wait(lambda: harness.driver.state == "running" and harness.counts.received > before)


def is_unplugged_once(seed: int, table: FaultsTable) -> bool:
    """Return True if the cable is unplugged early and then not again during the test."""
    pulled = np.flatnonzero(Faults(table, seed, "bytes").draw_faults(2000).pulled)
    return bool(pulled.size) and 30 <= pulled[0] < 100 and not (pulled > pulled[0] + 150).any()
