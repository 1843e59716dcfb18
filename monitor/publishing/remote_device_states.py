"""State of all devices on the network, updated from zenoh messages.

Malformed messages are counted and otherwise ignored. Any program on the network may send messages, so the number of
devices and the length of texts are limited.
"""

import copy
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from drivers.data_types import AXES
from monitor.common import topics
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import Coefficients
from monitor.publishing.messages.message import Message, decode_message
from monitor.publishing.messages.results import (
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    StatusMessage,
    measured_axes,
)

NORMAL_OUTPUT_STATES: Final = ("ok", "off")
"""States of an output, such as the viewer, that are not reported as problems."""
GONE_TIMEOUT_S: Final = 1.5
"""Time since the newest message [s] after which a device without liveliness token counts as gone."""
SILENCE_TIMEOUT_S: Final = 5.0
"""Time since the newest message [s] after which a device counts as silent."""
MAX_NAMED_LIMITS: Final = 6
"""Largest number of exceeded limits that a message lists by name."""
MAX_DEVICES: Final = 20_000
"""Largest number of devices. Beyond this number, a new device replaces one that was silent for FORGET_AFTER_S."""
FORGET_AFTER_S: Final = 600.0
MAX_KEY_LENGTH: Final = 200
MAX_EVENTS: Final = 5
"""Number of events of all devices to keep."""
DECODERS: Final[dict[topics.ZenohTopic, Callable[[bytes], Message]]] = {
    topics.STATUS: StatusMessage.decode,
    topics.EVENT: EventMessage.decode,
    topics.COEFFICIENTS: partial(decode_message, CoefficientsMessage),
    topics.GAP: partial(decode_message, ModelGapMessage),
}
"""Function that decodes the messages of each topic shown in device tables."""


@dataclass(frozen=True, slots=True)
class DeviceCoefficients:
    """Newest noise coefficients of a device."""

    coefficients: Coefficients
    axes: tuple[str, ...]  # measured axes
    k_or_r: frozenset[str]  # axes on which the data cannot distinguish K from R
    filled_s: float | None = None  # duration of the samples in the window [s]

    @classmethod
    def from_estimate(cls, estimate: Estimate) -> "DeviceCoefficients":
        """Build the coefficients of a device from an estimate."""
        measured = measured_axes(estimate.curve)
        k_or_r = frozenset(axis for i, axis in measured if estimate.k_or_r[i])
        return cls(estimate.coefficients, tuple(axis for _, axis in measured), k_or_r)

    @classmethod
    def from_message(cls, message: CoefficientsMessage) -> "DeviceCoefficients":
        """Build the coefficients of a device from a message.

        Raises
        ------
        ValueError
            If a coefficient has an unknown status.
        """
        axes = tuple(axis for axis in AXES if axis in message.axes)
        k_or_r = frozenset(axis for axis in axes if any(one.other for one in message.axes[axis].values()))
        return cls(message.to_coefficients(), axes, k_or_r, message.filled_s)


@dataclass(slots=True)
class RemoteDevice:
    """State of a device of another process. All times refer to the monotonic clock of the receiving process."""

    key: str  # zenoh key of the device without the topic, such as imu/bench-1
    last_message_s: float  # time of the newest message of any topic
    status: StatusMessage | None = None
    coefficients: DeviceCoefficients | None = None
    disagreements: tuple[str, ...] = ()  # one text for each axis that disagrees with the noise model
    token_exists: bool | None = None  # True if the liveliness token exists; None if unknown
    curve: AllanCurve | None = None  # newest Allan variances, if the device belongs to this process

    def state(self, now_s: float) -> str:
        """Return the state that the daemon reports, or "gone", "silent" or "present" if there is no current status."""
        age_s = now_s - self.last_message_s
        ended = self.status is not None and self.status.state == "ended"
        if age_s > GONE_TIMEOUT_S and self.token_exists is False and not ended:
            return "gone"
        if age_s > SILENCE_TIMEOUT_S and not ended:
            return "silent"
        return "present" if self.status is None else self.status.state

    def sends_nothing(self, now_s: float) -> bool:
        """Return True if no messages of the device arrive, although its recording has not ended."""
        return self.state(now_s) in ("gone", "silent")

    def problems_first_rank(self, now_s: float) -> int:
        """Return the rank for sorting device tables: 0 without data, 1 with a problem, 2 running, 3 ended."""
        state, status = self.state(now_s), self.status
        if state == "lost" or self.sends_nothing(now_s):
            return 0
        if state == "ended":
            return 3
        if status is None or state != "running":
            return 1
        outputs_work = all(one in NORMAL_OUTPUT_STATES or one.startswith("ok,") for one in status.outputs.values())
        troubled = status.text or status.overflowed or status.crossed or self.disagreements
        return 2 if outputs_work and not troubled else 1

    def describe_device_problems(self) -> str:
        """Describe all problems of the device, or return an empty string if the device has none."""
        if self.status is None:
            return ""
        found = [self.status.text] if self.status.text else []
        outputs = self.status.outputs.items()
        found += [f"{name}: {state}" for name, state in outputs if state not in NORMAL_OUTPUT_STATES]
        if self.status.overflowed:
            found.append(
                f"{self.status.overflowed:,} samples overwritten before they were used: this computer is too slow"
            )
        if crossed := self.status.crossed:
            more = f" and {len(crossed) - MAX_NAMED_LIMITS} more" if len(crossed) > MAX_NAMED_LIMITS else ""
            found.append(f"limits exceeded: {', '.join(crossed[:MAX_NAMED_LIMITS])}{more}")
        if self.status.loss.widens_intervals:
            found.append(self.status.loss.describe())
        return "; ".join([*found, *self.disagreements])

    def update_from_message(self, message: Message) -> None:
        """Update the state of the device from a message.

        Raises
        ------
        ValueError
            If a coefficient has an unknown status. The state of the device remains unchanged.
        """
        match message:
            case StatusMessage():
                self.status = message
            case CoefficientsMessage():
                self.coefficients = DeviceCoefficients.from_message(message)
            case ModelGapMessage():
                self.disagreements = tuple(_describe_disagreements(message))


