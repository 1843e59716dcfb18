"""Tests of the simulation: transforms, cross-axis effects, effects added later, drawn values, temperature, memory."""

import json
import tracemalloc

import numpy as np
import pytest
from scipy.signal import hilbert, welch
from scipy.stats import kstest

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.noise.effects import (
    TRANSFORM_ORDER,
    AngleRandomWalk,
    AxisPermutation,
    BandwidthLimit,
    BiasInstability,
    BiasStep,
    ConstantBias,
    CrossAxis,
    ExponentiallyCorrelated,
    GSensitivity,
    Narrowband,
    NoiseStep,
    Outliers,
    PoissonSteps,
    QuantizationNoise,
    RandomSampleHold,
    RandomTelegraph,
    RateRamp,
    RateRandomWalk,
    Resolution,
    SampleRateError,
    Saturation,
    ScaleFactor,
    Sinusoidal,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
    WanderingLine,
)
from monitor.noise.model import NoiseModel
from monitor.noise.temperature import Temperature

RATE_HZ = 100.0


def test_transforms_act_in_a_fixed_order():
    assert [kind.name for kind in TRANSFORM_ORDER] == [
        "bandwidth_limit", "scale_factor", "sample_rate_error", "saturation", "resolution", "sample_hold",
        "unit_error",
    ]  # fmt: skip
    axis = (Resolution(step=0.4), Saturation(limit=1.0), ConstantBias(value=0.7), ScaleFactor(factor=2.0))
    # 0.7 · 2 = 1.4 is clipped to 1.0 and rounded to 0.8. Any other order gives another value.
    assert NoiseModel({"gx": axis}).simulate(3, RATE_HZ, 0)[:, 0].tolist() == [0.8, 0.8, 0.8]


def test_cross_axis_effects_read_the_source_without_its_own_cross_axis_effects():
    both = NoiseModel(
        {
            "gx": (AngleRandomWalk(N=1.0), CrossAxis(source="gy", coefficient=0.5), Saturation(limit=9.0)),
            "gy": (AngleRandomWalk(N=1.0), CrossAxis(source="gx", coefficient=0.25), Resolution(step=3.0)),
        }
    )
    alone = NoiseModel(
        {
            "gx": (AngleRandomWalk(N=1.0), Saturation(limit=9.0)),
            "gy": (AngleRandomWalk(N=1.0), Resolution(step=3.0)),
        }
    )
    bare = NoiseModel({"gx": (AngleRandomWalk(N=1.0),), "gy": (AngleRandomWalk(N=1.0),)}).simulate(5000, RATE_HZ, 2)
    read, mixed = alone.simulate(5000, RATE_HZ, 2), both.simulate(5000, RATE_HZ, 2)
    np.testing.assert_allclose(mixed[:, 0], np.clip(bare[:, 0] + 0.5 * read[:, 1], -9.0, 9.0))
    np.testing.assert_allclose(mixed[:, 1], 3.0 * np.rint((bare[:, 1] + 0.25 * read[:, 0]) / 3.0))


def test_filter_acts_before_leaks_are_added():
    filtered = {
        "gx": (AngleRandomWalk(N=1.0), BandwidthLimit(cutoff=4.0, order=2, floor=0.05), ScaleFactor(factor=1.5)),
        "gy": (AngleRandomWalk(N=1.0), BandwidthLimit(cutoff=20.0)),
    }
    leaking = NoiseModel(filtered) + NoiseModel({"gx": (CrossAxis(source="gy", coefficient=0.5),)})
    alone, mixed = NoiseModel(filtered).simulate(65_536, RATE_HZ, 2), leaking.simulate(65_536, RATE_HZ, 2)
    np.testing.assert_allclose(mixed[:, 0], alone[:, 0] + 1.5 * 0.5 * alone[:, 1])
    f_hz, measured = welch(mixed[:, 0], RATE_HZ, nperseg=256, return_onesided=False)
    wanted = (np.abs(f_hz) / RATE_HZ > 0.01) & (np.abs(f_hz) / RATE_HZ < 0.49)
    expected = leaking.two_sided_psd("gx", np.abs(f_hz[wanted]), 1.0 / RATE_HZ)
    np.testing.assert_allclose(measured[wanted], expected, rtol=0.25)  # four standard deviations


