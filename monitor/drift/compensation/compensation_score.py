"""One judge for all ways of compensating: a rate before and after, at rest or beside a rate that is known.

A judge sees samples that taught nothing: a filter of samples up to now has learned from earlier ones only; whatever
learns from a whole recording is shown another part of it. Before compensation a rate is given the one correction that
costs nothing, its mean over what was learned from, so that no method is praised for taking out a constant.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.estimation.allan.batch import cluster_sizes, overlapping_axis

MINUTE_S: Final = 60.0
SPANS_S: Final = (60.0, 600.0, 3600.0)
"""Over which a mean rate is an error of heading."""


@dataclass(frozen=True, slots=True)
class AtRest:
    """One axis while the carrier rests; rad/s. What cannot be told of so short a record is NaN."""

    deviation: float  # rms about nothing
    worst_minute: float  # the largest rms of a minute
    drift: tuple[float, ...]  # rms of the means over SPANS_S
    tau_s: Floats
    allan: Floats


@dataclass(frozen=True, slots=True)
class InMotion:
    """One axis beside its known rate."""

    error: float  # rms, rad/s
    delay_s: float  # by which the rate comes late
    angle: float  # rms of the integrated error, rad


def at_rest(rate: Floats, rate_hz: float) -> AtRest:
    """How still a rate [n] is whose truth is nothing; NaN = missing, or not at rest."""
    sizes: Ints = cluster_sizes(rate.size, rate_hz)
    allan, _ = overlapping_axis(rate, sizes)
    minutes = _spans(rate**2, round(MINUTE_S * rate_hz))
    return AtRest(
        deviation=_rms(rate),
        worst_minute=float(np.sqrt(minutes.max())) if minutes.size else np.nan,
        drift=tuple(_rms(_spans(rate, round(span * rate_hz))) for span in SPANS_S),
        tau_s=sizes / rate_hz,
        allan=np.sqrt(allan),
    )


def in_motion(rate: Floats, truth: Floats, rate_hz: float) -> InMotion:
    """How near a rate [n] is to the true one, rad/s.

    >>> t = np.arange(1000) / 100.0
    >>> one = in_motion(np.sin(t - 0.02), np.sin(t), 100.0)
    >>> round(one.delay_s, 4)
    0.02
    """
    apart = np.where(np.isfinite(rate), rate - truth, 0.0)
    slope = np.gradient(truth) * rate_hz
    moved = float(slope @ slope)
    return InMotion(
        error=_rms(rate - truth),
        delay_s=-float(apart @ slope) / moved if moved > 0.0 else np.nan,
        angle=_rms(np.cumsum(apart) / rate_hz),
    )


def _spans(x: Floats, samples: int) -> Floats:
    """Means of spans one after the other, of which at least half is there."""
    count = x.size // samples if samples else 0
    if not count:
        return np.zeros(0)
    rows = x[: count * samples].reshape(count, samples)
    there = np.isfinite(rows).sum(axis=1)
    rows = rows[2 * there >= samples]
    return np.nanmean(rows, axis=1) if len(rows) else np.zeros(0)


def _rms(x: Floats) -> float:
    known = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan
