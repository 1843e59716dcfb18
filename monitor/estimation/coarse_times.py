"""Sample times of a recording whose time stamps are coarser than the sample period.

Such stamps count whole seconds, for example, and a hundred samples share each of them. The samples are evenly spaced as
long as each stamp has its usual number of samples. Otherwise, samples are missing:

- If a stamp and the next one have too few samples, or no sample has the next stamp, the pause lies between the samples
  of both. Those before the pause follow the start of their stamp, and those after it precede the end of theirs.
- If a single stamp has too few samples, the position of the missing ones is unknown. They are assumed to be the last.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from drivers.data_types import NS_PER_S, Ints, SampleBlock

MIN_STEPS: Final = 2
"""Minimum number of steps from stamp to stamp, from which the sample rate follows."""
MIN_SHARED_SHARE: Final = 0.05
"""Minimum share of the samples with the time stamp of the previous sample. A smaller share is jitter."""
MAX_REPEATED_SHARE: Final = 0.5
"""Maximum share of these samples that repeat the previous values. A larger share consists of repeated messages."""
MIN_MISSING: Final = 1.5
"""Minimum number of samples by which a stamp has too few, because the usual number varies by one."""
MISSING_SIGMA: Final = 6.0
"""The same number in standard deviations of the number of samples."""
UNIT_TOLERANCE: Final = 1e-3
"""Maximum deviation of a time step from a multiple of the resolution, as a fraction of the resolution."""


def refine_coarse_times(blocks: Sequence[SampleBlock]) -> tuple[list[SampleBlock], float]:
    """Replace coarse time stamps by evenly spaced times between the pauses.

    Parameters
    ----------
    blocks : sequence of SampleBlock
        Recording with time stamps.

    Returns
    -------
    blocks : list of SampleBlock
        The same samples. Their times are unchanged if the stamps are not coarse.
    resolution_s : float
        Resolution of coarse stamps in seconds, otherwise 0.
    """
    t_ns = np.concatenate([samples.t_ns for samples in blocks])
    steps = np.diff(t_ns)
    shared = steps == 0
    if not steps.size or steps.min() < 0 or shared.mean() < MIN_SHARED_SHARE:
        return list(blocks), 0.0
    starts = np.flatnonzero(~shared) + 1  # rows that have another stamp than the previous row
    unit_ns = _resolution_ns(np.diff(t_ns[starts]))
    if unit_ns == 0.0:
        return list(blocks), 0.0
    values = np.concatenate([samples.values for samples in blocks])
    repeated = (values[1:][shared] == values[:-1][shared]) | np.isnan(values[:-1][shared])
    if repeated.all(axis=1).mean() > MAX_REPEATED_SHARE:
        return list(blocks), 0.0
    refined = _spread_evenly(t_ns, starts, unit_ns)
    ends = np.cumsum([len(samples) for samples in blocks])
    parts = zip(blocks, np.split(refined, ends[:-1]), strict=True)
    return [samples.with_times(part, samples.lost) for samples, part in parts], unit_ns / NS_PER_S


def _resolution_ns(steps: Ints) -> float:
    """Return the smallest step if all steps are multiples of it, otherwise 0."""
    if steps.size < MIN_STEPS:
        return 0.0
    # The mean of several steps is more accurate, because time stamps are rounded to nanoseconds.
    unit_ns = float(steps[steps < 1.5 * steps.min()].mean())
    multiples = steps / unit_ns
    return unit_ns if np.abs(multiples - np.rint(multiples)).max() < UNIT_TOLERANCE else 0.0


def _spread_evenly(t_ns: Ints, starts: Ints, unit_ns: float) -> Ints:
    """Return evenly spaced times [n] in ns. ``starts`` are the rows that have another stamp than the previous row."""
    counts, stamps = np.diff(starts), t_ns[starts]
    units = np.rint(np.diff(stamps) / unit_ns)
    usual = np.sort(counts[units == 1.0])[(units == 1.0).sum() // 2]
    regular = (units == 1.0) & (np.abs(counts - usual) <= MIN_MISSING)
    missing = units * counts[regular].mean() - counts
    scatter = 1.4826 * float(np.median(np.abs(missing[units == 1.0])))
    too_few = missing > max(MIN_MISSING, MISSING_SIGMA * scatter)
    ends: list[int] = []  # the stamps before missing samples
    for k in np.flatnonzero(too_few).tolist():
        if not ends or ends[-1] < k - 1:  # otherwise, the stamp lacks the samples before its own
            ends.append(k)
    firsts, lasts = np.array([0, *(k + 1 for k in ends)]), np.array([*ends, starts.size - 1])
    after_pause = (firsts > 0) & ((units[firsts - 1] > 1.0) | np.append(too_few, False)[firsts])
    anchors = firsts + (after_pause & (firsts < lasts))
    # If all samples are there, the first sample of a stamp is late by less than a period.
    spans = stamps[lasts] - stamps[anchors]
    period_ns = spans.sum() / (starts[lasts] - starts[anchors]).sum() if spans.any() else unit_ns / usual
    begins = np.append(0, starts[firsts[1:]])
    sizes = np.diff(np.append(begins, t_ns.size))
    rows = np.arange(t_ns.size) - np.repeat(starts[anchors], sizes)
    refined: Ints = np.repeat(stamps[anchors], sizes) + np.rint(rows * period_ns).astype(np.int64)
    return np.maximum.accumulate(refined)
