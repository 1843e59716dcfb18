"""TOML -> typed settings. Reading opens nothing; everything wrong with a file is found, not only the first thing.

An unknown key is an error that names the nearest known one. Links and decoders bring their own keys: their modules'
``Settings`` are filled from ``[device.driver]`` and ``[device.driver.decoder_options]``. Their ``build`` reports all
mistakes in one ``ConfigError``, a line each that begins with the key. Relative paths are relative to the configuration
file.
"""

import dataclasses
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Generic, Literal, TypeVar

import msgspec

import drivers.decoders
import drivers.links
from drivers import discovery, file_access
from drivers.decoders.base import AddressFilter, Decoder
from drivers.driver import AxisMap, parse_axis_map
from drivers.errors import ConfigError, format_one_line
from drivers.links.base import AddressFilteringLink, Link
from drivers.quantities import DURATION_S, PERCENT, PORT, SIZE_BYTES, UPDATE_RATE_HZ
from drivers.sample import AXES, EVENT_KINDS
from drivers.zenoh.session import build_session_config, find_secret_files, format_error
from monitor.common.config_files import model_path
from monitor.common.topics import ENDPOINT
from monitor.settings import file_permissions, toml_text
from monitor.settings.schema import (
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
from monitor.settings.value_conversion import WRONG, convert, neutral, shown

__all__ = [
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
    "period",
    "read",
    "seconds",
    "viewer_mode",
]

T = TypeVar("T", bound=msgspec.Struct)
T_co = TypeVar("T_co", bound=msgspec.Struct, covariant=True)

UNITS_S: Final = {"": 1.0, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
WINDOW_SAMPLES: Final = (100, 10_000_000)
MAX_WINDOW_S: Final = 40 * 86400.0
THERMAL_SAMPLES: Final = 8
"""In an interval at the least: its scatter tells how well its mean is known."""
MAX_THERMAL_INTERVAL_S: Final = 86400.0
SEGMENT_S: Final = (10.0, 86400.0)
DEVICE_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
IS_ENDPOINT: Final = re.compile(r"[a-z]+/.+")
MAX_QUOTED_CHARACTERS: Final = 60
"""Characters of a wrong value that a message repeats."""
LISTEN: Final = re.compile(r"(\[[0-9a-fA-F:]+\]|[\w.-]+):([0-9]{1,5})", re.ASCII)
MEMORY: Final = re.compile(r"([0-9]{1,20}(?:\.[0-9]{1,20})?)\s*(?:([kMGT]?)(i?)B|%)")


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


@dataclass(frozen=True, slots=True)
class ModelUse:
    """What of a device is to be checked against model files, even if other keys of its table are wrong."""

    device: str
    model: Path | None  # the model in force
    limits: tuple[Limit, ...]
    virtual: VirtualTable | None  # None: the device is not simulated


@dataclass(frozen=True, slots=True)
class Reading:
    """All that reading a configuration found, with mistakes in it or without."""

    config: Config | None  # None: something is wrong
    wrong: list[str]  # a line each, beginning with the file
    models: tuple[ModelUse, ...] = ()


@dataclass(frozen=True, slots=True)
class _Filled(Generic[T_co]):
    """A table with its values; keys that are wrong or missing have their defaults, or an empty value."""

    table: T_co
    wrong: frozenset[str] = frozenset()  # places of wrong values: "tau[1]", "signals.gz"

    def sound(self, *keys: str) -> bool:
        """Return True if nothing is wrong with these keys."""
        return self.wrong.isdisjoint(keys) and not any(re.split(r"[.\[]", place)[0] in keys for place in self.wrong)

    def follows(self, line: str) -> bool:
        """Return True if a line is about a value that is known to be wrong: "key: text" about key or a part of it."""
        place = line.partition(": ")[0]
        return any(one == place or one.startswith((f"{place}.", f"{place}[")) for one in self.wrong)


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
    reading = examine(path, pipe=pipe)
    return reading.config, reading.wrong


def examine(path: Path, *, pipe: bool = False) -> Reading:
    """Read a configuration file and find all that is wrong with it; opens nothing."""
    try:
        text = file_access.read_small_file(path, pipe=pipe).decode("utf-8")
    except FileNotFoundError:
        return Reading(None, [f"{path}: no such file; imu-monitor check --print-defaults prints one to start from"])
    except (OSError, UnicodeDecodeError) as error:
        return Reading(None, [f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"])
    try:
        table = toml_text.format_tables(text)
    except ConfigError as error:
        return Reading(None, [f"{path}: {error}"])
    reader = _Reader(path.resolve().parent)
    config = reader.config(table)
    reader.trust(path)
    if config is None or reader.wrong:
        return Reading(None, [format_one_line(f"{path}: {line}") for line in reader.wrong], tuple(reader.models))
    warnings = tuple(f"{path}: {line}" for line in reader.warnings)
    return Reading(replace(config, path=path, table=table, warnings=warnings), [], tuple(reader.models))


class _Reader:
    """Fills settings from tables and collects what is wrong.

    A wrong key does not hide another: checks go on with the default in its place, and what they find is discarded if
    anything is wrong. A check of several keys is left out if one of them is wrong by itself.
    """

    def __init__(self, folder: Path) -> None:
        self.wrong: list[str] = []
        self.warnings: list[str] = []
        self.models: list[ModelUse] = []
        self._folder = folder

    def trust(self, path: Path) -> None:
        """Who else may change the file itself, or read a secret in it."""
        if line := file_permissions.changeable(path):
            self.wrong.append(line)
        if line := file_permissions.exposed(path):
            self.warnings.append(line)

    def config(self, table: Mapping[str, Any]) -> Config | None:
        filled = self.fill(FileTable, table, "")
        file = filled.table
        if not file.device and filled.sound("device"):
            self.wrong.append("device: there is none; add [[device]] with name and driver")
        devices = [self.device(entry, f"device[{i}]") for i, entry in enumerate(file.device)]
        names = [entry.get("name") for entry in file.device]
        for name in sorted({str(n) for n in names if names.count(n) > 1 and n is not None}):
            count = [str(n) for n in names].count(name)
            self.wrong.append(f'device: {count} devices are named "{name}"; names must be unique')
        zenoh = self._zenoh(file.zenoh)
        viewer = self.fill(ViewerTable, file.viewer, "viewer")
        log = self.fill(LogTable, file.log, "log").table
        if viewer.sound("mode"):
            self._try("viewer.mode", viewer_mode, viewer.table.mode)
        if viewer.sound("memory"):
            self._try("viewer.memory", viewer_memory, viewer.table.memory)
        storage = self._storage(file.storage)
        hooks = self._hooks(file.hook, [str(name) for name in names], zenoh.mode == "none")
        metrics = self._metrics(file.metrics)
        keeps_history = storage is not None and storage.history
        history_s = self._shown_history(viewer, keeps_history or not filled.sound("storage"))
        if self.wrong:
            return None
        shown = msgspec.structs.replace(viewer.table, history=history_s)
        if shown.mode.endswith(".rrd"):
            shown = msgspec.structs.replace(shown, mode=str(self._folder / file_access.expand_user(shown.mode)))
        known = tuple(device for device in devices if device is not None)
        return Config(known, zenoh, shown, log, storage, hooks, metrics)

    def _shown_history(self, viewer: _Filled[ViewerTable], kept: bool) -> float | None:
        """s of it that the viewer opens on."""
        if viewer.table.history is None:
            return None
        if not kept:
            self.wrong.append("viewer.history: none is kept; [storage] folder says where it would be")
        found: float | None = self._try("viewer.history", seconds, viewer.table.history)
        return found

    def _limits(self, tables: list[dict[str, Any]], has_model: bool, at: str) -> tuple[Limit, ...]:
        limits = []
        for i, one in enumerate(tables):
            here = f"{at}[{i}]"
            filled = self.fill(LimitTable, one, here)
            table = filled.table
            axes = self._try(f"{here}.axes", _axes, table.axes) if filled.sound("axes") else None
            hold_s = self._try(f"{here}.hold", seconds, table.hold) if filled.sound("hold") else None
            bounded = self._bounds(filled, has_model, here)
            if bounded and axes and hold_s and filled.sound("letter"):
                limits.append(Limit(axes, table.letter, table.above, table.below, table.times_model, hold_s))
        return tuple(limits)

    def _bounds(self, filled: _Filled[LimitTable], has_model: bool, at: str) -> bool:
        """Whether the bounds of a limit fit each other."""
        if not filled.sound("above", "below", "times_model"):
            return False
        before, table = len(self.wrong), filled.table
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
            filled = self.fill(HookTable, one, at)
            table = filled.table
            timeout_s = self._try(f"{at}.timeout", seconds, table.timeout) if filled.sound("timeout") else None
            for key, said, known in (("on", table.on, (*EVENT_KINDS, "*")), ("devices", table.devices, devices)):
                for word in (word for word in said if word not in known):
                    self.wrong.append(f'{at}.{key}: "{word}"{discovery.format_choices(word, known)}')
            if not table.on and filled.sound("on"):
                self.wrong.append(f'{at}.on: empty; write kinds of events, or ["*"]')
            if not table.command and table.key is None and filled.sound("command", "key"):
                self.wrong.append(f"{at}: nothing to do; add command or key")
            if table.key is not None and no_zenoh:
                self.wrong.append(f'{at}.key: zenoh.mode is "none", so nothing can be put there')
            command = self._try(f"{at}.command", _command, table.command, self._folder)
            hooks.append(
                Hook(frozenset(table.on), frozenset(table.devices), command or (), table.key, timeout_s or 0.0)
            )
        return tuple(hooks)

    def _metrics(self, keys: Mapping[str, Any]) -> Metrics | None:
        table = self.fill(MetricsTable, keys, "metrics").table
        if table.listen is None:
            return None
        match = LISTEN.fullmatch(table.listen)
        if match is None or int(match[2]) == 0 or not PORT.supports(int(match[2])):
            self.wrong.append(f'metrics.listen: "{table.listen}" is no host and port; write "127.0.0.1:9464"')
            return None
        return Metrics(match[1].strip("[]"), int(match[2]))

    def _storage(self, keys: Mapping[str, Any]) -> Storage | None:
        """None where nothing is to be kept, or a key is wrong."""
        filled = self.fill(StorageTable, keys, "storage")
        table = filled.table
        segment_s = self._try("storage.segment", seconds, table.segment) if filled.sound("segment") else None
        keep_s = self._try("storage.keep", seconds, table.keep) if filled.sound("keep") else None
        if segment_s is not None and not SEGMENT_S[0] <= segment_s <= SEGMENT_S[1]:
            self.wrong.append(f"storage.segment: {segment_s:g} s; possible are 10 s to 1 d")
        if segment_s is not None and keep_s is not None and keep_s < segment_s:
            self.wrong.append(f"storage.keep: {keep_s:g} s is shorter than a segment of {segment_s:g} s")
        if table.folder is None:
            return None
        return Storage(
            table.folder, table.record, table.raw, segment_s or 0.0, keep_s or 0.0, table.disk_share, table.history
        )

    def _zenoh(self, keys: Mapping[str, Any]) -> ZenohTable:
        """The table, and whether the session could ever open."""
        unsaid = dict.fromkeys({"mode", "listen"} - keys.keys()) if "config" in keys else {}
        filled = self.fill(ZenohTable, {**unsaid, **keys}, "zenoh")
        zenoh = filled.table
        for key, endpoints in (("listen", zenoh.listen or ()), ("connect", zenoh.connect)):
            for endpoint in endpoints:
                if not IS_ENDPOINT.fullmatch(endpoint):
                    self.wrong.append(f'zenoh.{key}: "{endpoint}" is no endpoint; write "{ENDPOINT}"')
        if zenoh.config is not None and zenoh.mode != "none":
            self._zenoh_file(zenoh.config)
        alone = not zenoh.connect and zenoh.config is None
        if zenoh.mode == "client" and alone and filled.sound("connect", "config"):
            self.wrong.append('zenoh.connect: empty, but a client needs a router, e.g. ["tcp/127.0.0.1:7447"]')
        return zenoh

    def _zenoh_file(self, path: Path) -> None:
        """Whether zenoh takes it, and who else may change it or read the secrets in it."""
        if not os.path.exists(path):
            self.wrong.append(f"zenoh.config: {path}: no such file")
            return
        if line := file_permissions.changeable(path):
            self.wrong.append(f"zenoh.config: {line}")
        files = self._try("zenoh.config", zenoh_file_secrets, path)
        for file, secret in ((path, None), *((one, True) for one in files or ())):
            if line := file_permissions.exposed(file, secret):
                self.warnings.append(f"zenoh.config: {file.name}: {line}")

    def device(self, table: Mapping[str, Any], at: str) -> Device | None:
        filled = self.fill(DeviceTable, table, at)
        entry = filled.table
        if filled.sound("name"):
            if not DEVICE_NAME.fullmatch(entry.name):
                self.wrong.append(f'{at}.name: "{entry.name}"; letters, digits, - and _ are possible')
            at = f"device {entry.name}"
        rate = entry.rate if filled.sound("rate") else None
        window_s = self._try(f"{at}: window", seconds, entry.window) if filled.sound("window") else None
        refit_s = self._try(f"{at}: refit", period, entry.refit, "every sample") if filled.sound("refit") else None
        publish_s = (
            self._try(f"{at}: publish", period, entry.publish, "every block") if filled.sound("publish") else None
        )
        axes = self._try(f"{at}: axes", parse_axis_map, entry.axes)
        link, decoder, silence_s = None, None, 0.0
        if filled.sound("driver"):
            link, decoder, silence_s = self.driver(entry.driver, f"{at}: driver")
        tau = entry.tau if isinstance(entry.tau, str) else tuple(entry.tau)
        if window_s is not None and filled.sound("rate"):
            self._try(f"{at}: window", _possible_window, window_s, rate)
            if filled.sound("tau"):
                self._try(f"{at}: tau", _possible_tau, tau, window_s, rate)
        thermal_s = None
        if filled.sound("thermal_interval"):
            thermal_s = self._try(f"{at}: thermal_interval", _thermal_interval, entry.thermal_interval, rate)
        model = None if entry.model is None else self._try(f"{at}: model", model_path, entry.model, self._folder)
        limits = self._limits(entry.limit, entry.model is not None or not filled.sound("model"), f"{at}: limit")
        virtual = link if isinstance(link, VirtualTable) else None
        self.models.append(ModelUse(at, model, limits, virtual))
        if link is None or decoder is None:
            return None
        return Device(
            entry.name, rate, window_s or 0.0, tau, refit_s or 0.0, publish_s or 0.0, link, decoder,
            axes or AxisMap(), silence_s, entry.motion == "leave out", entry.alarms_per_day, entry.restart, model,
            entry.reconcile_folder, thermal_s, entry.compensate, limits,
        )  # fmt: skip

    def driver(self, table: Mapping[str, Any], at: str) -> tuple[Link | VirtualTable | None, Decoder | None, float]:
        """Link, decoder and ``silence`` in s; without a link or decoder where it is unknown or wrong."""
        keys = dict(table)
        link_name = keys.pop("link", None)
        decoder_name = keys.pop("decoder", "")
        options = keys.pop("decoder_options", {})
        known = sorted({*discovery.list_modules(drivers.links, "_link"), "virtual"})
        if link_name not in known:
            said = "missing" if link_name is None else shown(link_name)
            self.wrong.append(f"{at}.link: {said}{discovery.format_choices(str(link_name or ''), known)}")
            if decoder_name:
                self.decoder(decoder_name, options, at)
            return None, None, 0.0
        link, silence_s, carrier, default = self._link(link_name, keys, at)
        decoder, decodes = self.decoder(decoder_name or default, options, at)
        if carrier and decodes and decodes != carrier:
            fitting = ", ".join(_decoders_of(carrier))
            name = decoder_name or default
            self.wrong.append(f"{at}.decoder: {name} reads {decodes}, link {link_name} brings {carrier}: {fitting}")
        _narrow(link, decoder)
        return link, decoder, silence_s

    def _link(self, name: str, keys: Mapping[str, Any], at: str) -> tuple[Link | VirtualTable | None, float, str, str]:
        """Link, its ``silence`` in s, what it carries ("": anything), and its default decoder."""
        if name == "virtual":
            table = self._virtual(keys, at)
            return table, table.silence, "", "vectornav_binary"
        module = discovery.import_module(drivers.links, name, "_link")
        filled = self.fill(module.Settings, keys, at)
        link: Link | None = self._build(module, filled, at)
        if link is None:
            return None, 0.0, _carrier_of(module), module.DEFAULT_DECODER
        default = getattr(link, "default_decoder", module.DEFAULT_DECODER)
        return link, filled.table.silence, link.carrier, default

    def _virtual(self, keys: Mapping[str, Any], at: str) -> VirtualTable:
        named = dict(keys)
        faults = self._faults(named.pop("faults", {}), f"{at}.faults")
        table = self.fill(VirtualTable, named, at).table
        path = self._try(f"{at}.model", model_path, table.model, self._folder)
        return msgspec.structs.replace(table, model="" if path is None else str(path), faults=faults)

    def _faults(self, keys: Any, at: str) -> FaultsTable:
        if not isinstance(keys, dict):
            self.wrong.append(f"{at}: expected a table, got {shown(keys)}")
            return FaultsTable()
        table = self.fill(FaultsTable, keys, at).table
        if table.lost + table.repeated + table.flipped + table.cut > 1.0:
            self.wrong.append(
                f"{at}: lost, repeated, flipped and cut are shares of all samples: their sum is at most 1"
            )
        return table

    def decoder(self, name: Any, options: Any, at: str) -> tuple[Decoder | None, str]:
        """The decoder, and what it reads ("": unknown); None where it is unknown or its options are wrong."""
        known = discovery.list_modules(drivers.decoders)
        if not name or name not in known:
            said = shown(name) if name else "missing"
            self.wrong.append(f"{at}.decoder: {said}{discovery.format_choices(str(name), known)}")
            return None, ""
        module = discovery.import_module(drivers.decoders, name)
        if not isinstance(options, dict):
            self.wrong.append(f"{at}.decoder_options: expected a table, got {shown(options)}")
            return None, _carrier_of(module)
        filled = self.fill(module.Settings, options, f"{at}.decoder_options")
        return self._build(module, filled, f"{at}.decoder_options"), _carrier_of(module)

    def _build(self, module: Any, filled: _Filled[Any], at: str) -> Any:
        """The link or decoder of a module; None where its settings are wrong, which the module knows best."""
        try:
            built = module.build(filled.table)
        except ConfigError as error:
            keys = {field.encode_name for field in msgspec.structs.fields(filled.table)}
            for line in (line for line in error.lines if not filled.follows(line)):
                dot = "." if re.split(r"[.\[:]", line)[0] in keys else ": "
                self.wrong.append(f"{at}{dot}{line}")
            return None
        return None if filled.wrong else built

    def fill(self, kind: type[T], table: Mapping[str, Any], at: str) -> _Filled[T]:
        """A struct from a table, each key on its own, so that every wrong one is told."""
        dot = f"{at}." if at else ""
        fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
        values: dict[str, Any] = {}
        wrong: list[str] = []
        for key, value in table.items():
            if key not in fields:
                wrong.append(key)
                self.wrong.append(f"{dot}{key}: unknown key{discovery.format_suggestion(key, tuple(fields))}")
                continue
            converted, problems = convert(value, fields[key].type, self._path)
            if not problems:
                try:
                    converted = self._beside(converted, fields[key].type)
                except ValueError as error:
                    converted, problems = WRONG, [("", str(error))]
            for place, text in problems:
                wrong.append(f"{key}{place}")
                self.wrong.append(f"{dot}{key}{place}: {text}")
            if converted is not WRONG:
                values[fields[key].name] = converted
        for key, field in fields.items():
            if field.required and key not in table:
                wrong.append(key)
                self.wrong.append(f"{dot}{key}: missing")
            if field.required and field.name not in values:
                values[field.name] = neutral(field.type)
        return _Filled(kind(**values), frozenset(wrong))

    def _beside(self, value: Any, kind: Any) -> Any:
        """Files are looked for beside the configuration file, see ``drivers.discovery``."""
        info = msgspec.inspect.type_info(kind)
        wanted = (info.extra or {}).get("file") if isinstance(info, msgspec.inspect.Metadata) else None
        if not wanted or not value:
            return value
        path = self._folder / file_access.expand_user(value)
        there = os.path.exists(path)  # false for a name that no file can have
        if wanted == "exists" and not there:
            raise ValueError(f"{path}: no such file")
        return str(path) if there else value

    def _path(self, kind: type, value: Any) -> Any:
        if kind is Path and isinstance(value, str):
            return self._folder / file_access.expand_user(value)
        raise ValueError("not a path")

    def _try(self, at: str, function: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except ConfigError as error:
            self.wrong += [f"{at}: {line}" for line in error.lines]
            return None


def zenoh_file_secrets(path: Path) -> tuple[Path, ...]:
    """Files of keys and passwords that a zenoh file names.

    Raises:
        ConfigError: zenoh refuses the file
    """
    import zenoh

    try:
        return find_secret_files(build_session_config({}, path))
    except zenoh.ZError as error:
        text = format_error(error)
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
    if not duration > 0.0:
        raise ConfigError(f'"{_shortened(value)}" is no duration; write seconds, or "90s", "30min", "1h", "2d"')
    return DURATION_S.check(duration)


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
    if not rate_hz > 0.0:
        raise ConfigError(f'"{_shortened(value)}" is no rate; write "10 Hz" or "{always}"')
    return 1.0 / UPDATE_RATE_HZ.check(rate_hz)


def viewer_memory(size: str) -> str:
    """The viewer's limit of memory as Rerun reads it; ConfigError for a text that is no size.

    >>> viewer_memory("256MiB"), viewer_memory("25%")
    ('256MiB', '25%')
    """
    match = MEMORY.fullmatch(size)
    if match is None:
        raise ConfigError(f'"{_shortened(size)}" is no size; write "256MiB", "1GB" or "25%"')
    number, prefix, binary = match.groups()
    if size.endswith("%"):
        PERCENT.check(float(number))
    else:
        SIZE_BYTES.check(float(number) * (1024.0 if binary else 1000.0) ** ("", *"kMGT").index(prefix))
    return size


def viewer_mode(mode: str) -> str:
    """The viewer's mode; ConfigError for none that there is."""
    modes = ("auto", "native", "web", "none")
    if mode in modes or mode.endswith(".rrd"):
        return mode
    raise ConfigError(f'"{mode}"{discovery.format_choices(mode, modes)}, or a file ending in .rrd')


def _shortened(value: object) -> str:
    """Enough of a text to recognise it in a message."""
    text = str(value)
    return text if len(text) <= MAX_QUOTED_CHARACTERS else f"{text[:MAX_QUOTED_CHARACTERS]}…"


def _possible_window(window_s: float, rate_hz: float | None) -> None:
    if rate_hz is None:
        if window_s > MAX_WINDOW_S:
            raise ConfigError(f"{window_s:g} s; at most {MAX_WINDOW_S:g} s")
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
    if not shortest_s <= interval_s <= MAX_THERMAL_INTERVAL_S:
        few = f"{shortest_s:g} s ({THERMAL_SAMPLES} samples)" if rate_hz else f"{THERMAL_SAMPLES} samples"
        raise ConfigError(f"{interval_s:g} s; possible are {few} to {MAX_THERMAL_INTERVAL_S:g} s")
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
    raise ConfigError(f'"{pattern}"{discovery.format_choices(pattern, (*AXES, "g*", "a*", "*"))}')


def _command(words: list[str], folder: Path) -> tuple[str, ...]:
    """A program and its arguments; a relative path begins at ``folder``."""
    if not words:
        return ()
    if "/" not in words[0]:
        raise ConfigError(f'"{words[0]}" is no path; write where the program is, e.g. "/usr/bin/{words[0]}"')
    if any("\0" in word for word in words):
        raise ConfigError("a word with a NUL character cannot be handed to a program")
    path = folder / file_access.expand_user(words[0])
    if not file_access.is_file(path):
        raise ConfigError(f"{path}: no such file")
    if not os.access(path, os.X_OK):
        raise ConfigError(f"{path}: not executable; chmod +x it")
    return (str(path), *words[1:])


def _narrow(link: object, decoder: object) -> None:
    """A link that can leave things out brings only what its decoder reads."""
    if isinstance(link, AddressFilteringLink) and isinstance(decoder, AddressFilter):
        link.accept(decoder.addresses)


def _decoders_of(carrier: str) -> list[str]:
    modules = [
        (name, discovery.import_module(drivers.decoders, name)) for name in discovery.list_modules(drivers.decoders)
    ]
    return [name for name, module in modules if _carrier_of(module) == carrier]


def _carrier_of(module: ModuleType) -> str:
    """What a link module brings, or a decoder module reads; "" where its settings decide."""
    kinds = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    return next((str(kind.carrier) for kind in kinds if hasattr(kind, "carrier")), "")
