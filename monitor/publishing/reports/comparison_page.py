"""Comparison of several recordings of one sensor as a self-contained HTML page, ``report.html`` above the single
reports.

The page needs no network. It holds a summary, a table of axes and recordings with links to the single reports, and
the effects. Each common effect is shown with its size in every recording and its pooled size. Each effect of some
recordings only is shown with the meaning of its absence in the others. Jinja2 is imported when a page is requested.
Equal comparisons give equal pages.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.common.units import format_duration
from monitor.noise.effects import EFFECTS
from monitor.publishing.plots.allan_figure import COLOURS, DARK
from monitor.publishing.plots.ruler import Ruler
from monitor.publishing.reports import comparison_sentences as runs_words
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.reports.reconcile_page import MISSING
from monitor.reconcile.result import ParameterInterval, ReconciliationStep
from monitor.reconcile.several_recordings.comparison import AxisRuns, Comparison, MatchedEffect

TEMPLATE: Final = "reconcile_runs.html.j2"
STRIP_PX: Final = (260.0, 22.0)
STRIP_MARGIN: Final = 0.06
"""Margin at both ends of a strip, as a share of the span of all intervals."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """Row of one recording in the table at the top."""

    name: str  # also the name of its folder
    verdict: str  # as in the JSON
    word: str
    length: str
    samples: str
    rate: str


@dataclass(frozen=True, slots=True)
class AxisRow:
    """Row of one axis: its result in all recordings."""

    axis: str
    colour: str
    cells: tuple[tuple[str, str, str], ...]  # result as in the JSON, its text, and what was found


@dataclass(frozen=True, slots=True)
class SizeRow:
    """Size of a common effect in one recording, or pooled over all recordings."""

    name: str
    cells: tuple[str, ...]  # text of each parameter
    confidence: str
    strip: str  # SVG


@dataclass(frozen=True, slots=True)
class CommonPart:
    """Section of the page for one common effect."""

    axis: str
    colour: str
    title: str
    means: str
    agreement: str
    differ: bool
    names: tuple[str, ...]  # names of the parameters
    drawn: str  # parameter shown in the strips
    rows: tuple[SizeRow, ...]  # one for each recording, and the pooled one last


@dataclass(frozen=True, slots=True)
class SingleRow:
    """Row of one effect that only some recordings have."""

    axis: str
    colour: str
    kind: str
    effect: str
    parameters: str
    runs: str
    elsewhere: tuple[tuple[str, str, str, str], ...]  # recording, meaning as in the JSON and as text, and reason


def render_page(c: Comparison) -> str:
    """Return the page as text.

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
    return environment.get_template(TEMPLATE).render(
        title=f"{len(c.runs)} recordings of one sensor",
        verdict=c.verdict,
        word=words.RESULT_TEXTS[c.verdict],
        summary=runs_words.summary(c),
        recorded=_recorded(c),
        rows=[_row(c, one) for one in c.axes.values()],
        common=[_common(c, axis, seen) for axis, one in c.axes.items() for seen in one.common],
        single=[_single(c, axis, seen) for axis, one in c.axes.items() for seen in one.single],
        silent=c.without_result,
        model=str(c.model),
    )


def _recorded(c: Comparison) -> list[Recorded]:
    """Return the rows of the recordings."""
    return [
        Recorded(
            run.name,
            run.result.verdict,
            words.RESULT_TEXTS[run.result.verdict],
            format_duration(run.result.duration_s),
            f"{run.result.samples:,}",
            f"{run.result.rate_hz:.6g} Hz",
        )
        for run in c.runs
    ]


def _row(c: Comparison, one: AxisRuns) -> AxisRow:
    """Return the row of one axis."""
    cells = []
    for run in c.runs:
        result = one.results.get(run.name)
        verdict = "" if result is None else result.verdict
        cells.append((verdict, words.RESULT_TEXTS.get(verdict, ""), runs_words.axis_summary(result)))
    return AxisRow(one.axis, _colour(one.axis), tuple(cells))


