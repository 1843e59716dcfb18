"""Timeline of the samples of one device: Unix time, present time, and events whose time is not yet known.

The samples of a live sensor carry host monotonic times, which ``SlewedClock`` converts to Unix time. The samples of a
recording, or of a device with its own time stamps, carry Unix times. Events of a recording wait for the first sample,
because the present time is unknown before the first sample.
"""

import time
from collections import deque
from typing import Final

from drivers.data_types import Event, Ints, SampleBlock
from drivers.driver import Driver
from drivers.timing.arrival_timeline import JUMP_S
from monitor.daemon.slewed_clock import MAX_SLEW_RATE, SlewedClock

MAX_UNTIMED_EVENTS: Final = 100
"""Maximum number of events that wait for the first sample. The oldest events are dropped first."""
MIN_CLOCK_STEP_S: Final = 1.0
"""Smallest reported step of the host clock, and smallest reported offset of the sample times."""


class DeviceTimeline:
    """Timeline of the samples of one device.

    Parameters
    ----------
    driver : Driver
        Driver of the device.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._replayed = driver.link.epoch == "unix"
        self._clock = SlewedClock(time.monotonic_ns(), time.time_ns())
        self._newest_ns: int | None = None  # time of the newest sample from the ring buffer
        self._taken_ns = 0  # monotonic time at which the newest sample was taken
        self._events: list[Event] = []
        self._untimed: deque[tuple[str, str]] = deque(maxlen=MAX_UNTIMED_EVENTS)  # kind and text

    # --- conversion of times

    def unix_offset_ns(self, t_ns: int) -> int:
        """Return the offset that converts a sample time to Unix time, in nanoseconds."""
        return 0 if self._driver.times_are_unix else self._clock.unix_offset_ns(t_ns)

    def unix_offsets_ns(self, samples: SampleBlock) -> Ints | int:
        """Return the offsets that convert sample times to Unix time in nanoseconds, int64 [n] or one number.

        The Unix times of successive samples increase even if the host clock was set back.
        """
        return 0 if self._driver.times_are_unix else self._clock.unix_offsets_ns(samples.t_ns)

    def to_unix_s(self, t_ns: int) -> float:
        """Convert a sample time in nanoseconds to Unix time in seconds."""
        return (t_ns + self.unix_offset_ns(t_ns)) / 1e9

    # --- present time

    def set_newest_sample_time(self, t_ns: int) -> None:
        """Set the time of the newest sample that was taken from the ring buffer."""
        self._newest_ns, self._taken_ns = t_ns, time.monotonic_ns()

    def now_unix_s(self) -> float | None:
        """Return the present time on the timeline of the samples, in Unix seconds.

        Returns
        -------
        float or None
            Time of the newest sample. The time advances with the host clock while no samples arrive. None if the time
            is unknown.
        """
        now_ns = self._now_ns()
        return None if now_ns is None else self.to_unix_s(now_ns)

    def _now_ns(self) -> int | None:
        """Return the present time on the timeline of the samples in nanoseconds, or None if it is unknown."""
        newest_ns, now_ns = self._newest_ns, time.monotonic_ns()
        if newest_ns is not None and (self._replayed or self._driver.state in ("running", "ended")):
            return newest_ns
        if not self._driver.times_are_unix:
            return now_ns
        if newest_ns is None:  # samples may wait in the ring buffer, and the first sample is the oldest
            return self._driver.first_t_ns
        return newest_ns + now_ns - self._taken_ns

    # --- events

    def add_event(self, event: Event) -> None:
        """Queue an event that has a time."""
        self._events.append(event)

    def add_event_now(self, kind: str, text: str) -> None:
        """Queue an event with the present time. The event waits until the present time is known.

        Parameters
        ----------
        kind : str
            Kind of the event, for example "recording_stopped".
        text : str
            Message of the event.
        """
        now_ns = self._now_ns()
        if now_ns is None:
            self._untimed.append((kind, text))
        else:
            self._events.append(Event(kind, now_ns, text))

    def take_events(self) -> list[Event]:
        """Return the events since the last call, except events whose time is not yet known."""
        now_ns = self._now_ns() if self._untimed else None
        if now_ns is not None:
            self._events += [Event(kind, now_ns, text) for kind, text in self._untimed]
            self._untimed.clear()
        events, self._events = self._events, []
        return events

    # --- host clock

    def slew_to_host_clock(self) -> None:
        """Slew the Unix times of the samples towards the host clock, and queue an event if the host clock was set."""
        now_ns = time.monotonic_ns()
        # Sample times may be ahead of the host clock. A correction that begins after them leaves them in order.
        ahead_ns = round(JUMP_S * 1e9)
        step_s = self._clock.slew_and_return_host_step(now_ns + ahead_ns, time.time_ns() + ahead_ns) / 1e9
        if abs(step_s) < MIN_CLOCK_STEP_S or self._driver.times_are_unix:
            return
        text = (
            f"the host clock was set {'forward' if step_s > 0.0 else 'back'} by {abs(step_s):.6g} s; sample times "
            f"follow by {MAX_SLEW_RATE * 3600.0:g} s per hour; restart imu-monitor to adopt the new time at once"
        )
        self._events.append(Event("clock_jumped", now_ns, text))

    def host_clock_offset_text(self) -> str:
        """Return a message about the offset of the sample times from the host clock, or "" if the offset is small."""
        behind_s = 0.0 if self._driver.times_are_unix else self._clock.lag_behind_host_ns / 1e9
        if abs(behind_s) < MIN_CLOCK_STEP_S:
            return ""
        where = "behind" if behind_s > 0.0 else "ahead of"
        return f"sample times are {abs(behind_s):.6g} s {where} the host clock, because the host clock was set"
