"""Command ``doctor``: checks a machine and a configuration for unattended operation.

Each check returns findings with advice and never raises an error. The checks briefly bind ports, connect to zenoh
routers, and create and remove an empty file in the storage folder. No device is opened, except UDP ports.
"""

import contextlib
import ctypes
import errno
import operator
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import urlsplit

from drivers import file_access
from drivers.errors import LinkUnavailable
from drivers.extras import find_missing_packages, install_command
from drivers.links import iio_link, udp_link
from drivers.links.can_link import describe_missing_package
from drivers.links.replay_link import ReplayLink
from drivers.number_ranges import DAY_S
from monitor.commands.check_configuration import check_configuration
from monitor.common.folder_lock import HISTORY_LOCK, RECORDING_LOCK, describe_lock_holder
from monitor.common.unit_formatting import format_count
from monitor.settings.file_permissions import contains_secret
from monitor.settings.loading import Config, Storage

Mark = Literal["well", "doubt", "wrong"]

SAMPLE_BYTES: Final = 35.0
"""Size in bytes of a sample with six axes, temperature and counter in a compressed recording.

High-resolution sensors need 32.5 to 33.3 bytes per sample. Coarse-resolution sensors need 17 to 23 bytes.
"""
RAW_BYTES: Final = 60.0
"""Approximate number of received bytes per sample. The number depends on the protocol."""
CONNECT_TIMEOUT_S: Final = 2.0
TIME_ERROR: Final = 5
"""Return value of adjtimex(2) if the clock is not synchronized."""
CAN_TYPE: Final = "280"
"""Content of /sys/class/net/NAME/type for a CAN interface (ARPHRD_CAN)."""
MAX_PORT: Final = 65535
UNIT: Final = "imu-monitor.service"
PACKAGE: Final = "imu-monitor"
PACKAGES: Final = ("monitor", "drivers")
"""Packages of the program. Other packages may have the same names, because these names are common."""
TCP_ENDPOINT: Final = re.compile(r"(?:tcp|tls)/\[?([^\]]+?)\]?:(\d+)(?:[?#].*)?")
"""Regular expression that matches the host and the port of a zenoh endpoint over TCP or TLS."""
REQUIREMENT: Final = re.compile(r"([A-Za-z0-9._-]+)\s*(?:\[[^\]]*\])?\s*\(?([^;)]*)\)?\s*(?:;(.*))?")
"""Regular expression that matches the name, versions and marker of a package requirement."""
LOOPBACK: Final = ("127.", "::1", "localhost")


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check of the machine or the configuration."""

    mark: Mark
    about: str
    text: str
    do: str = ""  # advice; empty if no action is needed


_well, _doubt, _wrong = partial(Finding, "well"), partial(Finding, "doubt"), partial(Finding, "wrong")


def examine_machine(config_path: Path | None = None) -> list[Finding]:
    """Check the machine, and the configuration file if a path is given."""
    machine = [
        *check_library_versions(),
        *_check_shadowed_packages(sys.path),
        _check_kernels(),
        check_clock(),
        *_check_systemd_unit(),
    ]
    if config_path is None:
        return machine
    config, mistakes = check_configuration(config_path, pipe=True)
    found = [_wrong("configuration", line) for line in mistakes]
    if config is not None:
        found.append(_well("configuration", f"{config_path}: {format_count(len(config.devices), 'device')}"))
    found += machine
    if config_path.is_file():
        found.append(_check_permissions(config_path))
    if config is not None:
        found += _check_configured(config)
    return found


def _check_configured(config: Config) -> Iterator[Finding]:
    for one in config.table["device"]:
        yield from _check_device(str(one["name"]), one["driver"])
    yield from _check_zenoh(config)
    yield from _check_viewer(config)
    yield from _check_storage(config)
    yield from _check_metrics(config)
    yield from _check_influx(config)
    yield from _check_ros2(config)
    yield from _check_reconcile(config)
    for hook in config.hooks:
        if hook.command:
            command = Path(hook.command[0])
            yield _check_permissions(command, f"hook {command.name}", secret=False)


def _check_permissions(path: Path, about: str = "permissions", secret: bool | None = None) -> Finding:
    """Check which users may write a file, and which users may read it if it is secret.

    By default, a file is secret if it contains a password.
    """
    try:
        seen = path.stat()
    except OSError as error:
        return _wrong(about, f"{path}: {error.strerror or error}")
    mode = stat.S_IMODE(seen.st_mode)
    if mode & stat.S_IWOTH:
        text = f"{path}: everyone can write it, and run commands as the user of the service"
        return _wrong(about, text, f"chmod o-w {path}")
    if seen.st_uid not in (0, os.geteuid()):
        text = f"{path}: belongs to another user ({_user(seen.st_uid)}), who can change what the service does"
        return _doubt(about, text, f"chown root {path}")
    if mode & stat.S_IWGRP:
        return _doubt(about, f"{path}: the group {_group(seen.st_gid)} can write it", f"chmod g-w {path}")
    if mode & stat.S_IROTH and (contains_secret(path) if secret is None else secret):
        return _wrong(about, f"{path}: everyone can read the password in it", f"chmod o-r {path}")
    return _well(about, f"{path}: {mode:04o}, owner {_user(seen.st_uid)}")


# --- devices


def _check_device(name: str, driver: Mapping[str, Any]) -> Iterator[Finding]:
    about = f"device {name}"
    match driver.get("link"):
        case "serial":
            yield _check_serial_port(about, str(driver.get("port")))
        case "can":
            interface, channel = str(driver.get("interface", "socketcan")), str(driver.get("channel", "can0"))
            yield check_can_interface(about, interface, channel)
        case "iio":
            yield check_iio_device(about, str(driver.get("device")), bool(driver.get("enable", False)))
        case "udp":
            yield _check_udp_port(about, {key: driver[key] for key in ("host", "port") if key in driver})
        case "zenoh":
            for endpoint in driver.get("connect", []):
                yield _check_reachable(about, str(endpoint))
        case other:
            yield _well(about, f"link {other}: nothing to check on this machine")


def _check_serial_port(about: str, port: str) -> Finding:
    if "://" in port:
        return _well(about, f"{port}: network port or pattern, not checked")
    path = Path(port)
    if not path.exists():
        there = sorted(str(one) for kind in ("ttyUSB*", "ttyACM*", "ttyAMA*") for one in Path("/dev").glob(kind))
        text = f"{port}: no such port; existing ports: {', '.join(there) or 'none'}"
        return _wrong(about, text, "plug it in, or choose another port; dmesg shows what was plugged in last")
    seen = path.stat()
    if not stat.S_ISCHR(seen.st_mode):
        return _wrong(about, f"{port}: not a serial port")
    if not os.access(path, os.R_OK | os.W_OK):
        user, group = _user(os.geteuid()), _group(seen.st_gid)
        text = f"{port}: {user} cannot read and write it; members of group {group} can"
        return _wrong(about, text, f"sudo usermod -aG {group} {user}, and log in again")
    if holders := ", ".join(_processes_using(path)):
        do = "if this is not the service itself, end it: only one program can read a port"
        return _doubt(about, f"{port}: in use by {holders}", do)
    return _well(about, f"{port}: exists, is readable, and no visible program uses it")


def _check_udp_port(about: str, keys: Mapping[str, Any]) -> Finding:
    """Check that a UDP port can be opened, by opening it briefly."""
    link = udp_link.build(udp_link.Settings(**keys))
    try:
        link.open()
    except LinkUnavailable as error:
        text = str(error)
        if isinstance(error.__cause__, OSError) and error.__cause__.errno == errno.EADDRINUSE:
            return _doubt(about, text, "if this is not the service itself, end it, or choose another port")
        return _wrong(about, text)
    link.close()
    return _well(about, f"{link.name}: free")


def _processes_using(port: Path) -> Iterator[str]:
    """Yield the programs that have opened a serial port. Only programs that the user may inspect are found."""
    wanted = str(port.resolve())
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process belongs to another user or has ended
            if process.name != str(os.getpid()) and wanted in map(os.readlink, (process / "fd").iterdir()):
                yield f"{(process / 'comm').read_text().strip()} (pid {process.name})"


def check_can_interface(subject: str, interface: str, channel: str, sysfs: Path = Path("/sys/class/net")) -> Finding:
    """Check that the package for a CAN interface is installed and that the SocketCAN interface is up.

    Parameters
    ----------
    subject : str
        Subject of the finding, shown before the result.
    interface : str
        Name of the python-can interface.
    channel : str
        Channel of the CAN interface.
    sysfs : Path, optional
        Folder in which the kernel lists the network interfaces.
    """
    if missing := describe_missing_package(interface):
        text, _, command = missing.partition(": ")
        return _wrong(subject, text, command)
    if interface != "socketcan":
        return _well(subject, f"{interface} {channel}: not checked")
    if not hasattr(socket, "AF_CAN"):
        return _wrong(subject, "this system has no socketcan", "use another interface of python-can")
    network = sysfs / channel
    up = f"sudo ip link set {channel} up type can bitrate 500000, with the bit rate of the bus"
    try:
        kind, flags = (network / "type").read_text().strip(), int((network / "flags").read_text(), 16)
    except OSError:
        types = [one for one in sysfs.glob("*/type") if os.access(one, os.R_OK) and one.read_text().strip() == CAN_TYPE]
        there = ", ".join(sorted(one.parent.name for one in types)) or "none"
        return _wrong(subject, f"{channel}: no such interface; existing CAN interfaces: {there}", up)
    if kind != CAN_TYPE:
        return _wrong(subject, f"{channel}: not a CAN interface", up)
    if not flags & 1:  # the flag IFF_UP is not set
        return _wrong(subject, f"{channel}: is down", up)
    return _well(subject, f"{channel}: is up")


def check_iio_device(subject: str, device: str, enable: bool, root: Path = iio_link.ROOT) -> Finding:
    """Check that an IIO device exists and that the user may read it and, if necessary, enable its buffer.

    Parameters
    ----------
    subject : str
        Subject of the finding, shown before the result.
    device : str
        Name or number of the device.
    enable : bool
        True if the link enables the buffer.
    root : Path, optional
        Folder that contains the folders ``sys`` and ``dev`` of the kernel.
    """
    try:
        folder, node = iio_link.find_device(device, root)
        enabled = folder / "buffer" / "enable"
        running = iio_link.read_attribute(enabled) == "1"
    except LinkUnavailable as error:
        return _wrong(subject, str(error), "load the driver of the sensor, or correct the key device")
    user, advice = _user(os.geteuid()), iio_link.PERMISSION_ADVICE
    if not os.access(node, os.R_OK):
        return _wrong(subject, f"{node}: does not exist, or {user} cannot read it", advice)
    if enable and not os.access(enabled, os.W_OK):
        return _wrong(subject, f"{enabled}: {user} cannot write it, as enable = true needs", advice)
    if not enable and not running:
        return _doubt(subject, f"{node}: its buffer is not enabled", "set enable = true, or let a program enable it")
    return _well(subject, f"{node}: exists, and {user} has the necessary permissions")


# --- outputs


def _check_zenoh(config: Config) -> Iterator[Finding]:
    own = config.zenoh
    if own.mode == "none":
        return
    if own.mode != "client":
        for endpoint in own.listen or ():
            yield check_port_free("zenoh", endpoint)
    for endpoint in own.connect:
        yield _check_reachable("zenoh", endpoint)
    if own.config is not None:
        yield _check_permissions(own.config, "zenoh file")
        return
    for endpoint in own.listen or ():
        address = TCP_ENDPOINT.fullmatch(endpoint)
        if address is not None and not address[1].startswith(LOOPBACK):
            text = f"{endpoint}: everyone who reaches this machine can read all data and send commands"
            yield _doubt("zenoh", text, "listen on 127.0.0.1, or use TLS and access control")


def _parse_endpoint(about: str, endpoint: str, failure: str) -> tuple[str, int] | Finding:
    """Return the host and the port of a TCP endpoint, or a finding if the endpoint cannot be checked."""
    match = TCP_ENDPOINT.fullmatch(endpoint)
    if match is None:
        return _well(about, f"{endpoint}: not checked, since only TCP endpoints can be checked")
    if int(match[2]) > MAX_PORT:
        return _wrong(about, f"{endpoint}: {failure}: the largest port is {MAX_PORT}")
    return match[1], int(match[2])


def check_port_free(subject: str, endpoint: str) -> Finding:
    """Check that a port is free by listening on it briefly.

    Parameters
    ----------
    subject : str
        Subject of the finding, shown before the result.
    endpoint : str
        Zenoh endpoint.
    """
    address = _parse_endpoint(subject, endpoint, "cannot listen")
    if isinstance(address, Finding):
        return address
    try:
        with socket.create_server(address, family=socket.AF_INET6 if ":" in address[0] else socket.AF_INET):
            return _well(subject, f"{endpoint}: free")
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            do = "no problem if it is this service; otherwise end it, or choose another port"
            return _doubt(subject, f"{endpoint}: another program listens there", do)
        return _wrong(subject, f"{endpoint}: cannot listen: {getattr(error, 'strerror', None) or error}")


def _check_reachable(about: str, endpoint: str) -> Finding:
    address = _parse_endpoint(about, endpoint, "no answer")
    if isinstance(address, Finding):
        return address
    try:
        with socket.create_connection(address, timeout=CONNECT_TIMEOUT_S):
            return _well(about, f"{endpoint}: answers")
    except (OSError, UnicodeError) as error:
        text = f"{endpoint}: no answer: {getattr(error, 'strerror', None) or error}"
        do = "start the program there, or check cables and firewalls; the service tries again"
        return _doubt(about, text, do)


def _check_viewer(config: Config) -> Iterator[Finding]:
    mode = config.viewer.mode
    if mode == "none":
        return
    if find_spec("rerun") is None:
        text = f'viewer.mode is "{mode}", but rerun-sdk is not installed: there will be no live view'
        yield _doubt("viewer", text, f'{install_command("imu-monitor[viewer]")}, or mode = "none"')
    else:
        yield _well("viewer", f"rerun-sdk is installed, mode {mode}")


def _check_metrics(config: Config) -> Iterator[Finding]:
    own = config.metrics
    if own is None:
        return
    if find_spec("prometheus_client") is None:
        text = "metrics.listen is set, but prometheus-client is not installed"
        yield _wrong("metrics", text, install_command("imu-monitor[metrics]"))
        return
    host = f"[{own.host}]" if ":" in own.host else own.host
    yield check_port_free("metrics", f"tcp/{host}:{own.port}")
    if not own.host.startswith(LOOPBACK):
        text = f"{own.host}: everyone who reaches this machine can read the metrics"
        yield _doubt("metrics", text, "listen on 127.0.0.1, and let a local collector forward them")


def _check_influx(config: Config) -> Iterator[Finding]:
    own = config.influx
    if own is None or own.url is None:
        return
    parts = urlsplit(own.url)
    host = str(parts.hostname)
    port = parts.port or (443 if parts.scheme == "https" else 80)
    yield _check_reachable("influx", f"tcp/[{host}]:{port}" if ":" in host else f"tcp/{host}:{port}")
    if own.token_file is not None:
        yield _check_permissions(own.token_file, "influx token", secret=True)
    if parts.scheme == "http" and not host.startswith(LOOPBACK):
        text = f"{host}: everyone on the network between can read the results and the token"
        yield _doubt("influx", text, "use https")


def _check_ros2(config: Config) -> Iterator[Finding]:
    for endpoint in config.ros2.connect if config.ros2 is not None else ():
        yield _check_reachable("ros2", endpoint)


def _check_reconcile(config: Config) -> Iterator[Finding]:
    """If a folder for reports is configured, check that the packages for the command ``reconcile`` are installed."""
    missing = " and ".join(find_missing_packages("reconcile"))
    if missing and any(one.reconcile_folder for one in config.devices):
        text = f"reconcile_folder is set, but {missing} is not installed: the service refuses command/reconcile"
        yield _doubt("reconcile", text, install_command("imu-monitor[reconcile]"))


def _check_storage(config: Config) -> Iterator[Finding]:
    own = config.storage
    if own is None:
        yield _doubt("storage", "nothing is stored: after a restart the window is empty", "set folder in [storage]")
        return
    if (own.record or own.raw) and find_spec("pyarrow") is None:
        text = "samples are to be recorded, but pyarrow is not installed"
        yield _wrong("storage", text, install_command("imu-monitor[arrow]"))
    folder = next(one for one in (own.folder, *own.folder.parents) if os.path.exists(one))
    try:
        file_access.check_folder_or_absent(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
        usage = shutil.disk_usage(folder)
    except OSError as error:
        text = f"{own.folder}: cannot be written: {error.strerror or error}"
        yield _wrong("storage", text, f"create it, owned by {_user(os.geteuid())}")
        return
    yield from _check_in_use(own)
    yield check_disk_space(own, recorded_bytes_per_day(config), usage.total, usage.free)


def _check_in_use(own: Storage) -> Iterator[Finding]:
    wanted = {RECORDING_LOCK: own.record or own.raw, HISTORY_LOCK: own.history}
    do = "no problem if it is this service; otherwise end it, or choose another folder: only one program records"
    for holder in sorted({describe_lock_holder(own.folder, name) for name, on in wanted.items() if on} - {""}):
        yield _doubt("storage", f"{own.folder}: in use by {holder}", do)


def recorded_bytes_per_day(config: Config) -> float | None:
    """Return the number of bytes recorded per day for all devices, or None if the sample rate of a device is unknown.

    Examples
    --------
    >>> import dataclasses
    >>> from monitor.common.shipped_config_paths import CONFIG_FOLDER
    >>> from monitor.settings.loading import load_config
    >>> one = load_config(CONFIG_FOLDER / "demo.toml")
    >>> kept = Storage(folder=Path("kept"))
    >>> recorded_bytes_per_day(dataclasses.replace(one, storage=kept)) == one.devices[0].rate_hz * DAY_S * SAMPLE_BYTES
    True
    """
    own = config.storage
    if own is None:
        return 0.0
    each = SAMPLE_BYTES * own.record + RAW_BYTES * own.raw
    rates = [one.rate_hz for one in config.devices if not isinstance(one.link, ReplayLink)]  # replays are not recorded
    known = [rate for rate in rates if rate is not None]
    return None if len(known) < len(rates) else sum(known) * DAY_S * each


def check_disk_space(storage: Storage, bytes_per_day: float | None, total_bytes: int, free_bytes: int) -> Finding:
    """Check that the disk has enough space for the recordings.

    Parameters
    ----------
    storage : Storage
        Storage settings.
    bytes_per_day : float or None
        Number of bytes that are recorded per day; None if unknown.
    total_bytes : int
        Capacity of the disk in bytes.
    free_bytes : int
        Free space on the disk in bytes.
    """
    allowed = free_bytes - (1.0 - storage.disk_share) * total_bytes
    if bytes_per_day is None:
        text = (
            f"{storage.folder}: {_gb(free_bytes)} free; disk use per day unknown, since a device has no configured rate"
        )
        return _doubt("storage", text, "add rate to every device")
    wanted = bytes_per_day * storage.keep_s / DAY_S
    days = max(allowed, 0.0) / bytes_per_day if bytes_per_day else float("inf")
    text = (
        f"{storage.folder}: {_gb(free_bytes)} free, about {_gb(bytes_per_day)} per day, "
        f"{_gb(wanted)} for the whole time of keep"
    )
    if allowed <= 0.0 or days < 1.0:
        do = "free disk space, or record on another disk"
        return _wrong("storage", f"{text}: not enough for one day below disk_share", do)
    if wanted > allowed:
        do = "a larger disk, or a shorter keep"
        return _doubt("storage", f"{text}: the oldest data will be deleted after about {days:.0f} days", do)
    return _well("storage", text)


# --- machine


def check_library_versions() -> list[Finding]:
    """Check whether each installed library has a version that the program supports."""
    about, wrong, count = "libraries", [], 0
    for name, versions, optional in library_requirements():
        install = install_command(f"{name}{versions}")
        try:
            there = metadata.version(name)
        except metadata.PackageNotFoundError:
            if not optional:
                wrong.append(_wrong(about, f"{name} is missing", install))
            continue
        count += 1
        if not version_satisfies(there, versions):
            wrong.append(_wrong(about, f"{name} {there} is installed, {versions} is required", install))
    if not wrong and not count:
        text = "the required versions are unknown, because the package imu-monitor is not installed"
        return [_doubt(about, text)]
    return wrong or [_well(about, f"Python {sys.version.split()[0]}, {count} libraries with the required versions")]


def library_requirements() -> Iterator[tuple[str, str, bool]]:
    """Yield the name and the required versions of each library, and whether it is optional.

    Test libraries are omitted.
    """
    try:
        lines = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return
    for line in lines:
        match = REQUIREMENT.fullmatch(line.strip())
        if match is None or match[1] == PACKAGE:
            continue
        extra = re.search(r"extra\s*==\s*['\"](\w+)['\"]", match[3] or "")
        if extra is None or extra[1] not in ("test", "all"):
            yield match[1], match[2].replace(" ", ""), extra is not None


def version_satisfies(version: str, bounds: str) -> bool:
    """Return True if a version satisfies bounds such as ``>=0.41,<0.42``. Other kinds of bounds are ignored.

    Parameters
    ----------
    version : str
        Version of the installed library.
    bounds : str
        Version bounds, separated by commas.

    Examples
    --------
    >>> version_satisfies("0.41.2", ">=0.41,<0.42"), version_satisfies("0.42.0", ">=0.41,<0.42")
    (True, False)
    """
    compare = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt, "==": operator.eq}
    pairs = re.findall(r"(>=|<=|==|>|<)\s*([\d.]+)", bounds)
    return all(compare[sign](_numbers(version), _numbers(bound)) for sign, bound in pairs)


def _check_shadowed_packages(module_path: Sequence[str]) -> list[Finding]:
    """Check that no other module on the import path shadows a package of the program."""
    own = Path(__file__).resolve().parents[2]
    found = []
    for entry in module_path:
        folder = Path(entry or os.curdir).resolve()
        if folder == own:
            break
        for name in PACKAGES:
            # A folder without __init__.py is a namespace package. Python prefers a regular package on a later path.
            places = (folder / name / "__init__.py", folder / f"{name}.py")
            foreign = next((one for one in places if one.is_file()), None)
            if foreign is not None:
                text = (
                    f"{foreign}: is found before the program's own package {name}; imu-monitor uses its own, a script "
                    f"that imports {name} does not"
                )
                found.append(_doubt("packages", text, f"remove {folder} from PYTHONPATH for such scripts"))
    return found or [_well("packages", f"{' and '.join(PACKAGES)} are the program's own, in {own}")]


def _check_kernels() -> Finding:
    from monitor.common.compiled import kernel_cache_folder
    from monitor.daemon.kernels.kernel_compilation import is_warm
    from monitor.daemon.kernels.kernel_groups import SERVICE

    folder = kernel_cache_folder()
    if folder is None:
        text = "no folder for compiled kernels is writable: every start compiles them again, for one or two minutes"
        return _doubt("kernels", text, "set NUMBA_CACHE_DIR to a folder of the service's user")
    if not is_warm(SERVICE):
        text = f"not compiled for this version on this machine, in {folder}: the next start takes longer"
        return _doubt("kernels", text, "run imu-monitor warm-up as the user of the service")
    return _well("kernels", f"compiled, in {folder}")


def check_clock() -> Finding:
    """Check that the system clock is synchronized, because the results contain system times."""
    state = _adjtimex()
    if state is None:
        return _doubt("clock", "the system does not report whether it is synchronised")
    if state == TIME_ERROR:
        text = "not synchronised: the times of results and recordings will drift, or jump when it is set"
        return _doubt("clock", text, "timedatectl set-ntp true, or install chrony")
    return _well("clock", "synchronised")


def _check_systemd_unit() -> list[Finding]:
    if shutil.which("systemctl") is None or not Path("/run/systemd/system").is_dir():
        return []
    command = ["systemctl", "show", UNIT, "--property=LoadState,ActiveState,SubState,NRestarts,UnitFileState"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return [_doubt("systemd", f"the state is unknown: {error}")]
    return check_systemd_unit_state(dict(line.split("=", 1) for line in said.splitlines() if "=" in line))


def check_systemd_unit_state(unit_properties: Mapping[str, str]) -> list[Finding]:
    """Return the findings about the properties that ``systemctl show`` prints. The list is empty if there is no unit.

    Examples
    --------
    >>> check_systemd_unit_state({"LoadState": "not-found"})
    []
    """
    if unit_properties.get("LoadState") != "loaded":
        return []
    state, restarts = unit_properties.get("ActiveState", ""), unit_properties.get("NRestarts", "0")
    enabled = unit_properties.get("UnitFileState", "")
    text = f"{UNIT}: {state} ({unit_properties.get('SubState', '')}), {restarts} restarts, {enabled}"
    if state == "failed":
        return [_wrong("systemd", text, f"journalctl -u {UNIT} -e shows the reason")]
    if state != "active" or restarts != "0":
        return [_doubt("systemd", text, f"journalctl -u {UNIT} -e; systemctl enable --now {UNIT}")]
    if enabled != "enabled":
        return [_doubt("systemd", text, f"systemctl enable {UNIT}; otherwise it does not start with the machine")]
    return [_well("systemd", text)]


# --- shared functions


def _adjtimex() -> int | None:
    try:
        library = ctypes.CDLL(None, use_errno=True)
        question = ctypes.create_string_buffer(512)  # modes = 0 only reads the clock
        state = int(library.adjtimex(question))
    except (OSError, AttributeError, TypeError):
        return None
    return state if state >= 0 else None


def _numbers(version: str) -> tuple[int, ...]:
    """Return the first four numbers of a version. Missing numbers are 0."""
    numbers = [int(part) for part in re.split(r"[^\d.]", version)[0].split(".") if part]
    return (*numbers, 0, 0, 0, 0)[:4]


def _gb(amount: float) -> str:
    return f"{amount / 1e9:.3g} GB"


def _user(uid: int) -> str:
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _group(gid: int) -> str:
    import grp

    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def worst_mark(findings: Iterable[Finding]) -> Mark:
    """Return the most severe mark among all findings."""
    marks = {one.mark for one in findings}
    return "wrong" if "wrong" in marks else "doubt" if "doubt" in marks else "well"
