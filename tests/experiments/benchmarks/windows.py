"""Comparison of windows that weight the squared second differences: rectangle, Hann, and a window per τ.

    python -m tests.experiments.benchmarks.windows [--records 240] [--seed 1]

All windows have the same effective length: at short τ and for white noise, the variance of σ² is that of the rectangle.
The tables contain the response to a step of N and to a burst, the scatter for white noise, flicker and random walk, the
cost, and the five-term fit while N is changing. The Hann window is computed from the whole record, because it has no
fast recursion.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, Ints
from monitor.estimation.allan.batch import cluster_sizes
from monitor.estimation.allan.uncertainty import covariance_table as covariances
from monitor.estimation.allan.window import AllanWindow, newest_samples_per_displayed_tau
from monitor.estimation.fit.coefficient_fit import Fit, MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.noise.effect import Source
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.ieee952.bias_instability import BiasInstability
from monitor.noise.effects.ieee952.rate_random_walk import RateRandomWalk
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks.machine import console, create_table, describe_machine, time_alternately

RATE_HZ: Final = 20.0
WINDOW_S: Final = 3600.0
LENGTH: Final = round(WINDOW_S * RATE_HZ)
HANN: Final = 1.5
"""Length of the Hann window over that of a rectangle with equal variance: (Σw)²/Σw² is 2/3 of its length."""
N_TRUE, N_STEP, B_TRUE = 1.5e-4, 1.5, 4e-5
FIT_TIMES_S: Final = (-1.0, 30.0, 120.0, 600.0, 1800.0, 3600.0, 7200.0, 14_400.0)
"""Times of the fits since the change of N."""
KINDS: Final = ("rectangle", "Hann", "a window per τ")
RESTARTED: Final = "rectangle, restarted"
TAUS: Final = 17
"""Number of τ in the table of costs."""

Variances = dict[str, Floats]  # name: σ² [times, m, 6]


def make_windows(factors: Ints, length: int, rate_hz: float) -> dict[str, AllanWindow]:
    """Return the recursive windows."""
    return {
        "rectangle": AllanWindow(length, factors),
        "a window per τ": AllanWindow(length, factors, newest_samples_per_displayed_tau(factors, rate_hz, length)),
    }


def append_and_read(window: AllanWindow, values: Floats, ends: Sequence[int]) -> Floats:
    """Return σ² [times, m, 6] after each number of samples."""
    variances = []
    for start, end in zip([0, *ends], ends, strict=False):
        window.append_samples(values[start:end])
        variances.append(window.avar())
    return np.array(variances)


def hann_variances(values: Floats, factors: Ints, length: int, ends: Sequence[int]) -> Floats:
    """Return σ² [times, m, 6] with Hann weights over the last 1.5 · length terms, by definition."""
    phase = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    weights = np.sin(np.pi * (np.arange(round(HANN * length)) + 0.5) / round(HANN * length)) ** 2
    variances = np.empty((len(ends), factors.size, values.shape[1]))
    for i, m in enumerate(factors):
        squares = (phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]) ** 2  # term k ends at sample 2m + k
        for k, end in enumerate(ends):
            there = squares[max(0, end + 1 - 2 * m - weights.size) : end + 1 - 2 * m]
            own = weights[weights.size - len(there) :]
            variances[k, i] = own @ there / own.sum() / (2.0 * m * m)
    return variances


def compare_windows(values: Floats, factors: Ints, length: int, rate_hz: float, ends: Sequence[int]) -> Variances:
    """Return σ² of every window for one record of six axes."""
    found = {
        name: append_and_read(window, values, ends) for name, window in make_windows(factors, length, rate_hz).items()
    }
    found["Hann"] = hann_variances(values, factors, length, ends)
    return {name: found[name] for name in KINDS}


def simulate_change(gain: Floats, rng: np.random.Generator) -> Floats:
    """Return white noise of three axes, and the same noise times ``gain`` [n]."""
    calm = rng.standard_normal((gain.size, 3))
    return np.concatenate([calm, gain[:, None] * calm], axis=1) * N_TRUE


def average_change(
    gain: Floats, factors: Ints, ends: Sequence[int], records: int, seed: int
) -> tuple[Variances, Variances]:
    """Return σ² [times, m] without and with the change, averaged over records."""
    sums: dict[str, Floats] = {}
    rng = np.random.default_rng(seed)
    for _ in range(-(-records // 3)):
        for name, found in compare_windows(simulate_change(gain, rng), factors, LENGTH, RATE_HZ, ends).items():
            sums[name] = sums.get(name, 0.0) + np.stack([found[..., :3].mean(2), found[..., 3:].mean(2)])
    return {k: v[0] for k, v in sums.items()}, {k: v[1] for k, v in sums.items()}


def step_table(records: int, seed: int) -> None:
    """Print the time until σ² shows 50, 90 and 99 % of a step of N."""
    factors, since = np.array([1, 64, 512]), np.unique(np.round(np.geomspace(1.0, 4.0 * WINDOW_S, 160) * RATE_HZ))
    before = 4 * LENGTH
    ends = [before + int(s) for s in since]
    gain = np.where(np.arange(ends[-1]) < before, 1.0, N_STEP)
    calm, step = average_change(gain, factors, ends, records, seed)
    table = create_table(
        f"a step of N × {N_STEP}: seconds until σ² shows a share of it (mean of {records} records)",
        "share, τ",
        *KINDS,
    )
    for i, m in enumerate(factors):
        for wanted in (0.5, 0.9, 0.99):
            reached = [find_crossing(since / RATE_HZ, step[name][:, i] / calm[name][:, i], wanted) for name in KINDS]
            table.add_row(f"{wanted:.0%} at {m / RATE_HZ:g} s", *(f"{t:.0f}" for t in reached))
    console.print(table)


def find_crossing(t: Floats, ratio: Floats, wanted: float) -> float:
    """Return the interpolated time at which σ² first reaches a share of the step."""
    share = (ratio - 1.0) / (N_STEP**2 - 1.0)
    k = int(np.argmax(share >= wanted))
    return float(t[0] if k == 0 else np.interp(wanted, share[k - 1 : k + 1], t[k - 1 : k + 1]))


def burst_table(records: int, seed: int) -> None:
    """Print the time until a burst of one second is less than 1 % of σ²."""
    factors, since = np.array([1, 64]), np.arange(0.02, 10.0, 0.02)
    before = 4 * LENGTH
    ends = [before + round(RATE_HZ) + round(s * LENGTH) for s in since]
    table = create_table(
        f"a burst of 1 s: windows until it stays below 1 % of σ² (mean of {records} records)", "burst, τ", *KINDS
    )
    for height in (10.0, 100.0, 10_000.0):
        gain = np.ones(ends[-1])
        gain[before : before + round(RATE_HZ)] = height
        calm, burst = average_change(gain, factors, ends, records, seed)
        for i, m in enumerate(factors):
            left = [since[_first_index_of_final_true(burst[name][:, i] <= 1.01 * calm[name][:, i])] for name in KINDS]
            table.add_row(f"{height:,g} × the noise, {m / RATE_HZ:g} s", *(f"{t:.2f}" for t in left))
    console.print(table)


def _first_index_of_final_true(flags: NDArray[np.bool_]) -> int:
    """Return the first index from which on all values are True. The last value must be True."""
    return 0 if flags.all() else int(np.flatnonzero(~flags)[-1]) + 1


def simulate_records(n: int, records: int, seed: int, source: Source, rate_hz: float) -> Iterator[Floats]:
    """Yield records of one noise, six at a time."""
    for k in range(-(-records // len(AXES))):
        yield NoiseModel(dict.fromkeys(AXES, (source,))).simulate(n, rate_hz, seed + k)


def scatter_table(records: int, seed: int) -> None:
    """Print the relative standard deviation of the Allan deviation for constant noise."""
    length, factors = 4096, np.array([1, 16, 128, 512])
    rate_hz = length / WINDOW_S
    kinds = {"white": AngleRandomWalk(N=1e-4), "flicker": BiasInstability(B=1e-4), "walk": RateRandomWalk(K=1e-4)}
    table = create_table(
        f"standard deviation of the deviation at rest, % ({records} records; "
        f"itself known to {70.0 / np.sqrt(records):.1f} % of it)",
        "noise, τ",
        *KINDS,
    )
    for kind, source in kinds.items():
        every: dict[str, list[Floats]] = {name: [] for name in KINDS}
        for values in simulate_records(6 * length, records, seed, source, rate_hz):
            for name, found in compare_windows(values, factors, length, rate_hz, [6 * length]).items():
                every[name].append(np.sqrt(found[0]))
        deviations = [np.concatenate(every[name], axis=1) for name in KINDS]
        for i, m in enumerate(factors):
            table.add_row(f"{kind}, T/{length // m}", *(f"{100 * d[i].std() / d[i].mean():.1f}" for d in deviations))
    console.print(table)


def cost_table(rounds: int, seed: int) -> None:
    """Print the processor time per sample and the memory for an hour at 100 Hz."""
    length, factors = 360_000, 2 ** np.arange(TAUS)
    values = N_TRUE * np.random.default_rng(seed).standard_normal((20_000, 6)) + 9.81
    works: dict[str, Callable[[], None]] = {}
    sizes = {}
    for name, window in make_windows(factors, length, 100.0).items():
        for _ in range(-(-(length + 1000) // len(values))):
            window.append_samples(values)
        sizes[name] = memory_of(window)
        works[f"{name} blocks"] = make_append_loop(window, values, 100)
        works[f"{name} singles"] = make_append_loop(window, values[:2000], 1)
    took = time_alternately(works, rounds)
    table = create_table(
        f"cost: {TAUS} τ, six axes, window of {length:,} samples; median (best) of {rounds} rounds",
        "window",
        "ns a sample, 100 a call",
        "ns a sample, 1 a call",
        "memory in kB",
    )
    for name, size in sizes.items():
        each = [[t * 1e9 / n for t in took[f"{name} {how}"]] for how, n in (("blocks", 20_000), ("singles", 2_000))]
        table.add_row(name, *(f"{median:.0f} ({best:.0f})" for median, best in each), f"{size / 1e3:,.0f}")
    console.print(table)


def memory_of(window: AllanWindow) -> int:
    """Return the memory of the arrays of a window in bytes."""
    return int(window._memory.nbytes)


def make_append_loop(window: AllanWindow, values: Floats, size: int) -> Callable[[], None]:
    """Return a function that appends all values, with ``size`` samples in each call."""
    blocks = [values[i : i + size] for i in range(0, len(values), size)]

    def work() -> None:
        for block in blocks:
            window.append_samples(block)

    return work


def fit_table(records: int, seed: int) -> None:
    """Print the five-term fit of each window while N changes. The true noise consists of N and B."""
    factors = cluster_sizes(LENGTH, RATE_HZ)
    before = 4 * LENGTH
    ends = [before + round(s * RATE_HZ) for s in FIT_TIMES_S]
    model = NoiseModel(dict.fromkeys(AXES, (BiasInstability(B=B_TRUE),)))
    fits: dict[tuple[str, int], list[Fit]] = {}
    for k in range(-(-records // len(AXES))):
        white = np.random.default_rng([seed, k]).standard_normal((ends[-1], 6)) * N_TRUE * np.sqrt(RATE_HZ)
        white[before:] *= N_STEP
        values = white + model.simulate(ends[-1], RATE_HZ, seed + k)
        for name, found in compare_windows(values, factors, LENGTH, RATE_HZ, ends).items():
            for index, avar in enumerate(found):
                fits.setdefault((name, index), []).append(fit_curve(name, factors, avar))
        for index, one in enumerate(fit_restarted_window(values, factors, before, ends)):
            fits.setdefault((RESTARTED, index), []).append(one)
    names = (*KINDS, RESTARTED)
    table = create_table(
        f"the fit while N changes: N over its value now / % of axes with Q or K in / % whose B the interval "
        f"misses ({records} records)",
        f"since N × {N_STEP}",
        *names,
    )
    for index, since_s in enumerate(FIT_TIMES_S):
        truth = N_TRUE * (N_STEP if since_s > 0.0 else 1.0)
        table.add_row(
            "at rest" if since_s < 0.0 else f"{since_s:g} s", *(format_fit(fits[name, index], truth) for name in names)
        )
    console.print(table)


def fit_curve(name: str, factors: Ints, avar: Floats, length: int = LENGTH) -> Fit:
    """Fit a curve as that of a rectangle, with the number of terms of each τ."""
    whole = covariances(length, factors)
    spans = (
        newest_samples_per_displayed_tau(factors, RATE_HZ, length)
        if name == "a window per τ"
        else np.full(factors.size, length)
    )
    terms = np.repeat(np.maximum(spans + 1 - 2 * factors, 0)[:, None], 6, axis=1)
    return fit_coefficients(make_design_matrix(factors, RATE_HZ), whole, MeasuredVariancesAndSlopes(avar, terms))


def fit_restarted_window(values: Floats, factors: Ints, before: int, ends: Sequence[int]) -> Iterator[Fit]:
    """Yield the fits of a rectangle that discards all samples before the change."""
    window = AllanWindow(LENGTH, factors)
    for index, (start, end) in enumerate(zip([0, *ends], ends, strict=False)):
        if index == 1:
            window.discard_samples()
            start = before
        window.append_samples(values[start:end])
        yield fit_curve(RESTARTED, factors, window.avar(), window.samples_in_window)


def format_fit(fits: Sequence[Fit], truth: float) -> str:
    """Return a cell with the ratio of N, false terms, and B outside its interval."""
    status = np.concatenate([f.coefficients.status for f in fits], axis=1)
    theta = np.concatenate([f.theta for f in fits], axis=1)
    lo, hi = (np.concatenate([getattr(f.coefficients, end) for f in fits], axis=1)[2] for end in ("lo", "hi"))
    false = (status[[0, 3]] == Status.ESTIMATED).any(axis=0)
    wrong = (lo > B_TRUE) | (hi < B_TRUE)
    return f"{np.nanmedian(np.sqrt(theta[1])) / truth:.2f} / {100.0 * false.mean():.0f} / {100.0 * wrong.mean():.0f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--records", type=int, default=240, help="of the fits; a tenth of the scatter's, 8 × the steps'"
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    console.print(describe_machine())
    step_table(max(arguments.records // 8, 3), arguments.seed)
    burst_table(max(arguments.records // 40, 3), arguments.seed)
    scatter_table(10 * arguments.records, arguments.seed)
    cost_table(arguments.rounds, arguments.seed)
    fit_table(arguments.records, arguments.seed)


if __name__ == "__main__":
    main()
