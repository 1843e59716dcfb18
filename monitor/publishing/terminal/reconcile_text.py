"""Result of a reconciliation as text for the terminal.

The text consists of the summary and of one line for each finding. The option ``details`` adds the confidences, the axes
with their steps, and the unexplained differences. Each result has a symbol and a word in addition to the colour. The
comparison of several recordings is a table of axes and recordings with lists of noise effects.
"""

from typing import Final

from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from drivers.data_types import AXES
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem, format_duration
from monitor.publishing.reports import reconcile_sentences as words
from monitor.publishing.reports import recording_comparison_sentences
from monitor.publishing.terminal.tables import plain_table, print_line, print_notes
from monitor.reconcile.result import AddedOrResizedEffect, AxisResult, Reconciliation
from monitor.reconcile.several_recordings.comparison import EffectInRecordings, RecordingsComparison
from monitor.reconcile.summary.ranked_findings import rank_findings
from monitor.reconcile.summary.summary_sentences import (
    describe_finding,
    describe_remaining_gap,
    format_share,
    summarize,
)

RESULT_STYLES: Final = {
    "agrees": ("●", "green"),
    "explained": ("●", "green"),
    "partly_explained": ("◐", "yellow"),
    "unexplained": ("✖", "bold red"),
}
"""Symbol and colour of each possible result of a reconciliation."""


def print_reconciliation(
    r: Reconciliation, console: Console, *, details: bool = False, units: UnitSystem = DEFAULT_UNITS
) -> None:
    """Print the summary and the findings of a reconciliation.

    Parameters
    ----------
    r
        Result of the reconciliation.
    console
        Console that receives the output.
    details
        If True, the axes and all steps are listed too.
    units
        Unit system.
    """
    console.print(_verdict(r.verdict), Text(" ".join(summarize(r))))
    for finding in r.recording_findings:
        sign = "◐" if finding.corrected else "✖"
        print_line(Text(f"{sign} recording: {finding.sentence}", style="yellow"), console)
    if details:
        console.print(_findings_table(r))
        console.print(_axes_table(r, units))
    else:
        for one in rank_findings(r).findings:
            said = f"{format_share(one.share):>8}  {words.describe_finding_and_parameters(one, units)}"
            print_line(said, console)
    console.print(f"{r.samples} samples at {r.rate_hz:g} Hz, {format_duration(r.duration_s)}", highlight=False)
    print_notes(r.notes, console)


def _findings_table(r: Reconciliation) -> RenderableType:
    rows = plain_table()
    rows.add_column("share", justify="right", no_wrap=True)
    rows.add_column("finding", overflow="fold")
    rows.add_column("conf.", justify="right", no_wrap=True)
    rows.add_column("Allan deviation", overflow="fold")
    ranking = rank_findings(r)
    for one in ranking.findings:
        said = Text(f"added {describe_finding(one)}" if one.kind == "added" else describe_finding(one))
        sure = words.format_probability(one.confidence)
        rows.add_row(format_share(one.share), said, sure, words.describe_allan_influence(one))
    for left in ranking.remainders:
        rows.add_row(
            format_share(left.share), Text(f"left over: {describe_remaining_gap(left)}", style="yellow"), "", ""
        )
    return Padding(rows, (1, 0, 0, 0))


def _axes_table(r: Reconciliation, units: UnitSystem) -> RenderableType:
    rows = plain_table("axis", "verdict")
    for head in ("gap", "conf."):
        rows.add_column(head, justify="right", no_wrap=True)
    rows.add_column("what", overflow="fold")
    for axis in (axis for axis in AXES if axis in r.axes):
        _add(rows, r, r.axes[axis], units)
    return Padding(rows, (1, 0))


def _add(rows: Table, r: Reconciliation, result: AxisResult, units: UnitSystem) -> None:
    lines = [_step(r, result.axis, step, units) for step in result.steps]
    lines += [
        ("", "", Text(f"left over: {words.describe_gap(one, result.axis, units)}", style="yellow"))
        for one in result.left_over
    ]
    head = (Text(result.axis, style="bold"), _verdict(result.verdict))
    if not lines and result.start.gaps:
        most = max(result.start.gaps, key=words.gap_to_threshold_ratio)
        lines.append(("", "", Text(f"largest: {words.describe_gap(most, result.axis, units)}", style="dim")))
    for i, line in enumerate(lines or [("", "", Text())]):
        rows.add_row(*(head if i == 0 else ("", "")), *line)


