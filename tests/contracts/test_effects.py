"""Tests that every effect in ``EFFECTS`` has to pass.

The main ones check that simulated data have the stated Allan variance and spectrum.
"""

import inspect
import json
import pkgutil
from dataclasses import fields
from functools import cache

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import welch

import monitor.noise.effects as folder
from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.noise.effect import (
    AxisLeak,
    Effect,
    Source,
    Transform,
    WhiteNoiseGain,
    gyro_and_accel_units,
    required_parameters,
)
from monitor.noise.effects import EFFECTS, TRANSFORM_ORDER, AxisPermutation, HeavyTails
from monitor.noise.model import NoiseModel
from tests.contracts.effect_examples import (
    AXIS,
    RATE_HZ,
    get_example,
    make_effect,
    make_model,
    make_model_without_effect,
)
from tests.support.noise_series import draw_next_samples

N = 1 << 16
RUNS = 16
FACTORS = 2 ** np.arange(0, 12, 2)
COLUMN = AXES.index(AXIS)

NAMES = sorted(EFFECTS)
TAU0_S = 1.0 / RATE_HZ


def get_stated_avar(name: str) -> np.ndarray:
    return make_model(name).avar(AXIS, FACTORS * TAU0_S, TAU0_S)


WITH_STATED_AVAR = [name for name in NAMES if not np.isnan(get_stated_avar(name)).any()]
WITH_EXPECTED_SERIES = [name for name in NAMES if get_example(name).expected_series is not None]


def simulate_axis(name: str, seed: int, n: int = N) -> np.ndarray:
    return make_model(name).simulate(n, RATE_HZ, seed)[:, COLUMN]


@cache
def simulate_records(name: str) -> np.ndarray:
    """Return simulated series of an effect, shape [RUNS, N]."""
    return np.stack([simulate_axis(name, seed) for seed in range(RUNS)])


def compute_standard_errors(name: str, data: np.ndarray) -> np.ndarray:
    """Return the deviation of the mean Allan variance from the stated one, in standard errors, at each τ.

    ``data`` has the shape [RUNS, N].
    """
    taus = FACTORS * TAU0_S
    avar = np.array([allantools.oadev(row, rate=RATE_HZ, data_type="freq", taus=taus)[1] ** 2 for row in data])
    error = np.std(avar, axis=0, ddof=1) / np.sqrt(RUNS)
    # rounding is the only error of effects that are not random
    return np.abs(avar.mean(axis=0) - get_stated_avar(name)) / (error + 1e-7 * get_stated_avar(name) + 1e-24)


def test_every_file_of_the_folder_is_listed():
    modules = [
        m.name.rpartition(".")[2] for m in pkgutil.walk_packages(folder.__path__, f"{folder.__name__}.") if not m.ispkg
    ]
    assert sorted(modules) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_effect_has_name_description_units_and_example(name):
    kind = EFFECTS[name]
    assert kind.name == name
    assert kind.description.endswith(".")
    assert kind.description.count("\n") == 0
    assert kind.description[:-1].count(". ") == 0
    assert all(gyro and accelerometer for gyro, accelerometer in gyro_and_accel_units(kind).values())
    assert inspect.getdoc(inspect.getmodule(kind))
    assert ">>>" in inspect.getdoc(kind)
    assert issubclass(kind, (Source, AxisLeak, Transform, WhiteNoiseGain, AxisPermutation, HeavyTails))
    assert issubclass(kind, Transform) == (kind in TRANSFORM_ORDER)


def test_each_effect_has_a_variance_or_a_series_to_compare_with():
    assert set(WITH_STATED_AVAR) | set(WITH_EXPECTED_SERIES) == set(NAMES)


@pytest.mark.parametrize("name", WITH_STATED_AVAR)
def test_simulated_allan_variance_equals_the_stated_one(name):
    # the largest of six τ exceeds 5 standard errors of 16 runs once in 1500 tests (Student's t)
    assert compute_standard_errors(name, simulate_records(name)).max() < 5.0
    if get_stated_avar(name).any():  # a level that is wrong by 3 % would be detected
        assert compute_standard_errors(name, 1.03 * simulate_records(name)).max() > 5.0


