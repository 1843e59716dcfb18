"""Compiled part of the change detector, which computes Haar differences, cumulative sums (CUSUM) and alarms.

Samples are processed in ticks of 32 samples. Processing stops when a decision about an alarm is due. The decision
therefore does not depend on how the samples are distributed over calls.

- **Haar differences.** In octave j, the means of two successive blocks of m = 2^j samples give the Haar difference z =
  (mean − mean')/√2. The mean square of z is the Allan variance at cluster size m. For white noise and random walk, the
  differences are independent. The computation takes two additions per sample and axis.
- **Missing samples.** Single samples are paired with the next sample that is present, also across one missing sample.
  The mean of a longer block is the mean of its present samples, if these are at least 60 %. The expectation of z² is
  then σ²(m) + e V(m), with the symbols of ``allan.missing_samples``. V and σ² are taken from the reference, and z² is
  divided by 1 + e V/σ². Loss therefore changes no variance. For white noise, V/σ² = m. If missing samples cause most of
  z², as with a strong spectral line, z² is ignored.
- **Evidence.** Let S be the sum of the n squares z² since the start of the reference, and S₁ the sum of the n₁ squares
  since a suspected change. The evidence g is the log-likelihood ratio of the hypotheses "variance multiplied by r" and
  "no change":

      g = −(n/2) ln(1 − (1 − 1/r) S₁/S) − (n₁/2) ln r.

  The evidence does not depend on the unknown variance. With a long reference, g is Page's CUSUM. Without a change, the
  mean of e^g is 1, so the probability of an alarm at threshold h within k tests is at most k e^−h (Shiryaev–Roberts).
  If (1 − 1/r) S₁/n₁ ≤ ln(r) S/n, the squares fit the old variance better, and the time of the suspected change is set
  to the current sample. The condition g ≤ 0 is not sufficient. If S₁ contains most of S, g hardly changes, so a
  suspicion from the first samples would remain, and would hide a later change.
- **Non-Gaussian and correlated noise.** The squares z² are clipped at ``CLIP`` times the reference variance, which
  corresponds to 4σ. For Gaussian noise, clipping affects a share of 6e-5 of the squares and reduces their mean by 2e-4.
  The evidence is divided by the factor F by which the variance of sums of z² exceeds the variance for independent
  Gaussian noise. Heavy tails, spectral lines and coarse resolution increase F. The value of F at the time of the
  suspected change is used, because the change itself increases F.
- **Bias steps** are detected by comparing the mean of a pair of blocks with the mean of the second pair before it. The
  pair in between may contain the step. Pairs with too many missing samples are skipped.
"""

from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.estimation.allan.missing_samples import min_present

