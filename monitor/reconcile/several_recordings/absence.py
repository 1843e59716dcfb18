"""Explanation of why one recording does not show an effect that another recording of the same sensor shows.

The result is the meaning of the absence and a sentence that can be checked. The gap of a steady effect grows with the
square root of the length of the recording. The gap of a temperature effect also grows with the range of the
temperature. If the other noise is similar, the gap in the other recording can therefore be predicted to about one
standard deviation. If the prediction is clearly larger than the threshold of the other recording, the absence is a
contradiction. Otherwise the data are not sensitive enough. There is no conclusion for effects that happen once, for
leaks from another axis, and for recordings with an unnamed difference in the same diagnostic.
"""

from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final, Literal

from monitor.reconcile.likelihood.effect_terms import ONE_TIME_EFFECTS
from monitor.reconcile.result import AddedOrResizedEffect, AxisResult, DiagnosticGap, Reconciliation

Meaning = Literal["contradiction", "too_faint", "other_name", "unnamed", "may_differ"]
"""Meaning of an absence.

- ``contradiction``: the data would have shown the effect.
- ``too_faint``: the data are not sensitive enough.
- ``other_name``: the data show the effect under another name.
- ``unnamed``: the data show a difference without a name.
- ``may_differ``: the recording need not contain the effect.
"""
MIN_EXCESS_SIGMA: Final = 2.0
"""Number of standard deviations between the expected gap and a gap that would be sufficient."""
LEAK_EFFECTS: Final = ("g_sensitivity", "cross_axis")
"""Effects that depend on the motion of another axis."""
TEMPERATURE_EFFECTS: Final = ("temperature_bias", "temperature_lag")
"""Effects that depend on the temperature."""


@dataclass(frozen=True, slots=True)
class Absence:
    """Recording that contains the axis but does not show the effect."""

    run: str
    meaning: Meaning
    because: str


@dataclass(frozen=True, slots=True)
class ClearestOccurrence:
    """Effect in the recording that shows it most clearly."""

    step: AddedOrResizedEffect
    axis_result: AxisResult  # result of the axis in that recording
    gap: float  # gap that the effect itself causes, standard deviations
    duration_s: float  # length of that recording, s


def explain_absence(shown: ClearestOccurrence, other: Reconciliation) -> tuple[Meaning, str]:
    """Return why a recording does not show an effect: the meaning, and a sentence that explains it.

    Parameters
    ----------
    shown : ClearestOccurrence
        Effect in the recording that shows it most clearly.
    other : Reconciliation
        Result of the recording without the effect.
    """
    step, axis_result = shown.step, shown.axis_result
    there = other.axes.get(axis_result.axis)
    if there is None:
        return "may_differ", f"the recording does not contain {axis_result.axis}"
    if step.effect in ONE_TIME_EFFECTS:
        return "may_differ", "an effect that happens once need not happen in another recording"
    if rival := _confused_effect(step, axis_result, there):
        return "other_name", f"the difference was named {rival} there, and the two effects are hard to distinguish"
    seen = next((score for score in there.end.gaps if score.lens == step.before.lens), None)
    if any(score.lens == step.before.lens for score in there.left_over):
        return "unnamed", f"the same diagnostic ({step.before.lens}) leaves a difference without a name there"
    if step.effect in LEAK_EFFECTS:
        source = step.parameters["source"].value
        if source not in other.axes:
            return "too_faint", f"the recording does not contain {source}"
        return "may_differ", f"the contribution to the axis depends on the motion of {source}"
    if seen is None or not shown.gap > 0.0:
        return (
            "may_differ",
            f"the diagnostic that found the effect ({step.before.lens}) does not determine a size there",
        )
    growth = _gap_ratio(step, shown.duration_s, other.duration_s, seen)
    if growth is None:
        return "too_faint", "no changing temperature was recorded"
    return _compare_expected_gap(growth * shown.gap, growth, seen, other.duration_s)


def _compare_expected_gap(expected: float, growth: float, seen: DiagnosticGap, seconds: float) -> tuple[Meaning, str]:
    """Return whether an expected gap should have passed the threshold, with the sentence that explains it."""
    said = (
        f"with the size in the other recording, {seconds:.6g} s of data would show a gap of about {expected:.1f} "
        f"({seen.lens}), and the threshold of {seen.threshold:.1f} is not passed"
    )
    # a gap has a standard deviation of one, and so has the gap from which the expectation is scaled
    enough = seen.threshold + MIN_EXCESS_SIGMA * hypot(1.0, growth)
    return ("contradiction" if expected > enough else "too_faint"), said


def _gap_ratio(step: AddedOrResizedEffect, seconds: float, other_s: float, seen: DiagnosticGap) -> float | None:
    """Return the expected gap of the other recording relative to the first one, for an effect of the same size.

    The result is None if the effect cannot be visible there.
    """
    longer = other_s / seconds
    if step.effect == "rate_ramp":
        # the gain of a ramp grows with the cube of the length in white noise, and with the length in a random walk
        return min(sqrt(longer), longer * sqrt(longer))
    if step.effect not in TEMPERATURE_EFFECTS:
        return sqrt(longer)
    here, there = step.before.where.temperature, seen.where.temperature
    if there is None or not there[1] > there[0]:
        return None
    swing = 1.0 if here is None or not here[1] > here[0] else (there[1] - there[0]) / (here[1] - here[0])
    return sqrt(longer) * swing


def _confused_effect(step: AddedOrResizedEffect, axis_result: AxisResult, other_axis_result: AxisResult) -> str:
    """Return an effect that only the other recording has if one of the two effects was the runner-up of the other."""
    mine = {one.effect for one in axis_result.steps}
    for one in other_axis_result.steps:
        rivals = step.effect in _runner_up_names(one) or one.effect in _runner_up_names(step)
        if one.kind == step.kind == "added" and one.effect not in mine and rivals:
            return one.effect
    return ""


def _runner_up_names(step: AddedOrResizedEffect) -> set[str]:
    """Return the names of the alternatives of a step."""
    return {one.effect for one in step.runners_up}