class RemoteDeviceRegistry:
    """Thread-safe collection of the states of all remote devices.

    Parameters
    ----------
    clock
        Function that returns the time of a monotonic clock [s]. The methods expect times of this clock.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.note = ""  # note for the user, such as a list of unreachable endpoints
        self.malformed = 0  # number of messages that could not be decoded
        self.ignored = 0  # number of messages that were ignored because there are MAX_DEVICES devices
        self._clock = clock
        self._devices: OrderedDict[str, RemoteDevice] = OrderedDict()  # by the time of the last message, oldest first
        self._events: deque[tuple[str, EventMessage]] = deque(maxlen=MAX_EVENTS)
        self._lock = threading.Lock()

    def process_message(self, key: str, payload: bytes) -> Message | None:
        """Update the state of a device from a message, and return the decoded message.

        Return None if the message is malformed, or if its topic is not shown in device tables.

        Parameters
        ----------
        key
            zenoh key of the message.
        payload
            Encoded message.
        """
        device, topic = split_device_and_topic(key) or ("", topics.ALIVE)
        with self._lock:
            try:
                if topic not in DECODERS:
                    return None
                message = DECODERS[topic](payload)
                known = self._devices.get(device) or RemoteDevice(device, 0.0)
                known.update_from_message(message)
            except ValueError:
                self.malformed += 1
                return None
            if self._add(known):
                known.last_message_s = self._clock()
                self._devices.move_to_end(device)
                if isinstance(message, EventMessage):
                    self._events.append((device, message))
        return message

    def set_liveliness_token(self, key: str, exists: bool) -> None:
        """Record that the liveliness token of a device has appeared or disappeared.

        Parameters
        ----------
        key
            zenoh key of the liveliness token.
        exists
            True if the token has appeared, False if it has disappeared.
        """
        device, topic = split_device_and_topic(key) or ("", None)
        if topic is not topics.ALIVE:
            return
        with self._lock:
            known = self._devices.get(device) or RemoteDevice(device, self._clock())
            if self._add(known):
                known.token_exists = exists

    def set_allan_curve(self, device: str, curve: AllanCurve) -> None:
        """Store the newest Allan variances of a known device.

        Parameters
        ----------
        device
            Key of the device, such as imu/bench-1.
        curve
            Newest Allan variances.
        """
        with self._lock:
            if known := self._devices.get(device):
                known.curve = curve

    def remove_device(self, key: str) -> None:
        """Remove the state and the events of the device to which a zenoh key belongs."""
        device, _ = split_device_and_topic(key) or ("", None)
        with self._lock:
            self._devices.pop(device, None)
            for one in [one for one in self._events if one[0] == device]:
                self._events.remove(one)

    def devices_with_problems_first(self, now_s: float) -> list[RemoteDevice]:
        """Return copies of all device states, starting with devices that have problems at the time ``now_s`` [s]."""
        with self._lock:
            found = [copy.copy(one) for one in self._devices.values()]
        return sorted(found, key=lambda one: (one.problems_first_rank(now_s), one.key))

    def device_coefficients(self, device: str) -> DeviceCoefficients | None:
        """Return the newest noise coefficients of a device, or None if there are none."""
        with self._lock:
            known = self._devices.get(device)
        return None if known is None else known.coefficients

    def recent_events_in_time_order(self) -> list[tuple[str, EventMessage]]:
        """Return the newest events with the keys of their devices, in order of time."""
        with self._lock:
            return list(self._events)

    def _add(self, device: RemoteDevice) -> bool:
        """Add a new device. Return False if there are already MAX_DEVICES active devices."""
        if device.key in self._devices:
            return True
        full = len(self._devices) >= MAX_DEVICES
        oldest_s = next(iter(self._devices.values())).last_message_s if full else 0.0
        if len(device.key) > MAX_KEY_LENGTH or (full and self._clock() - oldest_s < FORGET_AFTER_S):
            self.ignored += 1
            return False
        if full:
            self._devices.popitem(last=False)
        self._devices[device.key] = device
        return True


def split_device_and_topic(key: str) -> tuple[str, topics.ZenohTopic] | None:
    """Split a zenoh key into the device key and the topic, or return None if the topic is unknown.

    >>> split_device_and_topic("imu/bench-1/status")
    ('imu/bench-1', ZenohTopic(name='status', encoding='application/json', when='1 Hz', kept=1))
    >>> split_device_and_topic("imu/bench-1/mood")
    """
    for topic in topics.TOPICS:
        device = key.removesuffix(f"/{topic.name}")
        if device != key and device:
            return device, topic
    return None


def _describe_disagreements(message: ModelGapMessage) -> list[str]:
    found = [(axis, message.axes[axis]) for axis in AXES if axis in message.axes]
    return [
        f"{axis} disagrees with its model: {one.gap:.3g} σ at τ {one.where.tau[0]:.3g} to {one.where.tau[1]:.3g} s"
        for axis, one in found
        if one.agrees is False
    ]
