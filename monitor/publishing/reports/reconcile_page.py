"""HTML report of a reconciliation, ``report.html``.

The page is self-contained and contains a summary, a table of the axes, and a section for each step. A section shows the
added or changed noise effect, and all diagnostics before and after the step.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from drivers.data_types import AXES
from monitor.common.units import format_duration
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots import reconcile_figures, style
from monitor.publishing.plots.reconcile_figures import diagnostic_comparison_svg, select_diagnostic_view, zoomed_view
from monitor.publishing.reports import reconcile_sentences
from monitor.publishing.reports.html_page import render_template
from monitor.reconcile.result import AxisResult, DiagnosticGap, DiagnosticSnapshot, PlotData, Reconciliation

RANGE_INCHES: Final = (8.0, 3.3)  # size of a plot without a detail plot
RANGE_WITH_DETAIL_INCHES: Final = (4.9, 3.3)  # size of a plot next to a detail plot
DETAIL_INCHES: Final = (3.33, 3.3)
PAIR_INCHES: Final = (6.8, 2.35)
SINGLE_INCHES: Final = (3.4, 2.05)


def render_page(r: Reconciliation, title: str = "") -> str:
    """Return the HTML report of a reconciliation as text.

    Parameters
    ----------
    r
        Result of the reconciliation.
    title
        Title of the page.

    Raises
    ------
    ConfigError
        If matplotlib or Jinja2 is not installed.
    """
    return render_template(
        "reconcile.html.j2",
        title=title or "Recording",
        r=r,
        results=[r.axes[axis] for axis in AXES if axis in r.axes],
        facts=(
            ("rate", f"{r.rate_hz:.6g} Hz"),
            ("samples", f"{r.samples:,}"),
            ("duration", format_duration(r.duration_s)),
            ("model under test", "five classic terms, fitted first" if r.fitted_first else "as given"),
            ("seed", str(r.seed)),
        ),
        words=reconcile_sentences,
        effects=EFFECTS,
        figures=reconcile_figures,
        colours=style,
        snapshots=lambda result: [result.start, *(step.snapshot_after for step in result.steps)],
        pair_scores=_pair_scores,
        scores_by_diagnostic=_scores_by_diagnostic,
        draw_range=_draw_range,
        draw_pairs=_draw_pairs,
        draw_single=_draw_single,
    )


def _pair_scores(
    before: Sequence[DiagnosticGap], after: Sequence[DiagnosticGap]
) -> list[tuple[DiagnosticGap, DiagnosticGap | None]]:
    later = {score.lens: score for score in after}
    return [(score, later.get(score.lens)) for score in before]


def _scores_by_diagnostic(results: Sequence[AxisResult]) -> list[tuple[str, list[DiagnosticGap | None]]]:
    known = [{score.lens: score for score in result.start.gaps} for result in results]
    return [(lens, [scores.get(lens) for scores in known]) for lens in dict.fromkeys(one for k in known for one in k)]


def _draw_single(view: PlotData, axis: str) -> str:
    return diagnostic_comparison_svg([("", view)], axis, *SINGLE_INCHES)


def _draw_pairs(before: DiagnosticSnapshot, after: DiagnosticSnapshot, axis: str) -> list[str]:
    later = {view.lens: view for view in after.plots}
    return [
        diagnostic_comparison_svg([("before", view), ("after", later[view.lens])], axis, *PAIR_INCHES)
        for view in before.plots
        if view.lens in later
    ]


def _draw_range(snapshot: DiagnosticSnapshot, found: DiagnosticGap, axis: str) -> list[str]:
    view = select_diagnostic_view(snapshot.plots, found.lens, found.where)
    if view is None:
        return []
    detail = zoomed_view(view, found.where)
    if detail is None:
        return [diagnostic_comparison_svg([("", view)], axis, *RANGE_INCHES, where=found.where)]
    whole = diagnostic_comparison_svg(
        [("", view)], axis, *RANGE_WITH_DETAIL_INCHES, where=replace(found.where, source=None)
    )
    return [whole, diagnostic_comparison_svg([("", detail)], axis, *DETAIL_INCHES, where=found.where)]