def test_held_samples_do_not_depend_on_cross_axis_effects():
    axis = (AngleRandomWalk(N=1.0), RandomSampleHold(fraction=0.5))
    model = NoiseModel({"gx": axis, "gy": (ConstantBias(value=0.0),)})
    leaking = model + NoiseModel({"gx": (CrossAxis(source="gy", coefficient=1.0),)})
    np.testing.assert_array_equal(model.simulate(5000, RATE_HZ, 2), leaking.simulate(5000, RATE_HZ, 2))


@pytest.mark.parametrize(
    "effect",
    [
        AngleRandomWalk(N=1.0),
        Sinusoidal(amplitude=1.0, frequency=7.0, phase=0.3),
        BiasStep(time=30.0, height=2.0),
        NoiseStep(time=30.0, ratio=3.0),
        ScaleFactor(factor=2.0),
        Resolution(step=0.5),
        CrossAxis(source="gx", coefficient=0.5),
        GSensitivity(source="az", coefficient=0.5),
    ],
    ids=lambda effect: effect.name,
)
def test_effect_added_before_the_first_sample_equals_an_effect_of_the_model(effect):
    model = NoiseModel({axis: (AngleRandomWalk(N=0.5), Saturation(limit=4.0)) for axis in AXES})
    running = model.start_stream(RATE_HZ, 1)
    running.add_effect("gz", effect)
    whole = (model + NoiseModel({"gz": (effect,)})).simulate(5000, RATE_HZ, 1)
    np.testing.assert_array_equal(running.draw_next_samples(5000), whole)


def test_added_effect_acts_from_the_next_sample():
    model = NoiseModel(
        {"gz": (AngleRandomWalk(N=0.5), BandwidthLimit(cutoff=20.0, order=2)), "gx": (ConstantBias(value=1.0),)}
    )
    plain = model.simulate(6000, RATE_HZ, 1)
    running = model.start_stream(RATE_HZ, 1)
    np.testing.assert_array_equal(running.draw_next_samples(3000), plain[:3000])
    running.add_effect("gx", ConstantBias(value=2.0))
    running.add_effect("gx", BiasStep(time=40.0, height=8.0))
    running.add_effect("gx", RateRamp(R=1.0))
    running.add_effect("gz", CrossAxis(source="gx", coefficient=1e-12))
    later = running.draw_next_samples(3000)
    np.testing.assert_allclose(later[:, 2], plain[3000:, 2], atol=1e-9)  # the filter was not restarted
    k = np.arange(3000)
    np.testing.assert_allclose(later[:, 0], 3.0 + 8.0 * (k >= 1000) + k / RATE_HZ)


def test_impossible_effect_is_refused_and_changes_nothing():
    model = NoiseModel({"gz": (ConstantBias(value=1.0),)})
    running = model.start_stream(RATE_HZ, 1)
    for axis, effect, message in (
        ("gq", ConstantBias(value=1.0), 'unknown axis "gq"'),
        ("gz", Sinusoidal(amplitude=1.0, frequency=60.0), "gz.sinusoidal: frequency must be below 50 Hz"),
        (
            "gz",
            SampleRateError(ratio=2.0),
            "gz.sample_rate_error: the sample rate error of a running stream cannot change",
        ),
        ("gz", NoiseStep(time=1.0, ratio=2.0), "gz.noise_step: gz has no angle_random_walk"),
        ("gz", CrossAxis(source="gx", coefficient=2.0), "gz.cross_axis: the model has no effect on its source gx"),
        ("gz", TemperatureBias(coefficient=1.0, reference=2.0), "gz.temperature_bias: no temperature"),
    ):
        with pytest.raises(ConfigError, match=f"^{message}"):
            running.add_effect(axis, effect)
    np.testing.assert_array_equal(running.draw_next_samples(10), model.simulate(10, RATE_HZ, 1))


