"""Bias, degrees of freedom and interval coverage of total and Hadamard variance for simulated records.

    python -m tests.experiments.benchmarks.total_edf --records 2000 --samples 4096

The noises are white noise, flicker, random walk, quantization and two mixtures. For each noise and τ = T/8, T/4, T/2,
3T/4 and T, the table contains the mean of the corrected total variance over the Allan variance, its measured and stated
degrees of freedom, and the coverage of the 95 % interval. The coverage is given for known noise and for noise that is
fitted to the same record. A second table contains the Hadamard variance up to T/3. The standard error of a share p over
n records is √(p(1 − p)/n), which is 0.5 % for 2000 records.
"""

import argparse
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.estimation.allan.batch import cluster_sizes, overlapping_avar, rate_slope_from_thirds
from monitor.estimation.allan.curve import VarianceCurve
from monitor.estimation.allan.hadamard import hadamard_estimator_moments, hadamard_variance
from monitor.estimation.allan.squared_difference_moments import (
    correct_bias_and_compute_intervals,
)
from monitor.estimation.allan.total import total_estimator_moments, total_variance
from monitor.estimation.allan.uncertainty import covariance_table
from monitor.estimation.fit.coefficient_fit import MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.noise.effect import Source
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.ieee952.bias_instability import BiasInstability
from monitor.noise.effects.ieee952.quantization_noise import QuantizationNoise
from monitor.noise.effects.ieee952.rate_random_walk import RateRandomWalk
from tests.support.noise_series import draw_next_samples

SHARES: Final = (0.125, 0.25, 0.5, 0.75, 1.0)
NOISES: Final[dict[str, tuple[float, float, float, float]]] = {  # Q N B K, τ0 = 1
    "white": (0.0, 1.0, 0.0, 0.0),
    "flicker": (0.0, 0.0, 1.0, 0.0),
    "random walk": (0.0, 0.0, 0.0, 1.0),
    "quantization": (1.0, 0.0, 0.0, 0.0),
    "Q and N": (10.0, 1.0, 0.0, 0.0),
    "N, B and K": (0.0, 1.0, 0.05, 0.001),
}
"""In the last mixture, flicker equals white noise at 900 samples, and random walk equals flicker at 1700 samples."""


def simulate_records(coefficients: tuple[float, ...], n: int, count: int, rng: np.random.Generator) -> Floats:
    """Return simulated rates [n, count]."""
    kinds: tuple[type[Source], ...] = (QuantizationNoise, AngleRandomWalk, BiasInstability, RateRandomWalk)
    values = np.zeros((n, count))
    for kind, letter, size in zip(kinds, "QNBK", coefficients, strict=True):
        for column in range(count if size else 0):
            values[:, column] += draw_next_samples(kind(**{letter: size}).start_series(1.0, rng), n)
    return values


def fit_noise(values: Floats) -> Floats:
    """Return θ [5, k] that is fitted to the records."""
    factors = cluster_sizes(len(values), 1.0)
    avar, terms = overlapping_avar(values, factors)
    measured = MeasuredVariancesAndSlopes(avar, terms, rate_slope_from_thirds(values))
    return fit_coefficients(make_design_matrix(factors, 1.0), covariance_table(len(values), factors), measured).theta


def print_row(name: str, curves: tuple[VarianceCurve, VarianceCurve], truth: Floats) -> None:
    """Print the row of one noise: mean over truth, measured and stated edf, and coverage."""
    variance, edf = curves[0].variance, curves[0].edf
    measured_edf = 2.0 * variance.mean(axis=1) ** 2 / variance.var(axis=1)
    cells = [
        f"{mean / true:.3f}; {found:.3g} / {stated:.3g}"
        for mean, true, found, stated in zip(variance.mean(axis=1), truth, measured_edf, edf[:, 0], strict=True)
    ]
    for curve in curves:
        covered = (curve.lo <= np.sqrt(truth)[:, None]) & (np.sqrt(truth)[:, None] <= curve.hi)
        cells = [f"{cell}; {100 * share:.1f}" for cell, share in zip(cells, covered.mean(axis=1), strict=True)]
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Simulate the records and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    n, rng = arguments.samples, np.random.default_rng(arguments.seed)
    factors = np.array([min(round(share * n), n - 1) for share in SHARES])
    thirds = np.array([n // 24, n // 12, n // 6, n // 4, n // 3])
    own = [total_estimator_moments(n, int(m)) for m in factors]
    other = [hadamard_estimator_moments(n, int(m)) for m in thirds]
    print(f"{arguments.records} records of {n} samples. Cells: mean over truth; edf measured / stated; % of intervals")
    print("that contain the truth with the noise known; with the noise fitted.\n")
    rows = []
    print("| total variance | " + " | ".join(f"{share:g} T" for share in SHARES) + " |")
    print("| --- " * (1 + len(SHARES)) + "|")
    for name, coefficients in NOISES.items():
        values = simulate_records(coefficients, n, arguments.records, rng)
        theta = np.append(np.square(coefficients), 0.0)
        known, found = np.repeat(theta[:, None], arguments.records, axis=1), fit_noise(values)
        tvar, terms, _ = total_variance(values, factors)
        totals = (
            correct_bias_and_compute_intervals(own, 1.0, known, tvar, terms),
            correct_bias_and_compute_intervals(own, 1.0, found, tvar, terms),
        )
        print_row(name, totals, np.stack([one.allan for one in own]) @ theta)
        hvar, terms, _ = hadamard_variance(values, thirds)
        hadamards = (
            correct_bias_and_compute_intervals(other, 1.0, known, hvar, terms),
            correct_bias_and_compute_intervals(other, 1.0, found, hvar, terms),
        )
        rows.append((name, hadamards, np.stack([one.mean for one in other]) @ theta))
    print("\n| Hadamard variance | " + " | ".join(f"{m / n:.3f} T" for m in thirds) + " |")
    print("| --- " * (1 + len(thirds)) + "|")
    for row in rows:
        print_row(*row)


if __name__ == "__main__":
    main()
