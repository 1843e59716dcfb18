"""State of a remote device, decoded from the messages of its daemon.

JSON messages as ``monitor.publishing.messages.encoding`` writes them, from any daemon on the network, become typed
values in SI units. Any other payload raises ``ValueError``. Unknown fields of newer daemons are ignored. Control
characters are removed from text, because it is shown on a terminal. The module does no I/O.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeVar

import msgspec
import numpy as np

from drivers.sample import AXES
from monitor.common import topics
from monitor.estimation.fit.coefficients import SYMBOLS, Coefficients, Status

STATUSES: Final = {status.name.lower(): status for status in Status}
NORMAL_OUTPUT_STATES: Final = ("ok", "off")
"""States of an output that are not shown."""
GONE_TIMEOUT_S: Final = 1.5
"""Age of the newest message [s] after which a device without liveliness token is gone. The status comes at 1 Hz, so a
daemon that is killed is reported within two seconds."""
MAX_NAMED_LIMITS: Final = 6
"""Largest number of exceeded limits that are listed by name."""
SILENCE_TIMEOUT_S: Final = 5.0
"""Age of the newest message [s] after which a device is silent, if its token exists or was never seen."""
MAX_TEXT_LENGTH: Final = 400
MAX_OUTPUTS: Final = 16

Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]

MAX_PAYLOAD_BYTES: Final = 1_000_000
"""Largest accepted payload; a message of six axes has a few kilobytes."""


class Latency(msgspec.Struct, frozen=True):
    """Percentiles of the latency from receipt to publication [s]."""

    p50: float | None = None
    p99: float | None = None


class StatusMessage(msgspec.Struct, frozen=True):
    """Message ``imu/<device>/status``."""

    schema: str
    t: float | None
    """Null before the first sample of a device that has its own clock."""
    state: str
    received: Count
    lost: Count
    bad: Count
    rate: float | None = None
    overflowed: Count = 0
    latency: Latency = Latency()
    outputs: dict[str, str] = {}
    crossed: tuple[str, ...] = ()
    text: str = ""
    memory: Count = 0
    uptime: float = 0.0


class Letter(msgspec.Struct, frozen=True):
    """Coefficient of one axis with interval and status."""

    status: str
    value: float | None = None
    lo: float | None = None
    hi: float | None = None
    either: str | None = msgspec.field(name="or", default=None)
    """The other letter of K and R, if the data do not show which of the two is present."""


class CoefficientsMessage(msgspec.Struct, frozen=True):
    """Message ``imu/<device>/coefficients``."""

    schema: str
    samples: Count
    axes: dict[str, dict[str, Letter]]
    rate: float | None = None
    window: float | None = None
    filled: float | None = None


class EventMessage(msgspec.Struct, frozen=True):
    """Message ``imu/<device>/event``."""

    schema: str
    t: float
    kind: str
    text: str
    axis: str | None = None
    what: dict[str, dict[str, Any]] = {}


class Curve(msgspec.Struct, frozen=True):
    """Deviations of one axis and their intervals, SI."""

    deviation: list[float | None]
    lo: list[float | None]
    hi: list[float | None]


class AllanMessage(msgspec.Struct, frozen=True):
    """Message ``imu/<device>/allan``."""

    schema: str
    t: float
    samples: Count
    rate: float
    window: float
    filled: float
    tau: list[float]
    axes: dict[str, Curve]


class Place(msgspec.Struct, frozen=True):
    """Range of averaging times of a deviation from the model."""

    tau: tuple[float, float]


class AxisGapMessage(msgspec.Struct, frozen=True):
    """Comparison of one axis with its model."""

    gap: float
    where: Place
    agrees: bool | None = None


class GapMessage(msgspec.Struct, frozen=True):
    """Message ``imu/<device>/gap``."""

    schema: str
    axes: dict[str, AxisGapMessage]


M = TypeVar("M", StatusMessage, CoefficientsMessage, EventMessage, GapMessage, AllanMessage)


@dataclass(frozen=True, slots=True)
class Noise:
    """Newest coefficients of a device."""

    coefficients: Coefficients
    axes: tuple[str, ...]  # measured axes
    seen_s: float | None  # filled part of the window [s]
    either: frozenset[str] = frozenset()  # axes on which either K or R is present and the data do not show which


@dataclass(slots=True)
class RemoteDevice:
    """State of a remote device; times are those of the receiver's monotonic clock."""

    key: str  # key of the device, without the topic
    last_message_s: float  # time of the newest message of any topic
    status: StatusMessage | None = None
    noise: Noise | None = None
    gap: GapMessage | None = None
    token_exists: bool | None = None  # True if its liveliness token exists; None if unknown

    def state(self, now_s: float) -> str:
        """Return the state that the daemon reports, or gone, silent or present (no status received yet)."""
        age_s = now_s - self.last_message_s
        ended = self.status is not None and self.status.state == "ended"
        if age_s > GONE_TIMEOUT_S and self.token_exists is False and not ended:
            return "gone"
        if age_s > SILENCE_TIMEOUT_S and not ended:
            return "silent"
        return "present" if self.status is None else strip_control_characters(self.status.state)

    def rank(self, now_s: float) -> int:
        """Return the sort key, worst first: 0 no data, 1 a problem or not ready, 2 running, 3 ended."""
        state, status = self.state(now_s), self.status
        if state in ("lost", "gone", "silent"):
            return 0
        if state == "ended":
            return 3
        if status is None or state != "running":
            return 1
        well = all(output in NORMAL_OUTPUT_STATES or output.startswith("ok,") for output in status.outputs.values())
        well &= not status.text and not status.overflowed and not status.crossed
        return 2 if well and not self.disagreements() else 1

    def problems(self) -> str:
        """Return a description of all problems; empty if there are none."""
        if self.status is None:
            return ""
        said = [strip_control_characters(self.status.text)] if self.status.text else []
        outputs = self.status.outputs.items()
        said += [
            f"{strip_control_characters(name)}: {strip_control_characters(state)}"
            for name, state in outputs
            if state not in NORMAL_OUTPUT_STATES
        ]
        if self.status.overflowed:
            said.append(f"{self.status.overflowed:,} samples overwritten before they were used: too slow here")
        if crossed := self.status.crossed:
            more = f" and {len(crossed) - MAX_NAMED_LIMITS} more" if len(crossed) > MAX_NAMED_LIMITS else ""
            said.append(
                "beyond its limit: "
                + ", ".join(strip_control_characters(one) for one in crossed[:MAX_NAMED_LIMITS])
                + more
            )
        return "; ".join([*said, *self.disagreements()])

    def disagreements(self) -> list[str]:
        """Return one line for each axis that disagrees with its model."""
        found = [] if self.gap is None else [item for item in self.gap.axes.items() if item[1].agrees is False]
        return [
            f"{strip_control_characters(axis)} disagrees with its model: "
            f"{one.gap:.3g} σ at τ {one.where.tau[0]:.3g} to "
            f"{one.where.tau[1]:.3g} s"
            for axis, one in found
        ]


