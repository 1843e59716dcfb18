"""Coverage of the predictions of the online thermal model, and detection of unexplained steps.

    python -m tests.experiments.benchmarks.thermal_live [--seeds 50] [--only white late wander walk steps]

Each record has 200 means of ten minutes, which are simulated without code of ``monitor.drift``. The temperature has a
daily swing of 3 °C with random clouds, and the bias follows without a lag or with a lag of 2 h. The residual of the
bias is white, correlated between means (0.8), or contains a random walk (0.2 of the white noise per mean). Without a
step, there should be no alarm. Steps occur after 140 means, and all should be detected.
"""

import argparse
from itertools import islice

import numpy as np

from drivers.data_types import Floats
from monitor.drift.thermal.online_thermal_model import MeasuredAndPredictedMean, OnlineThermalModel
from monitor.drift.thermal.residual_alarm import UnexplainedChange
from tests.experiments.benchmarks.machine import console, create_table
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, apply_lag, simulate_temperature

COUNT, MINUTES, LEARNING_MEANS, STEP_INDEX = 200, 10, 36, 140
NOISE = 0.05  # of the swing of the bias
CORRELATION = 0.8
WALK = 0.2
KINDS = {"white": 0.0, "late": 2.0, "wander": 2.0, "walk": 2.0}  # lag in h
STEPS = (3.0, 5.0, 10.0)  # in standard deviations of a mean


def simulate_means(kind: str, seed: int, step: float = 0.0) -> tuple[Floats, Floats, float]:
    """Return means of bias and temperature, and the standard deviation of a mean."""
    rng = np.random.default_rng(seed)
    hours = -(-COUNT * MINUTES // 60)
    temperatures = simulate_temperature(hours, rng)
    both = [
        part[-60 * hours :].reshape(-1, MINUTES).mean(axis=1)[:COUNT]
        for part in (apply_lag(temperatures, KINDS[kind]), temperatures)
    ]
    bias = BIAS_SLOPE * both[0]
    size = NOISE * float(np.ptp(bias))
    residual = rng.standard_normal(COUNT)
    if kind == "wander":
        residual = correlate(residual)
    if kind == "walk":
        residual = residual + WALK * rng.standard_normal(COUNT).cumsum()
    return bias + size * (residual + step * (np.arange(COUNT) >= STEP_INDEX)), both[1], size


def correlate(draws: Floats) -> Floats:
    """Return a series with standard deviation 1 and correlation CORRELATION."""
    out, level = np.empty(draws.size), float(draws[0])
    for k, draw in enumerate(draws.tolist()):
        level = CORRELATION * level + (1.0 - CORRELATION**2) ** 0.5 * draw
        out[k] = level
    return out


def run_online_model(
    kind: str, seed: int, step: float = 0.0
) -> tuple[list[MeasuredAndPredictedMean], list[tuple[int, UnexplainedChange]], float]:
    """Return the intervals, the alarms with their positions, and the standard deviation of a mean."""
    biases, temperatures, size = simulate_means(kind, seed, step)
    axis, intervals, alarms = OnlineThermalModel(60.0 * MINUTES), [], []
    for k, (bias, temperature_c) in enumerate(zip(biases.tolist(), temperatures.tolist(), strict=True)):
        intervals.append(axis.predict_and_add_interval(bias, size, temperature_c))
        while axis.run_selection_step_if_active():
            pass
        alarms += [(k, found) for found in axis.take_unexplained_changes()]
    return intervals, alarms, size


def measure_coverage(kind: str, seeds: int) -> tuple[str, ...]:
    """Return one row of the first table."""
    inside: dict[bool, list[bool]] = {True: [], False: []}
    alarms, records = 0, 0
    for seed in range(seeds):
        intervals, found, _ = run_online_model(kind, seed)
        alarms, records = alarms + len(found), records + bool(found)
        for k, one in enumerate(intervals):
            if one.one_step is not None:
                inside[k < LEARNING_MEANS].append(one.one_step.side_of_interval(one.bias) == 0)
    count = sum(map(len, inside.values()))
    shares = [f"{100 * np.mean(inside[early]):.1f} %" for early in (True, False)]
    return kind, f"{count}", *shares, f"{alarms}", f"{records} of {seeds}"


def measure_steps(step: float, seeds: int) -> tuple[str, ...]:
    """Return one row of the second table."""
    after, sizes = [], []
    for seed in range(seeds):
        _, alarms, size = run_online_model("late", seed, step)
        right = [(k, one) for k, one in alarms if k >= STEP_INDEX]
        for k, one in islice(right, 1):
            after.append(k - STEP_INDEX + 1)
            sizes.append(one.size / (step * size))
    if not after:
        return f"{step:g} σ", f"0 of {seeds}", "—", "—"
    return f"{step:g} σ", f"{len(after)} of {seeds}", f"{np.median(after):.0f}", f"{np.median(sizes):.2f}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--only", nargs="*", choices=[*KINDS, "steps"], default=[*KINDS, "steps"])
    arguments = parser.parse_args()
    heads = ("predicted", f"inside, to mean {LEARNING_MEANS}", "after", "alarms", "records")
    table = create_table(f"A true model, {arguments.seeds} records of {COUNT} means", "residual", *heads)
    for kind in KINDS:
        if kind in arguments.only:
            table.add_row(*measure_coverage(kind, arguments.seeds))
    if table.row_count:
        console.print(table)
    if "steps" in arguments.only:
        table = create_table("A step", "size", "detected", "means until detection", "measured over true size")
        for step in STEPS:
            table.add_row(*measure_steps(step, arguments.seeds))
        console.print(table)


if __name__ == "__main__":
    main()
