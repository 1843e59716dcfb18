"""Tests of the detection of noise steps, modulated noise and temporary lines, and of constant noise."""

import numpy as np
import pytest

from monitor.reconcile.likelihood.variance_change_tests import compare_variance_change_forms, find_spectrogram_change

N = 60_000
TAU0 = 0.01
T = TAU0 * np.arange(N)


def draw_noise(seed=0):
    return np.random.default_rng(seed).standard_normal(N)


@pytest.mark.parametrize("at", [2_000, 33_333, 59_000])
@pytest.mark.parametrize("ratio", [0.7, 1.5])
@pytest.mark.parametrize("unit", [1e-4, 1.0])
def test_time_and_ratio_of_a_noise_step_are_found(at, ratio, unit):
    w = unit * draw_noise()
    w[at:] *= ratio
    step = compare_variance_change_forms(w, TAU0).step
    assert step.time.value == pytest.approx(at * TAU0, abs=0.6)
    assert step.ratio.value == pytest.approx(ratio, rel=0.08)
    assert step.time.lo <= step.time.value <= step.time.hi
    assert step.gain > 50.0


def test_gain_is_the_likelihood_ratio_at_the_best_time():
    w = draw_noise()[:700]
    w[300:] *= 1.4

    def log_likelihood(part):
        return -0.5 * part.size * np.log(np.mean(part**2))

    gains = [log_likelihood(w[:k]) + log_likelihood(w[k:]) - log_likelihood(w) for k in range(16, 685)]
    step = compare_variance_change_forms(w, TAU0).step
    assert step.gain == pytest.approx(max(gains), rel=1e-9)
    assert step.time.value == pytest.approx(TAU0 * (16 + int(np.argmax(gains))))


def test_intervals_contain_the_true_values():
    inside = 0
    for seed in range(60):
        w = draw_noise(seed)
        w[20_000:] *= 1.1
        step = compare_variance_change_forms(w, TAU0).step
        inside += (step.time.lo <= 200.0 <= step.time.hi) + (step.ratio.lo <= 1.1 <= step.ratio.hi)
    assert 106 <= inside <= 120  # of 120 at 95 %


@pytest.mark.parametrize("frequency", [0.007, 0.11, 0.6])
def test_modulated_noise_is_periodic_and_no_step(frequency):
    found = compare_variance_change_forms(draw_noise() * np.exp(0.15 * np.sin(2.0 * np.pi * frequency * T)), TAU0)
    assert found.periodic.gain > 50.0
    assert found.periodic.gain > found.step.gain + 20.0


def test_variance_trend_gains_more_than_a_step():
    found = compare_variance_change_forms(draw_noise() * np.linspace(0.8, 1.2, N), TAU0)
    assert found.trend_gain > found.step.gain + 20.0


def test_wandering_variance_gains_more_than_one_step():
    walk = np.repeat(np.random.default_rng(1).standard_normal(N // 500), 500)
    found = compare_variance_change_forms(draw_noise() * np.exp(0.2 * walk), TAU0)
    assert found.slow_variation_gain > 100.0
    assert found.slow_variation_gain > found.step.gain + 50.0


def test_constant_noise_gains_little():
    courses = [compare_variance_change_forms(draw_noise(seed), TAU0) for seed in range(30)]
    assert max(one.step.gain for one in courses) < 12.0
    assert max(one.trend_gain for one in courses) < 9.0
    assert max(one.periodic.gain for one in courses) < 18.0
    assert max(one.slow_variation_gain for one in courses) < 9.0


def is_in_interval(pair, value):
    return pair[0] <= value <= pair[1]


def test_temporary_line_is_found_in_time_and_frequency():
    w = draw_noise() + np.where((T > 200.0) & (T < 330.0), 0.3, 0.0) * np.sin(2.0 * np.pi * 31.4 * T)
    found = find_spectrogram_change(w, TAU0)
    assert found.gain > 50.0
    assert is_in_interval(found.frequency, 31.4)
    assert is_in_interval((200.0 - 25.0, 330.0 + 25.0), sum(found.time) / 2.0)
    assert found.row_gain > 50.0


def test_broadband_burst_is_found_in_time():
    w = draw_noise()
    w[41_000:41_100] *= 3.0
    found = find_spectrogram_change(w, TAU0)
    assert found.gain > 30.0
    assert is_in_interval(found.time, 410.5)


def test_pause_is_found():
    w = draw_noise()
    w[30_000:34_000] *= 0.7
    found = find_spectrogram_change(w, TAU0)
    assert found.gain > 30.0


@pytest.mark.parametrize(
    "add",
    [
        0.4 * np.sin(2.0 * np.pi * 17.0 * T) * (1.0 + 0.9 * np.sin(2.0 * np.pi * T / 61.0)),
        0.3 * np.sin(2.0 * np.pi * (5.0 * T + 0.5 * 20.0 / T[-1] * T**2)),
    ],
    ids=["modulated line", "chirp"],
)
def test_changing_lines_make_a_spectrogram_row_uneven(add):
    found = find_spectrogram_change(draw_noise() + add, TAU0)
    assert found.row_gain > 20.0


@pytest.mark.parametrize("amplitude", [0.0, 0.5, 3.0])
def test_constant_noise_and_lines_gain_little(amplitude):
    found = [
        find_spectrogram_change(draw_noise(seed) + amplitude * np.sin(2.0 * np.pi * 17.0 * T + seed), TAU0)
        for seed in range(10)
    ]
    assert max(one.gain for one in found) < 20.0
    assert max(one.row_gain for one in found) < 18.0


def test_result_does_not_depend_on_the_unit():
    one, other = find_spectrogram_change(draw_noise(), TAU0), find_spectrogram_change(1e-4 * draw_noise(), TAU0)
    assert one.gain == pytest.approx(other.gain)
    assert one.time == other.time


def test_short_recordings_have_only_short_pieces():
    found = find_spectrogram_change(draw_noise()[:5_000], TAU0)
    assert found.gain < 15.0
    assert round((found.time[1] - found.time[0]) / 2.56) >= 1
