"""Number of worker processes, and distribution of the devices to them."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Final

from monitor.settings.loading import Config, Device

PROCESS_RATE_HZ: Final = 8000.0
"""Total sample rate of the devices above which they are spread over several processes."""
UNKNOWN_RATE_HZ: Final = 1000.0
"""Assumed sample rate of a device without a configured rate."""


def count_workers(config: Config) -> int:
    """Return the number of processes among which the devices are spread; 1 means that there are no workers."""
    if not config.table:  # the workers read their devices from the table of the configuration file
        return 1
    rate_hz = sum(device.rate_hz or UNKNOWN_RATE_HZ for device in config.devices)
    workers = config.workers or min(math.ceil(rate_hz / PROCESS_RATE_HZ), os.cpu_count() or 1)
    return min(workers, len(config.devices))


def spread_devices(devices: Sequence[Device], workers: int, before: Mapping[str, int]) -> dict[str, int]:
    """Assign each device to a worker. A device stays at its worker, and the others go to the least loaded worker.

    Parameters
    ----------
    devices : sequence of Device
        Devices of the configuration.
    workers : int
        Number of workers.
    before : mapping of str to int
        Present worker of each device by its name.

    Returns
    -------
    dict of str to int
        Number of the worker of each device by its name.
    """
    load_hz, places = [0.0] * workers, {}
    for device in sorted(devices, key=lambda one: (one.name not in before, -(one.rate_hz or UNKNOWN_RATE_HZ))):
        place = before.get(device.name, load_hz.index(min(load_hz)))
        load_hz[place] += device.rate_hz or UNKNOWN_RATE_HZ
        places[device.name] = place
    return places
