"""What another reading of the configuration changes: a file in, what is to be done out; nothing is done here.

Devices are told apart by name. One whose table reads as before, and whose model in force too, goes on untouched; where
only its limits differ they alone are exchanged; anything else means that it is stopped and begins anew. The log's level
and the hooks are exchanged as a whole. All other tables are wired once, while the service starts: that they differ is
said, and they stay as they are. A file with anything wrong in it changes nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from drivers.errors import ConfigError
from monitor.daemon.operations.limits import model_of
from monitor.noise.model import NoiseModel
from monitor.settings import loading
from monitor.settings.loading import Config, Device

EXCHANGED: Final = ("device", "hook", "log")
"""Tables that can be exchanged while the service runs; of ``log`` the level."""


@dataclass(frozen=True, slots=True)
class Change:
    """From one configuration to another."""

    config: Config  # that holds from then on
    removed: tuple[str, ...]  # changed ones too
    added: tuple[Device, ...]  # changed ones too
    limited: tuple[Device, ...]  # those of which only the limits differ
    restart: tuple[str, ...]  # tables that hold only after a restart

    def text(self) -> str:
        """In one sentence."""
        new = {device.name for device in self.added}
        parts = {
            "added": sorted(new - set(self.removed)),
            "removed": sorted(set(self.removed) - new),
            "begun anew": sorted(new & set(self.removed)),
            "new limits": [device.name for device in self.limited],
        }
        said = [f"{what}: {', '.join(names)}" for what, names in parts.items() if names]
        if self.restart:
            said.append(f"{', '.join(self.restart)}: changed, and only a restart makes that hold")
        return "; ".join(said) or "no device changed"


def change(running: Config, models: Mapping[str, NoiseModel | None]) -> Change:
    """What the file says now, against what runs.

    Args:
        running: as it was read from its file
        models: those in force, of each device, as they were read then
    Raises:
        ConfigError: one line: nothing is to be changed
    """
    if running.path is None:
        raise ConfigError("there is no file to read again")
    new = loading.load(running.path)
    old_tables, new_tables = _by_name(running.table), _by_name(new.table)
    added, limited = [], []
    for device in new.devices:
        model = model_of(device)
        before, now = old_tables.get(device.name), new_tables[device.name]
        if before is None or _without_limits(before) != _without_limits(now) or models.get(device.name) != model:
            added.append(device)
        elif before != now:
            limited.append(device)
    kept = {device.name for device in new.devices} - {device.name for device in added}
    removed = tuple(device.name for device in running.devices if device.name not in kept)
    restart = _wired(running.table, new.table)
    return Change(_with(running, new, restart), removed, tuple(added), tuple(limited), restart)


def _by_name(table: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {str(one.get("name")): one for one in table.get("device", ())}


def _without_limits(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key != "limit"}


def _wired(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, ...]:
    """Tables that differ and cannot be exchanged."""
    differ = [key for key in {**old, **new} if key not in EXCHANGED and old.get(key) != new.get(key)]
    form = [one.get("log", {}).get("format", "text") for one in (old, new)]
    return (*differ, *(["log.format"] if form[0] != form[1] else []))


def _with(running: Config, new: Config, restart: tuple[str, ...]) -> Config:
    """The new configuration, but for what only a restart makes hold: that is said again at the next reload."""
    table = {key: value for key, value in new.table.items() if key not in restart}
    table |= {key: running.table[key] for key in restart if key in running.table}
    if "log.format" in restart:
        table["log"] = {**new.table.get("log", {}), "format": running.log.format}
    return replace(running, devices=new.devices, hooks=new.hooks, log=new.log, table=table)