def _common(c: Comparison, axis: str, seen: MatchedEffect) -> CommonPart:
    """Return the section of one common effect."""
    names = tuple(seen.parameters)
    drawn = next((name for name, one in seen.parameters.items() if one.freedom), "")
    intervals = [step.parameters[drawn] for step in seen.steps.values() if drawn in step.parameters]
    ruler = _ruler(intervals)
    every = [*seen.steps.items(), ("all together", seen.step())]
    rows = tuple(
        SizeRow(
            name,
            _cells(c, axis, step, names),
            words.percent(step.confidence) if name in seen.steps else "",
            "" if ruler is None else _strip(step.parameters.get(drawn), ruler, _colour(axis), name not in seen.steps),
        )
        for name, step in every
    )
    return CommonPart(
        axis,
        _colour(axis),
        f"{seen.kind} {words.words_of(seen.effect)}",
        EFFECTS[seen.effect].description,
        runs_words.size_agreement(seen),
        seen.consistent is False,
        tuple(words.words_of(name) for name in names),
        words.words_of(drawn) if ruler else "",
        rows,
    )


def _cells(c: Comparison, axis: str, step: ReconciliationStep, names: Sequence[str]) -> tuple[str, ...]:
    """Return the text of each parameter."""
    known = {one.name: one.short for one in words.parameters(step, axis, c.baseline)}
    return tuple(known.get(name, "—") for name in names)


def _single(c: Comparison, axis: str, seen: MatchedEffect) -> SingleRow:
    """Return the row of one effect that only some recordings have."""
    effect, _, parameters = runs_words.effect_line(seen, axis, c.baseline).partition(": ")
    elsewhere = tuple((a.run, a.meaning, runs_words.MEANINGS[a.meaning], a.because) for a in seen.absent)
    return SingleRow(axis, _colour(axis), seen.kind, effect, parameters, ", ".join(seen.steps), elsewhere)


def _ruler(intervals: Sequence[ParameterInterval]) -> Ruler | None:
    """Return a linear scale that contains all intervals; None if they have no extent."""
    ends = [end for one in intervals for end in (one.lo, one.hi) if end is not None and np.isfinite(end)]
    if not ends or not max(ends) > min(ends):
        return None
    low, high = min(ends), max(ends)
    more = STRIP_MARGIN * (high - low)
    return Ruler(low - more, high + more, False, 0.0, STRIP_PX[0])


def _strip(one: ParameterInterval | None, ruler: Ruler, colour: str, whole: bool) -> str:
    """Return the SVG of an interval and its value; the pooled one is dark and marked with a diamond."""
    wide, middle = STRIP_PX[0], 0.5 * STRIP_PX[1]
    parts = [f'<line x1="0" x2="{wide:g}" y1="{middle:g}" y2="{middle:g}" stroke="#eee"/>']
    if one is not None and one.lo is not None and one.hi is not None and not isinstance(one.value, str):
        lo, at, hi = (float(px) for px in ruler.at(np.array([one.lo, one.value, one.hi])))
        tint = DARK if whole else colour
        ends = f'x1="{lo:.1f}" x2="{hi:.1f}" y1="{middle:g}" y2="{middle:g}"'
        parts.append(f'<line {ends} stroke="{tint}" stroke-width="2.5"/>')
        diamond = f'<path d="M{at - 6:.1f} {middle:g}l6 -6l6 6l-6 6z" fill="{tint}"/>'
        parts.append(diamond if whole else f'<circle cx="{at:.1f}" cy="{middle:g}" r="4.5" fill="{tint}"/>')
    return f'<svg class="strip" viewBox="0 0 {wide:g} {STRIP_PX[1]:g}">{"".join(parts)}</svg>'


def _colour(axis: str) -> str:
    """Return the colour of an axis."""
    return COLOURS[AXES.index(axis) % 3]
