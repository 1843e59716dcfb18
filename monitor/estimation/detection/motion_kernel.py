"""Compiled part of the motion detector, which learns the noise at rest and decides whether each block is in motion.

A block of samples is described by the mean and the logarithm of the variance of each axis. The sample with the largest
deviation is excluded, so a single outlier does not count as motion. The reference consists of the medians and the
quartiles over the last ``REFERENCE_BLOCKS`` blocks at rest. Unusual blocks do not affect the reference if they are
fewer than a quarter.

A block is in motion if the variance of an axis is too large, or if the mean of an axis is too far from the reference.
If the mean stays constant at a new value, the orientation has changed, and the reference is shifted. A disturbance that
stays constant becomes the new reference. A much smaller variance also starts a new reference, because the old reference
must have been learned in motion.

A step of the noise level is not motion. If the signal has been stationary with zero mean since the beginning of an
episode, the episode is marked as ``NOISE``, and its blocks become the new reference.

A block of which less than half of the samples are present is neither at rest nor in motion. The blocks before and after
such blocks are treated as successive blocks, except that the change of the mean between them is not tested. Limits for
the mean and the variance of a block are computed from the number of its samples that are present.

The index of a sample determines its block, so decisions do not depend on how the samples are distributed over calls.
"""

from math import exp, inf, log, nan, sqrt
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.common.distributions import NORMAL_QUARTILE

AXES: Final = 6
GYROS: Final = 3
REFERENCE_BLOCKS: Final = 240
"""Maximum number of blocks in the reference.

The 240 blocks of 0.25 s take 60 s. A constant disturbance that lasts longer counts as rest.
"""
MIN_REFERENCE_BLOCKS: Final = 8
"""Minimum number of blocks at rest in a reference.

With this number, the limits are twice as wide as with a long reference.
"""
BAND: Final = 8.0
"""Maximum deviation of a block at rest from the reference, in standard deviations."""
LOUDER: Final = log(4.0)
"""Minimum increase of the log variance that counts as motion. The change detector reports smaller increases."""
LOUDEST: Final = log(100.0)
"""Increase of the log variance that always counts as motion."""
TOGETHER: Final = log(2.5)
"""Minimum increase of the log variance, averaged over all axes, that counts as weak motion."""
TOGGLE: Final = 0.25
"""Variance of a signal that alternates between two adjacent quantization levels, in squared quantization steps."""
DRIFT: Final = 100.0
"""Maximum deviation of a block mean at rest, relative to the deviation expected from the noise within blocks."""
QUIETER: Final = log(9.0)
"""Minimum decrease of the log variance below the lower quartile of the reference that starts a new reference.

At least half of the axes must be this quiet for ``MIN_REFERENCE_BLOCKS`` blocks.
"""
NEVER_AT_REST: Final = (0.1,) * 3 + (1.0,) * 3
"""Limits in rad/s and m/s² that the noise of a MEMS sensor does not exceed at rest.

Before a reference exists, the limits apply to the rms within a block and to the change of the mean between blocks.
"""
SETTLED: Final = 4
"""Number of successive blocks with a constant mean after which a new orientation is accepted."""
NEW_BIAS: Final = 0.035
"""Maximum bias change of a gyroscope after handling, in rad/s (2 °/s).

A larger change counts as rotation for the first ``SPUN`` blocks.
"""
SPUN: Final = 40
"""Number of blocks (10 s) after which a larger change of the bias is accepted, if nothing else indicates motion.

In this case, the reference must have been learned during rotation.
"""
REMOVED_AFTER: Final = 2
"""Number of blocks that are replaced after a moving block."""
EPISODE_GAP_BLOCKS: Final = 4
"""Number of blocks at rest that end an episode of motion."""
GROUP_BLOCKS: Final = 4
"""Number of blocks in a group, over which the stationarity of an episode is tested.

A sinusoid above 2 Hz has nearly the same mean and variance in all groups.
"""
MIN_NOISE_BLOCKS: Final = 16
"""Minimum number of stationary blocks (4 s) that distinguish a step of the noise level from motion.

If the rise exceeds ``LARGE_RISE``, twice the number is needed.
"""
LARGE_RISE: Final = log(400.0)
"""Increase of the log variance that is more likely a vibration of a few seconds than a step of the noise level."""
MAX_NOISE_BLOCKS: Final = 40
"""Maximum number of blocks (10 s) after which an episode can still turn out to be a step of the noise level."""
GROUP_SIGMA: Final = 3.0
"""Maximum deviation of the mean or log variance of a group from the average, in standard deviations of white noise."""
MIN_GROUP_SCATTER: Final = 0.3
"""Deviation of the log variance of a group that is always accepted, because real noise fluctuates more than χ²."""
MAX_GAP_BLOCKS: Final = 40
"""Maximum number of blocks (10 s) without samples within an episode. A longer gap ends the episode."""
LOOK_EVERY: Final = 20
"""Number of blocks after which the detector tests again whether a disturbance is constant."""
WANDER: Final = 4.0
"""Maximum scatter of the block means, relative to the scatter expected from the noise within blocks."""
WANDER_BESIDE_LINE: Final = 2.0
"""Maximum scatter of the block means beside a sinusoid of constant amplitude and frequency, relative as ``WANDER``."""
MIN_VARIANCE: Final = 1e-30
"""Variance that is assigned to a constant signal, because the logarithm of zero is not finite."""
MIN_BLOCK_SAMPLES: Final = 4
"""Minimum number of samples that a block must contain to be tested for motion."""

