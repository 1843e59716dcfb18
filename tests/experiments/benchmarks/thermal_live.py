"""A bias that follows temperature, interval by interval: how often what was expected holds, and what is told of it.

    python -m tests.experiments.benchmarks.thermal_live [--seeds 50] [--only white late wander walk steps]

200 means of ten minutes, drawn apart from the room under test: a daily swing of 3 °C with clouds, heat that comes at
once or 2 h late; what is left of the bias is white, or correlated from mean to mean (0.8), or has a random walk in it
(0.2 of the white noise a mean). Of a true model nothing should be told; of steps, after 140 means, all.
"""

import argparse
from itertools import islice

import numpy as np

from drivers.data_types import Floats
from monitor.drift.thermal.online_thermal_model import MeasuredAndPredictedMean, OnlineThermalModel
from monitor.drift.thermal.residual_alarm import UnexplainedChange
from tests.experiments.benchmarks.machine import console, create_table
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, apply_lag, simulate_temperature

COUNT, MINUTES, FIRST, AT = 200, 10, 36, 140
NOISE = 0.05  # of the swing of the bias
KEEP = 0.8
WALK = 0.2
KINDS = {"white": 0.0, "late": 2.0, "wander": 2.0, "walk": 2.0}  # how late, h
STEPS = (3.0, 5.0, 10.0)  # deviations of a mean


def record(kind: str, seed: int, step: float = 0.0) -> tuple[Floats, Floats, float]:
    """Means of bias and temperature, and the deviation of a mean."""
    rng = np.random.default_rng(seed)
    hours = -(-COUNT * MINUTES // 60)
    warmth = simulate_temperature(hours, rng)
    both = [
        part[-60 * hours :].reshape(-1, MINUTES).mean(axis=1)[:COUNT]
        for part in (apply_lag(warmth, KINDS[kind]), warmth)
    ]
    bias = BIAS_SLOPE * both[0]
    size = NOISE * float(np.ptp(bias))
    left = rng.standard_normal(COUNT)
    if kind == "wander":
        left = wandering(left)
    if kind == "walk":
        left = left + WALK * rng.standard_normal(COUNT).cumsum()
    return bias + size * (left + step * (np.arange(COUNT) >= AT)), both[1], size


def wandering(draws: Floats) -> Floats:
    """Of deviation one, correlated by KEEP."""
    out, level = np.empty(draws.size), float(draws[0])
    for k, draw in enumerate(draws.tolist()):
        level = KEEP * level + (1.0 - KEEP**2) ** 0.5 * draw
        out[k] = level
    return out


def followed(
    kind: str, seed: int, step: float = 0.0
) -> tuple[list[MeasuredAndPredictedMean], list[tuple[int, UnexplainedChange]], float]:
    """The intervals, what was told when, and the deviation of a mean."""
    biases, warmth, size = record(kind, seed, step)
    axis, looks, told = OnlineThermalModel(60.0 * MINUTES), [], []
    for k, (bias, temperature_c) in enumerate(zip(biases.tolist(), warmth.tolist(), strict=True)):
        looks.append(axis.predict_and_add_interval(bias, size, temperature_c))
        while axis.run_selection_step_if_active():
            pass
        told += [(k, found) for found in axis.take_unexplained_changes()]
    return looks, told, size


def held(kind: str, seeds: int) -> tuple[str, ...]:
    """One row of the first table."""
    inside: dict[bool, list[bool]] = {True: [], False: []}
    told, records = 0, 0
    for seed in range(seeds):
        looks, found, _ = followed(kind, seed)
        told, records = told + len(found), records + bool(found)
        for k, one in enumerate(looks):
            if one.one_step is not None:
                inside[k < FIRST].append(one.one_step.side_of_interval(one.bias) == 0)
    count = sum(map(len, inside.values()))
    shares = [f"{100 * np.mean(inside[early]):.1f} %" for early in (True, False)]
    return kind, f"{count}", *shares, f"{told}", f"{records} of {seeds}"


def found_steps(step: float, seeds: int) -> tuple[str, ...]:
    """One row of the second table."""
    after, sizes = [], []
    for seed in range(seeds):
        _, told, size = followed("late", seed, step)
        right = [(k, one) for k, one in told if k >= AT]
        for k, one in islice(right, 1):
            after.append(k - AT + 1)
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
    heads = ("predicted", f"inside, to mean {FIRST}", "after", "told", "records")
    table = create_table(f"A true model, {arguments.seeds} records of {COUNT} means", "left", *heads)
    for kind in KINDS:
        if kind in arguments.only:
            table.add_row(*held(kind, arguments.seeds))
    if table.row_count:
        console.print(table)
    if "steps" in arguments.only:
        table = create_table("A step", "size", "told", "means until told", "size told over true")
        for step in STEPS:
            table.add_row(*found_steps(step, arguments.seeds))
        console.print(table)


if __name__ == "__main__":
    main()
