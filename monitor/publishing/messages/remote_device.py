"""What a daemon's messages say of one device: payloads of ``monitor.common.topics`` -> typed values.

In comes JSON as ``monitor.publishing.messages.encoding`` writes it, from any daemon on the network; out come numbers in SI, or
``ValueError`` for what is not such a message. Fields that a newer daemon added are ignored. Texts are freed of control
characters, as they end on a terminal. Pure.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeVar

import msgspec
import numpy as np

from drivers.sample import AXES
from monitor.common import topics
from monitor.estimation.fit.coefficients import LETTERS, Coefficients, Status

STATUSES: Final = {status.name.lower(): status for status in Status}
QUIET: Final = ("ok", "off")
"""States of an output that need no word."""
GONE_S: Final = 1.5
"""The liveliness token is away and no status (1 Hz) came for so long: who is killed is missed within two seconds."""
NAMED: Final = 6
"""Of the limits that are passed."""
SILENT_S: Final = 5.0
"""The token is there, or was never seen, and nothing came for so long."""
LONGEST_TEXT: Final = 400
MOST_OUTPUTS: Final = 16

Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]

LARGEST_BYTES: Final = 1_000_000
"""Of a payload: six axes are some kilobytes."""


class Latency(msgspec.Struct, frozen=True):
    """Receipt to published, s."""

    p50: float | None = None
    p99: float | None = None


class StatusMessage(msgspec.Struct, frozen=True):
    """``imu/<device>/status``."""

    schema: str
    t: float | None
    """Null before the first sample of a device with times of its own."""
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
    """One coefficient of one axis."""

    status: str
    value: float | None = None
    lo: float | None = None
    hi: float | None = None
    either: str | None = msgspec.field(name="or", default=None)
    """The other letter of K and R, where which of the two is there is not known."""


class CoefficientsMessage(msgspec.Struct, frozen=True):
    """``imu/<device>/coefficients``."""

    schema: str
    samples: Count
    axes: dict[str, dict[str, Letter]]
    rate: float | None = None
    window: float | None = None
    filled: float | None = None


class EventMessage(msgspec.Struct, frozen=True):
    """``imu/<device>/event``."""

    schema: str
    t: float
    kind: str
    text: str
    axis: str | None = None
    what: dict[str, dict[str, Any]] = {}


class Curve(msgspec.Struct, frozen=True):
    """Deviations of one axis, SI."""

    deviation: list[float | None]
    lo: list[float | None]
    hi: list[float | None]


class AllanMessage(msgspec.Struct, frozen=True):
    """``imu/<device>/allan``."""

    schema: str
    t: float
    samples: Count
    rate: float
    window: float
    filled: float
    tau: list[float]
    axes: dict[str, Curve]


class Place(msgspec.Struct, frozen=True):
    """Where a gap is."""

    tau: tuple[float, float]


class AxisGapMessage(msgspec.Struct, frozen=True):
    """One axis beside its model."""

    gap: float
    where: Place
    agrees: bool | None = None


class GapMessage(msgspec.Struct, frozen=True):
    """``imu/<device>/gap``."""

    schema: str
    axes: dict[str, AxisGapMessage]


M = TypeVar("M", StatusMessage, CoefficientsMessage, EventMessage, GapMessage, AllanMessage)


@dataclass(frozen=True, slots=True)
class Noise:
    """The newest coefficients of a device."""

    coefficients: Coefficients
    axes: tuple[str, ...]  # those that are measured
    seen_s: float | None  # how much of the window is full
    either: frozenset[str] = frozenset()  # axes on which K or R is there, which of them not known


@dataclass(slots=True)
class Heard:
    """All that is known of one device; times by the listener's own clock."""

    key: str  # without the topic
    heard_s: float  # newest message of any kind
    status: StatusMessage | None = None
    noise: Noise | None = None
    gap: GapMessage | None = None
    there: bool | None = None  # liveliness; None: never told

    def state(self, now_s: float) -> str:
        """The daemon's word, or what silence means: gone, silent; present while nothing is known yet."""
        age_s = now_s - self.heard_s
        ended = self.status is not None and self.status.state == "ended"
        if age_s > GONE_S and self.there is False and not ended:
            return "gone"
        if age_s > SILENT_S and not ended:
            return "silent"
        return "present" if self.status is None else clean(self.status.state)

    def rank(self, now_s: float) -> int:
        """For sorting, worst first: 0 nothing comes, 1 something is wrong or not there yet, 2 runs, 3 has ended."""
        state, status = self.state(now_s), self.status
        if state in ("lost", "gone", "silent"):
            return 0
        if state == "ended":
            return 3
        if status is None or state != "running":
            return 1
        well = all(output in QUIET or output.startswith("ok,") for output in status.outputs.values())
        well &= not status.text and not status.overflowed and not status.crossed
        return 2 if well and not self.disagreements() else 1

    def trouble(self) -> str:
        """What is wrong, in words; empty while all is well."""
        if self.status is None:
            return ""
        said = [clean(self.status.text)] if self.status.text else []
        outputs = self.status.outputs.items()
        said += [f"{clean(name)}: {clean(state)}" for name, state in outputs if state not in QUIET]
        if self.status.overflowed:
            said.append(f"{self.status.overflowed:,} samples overwritten before they were used: too slow here")
        if crossed := self.status.crossed:
            more = f" and {len(crossed) - NAMED} more" if len(crossed) > NAMED else ""
            said.append(f"beyond its limit: {', '.join(clean(one) for one in crossed[:NAMED])}{more}")
        return "; ".join([*said, *self.disagreements()])

    def disagreements(self) -> list[str]:
        """Of each axis that disagrees with its model, by how much and where."""
        found = [] if self.gap is None else [item for item in self.gap.axes.items() if item[1].agrees is False]
        return [
            f"{clean(axis)} disagrees with its model: {one.gap:.3g} σ at τ {one.where.tau[0]:.3g} to "
            f"{one.where.tau[1]:.3g} s"
            for axis, one in found
        ]