def test_drawn_random_values_agree_with_the_samples():
    model = NoiseModel(
        {
            "gz": (
                Sinusoidal(amplitude=1.0, frequency=5.0),
                Sinusoidal(amplitude=1.0, frequency=6.0, phase=1.0),
                Sinusoidal(amplitude=1.0, frequency=7.0),
            ),
            "gx": (PoissonSteps(rate=2.0, height=3.0),),
            "gy": (RandomTelegraph(amplitude=2.0, dwell_time=0.7),),
            "ax": (Outliers(fraction=0.02, scale=5.0),),
            "ay": (RandomSampleHold(fraction=0.1), RateRamp(R=1.0)),
            "az": (BiasInstability(B=1.0),),
        }
    )
    stream = model.start_stream(RATE_HZ, 8)
    assert stream.drawn_random_values()["gx"]["poisson_steps"][0]["count"] == 0
    values = stream.draw_next_samples(10_000)
    truth = json.loads(json.dumps(stream.drawn_random_values()))
    assert set(truth) == {"gx", "gy", "gz", "ax", "ay"}

    first, third = (line["phase"] for line in truth["gz"]["sinusoidal"])  # a phase stated in the model is not drawn
    t = np.arange(10_000) / RATE_HZ
    lines = [np.sin(2.0 * np.pi * f * t + phase) for f, phase in ((5.0, first), (6.0, 1.0), (7.0, third))]
    np.testing.assert_allclose(values[:, 2], sum(lines), atol=1e-9)

    jumps = truth["gx"]["poisson_steps"][0]
    assert jumps["count"] == len(jumps["times"]) == len(jumps["heights"])
    built = sum(h * (t >= at) for at, h in zip(jumps["times"], jumps["heights"], strict=True))
    np.testing.assert_allclose(values[:, 0], built)

    flips = truth["gy"]["random_telegraph"][0]
    assert flips["count"] == len(flips["times"])
    sign = (-1.0) ** np.searchsorted(flips["times"], t, "right")
    np.testing.assert_allclose(values[:, 1], flips["first_level"] * sign)

    wrong = truth["ax"]["outliers"][0]
    assert wrong["count"] == np.count_nonzero(values[:, 3])
    np.testing.assert_allclose(np.flatnonzero(values[:, 3]) / RATE_HZ, wrong["times"])
    assert truth["ay"]["sample_hold"][0]["count"] == np.count_nonzero(np.diff(values[:, 4]) == 0.0)


def test_number_of_listed_random_values_is_bounded():
    stream = NoiseModel({"gx": (Outliers(fraction=0.5, scale=1.0),)}).start_stream(RATE_HZ, 0)
    stream.draw_next_samples(5000)
    outliers = stream.drawn_random_values()["gx"]["outliers"][0]
    assert outliers["count"] > 2000
    assert len(outliers["times"]) == len(outliers["errors"]) == 1000


def test_dwell_times_are_exponential_and_both_levels_can_be_first():
    model = NoiseModel({"gx": (RandomTelegraph(amplitude=2.0, dwell_time=0.5),)})
    stream = model.start_stream(1000.0, 3)
    stream.draw_next_samples(400_000)
    dwells = np.diff(stream.drawn_random_values()["gx"]["random_telegraph"][0]["times"])
    assert kstest(dwells, "expon", args=(0.0, 0.5)).pvalue > 0.001
    firsts = [model.simulate(1, 1000.0, seed)[0, 0] for seed in range(200)]
    assert 70 < np.count_nonzero(np.array(firsts) > 0.0) < 130  # 4.2 standard deviations for equal probabilities


@pytest.mark.parametrize(
    "source",
    [
        ExponentiallyCorrelated(sigma=2.0, correlation_time=50.0),
        Narrowband(sigma=2.0, frequency=3.0, bandwidth=0.01),
        WanderingLine(amplitude=8.0**0.5, frequency=3.0, frequency_deviation=0.01, correlation_time=50.0),
        RandomTelegraph(amplitude=4.0, dwell_time=100.0),
    ],
    ids=lambda source: source.name,
)
def test_first_sample_is_stationary(source):
    # The variance of 3000 first samples is known to 2.6 %; the bound is four times that.
    first = [NoiseModel({"gx": (source,)}).simulate(1, RATE_HZ, seed)[0, 0] for seed in range(3000)]
    assert np.mean(np.square(first)) == pytest.approx(4.0, rel=0.1)


def test_a_wandering_line_has_one_amplitude_and_many_frequencies():
    line = WanderingLine(amplitude=2.0, frequency=20.0, frequency_deviation=3.0, correlation_time=5.0, phase=0.5)
    y = NoiseModel({"gx": (line,)}).simulate(400_000, 1000.0, 1)[:, 0]
    assert y[0] == pytest.approx(2.0 * np.sin(0.5))
    turns = np.unwrap(np.angle(hilbert(y)))[2000:-2000]
    assert np.abs(hilbert(y))[2000:-2000] == pytest.approx(2.0, rel=0.02)
    hz = np.diff(turns[::100]) / (2.0 * np.pi * 0.1)
    # 80 correlation times: the mean is known to 0.47 Hz, the deviation to 8 %
    assert hz.mean() == pytest.approx(20.0, abs=1.5)
    assert hz.std() == pytest.approx(3.0, rel=0.25)


