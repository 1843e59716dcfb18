"""A sensor's faults, seen from the far end of its real link: what was done is what the driver counts."""

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
from monitor.simulator import SimulatedDevice
from monitor.simulator.can_port import CanPort
from monitor.simulator.faults import FaultKind, Faults
from monitor.simulator.pty_port import PtyPort
from monitor.simulator.zenoh_port import ZenohPort
from tests.contracts.decoder_examples import EXAMPLES, Example
from tests.support.paced_sensor import follow_reader, is_open
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("tty", reason="pseudo-terminals need a POSIX system")

MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")
BY_NAME = {str(example): example for example in EXAMPLES}
PORTS = {"bytes": PtyPort, "frames": CanPort, "messages": ZenohPort}
SILENCE_S = 0.4
DRAWN = 5000
ENOUGH = 20
WHOLE_AT_END = 5


class Rig:
    """A sensor and its driver; the sensor begins to live once the driver's link is open.

    Args:
        samples: how many the sensor makes at least, paced by its reader; None = without end, paced by the host's clock
        of: at least ENOUGH of them have this fault
    """

    def __init__(
        self,
        example: Example,
        folder: Path,
        speed: float = 10.0,
        seed: int = 3,
        samples: int | None = 150,
        of: FaultKind = FaultKind.WHOLE,
        **faults: float,
    ) -> None:
        decoder = example.build(folder)
        shares = FaultsTable(**faults)
        silence_s = SILENCE_S if samples is None else 0.0  # a thread that waits for a processor is silent too
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
        self.samples = samples and whole_at_end(
            Faults(shares, seed, decoder.carrier).draw_faults(DRAWN).kind, samples, of
        )
        if self.samples is not None:
            all_of_them = float(self.samples)
            follow_reader(self.imu, self.driver, lambda: all_of_them)

    def _push(self, samples: SampleBlock) -> None:
        self.blocks.append(samples)
        self.pushed_s.append(time.monotonic())

    def __enter__(self) -> "Rig":
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
        def true() -> bool:
            self.kinds += [event.kind for event in self.driver.take_events()]
            return condition()

        wait_for(true, lambda: (self.truth, self.driver.state, self.driver.text, self.counts, self.samples))

    def read_all(self) -> None:
        """Wait until the sensor has made all its samples and the reader has counted each of them as what it is."""
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
        """Samples that have come, the repeated ones that were left out among them."""
        return self.counts.received + self.driver.clock.dropped_repeated_rows


def whole_at_end(kinds: np.ndarray, samples: int, of: FaultKind) -> int:
    """How many samples it takes: so many at least, ENOUGH of one kind, and the last of them whole.

    A decoder knows of a damaged frame by the frames after it.
    """
    enough = np.cumsum(kinds == of) >= ENOUGH
    whole = np.convolve(kinds == FaultKind.WHOLE, np.ones(WHOLE_AT_END, int))[: kinds.size] == WHOLE_AT_END
    return samples + int(np.flatnonzero((enough & whole)[samples - 1 :])[0])


COUNTED = ("vectornav_binary", "stim300", "xsens_mtdata2", "ros2_imu", "samples")
CHECKED = ("vectornav_binary", "stim300", "xsens_mtdata2", "vectornav_ascii", "witmotion")


@pytest.fixture(params=("vectornav_binary", "dbc", "ros2_imu", "samples", "text"))
def any_link(request: pytest.FixtureRequest) -> Example:
    return next(example for example in EXAMPLES if example.name == request.param)


def test_without_faults_every_sample_comes(any_link: Example, tmp_path: Path) -> None:
    with Rig(any_link, tmp_path) as rig:
        assert isinstance(rig.imu.port, PORTS[any_link.carrier])
        rig.read_all()
    assert rig.truth.sent == rig.counts.received == rig.samples


