"""Compiled kernel of the change detector: Haar differences, cumulative sums (CUSUM) and alarms.

Samples are processed in ticks of 32 samples. The kernel stops when a decision about an alarm is due, so the decision
does not depend on the division of the input into blocks.

- **Cascade.** Octave j combines the means of two successive blocks of m = 2^j samples to a Haar difference z = (mean −
  mean')/√2. The mean square of z is the Allan variance at cluster size m. For white noise and random walk, all z are
  independent. The cost is two additions per sample and axis.
- **Evidence.** Let S be the sum of the n squares z² since the start of the reference, and S₁ the sum of the n₁ squares
  since a suspected change. The log-likelihood ratio of "variance multiplied by r" and "no change" is called the
  evidence g:

      g = −(n/2) ln(1 − (1 − 1/r) S₁/S) − (n₁/2) ln r.

  The evidence does not depend on the unknown variance. With a long reference, g is Page's CUSUM. Without a change, the
  mean of e^g is 1, so the probability of an alarm at threshold h within k tests is at most k e^−h (Shiryaev–Roberts).
  If g ≤ 0, the suspected change is set to the current sample.
- **Non-Gaussian and correlated noise.** z² is clipped at ``CLIP`` times the reference variance, which corresponds to
  4σ. For Gaussian noise, clipping affects a share of 6e-5 of the values and reduces the mean by 2e-4. The evidence is
  divided by the factor F, the variance of sums of z² relative to independent Gaussian z. Heavy tails, spectral lines
  and coarse resolution increase F.
- **Steps** are detected by comparing a pair of blocks with the next but one pair. The pair in between may contain the
step.
"""

from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled

AXES: Final = 6
RATIOS: Final = np.array([1.2, 1.44, 2.25, 1 / 1.2, 1 / 1.44, 1 / 2.25])
"""Ratios of the variance after and before a change for which the evidence is computed."""
GAIN: Final = 1.0 - 1.0 / RATIOS
"""The factor 1 − 1/r of each ratio r."""
HALF_LOG: Final = 0.5 * np.log(RATIOS)
"""The term ½ ln r of each ratio r."""
TICK_SAMPLES: Final = 32
"""Number of samples in a tick. The evidence is updated once per tick, because logarithms are slow."""
SHORT: Final = 5
"""Number of octaves that are shorter than a tick."""
RAREST: Final = 1e-6
"""Minimum share of extreme values in the reference."""
HUGE: Final = 1e150
"""Absolute value at or above which samples count as missing, because their square overflows."""
CLIP: Final = 16.0
"""Maximum of z² relative to the reference variance. Larger values are clipped."""
EXTREME: Final = 36.0
"""Ratio of z² to the reference variance above which a difference is an outlier.

The limit is 6σ, which a share of 2e-9 of Gaussian values exceeds.
"""
MEDIAN: Final = 0.45494
"""Median of χ² with one degree of freedom."""
SEED: Final = 31
"""Number of first z² of an octave. The median of these values determines the clip level."""
SETTLED: Final = 256
"""Number of z² after which the clip level is constant."""
MIN_REFERENCE_TERMS: Final = 64
"""Minimum number of terms of a reference for an alarm, multiplied by F².

F terms contain the information of one independent term. The second factor F ensures that F is known for sums that are
much longer than the correlation of the terms.
"""
MIN_BAND_TERMS: Final = 16
"""Minimum number of terms of a longer octave for the estimate of slow noise."""
MIN_SPREAD_PAIRS: Final = 8
"""Minimum number of pairs for an estimate of the factor F."""
MAX_FLANK: Final = 12.0
"""Maximum ratio of z² to the reference variance beside a step."""
CONFIRM_PAIRS: Final = 2
"""Number of block pairs after a step that must confirm the step."""
SLOTS: Final = 4
"""Number of stored sums per level in ``ChangeState.snap``."""
NEVER: Final = 1 << 62
"""Sample number that means that no decision is due."""

