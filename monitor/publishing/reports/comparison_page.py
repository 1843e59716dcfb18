"""HTML report on the comparison of several recordings of one sensor, ``report.html``.

The self-contained page contains a summary, the results of each recording, and the noise effects that were found. If an
effect was not found in a recording, the page states why it may be absent.
"""

from monitor.common.unit_formatting import format_duration
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots.reconcile_figures import interval_chart_svg
from monitor.publishing.plots.style import axis_colour
from monitor.publishing.reports import reconcile_sentences, recording_comparison_sentences
from monitor.publishing.reports.html_page import render_template
from monitor.publishing.reports.reconcile_sentences import FormattedParameter, parameter_unit, readable_name
from monitor.reconcile.result import AddedOrResizedEffect
from monitor.reconcile.several_recordings.comparison import EffectInRecordings, RecordingsComparison


def render_page(c: RecordingsComparison) -> str:
    """Return the HTML report on the comparison of several recordings as text.

    Raises
    ------
    ConfigError
        If matplotlib or Jinja2 is not installed.
    """
    return render_template(
        "reconcile_runs.html.j2",
        title=f"{len(c.runs)} recordings of one sensor",
        c=c,
        words=reconcile_sentences,
        comparison_words=recording_comparison_sentences,
        effects=EFFECTS,
        axis_colour=axis_colour,
        format_duration=format_duration,
        rows_of=_rows,
        parameters_of=lambda step, axis: _parameters_by_name(c, step, axis),
        draw_intervals=_draw_intervals,
    )


def _rows(seen: EffectInRecordings) -> list[tuple[str, AddedOrResizedEffect]]:
    return [*seen.steps.items(), ("all together", seen.step_with_pooled_parameters())]


def _parameters_by_name(
    c: RecordingsComparison, step: AddedOrResizedEffect, axis: str
) -> dict[str, FormattedParameter]:
    return {one.name: one for one in reconcile_sentences.format_parameters(step, axis, c.baseline)}


def _draw_intervals(seen: EffectInRecordings, axis: str) -> str:
    """Return a chart of the first effect parameter that has intervals, or an empty string if no parameter has any."""
    name = next((name for name, one in seen.parameters.items() if one.freedom), "")
    rows = [(run, step.parameters[name]) for run, step in _rows(seen) if name in step.parameters]
    if not any(one.lo is not None and one.hi is not None and one.hi > one.lo for _, one in rows):
        return ""
    size = max(abs(one.value) for _, one in rows if not isinstance(one.value, str))
    unit = parameter_unit(seen.effect, name, axis, size)
    label = ", ".join(part for part in (readable_name(name), unit.name) if part)
    return interval_chart_svg(rows, f"{label}, with 95 % intervals", unit.factor, axis_colour(axis))
