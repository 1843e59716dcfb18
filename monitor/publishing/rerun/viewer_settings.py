"""Settings and errors of the viewer, and descriptions of devices. This module does not import Rerun."""

from dataclasses import dataclass


class ViewerError(Exception):
    """Error of a viewer that cannot be opened or has ended."""


class ViewerClosed(ViewerError):
    """Error of a window that a user has closed and that must not be opened again."""


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Settings of the viewer."""

    mode: str = "auto"  # auto, native, web, none, join (use an open viewer) or a path with the suffix .rrd
    port: int = 9876  # port of the Rerun server on the loopback interface
    web_port: int = 9090  # port of the web page on the loopback interface
    memory: str = "256MiB"  # memory limit for data in the viewer, which drops the oldest data first


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Description of a device for the viewer."""

    name: str
    about: str = ""  # short description: decoder, link, port
    has_model: bool = False  # True if the device is compared with a noise model
    has_thermal: bool = False  # True if the bias of the device is predicted from temperature
    compensated: bool = False  # True if the gyroscope drift of the device is compensated
