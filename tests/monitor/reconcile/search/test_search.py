"""The search on one axis: what was hidden is named, what is right is left alone, what nobody knows gets no name."""

import numpy as np
import pytest

from monitor.noise.effects import (
    AngleRandomWalk,
    ExponentiallyCorrelated,
    NoiseStep,
    Outliers,
    RateRandomWalk,
    Sinusoidal,
)
from monitor.reconcile.likelihood.hypothesis import fit_with_fewest_changes, fit_with_fixed_noise
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
    ringing,
    seen,
    time_s,
    walk,
    warmth,
    white,
)

pytestmark = pytest.mark.long

n = 40_000
MODEL = (WHITE, WALK)
SIGMA = N * RATE_HZ**0.5
T = time_s(n)


def noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def looked(y, model=MODEL, temperature_c=None) -> AxisSearchResult:
    return search_missing_effects(axis(y, model, temperature_c), model, STRICT, np.random.default_rng(0))


def names(found):
    """Of what was added."""
    return [effect.name for effect in found.hypothesis.effects[found.hypothesis.given_count :]]


@pytest.mark.parametrize("seed", range(3))
def test_a_true_model_is_left_alone(seed):
    found = looked(noise(seed))
    assert found.rounds == ()
    assert found.hypothesis.effects == MODEL


RNG = np.random.default_rng(1)
HIDDEN = {
    "sinusoidal": 2e-4 * np.sin(2 * np.pi * 17.3 * T),
    "narrowband": ringing(n, RNG, 4e-4, 17.3, 1.5),
    "exponentially_correlated": correlated(n, RNG, 3e-4, 0.5),
    "rate_ramp": 4e-6 * T,
    "bias_step": 6e-4 * (T > 130.0),
    "turn_on_transient": 1e-3 * np.exp(-T / 12.0),
    "temperature_bias": 2e-4 * (warmth(n) - 25.0),
    "outliers": (RNG.random(n) < 1e-3) * 1.5e-2 * RNG.standard_normal(n),
}


@pytest.mark.long
@pytest.mark.parametrize("name", HIDDEN)
def test_what_was_hidden_is_named(name):
    found = looked(noise(2) + HIDDEN[name], temperature_c=warmth(n))
    assert names(found) == [name]
    first = found.rounds[0]
    assert any(one.gain > STRICT[lens].threshold for lens, one in first.before.findings.items())
    assert not any(one.gain > STRICT[lens].threshold for lens, one in found.final.findings.items())
    assert first.trials[0].name == name
    assert first.trials[0].score > 0.0
    assert found.hypothesis.effects[:2] == MODEL  # what is right stays as it is


@pytest.mark.parametrize("seed", range(2))
def test_a_slow_telegraph_is_no_random_walk_and_no_poisson_steps(seed):
    """With a walk in the model that need only be stronger to have its spectrum."""
    rng = np.random.default_rng(seed)
    levels = np.cumsum(rng.random(n) < 1.0 / (25.0 * RATE_HZ)) % 2
    assert names(looked(noise(seed) + 1e-3 * levels)) == ["random_telegraph"]


def test_noise_that_becomes_another_is_a_step_of_it():
    found = looked(white(n, np.random.default_rng(3)) * np.where(T < 150.0, 1.0, 1.5), (WHITE,))
    assert names(found) == ["noise_step"]
    step = found.hypothesis.effects[-1]
    assert isinstance(step, NoiseStep)
    assert step.time == pytest.approx(150.0, abs=2.0)
    assert step.ratio == pytest.approx(1.5, rel=0.05)


def test_values_that_are_not_as_the_model_says():
    coarse = looked(4e-4 * np.rint(noise(4) / 4e-4))
    assert names(coarse) == ["resolution"]
    assert coarse.hypothesis.effects[-1].step == pytest.approx(4e-4)
    clipped = looked(np.clip(noise(4), -2.2 * SIGMA, 2.2 * SIGMA))
    assert names(clipped) == ["saturation"]
    assert clipped.hypothesis.effects[-1].limit == pytest.approx(2.2 * SIGMA)


def test_two_effects_are_two_rounds():
    y = noise(5) + HIDDEN["sinusoidal"] + HIDDEN["outliers"]
    found = looked(y)
    assert sorted(names(found)) == ["outliers", "sinusoidal"]
    assert len(found.rounds) == 2
    line = next(effect for effect in found.hypothesis.effects if isinstance(effect, Sinusoidal))
    assert line.frequency == pytest.approx(17.3, abs=1e-3)
    assert line.amplitude == pytest.approx(2e-4, rel=0.2)
    far = next(effect for effect in found.hypothesis.effects if isinstance(effect, Outliers))
    assert far.fraction == pytest.approx(1e-3, rel=0.6)
    assert far.scale == pytest.approx(1.5e-2, rel=0.4)


def test_another_size_is_no_name():
    found = looked(1.15 * noise(6))
    assert names(found) == []
    assert len(found.rounds) >= 1
    assert found.rounds[0].trials[0].effect is None
    assert pytest.approx(1.15 * N, rel=0.02) == found.hypothesis.effects[0].N
    bigger_walk = looked(noise(7) + walk(n, np.random.default_rng(8), 5e-5))
    assert names(bigger_walk) == []
    size = bigger_walk.hypothesis.effects[1].K
    assert size == pytest.approx(5e-5, rel=0.5)


def test_what_nobody_knows_has_no_name():
    """A chirp through the whole band, and Student's t of six degrees of freedom: both stay to be seen."""
    chirp = 1.5 * SIGMA * np.sin(2 * np.pi * (2.0 * T + 0.5 * (40.0 / T[-1]) * T**2))
    found = looked(noise(9) + chirp)
    assert any(one.gain > STRICT[lens].threshold for lens, one in found.final.findings.items())
    student = looked(SIGMA * np.random.default_rng(10).standard_t(6, n) / np.sqrt(1.5), (WHITE,))
    assert "outliers" not in names(student)
    assert student.final.findings["tails"].gain > STRICT["tails"].threshold


def test_the_same_generator_gives_the_same_search():
    y = noise(11) + HIDDEN["outliers"]
    one, other = looked(y), looked(y)
    assert one.hypothesis.effects == other.hypothesis.effects
    assert one.final.findings == other.final.findings
    assert [r.trials for r in one.rounds] == [r.trials for r in other.rounds]


def test_what_is_worth_nothing_is_dropped():
    y = noise(12) + HIDDEN["sinusoidal"]
    one = axis(y, MODEL)
    idle = ExponentiallyCorrelated(sigma=1e-6, correlation_time=1.0)
    line = Sinusoidal(amplitude=1.0, frequency=17.3, phase=0.0)
    last = RateRandomWalk(K=1e-9)  # what was just found is not asked
    state = drop_unneeded_effects(fit_with_fewest_changes(one, (idle, line, last), MODEL))
    assert [type(effect) for effect in state.effects] == [AngleRandomWalk, RateRandomWalk, Sinusoidal, RateRandomWalk]


def test_candidates_on_a_true_model_are_not_worth_their_price():
    """As none is asked for unless a lens passes its threshold, this is the second of two doors."""
    wrong = 0
    for seed in range(6):
        one = axis(noise(20 + seed), MODEL)
        trials = [
            each for kind in generate_trial_groups(fit_with_fixed_noise(one, MODEL), seen(one, MODEL)) for each in kind
        ]
        assert trials
        wrong += max(each.score for each in trials) > 0.0
    assert wrong <= 1