def test_generated_temperature_agrees_with_its_parameters():
    swing = Temperature(mean=25.0, swing=3.0, period=40.0)
    drawn = NoiseModel({}, RATE_HZ, swing).start_stream(RATE_HZ, 1).draw_samples_with_temperature(5000)
    np.testing.assert_allclose(
        drawn.temperature_c, 25.0 + 3.0 * np.sin(2.0 * np.pi * np.arange(5000) / RATE_HZ / 40.0), atol=1e-9
    )
    wander = Temperature(mean=0.0, wander=2.0, wander_time=0.05)
    c = NoiseModel({}, RATE_HZ, wander).start_stream(RATE_HZ, 1).draw_samples_with_temperature(200_000).temperature_c
    assert c.var() == pytest.approx(4.0, rel=0.05)
    assert np.mean(c[5:] * c[:-5]) == pytest.approx(4.0 * np.exp(-1.0), rel=0.08)
    assert np.isnan(NoiseModel().start_stream(RATE_HZ, 1).draw_samples_with_temperature(3).temperature_c).all()


def test_recorded_temperature_replaces_the_model_and_is_held():
    model = NoiseModel({"gx": (TemperatureBias(coefficient=1.0, reference=0.0),)}, None, Temperature(mean=99.0))
    drawn = model.start_stream(
        RATE_HZ, 1, np.array([np.nan, 20.0, np.nan, 22.0, np.nan])
    ).draw_samples_with_temperature(7)
    assert drawn.temperature_c.tolist() == [20.0, 20.0, 20.0, 22.0, 22.0, 22.0, 22.0]
    assert drawn.values[:, 0].tolist() == drawn.temperature_c.tolist()
    with pytest.raises(ConfigError, match="no temperature"):
        model.start_stream(RATE_HZ, 1, np.array([np.nan]))


def test_sample_rate_error_changes_the_true_time():
    axis = (
        BiasStep(time=10.0, height=1.0),
        Sinusoidal(amplitude=1.0, frequency=3.0, phase=0.0),
        TurnOnTransient(amplitude=1.0, time_constant=4.0),
    )
    true = NoiseModel({"gx": axis}).simulate(5000, 80.0, 1)
    stated = NoiseModel({"gx": axis, "gy": (SampleRateError(ratio=0.8),)}).simulate(5000, 100.0, 1)
    np.testing.assert_array_equal(stated, true)
    with pytest.raises(ConfigError, match="below 40 Hz"):
        NoiseModel({"gx": (Sinusoidal(amplitude=1.0, frequency=45.0), SampleRateError(ratio=0.8))}).start_stream(
            100.0, 1
        )


@pytest.mark.long
def test_memory_does_not_grow_with_the_length():
    axis = (
        QuantizationNoise(Q=1e-5),
        AngleRandomWalk(N=1e-4),
        BiasInstability(B=1e-4),
        RateRandomWalk(K=1e-5),
        PoissonSteps(rate=5.0, height=1e-4),
        TemperatureLag(coefficient=1e-5, reference=20.0, time_constant=60.0),
        RandomSampleHold(fraction=0.01),
    )
    model = NoiseModel(dict.fromkeys(AXES, axis), None, Temperature(mean=20.0, wander=1.0, wander_time=9.0))
    stream = model.start_stream(RATE_HZ, 1)
    stream.draw_next_samples(300_000)  # the lists of events are full by now
    tracemalloc.start()
    for _ in range(30):
        stream.draw_next_samples(10_000)
    used, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 100_000
    assert peak < 2_000_000  # one block of 10 000 samples is 560 kB


def test_permuted_axes_show_each_other():
    plain = NoiseModel({"gx": (AngleRandomWalk(N=1.0), ConstantBias(value=9.0)), "gy": (AngleRandomWalk(N=2.0),)})
    swap = NoiseModel({"gx": (AxisPermutation(source="gy"),), "gy": (AxisPermutation(source="gx"),)})
    drawn, swapped = (model.simulate(5000, 100.0, 1) for model in (plain, plain + swap))
    np.testing.assert_array_equal(swapped, drawn[:, [1, 0, 2, 3, 4, 5]])
    tau_s = np.array([1.0])
    assert (plain + swap).avar("gx", tau_s, 0.01) == plain.avar("gy", tau_s, 0.01)
