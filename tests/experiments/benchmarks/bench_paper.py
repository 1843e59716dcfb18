"""Table 1 of "Dynamic extraction of random drift error coefficients of MEMS gyroscopes", and what a fit a sample costs.

    python -m tests.experiments.benchmarks.bench_paper [--budget 60] [--rounds 7] [--windows 10000 360000]

The job of the table: white noise, a window of 202 samples, and at each sample the window's Allan variance and a fit
of five coefficients. The paper compares a *general* method, which computes the variance of each window anew, and a
*recursive* one (its eq. 12-15), which adds the newest squared difference and takes out the oldest. Both are written
here sample by sample in NumPy, each step over all it can take at once. Least squares is ``numpy.linalg.lstsq`` at each
sample; as τ and so the matrix never change, a second recursive one has the pseudo-inverse made beforehand. They do one
axis. ``Estimator`` does six, at each sample, with weights from the noise found, terms that enter and leave, and gaps
kept in place; it stands for all six, and by the axis.

τ is 2^i samples as in the paper's section 1.1, or each of 1 … L/2 - 1 as under its eq. 11. A method that would take
longer than the budget for a length is run at the longest that it can, and its time multiplied: ~ marks these.
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
from tests.experiments.benchmarks.machine import Load, about, alternate, console, table

L: Final = 202
LENGTHS: Final = (10**3, 10**4, 10**5, 10**6, 10**7)
AXES: Final = 6
ROWS: Final = 1000
"""Samples a call of the estimator."""
NOISE: Final = 1e-4
WINDOWS: Final = (10_000, 360_000)

One = TypeVar("One")
Solve = Callable[[Floats], Floats]


def white(n: int) -> Floats:
    """The first n samples of the one series that all methods get."""
    return NOISE * np.random.default_rng(1).standard_normal(n)


def general(y: Floats, sizes: Ints, solve: Solve) -> tuple[Floats, Floats]:
    """Each window's Allan variance anew; the coefficients [n - L + 1, 5] and the last curve [m]."""
    course, avar = np.empty((y.size - L + 1, 5)), np.empty(sizes.size)
    phase = np.zeros(L + 1)
    for n in range(len(course)):
        np.cumsum(y[n : n + L], out=phase[1:])
        for i, m in enumerate(sizes.tolist()):
            d = phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m]
            avar[i] = d @ d / (2.0 * m * m * d.size)
        course[n] = solve(avar)
    return course, avar


def recursive(y: Floats, sizes: Ints, solve: Solve) -> tuple[Floats, Floats]:
    """Eq. 15: the variance of the next window from that of the last; results as of ``general``."""
    course = np.empty((y.size - L + 1, 5))
    phase = np.concatenate([[0.0], np.cumsum(y)])
    scale = 2.0 * sizes * sizes * (L + 1 - 2 * sizes)
    first, avar = general(y[:L], sizes, solve)
    course[0] = first[0]
    sums, newest, oldest = (
        avar * scale,
        np.stack([0 * sizes, sizes, 2 * sizes]),
        np.stack([2 * sizes, sizes, 0 * sizes]),
    )
    for n in range(1, len(course)):
        a = phase[n + L - newest]
        b = phase[n - 1 + oldest]
        d = a[0] - 2.0 * a[1] + a[2]
        e = b[0] - 2.0 * b[1] + b[2]
        sums += d * d - e * e
        avar = sums / scale
        course[n] = solve(avar)
    return course, avar


class Fitted:
    """``Estimator``, advanced by six axes of noise; the first is the series that the others get."""

    def __init__(self, sizes: Ints) -> None:
        self._sizes = sizes
        self.avar = np.empty(0)

    def __call__(self, n: int) -> float:
        """Processor seconds for n samples; what is random is made outside of them."""
        estimator = Estimator(1.0, float(L), tuple(self._sizes.tolist()), every_sample=True)
        first, others, took = white(n), np.random.default_rng(2), 0.0
        for start in range(0, n, ROWS):
            values = NOISE * others.standard_normal((min(ROWS, n - start), AXES))
            values[:, 0] = first[start : start + ROWS]
            samples = make_block(start + np.arange(len(values)), values)
            begun = time.thread_time()
            estimator.add_samples(samples)
            took += time.thread_time() - begun
        self.avar = estimator.get_estimate().curve.avar[:, 0]
        return took


class Written:
    """A method of the paper."""

    def __init__(
        self, method: Callable[[Floats, Ints, Solve], tuple[Floats, Floats]], sizes: Ints, solve: Solve
    ) -> None:
        self._method, self._sizes, self._solve = method, sizes, solve
        self.avar = np.empty(0)

    def __call__(self, n: int) -> float:
        """Processor seconds for n samples."""
        y = white(n)
        begun = time.thread_time()
        _, self.avar = self._method(y, self._sizes, self._solve)
        return time.thread_time() - begun