AXES: Final = 6
RATIOS: Final = np.array([1.2, 1.44, 2.25, 1 / 1.2, 1 / 1.44, 1 / 2.25])
"""Ratios r between the variances after and before a change, for which the evidence is computed."""
GAIN: Final = 1.0 - 1.0 / RATIOS
"""Factor 1 − 1/r for each variance ratio r."""
HALF_LOG: Final = 0.5 * np.log(RATIOS)
"""Term ½ ln r for each variance ratio r."""
TICK_SAMPLES: Final = 32
"""Number of samples in a tick. To compute fewer logarithms, the evidence is updated once per tick."""
SHORT: Final = 5
"""Number of octaves whose clusters are shorter than a tick."""
RAREST: Final = 1e-6
"""Minimum share of extreme values that is assumed for the reference."""
HUGE: Final = 1e150
"""Absolute value from which samples count as missing, because their squares would overflow."""
CLIP: Final = 16.0
"""Ratio of a squared Haar difference to the reference variance above which the square is clipped."""
EXTREME: Final = 36.0
"""Ratio of a squared Haar difference to the reference variance above which the difference is an outlier.

The ratio corresponds to 6σ, which a share of 2e-9 of Gaussian values exceeds.
"""
MEDIAN: Final = 0.45494
"""Median of the χ² distribution with one degree of freedom."""
SEED: Final = 31
"""Number of squared differences in an octave whose median determines the initial clip level."""
SETTLED: Final = 256
"""Number of squared differences in an octave after which the clip level no longer changes."""
MIN_REFERENCE_TERMS: Final = 64
"""Minimum number of squared differences in a reference that can raise an alarm, if the factor F is 1.

The number is multiplied by F². The first factor F accounts for the reduced information in correlated squares. The
second factor F ensures that the observed sums are much longer than the correlation time.
"""
FIRST_SHARE: Final = 2.0 / 3.0
"""Minimum factor on the evidence of a noise change while the reference begins at the start of the detector."""
MIN_BAND_TERMS: Final = 16
"""Minimum number of squared differences in a longer octave from which slow noise is estimated."""
MIN_SPREAD_PAIRS: Final = 8
"""Minimum number of pairs of sums from which the factor F is estimated."""
MIN_INFORMATION: Final = 0.5
"""Minimum share of the expectation of z² that is not caused by missing samples. For white noise, the share is ≥ 0.6."""
MAX_GAP_RATIO: Final = 1.5
"""Maximum ratio of the mean squares of differences between successive samples and across one missing sample."""
MIN_STEP_BLOCKS: Final = 4.0
"""Distance of the block pairs before and after a step if no pair in between is missing, in blocks."""
MAX_STEP_BLOCKS: Final = 16.0
"""Maximum distance of the block pairs before and after a step, in blocks."""
MAX_FLANK: Final = 12.0
"""Maximum ratio of the squared Haar differences before and after a step to the reference variance."""
SLOTS: Final = 4
"""Number of copies that each level of ``ChangeState.snap`` stores."""
NEVER: Final = 1 << 62
"""Sample number that means "no decision is due"."""

N, S, LIMIT, SEEDED, F, GAP_N, GAP_S = range(7)
"""Columns of ``ChangeState.band``, which contains the reference.

They contain the number and the sum of clipped z², the clip level, the number of values in ``seeds``, F, and the number
and the sum of clipped z² of differences across one missing sample.
"""
UNIT_N, UNIT_S, UNIT_RAW, UNIT_INSIDE, UNIT_EXTREME = range(5)
"""Columns of ``ChangeState.unit`` and ``ChangeState.cum``, which contain sums of squared differences."""
N1, S1, SINCE, G, ONSET_F = range(5)
"""Columns of ``ChangeState.cusum``, which contains the evidence for changes."""
HELD, TERMS, SQUARES, COUNT, SPREAD = range(5)
"""Columns of ``ChangeState.spread``, from which the factor F is computed."""
NOISE, BURST, STEP = 1.0, 2.0, 3.0
"""Kinds of alarms."""
KIND, START, FOUND, EVIDENCE, DUE = range(5)
"""Columns of ``ChangeState.alarm``, which contains the pending alarms."""
BEFORE, AFTER, PLACE, SIGMA, LEFT = range(1, 6)
"""Columns of ``ChangeState.step``, in which column 0 is the octave."""
TOTAL, NEXT_DUE = 0, 1
"""Elements of ``ChangeState.clock``, which are sample numbers."""
H_NOISE, H_BURST, STEP_SIGMA, DWELL, LONGEST_DWELL, LEARN_TIME, NOISE_LEARN_TIME = range(7)
"""Elements of ``ChangeState.levels``, which are thresholds and times in samples."""


