"""Coarse values: steps that are as large as the noise, so that quantization shapes what is seen of it.

In comes a recording; out goes, for each axis, the step of the grid that all its values lie on, and the noise from
sample to sample. Both are asked of at most MOST stretches of ROWS samples, spread over the recording. Steps are the
distances of neighbouring values that occur; the noise is by the mean distance of samples that follow each other, which
coarse steps leave as it is, and which a few outliers or a slow drift move little.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats

COARSE: Final = 0.5
"""Of the noise: smaller steps add two percent to its variance at most."""
ROWS: Final = 4096
MOST: Final = 16
"""Stretches."""
ON_GRID: Final = 0.1
"""Of a step: values nearer to a whole number of steps are on its grid, which numbers of 32 bits are."""
GAUSSIAN: Final = 0.8862269254527580
"""√π/2: σ over the mean distance of two samples, of Gaussian noise."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps of the values of one axis."""

    axis: int  # index into AXES
    step: float  # rad/s or m/s²
    noise: float  # σ from sample to sample, its quantization included, rad/s or m/s²


def coarse(values: Floats) -> list[Steps]:
    """The axes whose values [n, 6] come in steps of COARSE or more of their noise.

    >>> noise = np.random.default_rng(0).standard_normal((20_000, 6))
    >>> noise[:, 4] = noise[:, 4].round()
    >>> [(one.axis, one.step, round(one.noise, 1)) for one in coarse(noise)]
    [(4, 1.0, 1.0)]
    """
    rows = min(ROWS, len(values))
    count = min(MOST, -(-len(values) // ROWS))
    begins = np.linspace(0, len(values) - rows, count).astype(np.int64)
    found = []
    for axis in range(len(AXES)) if rows > 1 else ():
        parts = [values[begin : begin + rows, axis] for begin in begins]
        away = np.abs(np.concatenate([np.diff(part) for part in parts]))
        away = away[np.isfinite(away)]
        noise = GAUSSIAN * float(away.mean()) if away.size else 0.0
        levels = np.unique(np.concatenate(parts))
        step = _step(levels[np.isfinite(levels)], COARSE * noise)
        if step is not None and noise > 0.0:
            found.append(Steps(axis, step, noise))
    return found


def _step(levels: Floats, least: float) -> float | None:
    """The step of a grid that these values lie on, where it is ``least`` or more."""
    apart = np.diff(levels)
    if not apart.size or not apart.min() >= least:
        return None
    near = apart[apart < 1.5 * apart.min()]
    counts = np.cumsum(np.rint(apart / near.mean()))
    if not np.isfinite(counts).all():
        return None
    step = float((levels[-1] - levels[0]) / counts[-1])
    return step if (np.abs((levels[1:] - levels[0]) / step - counts) < ON_GRID).all() else None