def solvers(sizes: Ints) -> tuple[Solve, Solve]:
    """Five-term least squares: solved at each call, and by a pseudo-inverse made beforehand."""
    tau = sizes.astype(float)
    columns = np.stack([tau**power for power in (-2, -1, 0, 1, 2)], axis=1)
    inverse = np.linalg.pinv(columns)
    return lambda avar: np.linalg.lstsq(columns, avar)[0], lambda avar: inverse @ avar


def paper(sizes: Ints, budget_s: float) -> None:
    """The paper's table, with ours beside it."""
    load = Load()
    solved, projected = solvers(sizes)
    methods: Mapping[str, Written | Fitted] = {
        "general": Written(general, sizes, solved),
        "recursive": Written(recursive, sizes, solved),
        "projected": Written(recursive, sizes, projected),
        "ours": Fitted(sizes),
    }
    said = ", ".join(map(str, sizes.tolist())) if sizes.size < 10 else f"1 … {sizes[-1]}"
    shown = table(
        f"a window of {L} samples, τ of {said} samples, a fit at every sample; processor seconds", "samples",
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
        shown.add_row(f"10^{len(str(n)) - 1}", *cells, *as_is, *(f"{AXES * ratio:.2g}" for ratio in over.values()))
    console.print(shown)
    console.print("pinv: recursive, with the pseudo-inverse made beforehand; /axis: over a sixth of ours")
    for method in methods.values():
        method(LENGTHS[0])
    ours = methods["ours"].avar
    apart = max(float(np.abs(methods[name].avar / ours - 1.0).max()) for name in ("general", "recursive"))
    console.print(f"largest relative difference of their last Allan variances to ours at {LENGTHS[0]:,}: {apart:.0e}")
    console.print(load.said() + "\n")


# --- a fit at every sample, by itself


def spaced(length: int, taus: int) -> Ints:
    """So many distinct cluster sizes to a quarter of the window, in steps as even in the logarithm as can be."""
    for steps in range(taus, 10 * taus):
        sizes = np.unique(np.rint(np.geomspace(1, length // 4, steps)).astype(np.int64))
        if sizes.size == taus:
            return sizes
    raise SystemExit(f"{length} samples have no room for {taus} cluster sizes")


class Noise:
    """White noise, a random walk that shows in the longest τ, and gravity on az; goes on from call to call."""

    def __init__(self, length: int) -> None:
        self._rng, self._at = np.random.default_rng(1), np.zeros(AXES)
        # N²/τ = K²τ/3 at a thirtieth of the window
        self._step = NOISE * np.sqrt(3.0) * 30.0 / length

    def __call__(self, n: int) -> Floats:
        walk = self._at + np.cumsum(self._step * self._rng.standard_normal((n, AXES)), axis=0)
        self._at = walk[-1]
        values: Floats = walk + NOISE * self._rng.standard_normal((n, AXES))
        values[:, 5] += 9.81
        return values


def for_each(work: Callable[[One], object], parts: Sequence[One]) -> Callable[[], None]:
    """Work on all parts, one after the other."""

    def done() -> None:
        for part in parts:
            work(part)

    return done


def each_sample(length: int, taus: int, rounds: int) -> tuple[str, ...]:
    """A row: the kernel alone, the estimator without and with a fit at every sample, a fit from nothing."""
    n, sizes, noise = 10 * ROWS, spaced(length, taus), Noise(length)
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
    avar, terms, slope = window.avar(), window.term_counts(), window.drift_slopes_by_axis_and_tau()[0]
    took = alternate(
        {
            "kernel": for_each(window.append_samples, [one.values for one in parts]),
            "plain": for_each(plain.add_samples, parts),
            "fitting": for_each(fitting.add_samples, parts),
            "solved": for_each(
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


def fits(windows: Sequence[int], rounds: int) -> None:
    """Cost of a fit at every sample, of each window and number of τ."""
    load = Load()
    shown = table(
        f"six axes, a hundred samples a call, full windows; median of {rounds} rounds, a sample", "window", "τ",
        "kernel, and a τ·axis", "Estimator.add_samples", "fitted at each", "more, an axis", "fit from nothing, an axis",
    )  # fmt: skip
    for length in windows:
        for taus in (20, 40):
            shown.add_row(f"{length:,}", *each_sample(length, taus, rounds))
    console.print(shown)
    console.print("the estimator also keeps, for the eye, each τ over a span of its own: twice the rows of the kernel")
    console.print(load.said() + "\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--budget", type=float, default=60.0, metavar="S", help="of a method and length; beyond, ~")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument(
        "--windows", type=int, nargs="+", default=WINDOWS, metavar="N", help="samples, of the last table"
    )
    given = parser.parse_args()
    console.print(about())
    Fitted(cluster_sizes(L, 1.0))(LENGTHS[0])  # compiled by now
    paper(cluster_sizes(L, 1.0), given.budget)
    paper(np.arange(1, L // 2), given.budget)
    fits(given.windows, given.rounds)


if __name__ == "__main__":
    main()
