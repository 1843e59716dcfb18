"""Tests of dynamic Allan curves against batch results and against the experiment of the paper."""

import numpy as np
import pytest

from drivers.errors import ConfigError, NotReady
from monitor.estimation.allan import batch
from monitor.estimation.allan.dynamic_allan import MAX_STEPS, compute_dynamic_allan
from monitor.estimation.allan.uncertainty import covariance_table, deviation_intervals
from monitor.estimation.fit.coefficient_fit import MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    QuantizationNoise,
    RateRamp,
    RateRandomWalk,
)
from monitor.noise.model import NoiseModel

RATE_HZ = 100.0
BEFORE = {"Q": 2.0e-5, "N": 1.5e-4, "B": 4.0e-5, "K": 1.5e-6, "R": 0.0}
AFTER = BEFORE | {"N": 3.0e-4, "B": 1.2e-4, "K": 2.0e-5, "R": 2.0e-6}  # Q does not change
JUMP_S, END_S, WINDOW_S = 250.0, 600.0, 100.0


def make_model(coefficients: dict[str, float]) -> NoiseModel:
    sources = (
        QuantizationNoise(Q=coefficients["Q"]),
        AngleRandomWalk(N=coefficients["N"]),
        BiasInstability(B=coefficients["B"]),
        RateRandomWalk(K=coefficients["K"]),
        RateRamp(R=coefficients["R"]),
    )
    return NoiseModel(dict.fromkeys(("gx", "gy", "gz", "ax", "ay", "az"), sources))


def simulate_jump(seed: int) -> np.ndarray:
    """Simulate 600 s at 100 Hz; at 250 s N doubles, B trebles, K grows and a ramp begins, while Q is constant."""
    before, after = round(JUMP_S * RATE_HZ), round((END_S - JUMP_S) * RATE_HZ)
    first_part = make_model(BEFORE).simulate(before, RATE_HZ, seed)
    second_part = make_model(AFTER).simulate(after, RATE_HZ, seed + 1000)
    second = round(RATE_HZ)
    level = first_part[-second:].mean(axis=0) - second_part[:second].mean(axis=0)  # keeps the bias continuous
    return np.concatenate([first_part, second_part + level])


def test_no_cluster_crosses_a_pause() -> None:
    """As a pause is longer than a window, only samples after the pause count."""
    values = 1e-3 * np.random.default_rng(1).standard_normal((3000, 6))
    values[1400] = np.nan
    values[1400:] += 1.0
    values[2200] = np.nan
    values[2200:] -= 5.0
    found = compute_dynamic_allan(values, 10.0, 60.0, step_s=7.0, pauses=np.array([1400, 2200]))
    assert np.nanmax(found.deviation) < 2e-3
    assert np.isfinite(found.deviation[:, :3]).all()  # longer τ need more samples after the pause
    assert np.nanmax(compute_dynamic_allan(values, 10.0, 60.0, step_s=7.0).deviation) > 0.1


def test_every_step_equals_a_batch_over_its_window() -> None:
    values = simulate_jump(1)[20_000:32_000]
    values[:, 5] += 9.81
    values[[500, 4321]] = np.nan
    values[np.random.default_rng(2).random(len(values)) < 0.03, 2:] = np.nan
    found = compute_dynamic_allan(values, RATE_HZ, 40.0, "octave", 7.0)
    length, step = 4000, 700
    factors = batch.cluster_sizes(length, RATE_HZ)
    columns, covariances = make_design_matrix(factors, RATE_HZ), covariance_table(length, factors)
    entered = np.zeros((5, 6), np.bool_)
    assert found.t_s.tolist() == [(length + i * step) / RATE_HZ for i in range(found.t_s.size)]
    assert found.t_s.size == 12
    assert found.window_s == 40.0
    for row, end in enumerate(range(length, 12_001, step)):
        window = values[end - length : end]
        avar, terms, excess = batch.overlapping_allan_variances(window, factors)
        slope, slopes = (
            batch.rate_slope_from_thirds(window) * RATE_HZ,
            batch.rate_slope_per_tau(window, factors) * RATE_HZ,
        )
        expected = fit_coefficients(
            columns, covariances, MeasuredVariancesAndSlopes(avar, terms, slope, slopes, entered, excess)
        )
        entered = expected.entered
        lo, hi = deviation_intervals(avar, expected.edf, excess=excess)
        assert found.deviation[row] == pytest.approx(np.sqrt(avar), rel=1e-9)
        # The window interpolates the slopes of long τ from a grid, which changes the fit slightly.
        assert found.lo[row] == pytest.approx(lo, rel=5e-3, nan_ok=True)
        assert found.hi[row] == pytest.approx(hi, rel=5e-3, nan_ok=True)
        coefficients = expected.coefficients
        np.testing.assert_array_equal(found.status[row], coefficients.status)
        for dynamic, batch_result in (
            (found.value, coefficients.value),
            (found.value_lo, coefficients.lo),
            (found.value_hi, coefficients.hi),
        ):
            np.testing.assert_allclose(dynamic[row], batch_result, rtol=5e-3, atol=1e-9)