class ChangeState(NamedTuple):
    """State of the change detector for A = 6 axes, J octaves and L = 12 levels of sums."""

    levels: Floats  # [7] thresholds, and times in samples, at the indices from H_NOISE to NOISE_LEARN_TIME
    clock: Ints  # [2] number of samples since the start, and sample number of the next decision
    born: Ints  # [A] first sample of the reference
    stage: Floats  # [A, 32] samples of the current tick
    half: Floats  # [A, J, 2] sum and number of samples of the first block of a pair
    fill: Ints  # [A, J] number of complete block pairs for step detection; −1 excludes the current pair
    ring: Floats  # [A, J, 2, 4] mean, difference, information and end of the last two block pairs
    seeds: Floats  # [A, J, SEED] first squared Haar differences z²
    band: Floats  # [A, J, 7] reference; columns from N to GAP_S
    unit: (
        Floats  # [A, J, 5] since the last test: number, sum of clipped z², sum of z², number below the median, extremes
    )
    cum: Floats  # [A, J, 5] columns of ``unit`` since the start
    cusum: Floats  # [A, J, 6, 5] n₁, S₁, time of the suspected change, evidence g, factor F at this time
    spread: Floats  # [A, J, L, 5] for the factor F: stored sum of z², its terms or 0, squared differences, pairs, F
    burst: Floats  # [A, 2] CUSUM of extreme values, and the last sample at which it was zero
    alarm: Floats  # [A, 5] pending alarm, with the columns from KIND to DUE; kind 0 means no alarm
    step: Floats  # [A, 6] octave or −1, mean before and after, position, significance, number of remaining pairs
    snap: Floats  # [levels, SLOTS, A, J, 5] copies of ``cum``, at intervals that increase with age
    snap_at: Ints  # [levels, SLOTS] sample numbers of the copies


def make_change_state(octaves: int) -> ChangeState:
    """Return the initial state of the change detector. The caller must set ``levels``."""
    a, j = AXES, octaves
    state = ChangeState(
        np.zeros(7), np.array([0, NEVER], np.int64), np.zeros(a, np.int64),
        np.zeros((a, TICK_SAMPLES)), np.zeros((a, j, 2)), np.zeros((a, j), np.int64), np.zeros((a, j, 2, 4)),
        np.zeros((a, j, SEED)),
        np.zeros((a, j, 7)), np.zeros((a, j, 5)), np.zeros((a, j, 5)), np.zeros((a, j, RATIOS.size, 5)),
        np.zeros((a, j, 12, 5)), np.zeros((a, 2)), np.zeros((a, 5)), np.zeros((a, 6)),
        np.zeros((40, SLOTS, a, j, 5)), np.full((40, SLOTS), -1, np.int64),
    )  # fmt: skip
    state.step[:, 0] = -1.0
    state.band[:, :, F] = 1.0
    return state


@compiled
def advance_until_decision(s: ChangeState, samples: Floats, first_row: int) -> int:
    """Process samples until a decision about an alarm is due, and return the index of the next sample.

    Parameters
    ----------
    s : ChangeState
        State of the change detector, updated in place.
    samples : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    first_row : int
        Index of the first sample to process.
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
    if count > 0.0:
        _look_within_tick(s, axis, count == TICK_SAMPLES, now)
    h = s.levels[H_NOISE]
    place = now // TICK_SAMPLES - 1
    for j in range(SHORT, s.half.shape[1]):
        if place & 1 == 0:
            s.half[axis, j, 0], s.half[axis, j, 1] = total, count
            return
        place >>= 1
        if s.fill[axis, j] >= 0:
            _pair(s, axis, j, s.half[axis, j, 0], s.half[axis, j, 1], total, count, now)
            best = _look(s.unit, s.cum, s.band, s.spread, s.cusum, s.alarm, axis, j, now, h)
            if best >= 0:
                _suspect(s, axis, j, best, now)
        else:
            s.fill[axis, j] = 0
        total += s.half[axis, j, 0]
        count += s.half[axis, j, 1]


@compiled
def _look_within_tick(s: ChangeState, axis: int, complete: bool, now: int) -> None:
    """Test the octaves whose blocks are shorter than a tick."""
    sums = s.stage[axis]
    present = np.ones(0 if complete else TICK_SAMPLES)
    for i in range(present.size):
        if sums[i] != sums[i]:
            sums[i] = present[i] = 0.0
    for j in range(SHORT):
        if complete:
            _differences(sums, s.band, s.unit, s.seeds, axis, j)
        else:
            _differences_of_present(sums, present, s.band, s.unit, s.seeds, axis, j)
        best = _look(s.unit, s.cum, s.band, s.spread, s.cusum, s.alarm, axis, j, now, s.levels[H_NOISE])
        if best >= 0:
            _suspect(s, axis, j, best, now)


@compiled
def _differences(sums: Floats, band: Floats, unit: Floats, seeds: Floats, axis: int, j: int) -> None:
    """Add the squared Haar differences of one octave within a tick to the sums of the octave.

    On input, ``sums`` contains sums over blocks of 2^j samples. On output, it contains sums over blocks of twice the
    length. Indices are used because array views would be slower.
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
def _differences_of_present(
    sums: Floats, present: Floats, band: Floats, unit: Floats, seeds: Floats, axis: int, j: int
) -> None:
    """Add the squared Haar differences of one octave within a tick in which samples are missing.

    ``sums`` is used as in ``_differences``, with 0 for missing samples. ``present`` contains the numbers of samples in
    the blocks.
    """
    m, ratio = 1 << j, _variance_ratio_within(band, axis, j)
    if j == 0:
        _differences_of_neighbours(sums, present, band, unit, seeds, axis)
    for i in range(TICK_SAMPLES >> (j + 1)):
        sum1, sum2, count1, count2 = sums[2 * i], sums[2 * i + 1], present[2 * i], present[2 * i + 1]
        sums[i], present[i] = sum1 + sum2, count1 + count2
        information = _information(count1, count2, m, ratio)
        if j > 0 and information >= MIN_INFORMATION:
            d = sum2 / count2 - sum1 / count1
            _gather(band, unit, seeds, axis, j, 0.5 * d * d * information)


