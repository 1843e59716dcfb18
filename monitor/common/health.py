"""How a device does right now: what the status message, the viewer and the terminal show."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

SAID: Final = 3
"""Troubles in one sentence."""


@dataclass(frozen=True, slots=True)
class Health:
    """One device's state at one moment; counts are since the start."""

    state: str  # running | waiting | lost | ended
    rate_hz: float | None  # measured; None until known
    received: int
    lost: int  # missing on the wire, or left out as a frame came too late; rejected frames are not among them
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


def sentence(healths: Mapping[str, Health], outputs: Mapping[str, str], stuck: Sequence[str] = ()) -> str:
    """How the whole service does, in one line: for systemd.

    >>> sentence({}, {"zenoh": "ok", "viewer": "off"})
    '0 devices; all well'
    """
    states = Counter(one.state for one in healths.values())
    count = f"{len(healths)} device{'' if len(healths) == 1 else 's'}"
    said = [f"{n} {state}" for state, n in states.items()]
    troubles = [f"{name}: {one.text}" for name, one in healths.items() if one.text]
    troubles += [f"{name}: beyond its limit: {', '.join(one.crossed)}" for name, one in healths.items() if one.crossed]
    troubles += [f"{name}: its reader is stuck" for name in stuck]
    troubles += [f"{name}: {state}" for name, state in outputs.items() if state not in ("ok", "off")]
    more = f"; and {len(troubles) - SAID} more" if len(troubles) > SAID else ""
    return f"{', '.join([count, *said])}; {'; '.join(troubles[:SAID]) or 'all well'}{more}"
