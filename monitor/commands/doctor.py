"""Command ``doctor``: checks a machine and a configuration for unattended operation, and returns findings with advice.

Each check returns findings and raises no error. If a check cannot determine a state, the finding says so. No device is
opened. The checks have three side effects: a port is bound for a moment, a connection to a router is opened and closed,
and an empty file is created in the storage folder and removed.

The disk use per day, in bytes, is rate · 86400 · SAMPLE_BYTES for each recorded device. Raw bytes add RAW_BYTES for
each sample. SAMPLE_BYTES is the size of a sample in a packed segment with six axes, temperature and counter, if the
noise uses all digits of a 32-bit float. Sensors with a coarser resolution need less. The history of results is
comparatively small and is not counted.
"""

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
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal

from drivers import file_access
from drivers.extras import find_missing_packages
from drivers.links.can_link import describe_missing_package
from drivers.links.replay_link import ReplayLink
from drivers.number_ranges import DAY_S
from monitor.commands.check_config import check_configuration
from monitor.common.folder_lock import HISTORY_LOCK, RECORDING_LOCK, lock_holder
from monitor.settings.file_permissions import contains_secret
from monitor.settings.loading import Config, Storage

Mark = Literal["well", "doubt", "wrong"]

SAMPLE_BYTES: Final = 35.0
"""Size of a sample in a packed segment.

Sensors that use all digits of a float need 32.5 to 33.3 bytes, and sensors with a coarse resolution 17 to 23 bytes.
"""
RAW_BYTES: Final = 60.0
"""Approximate size of the received frame of a sample. It depends on the protocol."""
CONNECT_TIMEOUT_S: Final = 2.0
"""Longest wait for a connection."""
TIME_ERROR: Final = 5
"""Return value of adjtimex(2) if the clock is not synchronised."""
CAN_TYPE: Final = "280"
"""ARPHRD_CAN, in /sys/class/net/NAME/type."""
MAX_PORT: Final = 65535
"""Largest port number."""
UNIT: Final = "imu-monitor.service"
"""Name of the systemd unit."""
PACKAGE: Final = "imu-monitor"
"""Name of the distribution package."""
PACKAGES: Final = ("monitor", "drivers")
"""Import packages of the program. The names are common, so other packages may have the same names."""
TCP_ENDPOINT: Final = re.compile(r"(?:tcp|tls)/\[?([^\]]+?)\]?:(\d+)(?:[?#].*)?")
"""Regular expression for the host and the port of a zenoh endpoint over TCP or TLS."""
REQUIREMENT: Final = re.compile(r"([A-Za-z0-9._-]+)\s*(?:\[[^\]]*\])?\s*\(?([^;)]*)\)?\s*(?:;(.*))?")
"""Regular expression for the requirement of a package: name, versions and marker."""
LOOPBACK: Final = ("127.", "::1", "localhost")
"""Beginnings of loopback addresses."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check."""

    mark: Mark
    about: str
    text: str
    do: str = ""  # advice; empty if nothing is to be done


def examine(path: Path | None = None) -> list[Finding]:
    """Check the machine, and the configuration if a path is given."""
    found = [
        *check_library_versions(),
        *check_shadowed_packages(sys.path),
        *_check_kernels(),
        *check_clock(),
        *_check_systemd_unit(),
    ]
    if path is None:
        return found
    config, wrong = read_configuration(path)
    found = [*wrong, *found]
    if path.is_file():
        found += _check_permissions(path)
    if config is None:
        return found
    for one in config.table["device"]:
        found += _check_device(str(one["name"]), one["driver"])
    found += [
        *_check_zenoh(config),
        *_check_viewer(config),
        *_check_storage(config),
        *_check_metrics(config),
        *_check_reconcile(config),
    ]
    for hook in config.hooks:
        if hook.command:
            found += _check_permissions(Path(hook.command[0]), f"hook {Path(hook.command[0]).name}", secret=False)
    return found


# --- the configuration


def read_configuration(path: Path) -> tuple[Config | None, list[Finding]]:
    """Read and check the configuration; return it, or None if it has a mistake, and the findings."""
    config, wrong = check_configuration(path, pipe=True)
    if config is None:
        return None, [Finding("wrong", "configuration", line) for line in wrong]
    count = len(config.devices)
    return config, [Finding("well", "configuration", f"{path}: {count} device{'' if count == 1 else 's'}")]