@pytest.mark.parametrize("name", COUNTED)
def test_lost_samples_are_counted_exactly_where_the_protocol_counts(name: str, tmp_path: Path) -> None:
    with Rig(BY_NAME[name], tmp_path, of=FaultKind.LOST, lost=0.1) as rig:
        rig.read_all()
    assert rig.counts.bad == 0


@pytest.mark.parametrize("name", ["vectornav_binary", "stim300", "ros2_imu", "samples"])
def test_repeated_samples_are_left_out(name: str, tmp_path: Path) -> None:
    """The first of them come before the clock has seen enough to call anything a repeat."""
    with Rig(BY_NAME[name], tmp_path, of=FaultKind.REPEATED, repeated=0.1) as rig:
        rig.read_all()
        assert rig.truth.repeated >= ENOUGH
        assert 0 <= rig.truth.repeated - rig.driver.clock.dropped_repeated_rows <= 5
        rig.wait(lambda: "samples_repeated" in rig.kinds)


@pytest.mark.parametrize("name", CHECKED)
def test_a_flipped_bit_costs_its_sample_and_no_wrong_one_comes(name: str, tmp_path: Path) -> None:
    with Rig(BY_NAME[name], tmp_path, of=FaultKind.FLIPPED, flipped=0.1) as rig:
        rig.read_all()
    assert rig.counts.bad > 0.8 * rig.truth.flipped


@pytest.mark.parametrize("name", ["vectornav_binary", "xsens_mtdata2", "dbc", "ros2_imu"])
def test_a_cut_frame_costs_its_sample(name: str, tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if str(example) == name or example.name == name)
    with Rig(example, tmp_path, of=FaultKind.CUT, cut=0.1) as rig:
        rig.read_all()


def test_a_flipped_can_frame_is_kept_off_by_the_bus(tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == "dbc")
    with Rig(example, tmp_path, of=FaultKind.FLIPPED, flipped=0.1) as rig:
        rig.read_all()
    assert rig.counts.bad == rig.truth.flipped


def test_bursts_held_back_lose_nothing(tmp_path: Path) -> None:
    with Rig(BY_NAME["vectornav_binary"], tmp_path, speed=1.0, jitter=0.1) as rig:
        rig.read_all()
    assert rig.truth.held_s > 0.05
    gaps = [b - a for a, b in zip(rig.pushed_s, rig.pushed_s[1:], strict=False)]
    assert max(gaps) > 0.05


def test_a_clock_that_is_off_shows_in_the_rate(tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == "dbc")  # without a counter of its own
    with Rig(example, tmp_path, speed=1.0, samples=None, clock=1.25) as rig:
        rig.wait(lambda: rig.truth.total_simulated_samples >= 350)
        # the measured rate converges; late arrivals on a loaded machine only delay it
        rig.wait(lambda: rig.driver.clock.measured_hz == pytest.approx(125.0, rel=0.03))


@pytest.mark.parametrize("name", ["vectornav_binary", "dbc", "ros2_imu"])
def test_a_pulled_cable_is_lost_and_found_again(name: str, tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == name)
    faults = {"unplugged": 0.002, "unplugged_for": 1.5}
    seed = next(seed for seed in range(5000) if pulled_once(seed, FaultsTable(**faults)))
    with Rig(example, tmp_path, speed=1.0, seed=seed, samples=None, **faults) as rig:
        rig.wait(lambda: rig.counts.received > 0 and rig.truth.unplugged >= 1)
        rig.wait(lambda: {"link_lost", "link_back"} <= set(rig.kinds))
        rig.wait(lambda: rig.truth.dropped >= 150)
        before = rig.counts.received
        rig.wait(lambda: rig.driver.state == "running" and rig.counts.received > before)


def pulled_once(seed: int, table: FaultsTable) -> bool:
    """Soon, and then not again for as long as the test may take to find the sensor."""
    pulled = np.flatnonzero(Faults(table, seed, "bytes").draw_faults(2000).pulled)
    return bool(pulled.size) and 30 <= pulled[0] < 100 and not (pulled > pulled[0] + 150).any()
