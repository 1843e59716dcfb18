"""Folder tree of an IIO device, as the Linux kernel provides it below ``/sys`` and ``/dev``.

A named pipe takes the place of the character device.
"""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path


class FakeIioDevice:
    """IIO device with a named pipe instead of a character device.

    Parameters
    ----------
    root
        Folder that contains the folders ``sys`` and ``dev``.
    name
        Name of the device.
    channels
        Type of each channel, in the order of the buffer.
    attributes
        Content of further sysfs attributes, such as "in_accel_scale".
    number
        Number of the device.
    enabled
        True if the buffer and all channels are enabled.
    """

    def __init__(
        self,
        root: Path,
        name: str,
        channels: Mapping[str, str],
        attributes: Mapping[str, str] | None = None,
        number: int = 0,
        enabled: bool = False,
    ) -> None:
        self.folder = root / f"sys/bus/iio/devices/iio:device{number}"
        self.node = root / f"dev/iio:device{number}"
        flag = "1" if enabled else "0"
        texts = {"name": name, "buffer/enable": flag, "buffer/length": "2", "trigger/current_trigger": ""}
        for index, (channel, scan_type) in enumerate(channels.items()):
            stem = f"scan_elements/{channel}"
            texts |= {f"{stem}_en": flag, f"{stem}_index": str(index), f"{stem}_type": scan_type}
        for path, text in (texts | dict(attributes or {})).items():
            (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / path).write_text(f"{text}\n")
        self.node.parent.mkdir(exist_ok=True)
        os.mkfifo(self.node)
        self._file = os.open(self.node, os.O_RDWR)

    def read(self, path: str) -> str:
        """Return the content of a sysfs attribute."""
        return (self.folder / path).read_text().strip()

    def write(self, data: bytes) -> None:
        """Write scans to the buffer. Wait while the pipe is full."""
        view = memoryview(data)
        while view:
            view = view[os.write(self._file, view) :]

    def unplug(self) -> None:
        """Remove the device. Do nothing if it has been removed."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            removed = self.folder.rename(self.folder.with_name("removed"))  # all attributes vanish at once
            shutil.rmtree(removed)
            self.node.unlink()
