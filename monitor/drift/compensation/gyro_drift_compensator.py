"""Sample-by-sample compensation of the gyro drift of a vehicle that may be in motion.

The measured rate is z = ω + drift + noise. At rest, the true rate ω is zero, and the Kalman filter in ``sage_husa``
estimates the drift from interval means. In motion, the drift is predicted, and the filters in
``vehicle_rate_filter_bank`` smooth the remaining rate.

The motion detector decides with a delay whether the sensor was at rest. At most sample rates, the bias estimate is
therefore delayed by 0.5 s. The compensated rate is not delayed. The results do not depend on how the samples are
divided into calls.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import AXES, Floats, Ints
from drivers.errors import NotReady
from monitor.common.compiled import compiled
from monitor.drift.compensation import sage_husa
from monitor.drift.compensation.arma import ORDERS, ArmaModel, Order, fit_arma
from monitor.drift.compensation.vehicle_rate_filter_bank import (
    MIN_REST_INTERVALS,
    choose_memory_lengths,
    compute_gains_by_filter_age,
    correct_rates_for_bias_change,
    filter_rate_sample,
    predict_over_gap,
    update_rest_noise,
)
from monitor.estimation.detection import motion_kernel
from monitor.estimation.detection.motion_detection import samples_per_block

GYROS: Final = 3
"""Number of gyro axes, which are the first columns of the samples."""
BLOCKS_PER_INTERVAL: Final = 4
"""Number of motion detector blocks in an interval. An interval lasts 1 s, or longer at sample rates below 32 Hz."""
MIN_REST_BLOCKS: Final = 2
"""Minimum number of blocks at rest for which an interval counts as an interval at rest."""
MAX_PENDING_BLOCKS: Final = 4
"""Maximum number of blocks that wait for a decision of the motion detector."""
HISTORY_INTERVALS: Final = 2048
"""Number of intervals that are stored to identify a drift model."""
MIN_IDENTIFICATION_INTERVALS: Final = 60
"""Number of intervals at rest before a drift model is identified for the first time.

The identification is repeated whenever the number of intervals has grown by half.
"""
MAX_REST_RMS: Final = (0.02,) * 3 + (0.3,) * 3
"""Maximum standard deviation of the samples in a block at rest, in rad/s and m/s².

The limit is needed because the motion detector can adapt to permanent motion, for example in a car.
"""
MAX_BIAS_RAD_S: Final = 0.35
"""Maximum mean rate of a gyro at rest, 0.35 rad/s or 20 °/s."""
MAX_GAP_INTERVALS: Final = 100_000
"""Maximum number of missing intervals over which the drift is predicted."""

BLOCK_NUMBER, COUNT, ORIGIN, SUM, SQUARES = range(5)
"""Columns of ``CompensatorArrays.waiting``.

The columns are the block number, the number of samples, the origin, the sum and the sum of squares. Both sums are
relative to the origin.
"""
MEAN, EXPECTED, INNOVATION_STD, OUTCOME, EXPECTED_ERROR, SCATTER = range(6)
"""Columns of the results for an interval.

