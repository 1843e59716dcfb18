"""Quality of a compensated rate beside a known true rate."""

from dataclasses import dataclass

import numpy as np

from drivers.data_types import Floats


@dataclass(frozen=True, slots=True)
class MotionScore:
    """Quality of one axis beside its known true rate."""

    rms_error: float  # rms, rad/s
    delay_s: float  # delay of the rate
    angle_error_rad: float  # rms of the integrated error, rad


def score_in_motion(rate: Floats, truth: Floats, rate_hz: float) -> MotionScore:
    """Return the quality of a rate beside the true rate.

    Parameters
    ----------
    rate : ndarray, shape (n,)
        Rate in rad/s; NaN = missing.
    truth : ndarray, shape (n,)
        True rate in rad/s.
    rate_hz : float
        Sample rate in Hz.

    Examples
    --------
    >>> t = np.arange(1000) / 100.0
    >>> one = score_in_motion(np.sin(t - 0.02), np.sin(t), 100.0)
    >>> round(one.delay_s, 4)
    0.02
    """
    difference = np.where(np.isfinite(rate), rate - truth, 0.0)
    slope = np.gradient(truth) * rate_hz
    moved = float(slope @ slope)
    return MotionScore(
        rms_error=_rms(rate - truth),
        delay_s=-float(difference @ slope) / moved if moved > 0.0 else np.nan,
        angle_error_rad=_rms(np.cumsum(difference) / rate_hz),
    )


def _rms(x: Floats) -> float:
    """Return the rms of the known values."""
    known = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan
