"""Which axes are said to depend on temperature, how large a loop is said to be, and silence on noise alone."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.drift.thermal.bias_temperature_tests import find_hysteresis, find_temperature_dependence, heating_direction
from monitor.drift.thermal.interval_means import IntervalMeans
from tests.monitor.drift.cycles import NOISES, SHAPES, chamber_means, drift

COUNT = 75


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("law", ["linear", "cubic"])
def test_a_bias_of_temperature_is_named_in_every_cycle(shape: str, law: str) -> None:
    noise = drift("random walk", COUNT, np.random.default_rng(1))
    found = find_temperature_dependence(chamber_means(shape, noise, law, 50.0 * noise.std()))
    assert found is not None
    assert found.explains_most_variance
    assert found.share > 0.99
    assert found.form == "cubic"
    assert found.one_way == (shape == "heating")


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("shape", SHAPES)
def test_noise_is_not_said_to_depend_on_temperature(shape: str, noise: str) -> None:
    for seed in range(3):
        means = chamber_means(shape, drift(noise, COUNT, np.random.default_rng(seed)))
        assert find_temperature_dependence(means) is None
        loop = find_hysteresis(means)
        assert (loop is None) == (shape == "heating")
        assert loop is None or not loop.hysteresis_is_significant


@pytest.mark.parametrize("law", ["loop", "lag", "play"])
@pytest.mark.parametrize("shape", SHAPES[:-1])
def test_hysteresis_has_its_size(shape: str, law: str) -> None:
    curve = chamber_means(shape, drift("white", COUNT, np.random.default_rng(4)), "cubic", 200.0).bias
    assert not find_hysteresis(chamber_means(shape, curve)).hysteresis_is_significant  # type: ignore[union-attr]
    found = find_hysteresis(chamber_means(shape, curve, law, 100.0))
    assert found is not None
    assert found.hysteresis_is_significant
    assert found.size == pytest.approx(100.0, rel=0.12)


def test_a_steady_drift_is_neither_temperature_nor_hysteresis() -> None:
    means = chamber_means("ramp", drift("white", COUNT, np.random.default_rng(5)) + np.linspace(0.0, 100.0, COUNT))
    assert find_temperature_dependence(means) is None
    loop = find_hysteresis(means)
    assert loop is not None
    assert not loop.hysteresis_is_significant


def test_a_loop_alone_is_temperature_too() -> None:
    found = find_temperature_dependence(
        chamber_means("ramp", drift("white", COUNT, np.random.default_rng(6)), "loop", 100.0)
    )
    assert found is not None
    assert found.form == "cubic with hysteresis"
    assert found.share > 0.95


def test_missing_means_and_units_do_not_matter() -> None:
    noise = drift("random walk", COUNT, np.random.default_rng(7))
    means = chamber_means("sine", noise, "cubic", 100.0)
    bias, warmth = 1e-6 * means.bias, means.temperature_c.copy()
    bias[20:26], warmth[40] = np.nan, np.nan
    found = find_temperature_dependence(replace(means, bias=bias, temperature_c=warmth))
    whole = find_temperature_dependence(means)
    assert found is not None
    assert whole is not None
    assert found.share == pytest.approx(whole.share, abs=0.01)
    looped = replace(chamber_means("sine", noise, "play", 100.0), temperature_c=warmth)
    size = find_hysteresis(replace(looped, bias=np.where(np.isfinite(bias), 1e-6 * looped.bias, np.nan)))
    assert size is not None
    assert size.size == pytest.approx(1e-4, rel=0.15)


def test_many_means_are_averaged_and_few_are_no_answer() -> None:
    noise = drift("white", 2000, np.random.default_rng(8))
    found = find_hysteresis(chamber_means("ramp", noise, "loop", 20.0))
    assert found is not None
    assert found.size == pytest.approx(20.0, rel=0.15)
    short = IntervalMeans(1.0, np.arange(8.0), np.ones(8), np.array([0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, 0.0]))
    assert find_hysteresis(short) is None
    assert find_temperature_dependence(short) is None


def test_a_dwell_keeps_the_direction_and_noise_is_no_reversal() -> None:
    rng = np.random.default_rng(9)
    course = np.concatenate([np.linspace(0.0, 10.0, 30), np.full(20, 10.0), np.linspace(10.0, 0.0, 30)])
    direction = heating_direction(course + 0.02 * rng.standard_normal(course.size))
    assert set(direction[:28]) == {1.0}
    assert set(direction[52:]) == {-1.0}
    assert np.count_nonzero(np.diff(direction)) == 1
    assert not heating_direction(np.full(10, 25.0)).any()
