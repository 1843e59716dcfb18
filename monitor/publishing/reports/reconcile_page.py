"""Report of a reconciliation as a self-contained HTML page, ``report.html``.

The page needs no network. It holds a summary, a table of the axes, and a section for each step. A section shows where
measurement and model differed, the added or changed effect with its parameters, and every diagnostic before and after.
Axes that agree with the model share a table of their diagnostics. Sentences and units come from
``reconcile_sentences``, drawings from ``reconcile_chart``; this module arranges them. Jinja2 is imported when a page
is requested. Equal results give equal pages.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.common.units import format_duration
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots.allan_figure import COLOURS, DARK, GREY
from monitor.publishing.plots.reconcile_chart import BAND, PLACE, chart, near, view_at
from monitor.publishing.plots.ruler import Ruler
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.reports.reconcile_sentences import Parameter
from monitor.reconcile.result import AxisResult, DiagnosticSnapshot, Reconciliation, ReconciliationStep, Score

TEMPLATE: Final = "reconcile.html.j2"
MISSING: Final = 'Jinja2 is needed: pip install "imu-monitor[plot]"'
RANGE_PLOT_PX: Final = (840.0, 330.0)  # plot of a range in its diagnostic, without a detail plot
RANGE_PLOT_WITH_DETAIL_PX: Final = (500.0, 330.0)  # the same plot next to a detail plot
DETAIL_PLOT_PX: Final = (340.0, 330.0)  # detail plot of the range
PAIR_PLOT_PX: Final = (670.0, 230.0)
SINGLE_PLOT_PX: Final = (335.0, 200.0)
BAR_PX: Final = (240.0, 22.0)
BAR_LIMITS: Final = (0.05, 20.0)  # smallest range of gap over threshold on a bar
ABOVE_THRESHOLD_COLOUR: Final = "#b3261e"  # colour of a gap above its threshold
BELOW_THRESHOLD_COLOUR: Final = "#1b7f4d"


@dataclass(frozen=True, slots=True)
class Row:
    """Row of one axis in the table at the top."""

    axis: str
    colour: str
    verdict: str  # as in the JSON
    word: str
    steps: tuple[tuple[str, str, str], ...]  # kind, effect with parameters, confidence
    left_over: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DiagnosticRow:
    """Row of one diagnostic in a step, with its gaps as text."""

    name: str
    place: str
    before: str
    after: str  # "" if there is only one model
    threshold: str
    null95: str
    open_before: bool
    open_after: bool
    bar: str  # SVG


@dataclass(frozen=True, slots=True)
class StepPart:
    """Section of the page for one step."""

    title: str
    means: str
    because: str
    found: str
    where: tuple[str, ...]  # SVG: the diagnostic and a detail of the range; empty if no diagnostic has a plot
    parameters: tuple[Parameter, ...]
    confidence: str
    why_not: str
    held_out: str
    lenses: tuple[DiagnosticRow, ...]
    pairs: tuple[str, ...]  # SVG of each diagnostic, before and after


@dataclass(frozen=True, slots=True)
class AxisPart:
    """Section of the page for one axis."""

    axis: str
    colour: str
    verdict: str
    word: str
    line: str
    steps: tuple[StepPart, ...]
    left_over: tuple[tuple[str, tuple[str, ...]], ...]  # description and SVG of the range
    lenses: tuple[DiagnosticRow, ...]  # only of an axis without steps
    views: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Agreeing:
    """Section of the page for all axes that agree with the model."""

    axes: tuple[tuple[str, str], ...]  # name and colour
    rows: tuple[tuple[str, tuple[str, ...]], ...]  # diagnostic; gap and threshold of each axis
    views: tuple[tuple[str, ...], ...]  # SVG of each axis


def render_page(r: Reconciliation, title: str = "") -> str:
    """Return the page as text.

    Parameters
    ----------
    r
        Result of the reconciliation.
    title
        Title of the page.

    Raises
    ------
    ConfigError
        Jinja2 is missing.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise ConfigError(MISSING) from error
    environment = Environment(
        loader=PackageLoader("monitor.publishing.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    results = [r.axes[axis] for axis in AXES if axis in r.axes]
    return environment.get_template(TEMPLATE).render(
        title=title or "Recording",
        verdict=r.verdict,
        word=words.RESULT_TEXTS[r.verdict],
        summary=words.summary(r),
        facts=facts(r),
        rows=[_row(r, result) for result in results],
        parts=[_axis(r, result) for result in results if result.verdict != "agrees"],
        agreeing=_agreeing([result for result in results if result.verdict == "agrees"]),
        notes=r.notes,
        model=str(r.model),
        colours={
            "dark": DARK,
            "band": BAND,
            "place": PLACE,
            "open": ABOVE_THRESHOLD_COLOUR,
            "closed": BELOW_THRESHOLD_COLOUR,
        },
    )


def facts(r: Reconciliation) -> tuple[tuple[str, str], ...]:
    """Return names and values that describe the recording and the model."""
    return (
        ("rate", f"{r.rate_hz:.6g} Hz"),
        ("samples", f"{r.samples:,}"),
        ("duration", format_duration(r.duration_s)),
        ("model under test", "five classic terms, fitted first" if r.fitted_first else "as given"),
        ("seed", str(r.seed)),
    )


def _row(r: Reconciliation, result: AxisResult) -> Row:
    """Return the row of one axis."""
    did = tuple(
        (step.kind, words.step_line(step, result.axis, r.baseline), words.percent(step.confidence))
        for step in result.steps
    )
    left = tuple(words.score_line(one, result.axis) for one in result.left_over)
    return Row(result.axis, _colour(result.axis), result.verdict, words.RESULT_TEXTS[result.verdict], did, left)


def _axis(r: Reconciliation, result: AxisResult) -> AxisPart:
    """Return the section of one axis."""
    looks = [result.start, *(step.look for step in result.steps)]
    steps = tuple(
        _step(r, result.axis, i, step, before)
        for i, (step, before) in enumerate(zip(result.steps, looks, strict=False), start=1)
    )
    left = tuple(
        (words.score_line(one, result.axis), _plots_of_range(result.end, one, result.axis)) for one in result.left_over
    )
    alone = not result.steps
    return AxisPart(
        result.axis,
        _colour(result.axis),
        result.verdict,
        words.RESULT_TEXTS[result.verdict],
        words.verdict_line(result),
        steps,
        left,
        _lenses(result.start, None, result.axis) if alone else (),
        _first_model_plots(result) if alone else (),
    )


def _agreeing(results: Sequence[AxisResult]) -> Agreeing:
    """Return the section of the axes that agree with the model."""
    lenses = list(dict.fromkeys(score.lens for result in results for score in result.start.scores))
    gaps = [{score.lens: _of_threshold(score) for score in result.start.scores} for result in results]
    return Agreeing(
        tuple((result.axis, _colour(result.axis)) for result in results),
        tuple((words.diagnostic_name(lens), tuple(known.get(lens, "—") for known in gaps)) for lens in lenses),
        tuple(_first_model_plots(result) for result in results),
    )


def _first_model_plots(result: AxisResult) -> tuple[str, ...]:
    """Return the plots of all diagnostics of an axis with the first model."""
    return tuple(chart([("", view)], result.axis, *SINGLE_PLOT_PX) for view in result.start.views)


def _of_threshold(score: Score) -> str:
    """Format a gap and its threshold."""
    return f"{words.format_gap(score.gap)} of {words.format_gap(score.threshold)}"


def _step(r: Reconciliation, axis: str, count: int, step: ReconciliationStep, before: DiagnosticSnapshot) -> StepPart:
    """Return the section of one step."""
    after = {view.lens: view for view in step.look.views}
    pairs = tuple(
        chart([("before", view), ("after", after[view.lens])], axis, *PAIR_PLOT_PX)
        for view in before.views
        if view.lens in after
    )
    return StepPart(
        title=f"Step {count}: {step.kind} {words.words_of(step.effect)}",
        means=EFFECTS[step.effect].description,
        because=step.because,
        found=words.score_line(step.found, axis),
        where=_plots_of_range(before, step.found, axis),
        parameters=words.parameters(step, axis, r.baseline),
        confidence=words.percent(step.confidence),
        why_not=words.alternatives_sentence(step),
        held_out=_held_out(step),
        lenses=_lenses(before, step.look, axis),
        pairs=pairs,
    )


def _held_out(step: ReconciliationStep) -> str:
    """Return how the gap changed on the held-out data, which were not used to choose the effect."""
    before, after = step.held_out_before, step.held_out_after
    if before is None or after is None:
        return f"None: {step.held_out_reason}."
    return (
        f"{words.format_gap(before.gap)} → {words.format_gap(after.gap)}, threshold {words.format_gap(after.threshold)}"
    )


def _plots_of_range(look: DiagnosticSnapshot, found: Score, axis: str) -> tuple[str, ...]:
    """Return the plot that shows a range best, and a detail plot if the range is narrow."""
    view = view_at(look.views, found.lens, found.where)
    if view is None:
        return ()
    part = near(view, found.where)
    if part is None:
        return (chart([("", view)], axis, *RANGE_PLOT_PX, where=found.where),)
    whole = chart([("", view)], axis, *RANGE_PLOT_WITH_DETAIL_PX, where=replace(found.where, source=None))
    return whole, chart([("", part)], axis, *DETAIL_PLOT_PX, where=found.where)


def _lenses(before: DiagnosticSnapshot, after: DiagnosticSnapshot | None, axis: str) -> tuple[DiagnosticRow, ...]:
    """Return the rows of all diagnostics, before and after a step; without ``after``, only ``before`` is filled."""
    later = {} if after is None else {score.lens: score for score in after.scores}
    pairs = [(score, later.get(score.lens)) for score in before.scores]
    largest = max((words.gap_ratio(one) for pair in pairs for one in pair if one is not None), default=1.0)
    ruler = Ruler(BAR_LIMITS[0], max(BAR_LIMITS[1], 1.3 * largest), True, 8.0, BAR_PX[0] - 8.0)
    return tuple(_lens(score, other, axis, ruler) for score, other in pairs)


def _lens(score: Score, later: Score | None, axis: str, ruler: Ruler) -> DiagnosticRow:
    """Return the row of one diagnostic."""
    deciding = later or score
    return DiagnosticRow(
        words.diagnostic_name(score.lens),
        words.format_range(score.where, axis),
        words.format_gap(score.gap),
        "" if later is None else words.format_gap(later.gap),
        words.format_gap(deciding.threshold),
        words.format_gap(deciding.null95),
        score.passes,
        later is not None and later.passes,
        _bar(score, later, ruler),
    )


def _bar(score: Score, later: Score | None, ruler: Ruler) -> str:
    """Return the SVG of gap over threshold: a ring before, a dot after, a line at the threshold."""
    wide, high = BAR_PX
    at = [_on_strip(one, ruler) for one in (score, later) if one is not None]
    one = _on_strip(None, ruler)
    parts = [
        f'<line x1="8" x2="{wide - 8:g}" y1="{high / 2:g}" y2="{high / 2:g}" stroke="#ddd"/>',
        f'<line x1="{one:.1f}" x2="{one:.1f}" y1="2" y2="{high - 2:g}" stroke="{GREY}" stroke-width="1.5"/>',
    ]
    if later is not None:
        parts.append(
            f'<line x1="{at[0]:.1f}" x2="{at[1]:.1f}" y1="{high / 2:g}" y2="{high / 2:g}" stroke="{GREY}" '
            'stroke-width="2"/>'
        )
        parts.append(f'<circle cx="{at[0]:.1f}" cy="{high / 2:g}" r="4.5" fill="#fff" stroke="{_gap_colour(score)}" '
                     'stroke-width="2"/>')  # fmt: skip
    parts.append(f'<circle cx="{at[-1]:.1f}" cy="{high / 2:g}" r="4.8" fill="{_gap_colour(later or score)}"/>')
    return f'<svg class="bar" viewBox="0 0 {wide:g} {high:g}">{"".join(parts)}</svg>'


def _on_strip(score: Score | None, ruler: Ruler) -> float:
    """Return the position of a gap, or of the threshold, on a bar [px]; a gap of zero is drawn at the left end."""
    share = 1.0 if score is None else max(words.gap_ratio(score), ruler.low)
    return float(ruler.at(np.array([share]))[0])


def _gap_colour(score: Score) -> str:
    """Return the colour of a gap: above or below its threshold."""
    return ABOVE_THRESHOLD_COLOUR if score.passes else BELOW_THRESHOLD_COLOUR


def _colour(axis: str) -> str:
    """Return the colour of an axis."""
    return COLOURS[AXES.index(axis) % 3]