@pytest.fixture(scope="module")
def dynamic_results() -> list:
    return [compute_dynamic_allan(simulate_jump(seed), RATE_HZ, WINDOW_S) for seed in range(4)]


def test_dynamic_curves_show_the_jump_and_constant_q(dynamic_results: list) -> None:
    """Repeat the experiment in "Dynamic extraction of random drift error coefficients of MEMS gyroscopes" (24 axes)."""
    q, n = SYMBOLS.index("Q"), SYMBOLS.index("N")
    t_s = dynamic_results[0].t_s
    before, after = t_s <= JUMP_S, t_s >= JUMP_S + WINDOW_S
    values = np.concatenate([result.value for result in dynamic_results], axis=2)  # [T, 5, 24]
    assert values[before, n].mean() == pytest.approx(BEFORE["N"], rel=0.01)
    assert values[after, n].mean() == pytest.approx(AFTER["N"], rel=0.02)
    # N is nearer to its new value at every step beyond one window, and at no step before the jump.
    half = np.sqrt(BEFORE["N"] * AFTER["N"])
    assert (values[before, n] < half).all()
    assert (values[after, n] > half).all()
    # Halfway, the window contains both noise levels, so the variance is their mean.
    midway = values[np.argmin(abs(t_s - JUMP_S - WINDOW_S / 2)), n]
    assert np.mean(midway**2) == pytest.approx((BEFORE["N"] ** 2 + AFTER["N"] ** 2) / 2, rel=0.1)
    quantization = np.nanmean(values[:, q], axis=1)
    assert quantization == pytest.approx(np.full(t_s.size, BEFORE["Q"]), rel=0.05)


def test_long_deviations_rise_by_the_expected_factor(dynamic_results: list) -> None:
    t_s, tau_s = dynamic_results[0].t_s, dynamic_results[0].tau_s
    at = int(np.argmin(abs(tau_s - 5.0)))
    deviation = np.concatenate([result.deviation[:, at] for result in dynamic_results], axis=1)
    before, after = (np.sqrt(np.mean(deviation[rows] ** 2)) for rows in (t_s <= JUMP_S, t_s >= JUMP_S + WINDOW_S))
    tau = tau_s[at : at + 1]
    expected = [np.sqrt(make_model(size).avar("gx", tau, 1 / RATE_HZ)[0]) for size in (BEFORE, AFTER)]
    assert [before, after] == pytest.approx(expected, rel=0.15)
    assert after > 1.8 * before


def test_curve_of_the_whole_recording_averages_both_noise_levels(dynamic_results: list) -> None:
    values = simulate_jump(0)
    avar, _ = batch.overlapping_avar(values, np.array([16]))
    whole = np.sqrt(avar[0].mean())
    at = int(np.argmin(abs(dynamic_results[0].tau_s - 0.16)))
    dynamic = dynamic_results[0].deviation[:, at].mean(axis=1)
    assert dynamic[0] < 0.8 * whole < 0.8 * dynamic[-1]


def test_number_of_steps_of_a_long_recording_is_bounded() -> None:
    values = np.random.default_rng(3).standard_normal((200_000, 6))
    shares: list[float] = []
    found = compute_dynamic_allan(values, 10.0, 20.0, (0.1, 0.4, 1.6), step_s=1.0, progress=shares.append)
    assert 0.9 * MAX_STEPS < found.t_s.size <= MAX_STEPS
    assert np.diff(found.t_s) == pytest.approx(np.full(found.t_s.size - 1, found.t_s[1] - found.t_s[0]))
    assert found.t_s[-1] > 20_000.0 - (found.t_s[1] - found.t_s[0])
    assert shares == pytest.approx(np.arange(1, found.t_s.size + 1) / found.t_s.size)


def test_unmeasured_axis_has_no_values() -> None:
    values = np.random.default_rng(4).standard_normal((2000, 6))
    values[:, 3:] = np.nan
    found = compute_dynamic_allan(values, 10.0, 100.0)
    assert np.isnan(found.deviation[..., 3:]).all()
    assert (found.status[..., 3:] == Status.UNESTIMATED).all()
    assert (found.status[:, SYMBOLS.index("N"), :3] == Status.ESTIMATED).all()


def test_recording_shorter_than_the_window_is_refused() -> None:
    with pytest.raises(NotReady, match=r"50 s are recorded, less than the window of 60 s"):
        compute_dynamic_allan(np.zeros((500, 6)), 10.0, 60.0)


@pytest.mark.parametrize(
    ("window_s", "step_s", "message"),
    [(5.0, None, r"window of 5 s: 50 samples at 10 Hz; possible are 10 to"), (20.0, 0.0, "step of 0 s")],
)
def test_impossible_window_or_step_is_refused(window_s: float, step_s: float | None, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compute_dynamic_allan(np.zeros((500, 6)), 10.0, window_s, step_s=step_s)
