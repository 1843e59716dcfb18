"""Sentences about a comparison of several recordings, used by the page and the terminal.

Functions convert the types of ``monitor.reconcile.several_recordings.comparison`` into short text, with the units and
digits of ``reconcile_sentences``.
"""

from typing import Final

from monitor.common.units import format_number
from monitor.noise.model import NoiseModel
from monitor.publishing.reports import reconcile_sentences as words
from monitor.reconcile.result import AxisResult
from monitor.reconcile.several_recordings.comparison import Comparison, MatchedEffect

MEANINGS: Final = {
    "contradiction": "contradicts it",
    "too_faint": "too faint to say",
    "other_name": "another name there",
    "unnamed": "unnamed there",
    "may_differ": "may differ",
}
"""Meaning of the absence of an effect in a recording, in two or three words."""
NO_EFFECTS: Final = "nothing"


def summary(c: Comparison) -> str:
    """Return a few sentences on common effects and on effects of some recordings only."""
    model = "the model" if c.fitted_to is None else f"the five classic terms, fitted to {c.fitted_to}"
    if c.verdict == "agrees":
        return f"{len(c.runs)} recordings beside {model}: none differs by more than chance."
    common = [f"{_effect_name(seen)} ({axis})" for axis, one in c.axes.items() for seen in one.common]
    single = [
        f"{_effect_name(seen)} ({axis}, {', '.join(seen.steps)})" for axis, one in c.axes.items() for seen in one.single
    ]
    said = [
        f"{len(c.runs)} recordings beside {model}.",
        f"Common to all: {'; '.join(common) or NO_EFFECTS}.",
        f"In some only: {'; '.join(single) or NO_EFFECTS}.",
    ]
    return " ".join(said)


def effect_line(seen: MatchedEffect, axis: str, baseline: NoiseModel) -> str:
    """Return one line with an effect and its pooled parameters.

    Parameters
    ----------
    seen
        Effect in several recordings.
    axis
        Name of the axis.
    baseline
        Model under test.
    """
    return words.step_line(seen.step(), axis, baseline)


def size_agreement(seen: MatchedEffect) -> str:
    """Return whether the sizes of an effect agree between the recordings, with the p-value."""
    if seen.p is None:
        return "nothing to compare"
    return f"sizes {'agree' if seen.consistent else 'differ'} ({probability(seen.p)})"


def probability(p: float) -> str:
    """Format a p-value.

    >>> probability(0.413), probability(2e-5)
    ('p = 0.41', 'p < 0.001')
    """
    return "p < 0.001" if p < 0.001 else f"p = {format_number(p, 2)}"


def axis_summary(result: AxisResult | None) -> str:
    """Return a short description of one axis in one recording, shown next to its result."""
    if result is None:
        return "not recorded"
    named = f"{len(result.steps)} effect{'' if len(result.steps) == 1 else 's'}" if result.steps else ""
    left = f"{len(result.left_over)} left over" if result.left_over else ""
    return ", ".join(one for one in (named, left) if one)


def _effect_name(seen: MatchedEffect) -> str:
    """Return the name of an effect, with a remark if it is a changed term of the model."""
    return words.words_of(seen.effect) + (" of another size" if seen.kind == "retuned" else "")
