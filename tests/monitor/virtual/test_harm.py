"""A sensor's faults, seen from the far end of its real link: what was done is what the driver counts."""

import threading
import time
from pathlib import Path
from types import TracebackType

import numpy as np
import pytest

from drivers.clock import SampleClock
from drivers.driver import Driver
from drivers.sample import SampleBlock
from monitor.settings import CONFIG_FOLDER, FaultsTable, VirtualTable
from monitor.virtual import VirtualImu
from monitor.virtual.can_port import CanPort
from monitor.virtual.faults import Faults
from monitor.virtual.pty_port import PtyPort
from monitor.virtual.zenoh_port import ZenohPort
from tests.contracts.decoder_examples import EXAMPLES, Example
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("tty", reason="pseudo-terminals need a POSIX system")

MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")
BY_NAME = {str(example): example for example in EXAMPLES}
PORTS = {"bytes": PtyPort, "frames": CanPort, "messages": ZenohPort}
SILENCE_S = 0.4


class Rig:
    """A sensor and its driver; the sensor begins to live once the driver's link is open."""

    def __init__(self, example: Example, folder: Path, speed: float = 10.0, seed: int = 3, **faults: float) -> None:
        decoder = example.build(folder)
        table = VirtualTable(model=MODEL, seed=seed, speed=speed, silence=SILENCE_S, faults=FaultsTable(**faults))
        self.imu = VirtualImu(table, decoder)
        self.truth = self.imu.truth
        self.blocks: list[SampleBlock] = []
        self.pushed_s: list[float] = []
        self.driver = Driver(
            "v", self.imu.link, decoder, SampleClock(decoder.timing, 100.0), self._push, silence_s=SILENCE_S
        )
        self.counts = self.driver.counts
        self._thread = threading.Thread(target=self.driver.run, daemon=True)
        self.kinds: list[str] = []

    def _push(self, samples: SampleBlock) -> None:
        self.blocks.append(samples)
        self.pushed_s.append(time.monotonic())

    def __enter__(self) -> "Rig":
        self.imu.plug()
        self._thread.start()
        self.wait(self._opened)
        self.imu.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.imu.stop()
        self.driver.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    def _opened(self) -> bool:
        link, port = self.imu.link, self.imu.port
        if isinstance(port, ZenohPort):
            return bool(port._publisher.matching_status.matching)
        return getattr(link, "_port" if isinstance(port, PtyPort) else "_bus") is not None

    def wait(self, condition) -> None:
        def true() -> bool:
            self.kinds += [event.kind for event in self.driver.take_events()]
            return condition()

        wait_for(true, lambda: (self.truth, self.driver.state, self.driver.text, self.counts))

    def accounted(self, *, lost: int = 0, bad: int = 0) -> bool:
        """Return True if the reader has counted every sample that the sensor sent, lost or damaged on purpose.

        On a loaded machine the sensor also drops samples for which the terminal has no room. The reader counts such a
        sample as lost or bad, except before the first and after the last sample that it receives.
        """
        missing = self.counts.lost + self.counts.bad - lost - bad
        received = self.counts.received + self.driver.clock.repeated
        return received == self.truth.sent + self.truth.repeated and 0 <= missing <= self.truth.dropped


COUNTED = ("vectornav_binary", "stim300", "xsens_mtdata2", "ros2_imu", "samples")
CHECKED = ("vectornav_binary", "stim300", "xsens_mtdata2", "vectornav_ascii", "witmotion")


@pytest.fixture(params=("vectornav_binary", "dbc", "ros2_imu", "samples", "text"))
def any_link(request: pytest.FixtureRequest) -> Example:
    return next(example for example in EXAMPLES if example.name == request.param)


def test_without_faults_every_sample_comes(any_link: Example, tmp_path: Path) -> None:
    with Rig(any_link, tmp_path) as rig:
        assert isinstance(rig.imu.port, PORTS[any_link.carrier])
        rig.wait(lambda: rig.truth.made >= 150 and rig.accounted())
    assert rig.truth.made == rig.truth.sent + rig.truth.dropped


@pytest.mark.parametrize("name", COUNTED)
def test_lost_samples_are_counted_exactly_where_the_protocol_counts(name: str, tmp_path: Path) -> None:
    with Rig(BY_NAME[name], tmp_path, lost=0.1) as rig:
        rig.wait(lambda: rig.truth.lost >= 20 and rig.accounted(lost=rig.truth.lost))
    assert rig.counts.bad <= rig.truth.dropped


