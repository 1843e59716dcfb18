"""Tests of the live estimator: missing samples, block sizes, refined rates and restarted axes."""

import numpy as np
import pytest

from drivers.data_types import AXES, make_block
from drivers.errors import ConfigError, NotReady
from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.estimator import MAX_HISTORY_SAMPLES, MIN_SAMPLES, Estimator
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRandomWalk
from monitor.noise.model import NoiseModel

RATE = 100.0


def make_samples(first, n, lost=0, seed=0):
    values = 1e-3 * np.random.default_rng([seed, first]).standard_normal((n, 6)) + 9.81
    return make_block(np.arange(first, first + n) * 10_000_000, values, lost=lost)


def test_last_estimate_covers_all_samples():
    estimator = Estimator(RATE, 20.0)
    blocks = [make_samples(at, 100) for at in range(0, 3000, 100)]
    for block in blocks:
        estimator.add_samples(block)
    found = estimator.get_estimate()
    assert (found.samples, found.t_ns, found.window_s, found.rate_hz) == (3000, 29_990_000_000, 20.0, RATE)
    values = np.concatenate([block.values for block in blocks])[-2000:]
    assert found.curve.n == 2000
    assert found.curve.avar == pytest.approx(overlapping_avar(values, found.curve.factors)[0], rel=1e-8)
    assert np.array_equal(found.curve.tau_s, found.curve.factors / RATE)
    assert (found.curve.lo < np.sqrt(found.curve.avar)).all()
    assert (found.curve.hi > np.sqrt(found.curve.avar)).all()
    # White noise of 1e-3 at 100 Hz has N = 1e-4.
    assert (found.coefficients.status[1] == Status.ESTIMATED).all()
    assert found.coefficients.value[1] == pytest.approx(1e-4, rel=0.15)


def test_missing_samples_keep_their_positions():
    estimator = Estimator(RATE, 20.0)
    estimator.add_samples(make_samples(0, 500))
    estimator.add_samples(make_samples(537, 400, lost=37))
    values = np.concatenate([make_samples(0, 500).values, np.full((37, 6), np.nan), make_samples(537, 400).values])
    found = estimator.get_estimate().curve
    expected, terms = overlapping_avar(values, found.factors)
    assert np.array_equal(found.terms, terms)
    assert found.avar[terms > 0] == pytest.approx(expected[terms > 0], rel=1e-8)
    assert found.n == 937


@pytest.mark.parametrize("every_sample", [False, True])
def test_rows_of_nan_equal_lost_samples(every_sample):
    whole = make_samples(0, 3000)
    masked = whole.values.copy()
    masked[[700, *range(1500, 1550)]] = np.nan
    lossy, rows_of_nan = (Estimator(RATE, 20.0, every_sample=every_sample) for _ in range(2))
    for first, end, lost in ((0, 700, 0), (701, 1500, 1), (1550, 3000, 50)):
        lossy.add_samples(make_block(whole.t_ns[first:end], whole.values[first:end], lost=lost))
    rows_of_nan.add_samples(make_block(whole.t_ns, masked))
    found, expected = lossy.get_estimate(), rows_of_nan.get_estimate()
    assert np.array_equal(found.curve.avar, expected.curve.avar)
    assert np.array_equal(found.coefficients.hi, expected.coefficients.hi, equal_nan=True)
    assert lossy.loss_of_samples() == rows_of_nan.loss_of_samples()


@pytest.mark.parametrize("lost", [1999, 2000, 2001, 10**11])
def test_gap_of_about_the_window_length_leaves_only_new_samples(lost):
    """A longer gap empties the window. After a shorter gap, clusters at its end are partly filled with new samples."""
    estimator = Estimator(RATE, 20.0)
    estimator.add_samples(make_samples(0, 3000))
    estimator.add_samples(make_samples(5000, 300, lost=lost))
    found = estimator.get_estimate()
    before = np.full((1700 if lost <= 2000 else 0, 6), np.nan)
    values = np.concatenate([before, make_samples(5000, 300).values])
    expected, terms = overlapping_avar(values, found.curve.factors)
    assert np.array_equal(found.curve.terms, terms)
    assert found.curve.avar[terms > 0] == pytest.approx(expected[terms > 0], rel=1e-8)
    assert found.samples == 3300


def test_single_samples_equal_a_block():
    whole, single = Estimator(RATE, 5.0), Estimator(RATE, 5.0)
    samples = make_samples(0, 1200)
    whole.add_samples(samples)
    for i in range(1200):
        single.add_samples(samples[i : i + 1])
    a, b = whole.get_estimate(), single.get_estimate()
    assert np.array_equal(a.coefficients.status, b.coefficients.status)
    np.testing.assert_allclose(a.coefficients.value, b.coefficients.value, rtol=1e-9)
    np.testing.assert_allclose(a.coefficients.hi, b.coefficients.hi, rtol=1e-9)


def test_too_few_samples_are_refused():
    estimator = Estimator(RATE, 20.0)
    with pytest.raises(NotReady, match="0 of at least 8"):
        estimator.get_estimate()
    estimator.add_samples(make_samples(0, MIN_SAMPLES - 1))
    with pytest.raises(NotReady):
        estimator.get_estimate()
    estimator.add_samples(make_samples(MIN_SAMPLES - 1, 1))
    found = estimator.get_estimate()
    assert (found.coefficients.status != Status.ESTIMATED).all() or np.isfinite(found.coefficients.value).any()


def test_reset_empties_the_window_and_keeps_the_counter():
    estimator, fresh = Estimator(RATE, 20.0), Estimator(RATE, 20.0)
    estimator.add_samples(make_samples(0, 3000))
    estimator.get_estimate()
    estimator.empty_window()
    with pytest.raises(NotReady):
        estimator.get_estimate()
    for either in (estimator, fresh):
        either.add_samples(make_samples(3000, 400))
    assert np.array_equal(estimator.get_estimate().curve.avar, fresh.get_estimate().curve.avar, equal_nan=True)
    assert (estimator.samples_received, fresh.samples_received) == (3400, 400)


def test_refined_rate_changes_only_time_and_units():
    refined, direct = Estimator(RATE, 20.0), Estimator(2 * RATE, 10.0)
    for estimator in (refined, direct):
        estimator.add_samples(make_samples(0, 2500))
    refined.refine_rate(2 * RATE)
    a, b = refined.get_estimate(), direct.get_estimate()
    assert (a.rate_hz, a.window_s) == (b.rate_hz, b.window_s) == (200.0, 10.0)
    assert np.array_equal(a.curve.tau_s, b.curve.tau_s)
    np.testing.assert_allclose(a.coefficients.value, b.coefficients.value, rtol=1e-12)


def test_unmeasured_axis_is_unestimated():
    estimator = Estimator(RATE, 20.0)
    samples = make_samples(0, 3000)
    values = samples.values.copy()
    values[:, 2] = np.nan
    estimator.add_samples(make_block(samples.t_ns.copy(), values))
    found = estimator.get_estimate()
    assert (found.coefficients.status[:, 2] == Status.UNESTIMATED).all()
    assert np.isnan(found.coefficients.value[:, 2]).all()
    assert found.coefficients.status[1, 1] == Status.ESTIMATED


def test_constant_axis_is_unestimated():
    estimator = Estimator(RATE, 20.0)
    estimator.add_samples(make_block(np.arange(2500) * 10**7, np.full((2500, 6), 9.81)))
    assert (estimator.get_estimate().coefficients.status == Status.UNESTIMATED).all()


def test_tau_beyond_half_the_window_is_refused():
    with pytest.raises(ConfigError, match="half the window"):
        Estimator(RATE, 20.0, (30.0,))


def test_deviations_are_available_without_a_fit():
    estimator = Estimator(RATE, 20.0)
    estimator.add_samples(make_samples(0, 2500))
    without_fit = estimator.get_estimate(fit_coefficients=False)
    assert np.array_equal(without_fit.curve.avar, estimator.get_estimate().curve.avar)
    assert (without_fit.coefficients.status == Status.UNESTIMATED).all()


def test_one_axis_restarts_without_affecting_the_others():
    estimator, fresh = Estimator(RATE, 100.0), Estimator(RATE, 100.0)
    for at in range(0, 20_000, 500):
        estimator.add_samples(make_samples(at, 500))
    before = estimator.get_estimate()
    estimator.restart_axis(2, 4_000)
    for at in range(16_000, 20_000, 500):
        fresh.add_samples(make_samples(at, 500))
    after, own = estimator.get_estimate(), fresh.get_estimate()
    others = [0, 1, 3, 4, 5]
    for field in ("value", "lo", "hi", "status"):
        whole, now = (getattr(estimate.coefficients, field) for estimate in (before, after))
        np.testing.assert_allclose(now[:, others], whole[:, others], rtol=5e-3)  # the fit started from other weights
        np.testing.assert_allclose(now[:, 2], getattr(own.coefficients, field)[:, 2], rtol=5e-3)
    np.testing.assert_allclose(after.curve.avar[:9, 2], own.curve.avar[:9, 2], rtol=1e-8)


@pytest.mark.parametrize("every_sample", [False, True])
def test_restarted_axis_has_the_new_noise_at_once(every_sample):
    estimator = Estimator(RATE, 200.0, every_sample=every_sample)
    for at in range(0, 40_000, 500):
        block = make_samples(at, 500)
        scale = np.where(np.arange(6) == 1, 3.0, 1.0) if at >= 30_000 else 1.0
        estimator.add_samples(make_block(block.t_ns, (block.values - 9.81) * scale + 9.81))
        if at + 500 == 32_000:
            estimator.restart_axis(1, 2_000)
    n = estimator.get_estimate().coefficients.value[1]
    assert n[1] == pytest.approx(3e-4, rel=0.05)
    assert n[[0, 2]] == pytest.approx(1e-4, rel=0.05)


