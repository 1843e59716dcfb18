"""HTML reports of a reconciliation and of the comparison of several recordings, ``report.html``.

The pages are self-contained. The report of one recording begins with the summary, the Allan deviation of each axis that
differs, and the ranked findings. A collapsible section contains a table of the axes and, for each step, all diagnostics
before and after the step. The comparison contains a summary, the results of each recording, and the noise effects that
were found. If an effect was not found in a recording, the page states why it may be absent.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import log
from typing import Final

from drivers.data_types import AXES
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem, format_duration
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots import reconcile_figures, style
from monitor.publishing.plots.reconcile_figures import (
    allan_before_and_after_svg,
    before_and_after_svgs,
    diagnostic_comparison_svg,
    interval_chart_svg,
    select_diagnostic_view,
    zoomed_view,
)
from monitor.publishing.plots.style import axis_colour
from monitor.publishing.reports import reconcile_sentences, recording_comparison_sentences
from monitor.publishing.reports.html_page import render_template
from monitor.publishing.reports.reconcile_sentences import FormattedParameter, parameter_unit, readable_name
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisModelDiagnostics,
    AxisResult,
    DiagnosticGap,
    Reconciliation,
)
from monitor.reconcile.several_recordings.comparison import EffectInRecordings, RecordingsComparison
from monitor.reconcile.summary import summary_sentences
from monitor.reconcile.summary.ranked_findings import GapRanking, rank_findings
from monitor.reconcile.summary.summary_sentences import summarize

RANGE_INCHES: Final = (8.0, 3.3)  # size of a plot without a detail plot
RANGE_WITH_DETAIL_INCHES: Final = (4.9, 3.3)  # size of a plot next to a detail plot
DETAIL_INCHES: Final = (3.33, 3.3)
PAIR_INCHES: Final = (6.8, 2.35)
SINGLE_INCHES: Final = (3.4, 2.05)
MIN_MARKED_LOG_RATIO: Final = 0.01
"""Smallest logarithmic change of the Allan deviation that is marked, about the width of a line in the figure."""


def render_page(r: Reconciliation, title: str = "", units: UnitSystem = DEFAULT_UNITS) -> str:
    """Return the HTML report of a reconciliation as text.

    Parameters
    ----------
    r
        Result of the reconciliation.
    title
        Title of the page.
    units
        Unit system.

    Raises
    ------
    ConfigError
        If matplotlib or Jinja2 is not installed.
    """
    ranking = rank_findings(r)
    return render_template(
        "reconcile.html.j2",
        summary=summarize(r),
        ranking=ranking,
        summary_words=summary_sentences,
        allan_figures=draw_differing_allan_deviations(r, ranking, units),
        title=title or "Recording",
        r=r,
        results=_sort_by_axis(r),
        facts=(
            ("rate", f"{r.rate_hz:.6g} Hz"),
            ("samples", f"{r.samples:,}"),
            ("duration", format_duration(r.duration_s)),
            ("model under test", "five classic terms, fitted first" if r.fitted_first else "as given"),
            ("seed", str(r.seed)),
        ),
        words=reconcile_sentences,
        units=units,
        effects=EFFECTS,
        figures=reconcile_figures,
        colours=style,
        snapshots=lambda result: [result.start, *(step.snapshot_after for step in result.steps)],
        pair_scores=_pair_scores,
        scores_by_diagnostic=_scores_by_diagnostic,
        draw_range=partial(_draw_range, units=units),
        draw_pairs=partial(_draw_pairs, units=units),
        draw_singles=partial(_draw_singles, units=units),
    )


def draw_differing_allan_deviations(
    r: Reconciliation, ranking: GapRanking, units: UnitSystem = DEFAULT_UNITS
) -> list[str]:
    """For each axis that differs from the model, draw the Allan deviation before and after the search as SVG elements.

    Parameters
    ----------
    r
        Result of the reconciliation.
    ranking
        Ranked findings, whose numbers mark the averaging times at which they change the Allan deviation most.
    units
        Unit system.

    Raises
    ------
    ConfigError
        If matplotlib is not installed.
    """
    drawn = (_draw_allan(result, ranking, units) for result in _sort_by_axis(r) if result.verdict != "agrees")
    return [figure for figure in drawn if figure is not None]


def _sort_by_axis(r: Reconciliation) -> list[AxisResult]:
    return [r.axes[axis] for axis in AXES if axis in r.axes]


def _draw_allan(result: AxisResult, ranking: GapRanking, units: UnitSystem) -> str | None:
    """Draw the Allan deviation before and after the search. The marks are the numbers of the findings."""
    before, after = (
        next((view for view in snapshot.plots if view.diagnostic == "allan"), None)
        for snapshot in (result.start, result.end)
    )
    if before is None or after is None:
        return None
    marks: dict[float, str] = {}
    for number, one in enumerate(ranking.findings, start=1):
        influence = one.influences.get(result.axis)
        if influence is not None and abs(log(influence.ratio)) > MIN_MARKED_LOG_RATIO:
            known = marks.get(influence.tau_s)
            marks[influence.tau_s] = f"{known}, {number}" if known else str(number)
    return allan_before_and_after_svg(before, after, result.axis, marks, units)


def _pair_scores(
    before: Sequence[DiagnosticGap], after: Sequence[DiagnosticGap]
) -> list[tuple[DiagnosticGap, DiagnosticGap | None]]:
    later = {score.diagnostic: score for score in after}
    return [(score, later.get(score.diagnostic)) for score in before]


def _scores_by_diagnostic(results: Sequence[AxisResult]) -> list[tuple[str, list[DiagnosticGap | None]]]:
    known = [{score.diagnostic: score for score in result.start.gaps} for result in results]
    return [
        (diagnostic, [scores.get(diagnostic) for scores in known])
        for diagnostic in dict.fromkeys(one for k in known for one in k)
    ]


def _draw_singles(result: AxisResult, units: UnitSystem) -> list[str]:
    """Draw the Allan deviation and the diagnostics with a significant gap, before the search."""
    drawn = _drawn_diagnostics(result.start)
    views = [view for view in result.start.plots if view.diagnostic in drawn]
    return [diagnostic_comparison_svg([("", view)], result.axis, *SINGLE_INCHES, units=units) for view in views]


def _draw_pairs(before: AxisModelDiagnostics, after: AxisModelDiagnostics, axis: str, units: UnitSystem) -> list[str]:
    """Draw the diagnostics with a significant gap, before and after a step."""
    later, drawn = {view.diagnostic: view for view in after.plots}, _drawn_diagnostics(before) - {"allan"}
    pairs = [(view, later[view.diagnostic]) for view in before.plots if view.diagnostic in drawn & set(later)]
    return before_and_after_svgs(pairs, axis, *PAIR_INCHES, units)


def _drawn_diagnostics(snapshot: AxisModelDiagnostics) -> set[str]:
    return {"allan"} | {gap.diagnostic for gap in snapshot.gaps if gap.is_significant}


def _draw_range(snapshot: AxisModelDiagnostics, found: DiagnosticGap, axis: str, units: UnitSystem) -> list[str]:
    view = select_diagnostic_view(snapshot.plots, found.diagnostic, found.where)
    if view is None:
        return []
    draw, detail = partial(diagnostic_comparison_svg, axis=axis, units=units), zoomed_view(view, found.where)
    if detail is None:
        width, height = RANGE_INCHES
        return [draw([("", view)], width=width, height=height, where=found.where)]
    (width, height), (detail_width, detail_height) = RANGE_WITH_DETAIL_INCHES, DETAIL_INCHES
    whole = draw([("", view)], width=width, height=height, where=replace(found.where, source=None))
    return [whole, draw([("", detail)], width=detail_width, height=detail_height, where=found.where)]


def render_comparison_page(c: RecordingsComparison, units: UnitSystem = DEFAULT_UNITS) -> str:
    """Return the HTML report on the comparison of several recordings as text.

    Parameters
    ----------
    c
        Comparison of several recordings.
    units
        Unit system.

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
        units=units,
        comparison_words=recording_comparison_sentences,
        effects=EFFECTS,
        axis_colour=axis_colour,
        format_duration=format_duration,
        rows_of=_rows,
        parameters_of=lambda step, axis: _parameters_by_name(c, step, axis, units),
        draw_intervals=partial(_draw_intervals, units=units),
    )


def _rows(seen: EffectInRecordings) -> list[tuple[str, AddedOrResizedEffect]]:
    return [*seen.steps.items(), ("all together", seen.step_with_pooled_parameters())]


def _parameters_by_name(
    c: RecordingsComparison, step: AddedOrResizedEffect, axis: str, units: UnitSystem
) -> dict[str, FormattedParameter]:
    return {one.name: one for one in reconcile_sentences.format_parameters(step, axis, c.baseline, units)}


def _draw_intervals(seen: EffectInRecordings, axis: str, units: UnitSystem) -> str:
    """Return a chart of the first effect parameter that has intervals, or an empty string if no parameter has any."""
    name = next((name for name, one in seen.parameters.items() if one.freedom), "")
    rows = [(run, step.parameters[name]) for run, step in _rows(seen) if name in step.parameters]
    if not any(one.lo is not None and one.hi is not None and one.hi > one.lo for _, one in rows):
        return ""
    size = max(abs(one.value) for _, one in rows if not isinstance(one.value, str))
    unit = parameter_unit(seen.effect, name, axis, size, units)
    label = ", ".join(part for part in (readable_name(name), unit.name) if part)
    return interval_chart_svg(rows, f"{label}, with 95 % intervals", unit.factor, axis_colour(axis))
