"""Settings classes, which define the keys, types, ranges and defaults of a configuration file.

``monitor.settings.driver_settings`` defines the table ``[device.driver]``.
"""

import os
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, Strict, ValidationInfo, model_validator

from drivers.data_types import AXES, EVENT_KINDS
from drivers.decoders.base import Decoder
from drivers.driver import AxisMap, parse_axis_map
from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from drivers.links.base import Link
from drivers.validation import module_lookup, number_ranges
from drivers.validation.number_ranges import DAY_S, NumberRange
from drivers.validation.settings_model import (
    Conflict,
    ConvertedFrom,
    KeywordOrType,
    ListOf,
    SettingsModel,
    checked_by,
    one_of,
)
from drivers.zenoh.ros2_imu_message import FRAME_ID
from monitor.common.shipped_config_paths import resolve_model_path
from monitor.common.topics import ENDPOINT
from monitor.common.unit_formatting import UNIT_SYSTEMS
from monitor.settings.driver_settings import BuiltLinkAndDecoder, VirtualTable, build_link_and_decoder
from monitor.settings.field_types import (
    DURATION_FROM_TEXT,
    INFLUX_URL,
    Address,
    Duration,
    Endpoint,
    InfluxUrl,
    RelativePath,
    ZenohKey,
    check_memory_limit,
    check_viewer_mode,
    period_stated_as_rate_annotation,
)
from monitor.settings.ros2_table import ROS_NAME, FrameId, Ros2Table, ros_name

WINDOW_SAMPLES: Final = (100, 10_000_000)
"""Smallest and largest number of samples in the sliding window."""
MAX_WINDOW_S: Final = 40 * DAY_S
"""Longest sliding window if the sample rate is not configured."""
THERMAL_INTERVAL_SAMPLES: Final = 8
"""Minimum number of samples in a thermal interval, for an estimate of the uncertainty of the mean."""
THERMAL_INTERVAL_S: Final = NumberRange("s", 1e-6, DAY_S)
SEGMENT_LENGTH_S: Final = NumberRange("s", 10.0, DAY_S)
INFLUX_INTERVAL_S: Final = NumberRange("s", 1.0, DAY_S)
DEVICE_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
AXIS_PATTERNS: Final = (*AXES, "g*", "a*", "*")

Coefficient = Annotated[float, number_ranges.COEFFICIENT]


def select_axes(pattern: str, _: object = None) -> tuple[str, ...]:
    """Return the axes that match an axis name or one of the patterns "g*", "a*" and "*".

    >>> select_axes("g*"), select_axes("az")
    (('gx', 'gy', 'gz'), ('az',))
    """
    if pattern not in AXIS_PATTERNS:
        raise ConfigError(f'"{pattern}"{module_lookup.format_choices_by_similarity(pattern, AXIS_PATTERNS)}')
    return tuple(axis for axis in AXES if fnmatch(axis, pattern))


