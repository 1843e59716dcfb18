"""Width and coverage of the intervals of N, B and K if samples are missing.

    python -m tests.experiments.benchmarks.loss --records 240
    python -m tests.experiments.benchmarks.loss --records 240 --generator simulator
    python -m tests.experiments.benchmarks.loss --recordings FOLDER
    python -m tests.experiments.benchmarks.loss --bias --records 1000

Records of one hour at 100 Hz are simulated with N, B and K by the generator of ``records``, or by the simulator of the
program. From each record, samples are removed in several ways. The table contains, for each way, the median width of
the 95 % intervals divided by the median width without loss, and the share of the results that are correct: intervals
and upper bounds.

The axes of real recordings have no true values. Their table contains the median of the ratios of the widths of
intervals and bounds, the largest ratio, and the share of the axes whose result without loss is correct with loss.

``--bias`` compares the Allan deviations of records with 5 % random loss with those of the complete records, separately
for white, flicker and random-walk noise.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES as AXIS_NAMES
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
from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks.records import AXES, MIX, RATE_HZ, Noise, Records, true_avar
from tests.experiments.real_recordings.__main__ import CASES

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


def fit_record(values: Floats, rate_hz: float = RATE_HZ) -> tuple[Floats, NDArray[np.int8]]:
    """Return the ends of the intervals [2, 3, axes] of N, B and K, and their status [3, axes]."""
    factors = cluster_sizes(len(values), rate_hz)
    avar, terms, excess = overlapping_allan_variances(values, factors)
    slope, slopes = rate_slope_from_thirds(values) * rate_hz, rate_slope_per_tau(values, factors) * rate_hz
    found = fit_coefficients(
        make_design_matrix(factors, rate_hz),
        covariance_table(len(values), factors),
        MeasuredVariancesAndSlopes(avar, terms, slope, slopes, excess=excess),
    ).coefficients
    rows = [SYMBOLS.index(symbol) for symbol in COEFFICIENTS]
    return np.stack([found.lo[rows], found.hi[rows]]), found.status[rows]


def simulate_with_the_program(rng: np.random.Generator) -> Floats:
    """Return six records [n, 6] of the simulator of the program."""
    terms = (AngleRandomWalk(NOISE.N), BiasInstability(NOISE.B), RateRandomWalk(NOISE.K))
    model = NoiseModel(dict.fromkeys(AXIS_NAMES, terms))
    seed = int(rng.integers(1 << 31))
    return model.simulate(round(SECONDS * RATE_HZ), RATE_HZ, seed=seed)


def measure(records: int, seed: int, simulator: bool) -> list[tuple[str, Floats, Floats, Floats]]:
    """Return the name of each loss, and for N, B and K the width, the share of correct and of estimated results."""
    ends: dict[str, list[Floats]] = {name: [] for name in LOSSES}
    status: dict[str, list[NDArray[np.int8]]] = {name: [] for name in LOSSES}
    rng = np.random.default_rng(seed)
    draw = Records(NOISE, round(SECONDS * RATE_HZ))
    for _ in range(-(-records // AXES)):
        values = simulate_with_the_program(rng) if simulator else draw.simulate_six(rng)
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


def list_recordings(folder: Path) -> Iterator[tuple[str, Floats, float]]:
    """Yield the name, the finite axes [n, axes] and the sample rate (Hz) of each static recording."""
    for case in CASES:
        if case.first == 0 and case.last is None and case.model_of is None:
            with np.load(folder / case.file) as file:
                axes = [file[axis].astype(np.float64) for axis in AXIS_NAMES if axis in file]
                yield (
                    case.name,
                    np.stack([y for y in axes if np.isfinite(y).all() and np.ptp(y) > 0.0], 1),
                    float(file["fs"]),
                )


def measure_recordings(folder: Path, seed: int) -> list[tuple[str, Floats, Floats, Floats]]:
    """Return the name of each loss, and for N, B and K the median and largest ratio of widths and the correct share."""
    rng = np.random.default_rng(seed)
    ratios: dict[str, list[Floats]] = {name: [] for name in LOSSES}
    agrees: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in LOSSES}
    for _, values, rate_hz in list_recordings(folder):
        (lo0, hi0), status0 = fit_record(values, rate_hz)
        middle = np.where(status0 == Status.ESTIMATED, np.sqrt(np.maximum(lo0 * hi0, 0.0)), lo0)
        for name, loss in LOSSES.items():
            (lo, hi), _ = fit_record(np.where(loss(values, rng), values, np.nan), rate_hz)
            ratios[name].append((hi - lo) / (hi0 - lo0))
            agrees[name].append((lo <= middle) & (middle <= hi))
    rows = []
    for name in LOSSES:
        ratio = np.concatenate(ratios[name], axis=1)
        held = np.concatenate(agrees[name], axis=1).mean(axis=1)
        rows.append((name, np.nanmedian(ratio, axis=1), np.nanmax(ratio, axis=1), 100.0 * held))
    return rows


def measure_bias(records: int, seed: int) -> list[tuple[str, Floats, Floats]]:
    """Return the cluster sizes and the bias of the Allan deviations with 5 % loss for white, flicker and random walk.

    The bias is the mean difference from the deviation of the complete record, divided by the standard deviation of the
    deviations with loss.
    """
    n, rng, lose = round(SECONDS * RATE_HZ / 10), np.random.default_rng(seed), remove_at_random(0.05)
    factors = cluster_sizes(n, RATE_HZ)
    rows = []
    for name, noise in {"N": Noise(N=MIX.N), "B": Noise(B=MIX.B), "K": Noise(K=MIX.K)}.items():
        draw, found = Records(noise, n), []
        for _ in range(-(-records // AXES)):
            whole = draw.simulate_six(rng)
            thinned = np.where(lose(whole, rng), whole, np.nan)
            found.append([overlapping_allan_variances(y, factors)[0] for y in (whole, thinned)])
        variances = np.concatenate(found, axis=2)  # complete or thinned, cluster sizes, records
        without, thin = np.sqrt(np.maximum(variances, 0.0))
        truth = np.sqrt(true_avar(noise, factors))
        spread = thin.std(axis=1)
        rows.append((name, (thin - without).mean(axis=1) / spread, (thin.mean(axis=1) - truth) / spread))
    return rows


def main() -> None:
    """Run the experiment and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--records", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--generator", choices=["exact", "simulator"], default="exact")
    parser.add_argument("--recordings", type=Path, metavar="FOLDER", help="folder of real recordings")
    parser.add_argument("--bias", action="store_true")
    arguments = parser.parse_args()
    names = " | ".join(COEFFICIENTS)
    if arguments.bias:
        for noise, paired, total in measure_bias(arguments.records, arguments.seed):
            print(f"{noise}: bias over standard deviation, from the complete records {np.round(paired, 3).tolist()}")
            print(f"   from the true deviation {np.round(total, 3).tolist()}")
        return
    if arguments.recordings:
        rows = measure_recordings(arguments.recordings, arguments.seed)
        print(f"| loss | median ratio {names} | largest ratio {names} | correct {names} |\n| {'--- | ' * 10}")
    else:
        rows = measure(arguments.records, arguments.seed, arguments.generator == "simulator")
        print(f"| loss | width of {names} | correct {names} | estimated {names} |\n| {'--- | ' * 10}")
    for name, first, second, third in rows:
        cells = [f"{x:.3f}" for x in first] + [f"{x:.2f}" for x in second] + [f"{x:.1f}" for x in third]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