@compiled
def _differences_of_neighbours(
    sums: Floats, present: Floats, band: Floats, unit: Floats, seeds: Floats, axis: int
) -> None:
    """Add the squared Haar differences of single samples, of which each is paired with the next one that is present.

    A pair may have one missing sample in between. The squares of such pairs are scaled by the ratio of the mean squares
    of both kinds of pairs, if this ratio is known and the noise is nearly white.
    """
    one = band[axis, 0]
    scale = 0.0
    if one[GAP_N] >= SETTLED and one[GAP_S] > 0.0:
        scale = one[S] / one[N] * one[GAP_N] / one[GAP_S]
        if not 1.0 / MAX_GAP_RATIO < scale < MAX_GAP_RATIO:
            scale = 0.0
    first = -3
    for i in range(TICK_SAMPLES):
        if present[i] == 0.0:
            continue
        z2 = 0.5 * (sums[i] - sums[first]) ** 2
        paired = i - first == 1
        if i - first == 2 and one[SEEDED] == SEED:
            one[GAP_N] += 1.0
            one[GAP_S] += min(z2, one[LIMIT])
            z2 *= scale
            paired = scale > 0.0
        if paired:
            _gather(band, unit, seeds, axis, 0, z2)
        first = -3 if paired else i


@compiled
def _variance_ratio_within(band: Floats, axis: int, j: int) -> float:
    """Return the ratio V/σ² of the variance within blocks of 2^j samples to the Allan variance, from the reference."""
    m, total = 1 << j, 0.0
    for i in range(j):
        if band[axis, i, N] == 0.0:
            return float(m)  # white noise, until the reference is known
        total += 0.5 * band[axis, i, S] / band[axis, i, N]
    if band[axis, j, S] <= 0.0 or j == 0:
        return float(m)
    return float(total * m / (m - 1.0) * band[axis, j, N] / band[axis, j, S])


@compiled
def _information(count1: float, count2: float, m: int, ratio: float) -> float:
    """Return the factor 1 / (1 + e V/σ²) for the square of a difference between block means, 0 for too few samples."""
    if min(count1, count2) < min_present(m):
        return 0.0
    return 1.0 / (1.0 + (0.5 * (1.0 / count1 + 1.0 / count2) - 1.0 / m) * ratio)


