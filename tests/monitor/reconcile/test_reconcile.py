"""Tests of a complete reconciliation of a ten-minute, three-axis recording with zero, one or several hidden effects."""

import json
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

from drivers.data_types import AXES
from drivers.errors import NotReady
from monitor.noise.effects import (
    AngleRandomWalk,
    ConstantBias,
    CrossAxis,
    Outliers,
    QuantizationNoise,
    RateRamp,
    RateRandomWalk,
    SampleRateError,
    Sinusoidal,
    TemperatureBias,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.json_report import encode_report
from monitor.reconcile.likelihood.axis_fit import RegressorCache
from monitor.reconcile.preparation.reconcile_input import (
    MIN_SAMPLES,
    RecordedAxes,
    _smooth_temperature,
    select_axes_and_smooth_temperature,
)
from monitor.reconcile.reconcile import RecordingContext, _effects_by_axis, fit_five_terms, reconcile
from monitor.reconcile.result import combine_decisions
from monitor.reconcile.summary.ranked_findings import rank_findings
from tests.monitor.reconcile.axes import (
    GYRO_AXES,
    MODEL,
    RATE_HZ,
    TERMS,
    WALK,
    WHITE,
    N,
    check_report,
    recording,
    time_s,
    walk,
    white,
)

pytestmark = pytest.mark.long

n = 60_000


def make_changing_temperature(size):
    """Return a non-sinusoidal temperature in °C, which a spectral line cannot imitate, shape [size]."""
    t = np.arange(size) / size
    return 25.0 + 6.0 * np.abs(t - 0.35) + 2.0 * np.sin(2 * np.pi * 2.3 * t**2)


HIDDEN = {
    "sinusoidal": ("gz", Sinusoidal(amplitude=1.2e-4, frequency=17.3, phase=0.5)),
    "outliers": ("gy", Outliers(fraction=1e-3, scale=1.5e-2)),
    "temperature_bias": ("gx", TemperatureBias(coefficient=1e-4, reference=25.0)),
}


@cache
def result(name, seed=1):
    more = NoiseModel({HIDDEN[name][0]: (HIDDEN[name][1],)}) if name else NoiseModel({})
    return reconcile(recording(MODEL + more, n, seed + 50, make_changing_temperature(n)), MODEL, seed)


@pytest.mark.parametrize("seed", [1, 2])
def test_true_model_agrees(seed):
    found = result("", seed)
    assert found.verdict == "agrees"
    assert {one.verdict for one in found.axes.values()} == {"agrees"}
    assert found.model.effects == MODEL.effects
    assert list(found.axes) == list(GYRO_AXES)
    assert (found.samples, found.duration_s, found.rate_hz, found.fitted_first) == (n, n / RATE_HZ, RATE_HZ, False)
    check_report(json.loads(encode_report(found)))


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_effect_is_found_on_its_axis(name):
    found, (where, effect) = result(name), HIDDEN[name]
    check_report(json.loads(encode_report(found)))
    assert found.verdict == "explained"
    assert {axis for axis, one in found.axes.items() if one.steps} == {where}
    added = [step for step in found.axes[where].steps if step.kind == "added"]
    assert [step.effect for step in added] == [name]
    (step,) = added
    assert step.before.is_significant
    assert not step.after.is_significant
    for parameter, bounds in step.parameters.items():
        if bounds.lo is not None and parameter != "phase":
            deviation = (bounds.hi - bounds.lo) / 3.92
            assert abs(bounds.value - getattr(effect, parameter)) < 4.0 * deviation
    assert type(effect) in {type(one) for one in found.model.effects[where]}
    assert found.baseline.effects == MODEL.effects
    assert NoiseModel.from_toml(found.model.to_toml()) == found.model


def test_resulting_model_agrees_with_another_recording():
    found = result("sinusoidal")
    where, effect = HIDDEN["sinusoidal"]
    other = recording(MODEL + NoiseModel({where: (effect,)}), n, 77, make_changing_temperature(n))
    assert reconcile(other, found.model, 3).verdict == "agrees"


def test_same_seed_gives_the_same_bytes_also_in_threads():
    small = recording(MODEL + NoiseModel({"gy": (HIDDEN["outliers"][1],)}), 12_000, 5)
    first = reconcile(small, MODEL, 4)
    one = encode_report(first)
    with ThreadPoolExecutor(3) as pool:
        assert encode_report(reconcile(small, MODEL, 4, pool.map)) == one
    other = reconcile(small, MODEL, 5)
    assert other.seed == 5
    # the outliers are replaced by other draws
    ends = [[score.gap for score in found.axes["gy"].end.gaps] for found in (first, other)]
    assert ends[0] != ends[1]


def test_moved_line_is_one_retuned_step():
    known, other = Sinusoidal(amplitude=3e-4, frequency=17.3), Sinusoidal(amplitude=3e-4, frequency=5.0)
    plain = NoiseModel(dict.fromkeys(GYRO_AXES, (WHITE, WALK))) + NoiseModel({"gy": (known, other)})
    true = NoiseModel(dict.fromkeys(GYRO_AXES, (WHITE, WALK))) + NoiseModel(
        {"gy": (Sinusoidal(amplitude=3e-4, frequency=16.1), other)}
    )
    found = reconcile(recording(true, 24_000, 6), plain, 1)
    check_report(json.loads(encode_report(found)))
    assert found.verdict == "explained"
    (step,) = (step for one in found.axes.values() for step in one.steps)
    assert (step.kind, step.effect) == ("retuned", "sinusoidal")
    assert step.parameters["frequency"].lo < 16.1 < step.parameters["frequency"].hi
    assert step.confidence > 0.9
    assert "another frequency of sinusoidal" in step.because
    lines = [effect.frequency for effect in found.model.effects["gy"] if isinstance(effect, Sinusoidal)]
    assert lines == [pytest.approx(16.1, abs=1e-3), 5.0]


def test_wrong_sample_rate_is_one_step_for_all_axes():
    line = Sinusoidal(amplitude=3e-4, frequency=17.3)
    other = Sinusoidal(amplitude=3e-4, frequency=9.0)
    plain = NoiseModel(dict.fromkeys(GYRO_AXES, (WHITE, WALK))) + NoiseModel({"gy": (line,), "gx": (other,)})
    unknown = Sinusoidal(amplitude=3e-4, frequency=31.0)
    drawn = recording(plain + NoiseModel({"gy": (SampleRateError(ratio=1.004),), "gz": (unknown,)}), 24_000, 6)
    found = reconcile(drawn, plain, 1)
    check_report(json.loads(encode_report(found)))
    assert found.verdict == "explained"
    (step,) = (step for one in found.axes.values() for step in one.steps if step.effect == "sample_rate_error")
    assert step.parameters["ratio"].value == pytest.approx(1.004, abs=1e-4)
    assert found.model.true_to_stated_rate_ratio == pytest.approx(1.004, abs=1e-4)
    # what was found in stated time stands in the model in true time
    assert found.axes["gz"].steps[0].parameters["frequency"].value == pytest.approx(31.0 / 1.004, abs=1e-3)
    added = next(effect for effect in found.model.effects["gz"] if isinstance(effect, Sinusoidal))
    assert added.frequency == pytest.approx(31.0, abs=4e-3)


def test_equal_factors_on_all_axes_may_come_from_the_sample_rate():
    plain = NoiseModel(dict.fromkeys(AXES, (WHITE,)))
    drawn = recording(plain + NoiseModel({"gy": (SampleRateError(ratio=1.2),)}), 24_000, 6, names=AXES)
    found = reconcile(drawn, plain, 1)
    steps = [step for one in found.axes.values() for step in one.steps]
    assert [step.effect for step in steps] == ["scale_factor"] * 6
    for step in steps:
        assert step.parameters["factor"].value == pytest.approx(1.2**0.5, rel=0.01)
        assert step.confidence == pytest.approx(0.5, abs=0.01)
        assert [other.effect for other in step.runners_up] == ["sample_rate_error"]


def test_leak_between_correlated_axes_has_one_direction():
    loud = (AngleRandomWalk(N=20 * N),)
    plain = NoiseModel({"gx": (WHITE,), "gy": loud, "gz": (WHITE,)})
    leaking = plain + NoiseModel({"gx": (CrossAxis(source="gy", coefficient=0.02),)})
    found = reconcile(recording(leaking, 12_000, 7), plain, 1)
    assert {axis: [s.effect for s in one.steps] for axis, one in found.axes.items() if one.steps} == {
        "gx": ["cross_axis"]
    }
    parameters = found.axes["gx"].steps[0].parameters
    assert parameters["source"].value == "gy"
    assert parameters["coefficient"].lo < 0.02 < parameters["coefficient"].hi


def test_without_a_model_the_five_noise_terms_are_fitted_first():
    drawn = recording(MODEL, 24_000, 8)
    told = []
    found = reconcile(drawn, None, 1, report_stage=lambda what, share: told.append((what, share)))
    assert found.fitted_first
    assert found.verdict == "agrees"
    assert told[:2] == [("checking the recording", None), ("fitting the five terms", None)]
    shares = [share for what, share in told if what == "searching for missing effects"]
    assert shares == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])
    for axis in GYRO_AXES:
        sizes = {effect.name: effect for effect in found.baseline.effects[axis]}
        assert pytest.approx(N, rel=0.03) == sizes["angle_random_walk"].N


