"""Sentences about the comparison of several recordings, for the HTML report and the terminal."""

from collections.abc import Iterable
from typing import Final

from monitor.common.unit_formatting import format_number
from monitor.publishing.reports.reconcile_sentences import readable_name
from monitor.reconcile.result import AxisResult
from monitor.reconcile.several_recordings.comparison import EffectInRecordings, RecordingsComparison

ABSENCE_TEXTS: Final = {
    "contradiction": "contradicts it",
    "too_faint": "too faint to say",
    "other_name": "another name there",
    "unnamed": "unexplained there",
    "may_differ": "may differ",
}
"""Text for each reason why an effect was not found in a recording."""


def summarize(c: RecordingsComparison) -> str:
    """Return sentences that state which noise effects all recordings show and which only some recordings show."""
    model = "the model" if c.fitted_to is None else f"the five classic terms, fitted to {c.fitted_to}"
    compared = f"{len(c.runs)} recordings were compared with {model}."
    if c.verdict == "agrees":
        return f"{compared} None differs by more than chance."
    common = _list_effects((axis, seen) for axis, one in c.axes.items() for seen in one.common)
    single = _list_effects((axis, seen) for axis, one in c.axes.items() for seen in one.single)
    return f"{compared} Common to all: {common}. In some only: {single}."


def describe_absences(effect: EffectInRecordings) -> list[tuple[str, str, str]]:
    """Return the recordings that share a reason why they do not show an effect, the kind of reason, and the reason."""
    recordings: dict[tuple[str, str], list[str]] = {}
    for absence in effect.absent:
        recordings.setdefault((absence.meaning, absence.because), []).append(absence.run)
    return [(", ".join(names), meaning, because) for (meaning, because), names in recordings.items()]


def describe_size_agreement(effect: EffectInRecordings) -> str:
    """Describe whether the sizes of an effect agree between recordings, with the p-value."""
    if effect.p is None:
        return "nothing to compare"
    return f"sizes {'agree' if effect.sizes_agree else 'differ'} ({_format_p_value(effect.p)})"


def _format_p_value(p: float) -> str:
    """Format a p-value.

    >>> _format_p_value(0.413), _format_p_value(2e-5)
    ('p = 0.41', 'p < 0.001')
    """
    return "p < 0.001" if p < 0.001 else f"p = {format_number(p, 2)}"


def describe_finding_counts(result: AxisResult | None) -> str:
    """Describe how many effects and unexplained differences were found on one axis."""
    if result is None:
        return "not recorded"
    effects = f"{len(result.steps)} effect{'' if len(result.steps) == 1 else 's'}" if result.steps else ""
    left_over = f"{len(result.left_over)} left over" if result.left_over else ""
    return ", ".join(part for part in (effects, left_over) if part)


def _list_effects(found: Iterable[tuple[str, EffectInRecordings]]) -> str:
    """Return each effect once, followed by its axes, or ``nothing`` if there is no effect."""
    axes: dict[str, dict[str, None]] = {}
    for axis, seen in found:
        axes.setdefault(_name_effect(seen), {})[axis] = None
    return "; ".join(f"{name} ({', '.join(names)})" for name, names in axes.items()) or "nothing"


def _name_effect(seen: EffectInRecordings) -> str:
    name = readable_name(seen.effect)
    return {"retuned": f"{name} of another size", "absent": f"no {name}"}.get(seen.kind, name)
