"""A whole recording at once: the Allan curve, its intervals and the fitted coefficients; the live service's reference.

The recording is first put on a regular grid by the same clock that stamps live samples: what is missing becomes NaN in
its place, and everything found about the time stamps is said in ``notes``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from drivers.errors import NotReady
from drivers.sample import AXES, Floats, Ints, SampleBlock
from monitor.estimate.batch import TauGrid, cluster_sizes, overlapping, slope, slopes
from monitor.estimate.curve import AllanCurve
from monitor.estimate.estimate import Estimate
from monitor.estimate.fit import design, fit
from monitor.estimate.fit_kernel import MIN_ROWS
from monitor.estimate.grid import on_grid
from monitor.estimate.uncertainty import intervals, table

FEWEST: Final = 50
"""Samples; below this nothing can be said, and the command exits with status 3."""


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
    result = fit(
        design(factors, rate),
        table(len(values), factors),
        avar,
        terms,
        slope=slope(values) * rate,
        slopes=slopes(values, factors) * rate,
    )
    lo, hi = intervals(avar, result.edf)
    curve = AllanCurve(factors / rate, factors, avar, terms, result.edf, lo, hi, len(values))
    seconds = len(values) / rate
    received = sum(len(samples) for samples in blocks)
    newest_ns = int(blocks[-1].t_ns[-1])
    estimate = Estimate(newest_ns, rate, seconds, received, curve, result.fitted, result.coefficients, result.k_or_r)
    few = [f"{factors.size} averaging times are too few to fit five terms; at least {MIN_ROWS} are needed"]
    said = few if factors.size < MIN_ROWS else _left_out(result.left_out, curve.tau_s)
    return Analysis(estimate, seconds, (*notes, *found, *said))


def _left_out(left_out: Ints, tau_s: Floats) -> list[str]:
    """On which axes the shortest τ contradict every sum of the five terms."""
    return [
        f"{axis}: the fit leaves out τ up to {tau_s[count - 1]:.3g} s, which no sum of the five terms follows: "
        "the sensor's bandwidth or a vibration shows there"
        for axis, count in zip(AXES, left_out.tolist(), strict=True)
        if count
    ]
