"""How far above the least possible error do the estimates lie? Beside other programs' ways, on the same records.

    python -m tests.experiments.benchmarks.efficiency --json efficiency.jsonl  # all cells, 300 records each
    python -m tests.experiments.benchmarks.efficiency --json efficiency.jsonl --records 1200    # add more

With ``--records 0 --page docs/statistics-measurements.md``, the program only writes the tables into the page.

For each cell (a noise and a length of record at 100 Hz), each estimator and each term: the root mean square of the
relative error of the coefficient over its Cramér–Rao limit, with the 95 % interval of that ratio from the scatter
of the squared errors. A term counts where the limit itself is below 15 %; above, an estimator that is clipped at
zero can be better than any unbiased one, and the ratio, then in parentheses, says little.

``ESTIMATORS`` maps a name to a function of values [n, 6] and rate that gives Q N B K R [5, 6]. The ways of the other
programs are written anew here from what their sources do:

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
from monitor.estimation.fit.coefficient_values import SYMBOLS
from tests.experiments.benchmarks.records import (
    HOURS_3,
    MIN_45,
    MIX,
    RATE_HZ,
    Chunk,
    Noise,
    cramer_rao,
    length,
    markdown,
    merged,
    program,
    sixes,
)

CELLS: Final = {
    "mix": MIX,
    "mix with K × 4": Noise(MIX.Q, MIX.N, MIX.B, 4.0 * MIX.K),
    "mix with K × 10": Noise(MIX.Q, MIX.N, MIX.B, 10.0 * MIX.K),
    "mix with B × 3": Noise(MIX.Q, MIX.N, 3.0 * MIX.B, MIX.K),
}
JUDGED: Final = 0.15
"""Limits above this are too loose for a ratio to mean much."""
TARGETS: Final[Mapping[str, Mapping[str, float]]] = {
    "live fit": {"Q": 1.2, "N": 1.15, "B": 1.1, "K": 1.3},
    "offline fit": {"Q": 1.1, "N": 1.1, "B": 1.1, "K": 1.25},
}
IMU_UTILS_CLUSTERS: Final = 100
FLOOR: Final = float(np.sqrt(2.0 * np.log(2.0) / np.pi))
"""Deviation of 1/f noise with B of one."""

Estimator = Callable[[Floats, float], Floats]


@cache
def _octaves(n: int, rate_hz: float) -> tuple[Ints, DesignMatrix, CovarianceTable]:
    factors = cluster_sizes(n, rate_hz)
    return factors, make_design_matrix(factors, rate_hz), covariance_table(n, factors)


def weighed_by_variances(values: Floats, rate_hz: float) -> Floats:
    """The fit that the live service repeats at every sample."""
    return _fitted(values, rate_hz, full=False)


def weighed_by_covariances(values: Floats, rate_hz: float) -> Floats:
    """The fit of ``analyze``."""
    return _fitted(values, rate_hz, full=True)


def _fitted(values: Floats, rate_hz: float, full: bool) -> Floats:
    factors, columns, covariances = _octaves(len(values), rate_hz)
    avar, terms = overlapping_avar(values, factors)
    straight, each = rate_slope_from_thirds(values) * rate_hz, rate_slope_per_tau(values, factors) * rate_hz
    found = fit_coefficients(
        columns, covariances, MeasuredVariancesAndSlopes(avar, terms, straight, each), full_covariance=full
    )
    return np.asarray(np.sqrt(np.maximum(found.theta, 0.0)))


def unweighted(values: Floats, rate_hz: float) -> Floats:
    """Five terms, every τ as good as every other."""
    factors = cluster_sizes(len(values), rate_hz)
    shapes = _shapes(factors / rate_hz)
    scale: Floats = np.linalg.norm(shapes, axis=0)
    avar, _ = overlapping_avar(values, factors)
    squares = np.stack([nnls(shapes / scale, column)[0] / scale for column in avar.T], axis=1)
    return np.asarray(np.sqrt(squares))


def imu_utils(values: Floats, rate_hz: float) -> Floats:
    """Five terms, equal relative weights: squares of log σ² of the model over that of the record."""
    longest = 2.0 ** np.floor(np.log2(len(values) // 2))
    factors = np.unique(np.ceil(np.geomspace(1.0, longest, IMU_UTILS_CLUSTERS) - 1e-9)).astype(np.int64)
    avar, _ = overlapping_avar(values, factors)
    tau = factors / rate_hz
    found = [_log_squares(tau, column) for column in avar.T]
    # from the bare powers of τ to the coefficients of IEEE Std 952
    return np.asarray(np.stack(found, axis=1) / np.sqrt([[3.0], [1.0], [FLOOR**2], [1.0 / 3.0], [0.5]]))


def _log_squares(tau: Floats, avar: Floats) -> Floats:
    powers = tau[:, None] ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    start = np.abs(np.linalg.lstsq(np.sqrt(powers), np.sqrt(avar), rcond=None)[0])

    def misfit(p: Floats) -> Floats:
        return np.asarray(np.log10(powers @ p**2 / avar))

    def slopes(p: Floats) -> Floats:
        return np.asarray(2.0 / np.log(10.0) * powers * p / (powers @ p**2)[:, None])

    return np.asarray(np.abs(least_squares(misfit, start, jac=slopes, x_scale="jac", method="lm").x))


def allan_variance_ros(values: Floats, rate_hz: float) -> Floats:
    """Lines through the logarithms; Q and R are not asked for there."""
    tau = 0.1 * np.arange(1, 10_000)
    factors = np.rint(tau * rate_hz).astype(np.int64)
    short = factors <= len(values) // 2
    tau, factors = tau[short], factors[short]
    phase = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - values.mean(axis=0), axis=0)])
    deviation = np.stack([_apart(phase[::m]) / (m * np.sqrt(2.0)) for m in factors])
    found = np.full((len(SYMBOLS), values.shape[1]), np.nan)
    found[SYMBOLS.index("N")] = _line(tau[tau < 9.95], deviation[tau < 9.95], -0.5, at=1.0)
    found[SYMBOLS.index("B")] = deviation.min(axis=0) / FLOOR
    found[SYMBOLS.index("K")] = _line(tau, deviation, 0.5, at=3.0)
    return found


def _apart(phase: Floats) -> Floats:
    """Root mean square of the second differences of clusters that do not overlap."""
    return np.asarray(np.sqrt(np.mean(np.diff(phase, n=2, axis=0) ** 2, axis=0)))


def _line(tau: Floats, deviation: Floats, steep: float, at: float) -> Floats:
    """Value at ``at`` of the least-squares line through logarithms, slope between ``steep`` and ``steep`` + 0.001."""
    x, y = np.log(tau), np.log(deviation)
    best = ((x - x.mean()) @ (y - y.mean(axis=0))) / np.sum((x - x.mean()) ** 2)
    return np.asarray(np.exp(y.mean(axis=0) + np.clip(best, steep, steep + 0.001) * (np.log(at) - x.mean())))


def _shapes(tau: Floats) -> Floats:
    """Allan variances of coefficients of one (IEEE Std 952)."""
    return np.stack([3.0 / tau**2, 1.0 / tau, np.full_like(tau, FLOOR**2), tau / 3.0, tau**2 / 2.0], axis=1)


ESTIMATORS: Final[Mapping[str, Estimator]] = {
    "live fit": weighed_by_variances,
    "offline fit": weighed_by_covariances,
    "five terms, unweighted": unweighted,
    "as imu_utils": imu_utils,
    "as allan_variance_ros": allan_variance_ros,
}


def count(cell: str, seconds: int, seed: int, chunk: int) -> Chunk:
    """Sums of the relative error, of its square and of its fourth power, over one chunk."""
    noise = CELLS[cell]
    truth = np.array([[getattr(noise, letter)] for letter in "QNBK"])
    sums = {name: np.zeros((3, 4)) for name in ESTIMATORS}
    for values in sixes(noise, cell, seconds, seed, chunk):
        for name, estimator in ESTIMATORS.items():
            error = estimator(values, RATE_HZ)[:4] / truth - 1.0
            sums[name] += np.stack([error.sum(axis=1), (error**2).sum(axis=1), (error**4).sum(axis=1)])
    return {"errors": {name: [[None if np.isnan(v) else v for v in row] for row in s] for name, s in sums.items()}}


def tables(chunks: list[Chunk]) -> str:
    """Markdown of all that was measured."""
    rows = [row for group in merged(chunks).items() for row in _rows(*group)]
    return markdown(("record", "noise", "estimator", "records", "Q", "N", "B", "K"), rows)


def _rows(key: tuple[int, str], group: list[Chunk]) -> list[tuple[str, ...]]:
    seconds, cell = key
    limits = cramer_rao(CELLS[cell], round(seconds * RATE_HZ))
    said = [f"{100 * limits[letter]:.3g} %" for letter in "QNBK"]
    rows: list[tuple[str, ...]] = [(length(seconds), cell, "*limit*", "", *said)]
    for name in dict.fromkeys(name for chunk in group for name in chunk["errors"]):
        # estimators that came later were not there in the first chunks
        having = [chunk for chunk in group if name in chunk["errors"]]
        records = sum(chunk["records"] for chunk in having)
        sums = np.sum([np.array(chunk["errors"][name], float) for chunk in having], axis=0)
        figures = [
            _ratio(limits[c], sums[1:, k] / records, records, TARGETS.get(name, {}).get(c))
            for k, c in enumerate("QNBK")
        ]
        rows.append((length(seconds), cell, name, str(records), *figures))
    return rows


def _ratio(limit: float, moments: Floats, records: int, target: float | None) -> str:
    """Root of the mean square over the limit, with its interval; bold where all of that is above the target."""
    square, fourth = moments  # of the relative error: mean square, mean fourth power
    if np.isnan(square):
        return "–"
    reach = 1.96 * np.sqrt((fourth - square**2) / records)
    lo, hi = np.sqrt(np.maximum([square - reach, square + reach], 0.0)) / limit
    text = f"{np.sqrt(square) / limit:.3g} [{lo:.3g}, {hi:.3g}]"
    if limit > JUDGED:
        return f"({text})"
    return f"**{text}**" if target is not None and lo > target else text


if __name__ == "__main__":
    program("efficiency", __doc__ or "", CELLS, (MIN_45, HOURS_3), count, tables)