@compiled
def _pair(s: ChangeState, axis: int, j: int, sum1: float, count1: float, sum2: float, count2: float, now: int) -> None:
    """Process a pair of blocks of 2^j samples, unless too many samples of a block are missing."""
    m = 1 << j
    fill = s.fill[axis, j]
    information = 1.0
    if count1 + count2 < 2.0 * m:
        information = _information(count1, count2, m, _variance_ratio_within(s.band, axis, j))
    if information < MIN_INFORMATION:
        return
    d = sum2 / count2 - sum1 / count1
    mean = (sum1 + sum2) / (count1 + count2)
    _gather(s.band, s.unit, s.seeds, axis, j, 0.5 * d * d * information)
    if s.step[axis, 0] == j:
        _confirm(s, axis, mean, now)
    elif fill == 2 and s.step[axis, 0] < 0.0 and s.alarm[axis, KIND] == 0.0:
        _seek_step(s, axis, j, mean, d, information, now)
    for i in range(s.ring.shape[3]):
        s.ring[axis, j, 0, i] = s.ring[axis, j, 1, i]
    s.ring[axis, j, 1, 0], s.ring[axis, j, 1, 1] = mean, d
    s.ring[axis, j, 1, 2], s.ring[axis, j, 1, 3] = information, now
    s.fill[axis, j] = min(fill + 1, 2)


@compiled
def _gather(band: Floats, unit: Floats, seeds: Floats, axis: int, j: int, z2: float) -> None:
    """Add one squared Haar difference to the sums of an octave. The first ``SEED`` values determine the clip level."""
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
            scale /= SEED  # With coarse resolution, the median is zero and the mean is used.
        if scale == 0.0:
            one[SEEDED] = 0.0  # The axis is constant, so new values are collected.
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
    unit: Floats,
    cum: Floats,
    band: Floats,
    spread: Floats,
    cusum: Floats,
    alarm: Floats,
    axis: int,
    j: int,
    now: int,
    h: float,
) -> int:
    """Add the new squared Haar differences of one octave to the reference and to the evidence.

    Differences after a change do not count towards the factor F. Return the index of the variance ratio with the
    largest evidence if the evidence exceeds the threshold h, else −1.
    """
    k, q = unit[axis, j, UNIT_N], unit[axis, j, UNIT_S]
    if k == 0.0:
        return -1
    for i in range(UNIT_EXTREME + 1):
        cum[axis, j, i] += unit[axis, j, i]
        unit[axis, j, i] = 0.0
    unsettled = band[axis, j, N] < SETTLED
    # a tick in which the seeds end has only a few other differences
    seeds_end = band[axis, j, N] == SEED and k < TICK_SAMPLES >> (j + 1)
    band[axis, j, N] += k
    band[axis, j, S] += q
    if unsettled and band[axis, j, N] >= SETTLED:
        band[axis, j, LIMIT] = CLIP * band[axis, j, S] / band[axis, j, N]
    best = _raise_cusums(cusum, band, axis, j, k, q, now, h)
    if best < 0 and alarm[axis, KIND] == 0.0 and not seeds_end:
        _feed_spread(spread, band, axis, j, q, k)
    return best


