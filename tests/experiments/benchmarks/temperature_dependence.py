"""False statements and power of the tests for a dependence on temperature and for hysteresis.

    python -m tests.experiments.benchmarks.temperature_dependence [--seeds 200]

75 means of 120 s in a temperature cycle of -18 … 74 °C; "heating" is one way. The first table has noise that does not
know the temperature, the second a bias that follows it beside a random walk, the third a difference between heating and
cooling on a cubic beside white noise.
"""

import argparse

import numpy as np

from monitor.drift.thermal.bias_temperature_tests import find_hysteresis, find_temperature_dependence
from tests.experiments.benchmarks.machine import console, create_table
from tests.monitor.drift.temperature_cycles import NOISES, SHAPES, simulate_chamber_means, simulate_noise_means

COUNT = 75
SHARES = (0.5, 0.8, 0.95, 0.99)
LOOPS = (10.0, 30.0, 100.0)


def false_statements(noise: str, shape: str, seeds: int) -> tuple[int, int, int]:
    """Return how many seeds were said to depend on temperature, to be mostly temperature, to have hysteresis."""
    found = np.zeros(3, int)
    for seed in range(seeds):
        means = simulate_chamber_means(shape, simulate_noise_means(noise, COUNT, np.random.default_rng(seed)))
        one, loop = find_temperature_dependence(means), find_hysteresis(means)
        found += (
            one is not None,
            one is not None and one.explains_most_variance,
            loop is not None and loop.hysteresis_is_significant,
        )
    return int(found[0]), int(found[1]), int(found[2])


def power(law: str, shape: str, share: float, seeds: int) -> int:
    """Return how many seeds were said to be mostly temperature, of which temperature makes that share."""
    found = 0
    for seed in range(seeds):
        noise = simulate_noise_means("random walk", COUNT, np.random.default_rng(seed))
        size = noise.std() * (share / (1.0 - share)) ** 0.5
        one = find_temperature_dependence(simulate_chamber_means(shape, noise, law, size))
        found += one is not None and one.explains_most_variance
    return found


def loops(law: str, shape: str, size: float, seeds: int) -> tuple[int, float]:
    """Return how many loops, in deviations of a mean, were found; and the median of found over true size."""
    ratios = []
    for seed in range(seeds):
        noise = simulate_noise_means("white", COUNT, np.random.default_rng(seed))
        curve = simulate_chamber_means(shape, noise, "cubic", 100.0).bias
        loop = find_hysteresis(simulate_chamber_means(shape, curve, law, size))
        if loop is not None and loop.hysteresis_is_significant:
            ratios.append(loop.size / size)
    return len(ratios), float(np.median(ratios)) if ratios else float("nan")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    table = create_table(
        f"False statements in {seeds} seeds: depends / mostly temperature / hysteresis", "noise", *SHAPES
    )
    for noise in NOISES:
        cells = (false_statements(noise, shape, seeds) for shape in SHAPES)
        table.add_row(noise, *(" / ".join(map(str, cell)) for cell in cells))
    console.print(table)
    table = create_table(
        "Named, by the share that is temperature beside a random walk", "law", "cycle", *(f"{s:.0%}" for s in SHARES)
    )
    for law in ("linear", "cubic"):
        for shape in SHAPES:
            table.add_row(law, shape, *(f"{power(law, shape, share, seeds) / seeds:.0%}" for share in SHARES))
    console.print(table)
    table = create_table(
        "Hysteresis found, and found over true size", "law", "cycle", *(f"{size:g} deviations" for size in LOOPS)
    )
    for law in ("loop", "lag", "play"):
        for shape in SHAPES[:-1]:
            sizes = (loops(law, shape, size, seeds) for size in LOOPS)
            table.add_row(law, shape, *(f"{count / seeds:.0%}, {ratio:.2f}" for count, ratio in sizes))
    console.print(table)


if __name__ == "__main__":
    main()
