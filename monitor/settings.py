"""TOML -> typed settings. Reading opens nothing; everything wrong with a file is found, not only the first thing.

Every key has a default but a device's ``name`` and ``driver``. An unknown key is an error that names the nearest
known one. Links and decoders bring their own keys: their modules' ``Settings`` are filled from ``[device.driver]``
and ``[device.driver.decoder_options]``. Relative paths are relative to the configuration file.
"""

import dataclasses
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from math import inf
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import msgspec

import drivers.decoders
import drivers.links
from drivers import plugin, small_file
from drivers.decoders.base import Addressed, Decoder
from drivers.driver import AxisMap, axis_map
from drivers.errors import ConfigError, in_one_line
from drivers.links.base import Filtering, Link, LinkSettings
from drivers.sample import AXES, KINDS
from drivers.zenoh_session import configuration, plain, secret_files
from monitor import permissions, toml
from monitor.tables import (
    DeviceTable,
    FaultsTable,
    FileTable,
    HookTable,
    LimitTable,
    LogTable,
    MetricsTable,
    StorageTable,
    ViewerTable,
    VirtualTable,
    ZenohTable,
)
from monitor.topics import ENDPOINT

__all__ = [
    "CONFIG_FOLDER",
    "Config",
    "Device",
    "DeviceTable",
    "FaultsTable",
    "Hook",
    "Limit",
    "LogTable",
    "Metrics",
    "Storage",
    "ViewerTable",
    "VirtualTable",
    "ZenohTable",
    "load",
    "model_path",
    "period",
    "read",
    "seconds",
    "viewer_mode",
]

T = TypeVar("T", bound=msgspec.Struct)

