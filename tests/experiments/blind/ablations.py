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

from tests.experiments.blind.run import Job, run

NULLS = 10
HIDDEN = (
    *("sinusoidal", "narrowband", "exponentially_correlated", "rate_ramp", "bias_step", "temperature_bias"),
    *("outliers", "cross_axis"),
)
FOREIGN = ("foreign:chirp", "foreign:amplitude_modulated_line", "foreign:sawtooth")


@contextmanager
def as_it_is() -> Iterator[None]:
    """Nothing switched off."""
    yield


@contextmanager
def without_null() -> Iterator[None]:
    """Thresholds from a table instead of from simulated recordings."""
    from monitor.reconcile import reconcile
    from monitor.reconcile.diagnostics.null_distribution import AxisNull, NullDistribution
    from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS

    def table(simulated: Mapping[str, Sequence[Any]]) -> dict[str, AxisNull]:
        return {axis: dict.fromkeys(DIAGNOSTICS, NullDistribution(1.92, 3.32)) for axis in simulated}

    with patch.object(reconcile, "estimate_null_distributions", table):
        yield


@contextmanager
def without_proof() -> Iterator[None]:
    """Nothing held out."""
    from monitor.reconcile.search import search

    with patch.object(search, "cross_validate", lambda *_arguments: search.accept_without_validation("switched off")):
        yield


@contextmanager
def without_refit() -> Iterator[None]:
    """The model's own sizes stay whatever is added."""
    from monitor.reconcile.likelihood import hypothesis
    from monitor.reconcile.search import search

    def stiff(axis: Any, added: Sequence[Any], model: tuple[Any, ...]) -> Any:
        return hypothesis.Hypothesis(model, axis.fit((*model, *added), hypothesis.noise_effect_indices(model)))

    name = "fit_with_fewest_changes"
    with patch.object(search, name, stiff), patch.object(hypothesis, name, stiff):
        yield


@contextmanager
def without_withdrawal() -> Iterator[None]:
    """Names stay, whatever is left at their place."""
    from monitor.reconcile.search import search

    with patch.object(search, "keep_uncontradicted_effects", lambda found, *_others: found):
        yield


VARIANTS: dict[str, Callable[[], Any]] = {
    "as it is": as_it_is,
    "without the simulated null": without_null,
    "without held-out halves": without_proof,
    "without the joint refit": without_refit,
    "without withdrawn names": without_withdrawal,
}


def main() -> None:
    """Run all variants and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--only", nargs="*", choices=VARIANTS, default=list(VARIANTS))
    asked = parser.parse_args()
    heads = ("", "true models accused", "given a name", "hidden and named", "5 % off", "false names", "foreign named")
    print("| " + " | ".join(heads) + " |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in asked.only:
        print(f"| {name} | " + " | ".join(_counts(VARIANTS[name], asked.seeds, asked.seconds)) + " |", flush=True)


def _counts(variant: Callable[[], Any], seeds: int, seconds: float) -> list[str]:
    def job(name: str, seed: int) -> Job:
        return Job(name, "plain", seed, seconds, axes=2)

    with variant():
        nulls = [run(job("null", seed), in_process=True) for seed in range(NULLS)]
        hidden = [run(job(name, seed), in_process=True) for name in HIDDEN for seed in range(seeds)]
        off = [
            run(replace(job(name, seed), baseline="off"), in_process=True) for name in HIDDEN for seed in range(seeds)
        ]
        foreign = [run(job(name, seed), in_process=True) for name in FOREIGN for seed in range(seeds)]
    named = [sum(not one.missed for one in group) for group in (hidden, off)]
    return [
        f"{sum(one.verdict != 'agrees' for one in nulls)} of {len(nulls)}",
        f"{sum(bool(one.names) for one in nulls)} of {len(nulls)}",
        f"{named[0]} of {len(hidden)}",
        f"{named[1]} of {len(off)}",
        f"{sum(len(one.false) for one in [*hidden, *off])}",
        f"{sum(bool(one.false) for one in foreign)} of {len(foreign)}",
    ]


if __name__ == "__main__":
    main()
