"""Read configuration files, and report all mistakes of a file together."""

import dataclasses
import json
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from drivers.errors import ConfigError, make_printable_and_shorten
from drivers.host import safe_file_reading
from drivers.secret_masking import remember_secrets_in
from drivers.validation.settings_model import Problem, TableCheckResult, check_table
from drivers.zenoh.session_config import build_session_config, find_secret_files, format_zenoh_error
from monitor.settings import file_permissions, toml_parser
from monitor.settings.driver_settings import BuiltLinkAndDecoder, FaultsTable, VirtualTable
from monitor.settings.field_types import MetricsAddress, check_viewer_mode, parse_duration_s, parse_rate_as_period
from monitor.settings.ros2_table import Ros2Table
from monitor.settings.schema import (
    DEVICE_NAME,
    WINDOW_SAMPLES,
    ConfigFile,
    Device,
    Hook,
    InfluxTable,
    Limit,
    LogTable,
    Storage,
    ViewerTable,
    ZenohTable,
)
from monitor.settings.token_file import read_token

__all__ = [
    "DEVICE_NAME",
    "WINDOW_SAMPLES",
    "BuiltLinkAndDecoder",
    "Config",
    "Device",
    "FaultsTable",
    "Hook",
    "InfluxTable",
    "Limit",
    "LogTable",
    "MetricsAddress",
    "Ros2Table",
    "Storage",
    "ViewerTable",
    "VirtualTable",
    "ZenohTable",
    "check_viewer_mode",
    "examine_config_file",
    "load_config",
    "parse_duration_s",
    "parse_rate_as_period",
]

MAX_DEVICES: Final = 1000
"""Maximum number of devices of one daemon."""
MAX_HOOKS: Final = 1000
DEVICE_PLACE: Final = re.compile(r"device\[(\d+)\]\.?(.*)")


@dataclass(frozen=True, slots=True)
class Config:
    """Validated configuration of the service."""

    devices: tuple[Device, ...]
    zenoh: ZenohTable
    viewer: ViewerTable
    log: LogTable
    storage: Storage | None = None  # None if nothing is kept
    hooks: tuple[Hook, ...] = ()
    metrics: MetricsAddress | None = None
    influx: InfluxTable | None = None  # None if nothing is sent
    ros2: Ros2Table | None = None  # None if nothing is published
    workers: int = 0  # number of worker processes; 0 if it depends on the sample rates
    path: Path | None = None  # of the file
    table: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # content of the file, for the comparison at a reload
    warnings: tuple[str, ...] = ()  # one line per warning


@dataclass(frozen=True, slots=True)
class ModelDependentSettings:
    """Settings of a device whose validation needs noise model files."""

    device: str  # "device bench-1"
    model: Path | None  # model in force
    limits: tuple[Limit, ...]
    virtual: VirtualTable | None  # None if the device is not simulated


@dataclass(frozen=True, slots=True)
class ConfigReading:
    """Result of reading a configuration file: a configuration or a list of mistakes."""

    config: Config | None  # None if the file has mistakes
    wrong: list[str]  # one line per mistake, beginning with the path of the file
    models: tuple[ModelDependentSettings, ...] = ()


def load_config(path: Path, *, allow_pipe: bool = False) -> Config:
    """Load a configuration file, and raise an error if the file has mistakes.

    Parameters
    ----------
    path
        Configuration file.
    allow_pipe
        True to accept a pipe instead of a regular file (``drivers.host.safe_file_reading.read_small_file``).

    Raises
    ------
    ConfigError
        If the file is not a valid configuration. The message describes the first mistake and counts the other mistakes.
    """
    reading = examine_config_file(path, allow_pipe=allow_pipe)
    if reading.config is None:
        count = len(reading.wrong) - 1
        raise ConfigError(reading.wrong[0] + (f" (and {count} more: imu-monitor check {path})" if count else ""))
    return reading.config


