"""Samples of a single noise source."""

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import RunningSource, SampleBlockContext


def draw_next_samples(series: RunningSource, n: int, first_index: int = 0) -> Floats:
    """Return the next samples of a time series.

    Parameters
    ----------
    series : RunningSource
        Time series of a source.
    n : int
        Number of samples.
    first_index : int
        Index of the first sample, counted from the start of the simulation.
    """
    values = np.zeros(n)
    if n:
        series.add_next_samples(values, SampleBlockContext(first_index, np.full(n, np.nan), np.empty(n)))
    return values