@compiled
def _feed_spread(spread: Floats, band: Floats, axis: int, j: int, q: float, k: float) -> None:
    """Update the factor F of one octave.

    The mean z² over 1, 2, 4, … ticks is compared with the preceding mean over the same time. For each length, the mean
    squared difference is divided by its expectation for independent Gaussian noise. F is the largest of these ratios.
    A ratio that is not significantly above 1 is first reduced by its standard error.
    """
    v = band[axis, j, S] / band[axis, j, N]
    for level in range(spread.shape[2]):
        held, terms = spread[axis, j, level, HELD], spread[axis, j, level, TERMS]
        if terms == 0.0:
            spread[axis, j, level, HELD], spread[axis, j, level, TERMS] = q, k
            return
        spread[axis, j, level, TERMS] = 0.0
        # the variance of the difference is 2 v² (1/k + 1/k')
        spread[axis, j, level, SQUARES] += 0.5 * (q / k - held / terms) ** 2 * k * terms / (k + terms)
        spread[axis, j, level, COUNT] += 1.0
        count = spread[axis, j, level, COUNT]
        q += held
        k += terms
        if count >= MIN_SPREAD_PAIRS and v > 0.0:
            found, error = spread[axis, j, level, SQUARES] / (v * v * count), np.sqrt(3.0 / count)
            if found < 1.0 + 2.0 * error:  # not significantly above 1
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

    Return the index of the variance ratio with the largest evidence if the evidence exceeds the threshold, else −1.
    """
    n, total, spread = band[axis, j, N], band[axis, j, S], band[axis, j, F]
    best, largest = -1, threshold
    for i in range(RATIOS.size):
        if cusum[axis, j, i, N1] == 0.0:
            cusum[axis, j, i, ONSET_F] = spread
        n1 = cusum[axis, j, i, N1] + k
        s1 = cusum[axis, j, i, S1] + q
        g = 0.0
        if GAIN[i] * s1 * n > 2.0 * HALF_LOG[i] * n1 * total:
            g = (-0.5 * n * np.log(1.0 - GAIN[i] * s1 / total) - n1 * HALF_LOG[i]) / cusum[axis, j, i, ONSET_F]
        if g <= 0.0:
            n1, s1 = 0.0, 0.0
            cusum[axis, j, i, SINCE] = now
        elif g > largest:
            best, largest = i, g
        cusum[axis, j, i, N1], cusum[axis, j, i, S1], cusum[axis, j, i, G] = n1, s1, g
    return best


@compiled
def _suspect(s: ChangeState, axis: int, j: int, i: int, now: int) -> None:
    """Raise an alarm for a noise change, or restart the reference if it is too short.

    The factor F of a reference that is shorter than the learning time does not contain slow fluctuations of the noise.
    The threshold is therefore raised by the ratio of the learning time to the length of the reference, but by at most
    1 / FIRST_SHARE before the first change. Noise that has changed once often goes on changing.
    """
    since, evidence = s.cusum[axis, j, i, SINCE], s.cusum[axis, j, i, G]
    terms = s.band[axis, j, N] - s.cusum[axis, j, i, N1]
    length = min(terms * (2 << j), since - s.born[axis])
    if terms >= MIN_REFERENCE_TERMS * s.cusum[axis, j, i, ONSET_F] ** 2 and length >= s.levels[NOISE_LEARN_TIME]:
        share = min(length / s.levels[LEARN_TIME], 1.0)
        if s.born[axis] == 0:
            share = max(share, FIRST_SHARE)
        if evidence * share > s.levels[H_NOISE]:
            _alarm(s, axis, NOISE, since, evidence, now)
    elif s.alarm[axis, KIND] == 0.0:
        _relearn(s, axis, j)


@compiled
def _relearn(s: ChangeState, axis: int, j: int) -> None:
    """Restart the reference of an octave whose variance changed during the learning time."""
    s.band[axis, j] = 0.0
    s.band[axis, j, F] = 1.0
    s.spread[axis, j] = 0.0
    s.unit[axis, j] = 0.0
    s.cusum[axis, j] = 0.0


@compiled
def _count_extremes(sums: Floats, band: Floats, cum: Floats, burst: Floats, axis: int, now: int) -> float:
    """Update and return the CUSUM of extreme values.

    The CUSUM tests whether the share of extreme values has risen to ten times the usual share, and to at least 1 %.
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
    """Record an alarm, unless another alarm is pending on the axis.

    The time from the alarm to the decision equals the time from the onset of the change to the alarm, within limits.
    """
    alarm = s.alarm[axis]
    if alarm[KIND] != 0.0 and not (alarm[FOUND] == now and evidence > alarm[EVIDENCE]):
        return
    wait = np.ceil(min(max(now - since, s.levels[DWELL]), s.levels[LONGEST_DWELL]) / TICK_SAMPLES) * TICK_SAMPLES
    alarm[KIND], alarm[START], alarm[FOUND], alarm[EVIDENCE], alarm[DUE] = kind, since, now, evidence, now + wait
    s.step[axis, 0] = -1.0
    set_next_decision_sample(s)


