"""Measure what each rule of ``reconcile`` contributes: run the blind set with one rule switched off at a time.

    python -m tests.experiments.blind.ablations [--seeds 2] [--seconds 1200]

The following rules are switched off:

- the simulated null distribution: each diagnostic has the 99 % point of χ² with one degree of freedom as threshold
- cross-validation: every effect that exceeds its penalty is accepted
- the joint fit: a candidate effect is fitted beside the model, and no known size may change
- the withdrawal of contradicted effects

The tables count false names on recordings of a true model, hidden effects that are named, false names beside them, and
foreign effects that get a name.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

from tests.experiments.blind.run import Job, run_job

NULLS = 10
HIDDEN = (
    *("sinusoidal", "narrowband", "exponentially_correlated", "rate_ramp", "bias_step", "temperature_bias"),
    *("outliers", "cross_axis"),
)
FOREIGN = ("foreign:chirp", "foreign:amplitude_modulated_line", "foreign:sawtooth")


@contextmanager
def unchanged() -> Iterator[None]:
    """Switch nothing off."""
    yield


@contextmanager
def without_null_distribution() -> Iterator[None]:
    """Use thresholds of the χ² distribution instead of simulated recordings."""
    from monitor.reconcile import reconcile
    from monitor.reconcile.diagnostics.null_distribution import AxisNull, NullDistribution
    from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS

    def fixed_distributions(simulated: Mapping[str, Sequence[Any]]) -> dict[str, AxisNull]:
        return {axis: dict.fromkeys(DIAGNOSTICS, NullDistribution(1.92, 3.32)) for axis in simulated}

    with patch.object(reconcile, "estimate_null_distributions", fixed_distributions):
        yield


@contextmanager
def without_cross_validation() -> Iterator[None]:
    """Accept every effect without cross-validation."""
    from monitor.reconcile.search import search

    with patch.object(search, "cross_validate", lambda *_arguments: search.accept_without_validation("switched off")):
        yield


@contextmanager
def without_joint_fit() -> Iterator[None]:
    """Keep all sizes of the model fixed when an effect is added."""
    from monitor.reconcile.likelihood import hypothesis_fit
    from monitor.reconcile.search import search

    def fit_with_fixed_sizes(axis: Any, added: Sequence[Any], model: tuple[Any, ...]) -> Any:
        return hypothesis_fit.Hypothesis(model, axis.fit((*model, *added), hypothesis_fit.noise_effect_indices(model)))

    name = "fit_with_fewest_changes"
    with patch.object(search, name, fit_with_fixed_sizes), patch.object(hypothesis_fit, name, fit_with_fixed_sizes):
        yield


@contextmanager
def without_withdrawal() -> Iterator[None]:
    """Do not withdraw contradicted effects."""
    from monitor.reconcile.search import search

    with patch.object(search, "keep_uncontradicted_effects", lambda found, *_others: found):
        yield


VARIANTS: dict[str, Callable[[], Any]] = {
    "unchanged": unchanged,
    "without simulated null distribution": without_null_distribution,
    "without cross-validation": without_cross_validation,
    "without joint fit": without_joint_fit,
    "without withdrawal": without_withdrawal,
}


def main() -> None:
    """Run all variants and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--only", nargs="*", choices=VARIANTS, default=list(VARIANTS))
    asked = parser.parse_args()
    heads = (
        "",
        "true models rejected",
        "true models with a name",
        "effects named",
        "effects named, baseline 5 % off",
        "false names",
        "foreign effects named",
    )
    print("| " + " | ".join(heads) + " |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in asked.only:
        print(f"| {name} | " + " | ".join(_counts(VARIANTS[name], asked.seeds, asked.seconds)) + " |", flush=True)


def _counts(variant: Callable[[], Any], seeds: int, seconds: float) -> list[str]:
    def job(name: str, seed: int) -> Job:
        return Job(name, "plain", seed, seconds, axes=2)

    with variant():
        nulls = [run_job(job("null", seed), in_process=True) for seed in range(NULLS)]
        hidden = [run_job(job(name, seed), in_process=True) for name in HIDDEN for seed in range(seeds)]
        off = [
            run_job(replace(job(name, seed), baseline="off"), in_process=True)
            for name in HIDDEN
            for seed in range(seeds)
        ]
        foreign = [run_job(job(name, seed), in_process=True) for name in FOREIGN for seed in range(seeds)]
    named = [sum(not outcome.missed for outcome in group) for group in (hidden, off)]
    return [
        f"{sum(outcome.verdict != 'agrees' for outcome in nulls)} of {len(nulls)}",
        f"{sum(bool(outcome.names) for outcome in nulls)} of {len(nulls)}",
        f"{named[0]} of {len(hidden)}",
        f"{named[1]} of {len(off)}",
        f"{sum(len(outcome.false) for outcome in [*hidden, *off])}",
        f"{sum(bool(outcome.false) for outcome in foreign)} of {len(foreign)}",
    ]


if __name__ == "__main__":
    main()
