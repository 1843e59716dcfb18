"""Check for single rows that repeat the previous row because the sensor had no new measurement.

Such rows occur throughout a recording that was resampled to a higher rate. Quantized values also repeat by chance, but
independently on each axis. The check therefore compares the share of rows that repeat on all axes with the product of
the shares of single axes. The rows are kept, because the search for noise effects describes the repeats on each axis.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.estimation.detection.repeated_share import estimate_stale_sample_share
from monitor.noise.effects import RandomSampleHold
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_AXES: Final = 3
"""Smallest number of axes with varying values."""
MIN_SHARE: Final = 0.02
"""Smallest share of repeated rows that is reported."""
MAX_CHANCE_SHARE: Final = 0.1
"""Largest share of rows that repeat by chance. If the resolution is too coarse, the share is larger."""


def check_repeated_rows(
    values: Mapping[str, Floats], rate_hz: float, model: NoiseModel | None
) -> list[RecordingFinding]:
    """Report rows that repeat on all axes more often than by chance.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    model : NoiseModel or None
        Model under test. Repeats are not reported if the model contains a random sample hold.
    """
    if model is not None and any(isinstance(effect, RandomSampleHold) for _, effect in model):
        return []
    varying = [y for y in values.values() if np.isfinite(y).any() and np.nanmin(y) < np.nanmax(y)]
    if len(varying) < MIN_AXES:
        return []
    by_chance = float(np.prod([np.mean(y[1:] == y[:-1]) for y in varying]))
    if by_chance > MAX_CHANCE_SHARE:
        return []
    share = estimate_stale_sample_share(np.column_stack(varying))
    if share < MIN_SHARE:
        return []
    n = varying[0].size
    error = 2.0 * (share * (1.0 - share) / n) ** 0.5
    return [
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
