"""The window beside its model: a true model is seldom accused, a wrong one where it is wrong, by as much as it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from drivers.data_types import AXES, make_block
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.detection.comparison_with_noise_model import (
    MIN_EDF,
    MIN_SAMPLES,
    ModelAllanVariances,
    chi2_ratio_to_normal_score,
    count_axis_samples_in_window,
    max_abs_z_limit,
)
from monitor.estimation.estimate import Estimate
from monitor.estimation.estimator import Estimator
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    ConstantBias,
    ExponentiallyCorrelated,
    Narrowband,
    QuantizationNoise,
    RateRamp,
    RateRandomWalk,
    Sinusoidal,
    TemperatureBias,
)
from monitor.noise.model import NoiseModel

RATE = 100.0
WHITE = AngleRandomWalk(N=1.5e-4)
CLASSIC = (QuantizationNoise(Q=8e-6), WHITE, BiasInstability(B=2e-4), RateRandomWalk(K=4e-5), ConstantBias(value=0.2))


def model_of(*effects: Effect, axes: tuple[str, ...] = AXES) -> NoiseModel:
    return NoiseModel(dict.fromkeys(axes, effects))


def estimate(values: np.ndarray, window: int | None = None) -> Estimate:
    """One look at samples [n, 6]."""
    estimator = Estimator(RATE, (window or len(values)) / RATE)
    estimator.add_samples(make_block(np.arange(len(values)) * 10_000_000, values.copy()))
    return estimator.get_estimate(fit_coefficients=False)


def simulated(model: NoiseModel, n: int, seed: int) -> Estimate:
    return estimate(model.simulate(n, RATE, seed))


@pytest.mark.long
@pytest.mark.parametrize(
    "effects",
    [
        CLASSIC,
        (WHITE, ExponentiallyCorrelated(sigma=1e-3, correlation_time=5.0)),
        (WHITE, Sinusoidal(amplitude=2e-3, frequency=7.3)),
        (WHITE, Narrowband(sigma=2e-3, frequency=20.0, bandwidth=0.5)),
        (WHITE, BandwidthLimit(cutoff=15.0, order=2)),
        (WHITE, RateRamp(R=1e-5)),
    ],
    ids=lambda effects: effects[-1].name,
)
def test_scores_of_a_true_model_are_those_of_chance(effects: tuple[Effect, ...]) -> None:
    """At every τ: a wrong number of degrees of freedom would show in the spread."""
    model = model_of(*effects)
    in_force = ModelAllanVariances(model, 12_000)
    looks = [in_force.compare_with_estimate(simulated(model, 12_000, seed)) for seed in range(40)]
    assert all(list(look.axes) == list(AXES) for look in looks)
    z = np.array([one.z for look in looks for one in look.axes.values()])
    judged = ~np.isnan(z).any(axis=0)
    assert judged.sum() >= 12
    n = len(z)  # 240: the mean is sure to 1/√n, the spread to 1/√2n; 4.5 σ for all of 70 numbers
    assert np.abs(z[:, judged].mean(axis=0)).max() < 4.5 / np.sqrt(n)
    narrow = 0.1 if effects[-1].name == "rate_ramp" else 0.75  # a ramp is allowed for by more than it needs
    spread = z[:, judged].std(axis=0)
    assert spread.max() < 1.0 + 4.5 / np.sqrt(2 * n)
    assert spread.min() > narrow
    assert sum(one.gap > one.threshold for look in looks for one in look.axes.values()) <= 3  # 0.4 are to be expected


def test_what_is_wrong_is_found_where_it_is_and_as_large_as_it_is() -> None:
    true = model_of(*CLASSIC)
    measured = true + NoiseModel({"gz": (Sinusoidal(amplitude=6e-4, frequency=5.0),)})
    look = ModelAllanVariances(true, 30_000).compare_with_estimate(simulated(measured, 30_000, 5))
    gz = look.axes["gz"]
    assert gz.gap > gz.threshold
    lo, hi = gz.tau_s
    assert lo <= 0.08 <= hi  # a line is largest at half its period
    assert look.tau_s[gz.row] in (0.04, 0.08)
    assert gz.gap == np.nanmax(np.abs(gz.z)) == abs(gz.z[gz.row])
    tau = look.tau_s[gz.row : gz.row + 1]
    expected = np.sqrt(measured.avar("gz", tau, 1 / RATE) / true.avar("gz", tau, 1 / RATE))[0]
    assert gz.ratio == pytest.approx(expected, rel=0.03)
    assert not any(look.axes[axis].gap > look.axes[axis].threshold for axis in AXES if axis != "gz")


def test_a_sensor_that_is_too_quiet_is_found_too() -> None:
    look = ModelAllanVariances(model_of(WHITE), 10_000).compare_with_estimate(
        simulated(model_of(AngleRandomWalk(N=1.2e-4)), 10_000, 1)
    )
    for one in look.axes.values():
        assert one.gap > one.threshold
        assert one.z[one.row] < 0.0
        assert one.ratio == pytest.approx(0.8, rel=0.06)


def test_a_part_of_a_percent_is_told_where_the_window_allows_it() -> None:
    """z is in the window's own standard deviations: at one sample, 1/√edf of the deviation."""
    n = 100_000
    look = ModelAllanVariances(model_of(WHITE), n).compare_with_estimate(
        simulated(model_of(AngleRandomWalk(N=1.5e-4 * 1.02)), n, 3)
    )
    shortest = [one.z[0] for one in look.axes.values()]
    assert np.mean(shortest) == pytest.approx(0.04 / np.sqrt(2 / (2 * n / 3)), rel=0.25)  # edf = 2/3 n


def test_axes_without_a_model_or_without_samples_are_not_judged() -> None:
    model = model_of(WHITE, axes=("gx", "gz")) + NoiseModel({"ay": (ConstantBias(value=1.0),)})
    heated = model + NoiseModel({"gx": (TemperatureBias(coefficient=1e-3, reference=20.0),)})
    values = model_of(WHITE).simulate(5000, RATE, 1)
    assert list(ModelAllanVariances(model, 5000).compare_with_estimate(estimate(values)).axes) == ["gx", "gz"]
    assert list(ModelAllanVariances(heated, 5000).compare_with_estimate(estimate(values)).axes) == [
        "gz"
    ]  # its temperature is not known
    values[:, 2] = np.nan
    assert list(ModelAllanVariances(model, 5000).compare_with_estimate(estimate(values)).axes) == ["gx"]


def test_too_few_samples_are_no_look() -> None:
    in_force = ModelAllanVariances(model_of(WHITE), 5000)
    values = model_of(WHITE).simulate(MIN_SAMPLES, RATE, 1)
    assert in_force.compare_with_estimate(estimate(values[:-1], 5000)).axes == {}
    assert list(in_force.compare_with_estimate(estimate(values, 5000)).axes) == list(AXES)


def test_an_axis_that_began_anew_is_judged_by_its_own_samples() -> None:
    model = model_of(WHITE)
    estimator = Estimator(RATE, 200.0)
    values = model.simulate(20_000, RATE, 1)
    values[:17_000, 2] *= 3.0
    estimator.add_samples(make_block(np.arange(20_000) * 10_000_000, values.copy()))
    in_force = ModelAllanVariances(model, estimator.window_length_samples)
    gz = in_force.compare_with_estimate(estimator.get_estimate(fit_coefficients=False)).axes["gz"]
    assert gz.gap > gz.threshold
    estimator.restart_axis(2, 3000)
    look = in_force.compare_with_estimate(estimator.get_estimate(fit_coefficients=False))
    assert look.axes["gz"].gap <= look.axes["gz"].threshold
    assert (look.axes["gz"].samples, look.axes["gx"].samples) == (3000, 20_000)
    assert count_axis_samples_in_window(estimator.get_estimate(fit_coefficients=False).curve, 2) == 3000
    # fewer samples, fewer τ that say something
    assert np.isfinite(look.axes["gz"].z).sum() < np.isfinite(look.axes["gx"].z).sum()


def test_gaps_in_the_samples_cost_certainty_and_nothing_else() -> None:
    model = model_of(*CLASSIC)
    values = model.simulate(30_000, RATE, 2)
    values[np.random.default_rng(1).random(30_000) < 0.01] = np.nan
    look = ModelAllanVariances(model, 30_000).compare_with_estimate(estimate(values))
    assert list(look.axes) == list(AXES)
    assert not any(one.gap > one.threshold for one in look.axes.values())


def test_a_rate_known_better_is_another_label() -> None:
    model = model_of(WHITE)
    in_force = ModelAllanVariances(model, 10_000)
    found = simulated(model, 10_000, 4)
    before = in_force.compare_with_estimate(found).axes["gz"]
    curve: AllanCurve = replace(found.curve, tau_s=found.curve.factors / 104.0)
    after = in_force.compare_with_estimate(replace(found, rate_hz=104.0, curve=curve)).axes["gz"]
    assert after.model == pytest.approx(before.model * np.sqrt(1.04))  # N over the root of a shorter τ
    assert in_force.compare_with_estimate(found).axes["gz"].gap == before.gap


def test_scores_against_the_distribution_itself() -> None:
    """The cube root against the exact quantiles, out to those that decide."""
    for edf in (MIN_EDF, 10.0, 1000.0):
        z = np.array([-1.5, 0.0, 2.0, 3.0, 3.8])
        exact = chi2.ppf(norm.cdf(z), edf) / edf
        assert chi2_ratio_to_normal_score(exact, np.full(5, edf)) == pytest.approx(z, abs=0.26 if edf < 5 else 0.05)
    assert np.isnan(chi2_ratio_to_normal_score(np.ones(1), np.array([MIN_EDF - 0.01]))[0])


def test_limits_pay_for_every_number() -> None:
    rng = np.random.default_rng(1)
    largest = np.abs(rng.standard_normal((200_000, 12))).max(axis=1)
    assert np.mean(largest > max_abs_z_limit(0.05, 12)) == pytest.approx(0.05, abs=0.002)
    together = 0.8 * rng.standard_normal((200_000, 1)) + 0.6 * rng.standard_normal((200_000, 12))
    assert np.mean(np.abs(together).max(axis=1) > max_abs_z_limit(0.05, 12)) < 0.05