N, S, LIMIT, SEEDED, F = range(5)
"""Columns of ``ChangeState.band``."""
UNIT_N, UNIT_S, UNIT_RAW, UNIT_INSIDE, UNIT_EXTREME = range(5)
"""Columns of ``ChangeState.unit`` and ``ChangeState.cum``."""
N1, S1, SINCE, G = range(4)
"""Columns of ``ChangeState.cusum``."""
HELD, FULL, SQUARES, COUNT, SPREAD = range(5)
"""Columns of ``ChangeState.spread``."""
NOISE, BURST, STEP = 1.0, 2.0, 3.0
"""Kinds of alarms."""
KIND, START, FOUND, EVIDENCE, DUE = range(5)
"""Columns of ``ChangeState.alarm``."""
BEFORE, AFTER, PLACE, SIGMA, LEFT = range(1, 6)
"""Columns of ``ChangeState.step``; column 0 is the octave."""
TOTAL, NEXT_DUE = 0, 1
"""Elements of ``ChangeState.clock``."""
H_NOISE, H_BURST, STEP_SIGMA, DWELL, LONGEST_DWELL, LEARN_TIME = range(6)
"""Elements of ``ChangeState.levels``."""


class ChangeState(NamedTuple):
    """State of the change detector for A = 6 axes, J octaves and L = 12 levels."""

    levels: Floats  # [6] thresholds, and times in samples; see H_NOISE
    clock: Ints  # [2] samples since the start; sample of the next decision
    born: Ints  # [A] first sample of the reference
    stage: Floats  # [A, 32] samples of the current tick
    half: Floats  # [A, J, 2] sum and number of samples of the first block of a pair
    fill: Ints  # [A, J] number of complete pairs for the detection of steps; −1 excludes the current pair
    ring: Floats  # [A, J, 2, 2] mean and block difference of the last two pairs
    seeds: Floats  # [A, J, SEED] first z²
    band: Floats  # [A, J, 5] reference: number and sum of clipped z², clip level, number of first z², F
    unit: (
        Floats  # [A, J, 5] since the last test: number, sum of clipped z², sum of z², number below the median, extremes
    )
    cum: Floats  # [A, J, 5] columns of ``unit`` since the start
    cusum: Floats  # [A, J, 6, 4] n₁, S₁, first sample of the suspected change, evidence g
    spread: Floats  # [A, J, L, 5] sums of z²: stored sum, 1 if stored, squared differences, pairs, spread F
    burst: Floats  # [A, 2] CUSUM of extreme values, and the last sample with a CUSUM of zero
    alarm: Floats  # [A, 5] pending alarm, see KIND; kind 0 means no alarm
    step: Floats  # [A, 6] octave or −1, mean before and after, position, significance, number of remaining pairs
    snap: Floats  # [levels, SLOTS, A, J, 5] copies of ``cum``; older copies have larger intervals
    snap_at: Ints  # [levels, SLOTS] sample numbers of the copies


def make_change_state(octaves: int) -> ChangeState:
    """Return the initial state of the change detector. The caller must set ``levels``."""
    a, j = AXES, octaves
    state = ChangeState(
        np.zeros(6), np.array([0, NEVER], np.int64), np.zeros(a, np.int64),
        np.zeros((a, TICK_SAMPLES)), np.zeros((a, j, 2)), np.zeros((a, j), np.int64), np.zeros((a, j, 2, 2)),
        np.zeros((a, j, SEED)),
        np.zeros((a, j, 5)), np.zeros((a, j, 5)), np.zeros((a, j, 5)), np.zeros((a, j, RATIOS.size, 4)),
        np.zeros((a, j, 12, 5)), np.zeros((a, 2)), np.zeros((a, 5)), np.zeros((a, 6)),
        np.zeros((40, SLOTS, a, j, 5)), np.full((40, SLOTS), -1, np.int64),
    )  # fmt: skip
    state.step[:, 0] = -1.0
    state.band[:, :, F] = 1.0
    return state


