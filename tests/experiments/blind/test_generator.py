"""Tests of the simulation, the levels and the oracle of the blind trials, by closed forms and without the program."""

import tomllib

import numpy as np
import pytest

from tests.experiments.blind import cases, foreign, levels, oracle, processes, sensors, spectra
from tests.experiments.blind.processes import Clock, generator
from tests.experiments.blind.recipes import RECIPES, scaled
from tests.experiments.blind.rivals import Rivals
from tests.experiments.blind.world import Effect, TemperatureProfile, World, model_text

RATE_HZ = 100.0
CLOCK = Clock(60_000, RATE_HZ)
SPECTRA = {
    "quantization_noise": {"Q": 1e-5},
    "angle_random_walk": {"N": 1e-4},
    "bias_instability": {"B": 1e-4},
    "rate_random_walk": {"K": 1e-5},
    "exponentially_correlated": {"sigma": 1e-3, "correlation_time": 3.0},
    "narrowband": {"sigma": 1e-3, "frequency": 17.0, "bandwidth": 2.0},
    "wandering_line": {
        "amplitude": 1e-3,
        "frequency": 17.0,
        "frequency_deviation": 2.0,
        "correlation_time": 0.2,
        "phase": 0.3,
    },
    "random_telegraph": {"amplitude": 1e-3, "dwell_time": 9.0},
    "poisson_steps": {"rate": 1.0, "height": 1e-3},
    "outliers": {"fraction": 1e-2, "scale": 1e-2},
}


def draw_series(name: str, parameters: dict[str, float], clock: Clock = CLOCK, seed: int = 1) -> processes.Floats:
    return processes.SOURCES[name](clock, generator(seed, name), **parameters)


def make_sensor(*effects: Effect, seconds: float = 600.0) -> World:
    baseline = tuple(Effect(axis, "angle_random_walk", {"N": 1e-4}) for axis in ("gx", "gy", "gz"))
    return World(3, seconds, RATE_HZ, ("gx", "gy", "gz"), baseline, dict.fromkeys(("gx", "gy", "gz"), 0.0), effects)


@pytest.mark.parametrize("name", SPECTRA)
def test_series_has_its_spectrum(name: str) -> None:
    f = spectra.frequencies(CLOCK.n, RATE_HZ)
    expected = spectra.density([Effect("gx", name, SPECTRA[name])], f, RATE_HZ) * RATE_HZ
    ratio = np.mean(
        [spectra.coefficients(draw_series(name, SPECTRA[name], seed=seed)) ** 2 / expected for seed in range(6)], axis=0
    )
    # the ends of differenced noise leak into the first coefficients
    first = 1200 if name == "quantization_noise" else 20
    for band in np.array_split(ratio[first:6000], 8):
        assert abs(band.mean() - 1.0) < 6.0 / np.sqrt(6 * 0.5 * band.size) + 0.05
    assert ratio[6000:].mean() == pytest.approx(1.0, abs=0.1 if name != "exponentially_correlated" else 0.02)


def test_flicker_noise_has_its_spectrum_at_the_lowest_frequencies() -> None:
    f = spectra.frequencies(20_000, RATE_HZ)
    expected = 1e-8 / (2.0 * np.pi * f) * RATE_HZ
    clock = Clock(20_000, RATE_HZ)
    powers = [
        spectra.coefficients(draw_series("bias_instability", {"B": 1e-4}, clock, seed)) ** 2 for seed in range(60)
    ]
    assert (np.mean(powers, axis=0) / expected)[:8].mean() == pytest.approx(1.0, abs=0.3)


def test_variance_of_random_walk_grows_with_time() -> None:
    ends = np.array(
        [draw_series("rate_random_walk", {"K": 2.0}, Clock(1000, 10.0), seed)[[0, 249, 999]] for seed in range(900)]
    )
    assert ends.var(axis=0) == pytest.approx(4.0 * np.array([0.1, 25.0, 100.0]), rel=0.2)


def test_random_telegraph_has_two_levels_and_exponential_dwell_times() -> None:
    values = draw_series("random_telegraph", {"amplitude": 2.0, "dwell_time": 0.5}, Clock(400_000, RATE_HZ))
    assert set(np.unique(values)) == {-1.0, 1.0}
    dwells = np.diff(np.flatnonzero(np.diff(values))) / RATE_HZ
    # 4000 s / 0.5 s dwell times, less two percent for pairs of flips between two samples
    assert dwells.size == pytest.approx(8000 * np.exp(-0.02), rel=0.04)
    assert dwells.std() == pytest.approx(dwells.mean(), rel=0.06)


