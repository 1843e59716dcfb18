"""Check for single corrupt rows, such as a first row from the warm-up, an incomplete last row, or a spike.

The distance of a sample is the smaller of the differences from the median of the samples before and from the median of
the samples after. A step therefore has a small distance. A row is corrupt if the distance on one axis exceeds three
limits: a fixed limit, the distances in a simulation of the model, and a multiple of the distances of all other rows.
Many large distances are outliers or motion, which other checks and the search for noise effects handle.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats, Ints
from monitor.noise.effects import Outliers
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.recording_under_test import CheckResult, RecordingUnderTest
from monitor.reconcile.result import ParameterInterval, RecordingFinding

MIN_DISTANCE: Final = 10.0
"""Smallest distance of a corrupt row in standard deviations of the sample noise."""
MIN_SINGLE_AXIS_DISTANCE: Final = 50.0
"""Smallest distance of a corrupt row on a single axis without a model, in standard deviations of the sample noise."""
MIN_SIMULATED_RATIO: Final = 1.5
"""Smallest distance relative to the largest distance in a simulation of the model."""
MAX_OUTLIER_SIGMA: Final = 6.0
"""Largest distance of an outlier of the model, relative to the scale of the outliers."""
MAX_ROWS: Final = 4
"""Largest number of successive corrupt rows, or of corrupt rows at the ends. More rows are outliers or motion."""
MIN_GAP_RATIO: Final = 2.5
"""Smallest ratio of the distance of a corrupt row to the largest distance of all other rows."""
MIN_END_GAP_RATIO: Final = 1.5
"""Smallest ratio of these distances for rows at the ends, where corrupt rows are more likely."""
END_ROWS: Final = 3
"""Number of rows at each end that count as end rows."""
SIMULATED_HEAD_SAMPLES: Final = 256
"""Number of samples in a simulation of the first rows."""
HEAD_SIMULATIONS: Final = 8
MAX_HEAD_RATIO: Final = 3.0
"""Largest distance of a first row that the model can explain, relative to the largest simulated distance."""
NEIGHBOURS: Final = 5
"""Number of samples on each side that contribute to the median."""
PREFILTER_DISTANCE: Final = 4.0
"""Difference between successive samples, in standard deviations, above which the samples are examined."""
SIGMA_PER_MEAN_STEP: Final = 0.8862269254527580
"""√π/2, the ratio of σ to the mean absolute difference of two samples of Gaussian noise."""
BLOCK_SAMPLES: Final = 64
"""Number of samples in a block for the estimate of the sample noise."""


def check_corrupt_rows(recording: RecordingUnderTest) -> CheckResult:
    """Mark corrupt rows as missing on all axes. Outliers of the model are not reported."""
    values, rate_hz, model, simulated = recording.values, recording.rate_hz, recording.model, recording.simulated
    limits = {axis: _distance_limit(axis, None if simulated is None else simulated[axis], model) for axis in values}
    n = recording.sample_count
    of_axes = np.zeros((len(values), n))
    for k, (axis, y) in enumerate(values.items()):
        rows, distances = compute_distances_from_neighbours(y)
        of_axes[k, rows] = distances / limits[axis]  # relative to the limit
    corrupt = _exclude_outliers(np.unique(np.concatenate([_find_corrupt_rows(one) for one in of_axes])), of_axes, model)
    if model is not None and (corrupt < END_ROWS).any():
        heads = _simulate_head_distances(model, rate_hz)
        usual = [of_axes[k, corrupt] * limits[axis] < MAX_HEAD_RATIO * heads[axis] for k, axis in enumerate(values)]
        wrong = [of_axes[k, corrupt] >= 1.0 for k in range(len(values))]
        explained = (np.logical_and(wrong, usual).sum(axis=0) > 0) & (corrupt < END_ROWS)
        corrupt = corrupt[~explained]
    if not corrupt.size:
        return values, []
    axes = tuple(axis for axis, of in zip(values, of_axes, strict=True) if of[corrupt].max() >= 1.0)
    marked = {axis: y.copy() for axis, y in values.items()}
    for y in marked.values():
        y[corrupt] = np.nan
    return marked, [_describe(corrupt, n, axes, of_axes, rate_hz, list(values), limits)]


def compute_distances_from_neighbours(y: Floats) -> tuple[Ints, Floats]:
    """Return the rows that differ from neighbouring rows, and the distances in standard deviations of the sample noise.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Samples of one axis; NaN means missing.

    Examples
    --------
    >>> y = np.tile([1.0, -1.0], 100)
    >>> y[50] = 41.0
    >>> rows, distances = compute_distances_from_neighbours(y)
    >>> int(rows[distances.argmax()])
    50
    """
    sigma = estimate_sample_noise(y)
    if not sigma > 0.0:
        return np.empty(0, np.int64), np.empty(0)
    steps = np.abs(np.diff(y)) > PREFILTER_DISTANCE * sigma
    some = np.zeros(y.size, np.bool_)
    some[1:] |= steps
    some[:-1] |= steps
    some[1:-1] |= some[2:] | some[:-2]  # a row between corrupt rows need not differ from them
    rows = np.flatnonzero(some)
    away = np.arange(1, NEIGHBOURS + 1)
    padded = np.concatenate([np.full(NEIGHBOURS, np.nan), y, np.full(NEIGHBOURS, np.nan)])
    before = _median_of_windows(padded[rows[:, None] + NEIGHBOURS - away])
    after = _median_of_windows(padded[rows[:, None] + NEIGHBOURS + away])
    distance = np.fmin(np.abs(y[rows] - before), np.abs(y[rows] - after)) / sigma
    return rows, np.where(np.isfinite(distance), distance, 0.0)


def estimate_sample_noise(y: Floats) -> float:
    """Estimate the standard deviation of the sample noise as the median over blocks.

    Blocks with missing samples are not used. If no block remains, the result is 0.
    """
    steps = np.abs(np.diff(y))
    blocks = steps[: steps.size // BLOCK_SAMPLES * BLOCK_SAMPLES].reshape(-1, BLOCK_SAMPLES).mean(axis=1)
    blocks = blocks[np.isfinite(blocks)]
    return SIGMA_PER_MEAN_STEP * float(np.median(blocks)) if blocks.size else 0.0


def _median_of_windows(windows: Floats) -> Floats:
    """Return the median of each row without NaN, or NaN if a row has fewer than three samples."""
    if not windows.size:
        return np.empty(len(windows))
    ordered = np.sort(windows, axis=1)  # NaN last
    counts = np.isfinite(windows).sum(axis=1)
    at = np.arange(len(windows))
    low, high = ordered[at, np.maximum(counts - 1, 0) // 2], ordered[at, np.minimum(counts // 2, windows.shape[1] - 1)]
    return np.where(counts >= 3, 0.5 * (low + high), np.nan)


def _find_corrupt_rows(distance: Floats) -> Ints:
    """Return the indices of the corrupt rows. ``distance`` is relative to the limit of the axis."""
    n = distance.size
    largest = np.argpartition(distance, max(n - MAX_ROWS - 1, 0))[max(n - MAX_ROWS - 1, 0) :]
    order = largest[np.argsort(distance[largest])[::-1]]
    for count in range(min(MAX_ROWS, order.size - 1), 0, -1):
        rows, least = order[:count], distance[order[count - 1]]
        at_end = bool(((rows < END_ROWS) | (rows >= n - END_ROWS)).all())
        if not at_end and np.ptp(rows) >= MAX_ROWS:
            continue  # separate rows are outliers
        gap = MIN_END_GAP_RATIO if at_end else MIN_GAP_RATIO
        if least >= 1.0 and least >= gap * distance[order[count]]:
            return np.sort(rows)
    return np.empty(0, np.int64)


def _exclude_outliers(rows: Ints, of_axes: Floats, model: NoiseModel | None) -> Ints:
    """Return the corrupt rows, except for rows that may be outliers. Rows at the ends are kept.

    Outliers occur at several times. Without a model, a moderate distance on a single axis may also be an outlier.
    """
    at_end = (rows < END_ROWS) | (rows >= of_axes.shape[1] - END_ROWS)
    middle = rows[~at_end]
    if not middle.size:
        return rows
    far = of_axes[:, middle]
    moderate = far.max() < MIN_SINGLE_AXIS_DISTANCE / MIN_DISTANCE and (far >= 1.0).any(axis=1).sum() < 2
    return rows[at_end] if np.ptp(middle) >= MAX_ROWS or (model is None and moderate) else rows


def _simulate_head_distances(model: NoiseModel, rate_hz: float) -> dict[str, float]:
    """Return for each axis the largest distance of the first rows in short simulations of the model.

    A low-pass filter of the model starts at the first sample. If the filter removes strong noise, the first rows differ
    from the following rows.
    """
    found = dict.fromkeys(AXES, 0.0)
    temperature_c = np.full(SIMULATED_HEAD_SAMPLES, 25.0)
    for seed in range(HEAD_SIMULATIONS):
        drawn = model.simulate(SIMULATED_HEAD_SAMPLES, rate_hz, seed, temperature_c)
        for k, axis in enumerate(AXES):
            y = drawn[:, k]
            sigma = estimate_sample_noise(y[END_ROWS:])
            if sigma > 0.0:
                away = [abs(y[row] - np.median(y[row + 1 : row + 1 + NEIGHBOURS])) for row in range(END_ROWS)]
                found[axis] = max(found[axis], float(max(away)) / sigma)
    return found


def _distance_limit(axis: str, simulated: Floats | None, model: NoiseModel | None) -> float:
    """Return the smallest distance of a corrupt row on one axis, in standard deviations of the sample noise."""
    if simulated is None or model is None:
        return MIN_DISTANCE
    _, distances = compute_distances_from_neighbours(simulated)
    scales = [effect.scale for effect in model.effects.get(axis, ()) if isinstance(effect, Outliers)]
    outliers = MAX_OUTLIER_SIGMA * max(scales, default=0.0) / max(estimate_sample_noise(simulated), 1e-300)
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
    which = ", ".join(_row_text(int(row), n, rate_hz) for row in rows)
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


def _row_text(row: int, n: int, rate_hz: float) -> str:
    if row < END_ROWS:
        return "The first row" if row == 0 else f"Row {row + 1}"
    return "The last row" if row == n - 1 else f"The row at {row / rate_hz:.6g} s"
