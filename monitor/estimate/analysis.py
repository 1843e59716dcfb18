"""A whole recording at once: the Allan curve, its intervals and the fitted coefficients; the live service's reference.

The recording is first put on a regular grid by the same clock that stamps live samples: what is missing becomes NaN in
its place, and everything found about the time stamps is said in ``notes``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.clock import JUMP_S, LONG_S, NS, SampleClock
from drivers.errors import NotReady
from drivers.line import made_rate
from drivers.sample import AXES, Floats, Given, Ints, SampleBlock
from monitor.estimate.batch import TauGrid, cluster_sizes, overlapping, slope
from monitor.estimate.curve import AllanCurve
from monitor.estimate.estimate import Estimate
from monitor.estimate.fit import design, fit
from monitor.estimate.fit_kernel import MIN_ROWS
from monitor.estimate.uncertainty import intervals, table

FEWEST: Final = 50
"""Samples; below this nothing can be said, and the command exits with status 3."""
OFF_RATE: Final = 0.02
"""A stated rate further than this from what the times say is told."""
LONGEST_HOLE: Final = 1_000_000
"""Missing samples kept in place, 48 bytes each; one stands for a longer pause, and keeps terms from reaching across."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """What ``imu-monitor analyze`` finds."""

    estimate: Estimate
    seconds: float
    notes: tuple[str, ...]


def analyze(
    blocks: Sequence[SampleBlock], rate_hz: float | None, tau: TauGrid = "octave", notes: Sequence[str] = ()
) -> Analysis:
    """The analysis of a recording.

    Args:
        blocks: the recording, with its own times
        rate_hz: the stated rate; None = found from the times
        tau: grid or list of averaging times, s
        notes: what reading the file found
    Raises:
        NotReady: fewer than FEWEST samples
        ConfigError: no τ of the list is possible
    """
    values, rate, found = on_grid(blocks, rate_hz)
    if len(values) < FEWEST:
        raise NotReady(f"{len(values)} samples; at least {FEWEST} are needed to say anything")
    factors = cluster_sizes(len(values), rate, tau)
    avar, terms = overlapping(values, factors)
    result = fit(design(factors, rate), table(len(values), factors), avar, terms, slope=slope(values) * rate)
    lo, hi = intervals(avar, result.edf)
    curve = AllanCurve(factors / rate, factors, avar, terms, result.edf, lo, hi, len(values))
    seconds = len(values) / rate
    received = sum(len(samples) for samples in blocks)
    newest_ns = int(blocks[-1].t_ns[-1])
    estimate = Estimate(newest_ns, rate, seconds, received, curve, result.fitted, result.coefficients)
    few = [f"{factors.size} averaging times are too few to fit five terms; at least {MIN_ROWS} are needed"]
    said = few if factors.size < MIN_ROWS else _left_out(result.left_out, curve.tau_s)
    return Analysis(estimate, seconds, (*notes, *found, *said))


def on_grid(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[Floats, float, list[str]]:
    """Values [n, 6] at a steady rate, missing samples NaN in their places; the rate; what was found about the times."""
    clock = SampleClock(Given(), rate_hz)
    stamped = [one for samples in blocks for one in clock.stamp(samples)]
    rate = rate_hz or _mean_rate(stamped)
    notes = [event.text for event in clock.take_events()[:10]] + _said_otherwise(stamped, rate)
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


def _said_otherwise(stamped: Sequence[SampleBlock], rate_hz: float) -> list[str]:
    """Where the steps of the times are steady, but not those of the rate."""
    steps_s = np.diff(np.concatenate([samples.t_ns for samples in stamped])) / NS
    low, middle, high = np.quantile(steps_s, [0.1, 0.5, 0.9]) if steps_s.size else (0.0, 0.0, 0.0)
    if middle <= 0.0 or high - low > OFF_RATE * middle or abs(middle * rate_hz - 1.0) < OFF_RATE:
        return []
    return [f"the rate used is {rate_hz:g} Hz, but the times step by {middle:.6g} s, {1.0 / middle:.6g} Hz"]


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


def _left_out(left_out: Ints, tau_s: Floats) -> list[str]:
    """On which axes the shortest τ contradict every sum of the five terms."""
    return [
        f"{axis}: the fit leaves out τ up to {tau_s[count - 1]:.3g} s, which no sum of the five terms follows: "
        "the sensor's bandwidth or a vibration shows there"
        for axis, count in zip(AXES, left_out.tolist(), strict=True)
        if count
    ]
