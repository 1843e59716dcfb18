"""Comparison of the running configuration with the configuration file, for a reload without a restart.

The module computes the changes, and the service applies the changes. If the table of a device and the noise model are
unchanged, the device continues. If only the limits differ, the limits are replaced. After any other change, the device
is restarted.

Changes of tables other than devices, hooks and the log level are only reported, because these tables take effect at the
start of the service. If the file contains an error, the running configuration is kept.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from drivers.errors import ConfigError
from monitor.daemon.operations.coefficient_limits import read_model_in_force
from monitor.noise.model import NoiseModel
from monitor.settings import loading
from monitor.settings.loading import Config, Device

RELOADABLE_TABLES: Final = ("device", "hook", "log")
"""Tables that can change while the service runs."""


@dataclass(frozen=True, slots=True)
class ConfigChange:
    """Differences between the running configuration and the configuration file."""

    config: Config  # configuration after the reload
    removed: tuple[str, ...]  # names of removed devices and devices to restart
    added: tuple[Device, ...]  # added devices and devices to restart
    limited: tuple[Device, ...]  # devices of which only the limits differ
    restart: tuple[str, ...]  # changed tables that take effect only after a restart

    def describe_changes(self) -> str:
        """Return the changes in one sentence."""
        new = {device.name for device in self.added}
        parts = {
            "added": sorted(new - set(self.removed)),
            "removed": sorted(set(self.removed) - new),
            "restarted": sorted(new & set(self.removed)),
            "new limits": [device.name for device in self.limited],
        }
        said = [f"{what}: {', '.join(names)}" for what, names in parts.items() if names]
        if self.restart:
            said.append(f"{', '.join(self.restart)}: changed; restart imu-monitor to apply the change")
        return "; ".join(said) or "no device changed"


def compare_with_file(running: Config, models: Mapping[str, NoiseModel | None]) -> ConfigChange:
    """Compare the configuration file with the running configuration, like ``compare_configurations``.

    Raises
    ------
    ConfigError
        If the file contains an error, or if the running configuration was not read from a file.
    """
    if running.path is None:
        raise ConfigError("the running configuration was not read from a file; there is no file to read again")
    return compare_configurations(running, loading.load_config(running.path), models)


def compare_configurations(running: Config, new: Config, models: Mapping[str, NoiseModel | None]) -> ConfigChange:
    """Compare a new configuration with the running configuration.

    Parameters
    ----------
    running : Config
        Running configuration.
    new : Config
        New configuration.
    models : mapping of str to NoiseModel or None
        Noise model that each running device uses.

    Returns
    -------
    ConfigChange
        Changes to apply.

    Raises
    ------
    ConfigError
        If a noise model of the new configuration is invalid.
    """
    old_tables, new_tables = _by_name(running.table), _by_name(new.table)
    added, limited = [], []
    for device in new.devices:
        model = read_model_in_force(device)
        before, now = old_tables.get(device.name), new_tables[device.name]
        if before is None or _without_limits(before) != _without_limits(now) or models.get(device.name) != model:
            added.append(device)
        elif before != now:
            limited.append(device)
    kept = {device.name for device in new.devices} - {device.name for device in added}
    removed = tuple(device.name for device in running.devices if device.name not in kept)
    restart = _restart_tables(running.table, new.table)
    return ConfigChange(_merge(running, new, restart), removed, tuple(added), tuple(limited), restart)


def _by_name(table: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {str(one.get("name")): one for one in table.get("device", ())}


def _without_limits(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key != "limit"}


def _restart_tables(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the changed tables that take effect only after a restart."""
    differ = [key for key in {**old, **new} if key not in RELOADABLE_TABLES and old.get(key) != new.get(key)]
    form = [one.get("log", {}).get("format", "text") for one in (old, new)]
    return (*differ, *(["log.format"] if form[0] != form[1] else []))


def _merge(running: Config, new: Config, restart: tuple[str, ...]) -> Config:
    """Return the new configuration, but keep the old contents of the tables that take effect only after a restart.

    The next reload therefore reports these tables again.
    """
    table = {key: value for key, value in new.table.items() if key not in restart}
    table |= {key: running.table[key] for key in restart if key in running.table}
    if "log.format" in restart:
        table["log"] = {**new.table.get("log", {}), "format": running.log.format}
    return replace(running, devices=new.devices, hooks=new.hooks, log=new.log, table=table)