def _check_permissions(path: Path, about: str = "permissions", secret: bool = True) -> list[Finding]:
    """Check who may write a file that controls the service, and who may read a file that may contain a password."""
    try:
        seen = path.stat()
    except OSError as error:
        return [Finding("wrong", about, f"{path}: {error.strerror or error}")]
    mode = stat.S_IMODE(seen.st_mode)
    if mode & stat.S_IWOTH:
        text = f"{path}: everyone can write it, and run commands as the user of the service"
        return [Finding("wrong", about, text, f"chmod o-w {path}")]
    if seen.st_uid not in (0, os.geteuid()):
        text = f"{path}: belongs to another user ({_user(seen.st_uid)}), who can change what the service does"
        return [Finding("doubt", about, text, f"chown root {path}")]
    if mode & stat.S_IWGRP:
        text = f"{path}: the group {_group(seen.st_gid)} can write it"
        return [Finding("doubt", about, text, f"chmod g-w {path}")]
    if secret and mode & stat.S_IROTH and contains_secret(path):
        text = f"{path}: everyone can read the password in it"
        return [Finding("wrong", about, text, f"chmod o-r {path}")]
    return [Finding("well", about, f"{path}: {mode:04o}, owner {_user(seen.st_uid)}")]


# --- devices


def _check_device(name: str, driver: Mapping[str, Any]) -> list[Finding]:
    """Check the link of a device without opening it."""
    about = f"device {name}"
    match driver.get("link"):
        case "serial":
            return _check_serial_port(about, str(driver.get("port")))
        case "can":
            return check_can_interface(
                about, str(driver.get("interface", "socketcan")), str(driver.get("channel", "can0"))
            )
        case "zenoh":
            endpoints = driver.get("connect", [])
            return [one for endpoint in endpoints for one in _reachable(about, str(endpoint))]
        case other:
            return [Finding("well", about, f"link {other}: nothing to check on this machine")]


def _check_serial_port(about: str, port: str) -> list[Finding]:
    """Check that a serial port exists, is accessible and is not used by another program."""
    if "://" in port:
        return [Finding("well", about, f"{port}: network port or pattern, not checked")]
    path = Path(port)
    if not path.exists():
        there = sorted(str(one) for kind in ("ttyUSB*", "ttyACM*", "ttyAMA*") for one in Path("/dev").glob(kind))
        text = f"{port}: no such port; existing ports: {', '.join(there) or 'none'}"
        return [
            Finding("wrong", about, text, "plug it in, or choose another port; dmesg shows what was plugged in last")
        ]
    seen = path.stat()
    if not stat.S_ISCHR(seen.st_mode):
        return [Finding("wrong", about, f"{port}: not a serial port")]
    if not os.access(path, os.R_OK | os.W_OK):
        group = _group(seen.st_gid)
        text = f"{port}: {_user(os.geteuid())} cannot read and write it; members of group {group} can"
        return [Finding("wrong", about, text, f"sudo usermod -aG {group} {_user(os.geteuid())}, and log in again")]
    holders = list(_processes_using(path))
    if holders:
        text = f"{port}: in use by {', '.join(holders)}"
        return [
            Finding("doubt", about, text, "if this is not the service itself, end it: only one program can read a port")
        ]
    return [Finding("well", about, f"{port}: exists, is readable, and no visible program uses it")]


def _processes_using(port: Path) -> Iterator[str]:
    """Yield the programs that have a port open, as far as this user can see them."""
    wanted = port.resolve()
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == str(os.getpid()):
            continue
        try:
            open_files = {os.readlink(one) for one in (process / "fd").iterdir()}
            if str(wanted) in open_files:
                yield f"{(process / 'comm').read_text().strip()} (pid {process.name})"
        except OSError:  # the process belongs to another user, or has ended
            continue


