"""A small part of the blind harness: twenty minutes of two axes, or one, the command called in this process.

What stands here is plain. How often faint effects, pairs and lookalikes are named, counted over many recordings, is
in the documentation; the whole harness is ``python -m tests.experiments.blind``.
"""

import pytest

from tests.experiments.blind.run import Job, run
from tests.experiments.blind.score import OPEN

SECONDS = 1200.0
AXES = 2


def job(name: str, seed: int = 0, axes: int = AXES) -> Job:
    return Job(name, "plain", seed, SECONDS, axes=axes)


@pytest.mark.parametrize(
    "name", ["sinusoidal", "bias_step", "outliers", "resolution", "temperature_bias", "exponentially_correlated"]
)
def test_hidden_effect_is_named(name: str) -> None:
    found = run(job(name), in_process=True)
    assert found.exit_status == 0
    assert [(one.effect, one.right) for one in found.names] == [(name, True)]
    assert not found.missed
    assert found.closed


@pytest.mark.parametrize("seed", range(4))
def test_true_model_is_not_accused(seed: int) -> None:
    found = run(job("null", seed, axes=1), in_process=True)
    assert (found.exit_status, found.verdict, found.names) == (0, "agrees", ())


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_a_wandering_line_is_named(seed: int) -> None:
    found = run(job("wandering_line", seed, axes=1), in_process=True)
    assert [(one.effect, one.right) for one in found.names] == [("wandering_line", True)]
    assert found.closed


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["narrowband", "sinusoidal"])
def test_a_resonance_and_a_line_do_not_wander(name: str, seed: int) -> None:
    found = run(job(name, seed, axes=1), in_process=True)
    assert "wandering_line" not in [one.effect for one in found.names]


@pytest.mark.parametrize("name", ["chirp", "sawtooth", "amplitude_modulated_line"])
def test_foreign_effect_gets_no_name(name: str) -> None:
    found = run(job(f"foreign:{name}", axes=1), in_process=True)
    assert found.exit_status == 0
    assert found.verdict in OPEN
    assert not found.false
