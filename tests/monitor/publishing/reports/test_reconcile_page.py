"""The report for people: complete in itself, small, quick, and with every word that it must have."""

import functools
import re
import sys
from html import unescape
from html.parser import HTMLParser

import pytest

from drivers.errors import ConfigError
from monitor.noise.effects import EFFECTS
from monitor.publishing.reports.reconcile_page import render_page
from tests.monitor.reconcile import samples

pytest.importorskip("jinja2")


class Text(HTMLParser):
    """Words of the page, without those of drawings; rows of its tables; tags that were left open."""

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
def page(name: str) -> str:
    return render_page(getattr(samples, name)(), "bench-1")


def read(name: str) -> Text:
    return Text(page(name))


def test_the_summary_the_figures_and_the_findings_stand_on_top() -> None:
    text = page("explained")
    words = read("explained").words
    first = words.index("Line at 17.3 Hz on gz (96 %) and 1 smaller finding (4.3 %).")
    assert first < words.index("added line at 17.3 Hz on gz") < words.index("Every axis, step and diagnostic")
    assert text.index("Allan deviation before and after") < text.index("<details>") < text.index("</details>")
    assert text.count("Allan deviation before and after") == 1  # the other axes agree
    assert ["1", "96 %", "added line at 17.3 Hz on gz", "99.8 %", "× 1.05 at τ = 0.02 s (gz)"] in read("explained").rows


def test_a_table_of_the_axes_follows() -> None:
    text = read("explained")
    table = {row[0]: row[1:] for row in text.rows if row}
    assert table["gx"] == ["agrees", "nothing", "nothing"]
    assert table["gz"] == [
        "explained",
        "added sinusoidal : amplitude 30.94 ± 0.54 °/h, frequency 17.300012 ± 0.000100 Hz (99.8 %) "
        "retuned angle random walk : N 0.6188 ± 0.0014 °/√h (> 99.9 %)",
        "nothing",
    ]


def test_a_step_says_where_what_why_and_how_sure() -> None:
    words = read("explained").words
    step = samples.explained().axes["gz"].steps[0]
    for said in (
        "Step 1: added sinusoidal", EFFECTS["sinusoidal"].description, step.because,
        "Where: spectrum, 17.1 … 17.5 Hz: gap 41.2, threshold 2.60", "99.8 %",
        "Less likely explanations of the same gap: narrowband (0.2 %)", "39.7 → 1.00, threshold 2.60",
        "Step 2: retuned angle random walk", "None: a known term of another size is not held out.",
    ):  # fmt: skip
        assert said in words


def test_parameters_have_intervals_units_and_what_the_model_had() -> None:
    rows = read("explained").rows
    assert ["frequency", "17.300012", "17.299912 … 17.300112", "Hz"] in rows
    assert ["N", "0.6188", "0.6174 … 0.6202", "°/√h", "0.516 °/√h"] in rows


def test_every_diagnostic_stands_before_and_after_each_step() -> None:
    made = samples.explained()
    rows = read("explained").rows
    assert ["spectrum", "17.1 … 17.5 Hz", "41.2", "4.60", "2.60", "1.90"] in rows
    assert ["Allan deviation", "τ = 0.01 … 0.64 s", "8.70", "0.70", "2.40", "1.60"] in rows
    text = page("explained")
    gz = made.axes["gz"]
    snapshots = [gz.start, *(step.snapshot_after for step in gz.steps[:-1])]
    drawn = [{gap.diagnostic for gap in one.gaps if gap.is_significant} - {"allan"} for one in snapshots]
    pairs = sum(view.diagnostic in names for one, names in zip(snapshots, drawn, strict=True) for view in one.plots)
    assert pairs > 1
    assert text.count(">before</text>") == text.count(">after</text>") == pairs


def test_axes_that_agree_have_one_figure_each() -> None:
    text = page("agrees")
    assert text.count("<svg ") == 6
    assert "Step" not in text
    assert "Left over" not in text
    diagnostics = {row[0]: row[1:] for row in Text(text).rows[7:]}
    assert diagnostics["spectrum"] == ["0.60 of 2.60"] * 6
    assert diagnostics["diagnostic"] == ["gx", "gy", "gz", "ax", "ay", "az"]


def test_what_is_unexplained_has_its_place_and_no_name() -> None:
    text = read("unexplained")
    assert "No known effect explains the difference, so no effect is named." in text.words
    assert "spectrum, 6 … 11 Hz: gap 7.90, threshold 2.60" in text.words
    assert not [
        name for name in EFFECTS if name.replace("_", " ") in text.words.replace("\xa0", " ").split("The model")[0]
    ]
    assert "five classic terms, fitted first" in text.words


def test_what_is_left_over_stands_after_the_steps() -> None:
    words = read("partly_explained").words
    assert words.index("Step 1") < words.index("Left over") < words.index("Axes that agree")
    assert "Allan deviation, τ = 0.01 … 0.64 s: gap 8.70, threshold 2.40" in words[words.index("Left over") :]


def test_the_page_is_complete_in_itself_and_escaped() -> None:
    text = render_page(samples.explained(), "a <b> & c")
    assert not re.search(r"<script|<link|@import|url\((?!#)|\bsrc=|\bhref=.(?!#)|http(?!://www.w3.org)", text)
    assert "a &lt;b&gt; &amp; c" in text
    assert "12 missing samples &lt;in 1 gap&gt; &amp; filled" in text
    assert unescape(Text(text).words).count("sinusoidal") > 2
    assert not [one for one in re.findall(r"<svg.*?</svg>", text, flags=re.S) if "nan" in one]


def test_two_steps_stay_small() -> None:
    assert len(page("explained").encode()) < 1_000_000


def test_the_same_reconciliation_gives_the_same_page() -> None:
    assert render_page(samples.explained(), "bench-1") == page("explained")


def test_without_its_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        render_page(samples.agrees())
