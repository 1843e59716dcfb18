"""Quality of a compensated rate at rest, by one measure for all methods.

The evaluated samples must not have been used for learning. A filter that uses only past samples fulfils this condition.
A method that learns from a whole recording is evaluated on another part of it. The rate before compensation is
corrected by its mean over the learning part, so that no method is credited with the removal of a constant.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats, Ints
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar_axis

MINUTE_S: Final = 60.0
"""One minute in seconds."""
SPANS_S: Final = (60.0, 600.0, 3600.0)
"""Time spans in seconds over which the mean rate is evaluated, because it is an error of heading."""


@dataclass(frozen=True, slots=True)
class RestScore:
    """Quality of one axis at rest, in rad/s. Values that the record is too short for are NaN."""

    rms: float  # rms about zero
    worst_minute: float  # largest rms of a minute
    drift: tuple[float, ...]  # rms of the means over each of SPANS_S
    tau_s: Floats  # [k] averaging times
    allan: Floats  # [k] overlapping Allan deviation


def score_at_rest(rate: Floats, rate_hz: float) -> RestScore:
    """Return the quality of a rate whose true value is zero.

    Parameters
    ----------
    rate : ndarray, shape (n,)
        Rate in rad/s; NaN = missing, or not at rest.
    rate_hz : float
        Sample rate in Hz.
    """
    sizes: Ints = cluster_sizes(rate.size, rate_hz)
    allan, _ = overlapping_avar_axis(rate, sizes)
    minutes = _span_means(rate**2, round(MINUTE_S * rate_hz))
    return RestScore(
        rms=_rms(rate),
        worst_minute=float(np.sqrt(minutes.max())) if minutes.size else np.nan,
        drift=tuple(_rms(_span_means(rate, round(span * rate_hz))) for span in SPANS_S),
        tau_s=sizes / rate_hz,
        allan=np.sqrt(allan),
    )


def _span_means(x: Floats, samples: int) -> Floats:
    """Return the means of successive spans of which at least half of the samples are known."""
    count = x.size // samples if samples else 0
    if not count:
        return np.zeros(0)
    rows = x[: count * samples].reshape(count, samples)
    known_count = np.isfinite(rows).sum(axis=1)
    rows = rows[2 * known_count >= samples]
    return np.nanmean(rows, axis=1) if len(rows) else np.zeros(0)


def _rms(x: Floats) -> float:
    """Return the rms of the known values."""
    known = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan
