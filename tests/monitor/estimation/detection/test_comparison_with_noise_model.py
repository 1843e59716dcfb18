"""Tests of the comparison of a window with its noise model: false alarms, location and size of deviations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from drivers.data_types import AXES, Event, make_block
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.detection.comparison_with_noise_model import (
    KIND,
    MIN_EDF,
    MIN_SAMPLES,
    RENEWED_SHARE,
    AxisModelComparison,
    ModelAgreementMonitor,
    ModelComparison,
    NoiseModelComparator,
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
FIVE_TERMS = (
    QuantizationNoise(Q=8e-6),
    WHITE,
    BiasInstability(B=2e-4),
    RateRandomWalk(K=4e-5),
    ConstantBias(value=0.2),
)
STEP = 100  # samples between two comparisons
WINDOW = 40_000
CONFIRMATION_SAMPLES = int(RENEWED_SHARE * WINDOW)
ONES = np.ones(4)


def make_model(*effects: Effect, axes: tuple[str, ...] = AXES) -> NoiseModel:
    return NoiseModel(dict.fromkeys(axes, effects))


def estimate_values(values: np.ndarray, window: int | None = None) -> Estimate:
    """Estimate the curve of samples [n, 6]."""
    estimator = Estimator(RATE, (window or len(values)) / RATE)
    estimator.add_samples(make_block(np.arange(len(values)) * 10_000_000, values.copy()))
    return estimator.get_estimate(fit_coefficients=False)


def simulate_estimate(model: NoiseModel, n: int, seed: int) -> Estimate:
    return estimate_values(model.simulate(n, RATE, seed))


@pytest.mark.long
@pytest.mark.parametrize(
    "effects",
    [
        FIVE_TERMS,
        (WHITE, ExponentiallyCorrelated(sigma=1e-3, correlation_time=5.0)),
        (WHITE, Sinusoidal(amplitude=2e-3, frequency=7.3)),
        (WHITE, Narrowband(sigma=2e-3, frequency=20.0, bandwidth=0.5)),
        (WHITE, BandwidthLimit(cutoff=15.0, order=2)),
        (WHITE, RateRamp(R=1e-5)),
    ],
    ids=lambda effects: effects[-1].name,
)
def test_scores_of_a_true_model_are_standard_normal(effects: tuple[Effect, ...]) -> None:
    """The test covers every τ; a wrong number of degrees of freedom would change the spread."""
    model = make_model(*effects)
    comparator = NoiseModelComparator(model, 12_000)
    comparisons = [comparator.compare_with_estimate(simulate_estimate(model, 12_000, seed)) for seed in range(40)]
    assert all(list(comparison.axes) == list(AXES) for comparison in comparisons)
    z = np.array([axis.z for comparison in comparisons for axis in comparison.axes.values()])
    valid = ~np.isnan(z).any(axis=0)
    assert valid.sum() >= 12
    n = len(z)  # 240; the mean has an error of 1/√n and the spread of 1/√2n; 4.5 σ allows for 70 values
    assert np.abs(z[:, valid].mean(axis=0)).max() < 4.5 / np.sqrt(n)
    min_spread = 0.1 if effects[-1].name == "rate_ramp" else 0.75  # the allowance for a ramp is larger than needed
    spread = z[:, valid].std(axis=0)
    assert spread.max() < 1.0 + 4.5 / np.sqrt(2 * n)
    assert spread.min() > min_spread
    assert (
        sum(axis.gap > axis.threshold for comparison in comparisons for axis in comparison.axes.values()) <= 3
    )  # 0.4 are expected


def test_unmodeled_line_is_found_at_its_averaging_time_with_its_size() -> None:
    true = make_model(*FIVE_TERMS)
    measured = true + NoiseModel({"gz": (Sinusoidal(amplitude=6e-4, frequency=5.0),)})
    comparison = NoiseModelComparator(true, 30_000).compare_with_estimate(simulate_estimate(measured, 30_000, 5))
    gz = comparison.axes["gz"]
    assert gz.gap > gz.threshold
    lo, hi = gz.tau_s
    assert lo <= 0.08 <= hi  # a line has its maximum at half its period
    assert comparison.tau_s[gz.row] in (0.04, 0.08)
    assert gz.gap == np.nanmax(np.abs(gz.z)) == abs(gz.z[gz.row])
    tau = comparison.tau_s[gz.row : gz.row + 1]
    expected = np.sqrt(measured.avar("gz", tau, 1 / RATE) / true.avar("gz", tau, 1 / RATE))[0]
    assert gz.ratio == pytest.approx(expected, rel=0.03)
    assert not any(comparison.axes[axis].gap > comparison.axes[axis].threshold for axis in AXES if axis != "gz")


def test_too_little_noise_is_also_found() -> None:
    comparison = NoiseModelComparator(make_model(WHITE), 10_000).compare_with_estimate(
        simulate_estimate(make_model(AngleRandomWalk(N=1.2e-4)), 10_000, 1)
    )
    for axis in comparison.axes.values():
        assert axis.gap > axis.threshold
        assert axis.z[axis.row] < 0.0
        assert axis.ratio == pytest.approx(0.8, rel=0.06)


def test_small_difference_is_found_in_a_long_window() -> None:
    """z is in standard deviations of the window, 1/√edf of the deviation at one sample."""
    n = 100_000
    comparison = NoiseModelComparator(make_model(WHITE), n).compare_with_estimate(
        simulate_estimate(make_model(AngleRandomWalk(N=1.5e-4 * 1.02)), n, 3)
    )
    shortest = [axis.z[0] for axis in comparison.axes.values()]
    assert np.mean(shortest) == pytest.approx(0.04 / np.sqrt(2 / (2 * n / 3)), rel=0.25)  # edf = 2/3 n


def test_axes_without_model_or_samples_are_not_compared() -> None:
    model = make_model(WHITE, axes=("gx", "gz")) + NoiseModel({"ay": (ConstantBias(value=1.0),)})
    heated = model + NoiseModel({"gx": (TemperatureBias(coefficient=1e-3, reference=20.0),)})
    values = make_model(WHITE).simulate(5000, RATE, 1)
    assert list(NoiseModelComparator(model, 5000).compare_with_estimate(estimate_values(values)).axes) == ["gx", "gz"]
    assert list(NoiseModelComparator(heated, 5000).compare_with_estimate(estimate_values(values)).axes) == [
        "gz"
    ]  # the temperature of gx is unknown
    values[:, 2] = np.nan
    assert list(NoiseModelComparator(model, 5000).compare_with_estimate(estimate_values(values)).axes) == ["gx"]


def test_too_few_samples_give_no_comparison() -> None:
    comparator = NoiseModelComparator(make_model(WHITE), 5000)
    values = make_model(WHITE).simulate(MIN_SAMPLES, RATE, 1)
    assert comparator.compare_with_estimate(estimate_values(values[:-1], 5000)).axes == {}
    assert list(comparator.compare_with_estimate(estimate_values(values, 5000)).axes) == list(AXES)


def test_restarted_axis_is_compared_by_its_own_samples() -> None:
    model = make_model(WHITE)
    estimator = Estimator(RATE, 200.0)
    values = model.simulate(20_000, RATE, 1)
    values[:17_000, 2] *= 3.0
    estimator.add_samples(make_block(np.arange(20_000) * 10_000_000, values.copy()))
    comparator = NoiseModelComparator(model, estimator.window_length_samples)
    gz = comparator.compare_with_estimate(estimator.get_estimate(fit_coefficients=False)).axes["gz"]
    assert gz.gap > gz.threshold
    estimator.restart_axis(2, 3000)
    comparison = comparator.compare_with_estimate(estimator.get_estimate(fit_coefficients=False))
    assert comparison.axes["gz"].gap <= comparison.axes["gz"].threshold
    assert (comparison.axes["gz"].samples, comparison.axes["gx"].samples) == (3000, 20_000)
    assert count_axis_samples_in_window(estimator.get_estimate(fit_coefficients=False).curve, 2) == 3000
    # With fewer samples, fewer τ can be compared.
    assert np.isfinite(comparison.axes["gz"].z).sum() < np.isfinite(comparison.axes["gx"].z).sum()


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_gaps_do_not_cause_disagreement(share: float) -> None:
    model = make_model(*FIVE_TERMS)
    values = model.simulate(30_000, RATE, 2)
    values[np.random.default_rng(1).random(30_000) < share] = np.nan
    comparison = NoiseModelComparator(model, 30_000).compare_with_estimate(estimate_values(values))
    assert list(comparison.axes) == list(AXES)
    assert not any(axis.gap > axis.threshold for axis in comparison.axes.values())


def test_refined_rate_rescales_the_model_but_not_the_gap() -> None:
    model = make_model(WHITE)
    comparator = NoiseModelComparator(model, 10_000)
    found = simulate_estimate(model, 10_000, 4)
    before = comparator.compare_with_estimate(found).axes["gz"]
    curve: AllanCurve = replace(found.curve, tau_s=found.curve.factors / 104.0)
    after = comparator.compare_with_estimate(replace(found, rate_hz=104.0, curve=curve)).axes["gz"]
    assert after.model == pytest.approx(before.model * np.sqrt(1.04))  # N divided by the root of a shorter τ
    assert comparator.compare_with_estimate(found).axes["gz"].gap == before.gap


def test_normal_score_agrees_with_the_chi_square_distribution() -> None:
    """Compare the cube root approximation with exact quantiles over the range used for decisions."""
    for edf in (MIN_EDF, 10.0, 1000.0):
        z = np.array([-1.5, 0.0, 2.0, 3.0, 3.8])
        exact = chi2.ppf(norm.cdf(z), edf) / edf
        assert chi2_ratio_to_normal_score(exact, np.full(5, edf)) == pytest.approx(z, abs=0.26 if edf < 5 else 0.05)
    assert np.isnan(chi2_ratio_to_normal_score(np.ones(1), np.array([MIN_EDF - 0.01]))[0])


def test_threshold_accounts_for_the_number_of_values() -> None:
    rng = np.random.default_rng(1)
    largest = np.abs(rng.standard_normal((200_000, 12))).max(axis=1)
    assert np.mean(largest > max_abs_z_limit(0.05, 12)) == pytest.approx(0.05, abs=0.002)
    correlated = 0.8 * rng.standard_normal((200_000, 1)) + 0.6 * rng.standard_normal((200_000, 12))
    assert np.mean(np.abs(correlated).max(axis=1) > max_abs_z_limit(0.05, 12)) < 0.05


def make_axis_comparison(axis: str, gap: float) -> AxisModelComparison:
    return AxisModelComparison(axis, 1.5 * ONES, ONES, gap * ONES, gap, (0.08, 0.32), 1, 2.8, 4.0, 4.5, WINDOW)


class MonitoredDevice:
    """A device that is compared with its model every STEP samples of 10 ms."""

    def __init__(self) -> None:
        self.agreement = ModelAgreementMonitor()
        self.samples = WINDOW

    def add_samples(self, samples: int, **gaps: float) -> list[Event]:
        events = []
        for _ in range(0, samples, STEP):
            self.samples += STEP
            axes = {axis: make_axis_comparison(axis, gap) for axis, gap in gaps.items()}
            comparison = ModelComparison(self.samples * 10_000_000, 100.0, 400.0, self.samples, WINDOW, ONES, axes)
            events += self.agreement.update_decisions(comparison)
        return events


def test_lasting_gap_is_reported_once_with_location_and_size() -> None:
    device = MonitoredDevice()
    assert device.add_samples(1000, gz=2.0, gx=2.0) == []
    assert device.add_samples(CONFIRMATION_SAMPLES, gz=6.0, gx=2.0) == []
    (event,) = device.add_samples(STEP, gz=6.0, gx=2.0)
    assert (event.kind, event.axis, event.sigma) == (KIND, "gz", 6.0)
    assert event.text == (
        "gz disagrees with its model at τ 0.08 to 0.32 s: the deviation is 1.5 times the deviation of the model, "
        "a gap of 6 σ with a threshold of 4.0 σ"
    )
    assert event.values == {
        "model": {"agrees": False, "gap": 6.0, "threshold": 4.0, "ratio": 1.5, "tau_lo": 0.08, "tau_hi": 0.32}
    }
    assert event.t_ns - (event.since_ns or 0) == CONFIRMATION_SAMPLES * 10_000_000
    assert device.agreement.agreement_by_axis == {"gz": False, "gx": True}
    assert device.add_samples(5 * CONFIRMATION_SAMPLES, gz=6.0, gx=2.0) == []


def test_short_gaps_are_not_reported() -> None:
    device = MonitoredDevice()
    for _ in range(5):
        assert device.add_samples(CONFIRMATION_SAMPLES, gz=6.0) == []
        assert device.add_samples(STEP, gz=2.0) == []
    assert (
        device.add_samples(20 * CONFIRMATION_SAMPLES, gz=4.3) == []
    )  # above the threshold of one comparison, but below that of repeated comparisons
    assert device.agreement.agreement_by_axis == {"gz": True}


def test_very_large_gap_is_reported_earlier() -> None:
    device = MonitoredDevice()
    device.add_samples(STEP, gz=2.0)
    assert device.add_samples(MIN_SAMPLES, gz=20.0) == []
    assert len(device.add_samples(STEP, gz=20.0)) == 1
    assert MIN_SAMPLES < CONFIRMATION_SAMPLES


def test_agreement_returns_only_below_the_lower_limit() -> None:
    device = MonitoredDevice()
    device.add_samples(MIN_SAMPLES + STEP, gz=20.0)
    assert device.agreement.agreement_by_axis == {"gz": False}
    assert device.add_samples(10 * CONFIRMATION_SAMPLES, gz=3.5) == []
    assert device.add_samples(CONFIRMATION_SAMPLES, gz=1.5) == []
    (event,) = device.add_samples(STEP, gz=1.5)
    assert (event.kind, event.values["model"]["agrees"]) == (KIND, True)
    assert event.text == "gz agrees with its model again: the largest gap is 1.5 σ"
    assert device.agreement.agreement_by_axis == {"gz": True}
    assert len(device.add_samples(2 * CONFIRMATION_SAMPLES, gz=6.0)) == 1


def test_first_decision_needs_enough_samples() -> None:
    device = MonitoredDevice()
    device.add_samples(MIN_SAMPLES, gz=20.0)
    assert device.agreement.agreement_by_axis == {}
    assert len(device.add_samples(STEP, gz=20.0)) == 1


def test_axis_without_comparison_keeps_its_decision() -> None:
    device = MonitoredDevice()
    device.add_samples(MIN_SAMPLES + STEP, gz=20.0)
    assert device.add_samples(CONFIRMATION_SAMPLES) == []
    assert device.agreement.agreement_by_axis == {"gz": False}
    assert device.add_samples(CONFIRMATION_SAMPLES, gz=20.0) == []


@pytest.mark.parametrize("gap", [4.4999, 4.5])
def test_gap_equal_to_the_alarm_limit_is_no_alarm(gap: float) -> None:
    assert MonitoredDevice().add_samples(3 * CONFIRMATION_SAMPLES, gz=gap) == []
