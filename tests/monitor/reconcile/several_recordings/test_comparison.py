"""Tests of the comparison of several recordings: matched effects, pooled sizes and effects of single recordings."""

from dataclasses import replace

import pytest

from monitor.noise.effects import AngleRandomWalk, BandwidthLimit, BiasStep, Sinusoidal, TemperatureBias
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.several_recordings.comparison import (
    AxisComparison,
    EffectInRecordings,
    NamedResult,
    compare_results,
)
from tests.monitor.reconcile import samples
from tests.monitor.reconcile.runs_made import DIAGNOSTIC, around, known_lines, line, run, step, with_axes


def compare_gz(*runs: NamedResult) -> AxisComparison:
    return compare_results(runs).axes["gz"]


def get_only_effect(found: tuple[EffectInRecordings, ...]) -> EffectInRecordings:
    (one,) = found
    return one


def test_line_of_every_recording_is_common_and_pooled() -> None:
    c = compare_results([run("a", line(1.50e-4)), run("b", line(1.52e-4)), run("c", line(1.48e-4, 17.302))])
    seen = get_only_effect(c.axes["gz"].common)
    assert c.axes["gz"].single == ()
    assert list(seen.steps) == ["a", "b", "c"]
    amplitude = seen.parameters["amplitude"].bounds
    assert amplitude.value == pytest.approx(1.50e-4)
    assert amplitude.hi == pytest.approx(1.50e-4 + 3e-6 / 3**0.5)
    assert "phase" not in seen.parameters  # of no meaning in another recording
    # two of them are 2 µrad/s from the mean, the deviation of each is 3 µrad/s / 1.96
    assert seen.parameters["amplitude"].chi2 == pytest.approx(2 * (2 / (3 / 1.959964)) ** 2)
    assert seen.p == seen.parameters["amplitude"].p_value
    assert seen.sizes_agree is True


def test_different_sizes_are_common_and_not_consistent() -> None:
    seen = get_only_effect(compare_gz(run("a", line(1.5e-4)), run("b", line(2.5e-4))).common)
    assert seen.sizes_agree is False
    assert seen.p is not None
    assert seen.p < 1e-6


def test_equal_sizes_are_consistent_at_any_frequency() -> None:
    seen = get_only_effect(compare_gz(run("a", line(1.50e-4)), run("b", line(1.51e-4, 17.35))).common)
    assert seen.sizes_agree is True
    moved = seen.parameters["frequency"].p_value
    assert moved is not None
    assert moved < 0.001  # it is told, but is no size


def test_one_recordings_own_effect_is_single_with_its_absence_elsewhere() -> None:
    own = step("bias_step", time=around(350.0, 0.1), height=around(1e-3, 1e-4))
    axis = compare_gz(run("a", line()), run("b", line(), own), run("c", line()))
    assert get_only_effect(axis.common).effect == "sinusoidal"
    seen = get_only_effect(axis.single)
    assert (seen.effect, list(seen.steps)) == ("bias_step", ["b"])
    assert [(one.run, one.meaning) for one in seen.absent] == [("a", "may_differ"), ("c", "may_differ")]
    assert seen.sizes_agree is None


def test_steps_at_different_times_are_two_effects() -> None:
    first, second = (step("bias_step", time=t, height=1e-3) for t in (100.0, 400.0))
    axis = compare_gz(run("a", first), run("b", second))
    assert axis.common == ()
    assert [list(seen.steps) for seen in axis.single] == [["a"], ["b"]]


def test_each_line_is_matched_to_the_nearest() -> None:
    axis = compare_gz(run("a", line(1e-4, 17.30), line(3e-4, 17.36)), run("b", line(3e-4, 17.37), line(1e-4, 17.31)))
    assert axis.single == ()
    assert [round(float(one.parameters["amplitude"].bounds.value), 6) for one in axis.common] == [1e-4, 3e-4]
    assert all(one.sizes_agree for one in axis.common)


def test_different_effects_are_not_matched() -> None:
    narrow = step("narrowband", sigma=1e-4, frequency=17.3, bandwidth=0.5)
    axis = compare_gz(run("a", line()), run("b", narrow))
    assert axis.common == ()
    assert [seen.effect for seen in axis.single] == ["sinusoidal", "narrowband"]


def test_axis_of_one_recording_has_nothing_in_common() -> None:
    both = with_axes(run("a", line()), run("a", line(), axis="gx"))
    c = compare_results([both, run("b", line())])
    assert list(c.axes) == ["gx", "gz"]
    assert get_only_effect(c.axes["gx"].single).absent == ()
    assert get_only_effect(c.axes["gz"].common).effect == "sinusoidal"


def test_common_effects_are_those_of_all_recordings_with_the_axis() -> None:
    c = compare_results([run("a", line()), run("b", line()), run("c", axis="gx")])
    assert get_only_effect(c.axes["gz"].common).steps.keys() == {"a", "b"}