CONFIG_FOLDER: Final = Path(__file__).resolve().parent.parent / "config"
"""The data package beside this one: example configurations, models, DBC files."""
UNITS_S: Final = {"": 1.0, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
WINDOW_SAMPLES: Final = (100, 10_000_000)
WINDOW_LONGEST_S: Final = 40 * 86400.0
THERMAL_SAMPLES: Final = 8
"""In an interval at the least: its scatter tells how well its mean is known."""
THERMAL_LONGEST_S: Final = 86400.0
RATES_HZ: Final = (1e-9, 1e9)
SEGMENT_S: Final = (10.0, 86400.0)
DEVICE_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
IS_ENDPOINT: Final = re.compile(r"[a-z]+/.+")
LISTEN: Final = re.compile(r"(\[[0-9a-fA-F:]+\]|[\w.-]+):([0-9]{1,5})", re.ASCII)
MEMORY: Final = re.compile(r"[0-9]+(\.[0-9]+)?\s*([kMGT]?i?B|%)")


@dataclass(frozen=True, slots=True)
class Limit:
    """What one coefficient of some axes must not pass; SI unit of letter and axis."""

    axes: tuple[str, ...]
    letter: str
    above: float | None
    below: float | None
    times_model: float | None  # instead of above
    hold_s: float  # that it has to be beyond, or back


@dataclass(frozen=True, slots=True)
class Device:
    """One device, ready to be wired; nothing of it is open."""

    name: str
    rate_hz: float | None  # None: found from the data
    window_s: float
    tau: Literal["octave", "decade10"] | tuple[float, ...]  # s
    refit_s: float  # 0 = every sample
    publish_s: float  # 0 = every block
    link: Link | VirtualTable
    decoder: Decoder
    axes: AxisMap
    silence_s: float
    leave_out_motion: bool = False
    alarms_per_day: float = 0.033  # 0 = changes are not looked for
    restart: bool = True  # the estimate of an axis begins anew where its noise has changed
    model: Path | None = None  # the model in force
    reconcile_folder: Path | None = None  # where reports are kept
    thermal_s: float | None = 600.0  # of the means that are held against temperature; None: they are not
    compensate: bool = True  # take the gyros' drift out of a copy of the samples
    limits: tuple[Limit, ...] = ()


@dataclass(frozen=True, slots=True)
class Hook:
    """What events of some kinds, of some devices, set off: a command, a message, or both."""

    on: frozenset[str]
    devices: frozenset[str]  # none: all
    command: tuple[str, ...]
    key: str | None
    timeout_s: float


@dataclass(frozen=True, slots=True)
class Metrics:
    """Where Prometheus finds the numbers."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class Storage:
    """What is kept on disk, and where."""

    folder: Path
    record: bool = True  # samples
    raw: bool = False  # bytes as they came
    segment_s: float = 3600.0  # of one file
    keep_s: float = 30 * 86400.0
    disk_share: float = 0.9  # taken, above which the oldest segments go
    history: bool = True  # results, events, status


@dataclass(frozen=True, slots=True)
class Config:
    """A whole configuration file."""

    devices: tuple[Device, ...]
    zenoh: ZenohTable
    viewer: ViewerTable
    log: LogTable
    storage: Storage | None = None
    hooks: tuple[Hook, ...] = ()
    metrics: Metrics | None = None
    path: Path | None = None  # of the file
    table: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # as it stands in the file, for a reload to compare
    warnings: tuple[str, ...] = ()  # a line each: what is not wrong, but should not stay


def load(path: Path, *, pipe: bool = False) -> Config:
    """The configuration in a file; from a pipe too if ``pipe``, see ``small_file.read``.

    Raises:
        ConfigError: one line: the first thing that is wrong, and how many more there are
    """
    config, wrong = read(path, pipe=pipe)
    if config is None:
        more = f" (and {len(wrong) - 1} more: imu-monitor check {path})" if len(wrong) > 1 else ""
        raise ConfigError(wrong[0] + more)
    return config


def read(path: Path, *, pipe: bool = False) -> tuple[Config | None, list[str]]:
    """The configuration, or None and all that is wrong with the file, a line each."""
    try:
        text = small_file.read(path, pipe=pipe).decode("utf-8")
    except FileNotFoundError:
        return None, [f"{path}: no such file; imu-monitor check --print-defaults prints one to start from"]
    except (OSError, UnicodeDecodeError) as error:
        return None, [f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"]
    try:
        table = toml.tables(text)
    except ConfigError as error:
        return None, [f"{path}: {error}"]
    reader = _Reader(path.resolve().parent)
    config = reader.config(table)
    reader.trust(path)
    if config is None or reader.wrong:
        return None, [in_one_line(f"{path}: {line}") for line in reader.wrong]
    warnings = tuple(f"{path}: {line}" for line in reader.warnings)
    return replace(config, path=path, table=table, warnings=warnings), []


class _Reader:
    """Fills settings from tables and collects what is wrong."""

    def __init__(self, folder: Path) -> None:
        self.wrong: list[str] = []
        self.warnings: list[str] = []
        self._folder = folder

    def trust(self, path: Path) -> None:
        """Who else may change the file itself, or read a secret in it."""
        if line := permissions.changeable(path):
            self.wrong.append(line)
        if line := permissions.exposed(path):
            self.warnings.append(line)

    def config(self, table: Mapping[str, Any]) -> Config | None:
        file = self.fill(FileTable, table, "")
        if file is None:
            return None
        if not file.device:
            self.wrong.append("device: there is none; add [[device]] with name and driver")
        devices = [self.device(entry, f"device[{i}]") for i, entry in enumerate(file.device)]
        names = [entry.get("name") for entry in file.device]
        for name in sorted({str(n) for n in names if names.count(n) > 1 and n is not None}):
            self.wrong.append(f'device: {names.count(name)} devices are named "{name}"; names must be unique')
        unsaid = dict.fromkeys({"mode", "listen"} - file.zenoh.keys()) if "config" in file.zenoh else {}
        zenoh = self.fill(ZenohTable, {**unsaid, **file.zenoh}, "zenoh")
        viewer = self.fill(ViewerTable, file.viewer, "viewer")
        log = self.fill(LogTable, file.log, "log")
        if viewer is not None:
            self._try("viewer.mode", viewer_mode, viewer.mode)
            if not MEMORY.fullmatch(viewer.memory):
                self.wrong.append(f'viewer.memory: "{viewer.memory}" is no size; write "256MiB", "1GB" or "25%"')
        if zenoh is not None:
            self._reachable(zenoh)
        storage = self._storage(file.storage)
        hooks = self._hooks(file.hook, [str(name) for name in names], zenoh is not None and zenoh.mode == "none")
        metrics = self._metrics(file.metrics)
        history_s = self._shown_history(viewer, storage)
        if zenoh is None or viewer is None or log is None:
            return None
        viewer = msgspec.structs.replace(viewer, history=history_s)
        if viewer.mode.endswith(".rrd"):
            path = self._folder / small_file.path(viewer.mode)
            viewer = msgspec.structs.replace(viewer, mode=str(path))
        known = tuple(device for device in devices if device is not None)
        return Config(known, zenoh, viewer, log, storage, hooks, metrics)

    def _shown_history(self, viewer: ViewerTable | None, storage: Storage | None) -> float | None:
        """s of it that the viewer opens on."""
        if viewer is None or viewer.history is None:
            return None
        if storage is None or not storage.history:
            self.wrong.append("viewer.history: none is kept; [storage] folder says where it would be")
        found: float | None = self._try("viewer.history", seconds, viewer.history)
        return found

    def _limits(self, tables: list[dict[str, Any]], has_model: bool, at: str) -> tuple[Limit, ...]:
        filled = [(self.fill(LimitTable, one, f"{at}[{i}]"), f"{at}[{i}]") for i, one in enumerate(tables)]
        limits = []
        for table, here in filled:
            if table is None:
                continue
            axes = self._try(f"{here}.axes", _axes, table.axes)
            hold_s = self._try(f"{here}.hold", seconds, table.hold)
            if self._bounds(table, has_model, here) and axes and hold_s:
                limits.append(Limit(axes, table.letter, table.above, table.below, table.times_model, hold_s))
        return tuple(limits)

    def _bounds(self, table: LimitTable, has_model: bool, at: str) -> bool:
        """Whether the bounds of a limit fit each other."""
        before = len(self.wrong)
        if table.above is None and table.below is None and table.times_model is None:
            self.wrong.append(f"{at}: no bound; add above, below or times_model")
        if table.above is not None and table.times_model is not None:
            self.wrong.append(f"{at}: above and times_model are two words for one bound; leave one out")
        if table.above is not None and table.below is not None and table.below >= table.above:
            self.wrong.append(f"{at}: below {table.below:g} is not under above {table.above:g}: nothing lies between")
        if table.times_model is not None and not has_model:
            self.wrong.append(f"{at}.times_model: the device has no model to be relative to; add model")
        return len(self.wrong) == before

    def _hooks(self, tables: list[dict[str, Any]], devices: list[str], no_zenoh: bool) -> tuple[Hook, ...]:
        hooks = []
        for i, one in enumerate(tables):
            at = f"hook[{i}]"
            table = self.fill(HookTable, one, at)
            timeout_s = None if table is None else self._try(f"{at}.timeout", seconds, table.timeout)
            if table is None or timeout_s is None:
                continue
            for key, said, known in (("on", table.on, (*KINDS, "*")), ("devices", table.devices, devices)):
                for word in (word for word in said if word not in known):
                    self.wrong.append(f'{at}.{key}: unknown "{word}"{plugin.nearest(word, known)}')
            if not table.on:
                self.wrong.append(f'{at}.on: empty; write kinds of events, or ["*"]')
            if not table.command and table.key is None:
                self.wrong.append(f"{at}: nothing to do; add command or key")
            if table.key is not None and no_zenoh:
                self.wrong.append(f'{at}.key: zenoh.mode is "none", so nothing can be put there')
            command = self._try(f"{at}.command", _command, table.command, self._folder)
            hooks.append(Hook(frozenset(table.on), frozenset(table.devices), command or (), table.key, timeout_s))
        return tuple(hooks)

    def _metrics(self, keys: Mapping[str, Any]) -> Metrics | None:
        table = self.fill(MetricsTable, keys, "metrics")
        if table is None or table.listen is None:
            return None
        match = LISTEN.fullmatch(table.listen)
        if match is None or not 0 < int(match[2]) < 65536:
            self.wrong.append(f'metrics.listen: "{table.listen}" is no host and port; write "127.0.0.1:9464"')
            return None
        return Metrics(match[1].strip("[]"), int(match[2]))

    def _storage(self, keys: Mapping[str, Any]) -> Storage | None:
        """None where nothing is to be kept, or a key is wrong."""
        table = self.fill(StorageTable, keys, "storage")
        if table is None:
            return None
        segment_s = self._try("storage.segment", seconds, table.segment)
        keep_s = self._try("storage.keep", seconds, table.keep)
        if table.folder is None or segment_s is None or keep_s is None:
            return None
        if not SEGMENT_S[0] <= segment_s <= SEGMENT_S[1]:
            self.wrong.append(f"storage.segment: {segment_s:g} s; possible are 10 s to 1 d")
        if keep_s < segment_s:
            self.wrong.append(f"storage.keep: {keep_s:g} s is shorter than a segment of {segment_s:g} s")
        return Storage(table.folder, table.record, table.raw, segment_s, keep_s, table.disk_share, table.history)

    def _reachable(self, zenoh: ZenohTable) -> None:
        """Whether the session could ever open."""
        for key, endpoints in (("listen", zenoh.listen or ()), ("connect", zenoh.connect)):
            for endpoint in endpoints:
                if not IS_ENDPOINT.fullmatch(endpoint):
                    self.wrong.append(f'zenoh.{key}: "{endpoint}" is no endpoint; write "{ENDPOINT}"')
        if zenoh.config is not None and zenoh.mode != "none":
            self._zenoh_file(zenoh.config)
        if zenoh.mode == "client" and not zenoh.connect and zenoh.config is None:
            self.wrong.append('zenoh.connect: empty, but a client needs a router, e.g. ["tcp/127.0.0.1:7447"]')

    def _zenoh_file(self, path: Path) -> None:
        """Whether zenoh takes it, and who else may change it or read the secrets in it."""
        if not os.path.exists(path):
            self.wrong.append(f"zenoh.config: {path}: no such file")
            return
        if line := permissions.changeable(path):
            self.wrong.append(f"zenoh.config: {line}")
        files = self._try("zenoh.config", zenoh_file_secrets, path)
        for file, secret in ((path, None), *((one, True) for one in files or ())):
            if line := permissions.exposed(file, secret):
                self.warnings.append(f"zenoh.config: {file.name}: {line}")

    def device(self, table: Mapping[str, Any], at: str) -> Device | None:
        entry = self.fill(DeviceTable, table, at)
        if entry is None:
            return None
        if not DEVICE_NAME.fullmatch(entry.name):
            self.wrong.append(f'{at}.name: "{entry.name}"; letters, digits, - and _ are possible')
        at = f"device {entry.name}"
        window_s = self._try(f"{at}: window", seconds, entry.window)
        refit_s = self._try(f"{at}: refit", period, entry.refit, "every sample")
        publish_s = self._try(f"{at}: publish", period, entry.publish, "every block")
        axes = self._try(f"{at}: axes", axis_map, entry.axes)
        link, decoder = self.driver(entry.driver, f"{at}: driver")
        if window_s is None or refit_s is None or publish_s is None or axes is None or link is None or decoder is None:
            return None
        self._try(f"{at}: window", _possible_window, window_s, entry.rate)
        thermal_s = self._try(f"{at}: thermal_interval", _thermal_interval, entry.thermal_interval, entry.rate)
        model = None if entry.model is None else self._try(f"{at}: model", model_path, entry.model, self._folder)
        tau = entry.tau if isinstance(entry.tau, str) else tuple(entry.tau)
        self._try(f"{at}: tau", _possible_tau, tau, window_s, entry.rate)
        limits = self._limits(entry.limit, entry.model is not None, f"{at}: limit")
        silence_s = float(entry.driver.get("silence", LinkSettings().silence))
        return Device(
            entry.name, entry.rate, window_s, tau, refit_s, publish_s, link, decoder, axes, silence_s,
            entry.motion == "leave out", entry.alarms_per_day, entry.restart, model,
            entry.reconcile_folder, thermal_s, entry.compensate, limits,
        )  # fmt: skip

    def driver(self, table: Mapping[str, Any], at: str) -> tuple[Link | VirtualTable | None, Decoder | None]:
        keys = dict(table)
        link_name = keys.pop("link", None)
        decoder_name = keys.pop("decoder", "")
        options = keys.pop("decoder_options", {})
        known = sorted({*plugin.names(drivers.links, "_link"), "virtual"} - {"loopback"})
        if link_name not in known:
            said = "missing" if link_name is None else f'unknown link "{link_name}"'
            self.wrong.append(f"{at}.link: {said}{plugin.nearest(str(link_name), known)}")
            return None, None
        if link_name == "virtual":
            link: Link | VirtualTable | None = self._virtual(keys, at)
            carrier, default = "", "vectornav_binary"
        else:
            module = plugin.load(drivers.links, link_name, "_link")
            settings = self.fill(module.Settings, keys, at)
            built: Link | None = None if settings is None else self._try(at, module.build, settings)
            link, carrier = built, built.carrier if built else ""
            default = (
                module.DEFAULT_DECODER if built is None else getattr(built, "default_decoder", module.DEFAULT_DECODER)
            )
        decoder = self.decoder(decoder_name or default, options, at)
        if decoder is not None and carrier and decoder.carrier != carrier:
            fitting = ", ".join(_decoders_of(carrier))
            name = decoder_name or default
            self.wrong.append(
                f"{at}.decoder: {name} reads {decoder.carrier}, link {link_name} brings {carrier}: {fitting}"
            )
        _narrow(link, decoder)
        return link, decoder

    def _virtual(self, keys: Mapping[str, Any], at: str) -> VirtualTable | None:
        named = dict(keys)
        faults = self._faults(named.pop("faults", {}), f"{at}.faults")
        table = self.fill(VirtualTable, named, at)
        path = None if table is None else self._try(f"{at}.model", model_path, table.model, self._folder)
        if table is None or faults is None or path is None:
            return None
        return msgspec.structs.replace(table, model=str(path), faults=faults)

    def _faults(self, keys: Any, at: str) -> FaultsTable | None:
        if not isinstance(keys, dict):
            self.wrong.append(f"{at}: expected a table")
            return None
        table = self.fill(FaultsTable, keys, at)
        if table is not None and table.lost + table.repeated + table.flipped + table.cut > 1.0:
            self.wrong.append(
                f"{at}: lost, repeated, flipped and cut are shares of all samples: their sum is at most 1"
            )
            return None
        return table

    def decoder(self, name: Any, options: Any, at: str) -> Decoder | None:
        if not isinstance(name, str):
            self.wrong.append(f"{at}.decoder: expected a name in quotes, got {name!r}")
            return None
        if not name:
            self.wrong.append(f"{at}.decoder: missing; known are {', '.join(plugin.names(drivers.decoders))}")
            return None
        module = self._try(f"{at}.decoder", plugin.load, drivers.decoders, name)
        if module is None:
            return None
        if not isinstance(options, dict):
            self.wrong.append(f"{at}.decoder_options: expected a table")
            return None
        settings = self.fill(module.Settings, options, f"{at}.decoder_options")
        decoder: Decoder | None = (
            None if settings is None else self._try(f"{at}.decoder_options", module.build, settings)
        )
        return decoder

    def fill(self, kind: type[T], table: Mapping[str, Any], at: str) -> T | None:
        """A struct from a table, each key on its own, so that every wrong one is told."""
        before = len(self.wrong)
        dot = f"{at}." if at else ""
        fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
        values: dict[str, Any] = {}
        for key, value in table.items():
            if key not in fields:
                self.wrong.append(f"{dot}{key}: unknown key{plugin.nearest(key, tuple(fields))}")
                continue
            try:
                converted = msgspec.convert(value, fields[key].type, dec_hook=self._path)
                values[fields[key].name] = self._beside(converted, fields[key].type)
            except (msgspec.ValidationError, ValueError) as error:
                self.wrong.append(f"{dot}{key}: {error}")
        for key, field in fields.items():
            if field.required and key not in table:
                self.wrong.append(f"{dot}{key}: missing")
        return kind(**values) if len(self.wrong) == before else None

    def _beside(self, value: Any, kind: Any) -> Any:
        """Files are looked for beside the configuration file, see ``drivers.plugin``."""
        info = msgspec.inspect.type_info(kind)
        wanted = (info.extra or {}).get("file") if isinstance(info, msgspec.inspect.Metadata) else None
        if not wanted or not value:
            return value
        path = self._folder / small_file.path(value)
        there = os.path.exists(path)  # false for a name that no file can have
        if wanted == "exists" and not there:
            raise ValueError(f"{path}: no such file")
        return str(path) if there else value

    def _path(self, kind: type, value: Any) -> Any:
        if kind is Path and isinstance(value, str):
            return self._folder / small_file.path(value)
        raise ValueError(f"expected a path in quotes, got {value!r}")

    def _try(self, at: str, function: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except ConfigError as error:
            self.wrong.append(f"{at}: {error}")
            return None


def model_path(name: str, folder: Path) -> Path:
    """The shipped model of that name, or the file of that path; relative ones begin at ``folder``.

    Raises:
        ConfigError: neither, with the nearest name
    """
    models = CONFIG_FOLDER / "models"
    shipped = models / f"{name}.toml"
    path = shipped if small_file.is_file(shipped) else folder / small_file.path(name)
    if os.path.exists(path) and not path.is_dir():
        return path  # whatever else it is, its reader says
    names = sorted(file.stem for file in models.glob("*.toml"))
    raise ConfigError(f'no model "{name}", neither a file nor one of those shipped{plugin.nearest(name, names)}')


def zenoh_file_secrets(path: Path) -> tuple[Path, ...]:
    """Files of keys and passwords that a zenoh file names.

    Raises:
        ConfigError: zenoh refuses the file
    """
    import zenoh

    try:
        return secret_files(configuration({}, path))
    except zenoh.ZError as error:
        text = plain(error)
        raise ConfigError(text if text.startswith(str(path)) else f"{path}: {text}") from error


def seconds(value: float | str) -> float:
    """A duration: a number of seconds, or "90s", "30min", "1h", "2d".

    >>> seconds("30min"), seconds(3600), seconds("1.5 h")
    (1800.0, 3600.0, 5400.0)
    """
    if isinstance(value, str):
        match = re.fullmatch(r"\s*([0-9.]+(?:e[+-]?[0-9]+)?)\s*([a-z]*)\s*", value)
        try:
            duration = float(match[1]) * UNITS_S[match[2]] if match else 0.0
        except (KeyError, ValueError):
            duration = 0.0
    else:
        duration = float(value)
    if not 0.0 < duration < inf:
        raise ConfigError(f'"{value}" is no duration; write seconds, or "90s", "30min", "1h", "2d"')
    return duration


def period(value: str, always: str) -> float:
    """Seconds between two runs of something: "10 Hz" -> 0.1; the word ``always`` -> 0.

    >>> period("10 Hz", "every sample"), period("every sample", "every sample")
    (0.1, 0.0)
    """
    if value == always:
        return 0.0
    match = re.fullmatch(r"\s*([0-9.]+)\s*Hz\s*", value)
    try:
        rate_hz = float(match[1]) if match else 0.0
    except ValueError:
        rate_hz = 0.0
    return 1.0 / rate_hz if RATES_HZ[0] <= rate_hz <= RATES_HZ[1] else _no_rate(value, always)


def viewer_mode(mode: str) -> str:
    """The viewer's mode; ConfigError for none that there is."""
    modes = ("auto", "native", "web", "none")
    if mode in modes or mode.endswith(".rrd"):
        return mode
    raise ConfigError(f'"{mode}"; possible are {", ".join(modes)} or a file ending in .rrd')


def _no_rate(value: str, always: str) -> float:
    raise ConfigError(f'"{value}" is no rate; write "10 Hz" or "{always}"')


def _possible_window(window_s: float, rate_hz: float | None) -> None:
    if rate_hz is None:
        if window_s > WINDOW_LONGEST_S:
            raise ConfigError(f"{window_s:g} s; at most {WINDOW_LONGEST_S:g} s")
        return
    low, high = WINDOW_SAMPLES
    if not low <= window_s * rate_hz <= high:
        raise ConfigError(
            f"{window_s:g} s at {rate_hz:g} Hz are {window_s * rate_hz:.0f} samples; "
            f"possible are {low} to {high}: {low / rate_hz:g} to {high / rate_hz:g} s"
        )


def _thermal_interval(value: float | str, rate_hz: float | None) -> float | None:
    """s; None for "off".

    >>> _thermal_interval("10min", 100.0), _thermal_interval("off", 100.0)
    (600.0, None)
    """
    if value == "off":
        return None
    try:
        interval_s = seconds(value)
    except ConfigError:
        raise ConfigError(f'"{value}" is neither a duration nor "off"; write seconds, or "10min", "1h"') from None
    shortest_s = THERMAL_SAMPLES / rate_hz if rate_hz else 0.0
    if not shortest_s <= interval_s <= THERMAL_LONGEST_S:
        few = f"{shortest_s:g} s ({THERMAL_SAMPLES} samples)" if rate_hz else f"{THERMAL_SAMPLES} samples"
        raise ConfigError(f"{interval_s:g} s; possible are {few} to {THERMAL_LONGEST_S:g} s")
    return interval_s


def _possible_tau(tau: str | tuple[float, ...], window_s: float, rate_hz: float | None) -> None:
    """At least one τ of a list lies between one sample and half the window."""
    if isinstance(tau, str):
        return
    shortest_s = 1.0 / rate_hz if rate_hz else 0.0
    # a τ is rounded to whole samples
    if not any(0.5 * shortest_s < one <= 0.5 * window_s for one in tau):
        low = f"{shortest_s:g} s, one sample," if rate_hz else "one sample"
        raise ConfigError(f"none of {list(tau)} s lies between {low} and {window_s / 2:g} s, half the window")


def _axes(pattern: str) -> tuple[str, ...]:
    """Axes of a name or "g*", "a*", "*".

    >>> _axes("g*"), _axes("az")
    (('gx', 'gy', 'gz'), ('az',))
    """
    if pattern in (*AXES, "g*", "a*", "*"):
        return tuple(axis for axis in AXES if fnmatch(axis, pattern))
    raise ConfigError(f'"{pattern}"; possible are {", ".join(AXES)}, g*, a*, *')


def _command(words: list[str], folder: Path) -> tuple[str, ...]:
    """A program and its arguments; a relative path begins at ``folder``."""
    if not words:
        return ()
    if "/" not in words[0]:
        raise ConfigError(f'"{words[0]}" is no path; write where the program is, e.g. "/usr/bin/{words[0]}"')
    if any("\0" in word for word in words):
        raise ConfigError("a word with a NUL character cannot be handed to a program")
    path = folder / small_file.path(words[0])
    if not small_file.is_file(path):
        raise ConfigError(f"{path}: no such file")
    if not os.access(path, os.X_OK):
        raise ConfigError(f"{path}: not executable; chmod +x it")
    return (str(path), *words[1:])


def _narrow(link: object, decoder: object) -> None:
    """A link that can leave things out brings only what its decoder reads."""
    if isinstance(link, Filtering) and isinstance(decoder, Addressed):
        link.accept(decoder.addresses)


def _decoders_of(carrier: str) -> list[str]:
    fitting: list[str] = []
    for name in plugin.names(drivers.decoders):
        module = plugin.load(drivers.decoders, name)
        kinds = [member for member in vars(module).values() if isinstance(member, type)]
        if any(kind.__module__ == module.__name__ and getattr(kind, "carrier", "") == carrier for kind in kinds):
            fitting.append(name)
    return fitting
