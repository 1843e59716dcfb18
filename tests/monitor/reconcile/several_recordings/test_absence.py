"""Tests of the reasons for the absence of an effect. Only data can contradict an effect."""

from dataclasses import replace
from typing import Any

import pytest

from monitor.reconcile.effect_properties import ONE_TIME_EFFECTS
from monitor.reconcile.result import AddedOrResizedEffect, DiagnosticGap, Location, ParameterInterval, Reconciliation
from monitor.reconcile.several_recordings.absence import Absence, ClearestOccurrence, explain_absence
from monitor.reconcile.several_recordings.comparison import NamedResult
from tests.monitor.reconcile.runs_made import DIAGNOSTIC, line, run, step


def make_shown(one: AddedOrResizedEffect, gap: float = 30.0, seconds: float = 600.0) -> ClearestOccurrence:
    return ClearestOccurrence(one, run("one", one).result.axes["gz"], gap, seconds)


def compute_absence(one: ClearestOccurrence, other: NamedResult) -> Absence:
    return Absence(other.name, *explain_absence(one, other.result))


def make_result(score: DiagnosticGap, seconds: float = 600.0) -> Reconciliation:
    """Return the result for an axis that agrees with the model and has one diagnostic."""
    agreeing = run("two", seconds=seconds).result
    gz = agreeing.axes["gz"]
    seen = replace(gz.end, gaps=(score,))
    return replace(agreeing, axes={"gz": replace(gz, start=seen, end=seen)})


def test_absence_of_a_detectable_effect_is_a_contradiction() -> None:
    found = compute_absence(make_shown(line()), run("two"))
    assert found.meaning == "contradiction"
    assert found.because == (
        "with the size in the other recording, 600 s of data would show a gap of about 30.0 (lines), and the threshold "
        "of 4.0 is not passed"
    )


@pytest.mark.parametrize(("seconds", "meaning"), [(600.0, "contradiction"), (15.0, "too_faint")])
def test_short_recording_has_smaller_gaps(seconds: float, meaning: str) -> None:
    """Gaps grow with the square root of the length, so a gap of 30 in 600 s is 4.7 in 15 s."""
    assert compute_absence(make_shown(line()), run("two", seconds=seconds)).meaning == meaning


@pytest.mark.parametrize(("gap", "meaning"), [(4.5, "too_faint"), (6.5, "too_faint"), (7.5, "contradiction")])
def test_scatter_of_the_gaps_is_considered(gap: float, meaning: str) -> None:
    """The limit is the threshold of 4 plus two standard deviations of the difference between two gaps, each with a
    standard deviation of one."""
    assert compute_absence(make_shown(line(), gap), run("two")).meaning == meaning


@pytest.mark.parametrize("effect", sorted(ONE_TIME_EFFECTS))
def test_single_event_may_be_absent(effect: str) -> None:
    given: dict[str, dict[str, Any]] = {
        "bias_step": {"time": 9.0, "height": 1.0},
        "noise_step": {"time": 9.0, "ratio": 2.0},
        "bias_curve": {"slope": 1.0, "curvature": 2.0},
    }
    one = step(effect, **given.get(effect, {"amplitude": 1.0, "time_constant": 9.0}))
    assert compute_absence(make_shown(one), run("two")).meaning == "may_differ"


def test_rival_effect_is_stated_only_if_it_was_the_runner_up() -> None:
    telegraph: dict[str, Any] = {"amplitude": 1e-4, "dwell_time": 9.0}
    rival = run("two", step("random_telegraph", rivals=["exponentially_correlated"], **telegraph))
    one = make_shown(step("exponentially_correlated", sigma=1e-4, correlation_time=5.0))
    found = compute_absence(one, rival)
    assert found.meaning == "other_name"
    assert "random_telegraph" in found.because
    assert compute_absence(one, run("two", step("random_telegraph", **telegraph))).meaning == "contradiction"


def test_remaining_gap_of_the_same_diagnostic_is_no_contradiction() -> None:
    left = replace(DIAGNOSTIC, gap=9.0)
    assert compute_absence(make_shown(line()), run("two", left=[left])).meaning == "unnamed"
    assert (
        compute_absence(make_shown(line()), run("two", left=[replace(left, diagnostic="tails")])).meaning
        == "contradiction"
    )


def test_leak_needs_its_source() -> None:
    one = make_shown(step("cross_axis", source=ParameterInterval("gx"), coefficient=0.1))
    assert compute_absence(one, run("two")).meaning == "too_faint"
    both = run("two").result
    with_source = replace(both, axes={**both.axes, "gx": run("two", axis="gx").result.axes["gx"]})
    assert explain_absence(one, with_source)[0] == "may_differ"


@pytest.mark.parametrize(
    ("swing", "meaning"), [((20.0, 30.0), "contradiction"), ((24.0, 25.0), "too_faint"), (None, "too_faint")]
)
def test_temperature_effect_needs_temperature_that_changes(swing: tuple[float, float] | None, meaning: str) -> None:
    warm = DiagnosticGap("temperature", Location(temperature=(20.0, 30.0)), 30.0, 2.0, 4.0)
    one = replace(step("temperature_bias", coefficient=1e-3, reference=ParameterInterval(25.0)), before=warm)
    other = make_result(replace(warm, where=Location(temperature=swing), gap=1.0))
    assert explain_absence(make_shown(one), other)[0] == meaning


def test_gap_of_a_ramp_decreases_faster_with_the_length() -> None:
    ramp = make_shown(step("rate_ramp", R=1e-6), gap=30.0)
    assert compute_absence(ramp, run("two", seconds=200.0)).meaning == "too_faint"
    assert compute_absence(make_shown(line(), 30.0), run("two", seconds=200.0)).meaning == "contradiction"


def test_without_the_diagnostic_or_the_axis_there_is_no_statement() -> None:
    assert explain_absence(make_shown(line()), make_result(replace(DIAGNOSTIC, diagnostic="psd")))[0] == "may_differ"
    assert compute_absence(make_shown(line()), run("two", axis="gx")).because == "the recording does not contain gz"
    assert compute_absence(make_shown(line(), gap=0.0), run("two")).meaning == "may_differ"