@compiled
def set_next_decision_sample(s: ChangeState) -> None:
    """Set the sample number at which processing stops for the next decision."""
    s.clock[NEXT_DUE] = NEVER
    for axis in range(AXES):
        if s.alarm[axis, KIND] != 0.0:
            s.clock[NEXT_DUE] = min(s.clock[NEXT_DUE], int(s.alarm[axis, DUE]))


@compiled
def _seek_step(s: ChangeState, axis: int, j: int, mean: float, d: float, information: float, now: int) -> None:
    """Search for a bias step between the newest pair of blocks and the second pair before it.

    Pairs with too many missing samples may lie in between. A step is rejected if the sensor moves, or if a linear drift
    explains the difference of the means. Without missing pairs, the drift within the pairs shows it. Otherwise, the
    pairs that confirm the step are at least as long as the distance, so that a drift would double the difference.
    """
    ring, m = s.ring[axis, j], 1 << j
    distance = (now - ring[0, 3]) / m
    longest = j + int(np.ceil(np.log2(1.5 * distance - 1.0)))
    height = mean - ring[0, 0]
    # The variance of each mean is inversely proportional to its information.
    both = 2.0 * information * ring[0, 2] / (information + ring[0, 2])
    band = s.band[axis, j]
    if band[N] == 0.0 or distance > MAX_STEP_BLOCKS or longest >= s.band.shape[1]:
        return
    v = band[S] / band[N]
    square = height * height
    if square * both <= s.levels[STEP_SIGMA] ** 2 * v * band[F]:
        return
    quiet = 2.0 * MAX_FLANK * v * band[F]
    if d * d * information > quiet or ring[0, 1] ** 2 * ring[0, 2] > quiet:
        return
    if now - s.born[axis] < s.levels[LEARN_TIME]:
        return
    slow = 0.0
    for above in range(j + 1, longest + 1):
        if s.band[axis, above, N] >= MIN_BAND_TERMS:
            slow = 2.0 * s.band[axis, above, S] / s.band[axis, above, N]
        elif above <= j + 3:
            return
        else:
            slow *= 2.0  # the variance of a random walk
        # Random walk and flicker noise also change the mean over this distance.
        v = max(v, slow)
    sigma = np.abs(height) * np.sqrt(both / (v * band[F]))
    # height without the linear drift on both sides, which is too inaccurate for larger distances
    straight = height - 2.0 * (d + ring[0, 1]) if distance == MIN_STEP_BLOCKS else height
    share = (ring[1, 0] - ring[0, 0]) / height  # share of the middle block pair that follows the step
    if sigma <= s.levels[STEP_SIGMA] or straight * height < 0.5 * square or not -0.3 < share < 1.3:
        return
    step = s.step[axis]
    step[0], step[BEFORE], step[AFTER] = j, ring[0, 0], mean
    # The step may lie between the pairs, or in the pair in the middle.
    share, end = min(max(share, 0.0), 1.0), ring[1, 3]
    step[PLACE] = 0.5 * (1.0 - share) * (end + now - 2.0 * m) + 0.5 * share * (end - 2.0 * m + ring[0, 3])
    step[SIGMA], step[LEFT] = sigma, np.ceil(0.5 * distance)


@compiled
def _confirm(s: ChangeState, axis: int, mean: float, now: int) -> None:
    """Confirm a step after enough block pairs at the new mean, or discard it if the mean changes again."""
    step = s.step[axis]
    if np.abs(mean - step[AFTER]) > 0.5 * np.abs(step[AFTER] - step[BEFORE]):
        step[0] = -1.0
        return
    step[LEFT] -= 1.0
    if step[LEFT] == 0.0 and s.alarm[axis, KIND] == 0.0:
        alarm = s.alarm[axis]
        alarm[KIND], alarm[START], alarm[FOUND] = STEP, step[PLACE], now
        alarm[EVIDENCE], alarm[DUE] = 0.5 * step[SIGMA] ** 2, now
        set_next_decision_sample(s)


@compiled
def _remember(s: ChangeState, tick: int) -> None:
    """Store a copy of the cumulative sums ``cum``.

    Copies at odd multiples of 2^k ticks are stored in level k, so the interval between copies increases with their age.
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
