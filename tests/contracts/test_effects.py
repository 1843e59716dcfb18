"""What every effect must pass, found by listing ``EFFECTS``: simulated data have the stated σ² and spectrum."""

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
from tests.contracts.effect_examples import AXIS, RATE_HZ, effect, example, model, without

N = 1 << 16
RUNS = 16
FACTORS = 2 ** np.arange(0, 12, 2)
COLUMN = AXES.index(AXIS)

NAMES = sorted(EFFECTS)
TAU0_S = 1.0 / RATE_HZ


def stated(name: str) -> np.ndarray:
    return model(name).avar(AXIS, FACTORS * TAU0_S, TAU0_S)


STATED = [name for name in NAMES if not np.isnan(stated(name)).any()]
EXACT = [name for name in NAMES if example(name).exact is not None]


def series(name: str, seed: int, n: int = N) -> np.ndarray:
    return model(name).simulate(n, RATE_HZ, seed)[:, COLUMN]


@cache
def records(name: str) -> np.ndarray:
    """[RUNS, N]"""
    return np.stack([series(name, seed) for seed in range(RUNS)])


def standard_errors(name: str, data: np.ndarray) -> np.ndarray:
    """How many standard errors the mean Allan variance of records [RUNS, N] is off the stated one, at each τ."""
    taus = FACTORS * TAU0_S
    found = np.array([allantools.oadev(one, rate=RATE_HZ, data_type="freq", taus=taus)[1] ** 2 for one in data])
    error = np.std(found, axis=0, ddof=1) / np.sqrt(RUNS)
    # and rounding, which is all there is where nothing is random
    return np.abs(found.mean(axis=0) - stated(name)) / (error + 1e-7 * stated(name) + 1e-24)


def test_every_file_of_the_folder_is_listed():
    modules = [
        m.name.rpartition(".")[2] for m in pkgutil.walk_packages(folder.__path__, f"{folder.__name__}.") if not m.ispkg
    ]
    assert sorted(modules) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_says_what_it_is(name):
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
    assert set(STATED) | set(EXACT) == set(NAMES)


@pytest.mark.parametrize("name", STATED)
def test_simulated_allan_variance_is_the_stated_one(name):
    # the worst of six τ beyond 5 standard errors of 16 runs (Student's t): once in 1500
    assert standard_errors(name, records(name)).max() < 5.0


@pytest.mark.parametrize("name", [name for name in STATED if stated(name).any()])
def test_a_level_wrong_by_three_percent_would_be_seen(name):
    assert standard_errors(name, 1.03 * records(name)).max() > 5.0


@pytest.mark.long
@pytest.mark.parametrize("name", STATED)
def test_simulated_spectrum_is_the_stated_one(name):
    # the Hann window keeps a walk's steep spectrum out of the higher frequencies; the lowest bins feel
    # the window and the detrending
    f, found = welch(records(name), RATE_HZ, nperseg=1024, detrend="linear")
    spectrum = model(name).spectrum(AXIS, TAU0_S)
    measured = found.mean(axis=0) / 2.0  # one-sided to two-sided
    keep = (f > 0.4) & (f < 0.5 * RATE_HZ)
    for line_hz, mean_square in spectrum.lines:
        near = np.abs(f - line_hz) < 0.3
        floor = model(name).two_sided_psd(AXIS, f[near], TAU0_S)
        power = 2.0 * np.sum(measured[near] - floor) * (f[1] - f[0])
        assert power == pytest.approx(mean_square, rel=0.02)
        keep &= ~near
    f, measured = f[keep], measured[keep]
    expected = model(name).two_sided_psd(AXIS, f, TAU0_S)
    if not expected.any():
        assert measured.max() < (1e-5 if spectrum.lines else 1e-12)  # the window's skirt of a line
        return
    # groups of 25 bins of 2000 segments: scatter 0.6 %; leakage costs another percent, and is all there is where the
    # spectrum is a ten-thousandth of its largest value
    for group in np.array_split(np.arange(f.size), 20):
        if expected[group].max() > 1e-4 * expected.max():
            assert np.mean(measured[group] / expected[group]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("name", EXACT)
def test_series_is_the_one_written_down_a_second_time(name):
    n = 5000
    drawn = model(name).start_stream(RATE_HZ, 3).draw_samples_with_temperature(n)
    base = without(name).simulate(n, RATE_HZ, 3)[:, COLUMN]
    expected = example(name).exact(base, np.arange(n) / RATE_HZ, drawn.temperature_c)
    np.testing.assert_allclose(drawn.values[:, COLUMN], expected, rtol=1e-9, atol=1e-12)
    assert not np.array_equal(drawn.values[:, COLUMN], base)


@pytest.mark.parametrize("name", NAMES)
@given(cuts=st.lists(st.integers(0, 700), min_size=1, max_size=12))
@settings(max_examples=12, deadline=None)
def test_any_cut_into_blocks_gives_the_same_series(name, cuts):
    n = 4500  # longer than what a stream makes at once
    stream = model(name).start_stream(RATE_HZ, 5)
    pieces = [stream.draw_samples_with_temperature(size) for size in [*cuts, max(0, n - sum(cuts))]]
    whole = model(name).start_stream(RATE_HZ, 5).draw_samples_with_temperature(max(n, sum(cuts)))
    np.testing.assert_array_equal(np.concatenate([piece.values for piece in pieces]), whole.values)
    np.testing.assert_array_equal(np.concatenate([piece.temperature_c for piece in pieces]), whole.temperature_c)


@pytest.mark.parametrize(
    "name", [n for n in NAMES if issubclass(EFFECTS[n], Source) and not EFFECTS[n].uses_temperature]
)
def test_a_source_by_itself_gives_what_the_stream_adds(name):
    started = effect(name).start_series(RATE_HZ, np.random.default_rng(5))
    pieces = [started.draw_next_samples(size, first) for size, first in ((1, 0), (0, 1), (900, 1), (99, 901))]
    whole = effect(name).start_series(RATE_HZ, np.random.default_rng(5)).draw_next_samples(1000)
    np.testing.assert_array_equal(np.concatenate(pieces), whole)


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_series_other_seed_another(name):
    np.testing.assert_array_equal(series(name, 1, 200), series(name, 1, 200))
    certain = name in ("bias", "rate_ramp", "bias_step", "turn_on_transient", "bias_curve")
    assert np.array_equal(series(name, 1, 200), series(name, 2, 200)) == certain


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"sample_rate_error"}))  # a clock is that of all axes
def test_effect_changes_its_axis_and_no_other(name):
    one, other = model(name).simulate(500, RATE_HZ, 1), without(name).simulate(500, RATE_HZ, 1)
    same = [np.array_equal(a, b) for a, b in zip(one.T, other.T, strict=True)]
    assert same == [axis != AXIS for axis in AXES]


