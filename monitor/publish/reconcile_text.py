"""A reconciliation on the terminal: the verdict, a table of the axes, a line a step, and what is left over.

In comes a ``Reconciliation``, out go lines of rich at any width: long ones wrap inside their column. A verdict has a
sign and a word beside its colour. Words and units come from ``reconcile_words``.
"""

from typing import Final

from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from drivers.sample import AXES
from monitor.publish import reconcile_words as words
from monitor.publish.panels import duration
from monitor.reconcile.reconciliation import AxisResult, Reconciliation, Step

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
