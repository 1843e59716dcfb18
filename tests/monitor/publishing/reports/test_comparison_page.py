"""Tests of the HTML page about several recordings: common and single effects, links and escaping."""

import re
import sys
from dataclasses import replace

import pytest

from drivers.errors import ConfigError
from monitor.publishing.reports.comparison_page import render_page
from monitor.reconcile.several_recordings.comparison import RecordingsComparison, compare_results
from tests.monitor.publishing.reports.test_reconcile_page import PageText
from tests.monitor.reconcile.runs_made import DIAGNOSTIC, line, run, step, with_axes

pytest.importorskip("jinja2")


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
    text = PageText(render_page(make_comparison()))
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
    text = PageText(render_page(make_comparison()))
    table = {row[0]: row[1:] for row in text.rows}
    assert table["warm"] == ["31.35 ± 0.62 °/h", "17.3000 ± 0.0010 Hz", "99.0 %"]
    assert table["all together"][0] == "29.7 ± 2.8 °/h"  # the values differ, so the interval includes their scatter
    assert "sizes differ (p < 0.001)" in text.words
    (chart,) = re.findall(r"<svg.*?</svg>", render_page(make_comparison()), flags=re.S)
    labels = re.findall(r"<text[^>]*>([^<]*)</text>", chart)
    assert {"cold &lt;1&gt;", "warm", "c", "all together", "amplitude, °/h, with 95 % intervals"} <= set(labels)


def test_single_effect_has_a_reason_why_it_is_not_in_other_recordings() -> None:
    (row,) = (row for row in PageText(render_page(make_comparison())).rows if "bias step" in " ".join(row))
    assert row[2] == "warm"
    assert "cold <1>: may differ an effect that happens once need not happen in another recording" in row[3]
    assert "c: may differ" in row[3]


def test_page_is_self_contained_and_escaped() -> None:
    text = render_page(make_comparison())
    assert not re.search(r"<script|<link|@import|url\((?!#)|\bsrc=|http(?!://www.w3.org)", text)
    assert re.findall(r' href="([^"]*)"', text) == ["cold%20%3C1%3E/report.html", "warm/report.html", "c/report.html"]
    assert "<1>" not in text
    assert "nan" not in "".join(re.findall(r"<svg.*?</svg>", text, flags=re.S))
    assert text == render_page(make_comparison())


def test_omitted_recordings_and_the_model_are_mentioned() -> None:
    words = collapse_whitespace(PageText(render_page(make_comparison())).words)
    assert "short: 200 samples; too few" in words
    assert (
        "3 recordings were compared with the five classic terms, fitted to cold <1>. Common to all: sinusoidal (gz)."
        in words
    )


def test_agreeing_recordings_give_a_short_page() -> None:
    words = collapse_whitespace(PageText(render_page(compare_results([run("a"), run("b")]))).words)
    assert "2 recordings were compared with the model. None differs by more than chance." in words
    assert "No effect was found in every recording." in words
    assert "No effect was found in some recordings only." in words


def test_missing_library_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        render_page(make_comparison())
