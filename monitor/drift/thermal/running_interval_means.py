"""Interval means of samples as they come: those that ``interval_means`` makes of a whole recording, sums alone kept.

Comes in: blocks in order, with how many samples are missing before each. Goes out: every interval when it is over. An
interval is so many samples, missing ones included; rows are gathered up to a part of an interval before they are
summed, so how samples were cut into blocks makes no difference.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.drift.thermal.interval_means import MOSTLY, PARTS

GATHERED: Final = 1024
"""Rows at most before they are summed."""
WARMTH: Final = len(AXES)
"""Column of the temperature, after those of the axes."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Means of one interval."""

    bias: Floats  # [6] rad/s and m/s²; NaN where too little was there
    error: Floats  # [6] standard error of each
    temperature_c: float  # NaN where too little was there
    end: int  # samples since the start that were over with it, missing ones included


class RunningMeans:
    """Means of successive intervals.

    Args:
        length: samples an interval, PARTS at least
        longest: empty intervals at most that one hole leaves; more would say no more

    >>> means = RunningMeans(50)
    >>> ramp = np.repeat(np.arange(100.0)[:, None], 6, axis=1)
    >>> [(one.bias[0].item(), one.temperature_c) for one in means.update(ramp, np.full(100, 25.0), 0)]
    [(24.5, 25.0), (74.5, 25.0)]
    """

    def __init__(self, length: int, longest: int = 1000) -> None:
        size = length // PARTS
        self._length = length
        self._longest = longest
        self._edges = [*(size * k for k in range(1, PARTS)), size * PARTS, length]  # what is left over has no part
        self._rows = np.empty((GATHERED, WARMTH + 1))
        self._filled = 0
        self._origin = np.full(WARMTH + 1, np.nan)  # a mean of 9.81 with noise of 1e-4 keeps its digits
        self._end = 0  # of the intervals that are over
        self._begin()

    def update(self, values: Floats, temperature_c: Floats, lost: int) -> list[Interval]:
        """The intervals that are over: of ``lost`` missing samples, then values [n, 6] and temperature [n] in °C."""
        over = self._skip(lost) if lost else []
        at = 0
        while at < len(values):
            count = min(len(values) - at, GATHERED - self._filled, self._edges[self._part] - self._place)
            rows = slice(self._filled, self._filled + count)
            self._rows[rows, :WARMTH] = values[at : at + count]
            self._rows[rows, WARMTH] = temperature_c[at : at + count]
            self._filled += count
            at += count
            over += self._pass(count)
        return over

    def forget(self) -> None:
        """What the interval so far says of the axes; its temperature stays."""
        self._rows[: self._filled, :WARMTH] = np.nan
        self._sum[:, :WARMTH], self._count[:, :WARMTH] = 0.0, 0

    def _begin(self) -> None:
        self._place = self._part = 0
        self._sum = np.zeros((PARTS + 1, WARMTH + 1))
        self._count = np.zeros((PARTS + 1, WARMTH + 1), np.int64)

    def _pass(self, count: int) -> list[Interval]:
        """So many samples have passed: sum up at a part's end, and close at an interval's."""
        self._place += count
        if self._filled == GATHERED or self._place == self._edges[self._part]:
            self._gather()
        while self._part < PARTS and self._place == self._edges[self._part]:
            self._part += 1
        if self._place < self._length:
            return []
        self._end += self._length
        closed = self._closed()
        self._begin()
        return [closed]

    def _gather(self) -> None:
        rows, self._filled = self._rows[: self._filled], 0
        there = np.isfinite(rows)
        new = there.any(axis=0) & np.isnan(self._origin)
        if new.any():
            self._origin[new] = rows[there.argmax(axis=0), np.arange(WARMTH + 1)][new]
        self._sum[self._part] += np.where(there, rows - self._origin, 0.0).sum(axis=0)
        self._count[self._part] += there.sum(axis=0)

    def _skip(self, lost: int) -> list[Interval]:
        over: list[Interval] = []
        while lost and self._place:
            count = min(lost, self._edges[self._part] - self._place)
            lost -= count
            if self._filled:
                self._gather()
            over += self._pass(count)
        if not lost:
            return over
        whole, self._place = divmod(lost, self._length)
        nothing = np.full(WARMTH, np.nan)
        for left in range(min(whole, self._longest) - 1, -1, -1):
            over.append(Interval(nothing, nothing, np.nan, self._end + (whole - left) * self._length))
        self._end += whole * self._length
        while self._part < PARTS and self._place >= self._edges[self._part]:
            self._part += 1
        return over

    def _closed(self) -> Interval:
        count = self._count.sum(axis=0)
        few = count < max(MOSTLY * self._length, 1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = self._origin + self._sum.sum(axis=0) / count
            apart = np.diff(self._sum[:PARTS, :WARMTH] / self._count[:PARTS, :WARMTH], axis=0)
            both = np.isfinite(apart)
            square = np.where(both, apart, 0.0) ** 2
            error = np.sqrt(0.5 * square.sum(axis=0) / both.sum(axis=0) / PARTS)
        mean[few], error[few[:WARMTH]] = np.nan, np.nan
        return Interval(mean[:WARMTH], error, float(mean[WARMTH]), self._end)