@pytest.mark.parametrize("name", ["vectornav_binary", "stim300", "ros2_imu", "samples"])
def test_repeated_samples_are_left_out(name: str, tmp_path: Path) -> None:
    """The first of them come before the clock has seen enough to call anything a repeat."""
    with Rig(BY_NAME[name], tmp_path, repeated=0.1) as rig:
        clock = rig.driver.clock
        rig.wait(lambda: rig.truth.repeated >= 20 and rig.accounted())
        assert 0 <= rig.truth.repeated - clock.repeated <= 5
        rig.wait(lambda: "samples_repeated" in rig.kinds)


@pytest.mark.parametrize("name", CHECKED)
def test_a_flipped_bit_costs_its_sample_and_no_wrong_one_comes(name: str, tmp_path: Path) -> None:
    with Rig(BY_NAME[name], tmp_path, flipped=0.1) as rig:
        rig.wait(lambda: rig.truth.flipped >= 20 and rig.accounted(bad=rig.truth.flipped))
    assert rig.counts.bad > 0.8 * rig.truth.flipped


@pytest.mark.parametrize("name", ["vectornav_binary", "xsens_mtdata2", "dbc", "ros2_imu"])
def test_a_cut_frame_costs_its_sample(name: str, tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if str(example) == name or example.name == name)
    with Rig(example, tmp_path, cut=0.1) as rig:
        rig.wait(lambda: rig.truth.cut >= 20 and rig.accounted(bad=rig.truth.cut))


def test_a_flipped_can_frame_is_kept_off_by_the_bus(tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == "dbc")
    with Rig(example, tmp_path, flipped=0.1) as rig:
        rig.wait(lambda: rig.truth.flipped >= 20 and rig.accounted(bad=rig.truth.flipped))
    assert rig.truth.flipped <= rig.counts.bad <= rig.truth.flipped + rig.truth.dropped


def test_bursts_held_back_lose_nothing(tmp_path: Path) -> None:
    with Rig(BY_NAME["vectornav_binary"], tmp_path, speed=1.0, jitter=0.1) as rig:
        rig.wait(lambda: rig.truth.made >= 150 and rig.accounted())
        assert rig.truth.held_s > 0.05
        gaps = [b - a for a, b in zip(rig.pushed_s, rig.pushed_s[1:], strict=False)]
        assert max(gaps) > 0.05
    assert rig.counts.bad <= rig.truth.dropped


def test_a_clock_that_is_off_shows_in_the_rate(tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == "dbc")  # without a counter of its own
    with Rig(example, tmp_path, speed=1.0, clock=1.25) as rig:
        rig.wait(lambda: rig.truth.made >= 350)
        # the measured rate converges; late arrivals on a loaded machine only delay it
        rig.wait(lambda: rig.driver.clock.measured_hz == pytest.approx(125.0, rel=0.03))


@pytest.mark.parametrize("name", ["vectornav_binary", "dbc", "ros2_imu"])
def test_a_pulled_cable_is_lost_and_found_again(name: str, tmp_path: Path) -> None:
    example = next(example for example in EXAMPLES if example.name == name)
    faults = {"unplugged": 0.002, "unplugged_for": 1.5}
    seed = next(seed for seed in range(5000) if pulled_once(seed, FaultsTable(**faults)))
    with Rig(example, tmp_path, speed=1.0, seed=seed, **faults) as rig:
        rig.wait(lambda: rig.counts.received > 0 and rig.truth.unplugged >= 1)
        before = rig.counts.received
        rig.wait(lambda: rig.driver.state == "lost")
        rig.wait(lambda: rig.driver.state == "running" and rig.counts.received > before)
        rig.wait(lambda: {"link_lost", "link_back"} <= set(rig.kinds))
        assert rig.truth.dropped >= 150


def pulled_once(seed: int, table: FaultsTable) -> bool:
    """Soon, and then not again for as long as the test may take to find the sensor."""
    pulled = np.flatnonzero(Faults(table, seed, "bytes").draw(2000).pulled)
    return bool(pulled.size) and 30 <= pulled[0] < 100 and not (pulled > pulled[0] + 150).any()
