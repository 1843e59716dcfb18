"""Check for missing rows, for rows that repeat the previous row, and for runs of equal values."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import log
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.estimation.detection.repeated_share import estimate_stale_sample_share
from monitor.noise.effects import RandomSampleHold
from monitor.reconcile.recording_checks.recording_under_test import CheckResult, RecordingUnderTest
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_AXES: Final = 3
"""Smallest number of axes with varying values."""
MIN_SHARE: Final = 0.02
"""Smallest share of repeated rows that is reported."""
MAX_CHANCE_SHARE: Final = 0.1
"""Largest share of rows that repeat by chance. If the resolution is too coarse, the share is larger."""
MIN_RUN_SAMPLES: Final = 16
"""Smallest number of equal samples in a run that is reported."""
WINDOW_SAMPLES: Final = 256
"""Number of samples in a window for the estimate of how often values repeat by chance."""
MAX_CHANCE: Final = 1e-9
"""Largest probability that a reported run occurs by chance."""
MIN_SIMULATED_RATIO: Final = 3.0
"""Smallest length of a run relative to the longest run in a simulation of the model."""
SAME_RUN_SHARE: Final = 0.8
"""Smallest overlap of two runs that are reported together, as a fraction of the total duration."""


def check_missing_rows(recording: RecordingUnderTest) -> CheckResult:
    """Report rows that are missing on all axes."""
    values, rate_hz = recording.values, recording.rate_hz
    missing = np.logical_and.reduce([~np.isfinite(y) for y in values.values()])
    if not missing.any():
        return values, []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2]
    longest = int(lengths.argmax())
    begin_s, duration_s = edges[2 * longest] / rate_hz, lengths[longest] / rate_hz
    rows, holes = int(missing.sum()), lengths.size
    where = f"in one hole at {begin_s:.5g} s" if holes == 1 else f"in {holes} holes, the longest at {begin_s:.5g} s"
    return values, [
        RecordingFinding(
            "missing_rows",
            tuple(values),
            f"{rows} of {missing.size} rows are missing {where} for {duration_s:.3g} s. "
            "The missing samples were drawn with the spectrum of the noise.",
            {"time": ParameterInterval(begin_s), "duration": ParameterInterval(duration_s)},
            {"rows": float(rows), "holes": float(holes), "share": rows / missing.size},
            corrected=True,
        )
    ]


def check_repeated_rows(recording: RecordingUnderTest) -> CheckResult:
    """Report rows that repeat on all axes more often than by chance.

    Such rows occur throughout a recording that was resampled to a higher rate. Quantized values also repeat by chance,
    but independently on each axis. The proportion of rows in which all axes repeat is therefore compared with the
    product of the proportions for the individual axes. The rows are kept, because the search for noise effects
    describes the repeats. Repeats are not reported if the model contains a random sample hold.
    """
    values, rate_hz, model = recording.values, recording.rate_hz, recording.model
    if model is not None and any(isinstance(effect, RandomSampleHold) for _, effect in model):
        return values, []
    varying = [y for y in values.values() if np.isfinite(y).any() and np.nanmin(y) < np.nanmax(y)]
    if len(varying) < MIN_AXES:
        return values, []
    by_chance = float(np.prod([np.mean(y[1:] == y[:-1]) for y in varying]))
    if by_chance > MAX_CHANCE_SHARE:
        return values, []
    share = estimate_stale_sample_share(np.column_stack(varying))
    if share < MIN_SHARE:
        return values, []
    n = varying[0].size
    error = 2.0 * (share * (1.0 - share) / n) ** 0.5
    return values, [
        RecordingFinding(
            "repeated_rows",
            tuple(axis for axis in AXES if axis in values),
            f"{100.0 * share:.3g} % of the rows repeat the previous row on all axes. "
            f"The sensor had {rate_hz * (1.0 - share):.4g} new measurements per second. The rows were not changed.",
            {"share": ParameterInterval(share, max(share - error, 0.0), share + error)},
            {"share_by_chance": by_chance},
            corrected=False,
        )
    ]


@dataclass(frozen=True, slots=True)
class Run:
    """Run of equal values on one axis."""

    axis: str
    first: int  # index of the first sample
    last: int  # index after the last sample
    chance_log: float  # logarithm of the probability by chance


def check_stuck_values(recording: RecordingUnderTest) -> CheckResult:
    """Mark stuck samples as missing, with a finding for each group of stuck axes.

    Quantized values also repeat by chance. The length of a run is therefore compared with the repeats in the rest of
    the recording and with the longest run in a simulation of the model. A run at the largest or smallest value of the
    axis may be clipping, which the search for noise effects handles.
    """
    values, simulated = recording.values, recording.simulated
    runs = [run for axis, y in values.items() if (run := find_stuck_run(axis, y, simulated)) is not None]
    marked, findings = dict(values), []
    while runs:
        together = [run for run in runs if _overlap_fraction(run, runs[0]) >= SAME_RUN_SHARE]
        runs = [run for run in runs if run not in together]
        findings.append(_describe_stuck_values(together, values, recording.rate_hz))
        for run in together:
            y = marked[run.axis].copy()
            y[run.first + 1 : run.last] = np.nan
            if run.last - run.first < y.size:  # ``select_axes_and_smooth_temperature`` excludes a constant axis
                marked[run.axis] = y
    return marked, findings


def find_stuck_run(axis: str, y: Floats, simulated: Mapping[str, Floats] | None) -> Run | None:
    """Find the longest run of equal values, or return None if the run may occur by chance.

    Parameters
    ----------
    axis : str
        Name of the axis.
    y : ndarray of float64, shape (n,)
        Samples of the axis; NaN means missing.
    simulated : mapping of str to ndarray or None
        Simulation of the model under test.
    """
    first, last = find_longest_run_bounds(y)
    length = last - first
    least = float(MIN_RUN_SAMPLES)
    if simulated is not None and axis in simulated:
        begin, end = find_longest_run_bounds(simulated[axis])
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


def find_longest_run_bounds(y: Floats) -> tuple[int, int]:
    """Return the first index and the index after the last index of the longest run of equal values.

    Examples
    --------
    >>> find_longest_run_bounds(np.array([1.0, 2.0, 2.0, 2.0, 3.0]))
    (1, 4)
    """
    changes = np.flatnonzero(~(y[1:] == y[:-1])) + 1
    edges = np.concatenate([[0], changes, [y.size]])
    at = int(np.diff(edges).argmax())
    return int(edges[at]), int(edges[at + 1])


def _overlap_fraction(one: Run, other: Run) -> float:
    """Return the overlap of two runs as a fraction of the time from the first start to the last end."""
    common = min(one.last, other.last) - max(one.first, other.first)
    return common / (max(one.last, other.last) - min(one.first, other.first))


def _describe_stuck_values(runs: list[Run], values: Mapping[str, Floats], rate_hz: float) -> RecordingFinding:
    axes = tuple(axis for axis in AXES if any(run.axis == axis for run in runs))
    first, last = min(run.first for run in runs), max(run.last for run in runs)
    frozen = len(axes) > 1 and len(axes) == len(values)
    begin_s, duration_s = first / rate_hz, (last - first) / rate_hz
    whole = last - first == values[axes[0]].size
    what = (
        "The whole row repeats" if frozen else f"{' and '.join(axes)} {'keep' if len(axes) > 1 else 'keeps'} one value"
    )
    action = "The axis was left out." if whole else "The repeated samples were marked as missing."
    return RecordingFinding(
        "frozen_rows" if frozen else "stuck_axis",
        axes,
        f"{what} for {duration_s:.5g} s from {begin_s:.5g} s. {action}",
        {"time": ParameterInterval(begin_s), "duration": ParameterInterval(duration_s)},
        {"samples": float(last - first), "ln_chance": max(run.chance_log for run in runs)},
        corrected=True,
    )