OPEN, HELD, HELD_MOVES, QUIET_RUN, BEGAN, LATEST, STILL, QUIET, RECENT, TURNED, MEASURED, BEGAN_RECENT = range(12)
"""Elements of ``MotionState.place``:

- ``OPEN``: number of the current block.
- ``HELD``, ``HELD_MOVES``: number of the block with a pending decision (-1 means none), and the decision.
- ``QUIET_RUN``: number of blocks at rest since the last moving block.
- ``BEGAN``, ``LATEST``: first (-1 means none) and latest moving block of the current episode.
- ``STILL``: number of successive blocks with a constant mean.
- ``QUIET``: number of successive blocks with a far smaller variance than the reference.
- ``RECENT``: total number of blocks of which enough samples are present.
- ``TURNED``: kind of the current episode, ``MOTION`` or ``TURN``.
- ``MEASURED``: number of the newest block of which enough samples are present.
- ``BEGAN_RECENT``: value of ``RECENT`` after the first moving block of the current episode.
"""
FIRST, LAST, KIND, AXIS, PEAK = range(5)
"""Columns of an episode: first and last moving block, kind, axis of the peak, size of the peak."""
MOTION, TURN, NOISE = range(3)
"""Kinds of episodes: motion, motion that changed the orientation, step of the noise level."""
LOG_VARIANCE, MEAN, PRESENT = range(3)
"""Indices of the block statistics in the first dimension of the ring buffers: ``PRESENT`` is a number of samples."""
COUNT, SHIFT, SUM, SQUARES, LOW, HIGH, BEFORE, STEP = range(8)
"""Columns of ``MotionState.open``:

- ``COUNT``: number of samples.
- ``SHIFT``: first sample.
- ``SUM``, ``SQUARES``: sums of the deviations from the first sample, and of the squared deviations.
- ``LOW``, ``HIGH``: minimum and maximum.
- ``BEFORE``: previous sample.
- ``STEP``: smallest difference of successive samples since the start.
"""


