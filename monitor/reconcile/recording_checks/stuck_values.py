"""Check for stretches in which an axis, or the whole row, keeps one value.

Quantized values repeat by chance. A stretch is therefore compared with the largest share of repeated values in any
window outside it, and with the longest stretch in a simulation of the model. A stretch at the largest or smallest value
of the axis may be clipping and is left to the noise search.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import log
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_RUN_SAMPLES: Final = 16
"""Smallest number of equal samples that counts as stuck."""
WINDOW_SAMPLES: Final = 256
"""Length of the windows in which chance repeats are counted."""
MAX_CHANCE: Final = 1e-9
"""Largest probability of a run by chance."""
MIN_SIMULATED_RATIO: Final = 3.0
"""Smallest length of a run relative to the longest run of a simulation of the model."""
SAME_RUN_SHARE: Final = 0.8
"""Smallest common share of two runs that belong together."""


@dataclass(frozen=True, slots=True)
class Run:
    """Stretch of one axis with one value."""

    axis: str
    first: int  # index of the first sample
    last: int  # index after the last sample
    chance_log: float  # logarithm of the probability by chance


def check_stuck_values(
    values: Mapping[str, Floats], rate_hz: float, simulated: Mapping[str, Floats] | None
) -> tuple[dict[str, Floats], list[RecordingFinding]]:
    """Return the values with stuck samples marked as missing, and a finding for each group of stuck axes.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    simulated : mapping of str to ndarray or None
        Simulation of the model under test.
    """
    runs = [run for axis, y in values.items() if (run := find_stuck_run(axis, y, simulated)) is not None]
    marked, findings = dict(values), []
    while runs:
        together = [run for run in runs if _common_share(run, runs[0]) >= SAME_RUN_SHARE]
        runs = [run for run in runs if run not in together]
        findings.append(_describe(together, values, rate_hz))
        for run in together:
            y = marked[run.axis].copy()
            y[run.first + 1 : run.last] = np.nan
            if run.last - run.first < y.size:  # a constant axis is left out later, with a note
                marked[run.axis] = y
    return marked, findings


def find_stuck_run(axis: str, y: Floats, simulated: Mapping[str, Floats] | None) -> Run | None:
    """Return the longest run of equal values if chance does not explain the run, otherwise None.

    Parameters
    ----------
    axis : str
        Name of the axis.
    y : ndarray of float64, shape (n,)
        Samples of the axis; NaN means missing.
    simulated : mapping of str to ndarray or None
        Simulation of the model under test.
    """
    first, last = longest_run(y)
    length = last - first
    least = float(MIN_RUN_SAMPLES)
    if simulated is not None and axis in simulated:
        begin, end = longest_run(simulated[axis])
        least = max(least, MIN_SIMULATED_RATIO * (end - begin))
    if length < least:
        return None
    others = np.concatenate([y[:first], y[last:]])
    others = others[np.isfinite(others)]
    if others.size and y[first] in (others.min(), others.max()):
        return None
    repeats = np.concatenate([y[1:first] == y[: max(first - 1, 0)], y[last + 1 :] == y[last:-1]]).astype(np.float64)
    windows = repeats[: repeats.size // WINDOW_SAMPLES * WINDOW_SAMPLES].reshape(-1, WINDOW_SAMPLES).sum(axis=1)
    most = windows.max() if windows.size else repeats.sum()
    share = (most + 2.0) / (min(WINDOW_SAMPLES, repeats.size) + 3.0)
    chance_log = log(y.size) + (length - 1) * log(min(share, 1.0 - 1e-9))
    return Run(axis, first, last, chance_log) if chance_log < log(MAX_CHANCE) else None


def longest_run(y: Floats) -> tuple[int, int]:
    """Return the first index and the index after the last index of the longest run of equal values.

    Examples
    --------
    >>> longest_run(np.array([1.0, 2.0, 2.0, 2.0, 3.0]))
    (1, 4)
    """
    changes = np.flatnonzero(~(y[1:] == y[:-1])) + 1
    edges = np.concatenate([[0], changes, [y.size]])
    at = int(np.diff(edges).argmax())
    return int(edges[at]), int(edges[at + 1])


def _common_share(one: Run, other: Run) -> float:
    """Return the common length of two runs relative to the length of both together."""
    common = min(one.last, other.last) - max(one.first, other.first)
    return common / (max(one.last, other.last) - min(one.first, other.first))


def _describe(runs: list[Run], values: Mapping[str, Floats], rate_hz: float) -> RecordingFinding:
    """Return the finding for axes that are stuck at the same time."""
    axes = tuple(axis for axis in AXES if any(run.axis == axis for run in runs))
    first, last = min(run.first for run in runs), max(run.last for run in runs)
    frozen = len(axes) > 1 and len(axes) == len(values)
    begin_s, length_s = first / rate_hz, (last - first) / rate_hz
    whole = last - first == values[axes[0]].size
    what = (
        "The whole row repeats" if frozen else f"{' and '.join(axes)} {'keep' if len(axes) > 1 else 'keeps'} one value"
    )
    action = "The axis was left out." if whole else "The repeated samples were marked as missing."
    return RecordingFinding(
        "frozen_rows" if frozen else "stuck_axis",
        axes,
        f"{what} for {length_s:.5g} s from {begin_s:.5g} s. {action}",
        {"time": ParameterInterval(begin_s), "duration": ParameterInterval(length_s)},
        {"samples": float(last - first), "ln_chance": max(run.chance_log for run in runs)},
        corrected=True,
    )
