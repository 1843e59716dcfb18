"""One axis as its intervals come: it learns, follows, doubts and tells."""

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
from tests.monitor.drift.made import COEFFICIENT, HOUR_S, hourly


class Run:
    """An axis that is given intervals, its choices made at once."""

    def __init__(self, slow: bool = False) -> None:
        self.following = OnlineThermalModel(HOUR_S)
        self.slow = slow
        self.looks, self.found = [], []

    def give(self, biases, temperatures):
        for bias, temperature_c in zip(biases, temperatures, strict=True):
            self.looks.append(self.following.predict_and_add_interval(float(bias), 1e-7, float(temperature_c)))
            while not self.slow and self.following.run_selection_step_if_active():
                pass
            self.found += [*self.following.take_unexplained_changes(), None][:1]
        return self


def shares(looks, biases):
    """Inside their one-step intervals."""
    return np.mean([one.one_step.side_of_interval(bias) == 0 for one, bias in zip(looks, biases, strict=True)])


@pytest.mark.long
def test_it_learns_how_bias_follows_temperature():
    means = hourly(1, 2, 0.05)
    run = Run().give(means.bias, means.temperature_c)
    assert "at least 12 are needed" in run.looks[5].text
    assert run.looks[5].one_step is None
    assert all(one.one_step is not None and not one.text for one in run.looks[12:])
    assert run.looks[-1].model.startswith("difference")
    assert run.looks[-1].slope == pytest.approx(COEFFICIENT, rel=0.15)
    apart = [bias - one.multi_step.bias for one, bias in zip(run.looks[36:], means.bias[36:], strict=True)]
    assert np.std(apart) < 0.4 * np.std(means.bias[36:])
    assert shares(run.looks[24:], means.bias[24:]) > 0.85
    assert not any(run.found)


@pytest.mark.long
def test_an_interval_is_expected_before_it_is_known():
    """Two records that differ in their last interval alone are expected to end the same."""
    means = hourly(2, 2, 0.05)
    other = means.bias.copy()
    other[-1] += 1.0
    one, two = (Run().give(biases, means.temperature_c).looks[-1] for biases in (means.bias, other))
    assert (one.one_step, one.multi_step) == (two.one_step, two.multi_step)
    assert two.one_step.side_of_interval(other[-1]) == 1


@pytest.mark.long
def test_a_step_that_temperature_does_not_explain_is_told_once_and_then_expected():
    means = hourly(3, 2, 0.05)
    size = 0.5 * np.ptp(means.bias)
    biases = means.bias + size * (np.arange(72) >= 50)
    run = Run().give(biases, means.temperature_c)
    (at,) = (k for k, one in enumerate(run.found) if one)
    assert 50 + MIN_OUTSIDE - 1 <= at <= 50 + 2 * MIN_OUTSIDE
    found = run.found[at]
    assert at - found.since + 1 == 50
    assert found.size == pytest.approx(size, rel=0.25)
    assert found.sigma > 5.0
    assert shares(run.looks[at + 2 :], biases[at + 2 :]) > 0.7
    assert run.looks[-1].slope == pytest.approx(COEFFICIENT, rel=0.3)  # still known


@pytest.mark.long
def test_a_step_that_temperature_explains_is_none():
    means = hourly(4, 0, 0.05)
    jumped = means.temperature_c + 1.5 * (np.arange(72) >= 50)
    run = Run().give(means.bias + COEFFICIENT * (jumped - means.temperature_c), jumped)
    assert not any(run.found)


@pytest.mark.long
def test_a_new_offset_is_learned_and_nothing_is_told():
    means = hourly(5, 2, 0.05)
    run = Run().give(means.bias[:50], means.temperature_c[:50])
    run.following.learn_new_offset()
    run.give(means.bias[50:] + 1e-3, means.temperature_c[50:])
    assert [one.text for one in run.looks[50 : 50 + OFFSET_INTERVALS]] == [NEW_OFFSET] * OFFSET_INTERVALS
    after = run.looks[50 + OFFSET_INTERVALS :]
    assert shares(after, means.bias[50 + OFFSET_INTERVALS :] + 1e-3) > 0.85
    assert after[0].slope == pytest.approx(run.looks[49].slope, rel=0.3)
    assert not any(run.found)


def test_before_there_is_a_model_a_new_offset_begins_the_record_anew():
    means = hourly(6, 2, 0.05)
    run = Run().give(means.bias[:8], means.temperature_c[:8])
    run.following.learn_new_offset()
    run.give(means.bias[8:22] + 1e-3, means.temperature_c[8:22])
    assert [one.one_step is None for one in run.looks[8:]] == [True] * 12 + [False] * 2


def test_a_choice_is_made_in_pieces_and_holds_nothing_up():
    means = hourly(7, 2, 0.05)
    run = Run(slow=True).give(means.bias[:40], means.temperature_c[:40])
    assert run.following.is_selecting_model
    assert run.looks[-1].text == "the model is being selected"
    pieces = 0
    while run.following.run_selection_step_if_active():
        pieces += 1
    assert pieces > 10
    run.give(means.bias[40:41], means.temperature_c[40:41])
    assert run.looks[-1].one_step is not None


@pytest.mark.long
def test_choices_follow_at_growing_spacings():
    means = hourly(8, 1, 0.05)
    run, at = Run(slow=True), []
    for k in range(72):
        run.give(means.bias[k : k + 1], means.temperature_c[k : k + 1])
        if run.following.is_selecting_model:
            at.append(k + 1)
        while run.following.run_selection_step_if_active():
            pass
    assert at[0] == 12
    assert all(later >= REFIT_GROWTH * one for one, later in pairwise(at))
    assert len(at) >= 6


@pytest.mark.long
def test_what_is_missing_is_passed_over():
    means = hourly(9, 2, 0.05)
    biases, warmth = means.bias.copy(), means.temperature_c.copy()
    biases[30:33], warmth[40] = np.nan, np.nan
    run = Run().give(biases, warmth)
    assert run.looks[31].one_step is not None
    assert np.isnan(run.looks[31].bias)
    assert not any(run.found)
    assert shares(run.looks[41:], biases[41:]) > 0.8


def test_temperature_that_hardly_moves_says_so():
    rng = np.random.default_rng(10)
    run = Run().give(1e-6 * rng.standard_normal(30), 25.0 + 0.01 * rng.standard_normal(30))
    assert "temperature hardly changed" in run.looks[-1].text
    assert run.looks[-1].one_step is None


def test_memory_is_bounded():
    following = OnlineThermalModel(HOUR_S)
    for _ in range(MAX_INTERVALS + 100):
        following.predict_and_add_interval(0.0, 1e-7, 25.0)
    assert len(following._rows) == MAX_INTERVALS
