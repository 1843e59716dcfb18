"""Check for single rows that repeat the previous row because the sensor had no new measurement.

The repeats are spread over the recording, as after resampling to a higher rate. Quantized axes repeat by chance too,
but independently of each other. The check therefore compares the share of rows that repeat on all axes with the
product of the shares of the axes. The rows are not removed, because the noise search describes them as sample hold on
each axis.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.estimation.detection.repeated_samples import repeated_share
from monitor.noise.effects import SampleHold
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_AXES: Final = 3
"""Smallest number of varying axes for the check."""
MIN_SHARE: Final = 0.02
"""Smallest share of repeated rows that is a finding."""
MAX_CHANCE_SHARE: Final = 0.1
"""Largest product of the shares of repeats of the axes. Coarser values repeat too often by chance."""


def check_repeated_rows(
    values: Mapping[str, Floats], rate_hz: float, model: NoiseModel | None
) -> list[RecordingFinding]:
    """Return a finding if whole rows repeat more often than chance allows.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    model : NoiseModel or None
        Model under test. If it contains sample hold, nothing is reported.
    """
    if model is not None and any(isinstance(effect, SampleHold) for _, effect in model):
        return []
    varying = [y for y in values.values() if np.isfinite(y).any() and np.nanmin(y) < np.nanmax(y)]
    if len(varying) < MIN_AXES:
        return []
    by_chance = float(np.prod([np.mean(y[1:] == y[:-1]) for y in varying]))
    if by_chance > MAX_CHANCE_SHARE:
        return []
    share = repeated_share(np.column_stack(varying))
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