MEAN is the measured mean, or NaN if the sensor was not at rest. EXPECTED is the predicted drift, and INNOVATION_STD is
the predicted standard deviation of MEAN − EXPECTED. OUTCOME is an outcome that ``sage_husa`` defines, for example
REJECTED. EXPECTED_ERROR is the standard error of the prediction. SCATTER is the variance of MEAN, estimated from the
scatter within the interval.
"""


class CompensatorArrays(NamedTuple):
    """State of the compensator, stored in arrays for compiled code."""

    rest: motion_kernel.MotionState
    current: Ints  # [1] number of the current interval; -1 before the first interval
    learned: Ints  # [3] number of intervals at rest from which the filters have learned their noise
    drift: np.ndarray  # [3] records of type sage_husa.DRIFT_FILTER
    bias: Floats  # [3] bias that is currently subtracted, rad/s; NaN if not known yet
    bank: Floats  # [3, filters + 1, 5] columns are defined in ``vehicle_rate_filter_bank``
    ages: Ints  # [3, filters, 2] columns are defined in ``vehicle_rate_filter_bank``
    missing: Ints  # [3] number of missing samples since the last present sample
    feedback: Floats  # [3, 1] difference between input and output that must still be fed back
    waiting: Floats  # [MAX_PENDING_BLOCKS, 6, 5] sums over the blocks that wait for a decision
    sums: Floats  # [MAX_PENDING_BLOCKS, 3, filters + 1, 2] ``square_sums`` of each waiting block
    means: Floats  # [3, BLOCKS_PER_INTERVAL] block means in the interval, rad/s; NaN if not at rest
    followed: Floats  # [3, filters + 1, 2] ``square_sums`` over the blocks at rest in the interval
    samples: Floats  # [3] number of samples in the blocks at rest in the interval
    table: Floats  # [rows, 2] gains of all filters
    first: Ints  # [filters + 1] first row of each filter in ``table``
    decisions: Ints  # [2, MAX_PENDING_BLOCKS] scratch memory: block numbers, and 1 for blocks in motion
    episodes: Floats  # [MAX_PENDING_BLOCKS, 5] scratch memory that the motion detector requires


@dataclass(frozen=True, slots=True)
class MeasuredAndPredictedDrift:
    """Measured and predicted drift of three gyro axes in one interval, in rad/s."""

    end: int  # index of the first sample after the interval, counting missing samples
    mean: Floats  # [3] measured drift at rest; NaN if in motion
    expected: Floats  # [3] predicted drift; NaN if not known yet
    error: Floats  # [3] predicted standard deviation of ``mean - expected``
    outcome: Ints  # [3] NOT_AT_REST, USED, REJECTED or STEPPED, see ``sage_husa``
    known: Floats  # [3] standard error of ``expected``

    @property
    def innovation(self) -> Floats:
        """Return the normalised innovations [3], which are ``(mean - expected) / error``."""
        return (self.mean - self.expected) / self.error


class Compensator:
    """Drift compensator for the three gyro axes of a sensor.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    adapts : bool
        True to adapt the noise variances of the drift model continuously, False to keep the identified variances.
    orders : sequence of (p, q)
        ARMA orders among which the identification selects.

    Examples
    --------
    >>> one = Compensator(100.0)
    >>> still = np.random.default_rng(0).normal(0.0, 1e-3, (3000, 6)) + 0.02
    >>> out = np.concatenate([one.compensate(still[k : k + 50]) for k in range(0, 3000, 50)])
    >>> bool(out[1000:, :3].std() < 2e-4), bool(np.array_equal(out[:, 3:], still[:, 3:]))
    (True, True)
    """

    def __init__(self, rate_hz: float, adapts: bool = True, orders: Sequence[Order] = ORDERS) -> None:
        self.rate_hz = rate_hz
        self.block_samples = samples_per_block(rate_hz)
        self.interval_samples = BLOCKS_PER_INTERVAL * self.block_samples  # number of samples in an interval
        self.models: list[ArmaModel | None] = [None] * GYROS
        self._orders = tuple(orders)
        self._state = _initial_state(rate_hz, adapts)
        self.sample_count = 0  # number of received samples, including missing samples
        self._means = np.full((GYROS, HISTORY_INTERVALS), np.nan)  # ring buffer of interval means
        self._scatter = np.full((GYROS, HISTORY_INTERVALS), np.nan)
        self._interval_count = 0
        self._at_rest = np.zeros(GYROS, np.int64)
        self._next_identification = np.full(GYROS, MIN_IDENTIFICATION_INTERVALS)
        self._finished_intervals: list[MeasuredAndPredictedDrift] = []

    @property
    def interval_s(self) -> float:
        """Return the length of an interval in seconds."""
        return self.interval_samples / self.rate_hz

    @property
    def bias(self) -> Floats:
        """Return the bias [3] that is currently subtracted in rad/s, or NaN if it is not known yet."""
        return self._state.bias.copy()

    def compensate(self, values: Floats, lost: int = 0) -> Floats:
        """Remove the gyro drift from samples.

        Until the bias of a gyro axis is known, the rate of the axis is returned unchanged.

        Parameters
        ----------
        values : ndarray, shape (n, 6), float64
            Samples in rad/s and m/s², in the order of AXES; NaN means missing.
        lost : int
            Number of samples that are missing before ``values``.

        Returns
        -------
        ndarray, shape (n, 6), float64
            Compensated samples in rad/s and m/s². The accelerometer values are unchanged.
        """
        self._state.missing[:] += lost
        self.sample_count += lost
        out = np.array(values, dtype=np.float64, order="C")
        # Numba compiles a version for each memory layout and access flag, so the array is always contiguous and
        # read-only.
        values = np.ascontiguousarray(values, np.float64).view()
        values.flags.writeable = False
        # After missing samples, the motion detector decides on all waiting blocks at once. Each block may end an
        # interval.
        outcomes = np.empty((len(values) // self.interval_samples + 2 + MAX_PENDING_BLOCKS, 1 + 6 * GYROS))
        filled = _advance(values, self.sample_count, self.block_samples, self._state, out, outcomes)
        self.sample_count += len(values)
        for k in range(filled):
            self._record_interval(outcomes[k])
        return out

    def take_finished_intervals(self) -> list[MeasuredAndPredictedDrift]:
        """Return the results of the intervals that have ended since the last call."""
        outcomes, self._finished_intervals = self._finished_intervals, []
        return outcomes

    # --- identification

    @property
    def samples_to_interval_end(self) -> int:
        """Return the number of samples until the end of the current interval.

        If drift models are only changed at the end of an interval, results do not depend on the sizes of the input
        blocks.
        """
        return self.interval_samples - self.sample_count % self.interval_samples

    @property
    def axes_due_for_identification(self) -> tuple[int, ...]:
        """Return the indices of the axes whose drift model should now be identified."""
        return tuple(np.flatnonzero(self._at_rest >= self._next_identification).tolist())

    def means_and_noise_variance_for_identification(self, axis: int) -> tuple[Floats, float]:
        """Return the interval means and the noise variance from which a drift model is identified.

        Parameters
        ----------
        axis : int
            Index of the gyro axis, 0 to 2.

        Returns
        -------
        means : ndarray, shape (n,)
            Interval means in rad/s, oldest first; NaN means not at rest.
        white : float
            Variance of the white noise of an interval mean, (rad/s)².
        """
        z, scatter = self._history(axis)
        white = float(np.nanmean(scatter)) if np.isfinite(scatter).any() else 0.0
        return z, white

    def apply_identification_result(self, axis: int, identified_model: ArmaModel | None) -> None:
        """Replace the drift model of an axis, and filter all stored intervals again with the new model.

        Parameters
        ----------
        axis : int
            Index of the gyro axis, 0 to 2.
        identified_model : ArmaModel or None
            Identified drift model. None means that the identification has failed and is repeated later.
        """
        self._next_identification[axis] = self._at_rest[axis] + min(
            max(self._at_rest[axis], MIN_IDENTIFICATION_INTERVALS) // 2, HISTORY_INTERVALS
        )
        if identified_model is None:
            return
        self.models[axis] = identified_model
        drift = self._state.drift[axis]
        count = drift["rest_count"]
        sage_husa.restart_with_model(drift, identified_model)
        sage_husa.refilter_history(drift, *self._history(axis), _min_variance(self._state.rest.open, axis))
        drift["rest_count"] = count  # Filtering the stored intervals again must not count them twice.
        _update_bias(axis, self._state.drift, self._state.bias, self._state.bank)

    def identify_due_models(self) -> None:
        """Identify the drift models of all axes for which an identification is due."""
        for axis in self.axes_due_for_identification:
            try:
                self.apply_identification_result(
                    axis, fit_arma(*self.means_and_noise_variance_for_identification(axis), self._orders)
                )
            except NotReady:  # too few interval means, or all means are equal
                self.apply_identification_result(axis, None)

    # --- results of intervals

    def _history(self, axis: int) -> tuple[Floats, Floats]:
        """Return the stored means of an axis and their variances, oldest first."""
        count = min(self._interval_count, HISTORY_INTERVALS)
        order = np.arange(self._interval_count - count, self._interval_count) % HISTORY_INTERVALS
        return self._means[axis][order], self._scatter[axis][order]

    def _record_interval(self, outcomes: Floats) -> None:
        columns = outcomes[1:].reshape(GYROS, 6).T.copy()
        at = self._interval_count % HISTORY_INTERVALS
        became = columns[OUTCOME].astype(np.int64)
        self._means[became == sage_husa.STEPPED] = np.nan  # Older means belong to the bias before the step.
        used = (became == sage_husa.USED) | (became == sage_husa.STEPPED)
        self._means[:, at] = np.where(used, columns[MEAN], np.nan)
        self._scatter[:, at] = np.where(used, columns[SCATTER], np.nan)
        self._interval_count += 1
        self._at_rest += used
        end = int(outcomes[0] + 1) * self.interval_samples
        mean, expected, innovation_std, _, expected_error, _ = columns
        self._finished_intervals.append(
            MeasuredAndPredictedDrift(end, mean, expected, innovation_std, became, expected_error)
        )


def _initial_state(rate_hz: float, adapts: bool) -> CompensatorArrays:
    each = choose_memory_lengths(rate_hz)
    table, first = compute_gains_by_filter_age(each)
    filters = each.size
    drift = np.zeros(GYROS, sage_husa.DRIFT_FILTER)
    drift["adaptive"] = adapts
    return CompensatorArrays(
        rest=motion_kernel.make_motion_state(),
        current=np.full(1, -1, np.int64),
        learned=np.zeros(GYROS, np.int64),
        drift=drift,
        bias=np.full(GYROS, np.nan),
        bank=np.zeros((GYROS, filters + 1, 5)),
        ages=np.zeros((GYROS, filters, 2), np.int64),
        missing=np.zeros(GYROS, np.int64),
        feedback=np.zeros((GYROS, 1)),
        waiting=np.full((MAX_PENDING_BLOCKS, len(AXES), 5), -1.0),
        sums=np.zeros((MAX_PENDING_BLOCKS, GYROS, filters + 1, 2)),
        means=np.full((GYROS, BLOCKS_PER_INTERVAL), np.nan),
        followed=np.zeros((GYROS, filters + 1, 2)),
        samples=np.zeros(GYROS),
        table=table,
        first=first,
        decisions=np.zeros((2, MAX_PENDING_BLOCKS), np.int64),
        episodes=np.zeros((MAX_PENDING_BLOCKS, 5)),
    )


@compiled
def _advance(values: Floats, index: int, size: int, s: CompensatorArrays, out: Floats, outcomes: Floats) -> int:
    """Process samples, write the results of completed intervals, and return the number of these intervals."""
    keep = 0.5 / (2 << (s.ages.shape[1] - 1))
    filled, i, n = 0, 0, values.shape[0]
    while i < n:
        number = (index + i) // size
        end = min(n, (number + 1) * size - index)
        decisions = motion_kernel.advance_motion_detection(
            values[i:end], index + i, size, False, s.rest, s.decisions[0], s.decisions[1], s.episodes
        )
        for v in range(decisions[0]):
            filled += _apply_rest_decision(s.decisions[0, v], s.decisions[1, v] > 0, s, outcomes[filled])
        slot = number % MAX_PENDING_BLOCKS
        if s.waiting[slot, 0, BLOCK_NUMBER] != number:
            _begin_block(number, s.waiting[slot], s.sums[slot])
        for a in range(GYROS):
            _subtract_drift(values[i:end, a], a, s.sums[slot, a], s, keep, out[i:end, a])
        for a in range(len(AXES)):
            _accumulate(values[i:end, a], s.waiting[slot, a])
        i = end
    return filled


@compiled
def _begin_block(number: int, waiting: Floats, sums: Floats) -> None:
    for a in range(len(AXES)):
        waiting[a, BLOCK_NUMBER] = number
        for column in range(COUNT, SQUARES + 1):
            waiting[a, column] = 0.0
    for a in range(GYROS):
        for j in range(sums.shape[1]):
            sums[a, j, 0] = sums[a, j, 1] = 0.0


@compiled
def _subtract_drift(z: Floats, axis: int, sums: Floats, s: CompensatorArrays, keep: float, out: Floats) -> None:
    bank, ages, feedback = s.bank[axis], s.ages[axis], s.feedback[axis]
    bias = s.bias[axis] if s.bias[axis] == s.bias[axis] else 0.0
    trusted, missing = s.learned[axis] >= MIN_REST_INTERVALS, s.missing[axis]
    for k in range(z.size):
        if z[k] != z[k]:
            missing += 1
            out[k] = z[k]
            continue
        if missing > 0:
            predict_over_gap(bank, ages, missing)
            missing = 0
        rate = filter_rate_sample(z[k] - bias, bank, ages, s.table, s.first, sums, feedback, keep)
        if not trusted:
            rate, feedback[0] = z[k] - bias, 0.0
        out[k] = rate
    s.missing[axis] = missing


@compiled
def _accumulate(values: Floats, sums: Floats) -> None:
    """Add the values that are not NaN to the sums of a block."""
    for k in range(values.size):
        if values[k] != values[k]:
            continue
        if sums[COUNT] == 0.0:
            sums[ORIGIN] = values[k]
        off = values[k] - sums[ORIGIN]
        sums[COUNT] += 1.0
        sums[SUM] += off
        sums[SQUARES] += off * off


@compiled
def _apply_rest_decision(number: int, moves: bool, s: CompensatorArrays, outcomes: Floats) -> bool:
    """Process the decision of the motion detector on a block, and return True if the previous interval has ended."""
    interval = number // BLOCKS_PER_INTERVAL
    over = bool(s.current[0] >= 0 and interval > s.current[0])
    if over:
        _finish_interval(s, outcomes)
        for _ in range(min(interval - s.current[0] - 1, MAX_GAP_INTERVALS)):
            for a in range(GYROS):
                _predict_next_interval(a, s)
    s.current[0] = interval
    slot = number % MAX_PENDING_BLOCKS
    if moves or s.waiting[slot, 0, BLOCK_NUMBER] != number or _exceeds_rest_limits(s.waiting[slot]):
        return over
    for a in range(GYROS):
        count = s.waiting[slot, a, COUNT]
        if count > 0.0:
            s.means[a, number % BLOCKS_PER_INTERVAL] = s.waiting[slot, a, ORIGIN] + s.waiting[slot, a, SUM] / count
            s.samples[a] += count
            for j in range(s.followed.shape[1]):
                s.followed[a, j, 0] += s.sums[slot, a, j, 0]
                s.followed[a, j, 1] += s.sums[slot, a, j, 1]
    return over


@compiled
def _exceeds_rest_limits(waiting: Floats) -> bool:
    """Return True if the scatter or the mean rate in a block exceeds the limits for a sensor at rest."""
    for a in range(len(AXES)):
        n = waiting[a, COUNT]
        if n == 0.0:
            continue
        mean = waiting[a, SUM] / n
        if waiting[a, SQUARES] / n - mean * mean > MAX_REST_RMS[a] ** 2:
            return True
        if a < GYROS and abs(waiting[a, ORIGIN] + mean) > MAX_BIAS_RAD_S:
            return True
    return False


@compiled
def _finish_interval(s: CompensatorArrays, outcomes: Floats) -> None:
    """Complete the current interval, update the drift filters, and predict the drift in the next interval."""
    outcomes[0] = s.current[0]
    for a in range(GYROS):
        outcome = outcomes[1 + 6 * a : 7 + 6 * a]
        known = s.bias[a] == s.bias[a]
        for column in range(6):
            outcome[column] = np.nan
        outcome[EXPECTED], outcome[OUTCOME] = s.bias[a], sage_husa.NOT_AT_REST
        if known:
            outcome[EXPECTED_ERROR] = np.sqrt(sage_husa.expected_bias_and_variance(s.drift[a])[1])
        count, mean, scatter = _interval_mean(s.means[a])
        if count >= MIN_REST_BLOCKS:
            variance, became = sage_husa.update_with_interval(s.drift[a], mean, scatter, _min_variance(s.rest.open, a))
            outcome[MEAN], outcome[INNOVATION_STD] = mean, np.sqrt(variance)
            outcome[OUTCOME], outcome[SCATTER] = became, scatter
            if known and became == sage_husa.USED:
                s.learned[a] += 1
                update_rest_noise(s.bank[a], s.followed[a], s.samples[a], s.learned[a])
        else:
            sage_husa.discard_unconfirmed_level_in_motion(s.drift[a])
        _predict_next_interval(a, s)
        for b in range(BLOCKS_PER_INTERVAL):
            s.means[a, b] = np.nan
        for j in range(s.followed.shape[1]):
            s.followed[a, j, 0] = s.followed[a, j, 1] = 0.0
        s.samples[a] = 0.0


@compiled
def _interval_mean(means: Floats) -> tuple[int, float, float]:
    """Return the number of blocks at rest in an interval, their mean, and the variance of the mean.

    The variance is estimated from the differences between the means of neighbouring blocks.
    """
    count, total, apart, pairs = 0, 0.0, 0.0, 0
    for b in range(BLOCKS_PER_INTERVAL):
        if means[b] == means[b]:
            count, total = count + 1, total + means[b]
            if b and means[b - 1] == means[b - 1]:
                apart, pairs = apart + (means[b] - means[b - 1]) ** 2, pairs + 1
    return count, total / count if count else np.nan, 0.5 * apart / pairs / count if pairs else np.nan


@compiled
def _min_variance(blocks: Floats, axis: int) -> float:
    """Return the minimum variance of an interval mean, which follows from the quantization step."""
    return float(blocks[axis, motion_kernel.STEP] ** 2 / 12.0 / BLOCKS_PER_INTERVAL + motion_kernel.MIN_VARIANCE)


@compiled
def _predict_next_interval(axis: int, s: CompensatorArrays) -> None:
    if s.drift[axis]["rest_count"] >= sage_husa.MIN_CONFIRMED_INTERVALS:
        sage_husa.predict_next_interval(s.drift[axis])
        _update_bias(axis, s.drift, s.bias, s.bank)


@compiled
def _update_bias(axis: int, drifts: np.ndarray, biases: Floats, banks: Floats) -> None:
    now = sage_husa.expected_bias_and_variance(drifts[axis])[0]
    before = biases[axis] if biases[axis] == biases[axis] else 0.0
    correct_rates_for_bias_change(banks[axis], now - before)
    biases[axis] = now
