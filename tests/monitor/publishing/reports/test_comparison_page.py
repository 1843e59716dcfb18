"""The page of several recordings: what is common, what is single, links, and nothing from the network."""

import re
import sys
from dataclasses import replace

import pytest

from drivers.errors import ConfigError
from monitor.publishing.reports.comparison_page import render_page
from monitor.reconcile.several_recordings.comparison import Comparison, compare_results
from tests.monitor.publishing.reports.test_reconcile_page import Text
from tests.monitor.reconcile.runs_made import DIAGNOSTIC, line, run, step, with_axes

pytest.importorskip("jinja2")


def made() -> Comparison:
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


def joined(text: str) -> str:
    return " ".join(text.split())


def test_the_table_has_axes_and_recordings() -> None:
    text = Text(render_page(made()))
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


def test_a_common_effect_has_every_recording_and_the_pooled_value() -> None:
    text = Text(render_page(made()))
    table = {row[0]: row[1:] for row in text.rows}
    assert table["warm"] == ["31.35 ± 0.62 °/h", "17.3000 ± 0.0010 Hz", "99.0 %"]
    assert table["all together"][0] == "29.7 ± 2.8 °/h"  # they differ: its interval holds their scatter
    assert "sizes differ (p < 0.001)" in text.words
    (chart,) = re.findall(r"<svg.*?</svg>", render_page(made()), flags=re.S)
    said = re.findall(r"<text[^>]*>([^<]*)</text>", chart)
    assert {"cold &lt;1&gt;", "warm", "c", "all together", "amplitude, °/h, with 95 % intervals"} <= set(said)


def test_a_single_effect_says_why_it_is_not_in_the_others() -> None:
    (row,) = (row for row in Text(render_page(made())).rows if "bias step" in " ".join(row))
    assert row[2] == "warm"
    assert "cold <1>: may differ an effect that happens once need not happen in another recording" in row[3]
    assert "c: may differ" in row[3]


def test_the_page_is_complete_in_itself_and_escaped() -> None:
    text = render_page(made())
    assert not re.search(r"<script|<link|@import|url\((?!#)|\bsrc=|http(?!://www.w3.org)", text)
    assert re.findall(r' href="([^"]*)"', text) == ["cold%20%3C1%3E/report.html", "warm/report.html", "c/report.html"]
    assert "<1>" not in text
    assert "nan" not in "".join(re.findall(r"<svg.*?</svg>", text, flags=re.S))
    assert text == render_page(made())


def test_what_was_left_out_and_what_the_model_was_is_told() -> None:
    words = joined(Text(render_page(made())).words)
    assert "short: 200 samples; too few" in words
    assert (
        "3 recordings were compared with the five classic terms, fitted to cold <1>. Common to all: sinusoidal (gz)."
        in words
    )


def test_recordings_that_agree_make_a_short_page() -> None:
    words = joined(Text(render_page(compare_results([run("a"), run("b")]))).words)
    assert "2 recordings were compared with the model. None differs by more than chance." in words
    assert "No effect was found in every recording." in words
    assert "No effect was found in some recordings only." in words


def test_without_its_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        render_page(made())
