"""Width and coverage of the intervals of N, B and K if samples are missing.

    python -m tests.experiments.benchmarks.loss --records 240

Records of one hour at 100 Hz are simulated with N, B and K by the generator of ``records``. From each record, samples
are removed in several ways. The table contains, for each way, the median width of the 95 % intervals divided by the
median width without loss, and the share of the results that are correct: intervals and upper bounds.
"""

import argparse
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats
from monitor.estimation.allan.batch import (
    cluster_sizes,
    overlapping_allan_variances,
    rate_slope_from_thirds,
    rate_slope_per_tau,
)
from monitor.estimation.allan.uncertainty import covariance_table
from monitor.estimation.fit.coefficient_fit import MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from tests.experiments.benchmarks.records import AXES, MIX, RATE_HZ, Noise, Records

SECONDS: Final = 3600
NOISE: Final = Noise(N=MIX.N, B=2.0 * MIX.B, K=10.0 * MIX.K)
"""Noise of the records. B and K are well above the smallest values that can be estimated."""
COEFFICIENTS: Final = ("N", "B", "K")

Loss = Callable[[Floats, np.random.Generator], NDArray[np.bool_]]
"""Type of a function that returns True [n, 6] for the samples that are present."""


def remove_at_random(share: float) -> Loss:
    """Return a loss in which each sample is missing with the same probability, on all axes together."""
    return lambda values, rng: np.broadcast_to(rng.random((len(values), 1)) >= share, values.shape)


def remove_bursts(values: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Remove 360 bursts of 10 samples."""
    present = np.ones(values.shape, np.bool_)
    for begin in rng.integers(0, len(values) - 10, 360):
        present[begin : begin + 10] = False
    return present


def remove_every_50th(values: Floats, _: np.random.Generator) -> NDArray[np.bool_]:
    """Remove each fiftieth sample."""
    present = np.ones(values.shape, np.bool_)
    present[::50] = False
    return present


def remove_one_gap(values: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Remove 5 % of the record in one piece."""
    present = np.ones(values.shape, np.bool_)
    begin = rng.integers(0, round(0.95 * len(values)))
    present[begin : begin + round(0.05 * len(values))] = False
    return present


def remove_outermost(values: Floats, _: np.random.Generator) -> NDArray[np.bool_]:
    """Remove the 1 % of the samples of each axis that differ most from the sample before."""
    apart = np.abs(np.diff(values, axis=0, prepend=values[:1]))
    return np.asarray(apart < np.quantile(apart, 0.99, axis=0))


LOSSES: Final[dict[str, Loss]] = {
    "none": remove_at_random(0.0),
    "0.1 % at random": remove_at_random(0.001),
    "1 % at random": remove_at_random(0.01),
    "5 % at random": remove_at_random(0.05),
    "10 % at random": remove_at_random(0.1),
    "20 % at random": remove_at_random(0.2),
    "360 bursts of 10": remove_bursts,
    "every 50th": remove_every_50th,
    "one gap of 5 %": remove_one_gap,
    "1 % that differ most": remove_outermost,
}


def fit_record(values: Floats) -> tuple[Floats, NDArray[np.int8]]:
    """Return the ends of the intervals [2, 3, 6] of N, B and K, and their status [3, 6]."""
    factors = cluster_sizes(len(values), RATE_HZ)
    avar, terms, excess = overlapping_allan_variances(values, factors)
    slope, slopes = rate_slope_from_thirds(values) * RATE_HZ, rate_slope_per_tau(values, factors) * RATE_HZ
    found = fit_coefficients(
        make_design_matrix(factors, RATE_HZ),
        covariance_table(len(values), factors),
        MeasuredVariancesAndSlopes(avar, terms, slope, slopes, excess=excess),
    ).coefficients
    rows = [SYMBOLS.index(symbol) for symbol in COEFFICIENTS]
    return np.stack([found.lo[rows], found.hi[rows]]), found.status[rows]


def measure(records: int, seed: int) -> list[tuple[str, Floats, Floats, Floats]]:
    """Return the name of each loss, and for N, B and K the width, the share of correct and of estimated results."""
    ends: dict[str, list[Floats]] = {name: [] for name in LOSSES}
    status: dict[str, list[NDArray[np.int8]]] = {name: [] for name in LOSSES}
    rng = np.random.default_rng(seed)
    draw = Records(NOISE, round(SECONDS * RATE_HZ))
    for _ in range(-(-records // AXES)):
        values = draw.simulate_six(rng)
        for name, loss in LOSSES.items():
            one, known = fit_record(np.where(loss(values, rng), values, np.nan))
            ends[name].append(one)
            status[name].append(known)
    truth = np.array([getattr(NOISE, symbol) for symbol in COEFFICIENTS])[:, None]
    rows, reference = [], None
    for name in LOSSES:
        lo, hi = np.concatenate(ends[name], axis=2)
        width = np.median(hi - lo, axis=1)
        reference = width if reference is None else reference
        estimated = np.concatenate(status[name], axis=1) == Status.ESTIMATED
        held = ((lo <= truth) & (truth <= hi)).mean(axis=1)
        rows.append((name, width / reference, 100.0 * held, 100.0 * estimated.mean(axis=1)))
    return rows


def main() -> None:
    """Run the experiment and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--records", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    names = " | ".join(COEFFICIENTS)
    print(f"| loss | width of {names} | correct {names} | estimated {names} |\n| {'--- | ' * 10}")
    for name, width, held, estimated in measure(arguments.records, arguments.seed):
        cells = [f"{x:.3f}" for x in width] + [f"{x:.1f}" for x in (*held, *estimated)]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
