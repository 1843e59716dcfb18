"""The tables of a configuration file: which keys there are, of what kind, and what holds where one is absent.

What a value means, and whether values fit each other, is for ``settings`` to say. Links and decoders bring tables of
their own.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from drivers import quantities
from drivers.links.base import LinkSettings
from monitor.common.topics import ENDPOINT

Coefficient = Annotated[float, quantities.COEFFICIENT.meta]
Duration = Annotated[float, quantities.DURATION_S.meta]
Port = Annotated[int, quantities.PORT.meta]
Share = Annotated[float, quantities.FRACTION.meta]
ZenohKey = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[^/*$?#]+(/[^/*$?#]+)*$",
        description='a zenoh key such as "site/alarms", without * $ ? # and with text between slashes',
    ),
]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of the file."""


class DeviceTable(_Table, frozen=True, kw_only=True):
    """``[[device]]``."""

    name: str
    driver: dict[str, Any]
    rate: Annotated[float, quantities.RATE_HZ.meta] | None = None
    window: Duration | str = 3600.0
    tau: Literal["octave", "decade10"] | list[Annotated[float, quantities.AVERAGING_TIME_S.meta]] = "octave"
    refit: str = "10 Hz"
    publish: str = "10 Hz"
    motion: Literal["tell", "leave out"] = "tell"
    alarms_per_day: Annotated[float, quantities.ALARMS_PER_DAY.meta] = 0.033
    """False alarms of changed noise to bear; 0 = do not look."""
    restart: bool = True
    model: str | None = None
    """The model in force: path of a model file, or the name of one in the shipped ``config/models``."""
    compensate: bool = True
    """Take the gyros' drift out of a copy of the samples."""
    thermal_interval: Duration | str = "10min"
    """Of the means that are held against temperature; "off": they are not."""
    reconcile_folder: Path | None = None
    """Where the reports of ``command/reconcile`` are kept; None: they are not."""
    axes: dict[str, str] = {}
    limit: list[dict[str, Any]] = []


class LimitTable(_Table, frozen=True, kw_only=True):
    """``[[device.limit]]``: what a coefficient must not pass; one of the three bounds at least."""

    axes: str
    letter: Literal["Q", "N", "B", "K", "R"]
    above: Coefficient | None = None
    """SI unit of letter and axis, as in a model file."""
    below: Coefficient | None = None
    times_model: Annotated[float, quantities.NOISE_RATIO.meta] | None = None
    """Too much is so many times what the model in force says."""
    hold: Duration | str = "1min"
    """It has to be beyond, or back, for so long."""


class FaultsTable(_Table, frozen=True, kw_only=True):
    """``[device.driver.faults]``: what goes wrong on the way from a simulated sensor, all of it drawn from its seed."""

    lost: Share = 0.0
    """Share of samples that are never sent; their count goes on."""
    repeated: Share = 0.0
    """Share of samples that are sent twice."""
    flipped: Share = 0.0
    """Share of samples one bit of which is flipped."""
    cut: Share = 0.0
    """Share of samples whose frame ends before it is whole."""
    jitter: Annotated[float, quantities.JITTER_S.meta] = 0.0
    """s: each burst is held back by a random time of up to so much."""
    unplugged: Share = 0.0
    """Chance at each sample that the cable is pulled before it."""
    unplugged_for: Duration = 2.0
    """s of the sensor's time until it is put back."""
    clock: Annotated[float, quantities.CLOCK_RATIO.meta] = 1.0
    """True rate over the rate that the sensor's clock and settings claim."""


class VirtualTable(LinkSettings, frozen=True, kw_only=True):
    """Keys of ``link = "virtual"``: a simulated IMU that speaks a real wire format over a real link.

    The decoder says which: a stream of bytes over a pseudo-terminal, CAN frames over a bus of python-can in this
    process, messages over zenoh on loopback.
    """

    model: str = "consumer-mems"
    """Path of a model file, or the name of one in the shipped ``config/models``."""
    seed: Annotated[int, quantities.SEED.meta] = 1
    speed: Annotated[float, quantities.SIMULATION_SPEED.meta] = 1.0
    """Times real time."""
    effect: tuple[str, ...] = ()
    """Effects that the sensor takes on while it runs: "gz.sinusoidal:amplitude=1e-3,frequency=17"."""
    effect_at: Annotated[float, quantities.DELAY_S.meta] = 90.0
    """s of the sensor's time; by then changes are looked for."""
    faults: FaultsTable = FaultsTable()


class ZenohTable(_Table, frozen=True, kw_only=True):
    """``[zenoh]``."""

    mode: Literal["peer", "client", "router", "none"] | None = "peer"
    listen: tuple[str, ...] | None = (ENDPOINT,)
    """These two are None where a zenoh file is named and they are not given beside it: then the file's hold."""
    connect: tuple[str, ...] = ()
    config: Path | None = None
    prefix: ZenohKey = "imu"


class ViewerTable(_Table, frozen=True, kw_only=True):
    """``[viewer]``."""

    mode: str = "auto"
    port: Port = 9876
    web_port: Port = 9090
    memory: str = "256MiB"
    history: Duration | str | None = None
    """Of what is kept, shown when the view opens; None: nothing."""


class StorageTable(_Table, frozen=True, kw_only=True):
    """``[storage]``: what is kept on disk; without a folder nothing is."""

    folder: Path | None = None
    record: bool = True
    """Samples as received and decoded, in segments."""
    raw: bool = False
    """The bytes as they came too, so that a decoder's fault can be replayed."""
    segment: Duration | str = "1h"
    keep: Duration | str = "30d"
    """Segments older than this are deleted."""
    disk_share: Annotated[float, quantities.POSITIVE_SHARE.meta] = 0.9
    """The oldest segments are deleted while more than this share of the disk is taken."""
    history: bool = True
    """Results, events and status, thinned with age."""


class HookTable(_Table, frozen=True, kw_only=True):
    """``[[hook]]``: what an event sets off, a command or a message."""

    on: list[str]
    """Kinds of events; "*" is every one."""
    devices: list[str] = []
    """Names; none: all."""
    command: list[str] = []
    """A program's path and its arguments, never a shell's line; the event comes as JSON on standard input."""
    key: ZenohKey | None = None
    """Of zenoh, where the event is put as JSON."""
    timeout: Duration | str = "30s"
    """After which the command is killed, with all that it started."""


class MetricsTable(_Table, frozen=True, kw_only=True):
    """``[metrics]``: numbers for Prometheus."""

    listen: str | None = None
    """Host and port; None: nothing listens."""


class LogTable(_Table, frozen=True, kw_only=True):
    """``[log]``."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: Literal["text", "json"] = "text"


class FileTable(_Table, frozen=True, kw_only=True):
    """The whole file."""

    device: list[dict[str, Any]] = []
    zenoh: dict[str, Any] = {}
    viewer: dict[str, Any] = {}
    storage: dict[str, Any] = {}
    hook: list[dict[str, Any]] = []
    metrics: dict[str, Any] = {}
    log: dict[str, Any] = {}
