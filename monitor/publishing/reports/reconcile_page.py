"""A reconciliation as one self-contained page for people: ``report.html``.

In comes a ``Reconciliation``, out goes text that needs no network: the verdict in a sentence, a table of the axes, and
for every step where measurement and model differed, what was added or retuned and why, its parameters, and every lens
before and after. Axes of which nothing is to be said show their lenses in one row. Words and units come from
``reconcile_words``, drawings from ``reconcile_chart``; here it is decided what stands where. Jinja2 is imported when a
page is asked for; the same reconciliation gives the same page.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots.allan_figure import COLOURS, DARK, GREY
from monitor.publishing.plots.reconcile_chart import BAND, PLACE, chart, near, view_at
from monitor.publishing.plots.ruler import Ruler
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.reports.reconcile_sentences import Parameter
from monitor.publishing.rerun.panels import duration
from monitor.reconcile.result import AxisResult, Look, Reconciliation, Score, Step

TEMPLATE: Final = "reconcile.html.j2"
MISSING: Final = 'Jinja2 is needed: pip install "imu-monitor[plot]"'
WIDE_PX: Final = (840.0, 330.0)  # a place in its view
WHERE_PX: Final = (500.0, 330.0)  # the same, with
NEAR_PX: Final = (340.0, 330.0)  # what is round it
PAIR_PX: Final = (670.0, 230.0)
ONE_PX: Final = (335.0, 200.0)
BAR_PX: Final = (240.0, 22.0)
BAR_ENDS: Final = (0.05, 20.0)  # gap over threshold, at least
OPEN: Final = "#b3261e"  # a gap above its threshold
CLOSED: Final = "#1b7f4d"


@dataclass(frozen=True, slots=True)
class Row:
    """One axis of the table on top."""

    axis: str
    colour: str
    verdict: str  # as in the JSON
    word: str
    did: tuple[tuple[str, str, str], ...]  # kind, effect with parameters, confidence
    left_over: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LensRow:
    """One lens of one step: gaps as people read them."""

    name: str
    place: str
    before: str
    after: str  # "" where there is only one model
    threshold: str
    null95: str
    open_before: bool
    open_after: bool
    bar: str  # SVG


@dataclass(frozen=True, slots=True)
class StepPart:
    """What the page shows of one step."""

    title: str
    means: str
    because: str
    found: str
    where: tuple[str, ...]  # SVG: the view, and the part round the place; none where no lens has a picture
    parameters: tuple[Parameter, ...]
    confidence: str
    why_not: str
    held_out: str
    lenses: tuple[LensRow, ...]
    pairs: tuple[str, ...]  # SVG, before beside after


@dataclass(frozen=True, slots=True)
class AxisPart:
    """What the page shows of one axis."""

    axis: str
    colour: str
    verdict: str
    word: str
    line: str
    steps: tuple[StepPart, ...]
    left_over: tuple[tuple[str, tuple[str, ...]], ...]  # what, and where as SVG
    lenses: tuple[LensRow, ...]  # of an axis without steps
    views: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Agreeing:
    """All axes of which nothing is to be said."""

    axes: tuple[tuple[str, str], ...]  # name and colour
    rows: tuple[tuple[str, tuple[str, ...]], ...]  # lens; gap and threshold of each axis
    views: tuple[tuple[str, ...], ...]  # SVG, of each axis


def page(r: Reconciliation, title: str = "") -> str:
    """The page as text.

    Raises:
        ConfigError: Jinja2 is missing
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise ConfigError(MISSING) from error
    environment = Environment(
        loader=PackageLoader("monitor.publishing"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    results = [r.axes[axis] for axis in AXES if axis in r.axes]
    return environment.get_template(TEMPLATE).render(
        title=title or "Recording",
        verdict=r.verdict,
        word=words.VERDICTS[r.verdict],
        summary=words.summary(r),
        facts=facts(r),
        rows=[_row(r, result) for result in results],
        parts=[_axis(r, result) for result in results if result.verdict != "agrees"],
        agreeing=_agreeing([result for result in results if result.verdict == "agrees"]),
        notes=r.notes,
        model=str(r.model),
        colours={"dark": DARK, "band": BAND, "place": PLACE, "open": OPEN, "closed": CLOSED},
    )


def facts(r: Reconciliation) -> tuple[tuple[str, str], ...]:
    """What was compared: name and value."""
    return (
        ("rate", f"{r.rate_hz:.6g} Hz"),
        ("samples", f"{r.samples:,}"),
        ("duration", duration(r.seconds)),
        ("model under test", "five classic terms, fitted first" if r.fitted_first else "as given"),
        ("seed", str(r.seed)),
    )


def _row(r: Reconciliation, result: AxisResult) -> Row:
    did = tuple(
        (step.kind, words.step_line(step, result.axis, r.baseline), words.percent(step.confidence))
        for step in result.steps
    )
    left = tuple(words.score(one, result.axis) for one in result.left_over)
    return Row(result.axis, _colour(result.axis), result.verdict, words.VERDICTS[result.verdict], did, left)


def _axis(r: Reconciliation, result: AxisResult) -> AxisPart:
    looks = [result.start, *(step.look for step in result.steps)]
    steps = tuple(
        _step(r, result.axis, i, step, before)
        for i, (step, before) in enumerate(zip(result.steps, looks, strict=False), start=1)
    )
    left = tuple((words.score(one, result.axis), _where(result.end, one, result.axis)) for one in result.left_over)
    alone = not result.steps
    return AxisPart(
        result.axis,
        _colour(result.axis),
        result.verdict,
        words.VERDICTS[result.verdict],
        words.verdict_line(result),
        steps,
        left,
        _lenses(result.start, None, result.axis) if alone else (),
        _singles(result) if alone else (),
    )


def _agreeing(results: Sequence[AxisResult]) -> Agreeing:
    lenses = list(dict.fromkeys(score.lens for result in results for score in result.start.scores))
    gaps = [{score.lens: _of_threshold(score) for score in result.start.scores} for result in results]
    return Agreeing(
        tuple((result.axis, _colour(result.axis)) for result in results),
        tuple((words.lens_name(lens), tuple(known.get(lens, "—") for known in gaps)) for lens in lenses),
        tuple(_singles(result) for result in results),
    )


def _singles(result: AxisResult) -> tuple[str, ...]:
    return tuple(chart([("", view)], result.axis, *ONE_PX) for view in result.start.views)


def _of_threshold(score: Score) -> str:
    return f"{words.gap(score.gap)} of {words.gap(score.threshold)}"


def _step(r: Reconciliation, axis: str, count: int, step: Step, before: Look) -> StepPart:
    after = {view.lens: view for view in step.look.views}
    pairs = tuple(
        chart([("before", view), ("after", after[view.lens])], axis, *PAIR_PX)
        for view in before.views
        if view.lens in after
    )
    return StepPart(
        title=f"Step {count}: {step.kind} {words.plain(step.effect)}",
        means=EFFECTS[step.effect].means,
        because=step.because,
        found=words.score(step.found, axis),
        where=_where(before, step.found, axis),
        parameters=words.parameters(step, axis, r.baseline),
        confidence=words.percent(step.confidence),
        why_not=words.why_not(step),
        held_out=_held_out(step),
        lenses=_lenses(before, step.look, axis),
        pairs=pairs,
    )


def _held_out(step: Step) -> str:
    """Whether the gap also shrank where the effect was not chosen."""
    before, after = step.held_out_before, step.held_out_after
    if before is None or after is None:
        return f"None: {step.held_out_reason}."
    return f"{words.gap(before.gap)} → {words.gap(after.gap)}, threshold {words.gap(after.threshold)}"


def _where(look: Look, found: Score, axis: str) -> tuple[str, ...]:
    """The picture that shows a place best, and beside it the part round a narrow one."""
    view = view_at(look.views, found.lens, found.where)
    if view is None:
        return ()
    part = near(view, found.where)
    if part is None:
        return (chart([("", view)], axis, *WIDE_PX, where=found.where),)
    whole = chart([("", view)], axis, *WHERE_PX, where=replace(found.where, source=None))
    return whole, chart([("", part)], axis, *NEAR_PX, where=found.where)


def _lenses(before: Look, after: Look | None, axis: str) -> tuple[LensRow, ...]:
    """Every lens, before and after; of one look the gaps stand under ``before``."""
    later = {} if after is None else {score.lens: score for score in after.scores}
    pairs = [(score, later.get(score.lens)) for score in before.scores]
    largest = max((words.over_threshold(one) for pair in pairs for one in pair if one is not None), default=1.0)
    ruler = Ruler(BAR_ENDS[0], max(BAR_ENDS[1], 1.3 * largest), True, 8.0, BAR_PX[0] - 8.0)
    return tuple(_lens(score, other, axis, ruler) for score, other in pairs)


def _lens(score: Score, later: Score | None, axis: str, ruler: Ruler) -> LensRow:
    deciding = later or score
    return LensRow(
        words.lens_name(score.lens),
        words.place(score.where, axis),
        words.gap(score.gap),
        "" if later is None else words.gap(later.gap),
        words.gap(deciding.threshold),
        words.gap(deciding.null95),
        score.passes,
        later is not None and later.passes,
        _bar(score, later, ruler),
    )


def _bar(score: Score, later: Score | None, ruler: Ruler) -> str:
    """Gap over threshold on a logarithmic strip: a ring before, a dot after, a line at the threshold."""
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
        parts.append(f'<circle cx="{at[0]:.1f}" cy="{high / 2:g}" r="4.5" fill="#fff" stroke="{_tint(score)}" '
                     'stroke-width="2"/>')  # fmt: skip
    parts.append(f'<circle cx="{at[-1]:.1f}" cy="{high / 2:g}" r="4.8" fill="{_tint(later or score)}"/>')
    return f'<svg class="bar" viewBox="0 0 {wide:g} {high:g}">{"".join(parts)}</svg>'


def _on_strip(score: Score | None, ruler: Ruler) -> float:
    """Pixel of a gap, or of the threshold; a gap of nothing stands at the left end."""
    share = 1.0 if score is None else max(words.over_threshold(score), ruler.low)
    return float(ruler.at(np.array([share]))[0])


def _tint(score: Score) -> str:
    return OPEN if score.passes else CLOSED


def _colour(axis: str) -> str:
    return COLOURS[AXES.index(axis) % 3]