def test_numbers_of_jumps_and_outliers() -> None:
    jumps = [
        np.count_nonzero(np.diff(draw_series("poisson_steps", {"rate": 0.1, "height": 1.0}, seed=s))) for s in range(40)
    ]
    assert np.mean(jumps) == pytest.approx(60.0, abs=5.0)
    assert np.var(jumps) == pytest.approx(60.0, rel=0.7)
    hit = draw_series("outliers", {"fraction": 0.01, "scale": 3.0})
    assert np.count_nonzero(hit) == pytest.approx(600, abs=100)
    assert hit[hit != 0.0].std() == pytest.approx(3.0, rel=0.15)


def test_deterministic_effects() -> None:
    t = CLOCK.t_s
    assert draw_series("rate_ramp", {"R": 2.0})[-1] == pytest.approx(2.0 * 599.99)
    assert draw_series("turn_on_transient", {"amplitude": -3.0, "time_constant": 50.0})[5000] == pytest.approx(
        -3.0 / np.e
    )
    assert draw_series("bias_step", {"time": 10.0, "height": 2.0})[[999, 1000]].tolist() == [0.0, 2.0]
    line = draw_series("sinusoidal", {"amplitude": 2.0, "frequency": 3.0, "phase": 0.5})
    assert np.allclose(line, 2.0 * np.sin(6.0 * np.pi * t + 0.5))


def test_temperature_bias_without_and_with_lag() -> None:
    step_clock = Clock(CLOCK.n, RATE_HZ, np.where(CLOCK.t_s < 100.0, 20.0, 30.0))
    at_once = draw_series("temperature_bias", {"coefficient": 2.0, "reference": 25.0, "quadratic": 0.1}, step_clock)
    late = draw_series("temperature_lag", {"coefficient": 2.0, "reference": 25.0, "time_constant": 40.0}, step_clock)
    assert (at_once[0], at_once[-1]) == pytest.approx((-7.5, 12.5))
    assert late[0] == pytest.approx(-10.0)
    assert late[14_000] == pytest.approx(2.0 * (30.0 - 10.0 / np.e - 25.0), rel=1e-3)
    with pytest.raises(ValueError, match="needs a temperature"):
        draw_series("temperature_bias", {"coefficient": 1.0, "reference": 25.0})


@pytest.mark.parametrize("order", [1, 2, 3])
def test_low_pass_has_its_frequency_response(order: int) -> None:
    t = np.arange(20_000) / RATE_HZ
    for f_hz, gain in ((10.0, 0.5**0.5), (1.0, 1.0), (40.0, None)):
        passed = processes.bandwidth_limit(np.sin(2.0 * np.pi * f_hz * t), RATE_HZ, generator(0), 10.0, order)
        bilinear = np.tan(np.pi * f_hz / RATE_HZ) / np.tan(np.pi * 10.0 / RATE_HZ)
        expected = (1.0 + bilinear ** (2 * order)) ** -0.5
        assert passed[1000:-1000].std() * 2**0.5 == pytest.approx(expected, rel=1e-3)
        assert gain is None or expected == pytest.approx(gain, rel=6e-3)
    level = processes.bandwidth_limit(np.full(1000, 9.8), RATE_HZ, generator(0), 10.0, order)
    assert np.allclose(level, 9.8)


def test_low_pass_is_causal() -> None:
    pulse = np.zeros(20_000)
    pulse[10_000] = 1.0
    response = processes.bandwidth_limit(pulse, RATE_HZ, generator(0), 10.0, 2)
    assert np.abs(response[:10_000]).max() < 1e-9
    assert response.sum() == pytest.approx(1.0)


def test_sample_hold_saturation_and_resolution() -> None:
    values = processes.white(100_000, generator(5))
    held = processes.sample_hold(values, RATE_HZ, generator(6), 0.2)
    assert np.mean(np.diff(held) == 0.0) == pytest.approx(0.2, abs=0.01)
    assert processes.saturation(np.array([-3.0, 0.5, 9.0]), 1.0, generator(0), 2.0).tolist() == [-2.0, 0.5, 2.0]
    grid = processes.resolution(values, RATE_HZ, generator(0), 0.25)
    assert np.all(grid / 0.25 == np.rint(grid / 0.25))
    assert np.abs(grid - values).max() <= 0.125