def split_key(key: str) -> tuple[str, topics.Topic] | None:
    """Split a key into the device's part and the topic; None if the topic is not in ``monitor.common.topics``.

    >>> split_key("imu/bench-1/status")
    ('imu/bench-1', Topic(name='status', encoding='application/json', when='1 Hz', kept=1))
    >>> split_key("imu/bench-1/mood")
    """
    for topic in topics.TOPICS:
        device = key.removesuffix(f"/{topic.name}")
        if device != key and device:
            return device, topic
    return None


def read(kind: type[M], topic: topics.Topic, payload: bytes) -> M:
    """Decode a message and check its schema.

    Parameters
    ----------
    kind
        Type of the message.
    topic
        Topic of the message, which defines the expected schema.
    payload
        JSON text.

    Raises
    ------
    ValueError
        The payload is too large, is not a message of this type, or has another schema.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"{len(payload)} bytes; {MAX_PAYLOAD_BYTES} are the most that is read")
    try:
        found = msgspec.json.decode(payload, type=kind)  # its errors are ValueErrors
    except RecursionError as error:
        raise ValueError(str(error)) from error
    if found.schema != topic.schema():
        raise ValueError(f'schema "{found.schema}" where {topic.schema()} is known')
    return found


def status(payload: bytes) -> StatusMessage:
    """Decode a status message; text is truncated, so that no device can exhaust the memory of the receiver."""
    found = read(StatusMessage, topics.STATUS, payload)
    outputs = {
        name[:MAX_TEXT_LENGTH]: said[:MAX_TEXT_LENGTH] for name, said in list(found.outputs.items())[:MAX_OUTPUTS]
    }
    return msgspec.structs.replace(
        found, state=found.state[:MAX_TEXT_LENGTH], text=found.text[:MAX_TEXT_LENGTH], outputs=outputs
    )


def event(payload: bytes) -> EventMessage:
    """Decode an event message; text is truncated as in a status message."""
    found = read(EventMessage, topics.EVENT, payload)
    what = {letter: found.what[letter] for letter in SYMBOLS if letter in found.what}
    return msgspec.structs.replace(
        found, kind=found.kind[:MAX_TEXT_LENGTH], text=found.text[:MAX_TEXT_LENGTH], what=what
    )


def gap(payload: bytes) -> GapMessage:
    """Decode a gap message; unknown axes are removed."""
    found = read(GapMessage, topics.GAP, payload)
    return msgspec.structs.replace(found, axes={axis: found.axes[axis] for axis in AXES if axis in found.axes})


def noise(message: CoefficientsMessage) -> Noise:
    """Convert coefficients into arrays of shape [5, 6] in SI; an unknown status raises ValueError."""
    value, lo, hi = (np.full((len(SYMBOLS), len(AXES)), np.nan) for _ in range(3))
    status = np.full(value.shape, Status.UNESTIMATED, np.int8)
    axes = tuple(axis for axis in AXES if axis in message.axes)
    for axis in axes:
        for letter, one in message.axes[axis].items():
            if letter not in SYMBOLS:
                continue
            at = SYMBOLS.index(letter), AXES.index(axis)
            value[at], lo[at], hi[at] = (np.nan if x is None else x for x in (one.value, one.lo, one.hi))
            status[at] = _status(one.status)
    either = frozenset(axis for axis in axes if any(one.either for one in message.axes[axis].values()))
    return Noise(Coefficients(value, lo, hi, status), axes, message.filled, either)


def strip_control_characters(text: Any) -> str:
    """Replace control characters by spaces, because a terminal would interpret them.

    >>> strip_control_characters("link\\x1b[2J lost\\nnow")
    'link [2J lost now'
    """
    return "".join(c if c.isprintable() else " " for c in str(text))


def _status(word: str) -> Status:
    """Return the status with this name; an unknown name raises ValueError."""
    if word not in STATUSES:
        raise ValueError(f'status "{word}"')
    return STATUSES[word]
