"""A reconciliation on the terminal: the verdict, a table of the axes, a line a step, and what is left over.

In comes a ``Reconciliation``, out go lines of rich at any width: long ones wrap inside their column. A verdict has a
sign and a word beside its colour. Words and units come from ``reconcile_words``.

Of several recordings: a table of axes and recordings, and a line for each effect that is common or single.
"""

from typing import Final

from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from drivers.sample import AXES
from monitor.publishing.reports import comparison_sentences as runs_words
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.rerun.panels import duration
from monitor.reconcile.result import AxisResult, Reconciliation, Step
from monitor.reconcile.several_recordings.comparison import AxisRuns, Comparison, Seen

STYLES: Final = {
    "agrees": ("●", "green"),
    "explained": ("●", "green"),
    "partly_explained": ("◐", "yellow"),
    "unexplained": ("✖", "bold red"),
}
"""Verdict -> its sign and colour."""


def tell(r: Reconciliation, console: Console) -> None:
    """Print it."""
    console.print(f"{r.samples} samples at {r.rate_hz:g} Hz, {duration(r.seconds)}", highlight=False)
    console.print(_verdict(r.verdict), Text(words.summary(r)))
    console.print(table(r))
    for note in r.notes:
        console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)


def table(r: Reconciliation) -> RenderableType:
    """A row an axis; below an axis its steps and what is left over."""
    rows = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for head, justify in (("axis", "left"), ("verdict", "left"), ("gap", "right"), ("conf.", "right")):
        rows.add_column(head, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    rows.add_column("what", overflow="fold")
    for axis in (axis for axis in AXES if axis in r.axes):
        _add(rows, r, r.axes[axis])
    return Padding(rows, (1, 0))


def _add(rows: Table, r: Reconciliation, result: AxisResult) -> None:
    """The axis with its first line, then the others."""
    lines = [_step(r, result.axis, step) for step in result.steps]
    lines += [("", "", Text(f"left over: {words.score(one, result.axis)}", style="yellow")) for one in result.left_over]
    head = (Text(result.axis, style="bold"), _verdict(result.verdict))
    if not lines and result.start.scores:
        most = max(result.start.scores, key=words.over_threshold)
        lines.append(("", "", Text(f"largest: {words.score(most, result.axis)}", style="dim")))
    for i, line in enumerate(lines or [("", "", Text())]):
        rows.add_row(*(head if i == 0 else ("", "")), *line)


def _step(r: Reconciliation, axis: str, step: Step) -> tuple[str, str, Text]:
    what = Text.assemble(f"{step.kind} ", words.step_line(step, axis, r.baseline))
    what.highlight_words([words.plain(step.effect)], "bold")
    gap = f"{words.gap(step.before.gap)} → {words.gap(step.after.gap)}"
    return gap, words.percent(step.confidence), what


def _verdict(verdict: str) -> Text:
    sign, style = STYLES[verdict]
    return Text(f"{sign} {words.VERDICTS[verdict]}", style=style)


def tell_runs(c: Comparison, console: Console) -> None:
    """Print what several recordings show together."""
    console.print(_verdict(c.verdict), Text(runs_words.summary(c)))
    console.print(Padding(_axes_by_runs(c), (1, 0)))
    for title, found in (("common to all", _common(c)), ("in some only", _single(c))):
        if found:
            console.print(Text(title, style="bold"))
            console.print(Padding(_lines(found), (0, 0, 1, 2)))
    for name, why in c.silent.items():
        console.print(f"note: {name} is left out: {why}", markup=False, highlight=False, soft_wrap=True)


def _axes_by_runs(c: Comparison) -> Table:
    rows = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    rows.add_column("axis", no_wrap=True)
    for run in c.runs:
        rows.add_column(Text(run.name), overflow="fold")
    for axis, one in c.axes.items():
        rows.add_row(Text(axis, style="bold"), *(_cell(one.results.get(run.name)) for run in c.runs))
    return rows


def _cell(result: AxisResult | None) -> Text:
    said = Text(runs_words.cell(result), style="dim")
    return (
        said
        if result is None
        else Text("\n").join([_verdict(result.verdict), said])
        if said
        else _verdict(result.verdict)
    )


def _lines(found: list[tuple[str, Text]]) -> Table:
    rows = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    rows.add_column(no_wrap=True, style="bold")
    rows.add_column(overflow="fold")
    for axis, said in found:
        rows.add_row(axis, said)
    return rows


def _common(c: Comparison) -> list[tuple[str, Text]]:
    found = []
    for axis, one in c.axes.items():
        for seen in one.common:
            said = _effect(c, axis, seen)
            said.append(f"; {runs_words.agreement(seen)}", style="yellow" if seen.consistent is False else "")
            found.append((axis, said))
    return found


def _single(c: Comparison) -> list[tuple[str, Text]]:
    return [line for axis, one in c.axes.items() for line in _single_on(c, axis, one)]


def _single_on(c: Comparison, axis: str, one: AxisRuns) -> list[tuple[str, Text]]:
    found = []
    for seen in one.single:
        said = _effect(c, axis, seen)
        said.append(f"; in {', '.join(seen.steps)}")
        found.append((axis, said))
        for absence in seen.absent:
            style = "yellow" if absence.meaning == "contradiction" else "dim"
            meaning = f"not in {absence.run}: {runs_words.MEANINGS[absence.meaning]}: {absence.because}"
            found.append(("", Text(meaning, style=style)))
    return found


def _effect(c: Comparison, axis: str, seen: Seen) -> Text:
    said = Text(f"{seen.kind} {runs_words.line(seen, axis, c.baseline)}")
    said.highlight_words([words.plain(seen.effect)], "bold")
    return said