def test_only_terms_that_the_data_support_are_fitted():
    rng = np.random.default_rng(9)
    values = {
        "gx": white(n, rng),
        "gy": white(n, rng) + walk(n, rng, 1e-4),
        "gz": white(n, rng) + 1e-5 * time_s(n),
        "ax": NoiseModel({"ax": (WHITE, QuantizationNoise(Q=5e-6))}).simulate(n, RATE_HZ, 1)[:, 3].copy(),
    }
    found = fit_five_terms(RecordingContext(RecordedAxes(values, RATE_HZ), 1, RegressorCache(n, RATE_HZ, None), map))
    kinds = {axis: {type(effect) for effect in effects} for axis, effects in found.effects.items()}
    assert kinds["gx"] == {AngleRandomWalk}
    assert kinds["gy"] >= {AngleRandomWalk, RateRandomWalk}
    assert kinds["gz"] == {AngleRandomWalk, RateRamp}
    assert kinds["ax"] == {AngleRandomWalk, QuantizationNoise}
    ramp = next(effect for effect in found.effects["gz"] if isinstance(effect, RateRamp))
    assert pytest.approx(1e-5, rel=0.05) == ramp.R
    assert found.sample_rate_hz == RATE_HZ


# --- what cannot be compared


def draw_recording(**changed):
    small = recording(MODEL, MIN_SAMPLES, 1)
    return RecordedAxes({**small.values, **changed}, RATE_HZ)