class MotionState(NamedTuple):
    """State of the motion detector."""

    place: Ints  # [12] counters and flags, at the indices from OPEN to BEGAN_RECENT
    open: Floats  # [6, 8] current block, with the columns from COUNT to STEP
    seen: Ints  # [6] total number of blocks that were added to the reference
    shifted: Floats  # [6] sum of the shifts of the mean caused by new orientations
    ring: Floats  # [2, 6, REFERENCE_BLOCKS] ring buffer of the log variance and the mean of blocks at rest
    ordered: Floats  # [2, 6, REFERENCE_BLOCKS] sorted values of ``ring``
    recent: Floats  # [3, 6, REFERENCE_BLOCKS] ring buffer of the statistics of all recent blocks
    peaks: Floats  # [2, 6] largest deviation in the current episode, in SI units and relative to the noise


def make_motion_state() -> MotionState:
    """Return the initial state of the motion detector."""
    place = np.zeros(12, np.int64)
    place[[HELD, BEGAN, MEASURED]] = -1
    place[QUIET_RUN] = EPISODE_GAP_BLOCKS
    fresh = np.zeros((AXES, 8))
    fresh[:, BEFORE] = np.nan
    rings = [np.full((kinds, AXES, REFERENCE_BLOCKS), np.nan) for kinds in (2, 2, 3)]
    return MotionState(
        place, fresh, np.zeros(AXES, np.int64), np.zeros(AXES), rings[0], rings[1], rings[2], np.zeros((2, AXES))
    )


@compiled
def advance_motion_detection(
    values: Floats,
    first_index: int,
    block_samples: int,
    stream_ends: bool,
    s: MotionState,
    blocks: Ints,
    moving: Ints,
    episodes: Floats,
) -> Ints:
    """Process consecutive samples, and write new decisions and completed episodes of motion to the output arrays.

    Parameters
    ----------
    values : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    first_index : int
        Index of the first sample, counting missing samples.
    block_samples : int
        Number of samples in a block.
    stream_ends : bool
        True at the end of the stream, to decide on the last block and to end the current episode.
    s : MotionState
        State of the motion detector, updated in place.
    blocks, moving : ndarray of int64, shape (at least n/size + 2,)
        Output arrays for the number of each decided block, and for the decision, which is 1 for motion.
    episodes : ndarray of float64, shape (at least n/size + 2, 5)
        Output array for completed episodes, with the columns ``FIRST``, ``LAST``, ``KIND``, ``AXIS`` and ``PEAK``.

    Returns
    -------
    ndarray of int64, shape (2,)
        Number of new decisions, and number of completed episodes.
    """
    filled = np.zeros(2, np.int64)
    for i in range(values.shape[0]):
        number = (first_index + i) // block_samples
        if number != s.place[OPEN]:
            _close(block_samples, s, blocks, moving, episodes, filled)
            s.place[OPEN] = number
        for a in range(AXES):
            value = values[i, a]
            if value != value:
                continue
            step = abs(value - s.open[a, BEFORE])
            if step > 0.0 and (step < s.open[a, STEP] or s.open[a, STEP] == 0.0):
                s.open[a, STEP] = step
            s.open[a, BEFORE] = value
            if s.open[a, COUNT] == 0.0:
                s.open[a, SHIFT], s.open[a, SUM], s.open[a, SQUARES] = value, 0.0, 0.0
                s.open[a, LOW], s.open[a, HIGH] = inf, -inf
            off = value - s.open[a, SHIFT]
            s.open[a, COUNT] += 1.0
            s.open[a, SUM] += off
            s.open[a, SQUARES] += off * off
            s.open[a, LOW] = min(s.open[a, LOW], value)
            s.open[a, HIGH] = max(s.open[a, HIGH], value)
    if stream_ends:
        _close(block_samples, s, blocks, moving, episodes, filled)
        _emit(s, blocks, moving, filled)
        s.place[HELD] = -1
        if s.place[BEGAN] >= 0:
            _end(s, episodes, filled)
    return filled


