"""Tests of the online thermal model of one axis."""

from itertools import pairwise

import numpy as np
import pytest

from monitor.drift.thermal.online_thermal_model import (
    MAX_INTERVALS,
    NEW_OFFSET,
    OFFSET_INTERVALS,
    REFIT_GROWTH,
    OnlineThermalModel,
)
from monitor.drift.thermal.residual_alarm import MIN_OUTSIDE
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, HOUR_S, simulate_hourly_means


class ModelRun:
    """Feeds intervals to an online thermal model and completes each model selection at once."""

    def __init__(self, slow: bool = False) -> None:
        self.model_under_test = OnlineThermalModel(HOUR_S)
        self.slow = slow
        self.results, self.found = [], []

    def add_intervals(self, biases, temperatures):
        for bias, temperature_c in zip(biases, temperatures, strict=True):
            self.results.append(self.model_under_test.predict_and_add_interval(float(bias), 1e-7, float(temperature_c)))
            while not self.slow and self.model_under_test.run_selection_step_if_active():
                pass
            self.found += [*self.model_under_test.take_unexplained_changes(), None][:1]
        return self


def compute_share_inside_prediction(results, biases):
    """Return the share of biases inside their one-step prediction intervals."""
    return np.mean([result.one_step.side_of_interval(bias) == 0 for result, bias in zip(results, biases, strict=True)])


@pytest.mark.long
def test_model_learns_how_bias_follows_temperature():
    means = simulate_hourly_means(1, 2, 0.05)
    run = ModelRun().add_intervals(means.bias, means.temperature_c)
    assert "at least 12 are needed" in run.results[5].text
    assert run.results[5].one_step is None
    assert all(result.one_step is not None and not result.text for result in run.results[12:])
    assert run.results[-1].model.startswith("difference")
    assert run.results[-1].slope == pytest.approx(BIAS_SLOPE, rel=0.15)
    errors = [bias - result.multi_step.bias for result, bias in zip(run.results[36:], means.bias[36:], strict=True)]
    assert np.std(errors) < 0.4 * np.std(means.bias[36:])
    assert compute_share_inside_prediction(run.results[24:], means.bias[24:]) > 0.85
    assert not any(run.found)


@pytest.mark.long
def test_prediction_does_not_use_the_predicted_interval():
    """Two recordings that differ only in the last interval have the same last prediction."""
    means = simulate_hourly_means(2, 2, 0.05)
    other = means.bias.copy()
    other[-1] += 1.0
    first, second = (
        ModelRun().add_intervals(biases, means.temperature_c).results[-1] for biases in (means.bias, other)
    )
    assert (first.one_step, first.multi_step) == (second.one_step, second.multi_step)
    assert second.one_step.side_of_interval(other[-1]) == 1


@pytest.mark.long
def test_unexplained_step_is_reported_once_and_then_predicted():
    means = simulate_hourly_means(3, 2, 0.05)
    size = 0.5 * np.ptp(means.bias)
    biases = means.bias + size * (np.arange(72) >= 50)
    run = ModelRun().add_intervals(biases, means.temperature_c)
    (at,) = (k for k, result in enumerate(run.found) if result)
    assert 50 + MIN_OUTSIDE - 1 <= at <= 50 + 2 * MIN_OUTSIDE
    found = run.found[at]
    assert at - found.since + 1 == 50
    assert found.size == pytest.approx(size, rel=0.25)
    assert found.sigma > 5.0
    assert compute_share_inside_prediction(run.results[at + 2 :], biases[at + 2 :]) > 0.7
    assert run.results[-1].slope == pytest.approx(BIAS_SLOPE, rel=0.3)  # the slope is kept


@pytest.mark.long
def test_step_explained_by_temperature_is_not_reported():
    means = simulate_hourly_means(4, 0, 0.05)
    jumped = means.temperature_c + 1.5 * (np.arange(72) >= 50)
    run = ModelRun().add_intervals(means.bias + BIAS_SLOPE * (jumped - means.temperature_c), jumped)
    assert not any(run.found)


