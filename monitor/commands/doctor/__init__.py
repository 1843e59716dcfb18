"""Command ``doctor``: checks a machine and a configuration for unattended operation.

Each check returns findings with advice and never raises an error. The checks briefly bind ports, connect to zenoh
routers, and create and remove an empty file in the storage folder. No device is opened, except UDP ports.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

from monitor.commands.check_configuration import check_configuration
from monitor.commands.doctor.devices import check_device
from monitor.commands.doctor.finding import DoctorFinding, check_permissions, well, wrong
from monitor.commands.doctor.installation_and_clock import (
    check_clock,
    check_kernels,
    check_library_versions,
    check_shadowed_packages,
    check_systemd_unit,
)
from monitor.commands.doctor.outputs import (
    check_influx,
    check_metrics,
    check_reconcile_packages,
    check_ros2_routers,
    check_viewer,
    check_zenoh,
)
from monitor.commands.doctor.storage import check_storage
from monitor.common.unit_formatting import format_count
from monitor.settings.loading import Config


def examine_machine(config_path: Path | None = None) -> list[DoctorFinding]:
    """Check the machine, and the configuration file if a path is given."""
    machine = [
        *check_library_versions(),
        *check_shadowed_packages(sys.path),
        check_kernels(),
        check_clock(),
        *check_systemd_unit(),
    ]
    if config_path is None:
        return machine
    config, mistakes = check_configuration(config_path, pipe=True)
    found = [wrong("configuration", line) for line in mistakes]
    if config is not None:
        found.append(well("configuration", f"{config_path}: {format_count(len(config.devices), 'device')}"))
    found += machine
    if config_path.is_file():
        found.append(check_permissions(config_path))
    if config is not None:
        found += _check_configured(config)
    return found


def _check_configured(config: Config) -> Iterator[DoctorFinding]:
    for one in config.table["device"]:
        yield from check_device(str(one["name"]), one["driver"])
    yield from check_zenoh(config)
    yield from check_viewer(config)
    yield from check_storage(config)
    yield from check_metrics(config)
    yield from check_influx(config)
    yield from check_ros2_routers(config)
    yield from check_reconcile_packages(config)
    for hook in config.hooks:
        if hook.command:
            command = Path(hook.command[0])
            yield check_permissions(command, f"hook {command.name}", secret=False)
