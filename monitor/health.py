"""How a device does right now: what the status message, the viewer and the terminal show."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Health:
    """One device's state at one moment; counts are since the start."""

    state: str  # running | waiting | lost | ended
    rate_hz: float | None  # measured; None until known
    received: int
    lost: int  # missing on the wire, rejected frames not among them
    bad: int  # rejected: failed check, impossible value
    overflowed: int  # overwritten in the ring before the worker took them
    latency_p50_s: float | None  # receipt to published, over the last second
    latency_p99_s: float | None
    memory_bytes: int  # of the whole process
    outputs: Mapping[str, str]  # output -> "ok" or what is wrong with it
    text: str  # one sentence for people; empty while all is well
    uptime_s: float
    repeated: int = 0  # samples that came twice, left out
    late: int = 0  # samples that came when their place had passed as missing, left out
    moving: bool = False  # the device is moved just now
    moved: int = 0  # samples of moving stretches
    crossed: tuple[str, ...] = ()  # the user's limits that are passed now: "gz N"
