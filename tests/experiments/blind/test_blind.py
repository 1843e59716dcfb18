"""Tests of ``reconcile`` with a small part of the blind trials: recordings of 20 minutes with one or two axes.

The effects have the level *plain*. The documentation contains results for faint effects, pairs and similar effects.
``python -m tests.experiments.blind`` runs all blind trials.
"""

import pytest

from tests.experiments.blind.run import Job, run_job
from tests.experiments.blind.score import OPEN_VERDICTS

SECONDS = 1200.0
AXES = 2


def make_job(name: str, seed: int = 0, axes: int = AXES) -> Job:
    return Job(name, "plain", seed, SECONDS, axes=axes)


@pytest.mark.parametrize(
    "name", ["sinusoidal", "bias_step", "outliers", "resolution", "temperature_bias", "exponentially_correlated"]
)
def test_hidden_effect_is_named(name: str) -> None:
    found = run_job(make_job(name), in_process=True)
    assert found.exit_status == 0
    assert [(named.effect, named.right) for named in found.names] == [(name, True)]
    assert not found.missed
    assert found.closed


@pytest.mark.parametrize("seed", range(4))
def test_recording_of_the_true_model_agrees(seed: int) -> None:
    found = run_job(make_job("null", seed, axes=1), in_process=True)
    assert (found.exit_status, found.verdict, found.names) == (0, "agrees", ())


@pytest.mark.long
def test_wandering_lines_are_named() -> None:
    outcomes = [run_job(make_job("wandering_line", seed, axes=1), in_process=True) for seed in range(8)]
    named = [[one.effect for one in found.names] for found in outcomes]
    assert named.count(["wandering_line"]) >= 6
    assert all(found.closed for found, names in zip(outcomes, named, strict=True) if names == ["wandering_line"])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["narrowband", "sinusoidal"])
def test_resonance_and_line_are_not_named_wandering_line(name: str, seed: int) -> None:
    found = run_job(make_job(name, seed, axes=1), in_process=True)
    assert "wandering_line" not in [one.effect for one in found.names]


@pytest.mark.parametrize("name", ["chirp", "sawtooth", "amplitude_modulated_line"])
def test_foreign_effect_gets_no_name(name: str) -> None:
    found = run_job(make_job(f"foreign:{name}", axes=1), in_process=True)
    assert found.exit_status == 0
    assert found.verdict in OPEN_VERDICTS
    assert not found.false
