"""Tests that a candidate effect whose fit fails does not end the command and does not hide the other findings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.noise.effects import EFFECTS, AngleRandomWalk
from monitor.noise.model import NoiseModel
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.axis_fit import Axis
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.reconcile import reconcile

RATE_HZ, n, N = 100.0, 1 << 14, 1e-4
FAILURES = {
    "singular matrix": np.linalg.LinAlgError("Matrix is singular to machine precision."),
    "invalid parameter": ConfigError("gain must be a finite number, is nan"),
    "overflow": OverflowError("math range error"),
    "nan": None,
}
CANDIDATES = set(EFFECTS) & set(PENALTY_NATS) - {AngleRandomWalk.name}
HIDDEN = {("gx", "sinusoidal"), ("gy", "bias_step"), ("gz", "resolution")}


@cache
def recording():
    rng, t = np.random.default_rng(5), np.arange(n) / RATE_HZ
    gx, gy, gz = N * RATE_HZ**0.5 * rng.standard_normal((3, n))
    gx += 3e-4 * np.sin(2.0 * np.pi * 17.3 * t)
    gy += np.where(t > 70.0, 4e-4, 0.0)
    gz = 2e-3 * np.rint(gz / 2e-3)
    return RecordedAxes({"gx": gx, "gy": gy, "gz": gz}, RATE_HZ, None)


def find():
    model = NoiseModel(dict.fromkeys(("gx", "gy", "gz"), (AngleRandomWalk(N=N),)), RATE_HZ)
    return reconcile(recording(), model, seed=1)


def found_effects(result):
    return {(axis, step.effect) for axis, one in result.axes.items() for step in one.steps}


def fail(monkeypatch, names, failure):
    """Make every fit fail that contains an effect with one of the names."""
    fit = Axis.fit

    def fit_or_fail(self, effects, fixed_sizes=frozenset()):
        if not any(effect.name in names for effect in effects):
            return fit(self, effects, fixed_sizes)
        if failure is not None:
            raise failure
        return replace(fit(self, effects, fixed_sizes), log_likelihood=float("nan"))

    monkeypatch.setattr(Axis, "fit", fit_or_fail)


@pytest.mark.parametrize("failure", FAILURES.values(), ids=FAILURES)
def test_findings_remain_if_all_other_candidates_fail(monkeypatch, failure):
    fail(monkeypatch, CANDIDATES - {effect for _, effect in HIDDEN}, failure)
    result = find()
    assert found_effects(result) >= HIDDEN
    if failure is not None:
        assert any(str(failure) in one for one in result.failed_candidates)


@pytest.mark.long
def test_candidate_that_fails_is_dropped(monkeypatch):
    """Candidates that the search does not try on this recording, such as effects of temperature, cannot fail."""
    fit, tried = Axis.fit, set()

    def fit_and_note(self, effects, fixed_sizes=frozenset()):
        tried.update(effect.name for effect in effects)
        return fit(self, effects, fixed_sizes)

    monkeypatch.setattr(Axis, "fit", fit_and_note)
    find()
    failing = sorted(tried & CANDIDATES)
    assert len(failing) >= 16
    for name in failing:
        monkeypatch.setattr(Axis, "fit", fit)
        fail(monkeypatch, {name}, FAILURES["singular matrix"])
        found = found_effects(find())
        assert name not in {effect for _, effect in found}, name
        assert found >= {one for one in HIDDEN if one[1] != name}, name


@pytest.mark.parametrize("step", [1.4, 2.0, 3.0])
def test_values_rounded_to_steps_larger_than_the_noise(step):
    rng = np.random.default_rng(1)
    values = {axis: N * RATE_HZ**0.5 * rng.standard_normal(n) for axis in ("gx", "gy", "gz")}
    step *= N * RATE_HZ**0.5
    values["gz"] = step * np.rint(values["gz"] / step)
    result = reconcile(RecordedAxes(values, RATE_HZ, None), None, seed=1)
    assert found_effects(result) - {("gz", "angle_random_walk")} == {("gz", "resolution")}
    assert result.verdict == "explained"
    assert not result.failed_candidates
