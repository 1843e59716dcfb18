"""Check for motion, knocks and handling, and removal of these samples.

The detector is that of ``analyze --rest``. Motion of a sensor acts on several axes at once. An episode on a single axis
may be a noise effect and is left to the noise search. The same holds for axes whose model contains steps or changes of
the noise. If a simulation of the model has episodes, motion cannot be distinguished from noise, and nothing is removed.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.common.distributions import NORMAL_QUARTILE
from monitor.common.units import format_rate
from monitor.estimation.detection.motion_detection import Motion, block_size, detect_motion
from monitor.noise.effects import BiasStep, NoiseStep, PoissonSteps, RandomTelegraph, TurnOnTransient
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import ParameterInterval, RecordingFinding

EVENTS: Final = (BiasStep, NoiseStep, PoissonSteps, RandomTelegraph, TurnOnTransient)
"""Effects that resemble motion."""
MIN_MOVING_AXES: Final = 2
"""Smallest number of axes that must be loud at the same time."""
MIN_RISE: Final = float(np.log(2.5))
"""Smallest rise of the logarithm of the variance of a block on a moving axis."""
MIN_DEVIATION: Final = 6.0
"""Smallest deviation of a block on a moving axis, in standard deviations of the blocks at rest."""
MIN_BLOCK_SAMPLES: Final = 4
"""Smallest number of samples of a block whose variance is used. At least half of the block must be present as well."""
MIN_BLOCKS: Final = 4
"""Smallest number of blocks for a comparison."""
MAX_MOVING_SHARE: Final = 0.4
"""Largest share of samples in motion that can be removed."""
MAX_NAMED: Final = 3
"""Largest number of episodes whose times are listed."""


def check_motion(
    values: Mapping[str, Floats],
    rate_hz: float,
    simulated: Mapping[str, Floats] | None,
    model: NoiseModel | None = None,
) -> tuple[dict[str, Floats], list[RecordingFinding]]:
    """Return the values with the samples in motion marked as missing, and the finding.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis in rad/s or m/s²; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    simulated : mapping of str to ndarray or None
        Simulation of the model under test.
    model : NoiseModel or None, optional
        Model under test.
    """
    effects = {} if model is None else model.effects
    steady = {axis: y for axis, y in values.items() if not any(isinstance(e, EVENTS) for e in effects.get(axis, ()))}
    episodes = find_motion(steady, rate_hz) if steady else []
    if not episodes or (simulated is not None and find_motion({a: simulated[a] for a in steady}, rate_hz, axes=0)):
        return dict(values), []
    n = next(iter(values.values())).size
    moving = np.zeros(n, np.bool_)
    for motion, _ in episodes:
        moving[motion.since : motion.until] = True
    share = float(moving.mean())
    removed = share <= MAX_MOVING_SHARE
    marked = {axis: np.where(moving, np.nan, y) for axis, y in values.items()} if removed else dict(values)
    return marked, [_describe(episodes, share, removed, rate_hz)]


def find_motion(
    values: Mapping[str, Floats], rate_hz: float, axes: int = MIN_MOVING_AXES
) -> list[tuple[Motion, tuple[str, ...]]]:
    """Return the episodes of motion in which several axes are loud at the same time, with these axes.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    axes : int, optional
        Smallest number of axes that are loud at the same time. With 0, all episodes are returned.
    """
    n = next(iter(values.values())).size
    columns = np.full((n, len(AXES)), np.nan)
    for axis, y in values.items():
        columns[:, AXES.index(axis)] = y
    _, motions = detect_motion(columns, rate_hz)
    if not motions:
        return []
    size = block_size(rate_hz)
    loud = {axis: _loud_blocks(y, size) for axis, y in values.items()}
    together = np.sum(list(loud.values()), axis=0)
    found = []
    for motion in motions:
        blocks = slice(motion.since // size, -(-motion.until // size))
        if together[blocks].max(initial=0) >= axes:
            moving = tuple(axis for axis, of in loud.items() if of[blocks].any() or axis == motion.axis)
            found.append((motion, moving))
    return found


def _loud_blocks(y: Floats, size: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return for each block whether its variance is larger than the variance of most blocks."""
    blocks = y[: y.size // size * size].reshape(-1, size)
    used = np.isfinite(blocks).sum(axis=1) >= max(size // 2, MIN_BLOCK_SAMPLES)
    loud = np.zeros(len(blocks) + 1, np.bool_)
    if used.sum() < MIN_BLOCKS:
        return loud
    steps = np.abs(np.diff(y[np.isfinite(y)]))
    step = float(steps[steps > 0.0].min()) if (steps > 0.0).any() else 0.0
    log_variance = np.log(np.nanvar(blocks[used], axis=1) + step**2 / 12.0 + 1e-30)
    rise = log_variance - np.median(log_variance)
    loud[np.flatnonzero(used)] = rise > max(MIN_RISE, MIN_DEVIATION * _scatter(log_variance))
    return loud


def _scatter(x: Floats) -> float:
    """Return the standard deviation from the distance of the lower quartile, which motion does not change."""
    low, middle = np.quantile(x, [0.25, 0.5])
    return float(middle - low) / NORMAL_QUARTILE


def _describe(
    episodes: list[tuple[Motion, tuple[str, ...]]], share: float, removed: bool, rate_hz: float
) -> RecordingFinding:
    """Return the finding for all episodes."""
    axes = tuple(axis for axis in AXES if any(axis in of for _, of in episodes))
    largest = sorted(episodes, key=lambda one: one[0].until - one[0].since, reverse=True)[:MAX_NAMED]
    times = ", ".join(f"{one.since / rate_hz:.5g} s" for one, _ in sorted(largest, key=lambda one: one[0].since))
    most = max((one for one, _ in episodes), key=lambda one: one.seconds)
    count = len(episodes)
    what = "episode" if count == 1 else "episodes"
    where = f"at {times}" if count <= MAX_NAMED else f"the longest at {times}"
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
        f"with {most.axis} up to {format_rate(most.axis, most.peak)}. {action}",
        {"time": ParameterInterval(min(one.since for one, _ in episodes) / rate_hz)},
        {"episodes": float(count), "share": share, "longest_s": most.seconds},
        corrected=removed,
    )
