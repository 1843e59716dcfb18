"""Tests of the search on one axis: hidden effects are named, true models are kept, unknown effects get no name."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    ExponentiallyCorrelated,
    Narrowband,
    NoiseStep,
    Outliers,
    PowerLaw,
    RateRandomWalk,
    Resolution,
    Sinusoidal,
    TemperatureBias,
    TemperatureHysteresis,
    WanderingVariance,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.axis_result_builder import build_axis_result
from monitor.reconcile.likelihood.effect_roles import build_unit_regressors
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_fewest_changes, fit_with_model_sizes
from monitor.reconcile.search.backward_elimination import changed_sizes
from monitor.reconcile.search.search import AxisSearchResult, drop_unneeded_effects, search_missing_effects
from monitor.reconcile.search.trials import generate_trial_groups
from tests.monitor.reconcile.axes import (
    RATE_HZ,
    STRICT,
    WALK,
    WHITE,
    N,
    axis,
    correlated,
    draw_resonance,
    make_temperature,
    time_s,
    walk,
    white,
    whiten,
)

pytestmark = pytest.mark.long

n = 40_000
MODEL = (WHITE, WALK)
SIGMA = N * RATE_HZ**0.5
T = time_s(n)


def draw_noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def search_axis(y, model=MODEL, temperature_c=None) -> AxisSearchResult:
    return search_missing_effects(axis(y, model, temperature_c), model, STRICT, np.random.default_rng(0))


def list_added(found):
    """Return the names of the added effects."""
    return [effect.name for effect in found.hypothesis.effects[found.hypothesis.model_effect_count :]]


@pytest.mark.parametrize("seed", range(3))
def test_true_model_is_not_changed(seed):
    found = search_axis(draw_noise(seed))
    assert found.rounds == ()
    assert found.hypothesis.effects == MODEL


RNG = np.random.default_rng(1)
HIDDEN = {
    "sinusoidal": 2e-4 * np.sin(2 * np.pi * 17.3 * T),
    "narrowband": draw_resonance(n, RNG, 4e-4, 17.3, 1.5),
    "exponentially_correlated": correlated(n, RNG, 3e-4, 0.5),
    "rate_ramp": 4e-6 * T,
    "bias_step": 6e-4 * (T > 130.0),
    "turn_on_transient": 1e-3 * np.exp(-T / 12.0),
    "bias_curve": 1.2e-3 * (2.0 * T / T[-1] - 1.0) ** 2,
    "temperature_bias": 2e-4 * (make_temperature(n) - 25.0),
    "power_law": NoiseModel({"gz": (PowerLaw(density=0.5 * N, exponent=1.5),)}).simulate(n, RATE_HZ, 3)[:, 2],
    "outliers": (RNG.random(n) < 1e-3) * 1.5e-2 * RNG.standard_normal(n),
    "pulse_train": 3e-4 * (np.mod(T + 1e-9, 1.0) < 0.03),
}


@pytest.mark.long
@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_effect_is_named(name):
    found = search_axis(draw_noise(2) + HIDDEN[name], temperature_c=make_temperature(n))
    assert list_added(found) == [name]
    first = found.rounds[0]
    assert any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in first.before.findings.items())
    assert not any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in found.final.findings.items())
    assert first.trials[0].name == name
    assert first.trials[0].score > 0.0
    assert found.hypothesis.effects[:2] == MODEL  # what is right stays as it is


@pytest.mark.parametrize("seed", range(2))
def test_slow_telegraph_signal_is_no_random_walk_and_no_poisson_steps(seed):
    """The model has a random walk, which would have the same spectrum if it were stronger."""
    rng = np.random.default_rng(seed)
    levels = np.cumsum(rng.random(n) < 1.0 / (25.0 * RATE_HZ)) % 2
    assert list_added(search_axis(draw_noise(seed) + 1e-3 * levels)) == ["random_telegraph"]


@pytest.mark.parametrize(("quadratic", "cubic"), [(2e-7, None), (2e-7, 4e-9)], ids=["quadratic", "quadratic and cubic"])
@pytest.mark.parametrize("given", [(), (TemperatureBias(coefficient=1e-5, reference=25.0),)], ids=["new", "beside c"])
def test_order_of_a_temperature_effect_is_found(quadratic, cubic, given):
    """The temperature is −18 … 74 °C, and the model may contain the linear coefficient."""
    warm = 28.0 - 46.0 * np.cos(2.0 * np.pi * T / T[-1])
    away = warm - 25.0
    y = draw_noise(4) + (1e-5 + (quadratic + (cubic or 0.0) * away) * away) * away
    found = search_axis(y, (*MODEL, *given), warm)
    assert list_added(found) == ["temperature_bias"]
    curve = found.hypothesis.effects[-1]
    assert (curve.quadratic is None, curve.cubic is None) == (quadratic is None, cubic is None)
    if cubic is not None:
        assert curve.cubic == pytest.approx(cubic, rel=0.1)


def test_temperature_hysteresis_is_found_beside_a_slope():
    warm = make_temperature(n)
    (loop,) = build_unit_regressors(TemperatureHysteresis(height=1.0, reversal=0.8), n, RATE_HZ, warm)
    found = search_axis(draw_noise(5) + 8e-4 * loop + 2e-4 * (warm - 25.0), temperature_c=warm)
    assert sorted(list_added(found)) == ["temperature_bias", "temperature_hysteresis"]


def test_change_of_the_noise_level_is_a_noise_step():
    found = search_axis(white(n, np.random.default_rng(3)) * np.where(T < 150.0, 1.0, 1.5), (WHITE,))
    assert list_added(found) == ["noise_step"]
    step = found.hypothesis.effects[-1]
    assert isinstance(step, NoiseStep)
    assert step.time == pytest.approx(150.0, abs=2.0)
    assert step.ratio == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_random_noise_level_is_a_wandering_variance(seed):
    hidden = WanderingVariance(deviation=0.5, correlation_time=5.0)
    gain = hidden.start_gain(RATE_HZ, np.random.default_rng([seed, 1])).compute_gain(0, n)
    rng = np.random.default_rng([seed, 2])
    found = search_axis(white(n, rng) * gain + walk(n, rng))
    assert list_added(found) == ["wandering_variance"]
    effect = found.hypothesis.effects[-1]
    assert effect.deviation == pytest.approx(hidden.deviation, rel=0.3)
    assert max(one.gain for one in found.final.findings.values()) < 20.0
    # the mean variance of a recording depends on chance and is no other size of the model
    assert changed_sizes(found.hypothesis) == []


@pytest.mark.parametrize("seed", range(4))
def test_random_noise_level_of_the_model_may_take_another_course(seed):
    hidden = WanderingVariance(deviation=0.5, correlation_time=5.0)
    gain = hidden.start_gain(RATE_HZ, np.random.default_rng([seed, 1])).compute_gain(0, n)
    rng = np.random.default_rng([seed, 2])
    found = search_axis(white(n, rng) * gain + walk(n, rng), (*MODEL, hidden))
    assert found.rounds == ()
    louder = search_axis(1.5 * (white(n, rng) * gain + walk(n, rng)), (*MODEL, hidden))
    assert louder.rounds


def test_periodic_noise_level_is_a_variance_modulation():
    gain = np.sqrt(1.0 + 0.3 * np.sin(2.0 * np.pi * T / 37.0 + 1.0))
    found = search_axis(white(n, np.random.default_rng(3)) * gain, (WHITE,))
    assert list_added(found) == ["variance_modulation"]
    effect = found.hypothesis.effects[-1]
    assert effect.depth == pytest.approx(0.3, abs=0.05)
    assert effect.period == pytest.approx(37.0, rel=0.02)
    assert effect.phase == pytest.approx(1.0, abs=0.3)


def test_resolution_and_saturation_are_named():
    coarse = search_axis(4e-4 * np.rint(draw_noise(4) / 4e-4))
    assert list_added(coarse) == ["resolution"]
    assert coarse.hypothesis.effects[-1].step == pytest.approx(4e-4)
    clipped = search_axis(np.clip(draw_noise(4), -2.2 * SIGMA, 2.2 * SIGMA))
    assert list_added(clipped) == ["saturation"]
    assert clipped.hypothesis.effects[-1].limit == pytest.approx(2.2 * SIGMA)


def test_two_effects_are_found_in_two_rounds():
    y = draw_noise(5) + HIDDEN["sinusoidal"] + HIDDEN["outliers"]
    found = search_axis(y)
    assert sorted(list_added(found)) == ["outliers", "sinusoidal"]
    assert len(found.rounds) == 2
    line = next(effect for effect in found.hypothesis.effects if isinstance(effect, Sinusoidal))
    assert line.frequency == pytest.approx(17.3, abs=1e-3)
    assert line.amplitude == pytest.approx(2e-4, rel=0.2)
    far = next(effect for effect in found.hypothesis.effects if isinstance(effect, Outliers))
    assert far.fraction == pytest.approx(1e-3, rel=0.6)
    assert far.scale == pytest.approx(1.5e-2, rel=0.4)


def test_changed_size_adds_no_effect():
    found = search_axis(1.15 * draw_noise(6))
    assert list_added(found) == []
    assert len(found.rounds) >= 1
    assert found.rounds[0].trials[0].effect is None
    assert pytest.approx(1.15 * N, rel=0.02) == found.hypothesis.effects[0].N
    bigger_walk = search_axis(draw_noise(7) + walk(n, np.random.default_rng(8), 5e-5))
    assert list_added(bigger_walk) == []
    size = bigger_walk.hypothesis.effects[1].K
    assert size == pytest.approx(5e-5, rel=0.5)


def test_noise_band_with_sharp_edges_stays_unexplained():
    drawn = np.fft.rfft(np.random.default_rng(13).standard_normal(n))
    f_hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    found = search_axis(draw_noise(14) + SIGMA * np.fft.irfft(drawn * ((f_hz > 5.0) & (f_hz < 10.0)), n))
    assert found.final.findings["psd"].gain > STRICT["psd"].threshold
    assert not {"power_law", "bandwidth_limit", "exponentially_correlated"} & set(list_added(found))


def test_unknown_effect_gets_no_name():
    """A chirp through the whole band and a Laplace distribution stay visible in the diagnostics."""
    chirp = 1.5 * SIGMA * np.sin(2 * np.pi * (2.0 * T + 0.5 * (40.0 / T[-1]) * T**2))
    found = search_axis(draw_noise(9) + chirp)
    assert any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in found.final.findings.items())
    laplace = search_axis(SIGMA * np.random.default_rng(10).laplace(size=n) / np.sqrt(2.0), (WHITE,))
    assert list_added(laplace) == []
    assert laplace.final.findings["tails"].gain > STRICT["tails"].threshold


@pytest.mark.parametrize(("nu", "seed"), [(3.0, 1), (6.0, 2), (20.0, 3)])
def test_student_noise_has_heavy_tails(nu, seed):
    rng = np.random.default_rng(seed)
    found = search_axis(SIGMA * rng.standard_t(nu, n) * np.sqrt(1.0 - 2.0 / nu) + walk(n, rng))
    assert list_added(found) == ["heavy_tails"]
    assert found.hypothesis.effects[-1].nu == pytest.approx(nu, rel=0.25)
    assert max(one.gain for one in found.final.findings.values()) < 20.0  # of 60 to 8000 before


@pytest.mark.parametrize("period_s", [5.0, 100.0])
def test_periodic_variance_is_no_heavy_tail(period_s):
    rng = np.random.default_rng(15)
    found = search_axis(white(n, rng) * np.sqrt(1.0 + 0.5 * np.sin(2 * np.pi * T / period_s)) + walk(n, rng))
    assert list_added(found) == ["variance_modulation"]
    assert found.hypothesis.effects[-1].period == pytest.approx(period_s, rel=0.02)
    assert found.final.findings["variance"].gain < STRICT["variance"].threshold


def test_weak_ramp_is_named_below_the_threshold_of_every_diagnostic():
    y, ramp = white(n, np.random.default_rng(13)), T - T.mean()
    y -= ramp * (ramp @ y) / (ramp @ ramp)
    found = search_axis(y + ramp * SIGMA * np.sqrt(2.0 * 12.5 / (ramp @ ramp)), (WHITE,))  # a gain of 12.5 nats
    assert list_added(found) == ["rate_ramp"]
    level = found.rounds[0].before.findings["level"].gain
    assert STRICT["level"].min_gain_to_test_effects < level < STRICT["level"].threshold


def test_poisson_steps_are_neither_correlated_noise_nor_another_bias_instability():
    rng = np.random.default_rng(14)
    model = (WHITE, BiasInstability(B=0.5 * N), WALK)
    jumps = 6e-4 * np.cumsum((rng.random(n) < 0.05 / RATE_HZ) * rng.standard_normal(n))
    found = search_axis(draw_noise(14) + jumps, model)
    assert list_added(found) == ["poisson_steps"]
    assert found.hypothesis.effects[: len(model)] == model


def test_transient_and_correlated_noise_are_both_named():
    y = draw_noise(15) + correlated(n, np.random.default_rng(16), 3e-4, 1.0) + 2e-3 * np.exp(-T / 20.0)
    assert sorted(list_added(search_axis(y))) == ["exponentially_correlated", "turn_on_transient"]


def test_same_generator_gives_the_same_search():
    y = draw_noise(11) + HIDDEN["outliers"]
    one, other = search_axis(y), search_axis(y)
    assert one.hypothesis.effects == other.hypothesis.effects
    assert one.final.findings == other.final.findings
    assert [r.trials for r in one.rounds] == [r.trials for r in other.rounds]


def test_effect_without_gain_is_dropped():
    y = draw_noise(12) + HIDDEN["sinusoidal"]
    one = axis(y, MODEL)
    idle = ExponentiallyCorrelated(sigma=1e-6, correlation_time=1.0)
    line = Sinusoidal(amplitude=1.0, frequency=17.3, phase=0.0)
    last = RateRandomWalk(K=1e-9)  # what was just found is not asked
    state = drop_unneeded_effects(fit_with_fewest_changes(one, (idle, line, last), MODEL))
    assert [type(effect) for effect in state.effects] == [AngleRandomWalk, RateRandomWalk, Sinusoidal, RateRandomWalk]


def test_candidates_on_a_true_model_do_not_reach_their_penalty():
    """Candidates are tested only after a diagnostic has passed its threshold. The score is a second protection."""
    wrong = 0
    for seed in range(6):
        one = axis(draw_noise(20 + seed), MODEL)
        trials = [
            each
            for kind in generate_trial_groups(fit_with_model_sizes(one, MODEL), whiten(one, MODEL))
            for each in kind
        ]
        assert trials
        wrong += max(each.score for each in trials) > 0.0
    assert wrong <= 1


@pytest.mark.parametrize(
    ("known", "new_hz"),
    [
        (Sinusoidal(amplitude=2e-4, frequency=17.3), 16.1),
        (Sinusoidal(amplitude=2e-4, frequency=17.3), 23.7),
        (Narrowband(sigma=4e-4, frequency=17.3, bandwidth=1.5), 20.3),
    ],
)
def test_moved_line_of_the_model_is_no_new_line(known, new_hz):
    other = Sinusoidal(amplitude=3e-4, frequency=5.0)
    true = NoiseModel({"gz": (*MODEL, replace(known, frequency=new_hz), other)}).simulate(n, RATE_HZ, 32)
    found = search_axis(true[:, 2].copy(), (*MODEL, known, other))
    assert list_added(found) == []
    assert [trial.moved for trial in (one.trials[0] for one in found.rounds)] == [2]
    assert found.hypothesis.effects[2].frequency == pytest.approx(new_hz, abs=0.1)
    assert found.hypothesis.effects[3].frequency == 5.0
    assert not any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in found.final.findings.items())


@pytest.mark.parametrize("cycles", [0.7, 1.0, 1.3, 2.0, 5.0])
def test_line_of_the_model_that_moved_by_a_few_cycles_is_no_new_line(cycles):
    hz = 7.3 + cycles * RATE_HZ / n
    y = draw_noise(3) + 3e-4 * np.sin(2.0 * np.pi * hz * T + 1.0)
    found = search_axis(y, (*MODEL, Sinusoidal(amplitude=3e-4, frequency=7.3)))
    assert list_added(found) == []
    assert [one.trials[0].moved for one in found.rounds] == [len(MODEL)]
    assert found.hypothesis.effects[-1].frequency == pytest.approx(hz, abs=0.03 * RATE_HZ / n)


@pytest.mark.parametrize(("cutoff_hz", "order"), [(12.0, 1), (40.0, 1), (20.0, 2)])
def test_changed_filter_of_the_model_is_no_new_effect(cutoff_hz, order):
    known = BandwidthLimit(cutoff=28.0, order=1, floor=0.1 * N, kind="butterworth")
    model = (*MODEL, known)
    true = NoiseModel({"gz": (*MODEL, replace(known, cutoff=cutoff_hz, order=order))}).simulate(n, RATE_HZ, 34)
    found = search_axis(true[:, 2].copy(), model)
    assert list_added(found) == []
    assert [trial.moved for trial in (one.trials[0] for one in found.rounds)] == [2]
    low_pass = found.hypothesis.effects[2]
    assert low_pass.cutoff == pytest.approx(cutoff_hz, rel=0.05)
    assert low_pass.order == order
    assert not any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in found.final.findings.items())
    step = build_axis_result(found, STRICT, STRICT).steps[0]
    assert (step.kind, step.effect) == ("retuned", "bandwidth_limit")
    assert "another cutoff, order or kind of bandwidth_limit" in step.because


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_other_quantization_step_is_no_new_effect(ratio):
    model = (*MODEL, Resolution(step=N * 8.0))
    true = NoiseModel({"gz": (*MODEL, Resolution(step=ratio * N * 8.0))}).simulate(n, RATE_HZ, 37)[:, 2]
    found = search_axis(true.copy(), model)
    assert list_added(found) == []
    assert found.hypothesis.effects[2].step == pytest.approx(ratio * N * 8.0, rel=1e-3)
    (step,) = build_axis_result(found, STRICT, STRICT).steps
    assert (step.kind, step.effect) == ("retuned", "resolution")
    assert "another step of resolution" in step.because
    assert step.gain_nats < n  # a step is certain, but its gain is limited to the change of the noise


def test_same_quantization_step_agrees():
    model = (*MODEL, Resolution(step=N * 8.0))
    found = search_axis(NoiseModel({"gz": model}).simulate(n, RATE_HZ, 38)[:, 2].copy(), model)
    assert found.rounds == ()


def test_other_bandwidth_of_a_resonance_is_no_new_effect():
    known = Narrowband(sigma=4e-4, frequency=17.3, bandwidth=0.3)
    true = NoiseModel({"gz": (*MODEL, replace(known, bandwidth=2.0))}).simulate(n, RATE_HZ, 39)
    found = search_axis(true[:, 2].copy(), (*MODEL, known))
    assert list_added(found) == []
    resonance = found.hypothesis.effects[2]
    assert resonance.bandwidth == pytest.approx(2.0, rel=0.2)
    assert resonance.sigma == pytest.approx(4e-4, rel=0.1)


def test_second_of_two_resonances_that_moved_is_named():
    first, second = (Narrowband(sigma=4e-4, frequency=f, bandwidth=0.5) for f in (17.3, 30.0))
    true = NoiseModel({"gz": (*MODEL, first, replace(second, frequency=20.0))}).simulate(n, RATE_HZ, 41)
    found = search_axis(true[:, 2].copy(), (*MODEL, first, second))
    (step,) = (one for one in build_axis_result(found, STRICT, STRICT).steps if one.moved_from is not None)
    assert step.moved_from.frequency == 30.0
    assert step.parameters["frequency"].value == pytest.approx(20.0, abs=0.2)


def test_factor_of_an_axis_with_a_filter_also_multiplies_the_noise_after_the_filter():
    model = (*MODEL, BandwidthLimit(cutoff=15.0, order=1, floor=0.3 * N, kind="butterworth"))
    true = NoiseModel({"gz": model}).simulate(n, RATE_HZ, 36)[:, 2]
    found = search_axis(1.25 * true, model)
    (factor,) = found.hypothesis.added
    assert factor.name == "scale_factor"
    assert factor.factor == pytest.approx(1.25, rel=0.01)


def test_filter_that_changes_in_two_rounds_is_one_step_with_the_whole_gain():
    known = BandwidthLimit(cutoff=28.0, order=1, floor=0.1 * N, kind="butterworth")
    model = (*MODEL, known)
    drawn = NoiseModel({"gz": (*MODEL, replace(known, cutoff=12.0, order=2))}).simulate(n, RATE_HZ, 40)[:, 2]
    one = axis(drawn + 2e-4 * np.sin(2 * np.pi * 17.3 * time_s(n)), model)
    found = search_missing_effects(one, model, STRICT, np.random.default_rng(0))
    steps = build_axis_result(found, STRICT, STRICT).steps
    assert [step.effect for step in steps].count("bandwidth_limit") == 1
    gain = found.hypothesis.fit.log_likelihood - fit_with_model_sizes(one, model).fit.log_likelihood
    assert sum(step.gain_nats for step in steps) == pytest.approx(gain, rel=0.01)


def test_unchanged_filter_of_the_model_is_kept():
    model = (*MODEL, BandwidthLimit(cutoff=28.0, order=1, floor=0.1 * N, kind="butterworth"))
    true = NoiseModel({"gz": model}).simulate(n, RATE_HZ, 35)[:, 2] + 2e-4 * np.sin(2 * np.pi * 17.3 * time_s(n))
    found = search_axis(true, model)
    assert list_added(found) == ["sinusoidal"]
    assert found.hypothesis.effects[2] == model[2]


def test_new_line_beside_a_line_of_the_model_is_added():
    known = Sinusoidal(amplitude=2e-4, frequency=17.3)
    true = NoiseModel({"gz": (*MODEL, known, replace(known, frequency=16.1))}).simulate(n, RATE_HZ, 33)
    found = search_axis(true[:, 2].copy(), (*MODEL, known))
    assert list_added(found) == ["sinusoidal"]
    assert found.hypothesis.effects[2].frequency == 17.3


@pytest.mark.parametrize("kind", ["butterworth", "iir", "fir"])
def test_filter_with_subsequent_noise_is_one_effect(kind):
    hidden = BandwidthLimit(cutoff=12.0, order=2, floor=0.15 * N, kind=kind)
    y = NoiseModel({"gz": (WHITE, hidden)}).simulate(n, RATE_HZ, 30)[:, 2].copy()
    found = search_axis(y, (WHITE,))
    assert list_added(found) == ["bandwidth_limit"]
    limit = found.hypothesis.effects[-1]
    assert limit.cutoff == pytest.approx(12.0, rel=0.05)
    assert limit.floor == pytest.approx(0.15 * N, rel=0.2)  # the kinds differ most above the cutoff
    assert not any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in found.final.findings.items())


def test_noise_after_a_known_filter_is_its_floor():
    y = NoiseModel({"gz": (WHITE, BandwidthLimit(cutoff=12.0, order=2, floor=0.15 * N))}).simulate(n, RATE_HZ, 31)
    found = search_axis(y[:, 2].copy(), (WHITE, BandwidthLimit(cutoff=12.0, order=2, floor=0.0)))
    assert list_added(found) == []
    assert found.hypothesis.effects[1].floor == pytest.approx(0.15 * N, rel=0.05)


@pytest.mark.parametrize("seed", range(2))
def test_wandering_line_is_found_and_subtracted(seed):
    rng = np.random.default_rng(seed)
    hz = 17.3 + correlated(n, rng, 0.2, 30.0)
    found = search_axis(draw_noise(seed) + 4e-4 * np.sin(2.0 * np.pi * np.cumsum(hz) / RATE_HZ))
    assert list_added(found) == ["wandering_line"]
    line = found.hypothesis.effects[-1]
    assert line.amplitude == pytest.approx(4e-4, rel=0.1)
    assert not any(one.gain > STRICT[diagnostic].threshold for diagnostic, one in found.final.findings.items())


def test_wandering_line_of_varying_amplitude_gets_no_name():
    rng = np.random.default_rng(8)
    hz = 17.3 + correlated(n, rng, 0.2, 30.0)
    swell = 1.0 + 0.9 * np.sin(2.0 * np.pi * T / 40.0)
    assert "wandering_line" not in list_added(
        search_axis(draw_noise(8) + 1e-3 * swell * np.sin(2.0 * np.pi * np.cumsum(hz) / RATE_HZ))
    )