@pytest.mark.long
def test_new_offset_is_learned_without_an_alarm():
    means = simulate_hourly_means(5, 2, 0.05)
    run = ModelRun().add_intervals(means.bias[:50], means.temperature_c[:50])
    run.model_under_test.learn_new_offset()
    run.add_intervals(means.bias[50:] + 1e-3, means.temperature_c[50:])
    assert [result.text for result in run.results[50 : 50 + OFFSET_INTERVALS]] == [NEW_OFFSET] * OFFSET_INTERVALS
    after = run.results[50 + OFFSET_INTERVALS :]
    assert compute_share_inside_prediction(after, means.bias[50 + OFFSET_INTERVALS :] + 1e-3) > 0.85
    assert after[0].slope == pytest.approx(run.results[49].slope, rel=0.3)
    assert not any(run.found)


def test_new_offset_before_the_first_model_restarts_the_history():
    means = simulate_hourly_means(6, 2, 0.05)
    run = ModelRun().add_intervals(means.bias[:8], means.temperature_c[:8])
    run.model_under_test.learn_new_offset()
    run.add_intervals(means.bias[8:22] + 1e-3, means.temperature_c[8:22])
    assert [result.one_step is None for result in run.results[8:]] == [True] * 12 + [False] * 2


def test_model_selection_runs_in_short_steps():
    means = simulate_hourly_means(7, 2, 0.05)
    run = ModelRun(slow=True).add_intervals(means.bias[:40], means.temperature_c[:40])
    assert run.model_under_test.is_selecting_model
    assert run.results[-1].text == "the model is being selected"
    pieces = 0
    while run.model_under_test.run_selection_step_if_active():
        pieces += 1
    assert pieces > 10
    run.add_intervals(means.bias[40:41], means.temperature_c[40:41])
    assert run.results[-1].one_step is not None


@pytest.mark.long
def test_model_selections_have_growing_intervals():
    means = simulate_hourly_means(8, 1, 0.05)
    run, at = ModelRun(slow=True), []
    for k in range(72):
        run.add_intervals(means.bias[k : k + 1], means.temperature_c[k : k + 1])
        if run.model_under_test.is_selecting_model:
            at.append(k + 1)
        while run.model_under_test.run_selection_step_if_active():
            pass
    assert at[0] == 12
    assert all(later >= REFIT_GROWTH * earlier for earlier, later in pairwise(at))
    assert len(at) >= 6


@pytest.mark.long
def test_missing_intervals_are_skipped():
    means = simulate_hourly_means(9, 2, 0.05)
    biases, temperature_c = means.bias.copy(), means.temperature_c.copy()
    biases[30:33], temperature_c[40] = np.nan, np.nan
    run = ModelRun().add_intervals(biases, temperature_c)
    assert run.results[31].one_step is not None
    assert np.isnan(run.results[31].bias)
    assert not any(run.found)
    assert compute_share_inside_prediction(run.results[41:], biases[41:]) > 0.8


def test_almost_constant_temperature_is_reported():
    rng = np.random.default_rng(10)
    run = ModelRun().add_intervals(1e-6 * rng.standard_normal(30), 25.0 + 0.01 * rng.standard_normal(30))
    assert "temperature hardly changed" in run.results[-1].text
    assert run.results[-1].one_step is None


def test_history_is_bounded():
    model_under_test = OnlineThermalModel(HOUR_S)
    for _ in range(MAX_INTERVALS + 100):
        model_under_test.predict_and_add_interval(0.0, 1e-7, 25.0)
    assert len(model_under_test._rows) == MAX_INTERVALS


def test_random_walk_gives_a_constant_model():
    """The temperature has a daily cycle, and the bias is white noise and a random walk."""
    for seed in range(3):
        rng = np.random.default_rng([11, seed])
        temperature_c = simulate_hourly_means(seed, 0, 0.0).temperature_c
        bias = 1e-6 * (rng.standard_normal(72) + rng.standard_normal(72).cumsum())
        run = ModelRun().add_intervals(bias, temperature_c)
        assert {result.model for result in run.results[12:]} == {"constant"}
        assert run.results[-1].slope == 0.0
        assert not any(run.found)