def check_can_interface(
    about: str, interface: str, channel: str, sysfs: Path = Path("/sys/class/net")
) -> list[Finding]:
    """Check that the package for a CAN interface is installed, and that a socketcan interface exists and is up.

    Parameters
    ----------
    about : str
        Subject of the finding.
    interface : str
        Interface of python-can.
    channel : str
        Channel of the interface.
    sysfs : Path, optional
        Folder with the network interfaces of the kernel.
    """
    if missing := describe_missing_package(interface):
        text, _, command = missing.partition(": ")
        return [Finding("wrong", about, text, command)]
    if interface != "socketcan":
        return [Finding("well", about, f"{interface} {channel}: not checked")]
    if not hasattr(socket, "AF_CAN"):
        return [Finding("wrong", about, "this system has no socketcan", "use another interface of python-can")]
    network = sysfs / channel
    up = f"sudo ip link set {channel} up type can bitrate 500000, with the bit rate of the bus"
    try:
        kind, flags = (network / "type").read_text().strip(), int((network / "flags").read_text(), 16)
    except OSError:
        types = [one for one in sysfs.glob("*/type") if os.access(one, os.R_OK) and one.read_text().strip() == CAN_TYPE]
        there = ", ".join(sorted(one.parent.name for one in types)) or "none"
        return [Finding("wrong", about, f"{channel}: no such interface; existing CAN interfaces: {there}", up)]
    if kind != CAN_TYPE:
        return [Finding("wrong", about, f"{channel}: not a CAN interface", up)]
    if not flags & 1:  # IFF_UP
        return [Finding("wrong", about, f"{channel}: is down", up)]
    return [Finding("well", about, f"{channel}: is up")]


# --- outputs


def _check_zenoh(config: Config) -> list[Finding]:
    """Check the ports to listen on, the routers to connect to, and the zenoh configuration file."""
    own = config.zenoh
    if own.mode == "none":
        return []
    found = [one for endpoint in own.listen or () if own.mode != "client" for one in check_port_free("zenoh", endpoint)]
    found += [one for endpoint in own.connect for one in _reachable("zenoh", endpoint)]
    for endpoint in own.listen or ():
        host = _host(endpoint)
        if host and not host.startswith(LOOPBACK) and own.config is None:
            text = f"{endpoint}: everyone who reaches this machine can read all data and send commands"
            found.append(Finding("doubt", "zenoh", text, "listen on 127.0.0.1, or use TLS and access control"))
    if own.config is not None:
        found += _check_permissions(own.config, "zenoh file")
    return found


def check_port_free(about: str, endpoint: str) -> list[Finding]:
    """Check that a port is free, by listening on the port for a moment.

    Parameters
    ----------
    about : str
        Subject of the finding.
    endpoint : str
        Zenoh endpoint.
    """
    match = TCP_ENDPOINT.fullmatch(endpoint)
    if match is None:
        return [Finding("well", about, f"{endpoint}: not checked, since only TCP ports can be checked")]
    if int(match[2]) > MAX_PORT:
        return [Finding("wrong", about, f"{endpoint}: cannot listen: the largest port is {MAX_PORT}")]
    try:
        family = socket.AF_INET6 if ":" in match[1] else socket.AF_INET
        with socket.create_server((match[1], int(match[2])), family=family):
            return [Finding("well", about, f"{endpoint}: free")]
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            text = f"{endpoint}: another program listens there"
            return [
                Finding(
                    "doubt", about, text, "no problem if it is this service; otherwise end it, or choose another port"
                )
            ]
        why = getattr(error, "strerror", None) or error
        return [Finding("wrong", about, f"{endpoint}: cannot listen: {why}")]


def _reachable(about: str, endpoint: str) -> list[Finding]:
    """Check that a connection to an endpoint can be opened."""
    match = TCP_ENDPOINT.fullmatch(endpoint)
    if match is None:
        return [Finding("well", about, f"{endpoint}: not checked, since only TCP endpoints can be checked")]
    if int(match[2]) > MAX_PORT:
        return [Finding("wrong", about, f"{endpoint}: no answer: the largest port is {MAX_PORT}")]
    try:
        with socket.create_connection((match[1], int(match[2])), timeout=CONNECT_TIMEOUT_S):
            return [Finding("well", about, f"{endpoint}: answers")]
    except (OSError, UnicodeError) as error:
        text = f"{endpoint}: no answer: {getattr(error, 'strerror', None) or error}"
        return [
            Finding(
                "doubt", about, text, "start the program there, or check cables and firewalls; the service tries again"
            )
        ]