def test_noise_step_scales_only_white_noise() -> None:
    before = make_sensor(Effect("gx", "rate_ramp", {"R": 1e-6}))
    after = make_sensor(
        Effect("gx", "rate_ramp", {"R": 1e-6}), Effect("gx", "noise_step", {"time": 300.0, "ratio": 3.0})
    )
    extra = after.measured("gx") - before.measured("gx")
    assert np.all(extra[:30_000] == 0.0)
    assert extra[30_000:].std() == pytest.approx(2e-3, rel=0.02)
    assert np.array_equal(after.measured("gy"), before.measured("gy"))


def test_leak_uses_the_source_axis_without_its_own_leaks() -> None:
    leaking = make_sensor(
        Effect("gx", "cross_axis", {"source": "gy", "coefficient": 0.5}),
        Effect("gy", "cross_axis", {"source": "gz", "coefficient": 0.5}),
        Effect("gy", "scale_factor", {"factor": 4.0}),
    )
    without_leaks = make_sensor()
    own = {axis: without_leaks.measured(axis) for axis in without_leaks.axes}
    assert np.allclose(leaking.measured("gx"), own["gx"] + 0.5 * 4.0 * own["gy"])
    assert np.allclose(leaking.measured("gy"), 4.0 * (own["gy"] + 0.5 * own["gz"]))


def test_clock_error_simulates_at_the_true_rate() -> None:
    fast = make_sensor(Effect("gx", "sample_rate_error", {"ratio": 4.0}))
    assert fast.measured("gy").std() == pytest.approx(1e-4 * np.sqrt(400.0), rel=0.02)
    assert fast.clock().n == 60_000


def test_model_file_has_no_phases_and_repeats_tables() -> None:
    line = Effect("gx", "sinusoidal", {"amplitude": 1e-4, "frequency": 3.0, "phase": 1.0})
    text = model_text((line, line.sized(frequency=5.0), Effect("gx", "cross_axis", {"source": "gy"})), 100.0)
    model = tomllib.loads(text)
    assert model["sample_rate"] == 100.0
    assert model["gx"]["sinusoidal"] == [{"amplitude": 1e-4, "frequency": f} for f in (3.0, 5.0)]
    assert model["gx"]["cross_axis"] == {"source": "gy"}


@pytest.mark.parametrize("name", foreign.NAMES)
def test_foreign_effects_change_the_signal(name: str) -> None:
    profile = TemperatureProfile(5.0, 100.0, 1.0, 300.0, 0.3, 50.0)
    clock = Clock(CLOCK.n, RATE_HZ, profile.draw(CLOCK, generator(7)))
    if name in foreign.SERIES:
        series = foreign.SERIES[name](clock, generator(8), 1.0)
        assert series.std() > 0.05
    else:
        level = foreign.LEVELS[name](clock, generator(8))
        assert np.mean(level**2) == pytest.approx(1.0, rel=0.3)
        assert level.std() > 0.01


def test_case_is_reproducible_and_depends_on_the_seed() -> None:
    first, again, other = (cases.make_case("bias_step", "plain", seed, seconds=100.0, axes=1) for seed in (4, 4, 5))
    assert first.model == again.model
    assert first.truth == again.truth
    assert all(np.array_equal(first.columns[axis], again.columns[axis]) for axis in first.columns)
    assert other.model != first.model
    assert "bias_step" not in first.model


def test_baseline_off_changes_the_model_but_not_the_recording() -> None:
    exact = cases.make_case("null", seed=2, seconds=60.0)
    off = cases.make_case("null", seed=2, seconds=60.0, baseline="off")
    assert all(np.array_equal(exact.columns[axis], off.columns[axis]) for axis in exact.columns)
    true, stated = (tomllib.loads(case.model) for case in (exact, off))
    ratios = {
        stated[axis][term][letter] / true[axis][term][letter]
        for axis in exact.truth["axes"]
        for term, letter in (("angle_random_walk", "N"), ("bias_instability", "B"), ("rate_random_walk", "K"))
    }
    assert {round(ratio, 9) for ratio in ratios} == {0.95, 1.05}


@pytest.mark.parametrize("level", ["plain", "faint"])
def test_sizes_reach_gain_and_margin_of_the_level(level: str) -> None:
    lo, _, margin = levels.TARGETS[level]
    for name in ("sinusoidal", "bias_step", "outliers"):
        [hidden] = cases.make_case(name, level, 1, seconds=300.0, axes=1).truth["hidden"]
        assert hidden["gain"] >= 0.99 * lo
        assert hidden["margin"] >= margin


