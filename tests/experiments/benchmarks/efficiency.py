"""Errors of the coefficients relative to the Cramér–Rao limit, compared with the methods of other programs.

    python -m tests.experiments.benchmarks.efficiency --json efficiency.jsonl  # all cells, 300 records each
    python -m tests.experiments.benchmarks.efficiency --json efficiency.jsonl --records 1200    # add more

With ``--records 0 --page docs/measurements/statistics.md``, the program only writes the tables into the page.

A cell is a noise and a length of record at 100 Hz. For each cell, estimator and term, the table contains the rms
relative error of the coefficient divided by its Cramér–Rao limit. If the limit is above 15 %, the ratio is in
parentheses. An estimator that is clipped at zero can then be better than any unbiased estimator.

``ESTIMATORS`` maps a name to a function of values [n, 6] and rate that returns Q N B K R [5, 6]. The methods of the
other programs are implemented here after their sources:

- imu_utils: overlapping variances at up to 100 cluster sizes in logarithmic steps, up to the power of two below
  half the record; least squares of log σ² in five terms, all τ alike, from the least-squares polynomial of σ in √τ
  to the minimum (by Levenberg and Marquardt, there by Powell's dogleg).
- allan_variance_ros has no fit of five terms: variances without overlap at τ = 0.1, 0.2 … 999.9 s; N from a line of
  slope −½ through log σ below 10 s, read at 1 s; K from a line of slope +½ through all of log σ, read at 3 s; B the
  lowest σ, divided here by 0.664, which that program leaves to its user; slopes may be 0.001 more, as there.
- five terms, unweighted: non-negative least squares of σ² on the octave curve.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Final

import numpy as np
from scipy.optimize import least_squares, nnls

from drivers.data_types import Floats, Ints
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar, rate_slope_from_thirds, rate_slope_per_tau
from monitor.estimation.allan.uncertainty import CovarianceTable, covariance_table
from monitor.estimation.fit.coefficient_fit import (
    DesignMatrix,
    MeasuredVariancesAndSlopes,
    fit_coefficients,
    make_design_matrix,
)
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from tests.experiments.benchmarks.records import (
    HOURS_3,
    MIN_45,
    MIX,
    RATE_HZ,
    Chunk,
    Noise,
    cramer_rao,
    format_length,
    format_table,
    group_chunks,
    run_experiment,
    simulate_chunk,
)

CELLS: Final = {
    "mix": MIX,
    "mix with K × 4": Noise(MIX.Q, MIX.N, MIX.B, 4.0 * MIX.K),
    "mix with K × 10": Noise(MIX.Q, MIX.N, MIX.B, 10.0 * MIX.K),
    "mix with B × 3": Noise(MIX.Q, MIX.N, 3.0 * MIX.B, MIX.K),
}
MAX_COMPARED_LIMIT: Final = 0.15
"""Largest limit for which a ratio is compared with its target."""
TARGETS: Final[Mapping[str, Mapping[str, float]]] = {
    "live fit": {"Q": 1.2, "N": 1.15, "B": 1.1, "K": 1.3},
    "offline fit": {"Q": 1.1, "N": 1.1, "B": 1.1, "K": 1.25},
}
IMU_UTILS_CLUSTERS: Final = 100
FLICKER_DEVIATION: Final = float(np.sqrt(2.0 * np.log(2.0) / np.pi))
"""Allan deviation of 1/f noise with B = 1."""

Estimator = Callable[[Floats, float], Floats]


@cache
def _octaves(n: int, rate_hz: float) -> tuple[Ints, DesignMatrix, CovarianceTable]:
    factors = cluster_sizes(n, rate_hz)
    return factors, make_design_matrix(factors, rate_hz), covariance_table(n, factors)


def live_fit(values: Floats, rate_hz: float) -> Floats:
    """Run the fit of the live service."""
    return _fit(values, rate_hz, full=False)


def offline_fit(values: Floats, rate_hz: float) -> Floats:
    """Run the fit of ``analyze``."""
    return _fit(values, rate_hz, full=True)


def _fit(values: Floats, rate_hz: float, full: bool) -> Floats:
    factors, columns, covariances = _octaves(len(values), rate_hz)
    avar, terms = overlapping_avar(values, factors)
    straight, each = rate_slope_from_thirds(values) * rate_hz, rate_slope_per_tau(values, factors) * rate_hz
    found = fit_coefficients(
        columns, covariances, MeasuredVariancesAndSlopes(avar, terms, straight, each), full_covariance=full
    )
    return np.asarray(np.sqrt(np.maximum(found.theta, 0.0)))


def unweighted(values: Floats, rate_hz: float) -> Floats:
    """Fit five terms with equal weights of all τ."""
    factors = cluster_sizes(len(values), rate_hz)
    shapes = _shapes(factors / rate_hz)
    scale: Floats = np.linalg.norm(shapes, axis=0)
    avar, _ = overlapping_avar(values, factors)
    squares = np.stack([nnls(shapes / scale, column)[0] / scale for column in avar.T], axis=1)
    return np.asarray(np.sqrt(squares))


def imu_utils(values: Floats, rate_hz: float) -> Floats:
    """Fit five terms by least squares of log σ², as imu_utils does."""
    longest = 2.0 ** np.floor(np.log2(len(values) // 2))
    factors = np.unique(np.ceil(np.geomspace(1.0, longest, IMU_UTILS_CLUSTERS) - 1e-9)).astype(np.int64)
    avar, _ = overlapping_avar(values, factors)
    tau = factors / rate_hz
    found = [_log_squares(tau, column) for column in avar.T]
    # from the bare powers of τ to the coefficients of IEEE Std 952
    return np.asarray(np.stack(found, axis=1) / np.sqrt([[3.0], [1.0], [FLICKER_DEVIATION**2], [1.0 / 3.0], [0.5]]))


def _log_squares(tau: Floats, avar: Floats) -> Floats:
    powers = tau[:, None] ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    start = np.abs(np.linalg.lstsq(np.sqrt(powers), np.sqrt(avar), rcond=None)[0])

    def misfit(p: Floats) -> Floats:
        return np.asarray(np.log10(powers @ p**2 / avar))

    def slopes(p: Floats) -> Floats:
        return np.asarray(2.0 / np.log(10.0) * powers * p / (powers @ p**2)[:, None])

    return np.asarray(np.abs(least_squares(misfit, start, jac=slopes, x_scale="jac", method="lm").x))


def allan_variance_ros(values: Floats, rate_hz: float) -> Floats:
    """Fit lines to the logarithms, as allan_variance_ros does, without Q and R."""
    tau = 0.1 * np.arange(1, 10_000)
    factors = np.rint(tau * rate_hz).astype(np.int64)
    short = factors <= len(values) // 2
    tau, factors = tau[short], factors[short]
    phase = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - values.mean(axis=0), axis=0)])
    deviation = np.stack([_second_difference_rms(phase[::m]) / (m * np.sqrt(2.0)) for m in factors])
    found = np.full((len(SYMBOLS), values.shape[1]), np.nan)
    found[SYMBOLS.index("N")] = _line(tau[tau < 9.95], deviation[tau < 9.95], -0.5, at=1.0)
    found[SYMBOLS.index("B")] = deviation.min(axis=0) / FLICKER_DEVIATION
    found[SYMBOLS.index("K")] = _line(tau, deviation, 0.5, at=3.0)
    return found


def _second_difference_rms(phase: Floats) -> Floats:
    """Return the rms of the second differences of clusters that do not overlap."""
    return np.asarray(np.sqrt(np.mean(np.diff(phase, n=2, axis=0) ** 2, axis=0)))


def _line(tau: Floats, deviation: Floats, slope: float, at: float) -> Floats:
    """Return the value at ``at`` of the least-squares line with a slope between ``slope`` and ``slope`` + 0.001."""
    x, y = np.log(tau), np.log(deviation)
    best = ((x - x.mean()) @ (y - y.mean(axis=0))) / np.sum((x - x.mean()) ** 2)
    return np.asarray(np.exp(y.mean(axis=0) + np.clip(best, slope, slope + 0.001) * (np.log(at) - x.mean())))


def _shapes(tau: Floats) -> Floats:
    """Return the Allan variances of coefficients of 1 (IEEE Std 952)."""
    return np.stack([3.0 / tau**2, 1.0 / tau, np.full_like(tau, FLICKER_DEVIATION**2), tau / 3.0, tau**2 / 2.0], axis=1)


ESTIMATORS: Final[Mapping[str, Estimator]] = {
    "live fit": live_fit,
    "offline fit": offline_fit,
    "five terms, unweighted": unweighted,
    "as imu_utils": imu_utils,
    "as allan_variance_ros": allan_variance_ros,
}


def count(cell: str, seconds: int, seed: int, chunk: int) -> Chunk:
    """Return the sums of the relative error, its square and its fourth power over one chunk."""
    noise = CELLS[cell]
    truth = np.array([[getattr(noise, letter)] for letter in "QNBK"])
    sums = {name: np.zeros((3, 4)) for name in ESTIMATORS}
    for values in simulate_chunk(noise, cell, seconds, seed, chunk):
        for name, estimator in ESTIMATORS.items():
            error = estimator(values, RATE_HZ)[:4] / truth - 1.0
            sums[name] += np.stack([error.sum(axis=1), (error**2).sum(axis=1), (error**4).sum(axis=1)])
    return {"errors": {name: [[None if np.isnan(v) else v for v in row] for row in s] for name, s in sums.items()}}


def tables(chunks: list[Chunk]) -> str:
    """Return a table in Markdown with a row for each length and estimator, and a column for each noise."""
    figures: dict[tuple[str, str], dict[str, str]] = {}
    for (seconds, cell), group in group_chunks(chunks).items():
        for name, text in _figures(seconds, cell, group).items():
            figures.setdefault((format_length(seconds), name), {})[cell] = text
    cells = [cell for cell in CELLS if any(cell in row for row in figures.values())]
    rows = [(*key, *(row.get(cell, "") for cell in cells)) for key, row in figures.items()]
    intro = "Each cell gives the values for Q, N, B and K, in this order.\n\n"
    return intro + format_table(("record", "estimator", *cells), rows)


def _figures(seconds: int, cell: str, group: list[Chunk]) -> dict[str, str]:
    """Return the Cramér–Rao limits and the ratio of each estimator to them, for Q, N, B and K."""
    limits = cramer_rao(CELLS[cell], round(seconds * RATE_HZ))
    texts = {"*limit*, %": ", ".join(f"{100 * limits[letter]:.3g}" for letter in "QNBK")}
    for name in dict.fromkeys(name for chunk in group for name in chunk["errors"]):
        # the first chunks may lack estimators that were added later
        chunks_with_name = [chunk for chunk in group if name in chunk["errors"]]
        records = sum(chunk["records"] for chunk in chunks_with_name)
        sums = np.sum([np.array(chunk["errors"][name], float) for chunk in chunks_with_name], axis=0)
        texts[name] = ", ".join(
            _ratio(limits[c], sums[1:, k] / records, records, TARGETS.get(name, {}).get(c))
            for k, c in enumerate("QNBK")
        )
    return texts


def _ratio(limit: float, moments: Floats, records: int, target: float | None) -> str:
    """Return the ratio of the rms error to the limit, in bold if its 95 % interval is above the target."""
    square, fourth = moments  # of the relative error: mean square, mean fourth power
    if np.isnan(square):
        return "–"
    reach = 1.96 * np.sqrt((fourth - square**2) / records)
    lo = np.sqrt(max(square - reach, 0.0)) / limit
    text = f"{np.sqrt(square) / limit:.3g}"
    if limit > MAX_COMPARED_LIMIT:
        return f"({text})"
    return f"**{text}**" if target is not None and lo > target else text


if __name__ == "__main__":
    run_experiment("efficiency", __doc__ or "", CELLS, (MIN_45, HOURS_3), count, tables)