def split(key: str) -> tuple[str, topics.Topic] | None:
    """A key -> the device's part and the topic; None for what is no key of ``monitor.common.topics``.

    >>> split("imu/bench-1/status")
    ('imu/bench-1', Topic(name='status', encoding='application/json', when='1 Hz', kept=1))
    >>> split("imu/bench-1/mood")
    """
    for topic in topics.TOPICS:
        device = key.removesuffix(f"/{topic.name}")
        if device != key and device:
            return device, topic
    return None


def read(kind: type[M], topic: topics.Topic, payload: bytes) -> M:
    """The message of ``payload``; ValueError when it is none of this topic and schema."""
    if len(payload) > LARGEST_BYTES:
        raise ValueError(f"{len(payload)} bytes; {LARGEST_BYTES} are the most that is read")
    try:
        found = msgspec.json.decode(payload, type=kind)  # its errors are ValueErrors
    except RecursionError as error:
        raise ValueError(str(error)) from error
    if found.schema != topic.schema():
        raise ValueError(f'schema "{found.schema}" where {topic.schema()} is known')
    return found


def status(payload: bytes) -> StatusMessage:
    """Texts cut to what a table can show, so that no device can fill a watcher's memory."""
    found = read(StatusMessage, topics.STATUS, payload)
    outputs = {name[:LONGEST_TEXT]: said[:LONGEST_TEXT] for name, said in list(found.outputs.items())[:MOST_OUTPUTS]}
    return msgspec.structs.replace(
        found, state=found.state[:LONGEST_TEXT], text=found.text[:LONGEST_TEXT], outputs=outputs
    )


def event(payload: bytes) -> EventMessage:
    """Texts cut like those of a status."""
    found = read(EventMessage, topics.EVENT, payload)
    what = {letter: found.what[letter] for letter in LETTERS if letter in found.what}
    return msgspec.structs.replace(found, kind=found.kind[:LONGEST_TEXT], text=found.text[:LONGEST_TEXT], what=what)


def gap(payload: bytes) -> GapMessage:
    """Of the axes that there are."""
    found = read(GapMessage, topics.GAP, payload)
    return msgspec.structs.replace(found, axes={axis: found.axes[axis] for axis in AXES if axis in found.axes})


def noise(message: CoefficientsMessage) -> Noise:
    """Coefficients as arrays [5, 6] of SI; ValueError for a status that is not known."""
    value, lo, hi = (np.full((len(LETTERS), len(AXES)), np.nan) for _ in range(3))
    status = np.full(value.shape, Status.UNESTIMATED, np.int8)
    axes = tuple(axis for axis in AXES if axis in message.axes)
    for axis in axes:
        for letter, one in message.axes[axis].items():
            if letter not in LETTERS:
                continue
            at = LETTERS.index(letter), AXES.index(axis)
            value[at], lo[at], hi[at] = (np.nan if x is None else x for x in (one.value, one.lo, one.hi))
            status[at] = _status(one.status)
    either = frozenset(axis for axis in axes if any(one.either for one in message.axes[axis].values()))
    return Noise(Coefficients(value, lo, hi, status), axes, message.filled, either)


def clean(text: Any) -> str:
    """One line without control characters (a terminal would obey them).

    >>> clean("link\\x1b[2J lost\\nnow")
    'link [2J lost now'
    """
    return "".join(c if c.isprintable() else " " for c in str(text))


def _status(word: str) -> Status:
    if word not in STATUSES:
        raise ValueError(f'status "{word}"')
    return STATUSES[word]