def test_hidden_term_is_not_in_the_model() -> None:
    case = cases.make_case("bias_instability", "plain", 0, seconds=600.0, axes=1)
    assert "bias_instability" not in tomllib.loads(case.model)["gx"]
    assert case.truth["hidden"][0]["parameters"]["B"] > 0.0


def test_pair_on_one_axis() -> None:
    case = cases.make_case("bias_step@same+outliers", "plain", 0, seconds=100.0, axes=2)
    first, second = case.truth["hidden"]
    assert first["axis"] == second["axis"]
    assert (first["effect"], second["effect"]) == ("bias_step", "outliers")


def test_half_of_the_heavy_tails_has_twice_the_degrees_of_freedom() -> None:
    tails = Effect("gx", "heavy_tails", {"nu": 5.0})
    assert scaled(tails, make_sensor(), 0.5).parameters["nu"] == 10.0


def test_vocabulary_is_complete() -> None:
    known = {
        *processes.SOURCES,
        *processes.TRANSFORMS,
        "noise_step",
        "variance_modulation",
        "wandering_variance",
        "heavy_tails",
        "g_sensitivity",
        "cross_axis",
        "sample_rate_error",
    }
    assert set(RECIPES) == known


def test_oracle_gain_of_a_line_agrees_with_theory() -> None:
    """A line of amplitude A in white noise with standard deviation s has the mean gain A²n/4s²."""
    gains = []
    for seed in range(20):
        sensor = World(seed, 100.0, RATE_HZ, ("gx",), (Effect("gx", "angle_random_walk", {"N": 0.1}),), {"gx": 0.0})
        line = Effect("gx", "sinusoidal", {"amplitude": 0.2, "frequency": 11.0, "phase": 0.3})
        gains.append(oracle.Observer(sensor, line).gain())
    assert np.mean(gains) == pytest.approx(0.04 * 10_000 / 4.0, abs=6.0)


def test_oracle_gain_of_random_telegraph_agrees_with_forward_recursion() -> None:
    """The forward recursion gives the exact evidence in white noise. The oracle is slightly below it."""
    shortfalls, switches = [], []
    for seed in range(12):
        sensor = World(seed, 1200.0, 10.0, ("gx",), (Effect("gx", "angle_random_walk", {"N": 0.5}),), {"gx": 0.0})
        telegraph = Effect("gx", "random_telegraph", {"amplitude": 1.5, "dwell_time": 30.0})
        observer = oracle.Observer(sensor, telegraph)
        path = sensor.series(telegraph)
        # the mean level is known in the recursion and free in the oracle
        mean = observer.n * path.mean() * (observer.values.mean() - 0.5 * path.mean()) / 2.5
        shortfalls.append(_forward(observer.values, 2.5**0.5, 0.75, 1.0 / 300.0) - mean - observer.gain())
        switches.append(np.count_nonzero(np.diff(path)))
    assert 0.0 < np.mean(shortfalls) < 0.4 * np.mean(switches)


def _forward(values: processes.Floats, sigma: float, level: float, flip: float) -> float:
    """Return ln p(values | two levels) − ln p(values | no levels) in white noise."""
    gains = np.outer(values, (level, -level)) / sigma**2 - 0.5 * (level / sigma) ** 2
    belief, total = np.array([0.5, 0.5]), 0.0
    for likelihood in np.exp(gains):
        belief = (belief * (1.0 - flip) + belief[::-1] * flip) * likelihood
        total += np.log(belief.sum())
        belief /= belief.sum()
    return float(total)


def test_changed_terms_of_a_true_model_gain_half_a_unit_each() -> None:
    """By the theorem of Wilks, changes of three terms of a true model have a mean gain of 3/2."""
    gains = []
    for seed in range(10):
        sensor = sensors.draw_sensor(np.random.default_rng(seed), 600.0, RATE_HZ, ("gx",))
        observer = oracle.Observer(sensor, Effect("gx", "rate_ramp", {"R": 0.0}))
        rivals = Rivals(observer.y, observer.v, observer.baseline, RATE_HZ, None)
        found = rivals.all(without="")
        gains.append(found["retuned"])
        assert all(gain > found["retuned"] - 0.2 for gain in found.values())
    assert np.mean(gains) == pytest.approx(1.6, abs=1.2)
