"""Link to an inertial sensor whose driver is part of the Linux kernel (Industrial I/O).

The kernel writes one scan per sample to a buffer, which the link reads from ``/dev/iio:deviceN``. Each chunk contains
one or more complete scans. ``Chunk.attachment`` contains their layout (``drivers.iio_scan_layout``), which the link
reads from sysfs when it is opened.

By default, the link writes nothing, and another program has to enable the buffer. With ``enable = true``, the link
enables the channels of angular rate, acceleration, temperature and time, sets the trigger and the sampling frequency
if they are configured, and enables the buffer. ``close`` restores all attributes that the link has written.

The kernel drops new scans if the buffer is full. The decoder finds the missing samples from the time stamps.
"""

import contextlib
import errno
import os
import re
import select
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field

from drivers.data_types import Chunk
from drivers.errors import ConfigError, DecodeError, LinkLost, LinkUnavailable, describe_error
from drivers.iio_scan_layout import ScanElement, ScanLayout, locate_numbers
from drivers.links.base import Carrier, Link, LinkSettings, PolledLink
from drivers.number_ranges import RATE_HZ
from drivers.settings_model import Conflict, checked_by

DEFAULT_DECODER: Final = "iio"
ROOT: Final = Path("/")
"""Folder that contains the folders ``sys`` and ``dev`` of the kernel."""
BUFFER_SCANS: Final = 1024
"""Length of the buffer that the link enables. The kernel's default is 2."""
READ_BYTES: Final = 1 << 16
"""Maximum number of bytes per read, which is 1638 scans of 40 bytes."""
MAX_WAIT_S: Final = 0.1
"""Longest single wait for a scan in s. A removed device and a closed link are detected within this time."""
GATHER_S: Final = 0.01
"""Time in s that a scan may wait for more scans in a buffer of at least BUFFER_SCANS scans."""
ENABLED_CHANNELS: Final = re.compile(r"in_(anglvel|accel)_[xyz]|in_temp0?|in_timestamp")
"""Regular expression that matches the channels that the link enables."""
PERMISSION_ADVICE: Final = "a udev rule has to give the group of the user access, see docs/how-to/connecting-sensors.md"


def _check_device(device: str) -> None:
    if not device:
        raise ConfigError('empty; it is the name of an IIO device ("bmi160") or its number ("0")')


