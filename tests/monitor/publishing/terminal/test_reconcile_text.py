"""Tests of the reconciliation tables on a terminal of several widths."""

import io

import pytest
from rich.cells import cell_len
from rich.console import Console

from monitor.publishing.terminal.reconcile_text import print_comparison, print_reconciliation
from monitor.reconcile.result import Reconciliation
from monitor.reconcile.several_recordings.comparison import RecordingsComparison, compare_results
from tests.monitor.reconcile import samples
from tests.monitor.reconcile.runs_made import line, run, step, with_axes


def render_reconciliation(r: Reconciliation, width: int = 140, details: bool = True) -> list[str]:
    console = Console(width=width, file=io.StringIO(), record=True)
    print_reconciliation(r, console, details=details)
    return console.export_text().splitlines()


def collapse_whitespace(line: str) -> str:
    return " ".join(line.split())


def test_each_step_has_a_line_with_gap_and_confidence() -> None:
    lines = render_reconciliation(samples.explained())
    assert lines[0].startswith("● explained The model differs from the recording on gz, and 2 findings explain all")
    (first,) = [line for line in lines if line.startswith("gz")]
    step_text = "added sinusoidal: amplitude 30.94 ± 0.54 °/h, frequency 17.300012 ± 0.000100 Hz"
    assert collapse_whitespace(first) == f"gz ● explained 41.2 → 4.60 99.8 % {step_text}"
    second = lines[lines.index(first) + 1]
    assert collapse_whitespace(second) == "8.70 → 0.70 > 99.9 % retuned angle random walk: N 0.6188 ± 0.0014 °/√h"
    assert lines[-1] == "note: 12 missing samples <in 1 gap> & filled"


def test_summary_and_each_finding_with_parameters_are_printed_without_details() -> None:
    text = collapse_whitespace(" ".join(render_reconciliation(samples.explained(), details=False)))
    assert text == (
        "● explained The model differs from the recording on gz, and 2 findings explain all of the difference. "
        "Line at 17.3 Hz on gz (96 %) and 1 smaller finding (4.3 %). "
        "Continue with model.toml, which contains the findings, if the findings belong to the sensor. "
        "96 % added line at 17.3 Hz on gz: frequency 17.300012 ± 0.000100 Hz, amplitude 30.94 ± 0.54 °/h "
        "4.3 % white noise N changed by a factor of 1.2 on gz: N 0.6188 ± 0.0014 °/√h "
        "360000 samples at 100 Hz, 1 h 00 min note: 12 missing samples <in 1 gap> & filled"
    )


def test_findings_are_ordered_by_their_share() -> None:
    lines = [collapse_whitespace(line) for line in render_reconciliation(samples.explained())]
    at = lines.index("share finding conf. Allan deviation")
    assert lines[at + 1] == "96 % added line at 17.3 Hz on gz 99.8 % × 1.05 at τ = 0.02 s (gz)"
    assert lines[at + 2] == "4.3 % white noise N changed by a factor of 1.2 on gz > 99.9 % × 1.2 at τ = 0.01 s (gz)"
    left = [collapse_whitespace(line) for line in render_reconciliation(samples.partly_explained())]
    assert "4.3 % left over: a difference in the spectrum from 6 to 11 Hz on gz" in left


def test_agreeing_axis_shows_its_largest_gap() -> None:
    lines = render_reconciliation(samples.agrees())
    rows = [line for line in lines if line.split(" ")[0] in samples.agrees().axes]
    assert len(rows) == 6
    assert collapse_whitespace(rows[0]) == "gx ● agrees largest: level, t = 1200 … 1320 s: gap 1.10, threshold 2.50"


def test_remaining_gap_is_shown() -> None:
    text = "\n".join(render_reconciliation(samples.partly_explained()))
    assert "◐ partly explained" in text
    assert "left over: Allan deviation, τ = 0.01 … 0.64 s: gap 8.70, threshold 2.40" in text
    text = "\n".join(render_reconciliation(samples.unexplained()))
    assert "✖ unexplained" in text
    assert "left over: spectrum, 6 … 11 Hz: gap 7.90, threshold 2.60" in text


@pytest.mark.parametrize("width", [60, 80, 110])
def test_long_lines_wrap_inside_their_column(width: int) -> None:
    lines = render_reconciliation(samples.partly_explained(), width)
    assert all(cell_len(line) <= width for line in lines if not line.startswith("note"))
    words = " ".join(" ".join(lines).split())
    for word in ("17.300012", "0.000100", "Hz", "left", "over:", "threshold"):
        assert word in words


def render_comparison(c: RecordingsComparison, width: int = 140) -> list[str]:
    console = Console(width=width, file=io.StringIO(), record=True)
    print_comparison(c, console, details=True)
    return console.export_text().splitlines()


def make_comparison() -> RecordingsComparison:
    both = with_axes(run("warm", line(), step("bias_step", time=350.0, height=1e-3)), run("warm", axis="gx"))
    return compare_results([run("cold", line(3e-4)), both], None, {"short": "200 samples"})


def test_recordings_are_shown_side_by_side() -> None:
    lines = [collapse_whitespace(line) for line in render_comparison(make_comparison())]
    assert lines[0] == (
        "● explained 2 recordings were compared with the model. Common to all: sinusoidal (gz). "
        "In some only: bias step (gz)."
    )
    at = lines.index("axis cold warm")
    assert lines[at + 1 : at + 4] == ["gx not recorded ● agrees", "gz ● explained ● explained", "1 effect 2 effects"]
    assert lines[-1] == "note: short is left out: 200 samples"


def test_common_effects_state_agreement_and_single_effects_their_recording() -> None:
    lines = [collapse_whitespace(line) for line in render_comparison(make_comparison())]
    common, single = lines.index("common to all"), lines.index("in some only")
    assert lines[common + 1].startswith(
        "gz added sinusoidal: amplitude 46 ± 30 °/h, frequency 17.30000 ± 0.00071 Hz; sizes differ"
    )
    assert lines[single + 1].endswith("; in warm")
    assert (
        lines[single + 2] == "not in cold: may differ: an effect that happens once need not happen in another recording"
    )


@pytest.mark.parametrize("width", [60, 80])
def test_long_lines_of_several_recordings_wrap(width: int) -> None:
    lines = render_comparison(make_comparison(), width)
    assert all(cell_len(line) <= width for line in lines if not line.startswith("note"))
    assert "17.30000" in " ".join(" ".join(lines).split())
