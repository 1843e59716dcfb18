"""Gains of the diagnostics on recordings of a true model, beside thresholds from six simulated recordings.

    python -m tests.experiments.blind.null_gains --recordings 200 --model white five adis16405

Each model is simulated on three axes. The thresholds are estimated again for every six recordings, as ``reconcile``
does, and the following six recordings are compared with them.
"""

import argparse
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

# set before NumPy is imported, so that programs do not compete for the cores
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from drivers.data_types import AXES  # noqa: E402
from monitor.noise.effects import (  # noqa: E402
    AngleRandomWalk,
    BiasInstability,
    ConstantBias,
    QuantizationNoise,
    RateRamp,
    RateRandomWalk,
)
from monitor.noise.model import NoiseModel  # noqa: E402
from monitor.noise.model_loading import load_model  # noqa: E402
from monitor.reconcile.diagnostics.null_distribution import (  # noqa: E402
    Findings,
    estimate_null_distributions,
    run_diagnostics,
)
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS  # noqa: E402
from monitor.reconcile.likelihood.axis_fit import RegressorCache  # noqa: E402
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_model_sizes  # noqa: E402
from monitor.reconcile.likelihood.whitening import whiten_axis  # noqa: E402
from monitor.reconcile.preparation.reconcile_input import RecordedAxes  # noqa: E402
from monitor.reconcile.reconcile import SIMULATED_RECORDINGS  # noqa: E402
from monitor.reconcile.search.sample_repair import build_repaired_axes  # noqa: E402
from tests.experiments.blind.tables import format_share, format_table  # noqa: E402

RATE_HZ: Final = 100.0
TERMS: Final = {
    "white": (AngleRandomWalk(N=1.5e-4),),
    "five": (
        QuantizationNoise(Q=2e-6),
        AngleRandomWalk(N=1.5e-4),
        BiasInstability(B=4e-5),
        RateRandomWalk(K=3e-6),
        RateRamp(R=1e-8),
    ),
}
Round = dict[str, list[Findings]]
"""Findings of one axis in each recording."""


def diagnose(model: NoiseModel, n: int, seeds: Sequence[int]) -> Round:
    """Run the diagnostics on simulated recordings of a model, with a temperature that no axis follows."""
    effects = {axis: tuple(e for e in model.effects[axis] if not isinstance(e, ConstantBias)) for axis in AXES[:3]}
    temperature_c = 25.0 - 3.0 * np.exp(-np.arange(n) / (0.2 * n))
    regressors = RegressorCache(n, RATE_HZ, temperature_c)
    found: Round = {axis: [] for axis in effects}
    for seed in seeds:
        drawn = model.simulate(n, RATE_HZ, seed, temperature_c)
        recording = RecordedAxes({axis: drawn[:, AXES.index(axis)] for axis in effects}, RATE_HZ, temperature_c)
        axes = build_repaired_axes(recording, effects, regressors, np.random.default_rng(seed))
        for axis, own in effects.items():
            found[axis].append(run_diagnostics(whiten_axis(fit_with_model_sizes(axes[axis], own).fit)))
    return found


def compare_with_thresholds(model: NoiseModel, n: int, recordings: int) -> str:
    """Compare the thresholds of each six recordings with the gains of the following six recordings."""
    rounds = [
        diagnose(model, n, range(first, first + SIMULATED_RECORDINGS))
        for first in range(0, recordings + SIMULATED_RECORDINGS, SIMULATED_RECORDINGS)
    ]
    gains: dict[str, list[float]] = {name: [] for name in DIAGNOSTICS}
    thresholds: dict[str, list[float]] = {name: [] for name in DIAGNOSTICS}
    above, searched = [], []
    for before, after in pairwise(rounds):
        null = estimate_null_distributions(before)
        for at in range(SIMULATED_RECORDINGS):
            results = [(null[axis][name], after[axis][at][name].gain, name) for axis in after for name in DIAGNOSTICS]
            above.append(any(gain > limits.threshold for limits, gain, _ in results))
            searched.append(any(gain > limits.min_gain_to_test_effects for limits, gain, _ in results))
            for limits, gain, name in results:
                gains[name].append(gain)
                thresholds[name].append(limits.threshold)
    rows = [
        (
            name,
            *(f"{np.quantile(gains[name], q):.1f}" for q in (0.5, 0.95, 0.99)),
            f"{max(gains[name]):.1f}",
            f"{np.mean(thresholds[name]):.1f} ± {np.std(thresholds[name]):.1f}",
            format_share(sum(g > t for g, t in zip(gains[name], thresholds[name], strict=True)), len(gains[name])),
        )
        for name in DIAGNOSTICS
    ]
    lines = [
        format_table(("diagnostic", "median", "95 %", "99 %", "largest", "threshold", "above, of axes"), rows),
        f"Recordings above a threshold: {format_share(sum(above), len(above))}.",
        f"Recordings that are searched: {format_share(sum(searched), len(searched))}.",
    ]
    return "\n\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.experiments.blind.null_gains")
    parser.add_argument("--recordings", type=int, default=120)
    parser.add_argument("--hours", type=float, default=1.0 / 6.0)
    parser.add_argument("--model", nargs="+", default=["white", "five", "adis16405"])
    options = parser.parse_args()
    for name in options.model:
        model = NoiseModel(dict.fromkeys(AXES[:3], TERMS[name])) if name in TERMS else load_model(name, Path.cwd())
        tables = compare_with_thresholds(model, round(3600.0 * options.hours * RATE_HZ), options.recordings)
        print(f"{name}\n\n{tables}\n", flush=True)


if __name__ == "__main__":
    main()
