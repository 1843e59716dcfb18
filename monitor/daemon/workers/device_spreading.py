"""Number of worker processes, and distribution of the devices among them."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Final

from monitor.settings.loading import Config, Device

DEVICES_PER_PROCESS: Final = 8
"""Number of devices above which the devices are spread over several processes."""


def count_workers(config: Config) -> int:
    """Return the number of processes among which the devices are spread; 1 means that there are no workers."""
    if not config.table:  # the workers read their devices from the table of the configuration file
        return 1
    devices = len(config.devices)
    return min(devices, config.workers or min(math.ceil(devices / DEVICES_PER_PROCESS), os.cpu_count() or 1))


def spread_devices(devices: Sequence[Device], workers: int, before: Mapping[str, int]) -> dict[str, int]:
    """Assign each device to a worker. A device stays with its worker; other devices go to the worker with the fewest
    devices.

    The rate does not matter, because devices are read and results are published at rates independent of it.

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
        Worker number of each device, by the name of the device.
    """
    places = {device.name: before[device.name] for device in devices if device.name in before}
    for device in devices:
        used = list(places.values())
        places.setdefault(device.name, min(range(workers), key=used.count))
    return places
