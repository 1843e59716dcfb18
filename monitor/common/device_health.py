"""Health of a device, as shown in status messages, the viewer and the terminal."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from monitor.common.loss_of_samples import NO_LOSS, LossOfSamples
from monitor.common.unit_formatting import format_count

MAX_PROBLEMS: Final = 3


@dataclass(frozen=True, slots=True)
class Health:
    """Health of one device at one moment. Samples are counted from the start of the device."""

    state: str  # running | waiting | lost | ended
    rate_hz: float | None  # measured; None until known
    received: int
    lost: int  # missing on the wire, or discarded because the frame came too late; excludes rejected frames
    bad: int  # rejected because of a failed check or an impossible value
    overflowed: int  # overwritten in the ring buffer before the worker took them
    latency_p50_s: float | None  # median time from reception to publication, over the last second
    latency_p99_s: float | None  # 99 % quantile of this time
    memory_bytes: int  # of the whole process
    outputs: Mapping[str, str]  # state of each output: "ok" or a description of the problem
    text: str  # message about the device; empty if there is no problem
    uptime_s: float
    repeated: int = 0  # samples that were received twice and discarded
    late: int = 0  # samples that were discarded because they already counted as missing
    moving: bool = False  # True while the device is in motion
    moved: int = 0  # number of samples during motion
    crossed: tuple[str, ...] = ()  # user limits that are crossed now, for example "gz N"
    loss: LossOfSamples = NO_LOSS  # missing samples in the window


def format_service_status(healths: Mapping[str, Health], outputs: Mapping[str, str], stuck: Sequence[str] = ()) -> str:
    """Format the status of all devices and outputs in one line for systemd.

    Parameters
    ----------
    healths : mapping of str to Health
        Status of each device by its name.
    outputs : mapping of str to str
        State of each output by its name.
    stuck : sequence of str, optional
        Names of the devices whose reader is stuck.

    Examples
    --------
    >>> format_service_status({}, {"zenoh": "ok", "viewer": "off"})
    '0 devices; no problems'
    """
    states = Counter(one.state for one in healths.values())
    said = [f"{n} {state}" for state, n in states.items()]
    troubles = [f"{name}: {one.text}" for name, one in healths.items() if one.text]
    troubles += [f"{name}: crossed limits: {', '.join(one.crossed)}" for name, one in healths.items() if one.crossed]
    troubles += [f"{name}: the reader is stuck" for name in stuck]
    troubles += [f"{name}: {state}" for name, state in outputs.items() if state not in ("ok", "off")]
    more = f"; and {len(troubles) - MAX_PROBLEMS} more" if len(troubles) > MAX_PROBLEMS else ""
    head = ", ".join([format_count(len(healths), "device"), *said])
    return f"{head}; {'; '.join(troubles[:MAX_PROBLEMS]) or 'no problems'}{more}"
