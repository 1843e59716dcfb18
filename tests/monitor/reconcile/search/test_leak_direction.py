"""Tests of the direction of leaks between axes with equal or different spectra, drawn in plain NumPy."""

import numpy as np
import pytest

from monitor.noise.effects import BandwidthLimit, CrossAxis, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.reconcile import reconcile
from tests.monitor.reconcile.axes import RATE_HZ, WALK, WHITE, walk, white

n = 20_000
WHITE_AXES = NoiseModel({"gx": (WHITE,), "gy": (WHITE,)})
DIFFERENT_AXES = NoiseModel({"gx": (WHITE,), "gy": (WHITE, WALK)})


def reconcile_leak(model, coefficient, seed):
    """Compare a recording in which gy leaks into gx with a model."""
    rng = np.random.default_rng(seed)
    gy = white(n, rng)
    if WALK in model.effects["gy"]:
        gy += walk(n, rng)
    return reconcile(RecordedAxes({"gx": white(n, rng) + coefficient * gy, "gy": gy}, RATE_HZ, None), model, seed)


def list_steps(found):
    return [(axis, step.kind, step.effect) for axis, one in found.axes.items() for step in one.steps]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_leak_between_axes_with_different_spectra_has_one_direction(seed):
    found = reconcile_leak(DIFFERENT_AXES, 0.3, seed)
    assert list_steps(found) == [("gx", "added", "cross_axis")]
    assert found.axes["gx"].steps[0].confidence > 0.99


def test_direction_of_a_weak_leak_between_equal_axes_is_uncertain():
    confidences = []
    for seed in range(4):
        found = reconcile_leak(WHITE_AXES, 0.05, seed)
        ((_, kind, effect),) = list_steps(found)
        assert (kind, effect) == ("added", "cross_axis")
        confidences += [step.confidence for one in found.axes.values() for step in one.steps]
    assert np.mean(confidences) == pytest.approx(0.6, abs=0.2)


@pytest.mark.parametrize("model_coefficient", [0.02, -0.1])
def test_other_coefficient_of_a_leak_of_the_model_adds_no_leak_in_the_opposite_direction(model_coefficient):
    leak = CrossAxis(source="gy", coefficient=model_coefficient)
    found = reconcile_leak(WHITE_AXES + NoiseModel({"gx": (leak,)}), 0.1, 1)
    assert list_steps(found) == [("gx", "retuned", "cross_axis")]


def test_leak_of_the_model_is_no_leak_in_the_opposite_direction():
    """The search on gy starts because of its white noise, and finds the samples of gx correlated with gy."""
    leak = CrossAxis(source="gy", coefficient=0.05)
    model = NoiseModel({"gx": (WHITE, leak), "gy": (WALK,)})
    found = reconcile_leak(model, 0.05, 1)
    assert ("gy", "added", "cross_axis") not in list_steps(found)
    assert found.axes["gy"].steps


def test_new_leak_beside_a_leak_of_the_model_in_the_opposite_direction():
    """The spectra differ, so the leak of the model is not resized to explain the new leak."""
    known, hidden, rng = 0.05, 0.2, np.random.default_rng(4)
    own_gx = white(n, rng)
    gy = white(n, rng) + walk(n, rng, 20.0 * WALK.K) + known * own_gx
    model = NoiseModel(
        {"gx": (WHITE,), "gy": (WHITE, RateRandomWalk(K=20.0 * WALK.K), CrossAxis(source="gx", coefficient=known))}
    )
    found = reconcile(RecordedAxes({"gx": own_gx + hidden * (gy - known * own_gx), "gy": gy}, RATE_HZ, None), model, 1)
    assert ("gx", "added", "cross_axis") in list_steps(found)
    assert ("gy", "retuned", "cross_axis") not in list_steps(found)


def test_leak_of_a_filtered_axis_agrees_with_its_simulation():
    leak, filtered = CrossAxis(source="gy", coefficient=0.2), BandwidthLimit(cutoff=10.0, order=2)
    model = NoiseModel({"gx": (WHITE, leak, filtered), "gy": (WHITE, BandwidthLimit(cutoff=30.0))})
    drawn = model.simulate(n, RATE_HZ, 5)
    recorded = RecordedAxes({"gx": drawn[:, 0].copy(), "gy": drawn[:, 1].copy()}, RATE_HZ, None)
    found = reconcile(recorded, model, 1)
    assert found.verdict == "agrees"
    assert max(gap.threshold for gap in found.axes["gx"].start.gaps if gap.diagnostic == "other_axes") < 6.0
