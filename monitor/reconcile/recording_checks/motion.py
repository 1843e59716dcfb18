"""Check a recording for motion, knocks and handling, and remove the samples recorded during motion.

``analyze --rest`` uses the same motion detector. Motion of a sensor affects several axes at the same time. A
disturbance of a single axis may be a noise effect and is therefore not removed. Axes with steps or changes of the noise
in the model are not examined. If the detector finds motion in a simulation of the model, motion cannot be
distinguished from noise, and no samples are removed.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.common.distributions import NORMAL_QUARTILE
from monitor.common.unit_formatting import format_axis_value
from monitor.estimation.detection.motion_detection import MotionEpisode, detect_motion, samples_per_block
from monitor.noise.effects import BiasStep, NoiseStep, PoissonSteps, RandomTelegraph, TurnOnTransient
from monitor.reconcile.recording_checks.recording_under_test import CheckResult, RecordingUnderTest
from monitor.reconcile.result import ParameterInterval, RecordingFinding

EVENT_EFFECTS: Final = (BiasStep, NoiseStep, PoissonSteps, RandomTelegraph, TurnOnTransient)
"""Effects that the motion detector may mistake for motion."""
MIN_MOVING_AXES: Final = 2
"""Smallest number of axes with increased variance at the same time."""
MIN_RISE: Final = float(np.log(2.5))
"""Smallest increase of the logarithm of the block variance on a moving axis."""
MIN_DEVIATION: Final = 6.0
"""Smallest increase of the logarithm of the block variance, in standard deviations at rest."""
MIN_BLOCK_SAMPLES: Final = 4
"""Smallest number of valid samples in a block. At least half of the samples in a block must be valid."""
MIN_BLOCKS: Final = 4
"""Smallest number of valid blocks."""
MAX_MOVING_SHARE: Final = 0.4
"""Largest fraction of samples in motion that is removed."""
MAX_LISTED_EPISODES: Final = 3
"""Largest number of episodes in the description."""


def check_motion(recording: RecordingUnderTest) -> CheckResult:
    """Mark samples in motion as missing."""
    values, rate_hz, simulated = recording.values, recording.rate_hz, recording.simulated
    effects = {} if recording.model is None else recording.model.effects
    steady = {
        axis: y for axis, y in values.items() if not any(isinstance(e, EVENT_EFFECTS) for e in effects.get(axis, ()))
    }
    episodes = find_motion(steady, rate_hz) if steady else []
    if not episodes or (simulated is not None and find_motion({a: simulated[a] for a in steady}, rate_hz, min_axes=0)):
        return values, []
    moving = np.zeros(recording.sample_count, np.bool_)
    for motion, _ in episodes:
        moving[motion.since : motion.until] = True
    share = float(moving.mean())
    removed = share <= MAX_MOVING_SHARE
    marked = {axis: np.where(moving, np.nan, y) for axis, y in values.items()} if removed else values
    return marked, [_describe(episodes, share, removed, rate_hz)]


def find_motion(
    values: Mapping[str, Floats], rate_hz: float, min_axes: int = MIN_MOVING_AXES
) -> list[tuple[MotionEpisode, tuple[str, ...]]]:
    """Find episodes of motion with increased variance on several axes, and return each episode with the moving axes.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    min_axes : int, optional
        Smallest number of axes with increased variance at the same time. If 0, all episodes are returned.
    """
    n = next(iter(values.values())).size
    columns = np.full((n, len(AXES)), np.nan)
    for axis, y in values.items():
        columns[:, AXES.index(axis)] = y
    _, motions = detect_motion(columns, rate_hz)
    if not motions:
        return []
    size = samples_per_block(rate_hz)
    loud = {axis: _find_loud_blocks(y, size) for axis, y in values.items()}
    together = np.sum(list(loud.values()), axis=0)
    found = []
    for motion in motions:
        blocks = slice(motion.since // size, -(-motion.until // size))
        if together[blocks].max(initial=0) >= min_axes:
            moving = tuple(axis for axis, of in loud.items() if of[blocks].any() or axis == motion.axis)
            found.append((motion, moving))
    return found


def _find_loud_blocks(y: Floats, size: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return a mask of the blocks with a variance far above the median variance."""
    blocks = y[: y.size // size * size].reshape(-1, size)
    used = np.isfinite(blocks).sum(axis=1) >= max(size // 2, MIN_BLOCK_SAMPLES)
    loud = np.zeros(len(blocks) + 1, np.bool_)
    if used.sum() < MIN_BLOCKS:
        return loud
    steps = np.abs(np.diff(y[np.isfinite(y)]))
    step = float(steps[steps > 0.0].min()) if (steps > 0.0).any() else 0.0
    log_variance = np.log(np.nanvar(blocks[used], axis=1) + step**2 / 12.0 + 1e-30)
    rise = log_variance - np.median(log_variance)
    loud[np.flatnonzero(used)] = rise > max(MIN_RISE, MIN_DEVIATION * _standard_deviation_at_rest(log_variance))
    return loud


def _standard_deviation_at_rest(x: Floats) -> float:
    """Estimate the standard deviation from the lower quartile, because motion increases only the upper quantiles."""
    low, middle = np.quantile(x, [0.25, 0.5])
    return float(middle - low) / NORMAL_QUARTILE


def _describe(
    episodes: list[tuple[MotionEpisode, tuple[str, ...]]], share: float, removed: bool, rate_hz: float
) -> RecordingFinding:
    axes = tuple(axis for axis in AXES if any(axis in of for _, of in episodes))
    largest = sorted(episodes, key=lambda one: one[0].until - one[0].since, reverse=True)[:MAX_LISTED_EPISODES]
    times = ", ".join(f"{one.since / rate_hz:.5g} s" for one, _ in sorted(largest, key=lambda one: one[0].since))
    most = max((one for one, _ in episodes), key=lambda one: one.seconds)
    count = len(episodes)
    what = "episode" if count == 1 else "episodes"
    where = f"at {times}" if count <= MAX_LISTED_EPISODES else f"the longest at {times}"
    kinds = sorted({motion.kind for motion, _ in episodes})
    action = (
        f"{100.0 * share:.2g} % of the samples were marked as missing."
        if removed
        else f"{100.0 * share:.2g} % of the samples are in motion, which is too much to remove."
    )
    return RecordingFinding(
        "motion",
        axes,
        f"The sensor was moved or knocked: {count} {what} of {' and '.join(kinds)}, {where}, "
        f"with {most.axis} up to {format_axis_value(most.axis, most.peak)}. {action}",
        {"time": ParameterInterval(min(one.since for one, _ in episodes) / rate_hz)},
        {"episodes": float(count), "share": share, "longest_s": most.seconds},
        corrected=removed,
    )