def _check_viewer(config: Config) -> list[Finding]:
    """Check that the viewer is installed, if the configuration uses it."""
    if config.viewer.mode == "none":
        return []
    if find_spec("rerun") is None:
        text = f'viewer.mode is "{config.viewer.mode}", but rerun-sdk is not installed: there will be no live view'
        return [Finding("doubt", "viewer", text, 'pip install "imu-monitor[viewer]", or mode = "none"')]
    return [Finding("well", "viewer", f"rerun-sdk is installed, mode {config.viewer.mode}")]


def _check_metrics(config: Config) -> list[Finding]:
    """Check the library and the port for Prometheus, and who can reach the port."""
    own = config.metrics
    if own is None:
        return []
    if find_spec("prometheus_client") is None:
        text = "metrics.listen is set, but prometheus-client is not installed"
        return [Finding("wrong", "metrics", text, 'pip install "imu-monitor[metrics]"')]
    host = f"[{own.host}]" if ":" in own.host else own.host
    found = check_port_free("metrics", f"tcp/{host}:{own.port}")
    if not own.host.startswith(LOOPBACK):
        text = f"{own.host}: everyone who reaches this machine can read the metrics"
        found.append(Finding("doubt", "metrics", text, "listen on 127.0.0.1, and let a local collector forward them"))
    return found


def _check_reconcile(config: Config) -> list[Finding]:
    """Check that ``command/reconcile`` can be answered, if a folder is configured for its reports."""
    missing = find_missing_packages("reconcile")
    if not missing or not any(one.reconcile_folder for one in config.devices):
        return []
    text = (
        f"reconcile_folder is set, but {' and '.join(missing)} is not installed: the service refuses command/reconcile"
    )
    return [Finding("doubt", "reconcile", text, 'pip install "imu-monitor[reconcile]"')]