def test_error_for_too_few_samples_states_the_minimum():
    with pytest.raises(NotReady, match=rf"{MIN_SAMPLES - 1} samples; at least {MIN_SAMPLES} .*100 Hz"):
        select_axes_and_smooth_temperature(recording(MODEL, MIN_SAMPLES - 1, 1), MODEL)
    assert select_axes_and_smooth_temperature(draw_recording(), MODEL)[1] == ()


def test_axes_that_cannot_be_compared_are_left_out_with_a_note():
    values = draw_recording().values
    holed = values["gx"].copy()
    holed[10:] = np.nan
    kept, notes = select_axes_and_smooth_temperature(
        draw_recording(gx=holed, gy=np.full(MIN_SAMPLES, 0.3), ax=values["gz"]), MODEL
    )
    assert list(kept.values) == ["gz"]
    assert [note.split(":")[0] for note in notes] == ["gx", "gy", "ax"]
    assert all(note.endswith("left out") for note in notes)
    with pytest.raises(NotReady, match=r"no axis to compare: gx: .*; gy: "):
        select_axes_and_smooth_temperature(RecordedAxes({"gx": holed, "gy": holed}, RATE_HZ), MODEL)


def test_constant_bias_is_no_part_of_the_comparison():
    model = MODEL + NoiseModel({"gz": (ConstantBias(value=0.3),)})
    assert _effects_by_axis(model, draw_recording())["gz"] == TERMS
    assert _effects_by_axis(NoiseModel({}), draw_recording()) == dict.fromkeys(GYRO_AXES, ())


WHITE_AX = AngleRandomWalk(N=10.0 * N)
WITH_SIZES = NoiseModel(
    {
        "gx": (WHITE, TemperatureBias(coefficient=4e-5, reference=25.0)),
        "gy": (WHITE, Sinusoidal(amplitude=3e-4, frequency=7.3)),
        "gz": (WHITE, CrossAxis(source="gy", coefficient=0.02)),
        "ax": (WHITE_AX, RateRamp(R=1e-5)),
    }
)


