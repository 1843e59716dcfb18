"""Explanation of why one recording does not show an effect that another recording of the same sensor shows.

The difference due to a permanent effect grows with the square root of the recording length. The difference due to a
temperature effect also grows with the temperature range. If the expected difference clearly exceeds the threshold, the
absence of the effect is a contradiction.
"""

from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final, Literal

from monitor.reconcile.effect_properties import ONE_TIME_EFFECTS
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
"""Number of standard deviations by which the expected gap must exceed the threshold for a contradiction."""
LEAK_EFFECTS: Final = ("g_sensitivity", "cross_axis")
TEMPERATURE_EFFECTS: Final = ("temperature_bias", "temperature_lag", "temperature_hysteresis")


@dataclass(frozen=True, slots=True)
class Absence:
    """Recording that does not show an effect, with the explanation."""

    run: str  # name of the recording
    meaning: Meaning
    because: str


@dataclass(frozen=True, slots=True)
class ClearestOccurrence:
    """Effect in the recording with the clearest evidence."""

    step: AddedOrResizedEffect
    axis_result: AxisResult  # result of the axis in this recording
    gap: float  # gap that the effect itself causes, standard deviations
    duration_s: float  # length of this recording


def explain_absence(shown: ClearestOccurrence, other: Reconciliation) -> tuple[Meaning, str]:
    """Explain why a recording does not show an effect of another recording.

    Parameters
    ----------
    shown : ClearestOccurrence
        Effect in the recording with the clearest evidence.
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
    gap = next((gap for gap in there.end.gaps if gap.diagnostic == step.before.diagnostic), None)
    if any(gap.diagnostic == step.before.diagnostic for gap in there.left_over):
        return "unnamed", f"the same diagnostic ({step.before.diagnostic}) leaves a difference without a name there"
    if step.effect in LEAK_EFFECTS:
        source = step.parameters["source"].value
        if source not in other.axes:
            return "too_faint", f"the recording does not contain {source}"
        return "may_differ", f"the contribution to the axis depends on the motion of {source}"
    if gap is None or not shown.gap > 0.0:
        return (
            "may_differ",
            f"the diagnostic that found the effect ({step.before.diagnostic}) does not determine a size there",
        )
    growth = _gap_ratio(step, shown.duration_s, other.duration_s, gap)
    if growth is None:
        return "too_faint", "no changing temperature was recorded"
    return _compare_expected_gap(growth * shown.gap, growth, gap, other.duration_s)


def _compare_expected_gap(expected: float, growth: float, gap: DiagnosticGap, seconds: float) -> tuple[Meaning, str]:
    """Compare the expected difference with the threshold, and return a conclusion about the absence with a reason."""
    said = (
        f"with the size in the other recording, {seconds:.6g} s of data would show a gap of about {expected:.1f} "
        f"({gap.diagnostic}), and the threshold of {gap.threshold:.1f} is not passed"
    )
    # both the expected gap before scaling and the observed gap have a standard deviation of one
    enough = gap.threshold + MIN_EXCESS_SIGMA * hypot(1.0, growth)
    return ("contradiction" if expected > enough else "too_faint"), said


def _gap_ratio(step: AddedOrResizedEffect, seconds: float, other_s: float, gap: DiagnosticGap) -> float | None:
    """Return the ratio of the expected gap in the other recording to the observed gap, or None without a temperature
    change.
    """
    longer = other_s / seconds
    if step.effect == "rate_ramp":
        # the gain of a ramp grows with the cube of the length in white noise, and with the length in a random walk
        return min(sqrt(longer), longer * sqrt(longer))
    if step.effect not in TEMPERATURE_EFFECTS:
        return sqrt(longer)
    here, there = step.before.where.temperature, gap.where.temperature
    if there is None or not there[1] > there[0]:
        return None
    swing = 1.0 if here is None or not here[1] > here[0] else (there[1] - there[0]) / (here[1] - here[0])
    return sqrt(longer) * swing


def _confused_effect(step: AddedOrResizedEffect, axis_result: AxisResult, other_axis_result: AxisResult) -> str:
    """Return the name of an effect in the other recording that is hard to distinguish from ``step``, or "".

    Two effects are hard to distinguish if one effect was a runner-up to the other.
    """
    mine = {one.effect for one in axis_result.steps}
    for one in other_axis_result.steps:
        rivals = step.effect in _runner_up_names(one) or one.effect in _runner_up_names(step)
        if one.kind == step.kind == "added" and one.effect not in mine and rivals:
            return one.effect
    return ""


def _runner_up_names(step: AddedOrResizedEffect) -> set[str]:
    return {one.effect for one in step.runners_up}
