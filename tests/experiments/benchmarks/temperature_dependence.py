"""False alarms and power of the tests for a dependence on temperature and for hysteresis.

    python -m tests.experiments.benchmarks.temperature_dependence [--seeds 200]

Each record has 75 means of 120 s in a temperature cycle of -18 … 74 °C, or only its heating. The first table has noise
without a dependence on temperature. The second has a bias that depends on temperature, and a random walk. The third has
a difference between heating and cooling, in addition to a cubic and white noise.
"""

import argparse

import numpy as np

from monitor.drift.thermal.hysteresis import find_hysteresis
from monitor.drift.thermal.temperature_removal import find_temperature_dependence
from monitor.drift.thermal.thermal_fit import fit_thermal_model
from tests.experiments.benchmarks.machine import console, create_table
from tests.monitor.drift.temperature_cycles import NOISES, SHAPES, simulate_chamber_means, simulate_noise_means

COUNT = 75
SHARES = (0.5, 0.8, 0.95, 0.99)
LOOPS = (10.0, 30.0, 100.0)


def count_false_alarms(noise: str, shape: str, seeds: int) -> tuple[int, int, int]:
    """Return the numbers of seeds with a detected dependence, with mostly temperature, and with hysteresis."""
    found = np.zeros(3, int)
    for seed in range(seeds):
        means = simulate_chamber_means(shape, simulate_noise_means(noise, COUNT, np.random.default_rng(seed)))
        fit = fit_thermal_model(means)
        dependence, loop = find_temperature_dependence(fit), fit.hysteresis
        found += (
            dependence is not None,
            dependence is not None and dependence.explains_most_variance,
            loop is not None and loop.is_significant,
        )
    return int(found[0]), int(found[1]), int(found[2])


def count_detections(law: str, shape: str, share: float, seeds: int) -> int:
    """Return the number of seeds that are classified as mostly temperature, for a share of the temperature."""
    found = 0
    for seed in range(seeds):
        noise = simulate_noise_means("random walk", COUNT, np.random.default_rng(seed))
        size = noise.std() * (share / (1.0 - share)) ** 0.5
        dependence = find_temperature_dependence(fit_thermal_model(simulate_chamber_means(shape, noise, law, size)))
        found += dependence is not None and dependence.explains_most_variance
    return found


def count_loops(law: str, shape: str, size: float, seeds: int) -> tuple[int, float]:
    """Return the number of detected loops, and the median of measured over true size."""
    ratios = []
    for seed in range(seeds):
        noise = simulate_noise_means("white", COUNT, np.random.default_rng(seed))
        curve = simulate_chamber_means(shape, noise, "cubic", 100.0).bias
        loop = find_hysteresis(simulate_chamber_means(shape, curve, law, size))
        if loop is not None and loop.is_significant:
            ratios.append(loop.size / size)
    return len(ratios), float(np.median(ratios)) if ratios else float("nan")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    table = create_table(f"False alarms in {seeds} seeds: depends / mostly temperature / hysteresis", "noise", *SHAPES)
    for noise in NOISES:
        cells = (count_false_alarms(noise, shape, seeds) for shape in SHAPES)
        table.add_row(noise, *(" / ".join(map(str, cell)) for cell in cells))
    console.print(table)
    table = create_table(
        "Detected, by the share of the temperature in addition to a random walk",
        "law",
        "cycle",
        *(f"{s:.0%}" for s in SHARES),
    )
    for law in ("linear", "cubic"):
        for shape in SHAPES:
            table.add_row(
                law, shape, *(f"{count_detections(law, shape, share, seeds) / seeds:.0%}" for share in SHARES)
            )
    console.print(table)
    table = create_table(
        "Hysteresis detected, and measured over true size", "law", "cycle", *(f"{size:g} deviations" for size in LOOPS)
    )
    for law in ("loop", "lag", "play"):
        for shape in SHAPES[:-1]:
            sizes = (count_loops(law, shape, size, seeds) for size in LOOPS)
            table.add_row(law, shape, *(f"{count / seeds:.0%}, {ratio:.2f}" for count, ratio in sizes))
    console.print(table)


if __name__ == "__main__":
    main()
