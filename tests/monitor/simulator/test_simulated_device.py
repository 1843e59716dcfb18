"""The simulated sensor through an ordinary serial link: every sample it made is received or known to be missing."""

import math
import os
import threading

import numpy as np
import pytest

from drivers.decoders import stim300, vectornav_binary, xsens_mtdata2
from drivers.driver import Driver
from drivers.errors import ConfigError
from drivers.timing.sample_clock import SampleClock
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.settings.loading import VirtualTable
from monitor.simulator import SimulatedDevice
from tests.support.paced_sensor import follow_reader, is_open
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("tty", reason="pseudo-terminals need a POSIX system")

MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")


class Rig:
    """A sensor and its driver; the sensor begins to live once the driver's link is open.

    It makes no more than ``allowed`` samples, and waits for its reader while the cable is in.
    """

    def __init__(self, module=vectornav_binary, speed=1.0, allowed=math.inf):
        decoder = module.build(module.Settings())
        self.imu = SimulatedDevice(VirtualTable(model=MODEL, seed=3, speed=speed), decoder)
        self.blocks = []
        self.driver = Driver(
            "v", self.imu.port.link, decoder, SampleClock(decoder.timing, self.imu.rate_hz), self.blocks.append
        )
        self.allowed = allowed
        self.thread = threading.Thread(target=self.driver.run, daemon=True)

    def __enter__(self):
        follow_reader(self.imu, self.driver, lambda: self.allowed)
        self.imu.port.plug()
        self.thread.start()
        self.wait(lambda: is_open(self.imu))
        self.imu.start()
        return self

    def __exit__(self, *exc):
        self.imu.stop()
        self.driver.stop()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()

    def wait(self, condition):
        wait_for(condition, lambda: (self.driver.state, self.driver.text, self.driver.counts))

    def kinds(self):
        return [event.kind for event in self.driver.take_events()]


@pytest.mark.parametrize("module", [vectornav_binary, stim300, xsens_mtdata2], ids=lambda m: m.__name__)
def test_what_it_sends_is_received(module):
    with Rig(module, allowed=100) as rig:
        rig.wait(lambda: rig.imu.fault_counts.total_simulated_samples == rig.driver.counts.received == 100)
    counts, truth = rig.driver.counts, rig.imu.fault_counts
    assert (truth.sent, truth.dropped) == (100, 0)
    assert (counts.lost, counts.bad) == (0, 0)
    values = np.concatenate([one.values for one in rig.blocks])
    assert np.isfinite(values).all()
    # white noise of the model: N √rate, and Q
    assert 0.5e-3 < values[:, 0].std() < 5e-3


def test_a_pulled_cable_and_back():
    with Rig(allowed=50) as rig:
        counts, truth = rig.driver.counts, rig.imu.fault_counts
        rig.wait(
            lambda: truth.total_simulated_samples == counts.received == 50
        )  # nothing is on the way when the cable is pulled
        rig.imu.port.unplug()
        rig.wait(lambda: rig.driver.state == "lost")
        assert not rig.imu.port.path.exists()
        rig.allowed = 100
        rig.wait(lambda: truth.dropped == 50)  # half a second at 100 Hz
        assert counts.received == 50
        rig.imu.port.plug()
        rig.allowed = 150
        rig.wait(lambda: rig.driver.state == "running")
        rig.wait(lambda: truth.total_simulated_samples == 150 and counts.received == 100)
        kinds = rig.kinds()
    assert kinds.count("link_lost") == kinds.count("link_back") == 1
    assert "samples_lost" in kinds
    assert (counts.lost, counts.bad) == (50, 0)  # told by the sensor's counter
    assert truth.sent == 100


def test_nobody_reads_and_the_sensor_goes_on():
    rig = Rig(speed=20.0)
    rig.imu.start()
    try:
        rig.wait(lambda: rig.imu.fault_counts.dropped > 200)
    finally:
        rig.imu.stop()
    assert rig.imu.fault_counts.sent > 0
    assert not rig.imu.port.path.parent.exists()


def test_plugging_twice_and_pulling_twice_is_harmless_and_leaves_nothing_open():
    rig = Rig()
    files = set(os.listdir("/dev/fd"))
    for _ in range(20):
        rig.imu.port.plug()
        rig.imu.port.plug()
        rig.imu.port.unplug()
        rig.imu.port.unplug()
    assert set(os.listdir("/dev/fd")) <= files  # what an earlier test left may have been closed meanwhile
    rig.imu.stop()


def test_same_seed_same_noise():
    a, b = Rig().imu, Rig().imu
    try:
        assert np.array_equal(a._sensor._stream.draw_next_samples(50), b._sensor._stream.draw_next_samples(50))
    finally:
        a.stop()
        b.stop()


def test_a_model_that_cannot_be_read(tmp_path):
    (tmp_path / "bad.toml").write_text("[gz.no_such_effect]\nx = 1\n")
    decoder = vectornav_binary.build(vectornav_binary.Settings())
    with pytest.raises(ConfigError):
        SimulatedDevice(VirtualTable(model=str(tmp_path / "bad.toml")), decoder)