@compiled
def advance_until_decision(s: ChangeState, samples: Floats, first_row: int) -> int:
    """Process samples until a decision about an alarm is due, and return the next row to process.

    Parameters
    ----------
    s : ChangeState
        State of the change detector, updated in place.
    samples : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    first_row : int
        First row to process.
    """
    for row in range(first_row, len(samples)):
        place = s.clock[TOTAL] % TICK_SAMPLES
        for axis in range(AXES):
            s.stage[axis, place] = samples[row, axis]
        s.clock[TOTAL] += 1
        if place == TICK_SAMPLES - 1:
            now = s.clock[TOTAL]
            for axis in range(AXES):
                _tick(s, axis, now)
            _remember(s, now // TICK_SAMPLES)
            if now >= s.clock[NEXT_DUE]:
                return row + 1
    return len(samples)


@compiled
def _tick(s: ChangeState, axis: int, now: int) -> None:
    sums = s.stage[axis]
    total, count = 0.0, 0.0
    for i in range(TICK_SAMPLES):
        if np.abs(sums[i]) < HUGE:
            total += sums[i]
            count += 1.0
        else:
            sums[i] = np.nan
    evidence = _count_extremes(sums, s.band, s.cum, s.burst, axis, now)
    if evidence > s.levels[H_BURST] and s.burst[axis, 1] - s.born[axis] >= s.levels[LEARN_TIME]:
        _alarm(s, axis, BURST, s.burst[axis, 1], evidence, now)
    h = s.levels[H_NOISE]
    for j in range(SHORT):
        _differences(sums, s.band, s.unit, s.seeds, axis, j)
        best = _look(s.unit, s.cum, s.band, s.spread, s.cusum, axis, j, now, h)
        if best >= 0:
            _suspect(s, axis, j, best, now)
    place = now // TICK_SAMPLES - 1
    for j in range(SHORT, s.half.shape[1]):
        if place & 1 == 0:
            s.half[axis, j, 0], s.half[axis, j, 1] = total, count
            return
        place >>= 1
        if s.fill[axis, j] >= 0:
            _pair(s, axis, j, s.half[axis, j, 0], s.half[axis, j, 1], total, count, now)
            best = _look(s.unit, s.cum, s.band, s.spread, s.cusum, axis, j, now, h)
            if best >= 0:
                _suspect(s, axis, j, best, now)
        else:
            s.fill[axis, j] = 0
        total += s.half[axis, j, 0]
        count += s.half[axis, j, 1]


@compiled
def _differences(sums: Floats, band: Floats, unit: Floats, seeds: Floats, axis: int, j: int) -> None:
    """Add the squared Haar differences of one octave within a tick.

    ``sums`` contains the sums over blocks of 2^j samples, and is replaced by the sums over blocks of twice the length.
    Array views would be slower than the index arithmetic.
    """
    scale = 0.5 / (1 << j) ** 2
    limit = band[axis, j, LIMIT]
    inner, outer = limit * (MEDIAN / CLIP), limit * (EXTREME / CLIP)
    seeded = band[axis, j, SEEDED] == SEED
    n, clipped, raw, inside, extreme = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(TICK_SAMPLES >> (j + 1)):
        d = sums[2 * i + 1] - sums[2 * i]
        sums[i] = sums[2 * i] + sums[2 * i + 1]
        z2 = d * d * scale
        if z2 == z2:
            if not seeded:
                _gather(band, unit, seeds, axis, j, z2)
                continue
            n += 1.0
            clipped += min(z2, limit)
            raw += z2
            inside += z2 < inner
            extreme += z2 > outer
    unit[axis, j, UNIT_N] += n
    unit[axis, j, UNIT_S] += clipped
    unit[axis, j, UNIT_RAW] += raw
    unit[axis, j, UNIT_INSIDE] += inside
    unit[axis, j, UNIT_EXTREME] += extreme


@compiled
def _pair(s: ChangeState, axis: int, j: int, sum1: float, count1: float, sum2: float, count2: float, now: int) -> None:
    """Process two blocks of 2^j samples. Blocks with more than 1/16 of the samples missing are ignored."""
    m = 1 << j
    least = m - m // 16
    fill = s.fill[axis, j]
    if count1 < least or count2 < least:
        s.fill[axis, j] = 0
        return
    d = sum2 / count2 - sum1 / count1
    mean = (sum1 + sum2) / (count1 + count2)
    # For white noise, the variance of d is proportional to 1/count1 + 1/count2.
    z2 = d * d * count1 * count2 / ((count1 + count2) * m)
    _gather(s.band, s.unit, s.seeds, axis, j, z2)
    if s.step[axis, 0] == j:
        _confirm(s, axis, mean, now)
    elif fill == 2 and s.step[axis, 0] < 0.0 and s.alarm[axis, KIND] == 0.0:
        _seek_step(s, axis, j, mean, d, now)
    s.ring[axis, j, 0, 0], s.ring[axis, j, 0, 1] = s.ring[axis, j, 1, 0], s.ring[axis, j, 1, 1]
    s.ring[axis, j, 1, 0], s.ring[axis, j, 1, 1] = mean, d
    s.fill[axis, j] = min(fill + 1, 2)


@compiled
def _gather(band: Floats, unit: Floats, seeds: Floats, axis: int, j: int, z2: float) -> None:
    """Add one z² to the sums of an octave. The first ``SEED`` values determine the clip level."""
    if band[axis, j, SEEDED] == SEED:
        limit = band[axis, j, LIMIT]
        unit[axis, j, UNIT_N] += 1.0
        unit[axis, j, UNIT_S] += min(z2, limit)
        unit[axis, j, UNIT_RAW] += z2
        unit[axis, j, UNIT_INSIDE] += z2 < limit * (MEDIAN / CLIP)
        unit[axis, j, UNIT_EXTREME] += z2 > limit * (EXTREME / CLIP)
        return
    first, one = seeds[axis, j], band[axis, j]
    first[int(one[SEEDED])] = z2
    one[SEEDED] += 1.0
    if one[SEEDED] == SEED:
        scale = _median_of_seeds(first) / MEDIAN
        if scale == 0.0:
            for value in first:
                scale += value
            scale /= SEED  # more than half of the differences are zero, because the resolution is coarse
        if scale == 0.0:
            one[SEEDED] = 0.0  # a constant axis has no noise
        one[LIMIT] = CLIP * scale
        one[N], one[S] = SEED, 0.0
        for value in first:
            one[S] += min(value, one[LIMIT])


@compiled
def _median_of_seeds(first: Floats) -> float:
    for value in first:
        below, equal = 0, 0
        for other in first:
            below += other < value
            equal += other == value
        if below <= SEED // 2 < below + equal:
            return float(value)
    return 0.0


@compiled
def _look(
    unit: Floats, cum: Floats, band: Floats, spread: Floats, cusum: Floats, axis: int, j: int, now: int, h: float
) -> int:
    """Add new z² of one octave to the reference and to the evidence.

    Return the index of the variance ratio with the largest evidence above the threshold h, or −1.
    """
    k, q = unit[axis, j, UNIT_N], unit[axis, j, UNIT_S]
    if k == 0.0:
        return -1
    for i in range(UNIT_EXTREME + 1):
        cum[axis, j, i] += unit[axis, j, i]
        unit[axis, j, i] = 0.0
    unsettled = band[axis, j, N] < SETTLED
    band[axis, j, N] += k
    band[axis, j, S] += q
    if unsettled and band[axis, j, N] >= SETTLED:
        band[axis, j, LIMIT] = CLIP * band[axis, j, S] / band[axis, j, N]
    if k == max(1, TICK_SAMPLES >> (j + 1)):
        _feed_spread(spread, band, axis, j, q, k)
    return _raise_cusums(cusum, band, axis, j, k, q, now, h)


@compiled
def _feed_spread(spread: Floats, band: Floats, axis: int, j: int, q: float, k: float) -> None:
    """Update the factor F of one octave.

    F is the ratio of the squared Haar differences of sums of z² to the expectation for independent Gaussian z. The
    largest ratio over sums of 1, 2, 4, … tests is used. A ratio that is not significantly above 1 is reduced by its
    standard deviation.
    """
    v = band[axis, j, S] / band[axis, j, N]
    for level in range(spread.shape[2]):
        if spread[axis, j, level, FULL] == 0.0:
            spread[axis, j, level, HELD], spread[axis, j, level, FULL] = q, 1.0
            return
        held = spread[axis, j, level, HELD]
        spread[axis, j, level, FULL] = 0.0
        spread[axis, j, level, SQUARES] += (q - held) ** 2
        spread[axis, j, level, COUNT] += 1.0
        count = spread[axis, j, level, COUNT]
        q += held
        if count >= MIN_SPREAD_PAIRS and v > 0.0:
            expected = 4.0 * k * (1 << level) * v * v * count
            found, error = spread[axis, j, level, SQUARES] / expected, np.sqrt(3.0 / count)
            if found < 1.0 + 2.0 * error:  # A significantly larger value is not reduced.
                found /= 1.0 + error
            spread[axis, j, level, SPREAD] = found
            largest = 1.0
            for other in range(spread.shape[2]):
                largest = max(largest, spread[axis, j, other, SPREAD])
            band[axis, j, F] = largest


@compiled
def _raise_cusums(
    cusum: Floats, band: Floats, axis: int, j: int, k: float, q: float, now: int, threshold: float
) -> int:
    """Update the evidence of all variance ratios.

    Return the index of the ratio with the largest evidence above the threshold, or −1.
    """
    n, total, spread = band[axis, j, N], band[axis, j, S], band[axis, j, F]
    best, largest = -1, threshold
    for i in range(RATIOS.size):
        n1 = cusum[axis, j, i, N1] + k
        s1 = cusum[axis, j, i, S1] + q
        g = -1.0  # By Jensen's inequality, g is negative unless the variance has changed in the direction of r.
        if (s1 * n - total * n1) * GAIN[i] > 0.0:
            g = (-0.5 * n * np.log(1.0 - GAIN[i] * s1 / total) - n1 * HALF_LOG[i]) / spread
        if g <= 0.0:
            n1, s1 = 0.0, 0.0
            cusum[axis, j, i, SINCE] = now
        elif g > largest:
            best, largest = i, g
        cusum[axis, j, i, N1], cusum[axis, j, i, S1], cusum[axis, j, i, G] = n1, s1, g
    return best


@compiled
def _suspect(s: ChangeState, axis: int, j: int, i: int, now: int) -> None:
    """Raise an alarm for a noise change. If the reference is too short, restart the reference instead."""
    since = s.cusum[axis, j, i, SINCE]
    enough = s.band[axis, j, N] - s.cusum[axis, j, i, N1] >= MIN_REFERENCE_TERMS * s.band[axis, j, F] ** 2
    if enough and since - s.born[axis] >= s.levels[LEARN_TIME]:
        _alarm(s, axis, NOISE, since, s.cusum[axis, j, i, G], now)
    elif s.alarm[axis, KIND] == 0.0:
        _relearn(s, axis, j)


@compiled
def _relearn(s: ChangeState, axis: int, j: int) -> None:
    """Restart the reference of an octave that changed during the learning time."""
    s.band[axis, j] = 0.0
    s.band[axis, j, F] = 1.0
    s.spread[axis, j] = 0.0
    s.unit[axis, j] = 0.0
    s.cusum[axis, j] = 0.0


@compiled
def _count_extremes(sums: Floats, band: Floats, cum: Floats, burst: Floats, axis: int, now: int) -> float:
    """Update and return the CUSUM of extreme values.

    The CUSUM tests for a share of extreme values of at least 1 % that is also ten times the share at rest.
    """
    outer = 2.0 * band[axis, 0, LIMIT] * (EXTREME / CLIP)  # (y − y')² is 2 z²
    if band[axis, 0, SEEDED] != SEED or outer == 0.0:
        return 0.0
    k, extremes = 0.0, 0.0
    for i in range(TICK_SAMPLES // 2):
        d = sums[2 * i + 1] - sums[2 * i]
        if d == d:
            k += 1.0
            extremes += d * d > outer
    usual = max((cum[axis, 0, UNIT_EXTREME] + 0.5) / (cum[axis, 0, UNIT_N] + 1.0), RAREST)
    raised = max(10.0 * usual, 0.01)
    if raised >= 1.0:
        return 0.0
    burst[axis, 0] += extremes * np.log(raised / usual) - k * raised
    if burst[axis, 0] <= 0.0:
        burst[axis, 0], burst[axis, 1] = 0.0, now
    return float(burst[axis, 0])


@compiled
def _alarm(s: ChangeState, axis: int, kind: float, since: float, evidence: float, now: int) -> None:
    """Record an alarm, unless the axis already has an alarm.

    Within limits, the waiting time before the decision equals the time from the onset to the alarm.
    """
    alarm = s.alarm[axis]
    if alarm[KIND] != 0.0 and not (alarm[FOUND] == now and evidence > alarm[EVIDENCE]):
        return
    wait = np.ceil(min(max(now - since, s.levels[DWELL]), s.levels[LONGEST_DWELL]) / TICK_SAMPLES) * TICK_SAMPLES
    alarm[KIND], alarm[START], alarm[FOUND], alarm[EVIDENCE], alarm[DUE] = kind, since, now, evidence, now + wait
    s.step[axis, 0] = -1.0
    set_next_decision_time(s)


@compiled
def set_next_decision_time(s: ChangeState) -> None:
    """Set the sample at which the kernel stops for the next decision."""
    s.clock[NEXT_DUE] = NEVER
    for axis in range(AXES):
        if s.alarm[axis, KIND] != 0.0:
            s.clock[NEXT_DUE] = min(s.clock[NEXT_DUE], int(s.alarm[axis, DUE]))


@compiled
def _seek_step(s: ChangeState, axis: int, j: int, mean: float, d: float, now: int) -> None:
    """Search for a step between the newest pair of blocks and the next but one older pair.

    A step is rejected if the sensor moves or if a linear slope explains the difference.
    """
    ring = s.ring[axis, j]
    height = mean - ring[0, 0]
    band = s.band[axis, j]
    if band[N] == 0.0 or j + 3 >= s.band.shape[1]:
        return
    v = band[S] / band[N]
    square = height * height
    if square <= s.levels[STEP_SIGMA] ** 2 * v * band[F]:
        return
    quiet = 2.0 * MAX_FLANK * v * band[F]
    if d * d > quiet or ring[0, 1] ** 2 > quiet:
        return
    if now - s.born[axis] < s.levels[LEARN_TIME]:
        return
    for above in range(j + 1, j + 4):
        if s.band[axis, above, N] < MIN_BAND_TERMS:
            return
        # Random walk and flicker noise also change the mean within four blocks.
        v = max(v, 2.0 * s.band[axis, above, S] / s.band[axis, above, N])
    sigma = np.abs(height) / np.sqrt(v * band[F])
    straight = height - 2.0 * (d + ring[0, 1])  # without the part that the slopes on both sides explain
    share = (ring[1, 0] - ring[0, 0]) / height  # share of the middle pair that lies after the step
    if sigma <= s.levels[STEP_SIGMA] or straight * height < 0.5 * square or not -0.3 < share < 1.3:
        return
    step, m = s.step[axis], 1 << j
    step[0], step[BEFORE], step[AFTER] = j, ring[0, 0], mean
    step[PLACE] = now - 2.0 * m * (1.0 + min(max(share, 0.0), 1.0))
    step[SIGMA], step[LEFT] = sigma, CONFIRM_PAIRS


@compiled
def _confirm(s: ChangeState, axis: int, mean: float, now: int) -> None:
    """Confirm a step after ``CONFIRM_PAIRS`` pairs at the new mean. Discard the step if the mean changes again."""
    step = s.step[axis]
    if np.abs(mean - step[AFTER]) > 0.5 * np.abs(step[AFTER] - step[BEFORE]):
        step[0] = -1.0
        return
    step[LEFT] -= 1.0
    if step[LEFT] == 0.0 and s.alarm[axis, KIND] == 0.0:
        alarm = s.alarm[axis]
        alarm[KIND], alarm[START], alarm[FOUND] = STEP, step[PLACE], now
        alarm[EVIDENCE], alarm[DUE] = 0.5 * step[SIGMA] ** 2, now
        set_next_decision_time(s)


@compiled
def _remember(s: ChangeState, tick: int) -> None:
    """Store a copy of ``cum``.

    Copies at odd multiples of 2^k ticks are stored in level k, so that older copies have larger intervals.
    """
    level = 0
    while tick & 1 == 0:
        tick >>= 1
        level += 1
    slot = (tick >> 1) % SLOTS
    for axis in range(AXES):
        for j in range(s.cum.shape[1]):
            for i in range(UNIT_EXTREME + 1):
                s.snap[level, slot, axis, j, i] = s.cum[axis, j, i]
    s.snap_at[level, slot] = s.clock[TOTAL]
