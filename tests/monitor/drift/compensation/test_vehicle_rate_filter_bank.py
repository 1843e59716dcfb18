"""The bank of rate filters: gains beside the Riccati equation, noise at rest, motion."""

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


class Bank:
    """One axis."""

    def __init__(self, rate_hz: float = 100.0) -> None:
        each = choose_memory_lengths(rate_hz)
        self.table, self.first = compute_gains_by_filter_age(each)
        self.bank, self.ages = np.zeros((each.size + 1, 5)), np.zeros((each.size, 2), np.int64)
        self.feedback, self.sums = np.zeros(1), np.zeros((each.size + 1, 2))
        self.intervals = 0

    def run(self, z: np.ndarray, rest: bool) -> np.ndarray:
        out = np.empty_like(z)
        for k, one in enumerate(z):
            out[k] = filter_rate_sample(
                one, self.bank, self.ages, self.table, self.first, self.sums, self.feedback, 5e-4
            )
            if rest and k % 100 == 99:
                self.intervals += 1
                update_rest_noise(self.bank, self.sums, 100.0, self.intervals)
            if k % 100 == 99:
                self.sums[:] = 0.0
        return out


@pytest.fixture
def learned() -> Bank:
    bank = Bank()
    bank.run(SIGMA * np.random.default_rng(0).standard_normal(30_000), rest=True)
    return bank


def test_the_steady_gains_solve_the_riccati_equation():
    each = choose_memory_lengths(100.0)
    table, first = compute_gains_by_filter_age(each)
    step, look = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0], [0.0]])
    for j, memory in enumerate(each):
        q = process_noise_intensity(int(memory))
        before = solve_discrete_are(step.T, look, q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.eye(1))
        np.testing.assert_allclose(table[first[j + 1] - 1], before[:, 0] / (before[0, 0] + 1.0), rtol=1e-2)


def test_the_first_gains_are_those_of_a_straight_line():
    table, first = compute_gains_by_filter_age(choose_memory_lengths(100.0))
    k = np.arange(2, 20)
    np.testing.assert_allclose(table[first[-2] + k - 1, 0], 2 * (2 * k - 1) / (k * (k + 1)), rtol=1e-3)


def test_noise_at_rest_falls_by_the_memory(learned):
    noise = learned.bank[:, 3] / SIGMA**2
    assert noise[0] == pytest.approx(1.0, rel=0.1)
    np.testing.assert_allclose(noise[1:7] * choose_memory_lengths(100.0)[:6], 1.0, rtol=0.35)


def test_at_rest_the_slowest_is_taken(learned):
    out = learned.run(SIGMA * np.random.default_rng(1).standard_normal(20_000), rest=True)
    assert out.std() < 0.15 * SIGMA


@pytest.mark.parametrize("size", [0.02, 1.0])
def test_a_step_comes_out_at_once(learned, size):
    z = SIGMA * np.random.default_rng(2).standard_normal(2000)
    z[1000:] += size
    out = learned.run(z, rest=False)
    assert out[1000] == pytest.approx(z[1000], abs=SIGMA)
    assert np.sqrt(np.mean((out[1000:] - size) ** 2)) < 0.5 * SIGMA


def test_motion_is_never_followed_worse_than_measured(learned):
    t = np.arange(4000) / 100.0
    for hz, size in ((0.1, 0.05), (1.0, 0.2), (5.0, 3.0), (20.0, 1.0)):
        truth = size * np.sin(2.0 * np.pi * hz * t)
        out = learned.run(truth + SIGMA * np.random.default_rng(3).standard_normal(t.size), rest=False)
        assert np.sqrt(np.mean((out - truth) ** 2)) < 1.05 * SIGMA


def test_no_angle_is_lost(learned):
    t = np.arange(20_000) / 100.0
    truth = np.where((t % 10) < 5, 0.3 * np.sin(2.0 * np.pi * t), 0.0)
    z = truth + SIGMA * np.random.default_rng(4).standard_normal(t.size)
    out = learned.run(z, rest=False)
    assert abs((out - z).sum()) < 200 * SIGMA  # a filter that lags by half a deviation would lose 10 000 of them


def test_a_hole_makes_short_memories_begin_anew_and_a_shift_moves_all():
    bank = Bank()
    bank.run(np.full(500, 0.1), rest=False)
    correct_rates_for_bias_change(bank.bank, 0.1)
    np.testing.assert_allclose(bank.bank[1:, 0], 0.0, atol=1e-9)
    predict_over_gap(bank.bank, bank.ages, 16)
    assert bank.ages[:4, 0].tolist() == [0, 0, 0, 0]
    assert (bank.ages[4:, 0] == 500).all()


def test_a_constant_comes_out_as_it_is():
    bank = Bank()
    np.testing.assert_allclose(bank.run(np.full(3000, 0.25), rest=True), 0.25, atol=1e-12)
