"""Tests of noise models: TOML files, errors in one line, seeds and sums."""

import numpy as np
import pytest

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.noise.effects import EFFECTS, AngleRandomWalk, ConstantBias, GSensitivity, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.noise.temperature import Temperature

MODELS = sorted((CONFIG_FOLDER / "models").glob("*.toml"))


@pytest.mark.parametrize("path", MODELS, ids=lambda p: p.stem)
def test_shipped_models_are_read_and_written_back(path):
    model = NoiseModel.from_toml(path.read_text(encoding="utf-8"))
    assert model.sample_rate_hz
    assert set(model.effects) == set(AXES)
    assert NoiseModel.from_toml(model.to_toml()) == model


def test_models_are_shipped():
    assert MODELS


def test_wildcards_select_axes_of_one_kind_and_add_effects():
    model = NoiseModel.from_toml('[gz.bias]\nvalue = 1.0\n["g*".angle_random_walk]\nN = 2e-4')
    assert model.effects == {
        "gx": (AngleRandomWalk(N=2e-4),),
        "gy": (AngleRandomWalk(N=2e-4),),
        "gz": (ConstantBias(value=1.0), AngleRandomWalk(N=2e-4)),
    }


def test_repeated_effect_is_an_array_of_tables():
    text = "[[gx.bias]]\nvalue = 1.0\n[[gx.bias]]\nvalue = 2.0\n"
    model = NoiseModel.from_toml(text)
    assert model.effects["gx"] == (ConstantBias(value=1.0), ConstantBias(value=2.0))
    assert NoiseModel.from_toml(model.to_toml()) == model


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[gq.bias]\nvalue = 1", 'unknown axis "gq"; did you mean "gz"?'),
        ("[gz.angle_randomwalk]\nN = 1", 'gz: unknown effect "angle_randomwalk"; did you mean "angle_random_walk"?'),
        ("[gz.bias]\nvalu = 1", 'gz.bias: unknown parameter "valu"; did you mean "value"?'),
        ("[gz.angle_random_walk]\nN = -1", "gz.angle_random_walk: N must not be negative, is -1"),
        ('["g*".angle_random_walk]\nN = true', "g*.angle_random_walk: N must be a finite number, is True"),
        ("[gz.bias]", "gz.bias: value is missing"),
        ("[gz]\nbias = 3", "gz.bias must be a table with value"),
        ("gz = 1", "gz must be a table of effects, such as [gz.angle_random_walk]"),
        ("sample_rate = 0", "sample_rate: 0 Hz is outside the supported range 0.001 Hz to 1 MHz"),
        ("gz = [", "not TOML: "),
        ("[gz.sinusoidal]\namplitude = 1\nfrequency = 0", "gz.sinusoidal: frequency must be above zero, is 0"),
        (
            "sample_rate = 100\n[gz.sinusoidal]\namplitude = 1\nfrequency = 50",
            "gz.sinusoidal: frequency must be below 50 Hz, half the sample rate, is 50",
        ),
        (
            "sample_rate = 100\n[gz.bandwidth_limit]\ncutoff = 60\norder = 2",
            "gz.bandwidth_limit: cutoff must be below 50 Hz, half the sample rate, is 60",
        ),
        (
            '[gz.g_sensitivity]\nsource = "aq"\ncoefficient = 1',
            "gz.g_sensitivity: source must be one of gx, gy, gz, ax, ay, az, is 'aq'; did you mean \"a",
        ),
        (
            '[gz.g_sensitivity]\nsource = "gx"\ncoefficient = 1',
            "gz.g_sensitivity: source must be an accelerometer, is 'gx'",
        ),
        (
            '[ax.g_sensitivity]\nsource = "az"\ncoefficient = 1',
            "ax.g_sensitivity: belongs on a gyroscope, not on ax",
        ),
        (
            '[gz.cross_axis]\nsource = "az"\ncoefficient = 1',
            "gz.cross_axis: source must be a gyroscope as gz is, is 'az'",
        ),
        (
            '["a*".cross_axis]\nsource = "az"\ncoefficient = 1',
            "az.cross_axis: source must be another axis than az itself",
        ),
        (
            'sample_rate = 100\n[gz.cross_axis]\nsource = "gx"\ncoefficient = 1',
            "gz.cross_axis: the model has no effect on its source gx",
        ),
        (
            "sample_rate = 100\n[gz.noise_step]\ntime = 1\nratio = 2",
            "gz.noise_step: gz has no angle_random_walk to multiply",
        ),
        (
            "[gz.sample_rate_error]\nratio = 1.01\n[ax.sample_rate_error]\nratio = 0.99",
            "sample_rate_error: a recording has one clock, but ratio is 0.99 and 1.01",
        ),
        ("[temperature]\nswing = 3", "temperature: mean is missing"),
        ("[temperature]\nmean = 3\nswin = 3", 'temperature: unknown parameter "swin"; did you mean "swing"?'),
        ("[temperature]\nmean = 3\nwander = 3", "temperature: wander needs a wander_time"),
        (
            "[temperature]\nmean = 3\nswing = 3\nperiod = 0",
            "temperature: period must be above zero, is 0",
        ),
        ("temperature = 25", "temperature must be a table with mean, swing, period, wander, wander_time"),
    ],
)
def test_invalid_model_is_refused_in_one_line(text, message):
    with pytest.raises(ConfigError) as error:
        NoiseModel.from_toml(text)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_temperature_is_needed_for_simulation_and_not_for_reading():
    model = NoiseModel.from_toml("sample_rate = 100\n[gz.temperature_bias]\ncoefficient = 1\nreference = 20")
    with pytest.raises(ConfigError, match=r"^gz.temperature_bias: no temperature: .* no table \[temperature\]"):
        model.start_stream(100.0, 0)
    assert model.simulate(2, 100.0, 0, np.array([21.0, 22.0]))[:, 2].tolist() == [1.0, 2.0]