@pytest.mark.long
@pytest.mark.parametrize("name", WITH_STATED_AVAR)
def test_simulated_spectrum_equals_the_stated_one(name):
    # The Hann window prevents leakage from the steep spectrum of a random walk to higher frequencies. The window and
    # the detrending change the lowest bins, so these are left out.
    f, psd = welch(simulate_records(name), RATE_HZ, nperseg=1024, detrend="linear")
    spectrum = make_model(name).spectrum(AXIS, TAU0_S)
    measured = psd.mean(axis=0) / 2.0  # one-sided to two-sided
    keep = (f > 0.4) & (f < 0.5 * RATE_HZ)
    for line_hz, mean_square in spectrum.lines:
        near = np.abs(f - line_hz) < 0.3
        background = make_model(name).two_sided_psd(AXIS, f[near], TAU0_S)
        power = 2.0 * np.sum(measured[near] - background) * (f[1] - f[0])
        assert power == pytest.approx(mean_square, rel=0.02)
        keep &= ~near
    f, measured = f[keep], measured[keep]
    expected = make_model(name).two_sided_psd(AXIS, f, TAU0_S)
    if not expected.any():
        assert measured.max() < (1e-5 if spectrum.lines else 1e-12)  # leakage of a spectral line
        return
    # The mean over 25 bins of 2000 segments scatters by 0.6 %, and leakage adds one percent. Where the spectrum is
    # below a ten-thousandth of its maximum, only leakage is measured.
    for group in np.array_split(np.arange(f.size), 20):
        if expected[group].max() > 1e-4 * expected.max():
            assert np.mean(measured[group] / expected[group]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("name", WITH_EXPECTED_SERIES)
def test_series_equals_the_independently_computed_series(name):
    n = 5000
    drawn = make_model(name).start_stream(RATE_HZ, 3).draw_samples_with_temperature(n)
    base = make_model_without_effect(name).simulate(n, RATE_HZ, 3)[:, COLUMN]
    expected = get_example(name).expected_series(base, np.arange(n) / RATE_HZ, drawn.temperature_c)
    np.testing.assert_allclose(drawn.values[:, COLUMN], expected, rtol=1e-9, atol=1e-12)
    assert not np.array_equal(drawn.values[:, COLUMN], base)


@pytest.mark.parametrize("name", NAMES)
@given(cuts=st.lists(st.integers(0, 700), min_size=1, max_size=12))
@settings(max_examples=12, deadline=None)
def test_series_does_not_depend_on_the_division_into_blocks(name, cuts):
    n = 4500  # longer than the block that a stream draws at once
    stream = make_model(name).start_stream(RATE_HZ, 5)
    pieces = [stream.draw_samples_with_temperature(size) for size in [*cuts, max(0, n - sum(cuts))]]
    expected = make_model(name).start_stream(RATE_HZ, 5).draw_samples_with_temperature(max(n, sum(cuts)))
    np.testing.assert_array_equal(np.concatenate([piece.values for piece in pieces]), expected.values)
    np.testing.assert_array_equal(np.concatenate([piece.temperature_c for piece in pieces]), expected.temperature_c)


@pytest.mark.parametrize(
    "name", [n for n in NAMES if issubclass(EFFECTS[n], Source) and not EFFECTS[n].uses_temperature]
)
def test_source_gives_the_same_series_for_any_division(name):
    started = make_effect(name).start_series(RATE_HZ, np.random.default_rng(5))
    pieces = [draw_next_samples(started, size, first) for size, first in ((1, 0), (0, 1), (900, 1), (99, 901))]
    expected = draw_next_samples(make_effect(name).start_series(RATE_HZ, np.random.default_rng(5)), 1000)
    np.testing.assert_array_equal(np.concatenate(pieces), expected)


@pytest.mark.parametrize("name", NAMES)
def test_series_depends_on_the_seed_only_for_random_effects(name):
    np.testing.assert_array_equal(simulate_axis(name, 1, 200), simulate_axis(name, 1, 200))
    not_random = name in ("bias", "rate_ramp", "bias_step", "turn_on_transient", "bias_curve")
    assert np.array_equal(simulate_axis(name, 1, 200), simulate_axis(name, 2, 200)) == not_random


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"sample_rate_error"}))  # it changes all axes, which share a clock
def test_effect_changes_only_its_axis(name):
    with_effect, without_effect = (
        make_model(name).simulate(500, RATE_HZ, 1),
        make_model_without_effect(name).simulate(500, RATE_HZ, 1),
    )
    same = [np.array_equal(a, b) for a, b in zip(with_effect.T, without_effect.T, strict=True)]
    assert same == [axis != AXIS for axis in AXES]