@compiled
def _close(size: int, s: MotionState, blocks: Ints, moving: Ints, episodes: Floats, filled: Ints) -> None:
    number = s.place[OPEN]
    now, measured = np.empty((3, AXES)), False
    for a in range(AXES):
        now[LOG_VARIANCE, a] = now[MEAN, a] = nan
        now[PRESENT, a] = s.open[a, COUNT]
        if 2.0 * s.open[a, COUNT] >= size and s.open[a, COUNT] >= MIN_BLOCK_SAMPLES:
            _measure(a, s, now)
            measured = True
    if measured:
        _decide(now, number, size, s, episodes, filled)
    _emit(s, blocks, moving, filled)
    s.place[HELD], s.place[HELD_MOVES] = number, s.place[QUIET_RUN] <= REMOVED_AFTER
    for a in range(AXES):
        s.open[a, COUNT] = 0.0


@compiled
def _decide(now: Floats, number: int, size: int, s: MotionState, episodes: Floats, filled: Ints) -> None:
    """Decide on a block, and end the current episode if the sensor is at rest again."""
    if s.place[BEGAN] >= 0 and number - s.place[MEASURED] > MAX_GAP_BLOCKS:
        _end(s, episodes, filled)
        s.place[QUIET_RUN] = EPISODE_GAP_BLOCKS
    moves = _judge(now, s.place[MEASURED] == number - 1, s)
    s.place[MEASURED] = number
    if moves:
        _remember(now, number, s)
        s.place[HELD_MOVES] |= s.place[HELD] == number - 1
    _learn(now, moves, size, s)
    lasted = s.place[RECENT] - s.place[BEGAN_RECENT]  # without the first block, which contains the onset
    if s.place[BEGAN] >= 0 and MIN_NOISE_BLOCKS <= lasted <= MAX_NOISE_BLOCKS and _stationary(lasted, s):
        _begin_anew(lasted, s)
        s.place[TURNED] = NOISE
        _end(s, episodes, filled)
    s.place[QUIET_RUN] = 0 if moves else min(s.place[QUIET_RUN] + 1, EPISODE_GAP_BLOCKS)
    if s.place[BEGAN] >= 0 and s.place[QUIET_RUN] == EPISODE_GAP_BLOCKS:
        if s.place[TURNED] == MOTION and lasted <= MAX_NOISE_BLOCKS and _still_loud(size, s):
            s.place[QUIET_RUN] -= 1
        else:
            _end(s, episodes, filled)


@compiled
def _measure(a: int, s: MotionState, now: Floats) -> None:
    """Compute the log variance and the mean of one axis, excluding the sample with the largest deviation."""
    n = s.open[a, COUNT]
    mean = s.open[a, SUM] / n
    square = s.open[a, SQUARES] - n * mean * mean
    mean += s.open[a, SHIFT]
    high, low = s.open[a, HIGH] - mean, s.open[a, LOW] - mean
    furthest = high if high > -low else low
    square = max(square - furthest * furthest * n / (n - 1.0), 0.0)
    mean -= furthest / (n - 1.0)
    floor = s.open[a, STEP] ** 2 / 12.0  # variance of the quantization error
    now[LOG_VARIANCE, a] = log(square / (n - 2.0) + floor + MIN_VARIANCE)
    now[MEAN, a] = mean
    floor = log(floor + MIN_VARIANCE)
    if s.ordered[LOG_VARIANCE, a, 0] < floor:  # the quantization step was unknown when these values were learned
        for ring in (s.ordered, s.ring, s.recent):
            for k in range(REFERENCE_BLOCKS):
                if ring[LOG_VARIANCE, a, k] < floor:
                    ring[LOG_VARIANCE, a, k] = floor


# --- decision


