"""HTML reports of a reconciliation and of the comparison of several recordings, ``report.html``.

The pages are self-contained. The report of one recording begins with the summary, the ranked findings, and the Allan
deviation of each axis that differs. A collapsible section contains each step and all diagnostics of these axes. An axis
that agrees is shown as one collapsible line. The comparison contains a summary, the results of each recording, and the
noise effects that were found. If an effect was not found in a recording, the page states why it may be absent.
"""

from dataclasses import dataclass, replace
from functools import partial
from math import log
from typing import Final

from drivers.data_types import AXES
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem, format_duration
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots import reconcile_figures, style
from monitor.publishing.plots.reconcile_figures import (
    allan_before_and_after_svg,
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
    DiagnosticPlotData,
    Reconciliation,
    comparable_allan_deviations,
)
from monitor.reconcile.several_recordings.comparison import EffectInRecordings, RecordingsComparison
from monitor.reconcile.summary import summary_sentences
from monitor.reconcile.summary.ranked_findings import GapRanking, rank_findings
from monitor.reconcile.summary.summary_sentences import summarize

RANGE_INCHES: Final = (8.0, 3.3)  # size of a plot without a detail plot
RANGE_WITH_DETAIL_INCHES: Final = (4.9, 3.3)  # size of a plot next to a detail plot
DETAIL_INCHES: Final = (3.33, 3.3)
PANEL_INCHES: Final = (3.4, 2.35)
MIN_MARKED_LOG_RATIO: Final = 0.01
"""Smallest logarithmic change of the Allan deviation that is marked, about the width of a line in the figure."""


@dataclass(frozen=True, slots=True)
class _ShownRange:
    """Difference of one diagnostic, and the plot data that show its range."""

    gap: DiagnosticGap
    before: DiagnosticPlotData | None
    after: DiagnosticPlotData | None  # after the search


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
        main=summary_sentences.main_findings(ranking),
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
        ranges=_ranges,
        gaps_by_diagnostic=_gaps_by_diagnostic,
        draw_range=partial(_draw_range, units=units),
        draw_other_diagnostics=partial(_draw_other_diagnostics, units=units),
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
    return [_draw_allan(result, ranking, units) for result in _sort_by_axis(r) if result.verdict != "agrees"]


def _sort_by_axis(r: Reconciliation) -> list[AxisResult]:
    return [r.axes[axis] for axis in AXES if axis in r.axes]


def _draw_allan(result: AxisResult, ranking: GapRanking, units: UnitSystem) -> str:
    """Draw the Allan deviation before and after the search. The marks are the numbers of the findings."""
    before, after = comparable_allan_deviations(result.start, result.end)
    marks: dict[float, str] = {}
    for number, one in enumerate(ranking.findings, start=1):
        influence = one.influences.get(result.axis)
        if influence is not None and abs(log(influence.ratio)) > MIN_MARKED_LOG_RATIO:
            known = marks.get(influence.tau_s)
            marks[influence.tau_s] = f"{known}, {number}" if known else str(number)
    return allan_before_and_after_svg(before, after, result.axis, marks, units)


def _snapshots(result: AxisResult) -> list[AxisModelDiagnostics]:
    """Return the diagnostics before the search and after each step."""
    return [result.start, *(step.snapshot_after for step in result.steps)]


def _gaps_by_diagnostic(result: AxisResult) -> list[list[DiagnosticGap | None]]:
    """For each diagnostic, return the gap before the search and after each step."""
    known = [{gap.diagnostic: gap for gap in snapshot.gaps} for snapshot in _snapshots(result)]
    return [[gaps.get(diagnostic) for gaps in known] for diagnostic in known[0]]


def _draw_other_diagnostics(result: AxisResult, units: UnitSystem) -> list[tuple[int, str]]:
    """Draw the significant diagnostics before and after the search, without the panels that the page already shows.

    For each axis that differs, the page shows the Allan deviation, the diagnostic that led to each step, and any
    diagnostic that is still significant. Return the number of panels and the SVG element of each figure.
    """
    if result.verdict == "agrees":
        views = [view for view in result.start.plots if view.diagnostic == "allan"]
        return [(1, diagnostic_comparison_svg([("", view)], result.axis, *PANEL_INCHES, units=units)) for view in views]
    shown = {id(view) for one in _ranges(result) for view in (one.before, one.after)}
    significant = {gap.diagnostic for gap in result.start.gaps if gap.is_significant} - {"allan"}
    ends = [("before", result.start), ("after", result.end)] if result.steps else [("", result.start)]
    drawn = []
    for name in (view.diagnostic for view in result.start.plots if view.diagnostic in significant):
        panels = [(title, view) for title, end in ends for view in end.plots if view.diagnostic == name]
        panels = [(title, view) for title, view in panels if id(view) not in shown]
        if panels:
            width, height = PANEL_INCHES
            drawn.append(
                (len(panels), diagnostic_comparison_svg(panels, result.axis, width * len(panels), height, units=units))
            )
    return drawn


def _ranges(result: AxisResult) -> list[_ShownRange]:
    """Return the range of each step, and then of each remaining difference, with the diagnostics that show it.

    A range is shown before its step and, if no later figure shows the same diagnostic, after the search.
    """
    gaps = [*zip(_snapshots(result), (step.before for step in result.steps), strict=False)]
    gaps += [(result.end, gap) for gap in result.left_over]
    views = [select_diagnostic_view(snapshot.plots, gap.diagnostic, gap.where) for snapshot, gap in gaps]
    found = []
    for at, ((_, gap), view) in enumerate(zip(gaps, views, strict=True)):
        after = None
        if view is not None and view.diagnostic not in {later.diagnostic for later in views[at + 1 :] if later}:
            after = next((one for one in result.end.plots if one.diagnostic == view.diagnostic), None)
        found.append(_ShownRange(gap, view, after if at < len(result.steps) else None))
    return found


def _draw_range(shown: _ShownRange, axis: str, units: UnitSystem) -> list[str]:
    """Draw a range and, if it is narrow, its surroundings in detail. The figures are side by side or a column."""
    if shown.before is None:
        return []
    where = shown.gap.where
    draw, detail = partial(diagnostic_comparison_svg, axis=axis, units=units), zoomed_view(shown.before, where)
    width, height = RANGE_INCHES
    if shown.after is not None:
        panels = [[("before", shown.before), ("after", shown.after)]]
        detail_after = zoomed_view(shown.after, where)
        if detail is not None and detail_after is not None:
            panels.append([("before", detail), ("after", detail_after)])
        return ["".join(draw(pair, width=width, height=height, where=where) for pair in panels)]
    if detail is None:
        return [draw([("", shown.before)], width=width, height=height, where=where)]
    (width, height), (detail_width, detail_height) = RANGE_WITH_DETAIL_INCHES, DETAIL_INCHES
    whole = draw([("", shown.before)], width=width, height=height, where=replace(where, source=None))
    return [whole, draw([("", detail)], width=detail_width, height=detail_height, where=where)]


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