def test_sum_keeps_the_first_rate_and_temperature():
    model = NoiseModel({}, 100.0, Temperature(mean=20.0))
    assert model + NoiseModel({}, 50.0, Temperature(mean=30.0)) == model
    assert NoiseModel() + model == model
    with pytest.raises(TypeError):
        model + 1


def test_printed_model_is_a_table_with_units():
    model = NoiseModel(
        {
            "gz": (AngleRandomWalk(N=1.5e-4), GSensitivity(source="az", coefficient=2e-5)),
            "az": (ConstantBias(value=9.8),),
        },
        100.0,
        Temperature(mean=25.0, swing=3.0, period=86400.0),
    )
    assert str(model).splitlines() == [
        "sample rate 100 Hz",
        "temperature mean = 25 °C, swing = 3 °C, period = 86400 s",
        "axis  effect             parameters",
        "gz    angle_random_walk  N = 0.00015 rad/√s",
        "gz    g_sensitivity      source = az, coefficient = 2e-05 rad/s per m/s²",
        "az    bias               value = 9.8 m/s²",
    ]


def test_added_effect_changes_no_other_series():
    white = NoiseModel({"gz": (AngleRandomWalk(N=1e-4),)})
    walk = NoiseModel({"gz": (RateRandomWalk(K=1e-5),), "ax": (AngleRandomWalk(N=1e-3),)})
    both = (walk + white).simulate(500, 100.0, 3)
    np.testing.assert_allclose(
        both, white.simulate(500, 100.0, 3) + walk.simulate(500, 100.0, 3), rtol=1e-12, atol=1e-18
    )


def test_axes_and_equal_effects_are_independent():
    model = NoiseModel(dict.fromkeys(AXES, (AngleRandomWalk(N=1.0),)))
    correlation = np.corrcoef(model.simulate(20_000, 1.0, 0).T) - np.eye(6)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(20_000)
    twice = NoiseModel({"gx": (AngleRandomWalk(N=1.0), AngleRandomWalk(N=1.0))})
    # Independent variances add up to 2, whereas the same series twice gives 4. χ² of 20 000 determines 1 %.
    assert twice.simulate(20_000, 1.0, 0)[:, 0].var() == pytest.approx(2.0, rel=0.05)


def test_series_depends_on_seed_not_on_blocks():
    model = NoiseModel.from_toml(MODELS[0].read_text(encoding="utf-8"))
    stream = model.start_stream(100.0, 7)
    pieces = np.concatenate([stream.draw_next_samples(n) for n in (1, 0, 9, 490)])
    np.testing.assert_array_equal(pieces, model.simulate(500, 100.0, 7))
    assert not np.array_equal(pieces, model.simulate(500, 100.0, 8))


def test_avar_and_psd_are_sums_over_an_axis():
    model = NoiseModel({"gx": tuple(EFFECTS[n](1.0) for n in ("angle_random_walk", "quantization_noise"))})
    tau = np.array([0.1, 1.0])
    np.testing.assert_allclose(model.avar("gx", tau, 0.1), 1.0 / tau + 3.0 / tau**2)
    assert model.avar("gy", tau, 0.1).tolist() == [0.0, 0.0]
    assert model.two_sided_psd("gx", np.array([5.0]), 0.1)[0] == pytest.approx(1.0 + 40.0)


def test_all_mistakes_of_a_model_file_are_reported_at_once() -> None:
    text = """
sample_rate = -1.0
[temperature]
mena = 20.0
[gq.bias]
value = 1.0
[gx.angle_random_walk]
M = 1.0
[gy.angel_random_walk]
N = 1.0
[gz.bias]
value = "large"
[gz.narrowband]
sigma = 1e-3
"""
    with pytest.raises(ConfigError) as caught:
        NoiseModel.from_toml(text)
    starts = [
        "sample_rate: -1 Hz is outside the supported range",
        "temperature: ",
        'unknown axis "gq"',
        'gx.angle_random_walk: unknown parameter "M"',
        'gy: unknown effect "angel_random_walk"; did you mean "angle_random_walk"',
        "gz.bias: ",
        "gz.narrowband: frequency is missing",
        "gz.narrowband: bandwidth is missing",
    ]
    assert len(caught.value.mistake_lines) == len(starts), caught.value.mistake_lines
    for line, start in zip(caught.value.mistake_lines, starts, strict=True):
        assert line.startswith(start), line
