"""Estimate the angular rate of a moving vehicle with a bank of Kalman filters.

Each filter uses the "current" statistical model of Zhou & Kumar (1984) with the mean acceleration of Yuan et al.
(2010). The filter state consists of the rate ω and its derivative, and the transition matrix is [[1, T], [0, 1]]. If
the manoeuvre frequency α satisfies αT ≪ 1, the process noise is white noise of intensity q = 2ασ_a², where σ_a² is the
acceleration variance. The intensity q determines the gains and the memory length of a filter.

Filters with memory lengths of 2, 4, 8, … samples run in parallel. The filter with the smallest estimated error
determines the output. If no filter has a smaller error than the measured rate, the measured rate is returned. The
estimated mean square error is the noise variance of the output plus the increase of the mean square residual (Mallows'
C_p, Technometrics 15, 1973). The noise variance and the usual residual are measured at rest, so no noise model is
needed. A filter is not used while its residual exceeds GATE standard deviations.

Switching between filters would cause an error of the integrated angle. To prevent this error, the difference between
input and output is accumulated and slowly added to the output.
"""

from math import inf, log2, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled, inlined

MAX_MEMORY_S: Final = 10.0
RESIDUAL_MEMORY: Final = 64.0
"""Time constant of the exponential average of squared residuals, in samples."""
GATE: Final = 5.0
"""Maximum residual of a filter in use, in standard deviations at rest."""
MAX_GATE_EXCEEDANCES: Final = 3
"""Number of successive samples beyond GATE after which a filter is reset."""
SETTLING_SAMPLES: Final = (6, 48)
"""Minimum age at which a filter uses the steady-state gains, in memory lengths and in samples."""
MIN_REST_INTERVALS: Final = 5
"""Number of intervals at rest that are required before the output of the filters is used."""
NOISE_MEMORY_INTERVALS: Final = 60
"""Time constant of the exponential average of the noise at rest, in intervals."""
DIFFUSE_VARIANCE: Final = 1e12
"""Initial variance of an unknown state, relative to the variance of a sample."""

RATE, SLOPE, RESIDUAL, NOISE, REST_RESIDUAL = range(5)
"""Columns of ``bank``.

The columns are ω, the change of ω per sample, the recent mean square residual, the variance of the estimate at rest,
and the mean square residual at rest. The first row of ``bank`` belongs to the measured rate.
"""
AGE, EXCEEDANCES = range(2)
"""Columns of ``ages``: number of samples since the reset of a filter, and number of successive samples beyond GATE."""


def choose_memory_lengths(rate_hz: float) -> Ints:
    """Return the memory lengths of the filters in samples: 2, 4, 8, … up to about MAX_MEMORY_S.

    >>> choose_memory_lengths(4.0).tolist()
    [2, 4, 8, 16, 32]
    """
    return np.asarray(2 ** np.arange(1, max(round(log2(MAX_MEMORY_S * rate_hz)), 1) + 1), dtype=np.int64)


def process_noise_intensity(memory_samples: int) -> float:
    """Return the process noise intensity with which a filter divides the noise variance by ``memory_samples``.

    Time is in units of samples, and the noise of the measured rate has unit variance. For the intensity q, the
    steady-state gain is about √2 q^¼, and the variance of the filter output is 3/4 of the gain.
    """
    return (4.0 / (3.0 * memory_samples) / sqrt(2.0)) ** 4


def compute_gains_by_filter_age(memories: Ints) -> tuple[Floats, Ints]:
    """Return a table with the gains of all filters, and the index of the first row that belongs to each filter.

    The table has the shape (rows, 2) and contains the gains of ω and its derivative. Row i of a filter applies i
    samples after the filter was started. The last row of each filter contains the steady-state gains.
    """
    tables = [
        _gains(process_noise_intensity(int(memory)), max(SETTLING_SAMPLES[0] * int(memory), SETTLING_SAMPLES[1]))
        for memory in memories
    ]
    return np.concatenate(tables), np.cumsum([0, *(len(one) for one in tables)])


@compiled
def _gains(q: float, rows: int) -> Floats:
    """Compute the gains [rows, 2] of a filter with an unknown initial state by the Riccati recursion."""
    out = np.empty((rows, 2))
    p00, p01, p11 = DIFFUSE_VARIANCE, 0.0, DIFFUSE_VARIANCE
    for k in range(rows):
        s = p00 + 1.0
        g0, g1 = p00 / s, p01 / s
        out[k, 0], out[k, 1] = g0, g1
        a00, a01, a11 = p00 - g0 * p00, p01 - g0 * p01, p11 - g1 * p01
        p00, p01, p11 = a00 + 2.0 * a01 + a11 + q / 3.0, a01 + a11 + q / 2.0, a11 + q
    return out


