"""Settings and exceptions of the viewer, and descriptions of devices. This module does not import Rerun."""

from dataclasses import dataclass

from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem


class ViewerError(Exception):
    """Raised if a viewer cannot be opened or has ended."""


class ViewerClosed(ViewerError):
    """Raised if a user has closed the window of the viewer, so that it must not be opened again."""


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Settings of the Rerun viewer."""

    mode: str = "auto"  # auto, native, web, none, join (use an open viewer) or a path with the suffix .rrd
    port: int = 9876  # port of the Rerun server on the loopback interface
    web_port: int = 9090  # port of the web page on the loopback interface
    memory: str = "256MiB"  # memory limit for data; beyond it, the viewer drops the oldest data
    units: UnitSystem = DEFAULT_UNITS


@dataclass(frozen=True, slots=True)
class ViewerDeviceDescription:
    """Description of a device for the viewer."""

    name: str
    about: str = ""  # short description with decoder, link and port
    has_model: bool = False  # True if the device is compared with a noise model
    has_thermal: bool = False  # True if the bias of the device is predicted from temperature
    compensated: bool = False  # True if the gyroscope drift of the device is compensated
