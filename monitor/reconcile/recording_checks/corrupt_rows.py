"""Check for single corrupt rows: a warm-up row at the start, a torn row at the end, or a spike row between them.

The distance of a sample from its neighbours is the smaller of two distances: from the median of the samples before and
from the median of the samples after. A step is therefore no spike. A row is corrupt if its distance on one axis is
large, larger than in a simulation of the model, and far larger than the distances of all other rows. Many large
distances are outliers or motion and are left to other checks and to the noise search.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats, Ints
from monitor.noise.effects import Outliers
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_DISTANCE: Final = 10.0
"""Smallest distance of a corrupt row in standard deviations of the noise from sample to sample."""
LONE_DISTANCE: Final = 50.0
"""Smallest distance of a corrupt row on a single axis if there is no model, in the same unit."""
MIN_SIMULATED_RATIO: Final = 1.5
"""Smallest distance relative to the largest distance in a simulation of the model."""
MAX_OUTLIER_SIGMA: Final = 6.0
"""Largest distance of an outlier of the model, relative to the scale of the outliers."""
MAX_ROWS: Final = 4
"""Largest number of corrupt rows in succession or at the ends. More rows are outliers or motion."""
MIN_GAP_RATIO: Final = 2.5
"""Smallest ratio of the distance of a corrupt row to the largest distance of all other rows."""
MIN_END_GAP_RATIO: Final = 1.5
"""The same ratio for rows at the ends, where corrupt rows are more likely."""
END_ROWS: Final = 3
"""Number of rows at each end that count as end rows."""
HEAD_SAMPLES: Final = 256
"""Length of a simulation of the first rows."""
HEAD_SIMULATIONS: Final = 8
"""Number of these simulations."""
MAX_HEAD_RATIO: Final = 3.0
"""Largest distance of a first row, relative to the largest distance in these simulations, that the model explains."""
NEIGHBOURS: Final = 5
"""Number of samples on each side from which the distance is measured."""
PREFILTER_DISTANCE: Final = 4.0
"""Distance between successive samples, in standard deviations, from which a sample is examined."""
SIGMA_PER_MEAN_STEP: Final = 0.8862269254527580
"""√π/2, the ratio of σ to the mean distance of two samples of Gaussian noise."""
BLOCK_SAMPLES: Final = 64
"""Length of the blocks whose median gives the noise from sample to sample."""


def check_corrupt_rows(
    values: Mapping[str, Floats],
    rate_hz: float,
    simulated: Mapping[str, Floats] | None,
    model: NoiseModel | None = None,
) -> tuple[dict[str, Floats], list[RecordingFinding]]:
    """Return the values with corrupt rows marked as missing on all axes, and the finding.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    simulated : mapping of str to ndarray or None
        Simulation of the model under test.
    model : NoiseModel or None, optional
        Model under test, whose outliers are no corrupt rows.
    """
    limits = {axis: _limit(axis, None if simulated is None else simulated[axis], model) for axis in values}
    n = next(iter(values.values())).size
    of_axes = np.zeros((len(values), n))
    for k, (axis, y) in enumerate(values.items()):
        rows, distances = distances_from_neighbours(y)
        of_axes[k, rows] = distances / limits[axis]  # 1 = at the limit
    corrupt = _drop_outliers(np.unique(np.concatenate([_corrupt_rows(one) for one in of_axes])), of_axes, model)
    if model is not None and (corrupt < END_ROWS).any():
        heads = _simulated_head_distances(model, rate_hz)
        usual = [of_axes[k, corrupt] * limits[axis] < MAX_HEAD_RATIO * heads[axis] for k, axis in enumerate(values)]
        wrong = [of_axes[k, corrupt] >= 1.0 for k in range(len(values))]
        explained = (np.logical_and(wrong, usual).sum(axis=0) > 0) & (corrupt < END_ROWS)
        corrupt = corrupt[~explained]
    if not corrupt.size:
        return dict(values), []
    axes = tuple(axis for axis, of in zip(values, of_axes, strict=True) if of[corrupt].max() >= 1.0)
    marked = {axis: y.copy() for axis, y in values.items()}
    for y in marked.values():
        y[corrupt] = np.nan
    return marked, [_describe(corrupt, n, axes, of_axes, rate_hz, list(values), limits)]


def distances_from_neighbours(y: Floats) -> tuple[Ints, Floats]:
    """Return the rows that differ from their neighbours, and their distances in standard deviations of the noise.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Samples of one axis; NaN means missing.

    Examples
    --------
    >>> y = np.tile([1.0, -1.0], 100)
    >>> y[50] = 41.0
    >>> rows, distances = distances_from_neighbours(y)
    >>> int(rows[distances.argmax()])
    50
    """
    sigma = noise_of_samples(y)
    if not sigma > 0.0:
        return np.empty(0, np.int64), np.empty(0)
    steps = np.abs(np.diff(y)) > PREFILTER_DISTANCE * sigma
    some = np.zeros(y.size, np.bool_)
    some[1:] |= steps
    some[:-1] |= steps
    some[1:-1] |= some[2:] | some[:-2]  # rows inside a short run of corrupt rows have no steps
    rows = np.flatnonzero(some)
    away = np.arange(1, NEIGHBOURS + 1)
    padded = np.concatenate([np.full(NEIGHBOURS, np.nan), y, np.full(NEIGHBOURS, np.nan)])
    before = _median(padded[rows[:, None] + NEIGHBOURS - away])
    after = _median(padded[rows[:, None] + NEIGHBOURS + away])
    distance = np.fmin(np.abs(y[rows] - before), np.abs(y[rows] - after)) / sigma
    return rows, np.where(np.isfinite(distance), distance, 0.0)


def noise_of_samples(y: Floats) -> float:
    """Return the standard deviation from sample to sample, from the median of blocks; 0 without complete blocks.

    A missing sample makes its block incomplete.
    """
    steps = np.abs(np.diff(y))
    blocks = steps[: steps.size // BLOCK_SAMPLES * BLOCK_SAMPLES].reshape(-1, BLOCK_SAMPLES).mean(axis=1)
    blocks = blocks[np.isfinite(blocks)]
    return SIGMA_PER_MEAN_STEP * float(np.median(blocks)) if blocks.size else 0.0


def _median(windows: Floats) -> Floats:
    """Return the median of each row of an array, without NaN; NaN if there are fewer than three samples."""
    if not windows.size:
        return np.empty(len(windows))
    ordered = np.sort(windows, axis=1)  # NaN last
    counts = np.isfinite(windows).sum(axis=1)
    at = np.arange(len(windows))
    low, high = ordered[at, np.maximum(counts - 1, 0) // 2], ordered[at, np.minimum(counts // 2, windows.shape[1] - 1)]
    return np.where(counts >= 3, 0.5 * (low + high), np.nan)


def _corrupt_rows(distance: Floats) -> Ints:
    """Return the corrupt rows, given for each row its distance relative to the limit."""
    n = distance.size
    order = np.argsort(distance)[::-1][: MAX_ROWS + 1]
    for count in range(min(MAX_ROWS, order.size - 1), 0, -1):
        rows, least = order[:count], distance[order[count - 1]]
        at_end = bool(((rows < END_ROWS) | (rows >= n - END_ROWS)).all())
        if not at_end and np.ptp(rows) >= MAX_ROWS:
            continue  # separate rows are outliers
        gap = MIN_END_GAP_RATIO if at_end else MIN_GAP_RATIO
        if least >= 1.0 and least >= gap * distance[order[count]]:
            return np.sort(rows)
    return np.empty(0, np.int64)


def _drop_outliers(rows: Ints, of_axes: Floats, model: NoiseModel | None) -> Ints:
    """Return the rows without those between the ends that are rather outliers.

    Outliers occur at several times. Without a model, a moderate distance on one axis may be an outlier, too.
    """
    at_end = (rows < END_ROWS) | (rows >= of_axes.shape[1] - END_ROWS)
    middle = rows[~at_end]
    if not middle.size:
        return rows
    far = of_axes[:, middle]
    moderate = far.max() < LONE_DISTANCE / MIN_DISTANCE and (far >= 1.0).any(axis=1).sum() < 2
    return rows[at_end] if np.ptp(middle) >= MAX_ROWS or (model is None and moderate) else rows


def _simulated_head_distances(model: NoiseModel, rate_hz: float) -> dict[str, float]:
    """Return for each axis the largest distance of the first rows in short simulations of the model.

    A filter of the model starts in the state of its first sample. If the filter removes strong noise, this start is
    visible in the first rows.
    """
    found = dict.fromkeys(AXES, 0.0)
    temperature_c = np.full(HEAD_SAMPLES, 25.0)
    for seed in range(HEAD_SIMULATIONS):
        drawn = model.simulate(HEAD_SAMPLES, rate_hz, seed, temperature_c)
        for k, axis in enumerate(AXES):
            y = drawn[:, k]
            sigma = noise_of_samples(y[END_ROWS:])
            if sigma > 0.0:
                away = [abs(y[row] - np.median(y[row + 1 : row + 1 + NEIGHBOURS])) for row in range(END_ROWS)]
                found[axis] = max(found[axis], float(max(away)) / sigma)
    return found


def _limit(axis: str, simulated: Floats | None, model: NoiseModel | None) -> float:
    """Return the smallest distance of a corrupt row on one axis in standard deviations of the noise."""
    if simulated is None or model is None:
        return MIN_DISTANCE
    _, distances = distances_from_neighbours(simulated)
    scales = [effect.scale for effect in model.effects.get(axis, ()) if isinstance(effect, Outliers)]
    outliers = MAX_OUTLIER_SIGMA * max(scales, default=0.0) / max(noise_of_samples(simulated), 1e-300)
    return max(MIN_DISTANCE, MIN_SIMULATED_RATIO * float(distances.max(initial=0.0)), outliers)


def _describe(
    rows: Ints,
    n: int,
    axes: tuple[str, ...],
    of_axes: Floats,
    rate_hz: float,
    names: list[str],
    limits: Mapping[str, float],
) -> RecordingFinding:
    """Return the finding."""
    which = ", ".join(_name_of_row(int(row), n, rate_hz) for row in rows)
    k = int(of_axes[:, rows].max(axis=1).argmax())
    most = float(of_axes[k, rows].max()) * limits[names[k]]
    plural = rows.size > 1
    return RecordingFinding(
        "corrupt_rows",
        tuple(axis for axis in AXES if axis in axes),
        f"{which} {'are' if plural else 'is'} corrupt: {names[k]} differs from its neighbours by {most:.3g} standard "
        f"deviations. The {'rows were' if plural else 'row was'} marked as missing.",
        {"time": ParameterInterval(float(rows[0]) / rate_hz)},
        {
            "rows": float(rows.size),
            "first_row": float(rows[0]),
            "distance_sigma": most,
            "limit_sigma": limits[names[k]],
        },
        corrected=True,
    )


def _name_of_row(row: int, n: int, rate_hz: float) -> str:
    """Return a text for a row."""
    if row < END_ROWS:
        return "The first row" if row == 0 else f"Row {row + 1}"
    return "The last row" if row == n - 1 else f"The row at {row / rate_hz:.6g} s"