@inlined
def filter_rate_sample(
    unbiased_rate: float,
    bank: Floats,
    ages: Ints,
    gains: Floats,
    first_gain_rows: Ints,
    square_sums: Floats,
    feedback: Floats,
    feedback_share: float,
) -> float:
    """Filter one sample of a gyro axis with all filters, and return the filtered rate.

    Parameters
    ----------
    unbiased_rate : float
        Measured rate minus the bias, rad/s.
    bank : ndarray, shape (filters + 1, 5)
        State of all filters, updated in place.
    ages : ndarray, shape (filters, 2), int64
        Ages and GATE exceedances of all filters, updated in place.
    gains, first_gain_rows : ndarray
        Results of ``compute_gains_by_filter_age``.
    square_sums : ndarray, shape (filters + 1, 2)
        Sums of squared estimates and squared residuals, updated in place.
    feedback : ndarray, shape (1,)
        Accumulated difference between input and output, in rad/s times samples, updated in place.
    feedback_share : float
        Share of the accumulated difference that is added to the output with each sample.

    Returns
    -------
    float
        Filtered rate, rad/s.
    """
    least, rate = bank[0, NOISE], unbiased_rate
    square_sums[0, 0] += unbiased_rate * unbiased_rate
    for j in range(ages.shape[0]):
        at = min(first_gain_rows[j] + ages[j, AGE], first_gain_rows[j + 1] - 1)
        ages[j, AGE] += 1
        ahead = bank[j + 1, RATE] + bank[j + 1, SLOPE]
        new = unbiased_rate - ahead
        now = ahead + gains[at, 0] * new
        bank[j + 1, RATE] = now
        bank[j + 1, SLOPE] += gains[at, 1] * new
        square = (now - unbiased_rate) * (now - unbiased_rate)
        usual = bank[j + 1, REST_RESIDUAL]
        gate = GATE * GATE * usual if usual > 0.0 else inf
        bounded = min(square, gate)
        recent = bank[j + 1, RESIDUAL] + (bounded - bank[j + 1, RESIDUAL]) / RESIDUAL_MEMORY
        bank[j + 1, RESIDUAL] = recent
        square_sums[j + 1, 0] += now * now
        square_sums[j + 1, 1] += bounded
        if square > gate:
            ages[j, EXCEEDANCES] += 1
            if ages[j, EXCEEDANCES] >= MAX_GATE_EXCEEDANCES:
                bank[j + 1, RATE], bank[j + 1, SLOPE], ages[j, AGE], ages[j, EXCEEDANCES] = unbiased_rate, 0.0, 1, 0
            continue
        ages[j, EXCEEDANCES] = 0
        error = bank[j + 1, NOISE] + recent - usual
        if error < least:
            least, rate = error, now
    rate += feedback_share * feedback[0]
    feedback[0] += unbiased_rate - rate
    return float(rate)


@compiled
def predict_over_gap(bank: Floats, ages: Ints, missing_samples: int) -> None:
    """Predict the state of the filters over missing samples.

    A filter is reset if the gap is at least as long as its memory length.

    Parameters
    ----------
    bank : ndarray, shape (filters + 1, 5)
        State of all filters, updated in place.
    ages : ndarray, shape (filters, 2), int64
        Ages and GATE exceedances of all filters, updated in place.
    missing_samples : int
        Number of missing samples.
    """
    for j in range(ages.shape[0]):
        if missing_samples >= 2 << j:
            ages[j, AGE] = ages[j, EXCEEDANCES] = 0
            bank[j + 1, SLOPE] = 0.0
            # The first estimates after the reset are the measured rates, so the measured rate is preferred at first.
            bank[j + 1, RESIDUAL] = max(bank[j + 1, RESIDUAL], bank[j + 1, REST_RESIDUAL] + bank[0, NOISE])
        else:
            bank[j + 1, RATE] += missing_samples * bank[j + 1, SLOPE]


@compiled
def correct_rates_for_bias_change(bank: Floats, bias_change: float) -> None:
    """Correct the rates of the filters after the bias estimate has changed.

    Parameters
    ----------
    bank : ndarray, shape (filters + 1, 5)
        State of all filters, updated in place.
    bias_change : float
        Increase of the bias estimate, rad/s.
    """
    for j in range(1, bank.shape[0]):
        bank[j, RATE] -= bias_change


@compiled
def update_rest_noise(bank: Floats, square_sums: Floats, sample_count: float, rest_intervals: int) -> None:
    """Update the noise estimates of the filters after an interval at rest.

    Parameters
    ----------
    bank : ndarray, shape (filters + 1, 5)
        State of all filters, updated in place.
    square_sums : ndarray, shape (filters + 1, 2)
        Sums that ``filter_rate_sample`` accumulated over the interval.
    sample_count : float
        Number of samples in the interval.
    rest_intervals : int
        Number of intervals at rest so far, including this interval.
    """
    share = max(1.0 / NOISE_MEMORY_INTERVALS, 1.0 / rest_intervals)
    for j in range(bank.shape[0]):
        bank[j, NOISE] += share * (square_sums[j, 0] / sample_count - bank[j, NOISE])
        bank[j, REST_RESIDUAL] += share * (square_sums[j, 1] / sample_count - bank[j, REST_RESIDUAL])