@compiled
def _judge(now: Floats, follows: bool, s: MotionState) -> bool:
    """Return True if a block is in motion. If the orientation has changed, the reference is shifted."""
    loud, off, rotates = False, False, False
    still = follows
    before = (s.place[RECENT] - 1) % REFERENCE_BLOCKS
    judged, rises, excess = 0, 0.0, 0.0
    for a in range(AXES):
        if now[MEAN, a] != now[MEAN, a]:
            continue
        change = abs(now[MEAN, a] - s.recent[MEAN, a, before]) if follows else 0.0
        n = min(s.seen[a], REFERENCE_BLOCKS)
        if n < MIN_REFERENCE_BLOCKS:
            loud |= now[LOG_VARIANCE, a] > 2.0 * log(NEVER_AT_REST[a]) or change > NEVER_AT_REST[a]
            continue
        young = 1.0 + MIN_REFERENCE_BLOCKS / n
        step = s.open[a, STEP]
        middle = _quantile(s.ordered[LOG_VARIANCE, a], n, 0.5)
        # The standard deviation of ln(χ²/ν) is approximately √(2/ν).
        sigma = min(max(_scatter(s.ordered[LOG_VARIANCE, a], n), sqrt(2.0 / (now[PRESENT, a] - 2.0))), LOUDEST / BAND)
        loud |= exp(now[LOG_VARIANCE, a]) > exp(middle + young * max(LOUDER, BAND * sigma)) + step * step
        rise = log(max(exp(now[LOG_VARIANCE, a]) - TOGGLE * step * step, MIN_VARIANCE)) - middle
        rise = min(max(rise, -LOUDEST), LOUDEST)
        judged, rises, excess = judged + 1, rises + rise / young, excess + rise / sigma / young
        band = young * _band(a, n, now[PRESENT, a], s) + step
        far = now[MEAN, a] - _quantile(s.ordered[MEAN, a], n, 0.5)
        off |= abs(far) > band
        rotates |= a < GYROS and abs(far + s.shifted[a]) > max(band, NEW_BIAS)
        still &= change < band
    loud |= rises > TOGETHER * judged and excess > BAND * sqrt(judged)
    s.place[STILL] = s.place[STILL] + 1 if still and not loud else 0
    if off and not loud and s.place[STILL] >= (SPUN if rotates else SETTLED):
        _take_over(now, s)
        if rotates:
            for a in range(AXES):
                s.shifted[a] = 0.0
        off = False
    return loud or off


@compiled
def _band(a: int, n: int, present: float, s: MotionState) -> float:
    """Return the maximum deviation of a block mean at rest from the median of the reference."""
    explained = exp(0.5 * _quantile(s.ordered[LOG_VARIANCE, a], n, 0.5)) / sqrt(present)
    return BAND * min(max(_scatter(s.ordered[MEAN, a], n), explained), DRIFT / BAND * explained)


@compiled
def _take_over(now: Floats, s: MotionState) -> None:
    """Shift the means of the reference to the current means without changing their scatter."""
    for a in range(AXES):
        n = min(s.seen[a], REFERENCE_BLOCKS)
        if now[MEAN, a] == now[MEAN, a] and n > 0:
            shift = now[MEAN, a] - _quantile(s.ordered[MEAN, a], n, 0.5)
            for k in range(REFERENCE_BLOCKS):
                s.ordered[MEAN, a, k] += shift
                s.ring[MEAN, a, k] += shift
            s.shifted[a] += shift
    s.place[TURNED] = 1


# --- learning


@compiled
def _learn(now: Floats, moves: bool, size: int, s: MotionState) -> None:
    newest = s.place[RECENT] % REFERENCE_BLOCKS
    s.place[RECENT] += 1
    quieter = measured = 0
    for a in range(AXES):
        for kind in range(3):
            s.recent[kind, a, newest] = now[kind, a]
        n = min(s.seen[a], REFERENCE_BLOCKS)
        if now[MEAN, a] != now[MEAN, a]:
            continue
        measured += 1
        quieter += (
            n >= MIN_REFERENCE_BLOCKS
            and now[LOG_VARIANCE, a] < _quantile(s.ordered[LOG_VARIANCE, a], n, 0.25) - QUIETER
        )
        if not moves:
            _insert(a, now[LOG_VARIANCE, a], now[MEAN, a], s)
    s.place[QUIET] = s.place[QUIET] + 1 if measured and 2 * quieter >= measured else 0
    blocks = 0
    if s.place[QUIET] == MIN_REFERENCE_BLOCKS:
        blocks = MIN_REFERENCE_BLOCKS
        s.place[QUIET] = 0
    lasted = s.place[RECENT] - s.place[BEGAN_RECENT] + 1
    if moves and lasted >= REFERENCE_BLOCKS and lasted % LOOK_EVERY == 0 and _steady(size, s):
        blocks = REFERENCE_BLOCKS
    if blocks > 0:
        _begin_anew(blocks, s)


