"""Tests of the estimation of a wrong sample rate, which moves all features of a model by one ratio."""

import numpy as np
import pytest

from monitor.noise.effect import AxisLeak, SampleBlockContext, Source
from monitor.noise.effects import EFFECTS, AngleRandomWalk, Narrowband, SampleRateError, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.effect_properties import NOISE_SIZE_PARAMETERS, SERIES_SIZE_PARAMETERS
from monitor.reconcile.search.sample_rate_from_spectrum import convert_effect_to_stated_time, detect_sample_rate_error
from tests.contracts.effect_examples import make_effect
from tests.monitor.reconcile.axes import GYRO_AXES, RATE_HZ, WALK, WHITE, axes, make_temperature, recording

n = 24_000
RATIO = 1.13


NOISES = [
    EFFECTS[name]
    for name in NOISE_SIZE_PARAMETERS
    if issubclass(EFFECTS[name], Source) and name != "quantization_noise"
]


@pytest.mark.parametrize("kind", NOISES, ids=lambda kind: kind.name)
def test_spectrum_equals_that_of_resampled_noise(kind):
    """At the stated rate, the density is S'(f) = r S(rf) with the sample interval τ0/r."""
    one, tau0_s = make_effect(kind.name), 1.0 / RATE_HZ
    f_hz = np.geomspace(0.01, 0.499 * RATE_HZ, 50)
    expected = RATIO * one.two_sided_psd(RATIO * f_hz, tau0_s / RATIO)
    np.testing.assert_allclose(
        convert_effect_to_stated_time(one, RATIO).two_sided_psd(f_hz, tau0_s), expected, rtol=1e-9
    )
    clocked = NoiseModel({"gz": (one, SampleRateError(ratio=RATIO))})
    np.testing.assert_allclose(
        convert_effect_to_stated_time(one, RATIO).two_sided_psd(f_hz, tau0_s),
        clocked.two_sided_psd("gz", f_hz, tau0_s),
        rtol=1e-9,
    )


COURSES = [EFFECTS[name] for name in SERIES_SIZE_PARAMETERS if not issubclass(EFFECTS[name], AxisLeak)]


@pytest.mark.parametrize("kind", COURSES, ids=lambda kind: kind.name)
def test_series_equals_that_at_the_true_rate(kind):
    def drawn(one: Source, rate_hz: float):
        values = np.zeros(n)
        one.start_series(rate_hz, np.random.default_rng(1)).add_next_samples(
            values, SampleBlockContext(0, make_temperature(n), np.empty(n))
        )
        return values

    one = make_effect(kind.name)
    true, stated = drawn(one, RATIO * RATE_HZ), drawn(convert_effect_to_stated_time(one, RATIO), RATE_HZ)
    np.testing.assert_allclose(stated, true, atol=1e-6 * np.abs(true).max())


def test_conversion_and_its_inverse_give_the_same_effect():
    for name in sorted(set(EFFECTS) - {"bias", "sample_rate_error"}):
        back = convert_effect_to_stated_time(convert_effect_to_stated_time(make_effect(name), RATIO), 1.0 / RATIO)
        for parameter in back.__dataclass_fields__:
            want = getattr(make_effect(name), parameter)
            assert getattr(back, parameter) == (want if want is None or isinstance(want, str) else pytest.approx(want))
        assert convert_effect_to_stated_time(make_effect(name), 1.0) == make_effect(name)


LINE = Sinusoidal(amplitude=3e-4, frequency=17.3, phase=0.4)
OTHER = Sinusoidal(amplitude=1e-4, frequency=8.1, phase=2.0)
RESONANCE = Narrowband(sigma=8e-4, frequency=31.0, bandwidth=0.8)
HUM = Narrowband(sigma=4e-4, frequency=12.0, bandwidth=0.5)


def measure_at_wrong_rate(feature, ratio, seed=1):
    """Return three axes of a sensor with a wrong sample rate. The features are on gy."""
    plain = NoiseModel(dict.fromkeys(GYRO_AXES, (WHITE, WALK)), RATE_HZ)
    model = plain + NoiseModel({"gy": feature})
    drawn = recording(model + NoiseModel({"gy": (SampleRateError(ratio=ratio),)}), n, seed)
    effects = {name: tuple(model.effects[name]) for name in GYRO_AXES}
    return axes(dict(drawn.values), effects), effects


@pytest.mark.parametrize("ratio", [1.0007, 0.992, 1.05])
def test_ratio_is_found_by_a_line(ratio):
    found = detect_sample_rate_error(*measure_at_wrong_rate((LINE, OTHER), ratio))
    assert found is not None
    assert found.axis == "gy"
    assert found.ratio.value == pytest.approx(ratio, abs=3e-5)
    assert found.ratio.hi - found.ratio.lo < 6e-5
    assert found.frequency[0] == pytest.approx(17.3)
    assert found.frequency[1] == pytest.approx(17.3 / ratio, rel=3e-5)
    assert found.gain > 100.0


def test_ratio_is_found_by_a_resonance():
    found = detect_sample_rate_error(*measure_at_wrong_rate((RESONANCE, HUM), 1.02))
    assert found is not None
    assert found.ratio.lo < 1.02 < found.ratio.hi
    assert found.axis == "gy"
    assert found.gain > 100.0


def test_one_moved_line_is_no_wrong_rate():
    assert detect_sample_rate_error(*measure_at_wrong_rate((LINE,), 1.0007)) is None


def test_right_rate_is_not_changed():
    for seed in range(3):
        assert detect_sample_rate_error(*measure_at_wrong_rate((LINE, RESONANCE), 1.0, seed)) is None


def test_without_a_feature_the_rate_is_not_changed():
    assert detect_sample_rate_error(*measure_at_wrong_rate((), 1.01)) is None


def test_absent_line_is_no_wrong_rate():
    every, effects = measure_at_wrong_rate((), 1.0)
    assert detect_sample_rate_error(every, {**effects, "gy": (*effects["gy"], LINE)}) is None


def test_wrong_rate_with_white_noise_alone_changes_its_size():
    assert pytest.approx(1.1) == convert_effect_to_stated_time(AngleRandomWalk(N=1.0), 1.21).N


def test_unmoved_line_excludes_a_wrong_rate():
    """One line has not moved, so the clock is right, although two other lines have moved by the same ratio."""
    plain = NoiseModel(dict.fromkeys(GYRO_AXES, (WHITE, WALK)), RATE_HZ)
    third = Sinusoidal(amplitude=6e-5, frequency=23.9, phase=1.0)
    model = plain + NoiseModel({"gy": (LINE, OTHER, third)})
    moved = [Sinusoidal(amplitude=one.amplitude, frequency=one.frequency / 1.02, phase=0.0) for one in (LINE, OTHER)]
    drawn = recording(plain + NoiseModel({"gy": (*moved, third)}), n, 1)
    effects = {name: tuple(model.effects[name]) for name in GYRO_AXES}
    assert detect_sample_rate_error(axes(dict(drawn.values), effects), effects) is None