def test_model_has_the_common_effects_and_no_other() -> None:
    own = step("bias_step", time=350.0, height=1e-3)
    more = step("angle_random_walk", kind="retuned", N=around(1.8e-4, 1e-6))
    most = step("angle_random_walk", kind="retuned", N=around(1.84e-4, 1e-6))
    c = compare_results([run("a", line(1.50e-4), more), run("b", line(1.51e-4), most, own)])
    effects = c.model.effects["gz"]
    assert [effect.name for effect in effects] == [
        "angle_random_walk", "bias_instability", "rate_random_walk", "sinusoidal",
    ]  # fmt: skip
    white, tone = effects[0], effects[-1]
    assert isinstance(white, AngleRandomWalk)
    assert pytest.approx(1.82e-4) == white.N
    assert isinstance(tone, Sinusoidal)
    assert tone.amplitude == pytest.approx(1.505e-4)
    assert tone.phase is None  # drawn anew in every recording
    assert not any(isinstance(effect, BiasStep) for effect in effects)
    assert c.model.sample_rate_hz == samples.RATE_HZ


def test_of_several_lines_in_the_model_the_retuned_one_is_replaced() -> None:
    known = [Sinusoidal(amplitude=1e-4, frequency=f) for f in (10.0, 17.3)]
    retuned = step("sinusoidal", kind="retuned", amplitude=around(2e-4, 1e-6))
    runs = []
    for name in "ab":
        one = known_lines(known, run(name))
        effects = {"gz": (*one.result.baseline.effects["gz"][:-1], Sinusoidal(amplitude=2e-4, frequency=17.3))}
        axes = {"gz": replace(one.result.axes["gz"], steps=(retuned,), verdict="explained")}
        model = replace(one.result.model, effects=effects)
        runs.append(replace(one, result=replace(one.result, axes=axes, model=model, verdict="explained")))
    c = compare_results(runs)
    lines = [effect for effect in c.model.effects["gz"] if isinstance(effect, Sinusoidal)]
    assert [(one.frequency, round(one.amplitude, 6)) for one in lines] == [(10.0, 1e-4), (17.3, 2e-4)]


def test_parameter_without_an_interval_is_that_of_the_first_recording() -> None:
    low_pass = step("bandwidth_limit", cutoff=around(20.0, 0.1), order=ParameterInterval(2))
    c = compare_results([run("a", low_pass), run("b", low_pass)])
    found = c.model.effects["gz"][-1]
    assert found == BandwidthLimit(cutoff=20.0, order=2)
    assert get_only_effect(c.axes["gz"].common).sizes_agree is True  # by its cutoff, as it has no size


def test_curved_temperature_effect_is_pooled_at_one_reference() -> None:
    """The curve 2e-4 (T − 20) + 1e-5 (T − 20)² is stated at 20 °C and at 30 °C."""
    curve = around(1e-5, 1e-7)
    first = step("temperature_bias", coefficient=around(2e-4, 4e-6), quadratic=curve, reference=ParameterInterval(20.0))
    second = step(
        "temperature_bias", coefficient=around(4e-4, 4e-6), quadratic=curve, reference=ParameterInterval(30.0)
    )
    c = compare_results([run("a", first), run("b", second)])
    seen = get_only_effect(c.axes["gz"].common)
    assert seen.sizes_agree is True
    found = c.model.effects["gz"][-1]
    assert isinstance(found, TemperatureBias)
    assert (found.coefficient, found.quadratic, found.reference) == pytest.approx((2e-4, 1e-5, 20.0))


def test_retuned_term_is_a_contradiction_only_if_its_size_is_another() -> None:
    """A change of 1 % with an interval of 2 % is insignificant, no matter how much of the gap it closes."""
    for size, half, meaning in ((1.01, 0.02, "too_faint"), (1.2, 0.02, "contradiction")):
        retuned = step("angle_random_walk", kind="retuned", N=around(size * samples.N, half * samples.N))
        seen = get_only_effect(compare_gz(run("a", retuned), run("b")).single)
        assert [one.meaning for one in seen.absent] == [meaning]


def test_clock_is_one_for_all_axes() -> None:
    slow = step("sample_rate_error", ratio=around(1.01, 1e-4))
    c = compare_results([run("a", slow, axis="gx"), run("b", slow, axis="gz")])
    assert get_only_effect(c.axes["gx"].common).steps.keys() == {"a", "b"}
    assert c.axes["gz"].common == c.axes["gz"].single == ()
    assert [(axis, effect.name) for axis, effect in c.model if effect.name == slow.effect] == [("gx", slow.effect)]


def test_verdict_includes_all_recordings() -> None:
    left = replace(DIAGNOSTIC, gap=9.0)
    assert compare_results([run("a"), run("b")]).verdict == "agrees"
    assert compare_results([run("a"), run("b", line())]).verdict == "explained"
    assert compare_results([run("a"), run("b", left=[left])]).verdict == "unexplained"
    assert compare_results([run("a", line()), run("b", left=[left])]).verdict == "partly_explained"
