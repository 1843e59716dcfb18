"""Change of the Allan deviation over time that exceeds the statistical uncertainty, for heat maps."""

import numpy as np

from drivers.data_types import Floats


def log_change_beyond_chance(log_deviation: Floats, log_lo: Floats, log_hi: Floats) -> Floats:
    """Return the part of the change from the median over time that lies outside the 95 % interval.

    At long averaging times, an Allan deviation often differs from its median by a factor of 2 by chance. The value is
    therefore the logarithmic distance of the median from the nearer end of the interval, and 0 inside the interval.

    Parameters
    ----------
    log_deviation : ndarray of float64, shape (t, m, k)
        Natural logarithm of the Allan deviation of k axes at m averaging times and t times. NaN if it is missing.
    log_lo, log_hi : ndarray of float64, shape (t, m, k)
        Natural logarithms of the ends of the 95 % interval.

    Examples
    --------
    >>> deviation = np.log([[[1.0]], [[1.0]], [[3.0]]])
    >>> change = log_change_beyond_chance(deviation, deviation - np.log(1.5), deviation + np.log(1.5))
    >>> np.exp(change).round(2).ravel().tolist()
    [1.0, 1.0, 2.0]
    """
    there = np.isfinite(log_deviation)
    median = np.full(there.shape[1:], np.nan)
    known = there.any(axis=0)
    median[known] = np.nanmedian(log_deviation[:, known], axis=0)
    change = np.fmax(log_lo - median, 0.0) + np.fmin(log_hi - median, 0.0)
    return np.where(there, change, np.nan)