def examine_config_file(path: Path, *, allow_pipe: bool = False) -> ConfigReading:
    """Read a configuration file, and collect all mistakes.

    Parameters
    ----------
    path
        Configuration file.
    allow_pipe
        True to accept a pipe instead of a regular file.
    """
    try:
        text = safe_file_reading.read_small_file(path, allow_pipe=allow_pipe).decode("utf-8")
        remember_secrets_in(text)
        table = toml_parser.parse_toml(text)
    except FileNotFoundError:
        return ConfigReading(
            None, [f"{path}: no such file; imu-monitor check --print-defaults prints one to start from"]
        )
    except OSError as error:
        return ConfigReading(None, [f"{path}: cannot be read: {error.strerror or error}"])
    except UnicodeDecodeError as error:
        line = f"{path}: cannot be read: byte {error.start} is not text; expected a TOML file"
        return ConfigReading(None, [f"{line}; imu-monitor analyze reads recordings"])
    except ConfigError as error:
        hint = "" if path.suffix in ("", ".toml") else "; imu-monitor analyze reads recordings"
        return ConfigReading(None, [f"{path}: {error}{hint}"])
    if line := _explain_too_many_tables(table):
        return ConfigReading(None, [f"{path}: {line}"])
    checked = check_table(ConfigFile, table, path.resolve().parent)
    warnings = [*_check_zenoh_file(checked), *_check_token_file(checked), *_find_reflections(checked)]
    wrong = [_format_problem(problem, table) for problem in checked.problems]
    if line := file_permissions.explain_untrusted_file(path):
        wrong.append(line)
    if line := file_permissions.describe_exposed_secret(path):
        warnings.insert(0, line)
    models = _model_dependent_settings(checked, table)
    if wrong or checked.value is None:
        return ConfigReading(None, [make_printable_and_shorten(f"{path}: {line}") for line in wrong], models)
    config = _configuration(checked.value)
    lines = tuple(f"{path}: {line}" for line in warnings)
    return ConfigReading(dataclasses.replace(config, path=path, table=table, warnings=lines), [], models)


def _explain_too_many_tables(table: Mapping[str, Any]) -> str:
    """Return a message if an array of tables is too long to be checked and run by one process, or ""."""
    for key, limit in (("device", MAX_DEVICES), ("hook", MAX_HOOKS)):
        entries = table.get(key)
        if isinstance(entries, list) and len(entries) > limit:
            return f"{key}: {len(entries)} tables; at most {limit} are supported; use several daemons"
    return ""


def select_devices(config: Config, names: Collection[str]) -> tuple[dict[str, Any], Path]:
    """Return the table and the folder of a configuration for some devices that only records their results.

    Parameters
    ----------
    config : Config
        Configuration that was read from a file.
    names : collection of str
        Names of the devices.
    """
    table, off = config.table, {"mode": "none"}
    part = {"device": [one for one in table["device"] if one["name"] in names], "zenoh": off, "viewer": off}
    part |= {"log": table.get("log", {}), "storage": {**table.get("storage", {}), "history": False}}
    return part, (config.path or Path()).resolve().parent


def load_selected_devices(table: Mapping[str, Any], folder: Path) -> Config:
    """Load the configuration that ``select_devices`` has returned.

    Parameters
    ----------
    table : mapping of str to Any
        Content of the configuration.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    ConfigError
        If the configuration is no longer valid, for example because a file has been deleted.
    """
    remember_secrets_in(json.dumps(table))
    checked = check_table(ConfigFile, table, folder)
    if checked.problems or checked.value is None:
        raise ConfigError(*(_format_problem(problem, table) for problem in checked.problems))
    return dataclasses.replace(_configuration(checked.value), table=table)


def _configuration(file: ConfigFile) -> Config:
    storage = None if file.storage.folder == Path() else file.storage
    influx = None if file.influx.url is None else file.influx
    ros2 = None if file.ros2.domain is None else file.ros2
    return Config(
        file.devices,
        file.zenoh,
        file.viewer,
        file.log,
        storage,
        file.hooks,
        file.metrics.listen,
        influx,
        ros2,
        file.service.workers,
    )


