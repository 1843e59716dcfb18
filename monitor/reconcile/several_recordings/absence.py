"""Why a recording does not show an effect that another one of the same sensor shows.

In come the step of the one and the comparison of the other; out goes what the absence means and a sentence that can be
checked. The gap that a steady effect opens grows with the square root of the length, that of a temperature effect with
the swing of the temperature besides. So the gap which the effect would open in the other recording is known, if the
rest of its noise is alike, to about one standard deviation. Where it lies clearly above what that recording needs to
tell something, the absence is a contradiction; where it does not, the data are too faint to say. Nothing is concluded
of what happens once, of what another axis brings in, or where something without this name was found in its place.
"""

from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final, Literal

from monitor.reconcile.likelihood.effect_terms import ONCE
from monitor.reconcile.result import AxisResult, Reconciliation, Score, Step

Meaning = Literal["contradiction", "too_faint", "other_name", "unnamed", "may_differ"]
"""The data would have shown it; could not have; call it something else; show something without a name; need not
have it."""
CLEARLY: Final = 2.0
"""Standard deviations between what is expected and what would be enough."""
LEAKS: Final = ("g_sensitivity", "cross_axis")
WARMTH: Final = ("temperature_bias", "temperature_lag")


@dataclass(frozen=True, slots=True)
class Absence:
    """A recording that has the axis and not the effect."""

    run: str
    meaning: Meaning
    because: str


@dataclass(frozen=True, slots=True)
class Shown:
    """The effect in the recording that shows it most."""

    step: Step
    of: AxisResult  # its axis there
    gap: float  # that the effect itself opened
    seconds: float  # length of that recording


def absence(shown: Shown, run: str, other: Reconciliation) -> Absence:
    """What it means that the recording named ``run`` has no such step."""
    return Absence(run, *_meaning(shown, other))


def _meaning(shown: Shown, other: Reconciliation) -> tuple[Meaning, str]:
    step, of = shown.step, shown.of
    there = other.axes.get(of.axis)
    if there is None:
        return "may_differ", f"{of.axis} is not in it"
    if step.effect in ONCE:
        return "may_differ", "what happens once need not happen in another recording"
    if rival := _other_name(step, of, there):
        return "other_name", f"what is seen there was named {rival}, and the two are hard to tell apart"
    seen = next((score for score in there.end.scores if score.lens == step.found.lens), None)
    if any(score.lens == step.found.lens for score in there.left_over):
        return "unnamed", f"through the same lens ({step.found.lens}) something without a name is left over there"
    if step.effect in LEAKS:
        source = step.parameters["source"].value
        if source not in other.axes:
            return "too_faint", f"{source} is not in it"
        return "may_differ", f"how much of it is seen depends on how {source} moves"
    if seen is None or not shown.gap > 0.0:
        return "may_differ", f"the lens that found it ({step.found.lens}) tells nothing of its size there"
    growth = _growth(step, shown.seconds, other.seconds, seen)
    if growth is None:
        return "too_faint", "no changing temperature was recorded"
    return _beside(growth * shown.gap, growth, seen, other.seconds)


def _beside(expected: float, growth: float, seen: Score, seconds: float) -> tuple[Meaning, str]:
    said = (
        f"at the size seen elsewhere, its {seconds:.6g} s would show a gap of about {expected:.1f} ({seen.lens}), "
        f"and the threshold of {seen.threshold:.1f} is not passed"
    )
    # a gap scatters by one standard deviation, the one that the expectation is scaled from as well
    enough = seen.threshold + CLEARLY * hypot(1.0, growth)
    return ("contradiction" if expected > enough else "too_faint"), said


def _growth(step: Step, seconds: float, other_s: float, seen: Score) -> float | None:
    """The gap of the other recording over that of the one, for the same size; None: it cannot be seen at all."""
    longer = other_s / seconds
    if step.effect == "rate_ramp":
        # its power grows with the length cubed beside white noise, with the length beside a random walk
        return min(sqrt(longer), longer * sqrt(longer))
    if step.effect not in WARMTH:
        return sqrt(longer)
    here, there = step.found.where.temperature, seen.where.temperature
    if there is None or not there[1] > there[0]:
        return None
    swing = 1.0 if here is None or not here[1] > here[0] else (there[1] - there[0]) / (here[1] - here[0])
    return sqrt(longer) * swing


def _other_name(step: Step, of: AxisResult, there: AxisResult) -> str:
    """An effect that only the other has, if one of the two was the other's runner-up."""
    mine = {one.effect for one in of.steps}
    for one in there.steps:
        rivals = step.effect in _names(one) or one.effect in _names(step)
        if one.kind == step.kind == "added" and one.effect not in mine and rivals:
            return one.effect
    return ""


def _names(step: Step) -> set[str]:
    return {one.effect for one in step.runners_up}
