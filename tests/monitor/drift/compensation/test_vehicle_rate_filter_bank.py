"""Tests of the filter bank of the vehicle rate: gains, noise at rest and motion."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from monitor.drift.compensation.vehicle_rate_filter_bank import (
    choose_memory_lengths,
    compute_gains_by_filter_age,
    correct_rates_for_bias_change,
    filter_rate_sample,
    predict_over_gap,
    process_noise_intensity,
    update_rest_noise,
)

SIGMA = 1e-3


class FilterBank:
    """The filter bank of one axis."""

    def __init__(self, rate_hz: float = 100.0) -> None:
        memory_lengths = choose_memory_lengths(rate_hz)
        self.table, self.first = compute_gains_by_filter_age(memory_lengths)
        self.bank, self.ages = np.zeros((memory_lengths.size + 1, 5)), np.zeros((memory_lengths.size, 2), np.int64)
        self.feedback, self.sums = np.zeros(1), np.zeros((memory_lengths.size + 1, 2))
        self.intervals = 0

    def filter_samples(self, z: np.ndarray, rest: bool) -> np.ndarray:
        out = np.empty_like(z)
        for k, sample in enumerate(z):
            out[k] = filter_rate_sample(
                sample, self.bank, self.ages, self.table, self.first, self.sums, self.feedback, 5e-4
            )
            if rest and k % 100 == 99:
                self.intervals += 1
                update_rest_noise(self.bank, self.sums, 100.0, self.intervals)
            if k % 100 == 99:
                self.sums[:] = 0.0
        return out


@pytest.fixture
def trained_bank() -> FilterBank:
    bank = FilterBank()
    bank.filter_samples(SIGMA * np.random.default_rng(0).standard_normal(30_000), rest=True)
    return bank


def test_steady_gains_solve_the_riccati_equation():
    memory_lengths = choose_memory_lengths(100.0)
    table, first = compute_gains_by_filter_age(memory_lengths)
    transition, observation = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0], [0.0]])
    for j, memory in enumerate(memory_lengths):
        q = process_noise_intensity(int(memory))
        before = solve_discrete_are(transition.T, observation, q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.eye(1))
        np.testing.assert_allclose(table[first[j + 1] - 1], before[:, 0] / (before[0, 0] + 1.0), rtol=1e-2)


def test_first_gains_are_those_of_a_line_fit():
    table, first = compute_gains_by_filter_age(choose_memory_lengths(100.0))
    k = np.arange(2, 20)
    np.testing.assert_allclose(table[first[-2] + k - 1, 0], 2 * (2 * k - 1) / (k * (k + 1)), rtol=1e-3)


def test_noise_at_rest_decreases_with_memory_length(trained_bank):
    noise = trained_bank.bank[:, 3] / SIGMA**2
    assert noise[0] == pytest.approx(1.0, rel=0.1)
    np.testing.assert_allclose(noise[1:7] * choose_memory_lengths(100.0)[:6], 1.0, rtol=0.35)


def test_slowest_filter_is_selected_at_rest(trained_bank):
    out = trained_bank.filter_samples(SIGMA * np.random.default_rng(1).standard_normal(20_000), rest=True)
    assert out.std() < 0.15 * SIGMA


@pytest.mark.parametrize("size", [0.02, 1.0])
def test_step_is_followed_at_once(trained_bank, size):
    z = SIGMA * np.random.default_rng(2).standard_normal(2000)
    z[1000:] += size
    out = trained_bank.filter_samples(z, rest=False)
    assert out[1000] == pytest.approx(z[1000], abs=SIGMA)
    assert np.sqrt(np.mean((out[1000:] - size) ** 2)) < 0.5 * SIGMA


def test_motion_is_never_worse_than_measured(trained_bank):
    t = np.arange(4000) / 100.0
    for hz, size in ((0.1, 0.05), (1.0, 0.2), (5.0, 3.0), (20.0, 1.0)):
        truth = size * np.sin(2.0 * np.pi * hz * t)
        out = trained_bank.filter_samples(truth + SIGMA * np.random.default_rng(3).standard_normal(t.size), rest=False)
        assert np.sqrt(np.mean((out - truth) ** 2)) < 1.05 * SIGMA


def test_integrated_angle_is_preserved(trained_bank):
    t = np.arange(20_000) / 100.0
    truth = np.where((t % 10) < 5, 0.3 * np.sin(2.0 * np.pi * t), 0.0)
    z = truth + SIGMA * np.random.default_rng(4).standard_normal(t.size)
    out = trained_bank.filter_samples(z, rest=False)
    assert (
        abs((out - z).sum()) < 200 * SIGMA
    )  # a filter that lags by half a standard deviation would lose 10 000 of them


def test_gap_restarts_short_memories_and_bias_change_shifts_all():
    bank = FilterBank()
    bank.filter_samples(np.full(500, 0.1), rest=False)
    correct_rates_for_bias_change(bank.bank, 0.1)
    np.testing.assert_allclose(bank.bank[1:, 0], 0.0, atol=1e-9)
    predict_over_gap(bank.bank, bank.ages, 16)
    assert bank.ages[:4, 0].tolist() == [0, 0, 0, 0]
    assert (bank.ages[4:, 0] == 500).all()


def test_sample_after_a_gap_is_filtered_at_rest(trained_bank):
    """A filter that has been reset returns its first sample unfiltered, so it must not be selected at once."""
    rng = np.random.default_rng(5)
    first = []
    for _ in range(300):
        predict_over_gap(trained_bank.bank, trained_bank.ages, 10)
        first.append(trained_bank.filter_samples(SIGMA * rng.standard_normal(100), rest=True)[0])
    assert np.std(first) < 0.2 * SIGMA


def test_constant_rate_is_unchanged():
    bank = FilterBank()
    np.testing.assert_allclose(bank.filter_samples(np.full(3000, 0.25), rest=True), 0.25, atol=1e-12)