@pytest.mark.parametrize("every_sample", [False, True])
@pytest.mark.parametrize("kept", [0, 1, 2, 3, 7])
def test_axis_restarts_with_very_few_samples(kept, every_sample):
    estimator = Estimator(RATE, 20.0, every_sample=every_sample)
    estimator.add_samples(make_samples(0, 3000))
    estimator.restart_axis(2, kept)
    estimator.restart_axis(2, kept)
    found = estimator.get_estimate()
    assert (found.coefficients.status[:, 2] == Status.UNESTIMATED).all()
    assert found.coefficients.status[1, 3] == Status.ESTIMATED
    estimator.add_samples(make_samples(3000, 1000))
    assert estimator.get_estimate().coefficients.value[1, 2] == pytest.approx(1e-4, rel=0.2)


@pytest.mark.long
def test_restarted_axis_equals_a_new_window():
    mix = (QuantizationNoise(Q=5e-6), AngleRandomWalk(N=1.5e-4), BiasInstability(B=1e-4), RateRandomWalk(K=3e-5))
    differences, ramps = [], 0
    for seed in range(2):
        values = NoiseModel(dict.fromkeys(AXES, mix)).simulate(60_000, RATE, seed)
        old, young = (Estimator(RATE, 300.0, every_sample=True) for _ in range(2))

        def add_samples_to(estimators, first, last, values=values):
            for at in range(first, last, 2000):
                for estimator in estimators:
                    estimator.add_samples(
                        make_block(np.arange(at, at + 2000) * 10_000_000, values[at : at + 2000].copy())
                    )

        add_samples_to([old], 0, 32_000)
        old.get_estimate()
        for axis in range(6):
            old.restart_axis(axis, 2000)
        add_samples_to([young], 30_000, 32_000)
        young.get_estimate()
        add_samples_to([old, young], 32_000, 60_000)
        restarted, new = old.get_estimate().history, young.get_estimate().history
        assert np.isfinite(restarted.value[:, 1]).all()  # from the first sample after the restart
        differences.append((restarted.value[:, 1] / new.value[:, 1] - 1.0).ravel())
        ramps += np.isfinite(restarted.value[:, 4]).sum()
    assert ramps == 0
    assert np.sqrt(np.nanmean(np.concatenate(differences) ** 2)) < 2e-3


def test_gap_longer_than_the_window_discards_the_terms_in_the_fit():
    estimator = Estimator(RATE, 20.0, every_sample=True)
    estimator.add_samples(make_samples(0, 3000))
    assert np.isfinite(estimator.get_estimate().history.value[-1, 1]).all()
    estimator.add_samples(make_samples(10_000, 5, lost=7000))
    assert not estimator._refit.terms_in_fit.any()


def test_history_is_bounded_until_it_is_read():
    estimator = Estimator(RATE, 5.0, every_sample=True)
    for at in range(0, 70_000, 700):
        estimator.add_samples(make_samples(at, 700))
    t_ns = estimator.get_estimate().history.t_ns
    assert MAX_HISTORY_SAMPLES <= t_ns.size < MAX_HISTORY_SAMPLES + 700
    assert t_ns[-1] == 69_999 * 10_000_000
    assert (np.diff(t_ns) == 10_000_000).all()


def test_history_has_one_row_per_sample():
    estimator = Estimator(RATE, 100.0, every_sample=True)
    estimator.add_samples(make_samples(0, 700))
    estimator.add_samples(make_samples(707, 300, lost=7))
    found = estimator.get_estimate()
    assert found.history is not None
    assert found.history.t_ns.tolist() == [*make_samples(0, 700).t_ns.tolist(), *make_samples(707, 300).t_ns.tolist()]
    assert found.history.value[-1, 1] == pytest.approx(found.coefficients.value[1], rel=0.06)
    assert estimator.get_estimate().history is None


def test_display_curve_follows_a_change_at_once():
    estimator = Estimator(RATE, 600.0)
    for at in range(0, 60_000, 500):
        block = make_samples(at, 500)
        estimator.add_samples(make_block(block.t_ns, (block.values - 9.81) * (2.0 if at >= 58_000 else 1.0)))
    found = estimator.get_estimate()
    assert found.display_curve is not None
    assert np.sqrt(found.display_curve.avar[0]) == pytest.approx(2e-3, rel=0.1)
    assert np.sqrt(found.curve.avar[0]) == pytest.approx(np.sqrt(1 + 3 * 2000 / 60_000) * 1e-3, rel=0.05)
    truth = 2e-3 / np.sqrt(found.display_curve.factors[:8, None])
    assert ((found.display_curve.lo[:8] < truth) & (truth < found.display_curve.hi[:8])).mean() > 0.85