@pytest.mark.parametrize("name", NAMES)
def test_model_survives_a_round_trip_through_toml(name):
    written = make_model(name).to_toml()
    assert NoiseModel.from_toml(written) == make_model(name)
    assert NoiseModel.from_toml(written).to_toml() == written
    assert name in str(make_model(name))
    for parameter, (unit, _) in gyro_and_accel_units(EFFECTS[name]).items():
        if getattr(make_effect(name), parameter) is not None and unit not in ("1", "axis", "text"):
            assert f"{parameter} = " in str(make_model(name))
            assert unit in str(make_model(name))


@pytest.mark.parametrize("name", NAMES)
def test_optional_parameters_stay_absent_in_a_round_trip(name):
    required = {key: get_example(name).parameters.get(key, 0.3) for key in required_parameters(EFFECTS[name])}
    minimal = make_model_without_effect(name) + NoiseModel({AXIS: (EFFECTS[name](**required),)})
    assert NoiseModel.from_toml(minimal.to_toml()) == minimal


@pytest.mark.parametrize("name", NAMES)
def test_drawn_random_values_fit_into_json_and_depend_only_on_the_seed(name):
    def draw_and_dump() -> str:
        stream = make_model(name).start_stream(RATE_HZ, 4)
        stream.draw_next_samples(500)
        return json.dumps(stream.drawn_random_values(), allow_nan=False)

    assert draw_and_dump() == draw_and_dump()


def make_parameters(name: str, **changed: object) -> dict[str, object]:
    """Return valid parameters of an effect, with some of them replaced."""
    return {
        **{key: get_example(name).parameters.get(key, 0.3) for key in gyro_and_accel_units(EFFECTS[name])},
        **changed,
    }


NUMERIC_PARAMETERS = [(name, f.name) for name in NAMES for f in fields(EFFECTS[name]) if "quantity" in f.metadata]
TEXT_PARAMETERS = [(name, f.name) for name in NAMES for f in fields(EFFECTS[name]) if "choices" in f.metadata]


@pytest.mark.parametrize(("name", "parameter"), TEXT_PARAMETERS)
@pytest.mark.parametrize("bad", [1.0, True, "unknown", ["iir"]])
def test_unknown_choice_is_refused(name, parameter, bad):
    with pytest.raises(ConfigError, match=f"^{name}: {parameter} must be one of "):
        EFFECTS[name](**make_parameters(name, **{parameter: bad}))


@pytest.mark.parametrize(("name", "parameter"), NUMERIC_PARAMETERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, "1", True, [1.0]])
def test_value_that_is_no_finite_number_is_refused(name, parameter, bad):
    with pytest.raises(ConfigError, match=f"^{name}: {parameter} must be a finite number, is "):
        EFFECTS[name](**make_parameters(name, **{parameter: bad}))


@pytest.mark.parametrize(("name", "parameter"), NUMERIC_PARAMETERS)
def test_number_out_of_bounds_is_refused(name, parameter):
    limits = {f.name: f.metadata for f in fields(EFFECTS[name])}[parameter]
    instance: Effect
    if limits["signed"]:
        instance = EFFECTS[name](**make_parameters(name, **{parameter: -0.3}))
        assert getattr(instance, parameter) == -0.3
    else:
        with pytest.raises(ConfigError, match=f"{parameter} must not be negative, is -1.0"):
            EFFECTS[name](**make_parameters(name, **{parameter: -1.0}))
    if limits["positive"]:
        with pytest.raises(ConfigError, match=f"{parameter} must be above zero"):
            EFFECTS[name](**make_parameters(name, **{parameter: 0.0}))
    if limits["most"] < np.inf:
        with pytest.raises(ConfigError, match=f"{parameter} must be at most"):
            EFFECTS[name](**make_parameters(name, **{parameter: limits["most"] + 1}))
    if limits["whole"]:
        with pytest.raises(ConfigError, match=f"{parameter} must be a whole number"):
            EFFECTS[name](**make_parameters(name, **{parameter: 1.5}))


@pytest.mark.parametrize("name", NAMES)
def test_missing_parameter_is_named(name):
    for parameter in required_parameters(EFFECTS[name]):
        others = [key for key in required_parameters(EFFECTS[name]) if key != parameter]
        lines = [f'{key} = "az"' if key == "source" else f"{key} = 0.3" for key in others]
        with pytest.raises(ConfigError, match=f"^gz.{name}: {parameter} is missing$"):
            NoiseModel.from_toml("\n".join([f"[gz.{name}]", *lines]))
