"""Settings and errors of the viewer, and descriptions of its devices. This module does not import Rerun."""

from dataclasses import dataclass


class ViewerError(Exception):
    """Error: the viewer cannot be opened or has ended; the message is one line for the user."""


class ViewerClosed(ViewerError):
    """Error: a user closed the window, so it must not be opened again without request."""


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Settings of the viewer."""

    mode: str = "auto"  # auto, native, web, none, or a path that ends in .rrd; join: use an open viewer only
    port: int = 9876  # port of the Rerun server on the loopback interface
    web_port: int = 9090  # port of the web page on the loopback interface
    memory: str = "256MiB"  # memory for past data in the viewer; the oldest data are dropped first


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Description of a device for the viewer."""

    name: str
    about: str = ""  # short description: decoder, link, port
    has_model: bool = False  # True if it is compared with a noise model
    has_thermal: bool = False  # True if its bias is compared with its temperature, once it is measured
    compensated: bool = False  # True if its gyroscope drift is compensated
