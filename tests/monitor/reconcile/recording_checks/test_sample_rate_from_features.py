from math import log

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import AngleRandomWalk, Narrowband, SampleRateError, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.cosine_bins import cosine_transform
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.recording_checks.sample_rate_from_features import (
    correct_impossible_sample_rate,
    estimate_sample_rate_error,
    group_features_with_gains,
)
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.sample_rate_from_spectrum import SampleRateErrorEstimate
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, draw, make_model

MODEL = make_model()


def estimate(ratio, model_rate_hz, model=MODEL, seed=3):
    """Return the estimate for a recording whose true rate is ``ratio`` times the stated rate."""
    recording = draw(model, seed)
    coefficients = {axis: cosine_transform(y) for axis, y in recording.values.items()}
    return estimate_sample_rate_error(coefficients, RATE_HZ / ratio, model.effects, model_rate_hz, None)


@pytest.mark.parametrize("ratio", [0.82, 0.9, 0.97, 1.03, 1.1, 1.2])
def test_features_that_move_together_show_the_ratio(ratio):
    found = estimate(ratio, None)
    assert found.ratio.value == pytest.approx(ratio, rel=2e-3)
    assert found.ratio.lo <= ratio <= found.ratio.hi
    assert found.frequency[1] == pytest.approx(found.frequency[0] / ratio, rel=2e-3)


@pytest.mark.parametrize("ratio", [0.85, 0.98, 1.015, 1.2])
def test_one_feature_is_sufficient_if_the_model_states_the_other_rate(ratio):
    model = NoiseModel(
        {"gx": (AngleRandomWalk(N=1e-4), Narrowband(sigma=1e-3, frequency=12.0, bandwidth=0.05))}, RATE_HZ
    )
    assert estimate(ratio, RATE_HZ, model).ratio.value == pytest.approx(ratio, rel=1e-12)
    assert estimate(ratio, None, model) is None


def test_right_rate_is_no_finding():
    for seed in range(20):
        assert estimate(1.0, None, seed=seed) is None
        assert estimate(1.0, RATE_HZ * 1.05, seed=seed) is None


def test_features_that_move_differently_are_no_wrong_rate():
    other = NoiseModel(
        {
            axis: tuple(
                Narrowband(sigma=e.sigma, frequency=e.frequency * (1.0 + 0.012 * (k % 3)), bandwidth=e.bandwidth)
                if isinstance(e, Narrowband)
                else e
                for e in MODEL.effects[axis]
            )
            for k, axis in enumerate(AXES)
        },
        RATE_HZ,
    )
    recording = draw(other, 3)
    coefficients = {axis: cosine_transform(y) for axis, y in recording.values.items()}
    assert estimate_sample_rate_error(coefficients, RATE_HZ, MODEL.effects, RATE_HZ, None) is None


def test_harmonics_are_one_group():
    effects = {"gx": tuple(Narrowband(sigma=1e-3, frequency=f, bandwidth=0.1) for f in (7.0, 14.0, 21.0, 17.0))}
    y = np.random.default_rng(0).standard_normal(20_000)
    groups = group_features_with_gains({"gx": cosine_transform(y)}, RATE_HZ, effects)
    assert len(groups) == 2


def test_feature_above_half_the_stated_rate_needs_the_rate_of_the_model():
    model = NoiseModel(
        {"gx": (AngleRandomWalk(N=1e-4), Narrowband(sigma=1e-3, frequency=45.0, bandwidth=0.1))}, RATE_HZ
    )
    recording = draw(model, 3)
    stated = RecordedAxes(recording.values, 85.0)
    corrected, finding = correct_impossible_sample_rate(stated, model)
    assert corrected.rate_hz == RATE_HZ
    assert finding.kind == "sample_rate_error"
    assert log(finding.parameters["ratio"].value) == pytest.approx(log(100.0 / 85.0))
    assert correct_impossible_sample_rate(recording, model) is None
    white = RecordedAxes({axis: np.random.default_rng(0).standard_normal(16_000) for axis in AXES}, 85.0)
    assert correct_impossible_sample_rate(white, model) is None


def test_simulated_sample_rate_error_is_estimated():
    wrong = MODEL + NoiseModel({"gx": (SampleRateError(ratio=1.04),)})
    recording = draw(wrong, 3)
    coefficients = {axis: cosine_transform(y) for axis, y in recording.values.items()}
    found = estimate_sample_rate_error(coefficients, RATE_HZ, MODEL.effects, RATE_HZ, None)
    assert found.ratio.value == pytest.approx(1.04, rel=2e-3)


@pytest.mark.parametrize(
    ("smallest_axis_gain", "feature_gain", "accepted"), [(1.0, 25.0, True), (-1.0, 25.0, False), (1.0, 15.0, False)]
)
def test_weak_lines_need_the_noise_of_every_axis(smallest_axis_gain, feature_gain, accepted):
    line = NoiseModel({"gx": (Sinusoidal(amplitude=1e-9, frequency=17.0),)})
    model = NoiseModel(dict.fromkeys(AXES, (AngleRandomWalk(N=1e-3),))) + line
    coefficients = {axis: cosine_transform(y) for axis, y in draw(model, 3).values.items()}
    ratio = ParameterInterval(1.01, 1.0099, 1.0101)
    estimate = SampleRateErrorEstimate(ratio, 60.0, "gx", (17.0, 17.0 / 1.01), smallest_axis_gain, feature_gain)
    found = estimate_sample_rate_error(coefficients, RATE_HZ, model.effects, None, estimate)
    assert found == (estimate if accepted else None)
