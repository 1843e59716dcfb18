"""Table 1 of "Dynamic extraction of random drift error coefficients of MEMS gyroscopes", and cost of a fit per sample.

    python -m tests.experiments.benchmarks.bench_paper [--budget 60] [--rounds 7] [--windows 10000 360000]

The table of the paper measures white noise in a window of 202 samples. At each sample, the Allan variance of the window
and five coefficients are computed. The *general* method of the paper computes the variance of each window from the
beginning. The *recursive* method (eq. 12-15) adds the newest squared difference and subtracts the oldest one. Both
methods are implemented here in NumPy for one axis, and vectorised within each sample. They call ``numpy.linalg.lstsq``
at each sample. A second recursive method uses a precomputed pseudo-inverse, because τ and the matrix are constant.
``Estimator`` processes six axes at each sample, with weights, a selection of terms, and gaps. The table contains its
time for six axes and for one axis.

τ is 2^i samples as in section 1.1 of the paper, or each of 1 … L/2 - 1 as below its eq. 11. A method that exceeds the
budget for a length runs with the longest possible length, and its time is extrapolated. ``~`` marks these times.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final, TypeVar

import numpy as np

from drivers.data_types import Floats, Ints, make_block
from monitor.estimation.allan.batch import cluster_sizes
from monitor.estimation.allan.uncertainty import covariance_table as covariances
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.estimator import Estimator
from monitor.estimation.fit.coefficient_fit import MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, time_alternately

L: Final = 202
LENGTHS: Final = (10**3, 10**4, 10**5, 10**6, 10**7)
AXES: Final = 6
ROWS: Final = 1000
"""Number of samples in each call of the estimator."""
NOISE: Final = 1e-4
WINDOWS: Final = (10_000, 360_000)

Part = TypeVar("Part")
Solve = Callable[[Floats], Floats]


def white(n: int) -> Floats:
    """Return the first n samples of the series that all methods get."""
    return NOISE * np.random.default_rng(1).standard_normal(n)


def run_general_method(y: Floats, sizes: Ints, solve: Solve) -> tuple[Floats, Floats]:
    """Run the general method. Return the coefficients [n - L + 1, 5] and the last Allan variances [m]."""
    coefficients, avar = np.empty((y.size - L + 1, 5)), np.empty(sizes.size)
    phase = np.zeros(L + 1)
    for n in range(len(coefficients)):
        np.cumsum(y[n : n + L], out=phase[1:])
        for i, m in enumerate(sizes.tolist()):
            d = phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m]
            avar[i] = d @ d / (2.0 * m * m * d.size)
        coefficients[n] = solve(avar)
    return coefficients, avar


def run_recursive_method(y: Floats, sizes: Ints, solve: Solve) -> tuple[Floats, Floats]:
    """Run the recursive method (eq. 15). The results have the same shapes as those of ``run_general_method``."""
    coefficients = np.empty((y.size - L + 1, 5))
    phase = np.concatenate([[0.0], np.cumsum(y)])
    scale = 2.0 * sizes * sizes * (L + 1 - 2 * sizes)
    first, avar = run_general_method(y[:L], sizes, solve)
    coefficients[0] = first[0]
    sums, newest, oldest = (
        avar * scale,
        np.stack([0 * sizes, sizes, 2 * sizes]),
        np.stack([2 * sizes, sizes, 0 * sizes]),
    )
    for n in range(1, len(coefficients)):
        a = phase[n + L - newest]
        b = phase[n - 1 + oldest]
        d = a[0] - 2.0 * a[1] + a[2]
        e = b[0] - 2.0 * b[1] + b[2]
        sums += d * d - e * e
        avar = sums / scale
        coefficients[n] = solve(avar)
    return coefficients, avar


class EstimatorMethod:
    """``Estimator`` with six axes of noise. The first axis is the series of the other methods."""

    def __init__(self, sizes: Ints) -> None:
        self._sizes = sizes
        self.avar = np.empty(0)

    def __call__(self, n: int) -> float:
        """Return the processor time for n samples in seconds, without the generation of the noise."""
        estimator = Estimator(1.0, float(L), tuple(self._sizes.tolist()), every_sample=True)
        first, others, took = white(n), np.random.default_rng(2), 0.0
        for start in range(0, n, ROWS):
            values = NOISE * others.standard_normal((min(ROWS, n - start), AXES))
            values[:, 0] = first[start : start + ROWS]
            samples = make_block(start + np.arange(len(values)), values)
            start_s = time.thread_time()
            estimator.add_samples(samples)
            took += time.thread_time() - start_s
        self.avar = estimator.get_estimate().curve.avar[:, 0]
        return took


class PaperMethod:
    """Method of the paper."""

    def __init__(
        self, method: Callable[[Floats, Ints, Solve], tuple[Floats, Floats]], sizes: Ints, solve: Solve
    ) -> None:
        self._method, self._sizes, self._solve = method, sizes, solve
        self.avar = np.empty(0)

    def __call__(self, n: int) -> float:
        """Return the processor time for n samples in seconds."""
        y = white(n)
        start_s = time.thread_time()
        _, self.avar = self._method(y, self._sizes, self._solve)
        return time.thread_time() - start_s


def make_solvers(sizes: Ints) -> tuple[Solve, Solve]:
    """Return two solvers of five-term least squares: by ``lstsq`` and by a precomputed pseudo-inverse."""
    tau = sizes.astype(float)
    columns = np.stack([tau**power for power in (-2, -1, 0, 1, 2)], axis=1)
    inverse = np.linalg.pinv(columns)
    return lambda avar: np.linalg.lstsq(columns, avar)[0], lambda avar: inverse @ avar


def print_paper_table(sizes: Ints, budget_s: float) -> None:
    """Print the table of the paper, with the times of ``Estimator``."""
    load = Load()
    solved, projected = make_solvers(sizes)
    methods: Mapping[str, PaperMethod | EstimatorMethod] = {
        "general": PaperMethod(run_general_method, sizes, solved),
        "recursive": PaperMethod(run_recursive_method, sizes, solved),
        "projected": PaperMethod(run_recursive_method, sizes, projected),
        "ours": EstimatorMethod(sizes),
    }
    tau_text = ", ".join(map(str, sizes.tolist())) if sizes.size < 10 else f"1 … {sizes[-1]}"
    table = create_table(
        f"a window of {L} samples, τ of {tau_text} samples, a fit at every sample; processor seconds", "samples",
        "general", "recursive", "pinv", "ours, six axes", "general /ours", "recursive /ours", "general /axis",
        "recursive /axis", "pinv /axis",
    )  # fmt: skip
    longest: dict[str, tuple[int, float]] = {}
    for n in LENGTHS:
        took, marks = {}, {}
        for name, method in methods.items():
            known_n, known_s = longest.get(name, (n, 0.0))
            took[name], marks[name] = known_s * n / known_n, "~"
            if took[name] <= budget_s:
                took[name], marks[name] = method(n), ""
                longest[name] = n, took[name]
        cells = (f"{marks[name]}{took[name]:.3g}" for name in methods)
        over = {name: took[name] / took["ours"] for name in ("general", "recursive", "projected")}
        as_is = (f"{over[name]:.2g}" for name in ("general", "recursive"))
        table.add_row(f"10^{len(str(n)) - 1}", *cells, *as_is, *(f"{AXES * ratio:.2g}" for ratio in over.values()))
    console.print(table)
    console.print("pinv: recursive with a precomputed pseudo-inverse; /axis: relative to a sixth of ours")
    for method in methods.values():
        method(LENGTHS[0])
    ours = methods["ours"].avar
    apart = max(float(np.abs(methods[name].avar / ours - 1.0).max()) for name in ("general", "recursive"))
    console.print(f"largest relative difference of their last Allan variances to ours at {LENGTHS[0]:,}: {apart:.0e}")
    console.print(load.describe() + "\n")


# --- a fit at every sample, by itself


def logarithmic_cluster_sizes(length: int, taus: int) -> Ints:
    """Return ``taus`` cluster sizes up to a quarter of the window, in logarithmic steps."""
    for steps in range(taus, 10 * taus):
        sizes = np.unique(np.rint(np.geomspace(1, length // 4, steps)).astype(np.int64))
        if sizes.size == taus:
            return sizes
    raise SystemExit(f"{length} samples are too few for {taus} cluster sizes")


class Noise:
    """White noise, a random walk that is visible at the longest τ, and gravity on az, continued in each call."""

    def __init__(self, length: int) -> None:
        self._rng, self._at = np.random.default_rng(1), np.zeros(AXES)
        # N²/τ = K²τ/3 at τ = a thirtieth of the window
        self._step = NOISE * np.sqrt(3.0) * 30.0 / length

    def __call__(self, n: int) -> Floats:
        walk = self._at + np.cumsum(self._step * self._rng.standard_normal((n, AXES)), axis=0)
        self._at = walk[-1]
        values: Floats = walk + NOISE * self._rng.standard_normal((n, AXES))
        values[:, 5] += 9.81
        return values


def make_loop(work: Callable[[Part], object], parts: Sequence[Part]) -> Callable[[], None]:
    """Return a function that processes all parts in order."""

    def process_all() -> None:
        for part in parts:
            work(part)

    return process_all


def measure_fit_per_sample(length: int, taus: int, rounds: int) -> tuple[str, ...]:
    """Return a row with the times of the kernel, of the estimator without and with fits, and of a single fit."""
    n, sizes, noise = 10 * ROWS, logarithmic_cluster_sizes(length, taus), Noise(length)
    grid = tuple(sizes.astype(float).tolist())
    window = AllanWindow(length, sizes)
    plain, fitting = Estimator(1.0, float(length), grid), Estimator(1.0, float(length), grid, every_sample=True)
    for _ in range(-(-length // n) + 1):
        samples = make_block(np.arange(n), noise(n))
        window.append_samples(samples.values)
        plain.add_samples(samples)
        fitting.add_samples(samples)
    parts = [make_block(np.arange(100), noise(100)) for _ in range(n // 100)]
    model, table_ = make_design_matrix(sizes, 1.0), covariances(length, sizes)
    avar, terms, slope = window.avar(), window.variances().terms, window.drift_slopes_by_axis_and_tau()[0]
    took = time_alternately(
        {
            "kernel": make_loop(window.append_samples, [one.values for one in parts]),
            "plain": make_loop(plain.add_samples, parts),
            "fitting": make_loop(fitting.add_samples, parts),
            "solved": make_loop(
                lambda curve: fit_coefficients(model, table_, curve, full_covariance=False),
                [MeasuredVariancesAndSlopes(avar, terms, slope)] * 100,
            ),
        },
        rounds,
    )
    kernel, plain_s, fitting_s = (took[name][0] / n for name in ("kernel", "plain", "fitting"))
    solved = took["solved"][0] / 100
    return (
        f"{taus}",
        f"{kernel * 1e6:.3f} µs, {kernel * 1e9 / AXES / taus:.2f} ns",
        f"{plain_s * 1e6:.3f} µs",
        f"{fitting_s * 1e6:.3f} µs",
        f"{(fitting_s - plain_s) * 1e6 / AXES:.3f} µs",
        f"{solved * 1e6 / AXES:.1f} µs",
    )


def print_fit_costs(windows: Sequence[int], rounds: int) -> None:
    """Print the cost of a fit at every sample for each window and number of τ."""
    load = Load()
    table = create_table(
        f"six axes, a hundred samples a call, full windows; median of {rounds} rounds, a sample", "window", "τ",
        "kernel, and a τ·axis", "Estimator.add_samples", "fitted at each", "more, an axis", "fit from nothing, an axis",
    )  # fmt: skip
    for length in windows:
        for taus in (20, 40):
            table.add_row(f"{length:,}", *measure_fit_per_sample(length, taus, rounds))
    console.print(table)
    console.print("the estimator also maintains a separate window for each τ, which doubles the work of the kernel")
    console.print(load.describe() + "\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--budget", type=float, default=60.0, metavar="S", help="time limit of a method and length")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument(
        "--windows",
        type=int,
        nargs="+",
        default=WINDOWS,
        metavar="N",
        help="window lengths of the last table in samples",
    )
    arguments = parser.parse_args()
    console.print(describe_machine())
    EstimatorMethod(cluster_sizes(L, 1.0))(LENGTHS[0])  # compiles the kernels
    print_paper_table(cluster_sizes(L, 1.0), arguments.budget)
    print_paper_table(np.arange(1, L // 2), arguments.budget)
    print_fit_costs(arguments.windows, arguments.rounds)


if __name__ == "__main__":
    main()