def _check_storage(config: Config) -> list[Finding]:
    """Check the library for recordings, the storage folder and the free disk space."""
    own = config.storage
    if own is None:
        return [
            Finding(
                "doubt", "storage", "nothing is kept: after a restart the window is empty", "set folder in [storage]"
            )
        ]
    found = []
    if (own.record or own.raw) and find_spec("pyarrow") is None:
        text = "samples are to be recorded, but pyarrow is not installed"
        found.append(Finding("wrong", "storage", text, 'pip install "imu-monitor[arrow]"'))
    folder = next(one for one in (own.folder, *own.folder.parents) if os.path.exists(one))
    try:
        file_access.check_folder_or_absent(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
        usage = shutil.disk_usage(folder)
    except OSError as error:
        text = f"{own.folder}: cannot be written: {error.strerror or error}"
        return [*found, Finding("wrong", "storage", text, f"create it, owned by {_user(os.geteuid())}")]
    found += _check_in_use(own)
    return [*found, *check_disk_space(own, recorded_bytes_per_day(config), usage.total, usage.free)]


def _check_in_use(own: Storage) -> list[Finding]:
    """Check whether another process records into the storage folder or writes its history there."""
    wanted = {RECORDING_LOCK: own.record or own.raw, HISTORY_LOCK: own.history}
    holders = sorted({held for name, on in wanted.items() if on and (held := lock_holder(own.folder, name))})
    do = "no problem if it is this service; otherwise end it, or choose another folder: only one program records"
    return [Finding("doubt", "storage", f"{own.folder}: in use by {one}", do) for one in holders]


def recorded_bytes_per_day(config: Config) -> float | None:
    """Return the disk use of all devices per day in bytes; None if the rate of a device is not configured.

    Examples
    --------
    >>> import dataclasses
    >>> from monitor.common.shipped_file_paths import CONFIG_FOLDER
    >>> from monitor.settings.loading import load
    >>> one = load(CONFIG_FOLDER / "demo.toml")
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


def check_disk_space(own: Storage, a_day: float | None, total: int, available: int) -> list[Finding]:
    """Check that the disk has enough space for the data to be kept.

    Parameters
    ----------
    own : Storage
        Settings of the storage.
    a_day : float or None
        Disk use per day in bytes; None if unknown.
    total : int
        Size of the disk in bytes.
    available : int
        Free space of the disk in bytes.
    """
    allowed = available - (1.0 - own.disk_share) * total
    if a_day is None:
        text = f"{own.folder}: {_gb(available)} free; disk use per day unknown, since a device has no configured rate"
        return [Finding("doubt", "storage", text, "add rate to every device")]
    wanted, days = a_day * own.keep_s / DAY_S, max(allowed, 0.0) / a_day if a_day else float("inf")
    text = f"{own.folder}: {_gb(available)} free, about {_gb(a_day)} per day, {_gb(wanted)} for the whole time of keep"
    if allowed <= 0.0 or days < 1.0:
        do = "free disk space, or record on another disk"
        return [Finding("wrong", "storage", f"{text}: not enough for one day below disk_share", do)]
    if wanted > allowed:
        do = "a larger disk, or a shorter keep"
        return [Finding("doubt", "storage", f"{text}: the oldest data will be deleted after about {days:.0f} days", do)]
    return [Finding("well", "storage", text)]


# --- the machine


def check_library_versions() -> list[Finding]:
    """Check the version of each library against the requirements of this program."""
    wanted = list(required_libraries())
    if not wanted:
        return [
            Finding(
                "doubt",
                "libraries",
                "the required versions are unknown, because the package imu-monitor is not installed",
            )
        ]
    wrong, count = [], 0
    for name, versions, optional in wanted:
        try:
            there = metadata.version(name)
        except metadata.PackageNotFoundError:
            if not optional:
                wrong.append(Finding("wrong", "libraries", f"{name} is missing", f'pip install "{name}{versions}"'))
            continue
        count += 1
        if not version_satisfies(there, versions):
            text = f"{name} {there} is installed, {versions} is required"
            wrong.append(Finding("wrong", "libraries", text, f'pip install "{name}{versions}"'))
    return wrong or [
        Finding("well", "libraries", f"Python {sys.version.split()[0]}, {count} libraries with the required versions")
    ]


def required_libraries() -> Iterator[tuple[str, str, bool]]:
    """Yield the name, the versions and True if it is optional, for every library that is not only for tests."""
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


def version_satisfies(version: str, wanted: str) -> bool:
    """Return True if a version is within bounds like ``>=0.41,<0.42``. Bounds of another kind are ignored.

    Parameters
    ----------
    version : str
        Version of the installed library.
    wanted : str
        Bounds, separated by commas.

    Examples
    --------
    >>> version_satisfies("0.41.2", ">=0.41,<0.42"), version_satisfies("0.42.0", ">=0.41,<0.42")
    (True, False)
    """
    compare = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt, "==": operator.eq}
    bounds = re.findall(r"(>=|<=|==|>|<)\s*([\d.]+)", wanted)
    return all(compare[sign](_numbers(version), _numbers(bound)) for sign, bound in bounds)


def check_shadowed_packages(module_path: Sequence[str]) -> list[Finding]:
    """Report foreign modules that Python would import in place of the packages of the program.

    Parameters
    ----------
    module_path : sequence of str
        Folders in the order in which Python searches them, as ``sys.path``.
    """
    own = Path(__file__).resolve().parents[2]
    found = []
    for entry in module_path:
        folder = Path(entry or os.curdir).resolve()
        if folder == own:
            break
        for name in PACKAGES:
            # a folder without __init__.py is a namespace package, and Python prefers a regular package on a later path
            places = (folder / name / "__init__.py", folder / f"{name}.py")
            foreign = next((one for one in places if one.is_file()), None)
            if foreign is not None:
                text = (
                    f"{foreign}: is found before the program's own package {name}; imu-monitor uses its own, a script "
                    f"that imports {name} does not"
                )
                found.append(Finding("doubt", "packages", text, f"remove {folder} from PYTHONPATH for such scripts"))
    return found or [Finding("well", "packages", f"{' and '.join(PACKAGES)} are the program's own, in {own}")]


def _check_kernels() -> list[Finding]:
    """Check that the kernels are compiled and cached on disk."""
    from monitor.common.compiled import cache_folder
    from monitor.daemon.kernels.kernel_compilation import is_warm
    from monitor.daemon.kernels.kernel_parts import SERVICE

    folder = cache_folder()
    if folder is None:
        text = "no folder for compiled kernels is writable: every start compiles them again, for one or two minutes"
        return [Finding("doubt", "kernels", text, "set NUMBA_CACHE_DIR to a folder of the service's user")]
    if not is_warm(SERVICE):
        text = f"not compiled for this version on this machine, in {folder}: the next start takes longer"
        return [Finding("doubt", "kernels", text, "run imu-monitor warm-up as the user of the service")]
    return [Finding("well", "kernels", f"compiled, in {folder}")]


def check_clock() -> list[Finding]:
    """Check that the host clock is synchronised, because the times of results are taken from this clock."""
    state = _adjtimex()
    if state is None:
        return [Finding("doubt", "clock", "the system does not report whether it is synchronised")]
    if state == TIME_ERROR:
        text = "not synchronised: the times of results and recordings will drift, or jump when it is set"
        return [Finding("doubt", "clock", text, "timedatectl set-ntp true, or install chrony")]
    return [Finding("well", "clock", "synchronised")]


def _check_systemd_unit() -> list[Finding]:
    """Check the state of the systemd unit, if it is installed."""
    if shutil.which("systemctl") is None or not Path("/run/systemd/system").is_dir():
        return []
    command = ["systemctl", "show", UNIT, "--property=LoadState,ActiveState,SubState,NRestarts,UnitFileState"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return [Finding("doubt", "systemd", f"the state is unknown: {error}")]
    return check_unit_state(dict(line.split("=", 1) for line in said.splitlines() if "=" in line))


def check_unit_state(seen: Mapping[str, str]) -> list[Finding]:
    """Return the findings for the output of ``systemctl show``; none if there is no such unit.

    Examples
    --------
    >>> check_unit_state({"LoadState": "not-found"})
    []
    """
    if seen.get("LoadState") != "loaded":
        return []
    active, restarts = seen.get("ActiveState", ""), seen.get("NRestarts", "0")
    text = f"{UNIT}: {active} ({seen.get('SubState', '')}), {restarts} restarts, {seen.get('UnitFileState', '')}"
    if active == "failed":
        return [Finding("wrong", "systemd", text, f"journalctl -u {UNIT} -e shows the reason")]
    if active == "active" and restarts == "0" and seen.get("UnitFileState") == "enabled":
        return [Finding("well", "systemd", text)]
    if active == "active" and restarts == "0":
        return [
            Finding("doubt", "systemd", text, f"systemctl enable {UNIT}; otherwise it does not start with the machine")
        ]
    return [Finding("doubt", "systemd", text, f"journalctl -u {UNIT} -e; systemctl enable --now {UNIT}")]


# --- shared functions


def _adjtimex() -> int | None:
    """Return the state of the kernel clock; None if it cannot be read."""
    try:
        library = ctypes.CDLL(None, use_errno=True)
        question = ctypes.create_string_buffer(512)  # modes = 0: nothing is set
        state = int(library.adjtimex(question))
    except (OSError, AttributeError, TypeError):
        return None
    return state if state >= 0 else None


def _numbers(version: str) -> tuple[int, ...]:
    """Return the first four numbers of a version. Missing numbers are 0."""
    numbers = [int(part) for part in re.split(r"[^\d.]", version)[0].split(".") if part]
    return (*numbers, 0, 0, 0, 0)[:4]


def _host(endpoint: str) -> str:
    """Return the host of an endpoint; "" if it is not a TCP endpoint."""
    match = TCP_ENDPOINT.fullmatch(endpoint)
    return match[1] if match else ""


def _gb(amount: float) -> str:
    """Format a number of bytes in gigabytes."""
    return f"{amount / 1e9:.3g} GB"


def _user(uid: int) -> str:
    """Return the name of a user, or its number if it has no name."""
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _group(gid: int) -> str:
    """Return the name of a group, or its number if it has no name."""
    import grp

    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def worst_mark(findings: Iterable[Finding]) -> Mark:
    """Return the worst mark of all findings."""
    marks = {one.mark for one in findings}
    return "wrong" if "wrong" in marks else "doubt" if "doubt" in marks else "well"
