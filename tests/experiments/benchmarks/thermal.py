"""Prediction of a bias that follows the temperature with a lag, compared with a cubic polynomial.

    python -m tests.experiments.benchmarks.thermal [--seeds 200]

Each record has 72 hourly means, which are simulated without code of ``monitor.drift``. The temperature has a daily
swing of 3 °C with random clouds. The bias follows with a lag of 0 to 4 h, and its noise is 2 to 10 % of its swing. The
models are fitted to 24 h and predict 48 h. The errors are rms errors relative to those of a third-order polynomial. The
original paper reports 0.654 for multi-step prediction.
"""

import argparse
from collections import Counter

import numpy as np

from monitor.drift.thermal.thermal_fit import fit_thermal_model
from monitor.drift.thermal.thermal_model import predict_interval_means
from tests.experiments.benchmarks.machine import console, create_table
from tests.monitor.drift.thermal_biases import select_first_intervals, simulate_hourly_means

DAY = 24
LAGS_H = (0.0, 1.0, 2.0, 4.0)
NOISES = (0.02, 0.05, 0.1)


def measure_row(lag_h: float, noise: float, seeds: int) -> tuple[str, ...]:
    """Return one row of the table."""
    ratios, inside, names = [], [], Counter[str]()
    for seed in range(seeds):
        means = simulate_hourly_means(seed, lag_h, noise)
        model = fit_thermal_model(select_first_intervals(means, DAY)).model
        multi = predict_interval_means(model, means.temperature_c, starts_with_fit=True)
        one = predict_interval_means(model, means.temperature_c, means.bias, starts_with_fit=True)
        cubic = np.polynomial.Polynomial.fit(means.temperature_c[:DAY], means.bias[:DAY], 3)(means.temperature_c)
        of_cubic = np.sqrt(np.mean((means.bias - cubic)[DAY:] ** 2))
        ratios.append(
            [np.sqrt(np.mean((means.bias - prediction.bias)[DAY:] ** 2)) / of_cubic for prediction in (multi, one)]
        )
        inside.append(np.mean(((multi.lo < means.bias) & (means.bias < multi.hi))[DAY:]))
        names["difference" if model.shape.difference_equation_order else "polynomial"] += 1
    multi_step, one_step = np.array(ratios).T
    return (
        f"{lag_h:g} h",
        f"{100 * noise:.0f} %",
        f"{np.median(multi_step):.3f}",
        f"{np.quantile(multi_step, 0.9):.3f}",
        f"{multi_step.max():.3f}",
        f"{np.median(one_step):.3f}",
        f"{100 * np.mean(inside):.1f} %",
        f"{names['difference']} of {seeds}",
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    heads = ("noise", "multi-step, median", "90 %", "worst", "one-step", "inside 95 %", "difference equation")
    table = create_table(f"Error over that of a cubic, {seeds} seeds a row", "lag", *heads)
    for lag_h in LAGS_H:
        for noise in NOISES:
            table.add_row(*measure_row(lag_h, noise, seeds))
    console.print(table)


if __name__ == "__main__":
    main()