def recording_with_sizes(factors):
    """Draw a recording of ``WITH_SIZES`` in plain NumPy, with each deterministic effect multiplied by a factor."""
    rng = np.random.default_rng(7)
    t, warm = time_s(n), make_changing_temperature(n)
    gy = white(n, rng) + factors["gy"] * 3e-4 * np.sin(2.0 * np.pi * 7.3 * t + 1.0)
    values = {
        "gx": white(n, rng) + factors["gx"] * 4e-5 * (warm - 25.0),
        "gy": gy,
        "gz": white(n, rng) + factors["gz"] * 0.02 * gy,
        "ax": white(n, rng, WHITE_AX.N) - factors["ax"] * 1e-5 * t,
    }
    return RecordedAxes(values, RATE_HZ, warm)


def test_sizes_of_deterministic_effects_agree():
    assert reconcile(recording_with_sizes(dict.fromkeys(WITH_SIZES.effects, 1.0)), WITH_SIZES, 1).verdict == "agrees"


def test_changed_sizes_of_deterministic_effects_are_retuned():
    factors = {"gx": 1.5, "gy": 0.6, "gz": 5.0, "ax": 2.0}
    found = reconcile(recording_with_sizes(factors), WITH_SIZES, 1)
    assert found.verdict == "explained"
    for axis, factor in factors.items():
        effect = WITH_SIZES.effects[axis][1]
        (step,) = found.axes[axis].steps
        assert (step.kind, step.effect) == ("retuned", effect.name)
        assert step.confidence > 0.9
        (size,) = step.parameters.keys() & {"coefficient", "amplitude", "R"}
        bounds = step.parameters[size]
        half = bounds.hi - bounds.value
        assert bounds.value == pytest.approx(factor * getattr(effect, size), abs=2.0 * half)
        assert half < 0.2 * bounds.value
        assert getattr(found.model.effects[axis][1], size) == bounds.value
    ratios = {one.axes: one.size_ratio for one in rank_findings(found).findings}
    assert ratios == {(axis,): pytest.approx(factor, rel=0.2) for axis, factor in factors.items()}


def test_temperature_in_coarse_steps_is_no_other_coefficient():
    rng = np.random.default_rng(1)
    warm = 25.0 + np.cumsum(rng.standard_normal(n)) * 0.005
    coefficient = TemperatureBias(coefficient=4e-4, reference=25.0)
    values = {"gx": white(n, rng) + 4e-4 * (warm - 25.0) + 1e-4 * np.sin(2.0 * np.pi * 7.3 * time_s(n))}
    model = NoiseModel({"gx": (WHITE, coefficient)})
    found = reconcile(RecordedAxes(values, RATE_HZ, np.round(2.0 * warm) / 2.0), model, 1)
    assert ("added", "sinusoidal") in [(step.kind, step.effect) for step in found.axes["gx"].steps]
    assert "temperature_bias" not in [step.effect for step in found.axes["gx"].steps]


def test_missing_line_of_the_model_is_absent():
    found = reconcile(recording_with_sizes({"gx": 1.0, "gy": 0.0, "gz": 1.0, "ax": 1.0}), WITH_SIZES, 1)
    assert [(step.kind, step.effect) for step in found.axes["gy"].steps] == [("absent", "sinusoidal")]


def test_temperature_is_smoothed_and_gaps_are_filled():
    rng = np.random.default_rng(1)
    true = make_changing_temperature(n)
    noisy = true + 0.3 * rng.standard_normal(n)
    noisy[rng.random(n) < 0.5] = np.nan
    found = _smooth_temperature(noisy)
    assert np.isfinite(found).all()
    inside = slice(100, -100)
    assert np.std((found - true)[inside]) < 0.1
    np.testing.assert_allclose(_smooth_temperature(np.full(n, 25.0)), 25.0)
    assert _smooth_temperature(np.array([1.0, np.nan, 3.0])).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("axes", "whole"),
    [
        (["agrees", "agrees"], "agrees"),
        (["agrees", "explained"], "explained"),
        (["agrees", "unexplained"], "unexplained"),
        (["explained", "unexplained"], "partly_explained"),
        (["agrees", "partly_explained"], "partly_explained"),
    ],
)
def test_verdict_includes_all_axes(axes, whole):
    assert combine_decisions(axes) == whole


def test_sizes_are_listed_in_the_order_of_the_axes():
    assert list(result("outliers").axes) == [axis for axis in AXES if axis in GYRO_AXES]