def _check_zenoh_file(checked: TableCheckResult[ConfigFile]) -> list[str]:
    """Check the zenoh configuration file, and return warnings about secrets that all users can read."""
    zenoh = checked.value.zenoh if checked.value else None
    if zenoh is None or zenoh.config is None or zenoh.mode == "none":
        return []
    path = zenoh.config
    if not os.path.exists(path):
        checked.add_problem("zenoh.config", f"{path}: no such file")
        return []
    if line := file_permissions.explain_untrusted_file(path):
        checked.problems.append(Problem("zenoh.config", line))
    secrets: tuple[Path, ...] = ()
    try:
        secrets = _zenoh_file_secrets(path)
    except ConfigError as error:
        checked.problems.append(Problem("zenoh.config", str(error)))
    files = ((path, None), *((one, True) for one in secrets))
    exposed = ((file, file_permissions.describe_exposed_secret(file, secret)) for file, secret in files)
    return [f"zenoh.config: {file.name}: {line}" for file, line in exposed if line]


def _check_token_file(checked: TableCheckResult[ConfigFile]) -> list[str]:
    """Check the token file of InfluxDB, and return a warning if all users can read the token."""
    path = checked.value.influx.token_file if checked.value else None
    if path is None:
        return []
    try:
        read_token(path)
    except ConfigError as error:
        checked.add_problem("influx.token_file", str(error))
        return []
    line = file_permissions.describe_exposed_secret(path, is_secret=True)
    return [f"influx.token_file: {path.name}: {line}"] if line else []


def _find_reflections(checked: TableCheckResult[ConfigFile]) -> Iterator[str]:
    """Yield a warning for each sensor whose axes are mirrored, which is right only for a sensor with such axes."""
    for device in checked.value.devices if checked.value else ():
        for kind, columns in (("gyroscopes", slice(3)), ("accelerometers", slice(3, 6))):
            if device.axes.is_reflection(columns):
                text = "no mounting does this; correct only if the sensor itself inverts axes or has left-handed axes"
                yield f"device {device.name}: axes: the {kind} are mirrored; {text}"


def _zenoh_file_secrets(path: Path) -> tuple[Path, ...]:
    """Return the key and password files in a zenoh configuration. Raise ConfigError if zenoh rejects the
    configuration."""
    import zenoh

    try:
        return find_secret_files(build_session_config({}, path))
    except zenoh.ZError as error:
        text = format_zenoh_error(error)
        raise ConfigError(text if text.startswith(str(path)) else f"{path}: {text}") from error


def _format_problem(problem: Problem, table: Mapping[str, Any]) -> str:
    """Format a problem as a message, which begins with the name of the affected device."""
    match = DEVICE_PLACE.fullmatch(problem.key_path)
    name = _device_name(table, int(match[1])) if match else ""
    return f"{name}: {Problem(match[2], problem.text)}" if match and name else str(problem)


def _device_name(table: Mapping[str, Any], index: int) -> str:
    """Return "device NAME", or an empty string if the device has no valid name."""
    entry = table["device"][index]
    name = entry.get("name") if isinstance(entry, dict) else None
    return f"device {name}" if isinstance(name, str) and DEVICE_NAME.fullmatch(name) else ""


def _model_dependent_settings(
    checked: TableCheckResult[ConfigFile], table: Mapping[str, Any]
) -> tuple[ModelDependentSettings, ...]:
    """Return the valid settings of all devices that must be checked against noise model files."""
    uses = []
    for i, device in enumerate(checked.value.devices if checked.value else ()):
        at = f"device[{i}]"
        limits = tuple(one for k, one in enumerate(device.limits) if checked.has_no_problem(f"{at}.limit[{k}]"))
        virtual = device.link if checked.has_no_problem(f"{at}.driver") else checked.partial.get(f"{at}.driver")
        model = device.model if checked.has_no_problem(f"{at}.model") else None
        simulated = virtual if isinstance(virtual, VirtualTable) else None
        uses.append(ModelDependentSettings(_device_name(table, i) or at, model, limits, simulated))
    return tuple(uses)