class Limit(SettingsModel):
    """Table ``[[device.limit]]``: bounds of one noise coefficient."""

    axes: Annotated[tuple[str, ...], ConvertedFrom(str, select_axes)] = Field(
        examples=["g*"], description='axes to which the limit applies: gx ... az, "g*", "a*" or "*"'
    )
    letter: Literal["Q", "N", "B", "K", "R"] = Field(examples=["N"], description="noise coefficient")
    above: Coefficient | None = Field(
        None, examples=[2.0e-4], description="upper bound in the SI unit of the coefficient, as in a model file"
    )
    below: Coefficient | None = Field(
        None, examples=[1.0e-5], description="lower bound in the SI unit of the coefficient, as in a model file"
    )
    times_model: Annotated[float, number_ranges.NOISE_RATIO] | None = Field(
        None,
        examples=[1.5],
        description="instead of above: upper bound as a multiple of the coefficient in the noise model of the device",
    )
    hold_s: Duration = Field(
        60.0,
        alias="hold",
        examples=["1min"],
        description="time that the coefficient must stay beyond a bound, or within the bounds, before an event occurs",
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if the limit has no bound, or if the bounds contradict each other."""
        bounds = ("above", "below", "times_model")
        if self.above is None and self.below is None and self.times_model is None:
            yield Conflict("", "no bound; add above, below or times_model", bounds)
        if self.above is not None and self.times_model is not None:
            yield Conflict("", "above and times_model are the same bound; leave one out", bounds)
        if self.above is not None and self.below is not None and self.below >= self.above:
            yield Conflict("", f"below {self.below:g} must be less than above {self.above:g}", bounds)


def _check_name(name: str) -> None:
    if not DEVICE_NAME.fullmatch(name):
        raise ConfigError(f'"{name}"; letters, digits, - and _ are possible')


def _model_in_force(name: str, folder: Path | None) -> Path:
    return resolve_model_path(name, folder or Path())


class Device(SettingsModel):
    """Table ``[[device]]``: settings of one device."""

    name: Annotated[str, checked_by(_check_name)] = Field(
        examples=["bench-1"],
        description="letters, digits, - and _; must be unique, because every zenoh key contains the name",
    )
    driver: Annotated[BuiltLinkAndDecoder, ConvertedFrom(dict[str, Any], build_link_and_decoder)] = Field(
        examples=[{"link": "virtual"}], description="link and decoder"
    )
    rate_hz: Annotated[float, number_ranges.RATE_HZ] | None = Field(
        None,
        alias="rate",
        examples=[100.0],
        description="nominal sample rate in Hz; absent: measured from the sample times",
    )
    window_s: Duration = Field(3600.0, alias="window", examples=["1h"], description="length of the sliding window")
    tau: Annotated[
        Literal["octave", "decade10"] | tuple[float, ...],
        KeywordOrType(
            {"octave": "octave", "decade10": "decade10"}, ListOf[Annotated[float, number_ranges.AVERAGING_TIME_S]]
        ),
    ] = Field("octave", description="averaging times: a grid, or a list of seconds")
    refit_s: Annotated[float, period_stated_as_rate_annotation("every sample")] = Field(
        0.1,
        alias="refit",
        examples=["10 Hz"],
        description='rate at which the coefficients are fitted, or "every sample"',
    )
    publish_s: Annotated[float, period_stated_as_rate_annotation("every block")] = Field(
        0.1, alias="publish", examples=["10 Hz"], description='rate at which results are published, or "every block"'
    )
    motion: Literal["tell", "leave out"] = Field(
        "tell",
        description="tell: report motion; leave out: also exclude samples taken during motion (delay: 0.5 s)",
    )
    alarms_per_day: Annotated[float, number_ranges.ALARMS_PER_DAY] = Field(
        0.033,
        description="accepted false alarms of noise changes per day, on all axes together; 0 = no detection",
    )
    restart: bool = Field(
        True, description="true: after a change of the noise of an axis, discard the older samples of this axis"
    )
    model: Annotated[Path | None, ConvertedFrom(str, _model_in_force)] = Field(
        None,
        examples=["consumer-mems"],
        description="noise model with which the samples are compared: path of a model file, or name of a shipped model",
    )
    compensate: bool = Field(True, description="true: also publish the samples without the drift of the gyroscopes")
    thermal_s: Annotated[
        float | None, KeywordOrType({"off": None}, Annotated[float, THERMAL_INTERVAL_S, DURATION_FROM_TEXT])
    ] = Field(
        600.0,
        alias="thermal_interval",
        examples=["10min"],
        description='length of the intervals over which the thermal models average bias and temperature, or "off"',
    )
    reconcile_folder: RelativePath | None = Field(
        None,
        examples=["reports"],
        description="folder for the newest 20 reports of command/reconcile; absent: the reports are not kept",
    )
    frame_id: FrameId = Field(FRAME_ID, description="coordinate frame of the samples in ROS 2")
    axes: Annotated[AxisMap, ConvertedFrom(dict[str, str], lambda table, folder: parse_axis_map(table))] = Field(
        AxisMap(),
        examples=[{axis: axis for axis in AXES}],
        description='mounting of the sensor: axis of the output = axis of the sensor, as in gx = "-gy"',
    )
    limits: ListOf[Limit] = Field((), alias="limit", description="bounds of the coefficients")

    @property
    def link(self) -> Link | VirtualTable:
        """Link of the device, or settings of a simulated sensor."""
        return self.driver.link

    @property
    def decoder(self) -> Decoder:
        """Decoder of the device."""
        return self.driver.decoder

    @property
    def silence_s(self) -> float:
        """Time without data in seconds after which the link is reopened, or 0 for never."""
        return self.driver.silence_s

    @property
    def leave_out_motion(self) -> bool:
        """True if samples during motion are excluded from the noise analysis."""
        return self.motion == "leave out"

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict for each duration that does not match the sample rate, and for each relative limit without a
        noise model."""
        if text := self._window_problem():
            yield Conflict("window", text, ("rate",))
        if text := self._tau_problem():
            yield Conflict("tau", text, ("window", "rate"))
        shortest_s = THERMAL_INTERVAL_SAMPLES / (self.rate_hz or float("inf"))
        if self.thermal_s is not None and self.thermal_s < shortest_s:
            text = f"{self.thermal_s:g} s; possible are {shortest_s:g} s ({THERMAL_INTERVAL_SAMPLES} samples) to 1 d"
            yield Conflict("thermal_interval", text, ("rate",))
        for i, limit in enumerate(self.limits):
            if limit.times_model is not None and self.model is None:
                yield Conflict(f"limit[{i}].times_model", "the device has no model in force; add model", ("model",))

    def _window_problem(self) -> str:
        """Return a message if the sliding window is too short or too long, otherwise an empty string."""
        if self.rate_hz is None:
            return f"{self.window_s:g} s; at most {MAX_WINDOW_S:g} s" if self.window_s > MAX_WINDOW_S else ""
        low, high = WINDOW_SAMPLES
        samples = self.window_s * self.rate_hz
        if low <= samples <= high:
            return ""
        return (
            f"{self.window_s:g} s at {self.rate_hz:g} Hz are {samples:.0f} samples; "
            f"possible are {low} to {high}: {low / self.rate_hz:g} to {high / self.rate_hz:g} s"
        )

    def _tau_problem(self) -> str:
        """Return a message if no configured averaging time is possible, otherwise an empty string."""
        shortest_s = 1.0 / self.rate_hz if self.rate_hz else 0.0
        if isinstance(self.tau, str) or any(0.5 * shortest_s < one <= 0.5 * self.window_s for one in self.tau):
            return ""
        low = f"{shortest_s:g} s, one sample," if self.rate_hz else "one sample"
        return f"none of {list(self.tau)} s lies between {low} and {self.window_s / 2:g} s, half the window"


class ZenohTable(SettingsModel):
    """Table ``[zenoh]``: settings of the zenoh session of the daemon."""

    mode: Literal["peer", "client", "router", "none"] | None = Field("peer", description="mode of the session")
    listen: ListOf[Endpoint] | None = Field(
        (ENDPOINT,), description="endpoints on which the daemon listens; if they are in use, a free port is used"
    )
    connect: ListOf[Endpoint] = Field(
        (), examples=[["tcp/127.0.0.1:7447"]], description="routers or daemons to which the daemon connects"
    )
    config: RelativePath | None = Field(
        None, examples=["zenoh.json5"], description="zenoh file for all other settings (TLS, access control)"
    )
    prefix: ZenohKey = Field("imu", description="keys are <prefix>/<device>/...")

    @model_validator(mode="before")
    @classmethod
    def _prefer_file(cls, table: Any, info: ValidationInfo) -> Any:
        """Set ``mode`` and ``listen`` to None if a zenoh file is named, because the zenoh file takes precedence."""
        if info.context is None or not isinstance(table, dict) or "config" not in table:
            return table
        return {"mode": None, "listen": None, **table}

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if a zenoh client has no router endpoint."""
        if self.mode == "client" and not self.connect and self.config is None:
            text = 'empty, but a client needs a router, e.g. ["tcp/127.0.0.1:7447"]'
            yield Conflict("connect", text, ("mode", "config"))


def _viewer_mode(mode: str, info: ValidationInfo) -> str:
    """Check the viewer mode, and resolve a file name relative to the configuration file."""
    check_viewer_mode(mode)
    folder = info.context.folder if info.context else None
    return str(folder / safe_file_reading.expand_user(mode)) if folder and mode.endswith(".rrd") else mode


class ViewerTable(SettingsModel):
    """Table ``[viewer]``: settings of the live viewer."""

    mode: Annotated[str, AfterValidator(_viewer_mode)] = Field(
        "auto", description="where to show the viewer: auto, native, web, none, or a file ending in .rrd"
    )
    port: Annotated[int, number_ranges.PORT] = Field(
        9876, description="TCP port on loopback for the data of the viewer"
    )
    web_port: Annotated[int, number_ranges.PORT] = Field(
        9090, description="TCP port on loopback for the web page of the viewer"
    )
    memory: Annotated[str, checked_by(check_memory_limit)] = Field(
        "256MiB", description="largest memory for past data in the viewer; the oldest data are dropped first"
    )
    units: Annotated[str, one_of(tuple(UNIT_SYSTEMS))] = Field(
        "imu", description="units of the viewer and of the table in the terminal: imu, datasheet or si"
    )
    history: Duration | None = Field(
        None,
        examples=["1d"],
        description="duration of the stored history that is shown when the viewer opens; needs [storage]",
    )


class Storage(SettingsModel):
    """Table ``[storage]``: settings for samples and results on disk."""

    folder: RelativePath = Field(
        Path(),
        examples=["/var/lib/imu-monitor"],
        description="folder for samples and results; absent: nothing is stored, and the window is empty at a restart",
    )
    record: bool = Field(
        True, description="true: store samples in segments, which all commands can read; needs imu-monitor[arrow]"
    )
    raw: bool = Field(False, description="true: also store the received bytes, so that they can be decoded again")
    segment_s: Annotated[float, SEGMENT_LENGTH_S, DURATION_FROM_TEXT] = Field(
        3600.0, alias="segment", examples=["1h"], description="duration of one segment, which is one file"
    )
    keep_s: Duration = Field(
        30 * DAY_S, alias="keep", examples=["30d"], description="age at which segments are deleted"
    )
    disk_share: Annotated[float, number_ranges.POSITIVE_SHARE] = Field(
        0.9, description="if a larger share of the disk is in use, the oldest segments are deleted"
    )
    history: bool = Field(
        True, description="true: store results, events and status for years; older results cover longer intervals"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if segments would be deleted before they are complete."""
        if self.keep_s < self.segment_s:
            text = f"{self.keep_s:g} s is shorter than a segment of {self.segment_s:g} s"
            yield Conflict("keep", text, ("segment",))


def _program(words: tuple[str, ...], folder: Path | None) -> tuple[str, ...]:
    """Check a command, and resolve the program path relative to the configuration file."""
    if not words:
        return ()
    if "/" not in words[0]:
        raise ConfigError(f'"{words[0]}" is not a path; write the path of the program, e.g. "/usr/bin/{words[0]}"')
    if any("\0" in word for word in words):
        raise ConfigError("a word with a NUL character cannot be passed to a program")
    path = (folder or Path()) / safe_file_reading.expand_user(words[0])
    if not safe_file_reading.is_file(path):
        raise ConfigError(f"{path}: no such file")
    if not os.access(path, os.X_OK):
        raise ConfigError(f"{path}: not executable; chmod +x it")
    return (str(path), *words[1:])


def _check_events(kinds: frozenset[str]) -> None:
    if not kinds:
        raise ConfigError('empty; write kinds of events, or ["*"]')


class Hook(SettingsModel):
    """Table ``[[hook]]``: a command or a zenoh message for certain events."""

    on: Annotated[frozenset[Annotated[str, one_of((*EVENT_KINDS, "*"))]], Strict(False), checked_by(_check_events)] = (
        Field(examples=[["limit_crossed", "link_lost"]], description='kinds of events, or ["*"]')
    )
    devices: Annotated[frozenset[str], Strict(False)] = Field(
        frozenset(),
        examples=[["bench-1"]],
        description="names of the devices whose events are used; absent: all devices",
    )
    command: Annotated[tuple[str, ...], ConvertedFrom(ListOf[str], _program)] = Field(
        (),
        examples=[["/usr/local/bin/tell", "--loud"]],
        description="program and arguments, run without a shell; the event is sent to standard input as JSON",
    )
    key: ZenohKey | None = Field(
        None, examples=["site/alarms"], description="zenoh key on which the event is published as JSON"
    )
    timeout_s: Duration = Field(
        30.0, alias="timeout", examples=["30s"], description="time after which the command and its children are killed"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if the hook has neither a command nor a zenoh key."""
        if not self.command and self.key is None:
            yield Conflict("", "nothing to do; add command or key", ("command", "key"))


class MetricsTable(SettingsModel):
    """Table ``[metrics]``: settings of the metrics for Prometheus."""

    listen: Address | None = Field(
        None,
        examples=["127.0.0.1:9464"],
        description="host and port for the metrics; absent: the daemon does not listen; needs imu-monitor[metrics]",
    )


class InfluxTable(SettingsModel):
    """Table ``[influx]``: settings of the output to InfluxDB."""

    url: InfluxUrl | None = Field(
        None,
        examples=[INFLUX_URL],
        description="http or https address of the write endpoint of InfluxDB; absent: nothing is sent",
    )
    token_file: RelativePath | None = Field(
        None, examples=["influx-token"], description="file that contains the token; absent: requests contain no token"
    )
    interval_s: Annotated[float, INFLUX_INTERVAL_S, DURATION_FROM_TEXT] = Field(
        10.0, alias="interval", examples=["10s"], description="interval between two requests"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if there is a token and no server."""
        if self.token_file is not None and self.url is None:
            yield Conflict("token_file", "there is no server to send the token to; add url", ("url",))


class ServiceTable(SettingsModel):
    """Table ``[service]``: settings of the processes of the daemon."""

    workers: Annotated[int, KeywordOrType({"auto": 0}, Annotated[int, number_ranges.WORKERS])] = Field(
        0,
        examples=["auto"],
        description='number of processes that share the devices; 1: a single process, "auto": one for each 8 devices',
    )


class LogTable(SettingsModel):
    """Table ``[log]``: settings of the log messages."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="lowest level of messages that are written"
    )
    format: Literal["text", "json"] = Field("text", description="format of the log lines")


class ConfigFile(SettingsModel):
    """Complete configuration file."""

    devices: ListOf[Device] = Field((), alias="device", description="devices")
    zenoh: ZenohTable = Field(ZenohTable(), description="zenoh session of the daemon")
    viewer: ViewerTable = Field(ViewerTable(), description="live view")
    storage: Storage = Field(Storage(), description="samples and results that are kept on disk")
    hooks: ListOf[Hook] = Field((), alias="hook", description="actions for events")
    metrics: MetricsTable = Field(MetricsTable(), description="numbers for Prometheus")
    influx: InfluxTable = Field(InfluxTable(), description="numbers for InfluxDB")
    ros2: Ros2Table = Field(Ros2Table(), description="diagnostics and samples for ROS 2")
    log: LogTable = Field(LogTable(), description="messages of the service")
    service: ServiceTable = Field(ServiceTable(), description="processes of the service")

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield the conflicts between tables of a configuration file."""
        names = [device.name for device in self.devices]
        places = tuple(f"device[{i}].name" for i in range(len(names)))
        if not names:
            yield Conflict("device", "there is none; add [[device]] with name and driver")
        for name in dict.fromkeys(name for name in names if names.count(name) > 1):
            same = [place for place, one in zip(places, names, strict=True) if one == name]
            yield Conflict(same[-1], f'{len(same)} devices are named "{name}"; names must be unique', tuple(same))
        for i, hook in enumerate(self.hooks):
            for name in sorted(hook.devices - set(names)):
                yield Conflict(
                    f"hook[{i}].devices", f'"{name}"{module_lookup.format_choices_by_similarity(name, names)}', places
                )
            if hook.key is not None and self.zenoh.mode == "none":
                text = 'zenoh.mode is "none", so the message cannot be published'
                yield Conflict(f"hook[{i}].key", text, ("zenoh.mode",))
        if self.viewer.history is not None and not (self.storage.history and self.storage.folder != Path()):
            text = "there is no history to show; add folder to [storage]"
            yield Conflict("viewer.history", text, ("storage",))
        if self.ros2.domain is not None and self.ros2.imu != "none":
            yield from self._find_ros2_conflicts()

    def _find_ros2_conflicts(self) -> Iterator[Conflict]:
        """Yield a conflict for each device whose samples cannot be published in ROS 2."""
        devices: dict[str, str] = {}
        for i, device in enumerate(self.devices):
            name = ros_name(device.name)
            if not ROS_NAME.fullmatch(name):
                yield Conflict(
                    f"device[{i}].name", f'"{device.name}" begins with a digit, which ROS 2 refuses', ("ros2",)
                )
            if devices.setdefault(name, device.name) != device.name:
                text = f'"{device.name}" and "{devices[name]}" have the same name in ROS 2, {name}; change one of them'
                yield Conflict(f"device[{i}].name", text, ("ros2",))
            if self.ros2.imu == "compensated" and not device.compensate:
                text = 'false, but ros2.imu is "compensated"; write ros2.imu = "raw", or remove this key'
                yield Conflict(f"device[{i}].compensate", text, ("ros2",))
