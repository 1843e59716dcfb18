"""Detect quantization steps that are large enough to distort the measured noise.

The quantization step is the smallest distance between two different values of an axis. The noise is estimated from the
mean absolute difference of successive samples, because outliers and slow drift hardly affect it.

The command ``reconcile`` uses a method that also detects steps far below the noise, see ``value_artifacts``.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats

MIN_STEP_TO_NOISE: Final = 0.5
"""Minimum ratio of the quantization step to the noise.

Smaller steps increase the noise variance by at most two percent.
"""
ROWS: Final = 4096
"""Maximum number of successive samples that are examined together."""
MAX_STRETCHES: Final = 16
GRID_TOLERANCE: Final = 0.1
"""Maximum deviation of a value from a whole number of steps, as a fraction of the step.

The tolerance allows for values that were rounded to float32.
"""
SIGMA_PER_MEAN_DISTANCE: Final = 0.8862269254527580
"""Ratio √π/2 between the standard deviation of Gaussian noise and the mean absolute difference of two samples."""


@dataclass(frozen=True, slots=True)
class QuantizationStepAndNoise:
    """Quantization step and noise of one axis."""

    axis: int  # index into AXES
    step: float  # quantization step, rad/s or m/s²
    noise: float  # standard deviation from sample to sample, rad/s or m/s²


def find_coarsely_quantized_axes(values: Floats) -> list[QuantizationStepAndNoise]:
    """Return the axes of samples [n, 6] whose quantization step is at least ``MIN_STEP_TO_NOISE`` times the noise.

    >>> noise = np.random.default_rng(0).standard_normal((20_000, 6))
    >>> noise[:, 4] = noise[:, 4].round()
    >>> [(one.axis, one.step, round(one.noise, 1)) for one in find_coarsely_quantized_axes(noise)]
    [(4, 1.0, 1.0)]
    """
    rows = min(ROWS, len(values))
    count = min(MAX_STRETCHES, -(-len(values) // ROWS))
    begins = np.linspace(0, len(values) - rows, count).astype(np.int64)
    found = []
    for axis in range(len(AXES)) if rows > 1 else ():
        parts = [values[begin : begin + rows, axis] for begin in begins]
        away = np.abs(np.concatenate([np.diff(part) for part in parts]))
        away = away[np.isfinite(away)]
        noise = SIGMA_PER_MEAN_DISTANCE * float(away.mean()) if away.size else 0.0
        levels = np.unique(np.concatenate(parts))
        step = _step(levels[np.isfinite(levels)], MIN_STEP_TO_NOISE * noise)
        if step is not None and noise > 0.0:
            found.append(QuantizationStepAndNoise(axis, step, noise))
    return found


def _step(levels: Floats, least: float) -> float | None:
    """Return the step of the regular grid on which all values lie, or None if the step is below ``least``."""
    apart = np.diff(levels)
    if not apart.size or not apart.min() >= least:
        return None
    near = apart[apart < 1.5 * apart.min()]
    counts = np.cumsum(np.rint(apart / near.mean()))
    if not np.isfinite(counts).all():
        return None
    step = float((levels[-1] - levels[0]) / counts[-1])
    return step if (np.abs((levels[1:] - levels[0]) / step - counts) < GRID_TOLERANCE).all() else None
