"""What the service says to the viewer's thread: settings, devices, and the one error. Loads no Rerun."""

from dataclasses import dataclass


class ViewerTrouble(Exception):
    """The viewer cannot be opened, or is gone: one line for people."""


class ViewerClosed(ViewerTrouble):
    """Someone closed the window: it is not to be opened again unasked."""


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Which viewer, and where."""

    mode: str = "auto"  # auto | native | web | none | a path ending in .rrd; join: only a viewer that is open
    port: int = 9876  # of the Rerun server, loopback
    web_port: int = 9090  # of the page, loopback
    memory: str = "256MiB"  # of what the viewer keeps for looking back; the oldest go first


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A device as the viewer presents it."""

    name: str
    about: str = ""  # a few words: decoder, link, port
    has_model: bool = False  # one is in force
    has_thermal: bool = False  # its bias is held against its temperature, once one comes
    compensated: bool = False  # the drift of its gyros is taken out