@compiled
def _insert(a: int, log_variance: float, mean: float, s: MotionState) -> None:
    at, n = s.seen[a] % REFERENCE_BLOCKS, min(s.seen[a], REFERENCE_BLOCKS)
    for kind in range(2):
        value, ordered = log_variance if kind == LOG_VARIANCE else mean, s.ordered[kind, a]
        place = n
        if n == REFERENCE_BLOCKS:
            place = _rank(ordered, n, s.ring[kind, a, at])
        while place > 0 and ordered[place - 1] > value:
            ordered[place] = ordered[place - 1]
            place -= 1
        while place < n - 1 and ordered[place + 1] < value:
            ordered[place] = ordered[place + 1]
            place += 1
        ordered[place] = value
        s.ring[kind, a, at] = value
    s.seen[a] += 1
    if at == REFERENCE_BLOCKS - 1:
        s.shifted[a] = 0.0


@compiled
def _rank(ordered: Floats, n: int, value: float) -> int:
    low, high = 0, n - 1
    while low < high:
        middle = (low + high) // 2
        if ordered[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@compiled
def _begin_anew(blocks: int, s: MotionState) -> None:
    """Discard the reference, and learn a new reference from the most recent blocks."""
    for a in range(AXES):
        s.seen[a], s.shifted[a] = 0, 0.0
        for kind in range(2):
            for k in range(REFERENCE_BLOCKS):
                s.ring[kind, a, k] = s.ordered[kind, a, k] = nan
    for back in range(blocks, 0, -1):
        k = (s.place[RECENT] - back) % REFERENCE_BLOCKS
        for a in range(AXES):
            if s.recent[MEAN, a, k] == s.recent[MEAN, a, k]:
                _insert(a, s.recent[LOG_VARIANCE, a, k], s.recent[MEAN, a, k], s)


@compiled
def _steady(size: int, s: MotionState) -> bool:
    """Return True if the signal has been statistically constant during the last ``REFERENCE_BLOCKS`` blocks.

    The two halves of the blocks must agree, and there must be no bursts of noise and no drift of the mean. A sinusoid
    of constant amplitude and frequency is no drift.
    """
    half, ordered = REFERENCE_BLOCKS // 2, np.empty(REFERENCE_BLOCKS)
    for a in range(AXES):
        n = _sort_recent(s, MEAN, a, 0, REFERENCE_BLOCKS, ordered)
        if n == 0:
            continue
        if REFERENCE_BLOCKS - n > REFERENCE_BLOCKS // 10:
            return False
        scatter = 0.5 * (_interpolate(ordered, n, 0.75) - _interpolate(ordered, n, 0.25)) / NORMAL_QUARTILE
        scatter_without_line = (
            _scatter_without_line(a, _median(ordered, n), s) if scatter < NEVER_AT_REST[a] else scatter
        )
        n = _sort_recent(s, LOG_VARIANCE, a, 0, REFERENCE_BLOCKS, ordered)
        middle = _median(ordered, n)
        louder = 0
        for k in range(n):
            louder += ordered[k] > middle + 2.0 * LOUDER
        if louder > REFERENCE_BLOCKS // 50:
            return False
        explained = exp(0.5 * middle) / sqrt(size) + s.open[a, STEP]
        if scatter > WANDER * explained and scatter_without_line > WANDER_BESIDE_LINE * explained:
            return False
        for kind in range(2):
            early = _median(ordered, _sort_recent(s, kind, a, 0, half, ordered))
            late = _median(ordered, _sort_recent(s, kind, a, half, REFERENCE_BLOCKS, ordered))
            if abs(early - late) > (0.5 * LOUDER if kind == LOG_VARIANCE else WANDER * explained):
                return False
    return True


@compiled
def _scatter_without_line(a: int, middle: float, s: MotionState) -> float:
    """Return the standard deviation of the recent block means beside a sinusoid of constant amplitude and frequency.

    A sinusoid x of angular frequency ω satisfies x[k − lag] + x[k + lag] = 2 cos(ω lag) x[k]. The factor of x[k] is
    estimated by least squares. The mean of the sinusoid is ``middle``. Blocks without enough samples are not in
    ``recent``, so that the values around them have another lag and increase the scatter.
    """
    lag = REFERENCE_BLOCKS // 4
    n, xx, xy, yy = 0, 0.0, 0.0, 0.0
    for k in range(lag, REFERENCE_BLOCKS - lag):
        newest = s.place[RECENT] + k
        x = s.recent[MEAN, a, newest % REFERENCE_BLOCKS] - middle
        y = -2.0 * middle
        for beside in (newest - lag, newest + lag):
            y += s.recent[MEAN, a, beside % REFERENCE_BLOCKS]
        if x * y == x * y:
            n, xx, xy, yy = n + 1, xx + x * x, xy + x * y, yy + y * y
    if xx == 0.0:
        return inf
    factor = xy / xx
    return sqrt(max(yy - factor * xy, 0.0) / n / (2.0 + factor * factor))


@compiled
def _stationary(blocks: int, s: MotionState) -> bool:
    """Return True if the most recent blocks have a constant variance and the mean of the reference on all axes."""
    groups = blocks // GROUP_BLOCKS
    means, variances, present = np.empty((3, groups))
    for a in range(AXES):
        if s.seen[a] < MIN_REFERENCE_BLOCKS:
            return False
        for g in range(groups):
            n, samples, total, squares, within = 0, 0.0, 0.0, 0.0, 0.0
            for back in range(g * GROUP_BLOCKS + 1, (g + 1) * GROUP_BLOCKS + 1):
                k = (s.place[RECENT] - back) % REFERENCE_BLOCKS
                mean = s.recent[MEAN, a, k] - s.ordered[MEAN, a, 0]
                if mean == mean:
                    n += 1
                    samples += s.recent[PRESENT, a, k]
                    total += s.recent[PRESENT, a, k] * mean
                    squares += s.recent[PRESENT, a, k] * mean * mean
                    within += s.recent[PRESENT, a, k] * exp(s.recent[LOG_VARIANCE, a, k])
            if n < GROUP_BLOCKS - 1:
                return False
            means[g], present[g] = total / samples, samples
            variances[g] = (within + max(squares - samples * means[g] ** 2, 0.0)) / samples
        n = min(s.seen[a], REFERENCE_BLOCKS)
        learned = _scatter(s.ordered[MEAN, a], n)
        rest = _quantile(s.ordered[MEAN, a], n, 0.5) - s.ordered[MEAN, a, 0]
        level = log(np.mean(variances))
        rise = level - _quantile(s.ordered[LOG_VARIANCE, a], n, 0.5)
        if level > 2.0 * log(NEVER_AT_REST[a]) or (rise > LARGE_RISE and blocks < 2 * MIN_NOISE_BLOCKS):
            return False
        for g in range(groups):
            band = GROUP_SIGMA * max(learned, sqrt(np.mean(variances) / present[g])) + s.open[a, STEP]
            scatter = max(GROUP_SIGMA * sqrt(2.0 / present[g]), MIN_GROUP_SCATTER)
            if abs(means[g] - rest) > band or abs(log(variances[g]) - level) > scatter:
                return False
    return True


@compiled
def _still_loud(size: int, s: MotionState) -> bool:
    """Return True if the variance of an axis is still higher than in the reference, but too low to count as motion."""
    for a in range(AXES):
        n = min(s.seen[a], REFERENCE_BLOCKS)
        if n < MIN_REFERENCE_BLOCKS:
            continue
        level = 0.0
        for back in range(1, GROUP_BLOCKS + 1):
            level += s.recent[LOG_VARIANCE, a, (s.place[RECENT] - back) % REFERENCE_BLOCKS] / GROUP_BLOCKS
        usual = max(0.5 * LOUDER, GROUP_SIGMA * sqrt(2.0 / (GROUP_BLOCKS * size)))
        if level > _quantile(s.ordered[LOG_VARIANCE, a], n, 0.5) + usual:
            return True
    return False


@compiled
def _sort_recent(s: MotionState, kind: int, a: int, begin: int, end: int, ordered: Floats) -> int:
    """Write the recent values except NaN to ``ordered`` in ascending order, and return the number of values."""
    n = 0
    for k in range(begin, end):
        value = s.recent[kind, a, (s.place[RECENT] + k) % REFERENCE_BLOCKS]
        if value == value:
            place = n
            while place > 0 and ordered[place - 1] > value:
                ordered[place] = ordered[place - 1]
                place -= 1
            ordered[place] = value
            n += 1
    return n


@compiled
def _median(ordered: Floats, n: int) -> float:
    return 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]) if n > 0 else nan


