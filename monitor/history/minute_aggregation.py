"""One device's results as they come, gathered into rows of a minute of the samples' own time. Pure.

A row is handed out when the first result of the next minute comes. A result a moment late is counted where the others
are; one of an older time, as when a clock was set back or a recording is played again, begins a row of its own, which
the store adds to the one that it has. What was gathered and not handed out when the process ends is lost: a minute at
most.
"""

from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.common.health import Health
from monitor.estimation.estimate import Estimate
from monitor.history.bucket import STATES, Extremes, Row, joined
from monitor.history.columns import HEALTH, TEMPERATURE, Numbers

MINUTE_S: Final = 60
LATE_S: Final = 5.0
"""Batches of samples and estimates of one moment are not told at one moment."""


class Minutes:
    """What has come of one device since the last full minute."""

    def __init__(self) -> None:
        self._numbers: Numbers | None = None
        self._start_s: int | None = None
        self._newest_s = 0.0
        self._estimates: Extremes | None = None
        self._health = Extremes(HEALTH)
        self._temperature = Extremes(TEMPERATURE)
        self._counted = (0, 0, 0, 0)  # at the last report, since the start
        self._counts = (0, 0, 0, 0)  # in this minute
        self._state = 0

    def estimate(self, unix_s: float, estimate: Estimate) -> Row | None:
        """One estimate; the row that is full with it."""
        full = self._turn(unix_s)
        if self._numbers is None or not self._numbers.fit(estimate):
            self._numbers = Numbers(estimate)
        if self._estimates is not None and self._estimates.names != self._numbers.names:
            start_s = self._start_s
            full = self._end()  # the store makes one row of both
            self._start_s, self._newest_s = start_s, unix_s
        if self._estimates is None:
            self._estimates = Extremes(self._numbers.names)
        self._estimates.add(self._numbers.of(estimate))
        return full

    def temperature(self, unix_s: float, temperature_c: Floats) -> Row | None:
        """A batch's temperatures [n] °C; NaN = not measured."""
        there = temperature_c[~np.isnan(temperature_c)]
        if not there.size:
            return None
        full = self._turn(unix_s)
        self._temperature.add(np.array([there.mean()]))
        return full

    def health(self, unix_s: float, health: Health) -> Row | None:
        """How the device does: counts since the start, of which what came since the last report is kept."""
        full = self._turn(unix_s)
        known = [np.nan if one is None else float(one) for one in (health.rate_hz, health.latency_p99_s)]
        self._health.add(np.array([*known, float(health.memory_bytes)]))
        counted = (health.received, health.lost, health.bad, health.overflowed)
        # smaller than before: counted from the start anew
        more = tuple(now - old if now >= old else now for now, old in zip(counted, self._counted, strict=True))
        self._counts = tuple(a + b for a, b in zip(self._counts, more, strict=True))  # type: ignore[assignment]
        self._counted = counted
        worst = STATES.index(health.state) if health.state in STATES else 0
        self._state = max(self._state, worst)
        return full

    def end(self) -> Row | None:
        """The row that is not full yet; None where nothing has come."""
        return self._end() if self._start_s is not None else None

    def _turn(self, unix_s: float) -> Row | None:
        """Go to the minute of a moment; the row that it leaves behind."""
        start_s = int(unix_s // MINUTE_S) * MINUTE_S
        if self._start_s is not None and self._start_s - LATE_S <= unix_s < self._start_s + MINUTE_S:
            self._newest_s = max(self._newest_s, min(unix_s, self._start_s + MINUTE_S))
            return None
        full = self.end()
        self._start_s, self._newest_s = start_s, unix_s
        return full

    def _end(self) -> Row:
        parts = [part for part in (self._estimates, self._health, self._temperature) if part is not None]
        parts = [part for part in parts if part.n.any()]
        assert self._start_s is not None
        row = joined(self._start_s, MINUTE_S, self._newest_s, parts or [self._health], self._counts, self._state)
        self._estimates, self._health, self._temperature = None, Extremes(HEALTH), Extremes(TEMPERATURE)
        self._counts, self._state, self._start_s = (0, 0, 0, 0), 0, None
        return row
