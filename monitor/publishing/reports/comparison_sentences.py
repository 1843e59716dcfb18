"""What several recordings show together, in words: page and terminal take their sentences here.

In come the types of ``monitor.reconcile.several_recordings.comparison``, out go short texts, with the units and digits of ``reconcile_words``.
"""

from typing import Final

from monitor.noise.model import NoiseModel
from monitor.publishing.coefficient_cells import number
from monitor.publishing.reports import reconcile_sentences as words
from monitor.reconcile.result import AxisResult
from monitor.reconcile.several_recordings.comparison import Comparison, Seen

MEANINGS: Final = {
    "contradiction": "contradicts it",
    "too_faint": "too faint to say",
    "other_name": "another name there",
    "unnamed": "unnamed there",
    "may_differ": "may differ",
}
"""What the absence of an effect means, in two or three words."""
NO_EFFECTS: Final = "nothing"


def summary(c: Comparison) -> str:
    """What is common and what is not, in a few sentences."""
    model = "the model" if c.fitted_to is None else f"the five classic terms, fitted to {c.fitted_to}"
    if c.verdict == "agrees":
        return f"{len(c.runs)} recordings beside {model}: none differs by more than chance."
    common = [f"{_named(seen)} ({axis})" for axis, one in c.axes.items() for seen in one.common]
    single = [
        f"{_named(seen)} ({axis}, {', '.join(seen.steps)})" for axis, one in c.axes.items() for seen in one.single
    ]
    said = [
        f"{len(c.runs)} recordings beside {model}.",
        f"Common to all: {'; '.join(common) or NO_EFFECTS}.",
        f"In some only: {'; '.join(single) or NO_EFFECTS}.",
    ]
    return " ".join(said)


def line(seen: Seen, axis: str, baseline: NoiseModel) -> str:
    """An effect with its pooled parameters."""
    return words.step_line(seen.step(), axis, baseline)


def agreement(seen: Seen) -> str:
    """Whether its sizes are the same."""
    if seen.p is None:
        return "nothing to compare"
    return f"sizes {'agree' if seen.consistent else 'differ'} ({probability(seen.p)})"


def probability(p: float) -> str:
    """
    >>> probability(0.413), probability(2e-5)
    ('p = 0.41', 'p < 0.001')
    """
    return "p < 0.001" if p < 0.001 else f"p = {number(p, 2)}"


def cell(result: AxisResult | None) -> str:
    """One axis of one recording, beside its verdict."""
    if result is None:
        return "not recorded"
    named = f"{len(result.steps)} effect{'' if len(result.steps) == 1 else 's'}" if result.steps else ""
    left = f"{len(result.left_over)} left over" if result.left_over else ""
    return ", ".join(one for one in (named, left) if one)


def _named(seen: Seen) -> str:
    return words.plain(seen.effect) + (" of another size" if seen.kind == "retuned" else "")