@pytest.mark.parametrize("name", NAMES)
def test_is_read_back_as_it_was_written(name):
    written = model(name).to_toml()
    assert NoiseModel.from_toml(written) == model(name)
    assert NoiseModel.from_toml(written).to_toml() == written
    assert name in str(model(name))
    for parameter, (unit, _) in gyro_and_accel_units(EFFECTS[name]).items():
        if getattr(effect(name), parameter) is not None and unit not in ("1", "axis", "text"):
            assert f"{parameter} = " in str(model(name))
            assert unit in str(model(name))


@pytest.mark.parametrize("name", NAMES)
def test_what_may_be_absent_stays_absent(name):
    given_ = {key: example(name).parameters.get(key, 0.3) for key in required_parameters(EFFECTS[name])}
    bare = without(name) + NoiseModel({AXIS: (EFFECTS[name](**given_),)})
    assert NoiseModel.from_toml(bare.to_toml()) == bare


@pytest.mark.parametrize("name", NAMES)
def test_truth_is_ready_for_json_and_the_same_for_the_same_seed(name):
    def told() -> str:
        stream = model(name).start_stream(RATE_HZ, 4)
        stream.draw_next_samples(500)
        return json.dumps(stream.drawn_random_values(), allow_nan=False)

    assert told() == told()


def parameters(name: str, **changed: object) -> dict[str, object]:
    return {**{key: example(name).parameters.get(key, 0.3) for key in gyro_and_accel_units(EFFECTS[name])}, **changed}


NUMBERS = [(name, f.name) for name in NAMES for f in fields(EFFECTS[name]) if "quantity" in f.metadata]
WORDS = [(name, f.name) for name in NAMES for f in fields(EFFECTS[name]) if "choices" in f.metadata]


@pytest.mark.parametrize(("name", "parameter"), WORDS)
@pytest.mark.parametrize("bad", [1.0, True, "unknown", ["iir"]])
def test_refuses_what_is_no_choice(name, parameter, bad):
    with pytest.raises(ConfigError, match=f"^{name}: {parameter} must be one of "):
        EFFECTS[name](**parameters(name, **{parameter: bad}))


@pytest.mark.parametrize(("name", "parameter"), NUMBERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, "1", True, [1.0]])
def test_refuses_what_is_no_number(name, parameter, bad):
    with pytest.raises(ConfigError, match=f"^{name}: {parameter} must be a finite number, is "):
        EFFECTS[name](**parameters(name, **{parameter: bad}))


@pytest.mark.parametrize(("name", "parameter"), NUMBERS)
def test_refuses_what_is_out_of_bounds(name, parameter):
    allows = {f.name: f.metadata for f in fields(EFFECTS[name])}[parameter]
    made: Effect
    if allows["signed"]:
        made = EFFECTS[name](**parameters(name, **{parameter: -0.3}))
        assert getattr(made, parameter) == -0.3
    else:
        with pytest.raises(ConfigError, match=f"{parameter} must not be negative, is -1.0"):
            EFFECTS[name](**parameters(name, **{parameter: -1.0}))
    if allows["positive"]:
        with pytest.raises(ConfigError, match=f"{parameter} must be above zero"):
            EFFECTS[name](**parameters(name, **{parameter: 0.0}))
    if allows["most"] < np.inf:
        with pytest.raises(ConfigError, match=f"{parameter} must be at most"):
            EFFECTS[name](**parameters(name, **{parameter: allows["most"] + 1}))
    if allows["whole"]:
        with pytest.raises(ConfigError, match=f"{parameter} must be a whole number"):
            EFFECTS[name](**parameters(name, **{parameter: 1.5}))


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_parameter_is_named(name):
    for parameter in required_parameters(EFFECTS[name]):
        rest = [key for key in required_parameters(EFFECTS[name]) if key != parameter]
        lines = [f'{key} = "az"' if key == "source" else f"{key} = 0.3" for key in rest]
        with pytest.raises(ConfigError, match=f"^gz.{name}: {parameter} is missing$"):
            NoiseModel.from_toml("\n".join([f"[gz.{name}]", *lines]))
