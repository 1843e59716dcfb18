"""Checks of the devices of a configuration: serial ports, UDP ports, CAN interfaces and IIO devices."""

import contextlib
import errno
import os
import socket
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from drivers.errors import LinkUnavailable
from drivers.links import iio_link, udp_link
from drivers.links.can_link import describe_missing_package
from monitor.commands.doctor.finding import DoctorFinding, doubt, group_name, user_name, well, wrong
from monitor.commands.doctor.network import check_reachable

CAN_TYPE: Final = "280"
"""Content of /sys/class/net/NAME/type for a CAN interface (ARPHRD_CAN)."""


def check_device(name: str, driver: Mapping[str, Any]) -> Iterator[DoctorFinding]:
    """Check the port, the interface or the endpoints of one device."""
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
                yield check_reachable(about, str(endpoint))
        case other:
            yield well(about, f"link {other}: nothing to check on this machine")


def _check_serial_port(about: str, port: str) -> DoctorFinding:
    if "://" in port:
        return well(about, f"{port}: network port or pattern, not checked")
    path = Path(port)
    if not path.exists():
        there = sorted(str(one) for kind in ("ttyUSB*", "ttyACM*", "ttyAMA*") for one in Path("/dev").glob(kind))
        text = f"{port}: no such port; existing ports: {', '.join(there) or 'none'}"
        return wrong(about, text, "plug it in, or choose another port; dmesg shows what was plugged in last")
    seen = path.stat()
    if not stat.S_ISCHR(seen.st_mode):
        return wrong(about, f"{port}: not a serial port")
    if not os.access(path, os.R_OK | os.W_OK):
        user, group = user_name(os.geteuid()), group_name(seen.st_gid)
        text = f"{port}: {user} cannot read and write it; members of group {group} can"
        return wrong(about, text, f"sudo usermod -aG {group} {user}, and log in again")
    if holders := ", ".join(_processes_using(path)):
        do = "if this is not the service itself, end it: only one program can read a port"
        return doubt(about, f"{port}: in use by {holders}", do)
    return well(about, f"{port}: exists, is readable, and no visible program uses it")


def _check_udp_port(about: str, keys: Mapping[str, Any]) -> DoctorFinding:
    """Check that a UDP port can be opened, by opening it briefly."""
    link = udp_link.build(udp_link.Settings(**keys))
    try:
        link.open()
    except LinkUnavailable as error:
        text = str(error)
        if isinstance(error.__cause__, OSError) and error.__cause__.errno == errno.EADDRINUSE:
            return doubt(about, text, "if this is not the service itself, end it, or choose another port")
        return wrong(about, text)
    link.close()
    return well(about, f"{link.name}: free")


def _processes_using(port: Path) -> Iterator[str]:
    """Yield the programs that have opened a serial port. Only programs that the user may inspect are found."""
    wanted = str(port.resolve())
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process belongs to another user or has ended
            if process.name != str(os.getpid()) and wanted in map(os.readlink, (process / "fd").iterdir()):
                yield f"{(process / 'comm').read_text().strip()} (pid {process.name})"


def check_can_interface(
    subject: str, interface: str, channel: str, sysfs: Path = Path("/sys/class/net")
) -> DoctorFinding:
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
        return wrong(subject, text, command)
    if interface != "socketcan":
        return well(subject, f"{interface} {channel}: not checked")
    if not hasattr(socket, "AF_CAN"):
        return wrong(subject, "this system has no socketcan", "use another interface of python-can")
    network = sysfs / channel
    up = f"sudo ip link set {channel} up type can bitrate 500000, with the bit rate of the bus"
    try:
        kind, flags = (network / "type").read_text().strip(), int((network / "flags").read_text(), 16)
    except OSError:
        types = [one for one in sysfs.glob("*/type") if os.access(one, os.R_OK) and one.read_text().strip() == CAN_TYPE]
        there = ", ".join(sorted(one.parent.name for one in types)) or "none"
        return wrong(subject, f"{channel}: no such interface; existing CAN interfaces: {there}", up)
    if kind != CAN_TYPE:
        return wrong(subject, f"{channel}: not a CAN interface", up)
    if not flags & 1:  # the flag IFF_UP is not set
        return wrong(subject, f"{channel}: is down", up)
    return well(subject, f"{channel}: is up")


def check_iio_device(subject: str, device: str, enable: bool, root: Path = iio_link.ROOT) -> DoctorFinding:
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
        return wrong(subject, str(error), "load the driver of the sensor, or correct the key device")
    user, advice = user_name(os.geteuid()), iio_link.PERMISSION_ADVICE
    if not os.access(node, os.R_OK):
        return wrong(subject, f"{node}: does not exist, or {user} cannot read it", advice)
    if enable and not os.access(enabled, os.W_OK):
        return wrong(subject, f"{enabled}: {user} cannot write it, as enable = true needs", advice)
    if not enable and not running:
        return doubt(subject, f"{node}: its buffer is not enabled", "set enable = true, or let a program enable it")
    return well(subject, f"{node}: exists, and {user} has the necessary permissions")
