"""A recording on a regular grid: by the same clock that stamps live samples, what is missing is NaN in its place.

Rows that repeat others, time and values, are kept out. Rows that repeat the one before while time goes on stay, as they
are what the sensor's register held; their share is said, by what coarse resolution does not explain. Everything found
is said in notes, at most NOTES of one sort.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.clock import JUMP_S, LONG_S, SampleClock
from drivers.errors import NotReady
from drivers.line import made_rate
from drivers.order import NS
from drivers.sample import Floats, Given, SampleBlock

OFF_RATE: Final = 0.02
"""A stated rate further than this from what the times say is told."""
NOTES: Final = 10
"""Of the clock; what is beyond is counted."""
STALE_ROWS: Final = 1000
"""Rows within which noise is taken to be the same: the share of stale rows is the median over such stretches."""
STALE: Final = 0.01
"""A share below this is not told."""
LONGEST_HOLE: Final = 1_000_000
"""Missing samples kept in place, 48 bytes each; one stands for a longer pause, and keeps terms from reaching across."""


def on_grid(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[Floats, float, list[str]]:
    """Values [n, 6] at a steady rate, missing samples NaN in their places; the rate; what was found about the times."""
    clock = SampleClock(Given(), rate_hz)
    stamped = [one for samples in blocks for one in clock.stamp(samples)]
    rate = rate_hz or _mean_rate(stamped)
    told = [event.text for event in clock.take_events(ended=True)]
    notes = told[:NOTES] + _said_otherwise(stamped, rate) + _said_stale(stamped)
    if len(told) > NOTES:
        notes.insert(NOTES, f"and {len(told) - NOTES} more notes on the times")
    pieces: list[Floats] = []
    holes = missing = 0
    for samples in stamped:
        if samples.lost > LONGEST_HOLE:
            notes.append(f"a pause of {samples.lost / rate:.6g} s is too long to keep in place; no term reaches across")
            pieces.append(np.full((1, 6), np.nan))
        elif samples.lost:
            holes += 1
            missing += samples.lost
            pieces.append(np.full((samples.lost, 6), np.nan))
        pieces.append(samples.values)
    if holes:
        places = "1 place" if holes == 1 else f"{holes} places"
        notes.append(f"{missing} samples are missing in {places}; terms that touch them are left out")
    return np.concatenate(pieces), rate, notes


def stale_share(values: Floats) -> float:
    """Share of rows [n, 6] that repeat the one before because the sensor had not measured anew.

    Where a share s of rows is held, axis a repeats in p_a = s + (1 - s) q_a of the rows, q_a by its coarse resolution,
    and all axes at once in s + (1 - s) Π q_a, as noises of axes are independent: one equation for s. It takes two axes;
    with fewer the answer is 0.

    >>> noise = np.random.default_rng(0).normal(size=(5000, 6)).round()
    >>> stale_share(noise), round(stale_share(noise.repeat(2, axis=0)), 1)
    (0.0, 0.5)
    """
    there = ~np.isnan(values).all(axis=0)
    same = values[1:, there] == values[:-1, there]
    whole = ~np.isnan(values[1:, there] + values[:-1, there]).any(axis=1)
    same = same[whole]
    if same.shape[1] < 2 or not len(same):
        return 0.0
    shares = [_held(part.mean(axis=0), float(part.all(axis=1).mean())) for part in _stretches(same)]
    return float(np.median(shares))


def _stretches(rows: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    return np.array_split(rows, max(1, len(rows) // STALE_ROWS))


def _held(each: Floats, all_of_them: float) -> float:
    """The share s that solves all_of_them = s + (1 - s) Π (each - s)/(1 - s)."""
    low, high = 0.0, min(float(each.min()), all_of_them)
    explained = float(each.prod())
    if all_of_them <= explained + 3.0 * (explained / STALE_ROWS) ** 0.5 or each.max() == 1.0:
        return 0.0  # within its counting error; or an axis that never moves tells nothing
    for _ in range(40):
        middle = 0.5 * (low + high)
        by_chance = float(((each - middle) / (1.0 - middle)).prod()) if middle < 1.0 else 0.0
        low, high = (middle, high) if middle + (1.0 - middle) * by_chance < all_of_them else (low, middle)
    return low


def _said_stale(stamped: Sequence[SampleBlock]) -> list[str]:
    share = stale_share(np.concatenate([samples.values for samples in stamped]))
    if share < STALE:
        return []
    percent = 100.0 * share
    return [f"{percent:.2g} % of rows repeat the one before: the sensor updates slower than it is read; they are kept"]


def _said_otherwise(stamped: Sequence[SampleBlock], rate_hz: float) -> list[str]:
    """Where the times say another rate: by their steps if these are steady, else by their mean."""
    steps_s = np.diff(np.concatenate([samples.t_ns for samples in stamped])) / NS
    if not steps_s.size:
        return []
    low, middle, high = np.quantile(steps_s, [0.1, 0.5, 0.9])
    if middle > 0.0 and high - low <= OFF_RATE * middle:
        if abs(middle * rate_hz - 1.0) < OFF_RATE:
            return []
        return [f"the rate used is {rate_hz:g} Hz, but the times step by {middle:.6g} s, {1.0 / middle:.6g} Hz"]
    try:
        mean_hz = _mean_rate(stamped)
    except NotReady:
        return [f"the rate used is {rate_hz:g} Hz; the times do not go on and say none"]
    if abs(mean_hz / rate_hz - 1.0) < OFF_RATE:
        return []
    return [f"the rate used is {rate_hz:g} Hz, but by the times {mean_hz:.5g} samples came a second"]


def _mean_rate(stamped: Sequence[SampleBlock]) -> float:
    """Samples a second over the whole recording, missing ones included, where its times do not jump."""
    steps = np.diff(np.concatenate([samples.t_ns for samples in stamped])) / NS
    samples_each = np.ones(steps.size + 1, np.int64)
    starts = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    samples_each[starts] += [samples.lost for samples in stamped]
    steady = (steps > -JUMP_S) & (steps < LONG_S)
    n, span_s = int(samples_each[1:][steady].sum()), float(steps[steady].sum())
    if n < 1 or span_s <= 0.0:
        raise NotReady("the times of the recording do not go on, so that its rate is unknown; state it with --rate HZ")
    return made_rate(n / span_s)
