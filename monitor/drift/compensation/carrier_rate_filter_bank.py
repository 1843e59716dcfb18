"""Rate of a carrier that may move at any time: a bank of filters with the "current" statistical model.

Each filter follows Zhou & Kumar 1984, with the one-step prediction as the mean of the acceleration (Yuan et al. 2010).
The state is [ω, ω̇] with the transition matrix [[1, T], [0, 1]]. For αT ≪ 1, the process noise is white noise of
intensity 2ασ_a² in ω̈. The manoeuvre frequency α and the variance σ_a² appear only in this product. If time is measured
in samples and the noise of the measured rate has unit variance, the product is a single number q. The number q
determines the gains and the memory of the filter.

σ_a² adapts to the motion. Filters with memories of 2, 4, 8, … samples run in parallel. At every sample the output comes
from the filter with the least estimated error, or from the measured rate itself. The mean square error of a filter is
the noise variance of its output plus the increase of its mean square residual (Mallows' C_p, Technometrics 15, 1973).
The noise variance and the usual residual are learned at rest, where the rate is zero. The method therefore assumes
neither white noise nor any other noise model. A residual beyond GATE standard deviations excludes a filter immediately,
and resets the filter if it persists.

A change between filters would cause an error of the integrated angle. The difference between input and output is
therefore accumulated and slowly added to the output.
"""

from math import inf, log2, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled, inlined

MAX_MEMORY_S: Final = 10.0
RESIDUAL_MEMORY: Final = 64.0
"""Time constant of the exponential average of a residual, in samples."""
GATE: Final = 5.0
"""Largest residual, in standard deviations at rest."""
MAX_GATE_EXCEEDANCES: Final = 3
"""Successive samples beyond the gate after which a filter is reset."""
SETTLING_SAMPLES: Final = (6, 48)
"""Age after a reset at which a filter has reached the steady gains: a multiple of its memory, and a minimum in
samples."""
MIN_REST_INTERVALS: Final = 5
"""Intervals at rest before the output of the filters is used."""
NOISE_MEMORY_INTERVALS: Final = 60
"""Time constant of the exponential average of the noise, in intervals at rest."""
DIFFUSE_VARIANCE: Final = 1e12
"""Variance of an unknown state, relative to the variance of a sample."""

RATE, SLOPE, RESIDUAL, NOISE, REST_RESIDUAL = range(5)
"""Columns of ``bank``: ω, ω̇ per sample, recent mean square residual, variance of the estimate at rest, and mean square
residual at rest. The first row describes the measured rate itself, of which only NOISE is used."""
AGE, EXCEEDANCES = range(2)
"""Columns of ``ages``: samples since the reset of a filter, and successive samples beyond the gate."""


def choose_memory_lengths(rate_hz: float) -> Ints:
    """Return the filter memories in samples: 2, 4, 8, … up to about MAX_MEMORY_S.

    >>> choose_memory_lengths(4.0).tolist()
    [2, 4, 8, 16, 32]
    """
    return np.asarray(2 ** np.arange(1, max(round(log2(MAX_MEMORY_S * rate_hz)), 1) + 1), dtype=np.int64)


def process_noise_intensity(memory_samples: int) -> float:
    """Return the noise intensity 2ασ_a² of a filter that reduces the noise variance by the factor ``memory_samples``.

    Time is measured in samples, and the noise of the measured rate has unit variance. For the intensity q, the steady
    gain is about √2 q^¼, and the variance of the output is 3/4 of the gain.
    """
    return (4.0 / (3.0 * memory_samples) / sqrt(2.0)) ** 4


def compute_gain_table(memories: Ints) -> tuple[Floats, Ints]:
    """Return one table with the gains of all filters, and the first row of each filter.

    The table [rows, 2] has the gains of ω and ω̇, with one row for each age of a filter in samples. The last row of a
    filter has the steady gains. ``memories`` are the memories of the filters in samples.
    """
    tables = [
        _gains(process_noise_intensity(int(memory)), max(SETTLING_SAMPLES[0] * int(memory), SETTLING_SAMPLES[1]))
        for memory in memories
    ]
    return np.concatenate(tables), np.cumsum([0, *(len(one) for one in tables)])


@compiled
def _gains(q: float, rows: int) -> Floats:
    """Return the gains [rows, 2] of a filter with an unknown initial state by the Riccati recursion."""
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
    """Process one sample of one axis, and return the filtered rate.

    Parameters
    ----------
    unbiased_rate : float
        Measured rate minus the bias, rad/s.
    bank : ndarray, shape (filters + 1, 5)
        State of the filters. It is updated in place.
    ages : ndarray, shape (filters, 2), int64
        Ages and gate exceedances of the filters. They are updated in place.
    gains, first_gain_rows : ndarray
        Gains and first rows as ``compute_gain_table`` returns them.
    square_sums : ndarray, shape (filters + 1, 2)
        Sums of the squares of estimate and residual. They are updated in place, and used later if the sample was at
        rest.
    feedback : ndarray, shape (1,)
        Accumulated difference of input and output, in rad/s times samples. It is updated in place.
    feedback_share : float
        Share of the feedback that is added to the output in each sample.

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
    """Advance the filters over missing samples.

    Filters predict along their slopes. Filters with a memory shorter than the gap are reset.

    Parameters
    ----------
    bank : ndarray, shape (filters + 1, 5)
        State of the filters. It is updated in place.
    ages : ndarray, shape (filters, 2), int64
        Ages and gate exceedances of the filters. They are updated in place.
    missing_samples : int
        Number of missing samples.
    """
    for j in range(ages.shape[0]):
        if missing_samples >= 2 << j:
            ages[j, AGE] = ages[j, EXCEEDANCES] = 0
            bank[j + 1, SLOPE] = 0.0
        else:
            bank[j + 1, RATE] += missing_samples * bank[j + 1, SLOPE]


@compiled
def apply_bias_change(bank: Floats, bias_change: float) -> None:
    """Correct the filters after the estimate of the bias has changed.

    Parameters
    ----------
    bank : ndarray, shape (filters + 1, 5)
        State of the filters. It is updated in place.
    bias_change : float
        Increase of the bias, rad/s.
    """
    for j in range(1, bank.shape[0]):
        bank[j, RATE] -= bias_change


@compiled
def update_rest_noise(bank: Floats, square_sums: Floats, sample_count: float, rest_intervals: int) -> None:
    """Update the noise at rest with an interval that was at rest.

    Parameters
    ----------
    bank : ndarray, shape (filters + 1, 5)
        State of the filters. It is updated in place.
    square_sums : ndarray, shape (filters + 1, 2)
        Sums of ``filter_rate_sample`` over the samples of the interval.
    sample_count : float
        Number of these samples.
    rest_intervals : int
        Number of intervals at rest so far, including this one.
    """
    share = max(1.0 / NOISE_MEMORY_INTERVALS, 1.0 / rest_intervals)
    for j in range(bank.shape[0]):
        bank[j, NOISE] += share * (square_sums[j, 0] / sample_count - bank[j, NOISE])
        bank[j, REST_RESIDUAL] += share * (square_sums[j, 1] / sample_count - bank[j, REST_RESIDUAL])
