"""A simulated sensor that its reader paces, so that no sample depends on the load of the machine.

A real sensor does not wait. On a loaded machine its reader falls behind, the buffer of the pseudo-terminal overflows,
and what arrives differs from run to run. ``follow_reader`` replaces the sensor's clock by one that stands still while
the reader is behind. The sensor then makes the same samples on every machine, and each of them arrives.
"""

import math
import time
from collections.abc import Callable
from typing import Final

from drivers.driver import Driver
from monitor.simulator.ports import PtyPort, ZenohPort
from monitor.simulator.simulated_device import SimulatedDevice

AHEAD: Final = 32
"""Samples that the sensor may be ahead of its reader. A pseudo-terminal holds them in every wire format."""


def unlimited() -> float:
    """Return infinity, the number of samples of a sensor that never ends."""
    return math.inf


def is_open(imu: SimulatedDevice) -> bool:
    """Return True if a reader has opened the sensor's link, so that the next sample will reach it."""
    link, port = imu.port.link, imu.port
    if isinstance(port, ZenohPort):
        return port._session is not None and bool(port._publisher.matching_status.matching)
    return getattr(link, "_port" if isinstance(port, PtyPort) else "_bus") is not None


def is_plugged(imu: SimulatedDevice) -> bool:
    """Return True if the sensor's cable is in."""
    port = imu.port
    name = {PtyPort: "_master", ZenohPort: "_session"}.get(type(port), "_bus")
    return getattr(port, name) is not None


def follow_reader(imu: SimulatedDevice, driver: Driver, allowed: Callable[[], float] = unlimited) -> None:
    """Make a sensor that has not been started wait for its reader.

    The sensor keeps its own rate while the reader keeps up. It makes no sample before the link is open, and none while
    ``AHEAD`` whole samples have been sent and not been received. Without a cable it waits for nobody.

    Parameters
    ----------
    imu
        The sensor. It must not lose its cable by a fault of its own, as nobody receives what was on the way then.
    driver
        The reader of the sensor's link.
    allowed
        Number of samples, from the first on, that the sensor may make by now. It never decreases.
    """
    begun_s = -1.0
    limit = 0.0

    def now_s() -> float:
        nonlocal begun_s, limit
        host_s = time.monotonic()
        if begun_s < 0.0:
            begun_s = host_s
        if not is_plugged(imu):
            return min(host_s - begun_s, (allowed() + 0.5) / imu._pace_hz)
        if is_open(imu):
            waiting = (
                imu.fault_counts.sent
                + imu.fault_counts.repeated
                - driver.counts.received
                - driver.clock.dropped_repeated_rows
            )
            limit = max(limit, min(imu.fault_counts.total_simulated_samples + AHEAD - waiting, allowed()))
        return min(host_s - begun_s, (limit + 0.5) / imu._pace_hz)

    imu.now_s = now_s