class Settings(LinkSettings):
    """Keys of an IIO link."""

    device: Annotated[str, checked_by(_check_device)] = Field(
        examples=["bmi160"], description='name of the device, or its number in quotes: "0" is /dev/iio:device0'
    )
    enable: bool = Field(
        False, description="true: enable the channels and the buffer, and restore them when the link is closed"
    )
    trigger: str = Field("", examples=["bmi160-dev0"], description="name of the trigger to set; absent: unchanged")
    sampling_frequency: Annotated[float, RATE_HZ] | None = Field(
        None, examples=[200.0], description="sampling frequency in Hz to set; absent: unchanged"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if an attribute is to be set but the link is not allowed to write."""
        for key in ("trigger", "sampling_frequency"):
            if getattr(self, key) and not self.enable:
                yield Conflict(key, "the link writes nothing to the device unless enable = true")


class IioLink(PolledLink):
    """Link to the buffer of one IIO device.

    Parameters
    ----------
    settings
        Settings of the link.
    root
        Folder that contains the folders ``sys`` and ``dev`` of the kernel.
    """

    carrier: Carrier = "messages"
    epoch: Literal["monotonic", "unix"] = "monotonic"

    def __init__(self, settings: Settings, root: Path) -> None:
        super().__init__(f"IIO device {settings.device}")
        self._settings = settings
        self._root = root
        self._file: int | None = None
        self._poller = select.poll()
        self._previous: dict[Path, str] = {}  # previous values of the attributes that have been written
        self._layout = b""
        self._scan_bytes = 1
        self._gather_s = 0.0
        self._partial_scan = b""

    def _is_open(self) -> bool:
        return self._file is not None

    def _open_source(self) -> None:
        folder, node = find_device(self._settings.device, self._root)
        try:
            try:
                self._file = os.open(node, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            except OSError as error:
                raise LinkUnavailable(f"{self.name}: {node}: {_why_not_open(error)}") from error
            self._prepare_buffer(folder)
        except LinkUnavailable:
            self._close_source()
            raise
        self._partial_scan = b""
        self._poller = select.poll()
        self._poller.register(self._file, select.POLLIN)

    def _prepare_buffer(self, folder: Path) -> None:
        """Enable the buffer if this is configured, and read the layout of its scans."""
        enabled = folder / "buffer" / "enable"
        if self._settings.enable:
            self._write_attribute(enabled, "0")  # the other attributes cannot be changed while the buffer is enabled
            self._write_settings(folder)
        elif read_attribute(enabled) != "1":
            raise LinkUnavailable(
                f"{self.name}: the buffer is not enabled; set enable = true, or enable the buffer in the program "
                f"that configures the sensor (echo 1 > {enabled})"
            )
        layout = _read_layout(folder)
        try:
            self._scan_bytes = locate_numbers(layout.elements)[1]
        except DecodeError as error:
            raise LinkUnavailable(f"{folder / 'scan_elements'}: {error}") from error
        self._layout = layout.encode()
        self._gather_s = GATHER_S if _read_number(folder / "buffer" / "length") >= BUFFER_SCANS else 0.0
        if self._settings.enable:
            self._write_attribute(enabled, "1")

    def _write_settings(self, folder: Path) -> None:
        for path in sorted((folder / "scan_elements").glob("in_*_en")):
            if ENABLED_CHANNELS.fullmatch(path.name.removesuffix("_en")):
                self._write_attribute(path, "1")
        self._write_attribute(folder / "buffer" / "length", str(BUFFER_SCANS))
        if self._settings.trigger:
            self._write_attribute(folder / "trigger" / "current_trigger", self._settings.trigger)
        if self._settings.sampling_frequency is not None:
            names = ("sampling_frequency", "in_anglvel_sampling_frequency", "in_accel_sampling_frequency")
            found = [folder / name for name in names if (folder / name).exists()]
            if not found:
                raise LinkUnavailable(f"{folder}: the driver has no sampling_frequency; remove this key")
            for path in found:
                self._write_attribute(path, f"{self._settings.sampling_frequency:.9g}")

    def _write_attribute(self, path: Path, value: str) -> None:
        """Write a sysfs attribute, and keep its previous value for ``close``."""
        previous = read_attribute(path)
        try:
            path.write_text(f"{value}\n")
        except OSError as error:
            advice = f"; {PERMISSION_ADVICE}" if error.errno in (errno.EACCES, errno.EPERM) else ""
            raise LinkUnavailable(f'{path}: cannot write "{value}": {describe_error(error)}{advice}') from error
        self._previous.setdefault(path, previous)

    def _poll_source(self, deadline: float) -> list[Chunk]:
        assert self._file is not None
        wait_s = min(max(deadline - time.monotonic(), 0.0), MAX_WAIT_S)
        if self._poller.poll(1e3 * wait_s):
            self._closing.wait(self._gather_s)
        try:
            data = os.read(self._file, READ_BYTES)  # poll does not report that the device has been removed
        except BlockingIOError:
            return []
        except OSError as error:
            self._close_source()
            raise LinkLost(f"{self.name}: the device is gone (unplugged?): {describe_error(error)}") from error
        if not data:
            self._close_source()
            raise LinkLost(f"{self.name}: the device is gone (end of its data)")
        data = self._partial_scan + data
        end = len(data) - len(data) % self._scan_bytes
        self._partial_scan = data[end:]
        return [Chunk(data[:end], time.monotonic_ns(), attachment=self._layout)] if end else []

    def _close_source(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            os.close(file)
        previous, self._previous = self._previous, {}
        # The attribute that is written first enables the buffer, and it is restored last.
        for path, value in [*((path, "0") for path in [*previous][:1]), *reversed(previous.items())]:
            with contextlib.suppress(OSError):  # the attributes of an unplugged device do not exist
                path.write_text(f"{value}\n")


def find_device(device: str, root: Path = ROOT) -> tuple[Path, Path]:
    """Return the sysfs folder and the character device of an IIO device.

    Parameters
    ----------
    device
        Name or number of the device.
    root
        Folder that contains the folders ``sys`` and ``dev`` of the kernel.

    Raises
    ------
    LinkUnavailable
        If no device or more than one device has this name. The message lists the devices.
    """
    folders = sorted((root / "sys/bus/iio/devices").glob("iio:device*"))
    names = {folder: read_attribute(folder / "name") if (folder / "name").exists() else "" for folder in folders}
    found = [folder for folder in folders if device in (names[folder], folder.name.removeprefix("iio:device"))]
    if len(found) == 1:
        return found[0], root / "dev" / found[0].name
    listed = ", ".join(f"{folder.name} ({name})" for folder, name in names.items()) or "none"
    if found:
        raise LinkUnavailable(f"IIO device {device}: several devices have this name; give the number: {listed}")
    raise LinkUnavailable(f"IIO device {device}: no such device; is the driver loaded? IIO devices here: {listed}")


def read_attribute(path: Path) -> str:
    """Return the text of a sysfs attribute. Raise ``LinkUnavailable`` if the attribute cannot be read."""
    try:
        return path.read_text().strip()
    except OSError as error:
        raise LinkUnavailable(f"{path}: cannot be read: {describe_error(error)}") from error


def _read_layout(folder: Path) -> ScanLayout:
    """Return the enabled channels in the order of the buffer, with scale and offset."""
    clock = folder / "current_timestamp_clock"
    elements: dict[int, ScanElement] = {}
    for enabled in (folder / "scan_elements").glob("in_*_en"):
        if read_attribute(enabled) == "1":
            stem, channel = str(enabled).removesuffix("_en"), enabled.name.removesuffix("_en")
            factors = (_read_factor(folder, channel, "scale", 1.0), _read_factor(folder, channel, "offset", 0.0))
            index = int(_read_number(Path(f"{stem}_index")))
            elements[index] = ScanElement(channel, read_attribute(Path(f"{stem}_type")), *factors)
    ordered = [elements[index] for index in sorted(elements)]
    return ScanLayout(read_attribute(clock) if clock.exists() else "realtime", ordered)


def _read_factor(folder: Path, channel: str, kind: str, default: float) -> float:
    """Return the scale or the offset of a channel, which may be an attribute of the channel or of all its axes."""
    shared = re.sub(r"(_[xyz]|\d+)$", "", channel)
    paths = [folder / f"{name}_{kind}" for name in (channel, shared)]
    return next((_read_number(path) for path in paths if path.exists()), default)


def _read_number(path: Path) -> float:
    text = read_attribute(path)
    try:
        return float(text)
    except ValueError as error:
        raise LinkUnavailable(f'{path}: expected a number, got "{text}"') from error


def _why_not_open(error: OSError) -> str:
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission; {PERMISSION_ADVICE}"
    if error.errno == errno.EBUSY:
        return "another program reads this device; end it, because only one program can read an IIO buffer"
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return "no character device; the kernel driver of this sensor provides no buffer, or the sensor was unplugged"
    return f"cannot be opened: {describe_error(error)}"


def build(settings: Settings) -> Link:
    """Return the link without opening the device."""
    return IioLink(settings, ROOT)