def _step(r: Reconciliation, axis: str, step: AddedOrResizedEffect, units: UnitSystem) -> tuple[str, str, Text]:
    what = Text.assemble(f"{step.kind} ", words.describe_step(step, axis, r.baseline, units))
    what.highlight_words([words.readable_name(step.effect)], "bold")
    gap = f"{words.format_gap(step.before.gap)} → {words.format_gap(step.after.gap)}"
    return gap, words.format_probability(step.confidence), what


def _verdict(verdict: str) -> Text:
    sign, style = RESULT_STYLES[verdict]
    return Text(f"{sign} {words.RESULT_TEXTS[verdict]}", style=style)


def print_comparison(
    c: RecordingsComparison, console: Console, *, details: bool = False, units: UnitSystem = DEFAULT_UNITS
) -> None:
    """Print the comparison of several recordings.

    Parameters
    ----------
    c
        Comparison of several recordings.
    console
        Console that receives the output.
    details
        If True, the effects with their parameters are listed too.
    units
        Unit system.
    """
    console.print(_verdict(c.verdict), Text(recording_comparison_sentences.summarize(c)))
    console.print(Padding(_axes_by_runs(c), (1, 0)))
    for title, found in (("common to all", _common(c, units)), ("in some only", _single(c, units))):
        if details and found:
            console.print(Text(title, style="bold"))
            console.print(Padding(_lines(found), (0, 0, 1, 2)))
    print_notes([f"{name} is left out: {why}" for name, why in c.without_result.items()], console)


def _axes_by_runs(c: RecordingsComparison) -> Table:
    rows = plain_table("axis")
    for run in c.runs:
        rows.add_column(Text(run.name), overflow="fold")
    for axis, one in c.axes.items():
        rows.add_row(Text(axis, style="bold"), *(_cell(one.results.get(run.name)) for run in c.runs))
    return rows


def _cell(result: AxisResult | None) -> Text:
    said = Text(recording_comparison_sentences.describe_finding_counts(result), style="dim")
    return (
        said
        if result is None
        else Text("\n").join([_verdict(result.verdict), said])
        if said
        else _verdict(result.verdict)
    )


def _lines(found: list[tuple[str, Text]]) -> Table:
    rows = plain_table(show_header=False)
    rows.add_column(no_wrap=True, style="bold")
    rows.add_column(overflow="fold")
    for axis, said in found:
        rows.add_row(axis, said)
    return rows


def _common(c: RecordingsComparison, units: UnitSystem) -> list[tuple[str, Text]]:
    found = []
    for axis, one in c.axes.items():
        for seen in one.common:
            said = _effect(c, axis, seen, units)
            said.append(
                f"; {recording_comparison_sentences.describe_size_agreement(seen)}",
                style="yellow" if seen.sizes_agree is False else "",
            )
            found.append((axis, said))
    return found


def _single(c: RecordingsComparison, units: UnitSystem) -> list[tuple[str, Text]]:
    found = []
    for axis, seen in [(axis, seen) for axis, one in c.axes.items() for seen in one.single]:
        said = _effect(c, axis, seen, units)
        said.append(f"; in {', '.join(seen.steps)}")
        found.append((axis, said))
        for recordings, meaning, because in recording_comparison_sentences.describe_absences(seen):
            style = "yellow" if meaning == "contradiction" else "dim"
            text = f"not in {recordings}: {recording_comparison_sentences.ABSENCE_TEXTS[meaning]}: {because}"
            found.append(("", Text(text, style=style)))
    return found


def _effect(c: RecordingsComparison, axis: str, seen: EffectInRecordings, units: UnitSystem) -> Text:
    said = Text(f"{seen.kind} {words.describe_step(seen.step_with_pooled_parameters(), axis, c.baseline, units)}")
    said.highlight_words([words.readable_name(seen.effect)], "bold")
    return said
