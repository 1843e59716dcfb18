"""Check whether the axes of a triad are in another order than in the model.

The spectrum of each recorded axis is compared with the spectrum of each axis of a simulation. One factor that all three
axes share is free, because the unit may be wrong as well. Each axis may have another noise level than in the model, and
each band another power, as real sensors do from run to run. A permutation is found if it fits clearly better than the
order of the file. Two axes with the same spectrum cannot be distinguished, and their order is kept. Noise spectra do
not show the sign of an axis.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Narrowband
from monitor.reconcile.recording_checks.block_spectra import BlockSpectrum
from monitor.reconcile.result import ParameterInterval, RecordingFinding

LEVEL_SCATTER: Final = 0.12
"""Standard deviation from run to run of the logarithm of the noise power of an axis (empirical)."""
BAND_SCATTER: Final = 0.2
"""Standard deviation from run to run of the logarithm of the power in one band, beside the level (empirical)."""
MAX_BAND_COST: Final = 10.0
"""Largest cost of one band in nats. A line that moved therefore costs little."""
MAX_AXIS_COST: Final = 32.0
"""Largest cost of the level of one axis in nats."""
CORRELATED_BANDS: Final = 3.0
"""Number of neighbouring bands that deviate together (empirical)."""
SWAP_PENALTY: Final = 1.0
"""Penalty in nats for two axes that are swapped."""
ROTATION_PENALTY: Final = 8.0
"""Penalty in nats for three axes that are moved. With two similar axes, a rotation fits as well as a swap."""
MIN_GAIN: Final = 6.0
"""Gain in nats over the order of the file that makes a permutation a finding.

None of 46 unchanged triads of real sensors gained more than 4.0 nats (``tests/experiments/blind/corruptions``).
"""
IDENTITY: Final = (0, 1, 2)


@dataclass(frozen=True, slots=True)
class TriadOrder:
    """Assignment of the recorded axes of a triad to the axes of the model."""

    order: tuple[int, ...]  # for each recorded axis, the index of the axis of the model
    gain: float  # gain in nats over the order of the file
    log_ratios: Floats  # [3] logarithm of the noise of each recorded axis relative to its axis of the model
    error: float  # standard error of the mean of ``log_ratios``, with the scatter from run to run


def find_order(
    recorded: Sequence[BlockSpectrum], simulated: Sequence[BlockSpectrum], peaks: Sequence[tuple[float, float]] = ()
) -> TriadOrder:
    """Return the best assignment of the axes of a triad.

    Parameters
    ----------
    recorded, simulated : sequence of BlockSpectrum
        Spectra of the three recorded axes and of the three axes of a simulation, in the order of their columns.
    peaks : sequence of tuple of float
        Frequency in Hz, and variance of the logarithm of the power, of each resonance of the model.
    """
    cells = [[_compare(one, other, peaks) for other in simulated] for one in recorded]
    costs = {order: _cost([cells[at][to] for at, to in enumerate(order)], order) for order in permutations(IDENTITY)}
    best = min(costs, key=lambda order: costs[order])
    gain = costs[IDENTITY] - costs[best]
    if gain < MIN_GAIN:
        best, gain = IDENTITY, 0.0
    levels = np.array([cells[at][to][0] for at, to in enumerate(best)])
    return TriadOrder(best, gain, 0.5 * levels, 0.5 * LEVEL_SCATTER / float(np.sqrt(3.0)))


def fading_peaks(effects: Iterable[Effect], length_s: float) -> list[tuple[float, float]]:
    """Return the frequency in Hz of each resonance, and the variance of the logarithm of its power.

    The power of a resonance of bandwidth b changes about π b times per second. In a recording of length T, the power
    is the mean of about 1 + π b T independent values with an exponential distribution.

    Parameters
    ----------
    effects : iterable of Effect
        Effects of the model.
    length_s : float
        Length of the recording in seconds.
    """
    return [
        (one.frequency, 2.0 / (1.0 + np.pi * one.bandwidth * length_s))
        for one in effects
        if isinstance(one, Narrowband)
    ]


def _compare(
    recorded: BlockSpectrum, simulated: BlockSpectrum, peaks: Sequence[tuple[float, float]]
) -> tuple[float, float]:
    """Return the logarithm of the ratio of the powers of two axes, and the cost in nats of their different shapes."""
    ratio = recorded.log_power - simulated.log_power
    level = float(np.median(ratio))
    variance = recorded.error**2 + simulated.error**2 + BAND_SCATTER**2
    for f_hz, of_peak in peaks:  # in the recording and in the simulation
        variance = variance + np.where(np.abs(recorded.f_hz - f_hz) <= recorded.reach_hz, 2.0 * of_peak, 0.0)
    cost = np.minimum(0.5 * (ratio - level) ** 2 / variance, MAX_BAND_COST)
    return level, max(float(cost.sum()) / CORRELATED_BANDS, float(cost.max()))  # a line is in one band


def _cost(cells: Sequence[tuple[float, float]], order: tuple[int, ...]) -> float:
    """Return the cost in nats of one assignment, with the common factor of its axes fitted."""
    levels = np.array([level for level, _ in cells])
    level_cost = np.minimum(0.5 * ((levels - np.median(levels)) / LEVEL_SCATTER) ** 2, MAX_AXIS_COST).sum()
    moved = sum(at != to for at, to in enumerate(order))
    penalty = {0: 0.0, 2: SWAP_PENALTY, 3: ROTATION_PENALTY}[moved]
    return float(level_cost) + sum(cost for _, cost in cells) + penalty


def describe_order(triad: Sequence[str], found: TriadOrder) -> RecordingFinding | None:
    """Return the finding for axes in another order, or None if the axes are in the order of the model.

    Parameters
    ----------
    triad : sequence of str
        Names of the three axes.
    found : TriadOrder
        Assignment of the axes.
    """
    moved = {triad[at]: triad[to] for at, to in enumerate(found.order) if at != to}
    if not moved:
        return None
    pairs = ", ".join(f"{column} is {axis}" for column, axis in moved.items())
    return RecordingFinding(
        "axes_permuted",
        tuple(moved),
        f"The columns of the {_kind(triad)} are in another order than in the model: {pairs}. "
        f"The columns were put in the order of the model.",
        {column: ParameterInterval(axis) for column, axis in moved.items()},
        {"gain_nats": found.gain},
        corrected=True,
    )


def reorder(values: Mapping[str, Floats], triad: Sequence[str], order: Sequence[int]) -> dict[str, Floats]:
    """Return the values with the axes of a triad in the order of the model.

    Parameters
    ----------
    values : mapping of str to ndarray
        Values of all axes.
    triad : sequence of str
        Names of the three axes.
    order : sequence of int
        For each recorded axis, the index of the axis of the model.

    Examples
    --------
    >>> reorder({"gx": 1, "gy": 2, "gz": 3}, ("gx", "gy", "gz"), (1, 2, 0))
    {'gx': 3, 'gy': 1, 'gz': 2}
    """
    moved = {triad[to]: values[triad[at]] for at, to in enumerate(order)}
    return {axis: moved.get(axis, y) for axis, y in values.items()}


def _kind(triad: Sequence[str]) -> str:
    """Return the name of the sensors of a triad."""
    return "gyroscopes" if triad[0].startswith("g") else "accelerometers"
