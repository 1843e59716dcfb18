"""Rate limiter that passes at most one event of each kind per second."""

from typing import Final

from drivers.data_types import NS_PER_S, Event

MIN_EVENT_INTERVAL_S: Final = 1.0
"""Minimum time in s between two events of the same kind."""


class EventRateLimiter:
    """Event queue that passes at most one event of each kind per MIN_EVENT_INTERVAL_S of sample time.

    Excess events are held back and counted in the next event of the same kind.
    """

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._last_ns: dict[str, int] = {}
        self._held_back: dict[tuple[str, str], tuple[int, str, int]] = {}

    def report_event(self, kind: str, t_ns: int, text: str, n: int = 0) -> None:
        """Add an event, or hold the event back if an event of the same kind was added recently.

        Parameters
        ----------
        kind : str
            Kind of the event.
        t_ns : int
            Time of the event in ns.
        text : str
            Text of the event. ``{n}`` is replaced by the sum of ``n`` over all combined events.
        n : int
            Number of affected rows.
        """
        key = (kind, text if "{n}" in text else "")
        held = self._held_back.pop(key, None)
        if "{n}" in text:
            n += held[2] if held else 0
        else:  # keep the text of the first event, and count the later events
            n = held[2] + 1 if held else 0
            text = held[1] if held else text
        self._held_back[key] = (t_ns, text, n)
        self.release_held_events(t_ns)

    def release_held_events(self, t_ns: int) -> None:
        """Release the held events whose waiting time has ended at the time ``t_ns``."""
        for (kind, what), (at_ns, text, n) in [*self._held_back.items()] if self._held_back else ():
            if kind not in self._last_ns or abs(t_ns - self._last_ns[kind]) >= MIN_EVENT_INTERVAL_S * NS_PER_S:
                del self._held_back[(kind, what)]
                self._last_ns[kind] = t_ns
                more = f", and {n} more events of this kind within one second" if n and "{n}" not in text else ""
                self._events.append(Event(kind, at_ns, text.replace("{n}", str(n)) + more))

    def take_events(self, ended: bool = False) -> list[Event]:
        """Remove and return the queued events. If ``ended`` is True, include all held events."""
        while ended and self._held_back:
            self._last_ns.clear()
            self.release_held_events(0)
        if ended:
            self._last_ns.clear()
        events, self._events = self._events, []
        return events
