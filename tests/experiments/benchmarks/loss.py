"""Width and coverage of the intervals of N, B and K if samples are missing.

    python -m tests.experiments.benchmarks.loss --records 240
    python -m tests.experiments.benchmarks.loss --records 240 --generator simulator
    python -m tests.experiments.benchmarks.loss --recordings FOLDER
    python -m tests.experiments.benchmarks.loss --bias --records 1000
    python -m tests.experiments.benchmarks.loss --reconcile --records 48

Records of one hour at 100 Hz are simulated with N, B and K by the generator of ``records``, or by the simulator of the
program. From each record, samples are removed in several ways. The table contains, for each way, the median width of
the 95 % intervals divided by the median width without loss, and the share of the results that are correct: intervals
and upper bounds.

The axes of real recordings have no true values. Their table contains the median of the ratios of the widths of
intervals and bounds, the largest ratio, and the share of the axes whose result without loss is correct with loss.

``--bias`` compares the Allan deviations of records with 5 % random loss with those of the complete records, separately
for white, flicker and random-walk noise.

``--reconcile`` compares axes of ten minutes with their true models, and with models that lack one effect each. NumPy
and SciPy simulate the axes. The table contains the number of axes that agree with the true model. For each lacking
effect, it contains the number of axes on which the extended model explains the differences, and by how many percent the
size of the effect differs from the size without loss: mean (smallest … largest).
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, sosfilt

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
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    ExponentiallyCorrelated,
    Narrowband,
    QuantizationNoise,
    RateRandomWalk,
    Sinusoidal,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.reconcile import reconcile
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


def remove_bursts(values: Floats, rng: np.random.Generator, bursts: int = 360) -> NDArray[np.bool_]:
    """Remove bursts of 10 samples."""
    present = np.ones(values.shape, np.bool_)
    for begin in rng.integers(0, len(values) - 10, bursts):
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


RECONCILED_S: Final = 600
SIZES: Final = {"gx": "N", "gy": "cutoff", "gz": "Q", "ax": "amplitude", "ay": "sigma", "az": "sigma"}
"""Size of the effect that the incomplete model lacks or contains with a wrong size."""
RECONCILED_LOSSES: Final[dict[str, Loss]] = {
    "none": remove_at_random(0.0),
    "1 % at random": remove_at_random(0.01),
    "5 % at random": remove_at_random(0.05),
    "10 % at random": remove_at_random(0.1),
    "90 bursts of 10": lambda values, rng: remove_bursts(values, rng, 90),
}


def simulate_for_reconcile(rng: np.random.Generator) -> tuple[Floats, NoiseModel, NoiseModel]:
    """Return six axes [n, 6] with different noise, the true model, and a model that lacks an effect on each axis."""
    n, start = round(RECONCILED_S * RATE_HZ), 4000
    noise, q = 1e-4, 1e-5 * rng.uniform(0.5, 2.0)
    flicker, floor = noise * rng.uniform(0.2, 0.5), noise * 10.0 ** rng.uniform(-2.0, -1.0)
    order, cutoff = int(rng.integers(1, 3)), rng.uniform(5.0, 30.0)
    amplitude, line_hz = 1e-3 * rng.uniform(0.1, 0.5), rng.uniform(2.0, 45.0)
    resonance, peak_hz, width_hz = 1e-3 * rng.uniform(0.3, 0.6), rng.uniform(5.0, 45.0), rng.uniform(0.5, 2.0)
    correlated, time_s = 1e-3 * rng.uniform(0.3, 0.6), rng.uniform(0.5, 4.0)

    white = noise * RATE_HZ**0.5 * rng.standard_normal((n + start, AXES))
    values = white[start:].copy()
    values[:, 0] = Records(Noise(N=noise, B=flicker), n).simulate_six(rng)[:, 0]
    filtered = sosfilt(butter(order, cutoff, fs=RATE_HZ, output="sos"), white[:, 1])[start:]
    values[:, 1] = filtered + floor * RATE_HZ**0.5 * rng.standard_normal(n)
    values[:, 2] = Records(Noise(N=0.3 * noise, Q=q), n).simulate_six(rng)[:, 0]
    values[:, 3] += amplitude * np.sin(2.0 * np.pi * (line_hz / RATE_HZ * np.arange(n) + rng.random()))
    decay = np.exp((-np.pi * width_hz + 2j * np.pi * peak_hz) / RATE_HZ)
    turning = (rng.standard_normal((n + start, 2)) * (1.0 - abs(decay) ** 2) ** 0.5) @ [1.0, 1j]
    values[:, 4] += resonance * lfilter([1.0], [1.0, -decay], turning)[start:].real
    phi = np.exp(-1.0 / (time_s * RATE_HZ))
    drive = correlated * (1.0 - phi**2) ** 0.5 * rng.standard_normal(n + start)
    values[:, 5] += lfilter([1.0], [1.0, -phi], drive)[start:]

    term, bias = AngleRandomWalk(N=noise), BiasInstability(B=flicker)
    true: dict[str, tuple[Effect, Effect]] = {
        "gx": (term, bias),
        "gy": (term, BandwidthLimit(cutoff=cutoff, order=order, floor=floor)),
        "gz": (AngleRandomWalk(N=0.3 * noise), QuantizationNoise(Q=q)),
        "ax": (term, Sinusoidal(amplitude=amplitude, frequency=line_hz)),
        "ay": (term, Narrowband(sigma=resonance, frequency=peak_hz, bandwidth=width_hz)),
        "az": (term, ExponentiallyCorrelated(sigma=correlated, correlation_time=time_s)),
    }
    lacking = {axis: effects[:1] for axis, effects in true.items()} | {"gx": (AngleRandomWalk(N=0.8 * noise), bias)}
    return values, NoiseModel(true), NoiseModel(lacking)


def print_reconcile(records: int, seed: int) -> None:
    """Print the axes that agree with their true model, and the sizes of the effects that an incomplete model lacks."""
    rng = np.random.default_rng(seed)
    agree = dict.fromkeys(RECONCILED_LOSSES, 0)
    sizes = {name: np.full((AXES, -(-records // AXES)), np.nan) for name in RECONCILED_LOSSES}
    explained = {name: [0] * AXES for name in RECONCILED_LOSSES}
    for record in range(-(-records // AXES)):
        values, true, lacking = simulate_for_reconcile(rng)
        for name, loss in RECONCILED_LOSSES.items():
            kept = np.where(loss(values, rng), values, np.nan)
            recording = RecordedAxes({axis: kept[:, k].copy() for k, axis in enumerate(AXIS_NAMES)}, RATE_HZ)
            for axis, one in reconcile(recording, true, seed + record).axes.items():
                agree[name] += one.verdict == "agrees"
                if one.verdict != "agrees":
                    print(f"record {record}, {name}: {axis} {one.verdict}, {[step.effect for step in one.steps]}")
            for k, (axis, one) in enumerate(reconcile(recording, lacking, seed + record).axes.items()):
                explained[name][k] += one.verdict == "explained"
                if one.verdict != "explained":
                    print(f"record {record}, {name}: {axis} {one.verdict}, {[step.effect for step in one.steps]}")
                found = [step.parameters[SIZES[axis]].value for step in one.steps if SIZES[axis] in step.parameters]
                sizes[name][k, record] = found[0] if len(found) == 1 else np.nan
    names = ("N", "cutoff", "Q", "line", "resonance", "correlated noise")
    print(f"| loss | true model agrees, of {AXES * -(-records // AXES)} | {' | '.join(names)} |\n| {'--- | ' * 8}")
    for name, fitted in sizes.items():
        ratio = fitted / sizes["none"] - 1.0
        cells = [
            f"{count}: {100.0 * np.nanmean(one):+.2f} ({100.0 * np.nanmin(one):+.2f} … {100.0 * np.nanmax(one):+.2f})"
            for count, one in zip(explained[name], ratio, strict=True)
        ]
        print(f"| {name} | {agree[name]} | {' | '.join(cells)} |")


def main() -> None:
    """Run the experiment and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--records", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--generator", choices=["exact", "simulator"], default="exact")
    parser.add_argument("--recordings", type=Path, metavar="FOLDER", help="folder of real recordings")
    parser.add_argument("--bias", action="store_true")
    parser.add_argument("--reconcile", action="store_true")
    arguments = parser.parse_args()
    names = " | ".join(COEFFICIENTS)
    if arguments.reconcile:
        print_reconcile(arguments.records, arguments.seed)
        return
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
