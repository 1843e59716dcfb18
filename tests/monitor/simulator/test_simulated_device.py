"""Tests that every sample of a simulated sensor is received through a serial link or counted as missing."""

import math
import os
import threading

import numpy as np
import pytest

from drivers.decoders.binary_frames import stim300, vectornav_binary, xsens_mtdata2
from drivers.driver import Driver
from drivers.errors import ConfigError
from drivers.timing.sample_clock import SampleClock
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.settings.loading import VirtualTable
from monitor.simulator.simulated_device import SimulatedDevice
from tests.support.paced_sensor import follow_reader, is_open
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("tty", reason="pseudo-terminals need a POSIX system")

MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")


class SensorHarness:
    """A sensor and its driver; the sensor starts once the link of the driver is open.

    The sensor makes at most ``allowed`` samples and waits for its reader while it is connected.
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

    def take_event_kinds(self):
        return [event.kind for event in self.driver.take_events()]


@pytest.mark.parametrize("module", [vectornav_binary, stim300, xsens_mtdata2], ids=lambda m: m.__name__)
def test_all_sent_samples_are_received(module):
    with SensorHarness(module, allowed=100) as harness:
        harness.wait(lambda: harness.imu.fault_counts.total_simulated_samples == harness.driver.counts.received == 100)
    counts, truth = harness.driver.counts, harness.imu.fault_counts
    assert (truth.sent, truth.dropped) == (100, 0)
    assert (counts.lost, counts.bad) == (0, 0)
    values = np.concatenate([block.values for block in harness.blocks])
    assert np.isfinite(values).all()
    # The noise consists of white noise, N times the root of the rate, and quantization.
    assert 0.5e-3 < values[:, 0].std() < 5e-3


def test_unplugged_sensor_reconnects_and_missing_samples_are_counted():
    with SensorHarness(allowed=50) as harness:
        counts, truth = harness.driver.counts, harness.imu.fault_counts
        harness.wait(
            lambda: truth.total_simulated_samples == counts.received == 50
        )  # no sample is in transit when the cable is unplugged
        harness.imu.port.unplug()
        harness.wait(lambda: harness.driver.state == "lost")
        assert not harness.imu.port.path.exists()
        harness.allowed = 100
        harness.wait(lambda: truth.dropped == 50)  # half a second at 100 Hz
        assert counts.received == 50
        harness.imu.port.plug()
        harness.allowed = 150
        harness.wait(lambda: harness.driver.state == "running")
        harness.wait(lambda: truth.total_simulated_samples == 150 and counts.received == 100)
        kinds = harness.take_event_kinds()
    assert kinds.count("link_lost") == kinds.count("link_back") == 1
    assert "samples_lost" in kinds
    assert (counts.lost, counts.bad) == (50, 0)  # the counter of the sensor shows the loss
    assert truth.sent == 100


def test_sensor_continues_without_a_reader():
    harness = SensorHarness(speed=20.0)
    harness.imu.start()
    try:
        harness.wait(lambda: harness.imu.fault_counts.dropped > 200)
    finally:
        harness.imu.stop()
    assert harness.imu.fault_counts.sent > 0
    assert not harness.imu.port.path.parent.exists()


def test_repeated_plugging_is_harmless_and_leaves_nothing_open():
    harness = SensorHarness()
    files = set(os.listdir("/dev/fd"))
    for _ in range(20):
        harness.imu.port.plug()
        harness.imu.port.plug()
        harness.imu.port.unplug()
        harness.imu.port.unplug()
    assert set(os.listdir("/dev/fd")) <= files  # files of earlier tests may have been closed meanwhile
    harness.imu.stop()


def test_equal_seeds_give_equal_noise():
    a, b = SensorHarness().imu, SensorHarness().imu
    try:
        assert np.array_equal(a._sensor._stream.draw_next_samples(50), b._sensor._stream.draw_next_samples(50))
    finally:
        a.stop()
        b.stop()


def test_invalid_model_is_refused(tmp_path):
    (tmp_path / "bad.toml").write_text("[gz.no_such_effect]\nx = 1\n")
    decoder = vectornav_binary.build(vectornav_binary.Settings())
    with pytest.raises(ConfigError):
        SimulatedDevice(VirtualTable(model=str(tmp_path / "bad.toml")), decoder)
