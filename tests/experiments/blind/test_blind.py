"""Tests of ``reconcile`` with a small part of the blind trials: recordings of 20 minutes with one or two axes.

The effects have the level *plain*. The documentation contains results for faint effects, pairs and similar effects.
``python -m tests.experiments.blind`` runs all blind trials.
"""

import pytest

from monitor.publishing.reports import reconcile_page, reconcile_rrd
from tests.experiments.blind import levels
from tests.experiments.blind.oracle import Gains
from tests.experiments.blind.recipes import sized
from tests.experiments.blind.run import Job, run_job
from tests.experiments.blind.score import OPEN_VERDICTS, Outcome

SECONDS = 1200.0
AXES = 2
SIZES_OF_LEVEL = {
    "wandering_line": (2.741e-4, 1.050e-4, 1.808e-4, 1.142e-4, 7.181e-5, 1.766e-4, 1.340e-4, 2.580e-4),
    "narrowband": (2.331e-4, 1.368e-4, 2.215e-4, 2.311e-4),
    "sinusoidal": (7.142e-5, 7.027e-5, 1.307e-4, 9.325e-5),
}
"""Sizes of the level *plain* for each seed. The search for these sizes takes longer than ``reconcile``."""


def make_job(name: str, seed: int = 0, axes: int = AXES) -> Job:
    return Job(name, "plain", seed, SECONDS, axes=axes)


def run_long_job(monkeypatch: pytest.MonkeyPatch, name: str, seed: int) -> Outcome:
    """Run a case of one axis and known size, and write only the scored part of the report."""
    size = SIZES_OF_LEVEL[name][seed]
    monkeypatch.setattr(
        levels, "_search", lambda _, effect, wanted: (sized(effect, size, wanted.direction), Gains(wanted.gain, 0.0))
    )
    monkeypatch.setattr(reconcile_page, "render_page", lambda *_: "")
    monkeypatch.setattr(reconcile_rrd, "write_rrd", lambda *_: None)
    return run_job(make_job(name, seed, axes=1), in_process=True)


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
def test_wandering_lines_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = [run_long_job(monkeypatch, "wandering_line", seed) for seed in range(8)]
    named = [[one.effect for one in found.names] for found in outcomes]
    assert named.count(["wandering_line"]) >= 6
    assert all(found.closed for found, names in zip(outcomes, named, strict=True) if names == ["wandering_line"])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["narrowband", "sinusoidal"])
def test_resonance_and_line_are_not_named_wandering_line(monkeypatch: pytest.MonkeyPatch, name: str, seed: int) -> None:
    found = run_long_job(monkeypatch, name, seed)
    assert "wandering_line" not in [one.effect for one in found.names]


@pytest.mark.parametrize("name", ["chirp", "sawtooth", "amplitude_modulated_line"])
def test_foreign_effect_gets_no_name(name: str) -> None:
    found = run_job(make_job(f"foreign:{name}", axes=1), in_process=True)
    assert found.exit_status == 0
    assert found.verdict in OPEN_VERDICTS
    assert not found.false