@compiled
def _interpolate(ordered: Floats, n: int, p: float) -> float:
    rank = (n - 1) * p
    lower = int(rank)
    share = rank - lower
    return float(ordered[lower] * (1.0 - share) + ordered[min(lower + 1, n - 1)] * share)


@compiled
def _quantile(ordered: Floats, n: int, p: float) -> float:
    """Return a quantile of the first n values of a sorted array, without interpolation."""
    return float(ordered[int(p * (n - 1) + 0.5)])


@compiled
def _scatter(ordered: Floats, n: int) -> float:
    """Return the standard deviation, estimated from the median and the quartile that is farther from it."""
    low, middle, high = _quantile(ordered, n, 0.25), _quantile(ordered, n, 0.5), _quantile(ordered, n, 0.75)
    return max(high - middle, middle - low) / NORMAL_QUARTILE


# --- output


@compiled
def _remember(now: Floats, number: int, s: MotionState) -> None:
    if s.place[BEGAN] < 0:
        s.place[BEGAN], s.place[TURNED], s.place[BEGAN_RECENT] = number, 0, s.place[RECENT] + 1
        for a in range(AXES):
            s.peaks[0, a] = s.peaks[1, a] = 0.0
    s.place[LATEST] = number
    for a in range(AXES):
        n = min(s.seen[a], REFERENCE_BLOCKS)
        if s.open[a, COUNT] == 0.0:
            continue
        learned = n >= MIN_REFERENCE_BLOCKS
        middle = _quantile(s.ordered[MEAN, a], n, 0.5) if learned else now[MEAN, a]
        noise = exp(0.5 * _quantile(s.ordered[LOG_VARIANCE, a], n, 0.5)) if learned else NEVER_AT_REST[a]
        peak = max(s.open[a, HIGH] - middle, middle - s.open[a, LOW])
        if peak > s.peaks[0, a]:
            s.peaks[0, a] = peak
        s.peaks[1, a] = max(s.peaks[1, a], peak / noise)


@compiled
def _emit(s: MotionState, blocks: Ints, moving: Ints, filled: Ints) -> None:
    if s.place[HELD] >= 0:
        blocks[filled[0]], moving[filled[0]] = s.place[HELD], s.place[HELD_MOVES]
        filled[0] += 1


@compiled
def _end(s: MotionState, episodes: Floats, filled: Ints) -> None:
    axis = 0
    for a in range(1, AXES):
        if s.peaks[1, a] > s.peaks[1, axis]:
            axis = a
    episode = episodes[filled[1]]
    episode[FIRST], episode[LAST] = s.place[BEGAN], s.place[LATEST]
    episode[KIND], episode[AXIS], episode[PEAK] = s.place[TURNED], axis, s.peaks[0, axis]
    filled[1] += 1
    s.place[BEGAN] = -1
