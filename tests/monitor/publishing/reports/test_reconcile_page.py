"""Tests of the HTML reports of ``reconcile``."""

import functools
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import pytest

from drivers.errors import ConfigError
from monitor.common.unit_formatting import UNIT_SYSTEMS
from monitor.noise.effects import EFFECTS
from monitor.publishing.reports import reconcile_page
from monitor.publishing.reports.reconcile_page import render_comparison_page, render_page
from monitor.reconcile.result import AxisModelDiagnostics, DiagnosticGap, DiagnosticPlotData, Location
from monitor.reconcile.several_recordings.comparison import RecordingsComparison, compare_results
from tests.monitor.reconcile import samples
from tests.monitor.reconcile.runs_made import DIAGNOSTIC, line, run, step, with_axes

pytest.importorskip("jinja2")


class PageText(HTMLParser):
    """Text of the page without its drawings, the rows of its tables, and the tags that are still open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words = ""
        self.rows: list[list[str]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "br"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "svg" in self.open or "style" in self.open:
            return
        self.words += data
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] = " ".join(f"{self.rows[-1][-1]} {data}".split())


@functools.cache
def render_example(name: str) -> str:
    return render_page(getattr(samples, name)(), "bench-1")


def parse_example(name: str) -> PageText:
    return PageText(render_example(name))


def test_summary_figures_and_findings_come_first() -> None:
    text = render_example("explained")
    words = parse_example("explained").words
    first = words.index("Line at 17.3 Hz on gz (96 %) and 1 smaller finding (4.3 %).")
    assert first < words.index("added line at 17.3 Hz on gz") < words.index("Every step and diagnostic of gz")
    assert text.index("Allan deviation before and after") < text.index("<details>") < text.index("</details>")
    assert text.count("Allan deviation before and after") == 1  # the other axes agree and have no figure
    assert ["1", "96 %", "added line at 17.3 Hz on gz", "99.8 %", "× 1.05 at τ = 0.02 s (gz)"] in parse_example(
        "explained"
    ).rows


def test_axes_that_agree_are_one_folded_line_each() -> None:
    folded = re.findall(r"<details>\s*<summary>(.*?)</summary>", render_example("explained"), flags=re.S)
    lines = [" ".join(PageText(f"<p>{one}</p>").words.split()) for one in folded]
    assert lines[:2] == ["1 smaller finding", "Every step and diagnostic of gz"]
    assert [line[:2] for line in lines[2:-1]] == ["gx", "gy", "ax", "ay", "az"]
    assert all(re.fullmatch(r"\w\w agrees largest gap: .*: gap [\d.]+, threshold [\d.]+", line) for line in lines[2:-1])


def test_step_states_location_effect_reason_and_confidence() -> None:
    words = parse_example("explained").words
    step = samples.explained().axes["gz"].steps[0]
    for text in (
        "Step 1: added sinusoidal", EFFECTS["sinusoidal"].description, step.because,
        "Where: spectrum, 17.1 … 17.5 Hz: gap 41.2, threshold 2.60", "99.8 %",
        "Less likely explanations of the same gap: narrowband (0.2 %)", "39.7 → 1.00, threshold 2.60",
        "Step 2: retuned angle random walk", "None: a known term of another size is not held out.",
    ):  # fmt: skip
        assert text in words


def test_parameters_have_intervals_units_and_the_value_of_the_model() -> None:
    rows = parse_example("explained").rows
    assert ["frequency", "17.300012", "17.299912 … 17.300112", "Hz"] in rows
    assert ["N", "0.6188", "0.6174 … 0.6202", "°/√h", "0.516 °/√h"] in rows


def test_gaps_are_listed_once_per_axis_with_a_column_for_each_step() -> None:
    rows = parse_example("explained").rows
    assert [
        "diagnostic",
        "largest gap at",
        "gap",
        "after step 1",
        "after step 2",
        "threshold",
        "95 % of chance",
    ] in rows
    (spectrum,) = (row for row in rows if row[:3] == ["spectrum", "17.1 … 17.5 Hz", "41.2"])
    assert spectrum[3] == "4.60"
    assert len([row for row in rows if row[:1] == ["spectrum"]]) == len(samples.explained().axes)


@pytest.mark.parametrize("name", ["explained", "partly_explained", "unexplained"])
def test_no_figure_repeats_another(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[DiagnosticPlotData] = []

    def draw(panels: Sequence[tuple[str, DiagnosticPlotData]], *_: object, **__: object) -> str:
        drawn.extend(view for _, view in panels)
        return ""

    monkeypatch.setattr(reconcile_page, "diagnostic_comparison_svg", draw)
    render_page(getattr(samples, name)())
    assert len(drawn) > 1
    assert len({id(view) for view in drawn}) == len(drawn)


def test_every_significant_diagnostic_is_drawn_after_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[str, str]] = []

    def draw(panels: Sequence[tuple[str, DiagnosticPlotData]], *_: object, **__: object) -> str:
        drawn.extend((title, view.diagnostic) for title, view in panels)
        return ""

    monkeypatch.setattr(reconcile_page, "diagnostic_comparison_svg", draw)
    render_page(samples.explained())
    gz = samples.explained().axes["gz"]
    significant = {gap.diagnostic for gap in gz.start.gaps if gap.is_significant}
    assert significant
    assert {name for title, name in drawn if title == "after"} == significant
    assert [title for title, _ in drawn[:6]] == ["before", "after"] * 3  # beside each other, in the same size


def test_agreeing_axes_have_one_figure_each() -> None:
    text = render_example("agrees")
    assert text.count("<svg ") == 6
    assert "Step" not in text
    assert "Left over" not in text
    rows = [row for row in PageText(text).rows if row[0] == "spectrum"]
    assert [row[2:] for row in rows] == [["0.60", "2.60", "1.90"]] * 6


def test_unexplained_gap_has_a_location_and_no_effect() -> None:
    text = parse_example("unexplained")
    assert "No known effect explains the difference, so no effect is named." in text.words
    assert "spectrum, 6 … 11 Hz: gap 7.90, threshold 2.60" in text.words
    assert not [
        name for name in EFFECTS if name.replace("_", " ") in text.words.replace("\xa0", " ").split("The model")[0]
    ]
    assert "five classic terms, fitted first" in text.words


def test_remaining_gap_follows_the_steps() -> None:
    words = parse_example("partly_explained").words
    assert words.index("Step 1") < words.index("Left over") < words.index("gx")
    assert "Allan deviation, τ = 0.01 … 0.64 s: gap 8.70, threshold 2.40" in words[words.index("Left over") :]


def test_page_is_self_contained_and_escaped() -> None:
    text = render_page(samples.explained(), "a <b> & c")
    assert not re.search(r"<script|<link|@import|url\((?!#)|\bsrc=|\bhref=.(?!#)|http(?!://www.w3.org)", text)
    assert "a &lt;b&gt; &amp; c" in text
    assert "12 missing samples &lt;in 1 gap&gt; &amp; filled" in text
    assert unescape(PageText(text).words).count("sinusoidal") > 1
    assert not [svg for svg in re.findall(r"<svg.*?</svg>", text, flags=re.S) if "nan" in svg]


def test_report_with_two_steps_is_below_a_megabyte() -> None:
    assert len(render_example("explained").encode()) < 1_000_000


def test_tables_and_figures_have_the_chosen_units() -> None:
    si, r, runs = UNIT_SYSTEMS["si"], samples.explained(), make_comparison()
    for default, page in (
        (render_page(r), render_page(r, "", si)),
        (render_comparison_page(runs), render_comparison_page(runs, si)),
    ):
        assert "°/h" in default
        assert "°/h" not in page
        assert "rad/s</" in page


def test_largest_gap_of_an_agreeing_axis_has_the_chosen_unit() -> None:
    r = samples.agrees()
    gap = DiagnosticGap("values", Location(value=(-5.0, 5.0)), 2.5, 1.0, 2.6)
    gx = replace(r.axes["gx"], start=AxisModelDiagnostics((gap,), ()))
    page = render_page(replace(r, axes={"gx": gx}), "", UNIT_SYSTEMS["si"])
    assert "largest gap: values, −5 … 5 rad/s" in page


def test_same_reconciliation_gives_the_same_page() -> None:
    assert render_page(samples.explained(), "bench-1") == render_example("explained")


def test_missing_library_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        render_page(samples.agrees())


def make_comparison() -> RecordingsComparison:
    own = step("bias_step", time=350.0, height=1e-3)
    first = with_axes(run("cold <1>", line(1.5e-4)), run("cold <1>", axis="gx"))
    return compare_results(
        [
            first,
            run("warm", line(1.52e-4), own),
            run("c", line(1.3e-4), seconds=60.0, left=[replace(DIAGNOSTIC, gap=9.0)]),
        ],
        fitted_to="cold <1>",
        without_result={"short": "200 samples; too few"},
    )


def collapse_whitespace(text: str) -> str:
    return " ".join(text.split())


def test_table_has_axes_and_recordings() -> None:
    text = PageText(render_comparison_page(make_comparison()))
    heads, *rows = text.rows[:4]
    assert heads == [
        "axis", "cold <1> 1 h 00 min, 360,000 samples at 100 Hz".replace("1 h 00 min", "10 min 00 s"),
        "warm 10 min 00 s, 360,000 samples at 100 Hz", "c 1 min 00 s, 360,000 samples at 100 Hz",
    ]  # fmt: skip
    assert rows == [
        ["gx", "agrees", "not recorded", "not recorded"],
        ["gz", "explained 1 effect", "explained 2 effects", "partly explained 1 effect, 1 left over"],
        ["all", "explained", "explained", "partly explained"],
    ]


def test_common_effect_has_a_value_per_recording_and_a_pooled_value() -> None:
    text = PageText(render_comparison_page(make_comparison()))
    table = {row[0]: row[1:] for row in text.rows}
    assert table["warm"] == ["31.35 ± 0.62 °/h", "17.3000 ± 0.0010 Hz", "99.0 %"]
    assert table["all together"][0] == "29.7 ± 2.8 °/h"  # the values differ, so the interval includes their scatter
    assert "sizes differ (p < 0.001)" in text.words
    (chart,) = re.findall(r"<svg.*?</svg>", render_comparison_page(make_comparison()), flags=re.S)
    labels = re.findall(r"<text[^>]*>([^<]*)</text>", chart)
    assert {"cold &lt;1&gt;", "warm", "c", "all together", "amplitude, °/h, with 95 % intervals"} <= set(labels)


def test_single_effect_has_a_reason_why_it_is_not_in_other_recordings() -> None:
    (row,) = (row for row in PageText(render_comparison_page(make_comparison())).rows if "bias step" in " ".join(row))
    assert row[2] == "warm"
    assert "cold <1>, c: may differ an effect that happens once need not happen in another recording" in row[3]
    assert "c: may differ" in row[3]


def test_comparison_is_self_contained_and_escaped() -> None:
    text = render_comparison_page(make_comparison())
    assert not re.search(r"<script|<link|@import|url\((?!#)|\bsrc=|http(?!://www.w3.org)", text)
    assert re.findall(r' href="([^"]*)"', text) == ["cold%20%3C1%3E/report.html", "warm/report.html", "c/report.html"]
    assert "<1>" not in text
    assert "nan" not in "".join(re.findall(r"<svg.*?</svg>", text, flags=re.S))
    assert text == render_comparison_page(make_comparison())


def test_omitted_recordings_and_the_model_are_mentioned() -> None:
    words = collapse_whitespace(PageText(render_comparison_page(make_comparison())).words)
    assert "short: 200 samples; too few" in words
    assert (
        "3 recordings were compared with the five classic terms, fitted to cold <1>. Common to all: sinusoidal (gz)."
        in words
    )


def test_agreeing_recordings_give_a_short_page() -> None:
    words = collapse_whitespace(PageText(render_comparison_page(compare_results([run("a"), run("b")]))).words)
    assert "2 recordings were compared with the model. None differs by more than chance." in words
    assert "No effect was found in every recording." in words
    assert "No effect was found in some recordings only." in words


def test_page_contains_no_control_characters():
    page = render_page(samples.explained(), "run\x1b[2J\x07\u202ecsv")
    assert "run [2J  csv" in page
    assert not {one for one in page if one < " "} - {"\n"}
    assert "\u202e" not in page
