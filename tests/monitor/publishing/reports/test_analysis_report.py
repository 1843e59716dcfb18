"""Tests of the HTML report of an analysis: self-contained, small, and with units."""

import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.common.unit_formatting import DEFAULT_UNITS, UNIT_SYSTEMS
from monitor.estimation.allan.dynamic_allan import DynamicAllan, compute_dynamic_allan
from monitor.estimation.analysis import RecordingAnalysis
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.publishing.plots.analysis_plot import AnalysisPlotData
from monitor.publishing.plots.dynamic_figure import ChangeMark
from monitor.publishing.reports import analysis_report
from tests.monitor.publishing import example_results

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")


def make_analysis(**changed: object) -> RecordingAnalysis:
    return example_results.make_analysis(
        replace(example_results.make_estimate(), **changed), notes=("3 samples < 4 & more",)
    )


@pytest.fixture(scope="module")
def long_dynamic_curves() -> DynamicAllan:
    """Return the largest number of time steps, with several coefficients estimated."""
    sources = (
        QuantizationNoise(Q=2e-4),
        AngleRandomWalk(N=1.5e-4),
        BiasInstability(B=3e-4),
        RateRandomWalk(K=3e-4),
    )
    model = NoiseModel(dict.fromkeys(("gx", "gy", "gz", "ax", "ay", "az"), sources))
    found = compute_dynamic_allan(model.simulate(12_400, 20.0, 1), 20.0, 500.0, step_s=1.0)
    assert found.t_s.size == 121
    return DynamicAllan(
        np.linspace(500.0, 3000.0, 484), found.window_s, found.rate_hz, found.tau_s,
        *(np.concatenate([part, part[::-1]] * 2) for part in (
            found.deviation, found.lo, found.hi, found.value, found.value_lo, found.value_hi, found.status
        )),
    )  # fmt: skip


class ReportPage(HTMLParser):
    """The table cells of the page and all addresses to which it refers."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href")]
        self.open.append(tag)
        if tag == "td":
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in self.open:
            del self.open[len(self.open) - 1 - self.open[::-1].index(tag) :]

    def handle_data(self, data: str) -> None:
        if "td" in self.open:
            self.cells[-1] = f"{self.cells[-1]} {data}".strip()


@pytest.mark.long
def test_cells_have_value_unit_and_interval() -> None:
    result = make_analysis()
    page = ReportPage(analysis_report.render_page(AnalysisPlotData(result), "bench-1"))
    value, lo, hi = (part[1, 2] * np.degrees(1) * 60 for part in get_coefficient_arrays(result))
    cells = [" ".join(cell.split()) for cell in page.cells]
    assert "N angle random walk, °/√h" in cells
    assert f"{value:.3f} {lo:.3f} … {hi:.3f}" in cells
    bound = result.estimate.coefficients.hi[4, 0] * np.degrees(1) * 3600**2
    assert f"≤ {bound:.2f} (upper bound)" in cells
    assert len(cells) == 2 * 5 * 4


def get_coefficient_arrays(result: RecordingAnalysis) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    known = result.estimate.coefficients
    return known.value, known.lo, known.hi


@pytest.mark.parametrize("units", ["datasheet", "si"])
def test_page_can_use_other_units(units: str) -> None:
    result = make_analysis()
    page = ReportPage(analysis_report.render_page(AnalysisPlotData(result, units=UNIT_SYSTEMS[units])))
    cells = [" ".join(cell.split()) for cell in page.cells]
    n = result.estimate.coefficients.value[1, 2]
    if units == "datasheet":
        assert any(cell.startswith(f"{n * np.degrees(1) * 60:.3f} ") for cell in cells)
        assert any(cell.startswith(f"{n * np.degrees(1) * 1000 * np.sqrt(2):.2f} ") for cell in cells)
        assert len(cells) == 2 * 6 * 4
    else:
        assert any(cell.startswith(f"{n:.6f} ") for cell in cells)
        assert len(cells) == 2 * 5 * 4


def test_unknown_values_are_described_in_words() -> None:
    short = example_results.make_analysis(seconds=200.0)
    short.estimate.curve.avar[:, 3:] = np.nan
    text = analysis_report.render_page(AnalysisPlotData(short))
    assert text.count("(too few data)") == 3  # R on three axes
    assert "— <small>(too few data)</small>" in " ".join(text.split())
    assert 'class="because"' not in text
    drifting = replace(example_results.make_estimate(seconds=1000.0), k_or_r=np.array([True] + [False] * 5))
    columns = DEFAULT_UNITS.columns("gyro")
    small = {column.symbol: analysis_report.format_value_and_interval(drifting, column, "gx")[1] for column in columns}
    assert small["K"] == "(upper bound; K or R)"
    assert small["R"] == "(too few data)"
    assert "…" in small["N"]


def test_page_shows_the_facts_of_the_recording() -> None:
    facts = dict(analysis_report.recording_facts(make_analysis(samples=359_640)))
    assert facts == {
        "rate": "100 Hz",
        "samples": "359,640",
        "duration": "1 h 00 min",
        "missing samples": "360 (0.10 %)",
        "averaging times": "0.0100 … 655 s",
    }
    assert dict(analysis_report.recording_facts(make_analysis()))["missing samples"] == "none"


@pytest.mark.long
def test_page_is_self_contained_and_below_a_megabyte(tmp_path: Path, long_dynamic_curves: DynamicAllan) -> None:
    path = tmp_path / "report.html"
    drawn = AnalysisPlotData(make_analysis(), dynamic=long_dynamic_curves, marks=[ChangeMark(1500.0, "gz")])
    analysis_report.write_html_report(drawn, path, "a <b> & c")
    text = path.read_text("utf-8")
    assert path.stat().st_size < 1_000_000
    page = ReportPage(text)
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in page.addresses)
    assert not re.search(r"<script|<link|@import|url\((?!#)", text)
    assert "a &lt;b&gt; &amp; c" in text
    assert "3 samples &lt; 4 &amp; more" in text
    assert "in a window of 8 min 20 s" in text
    names = re.findall(r'\bid="([^"]+)"', text)
    assert len(names) == len(set(names))
    referred = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    assert referred <= set(names)
    drawings = re.findall(r"<svg.*?</svg>", text, flags=re.S)
    assert len(drawings) == 4
    for drawing in drawings:
        root = ElementTree.fromstring(drawing)
        assert "viewBox" in root.attrib
        assert not {"width", "height"} & root.attrib.keys()  # the drawing fills its column


def test_recording_without_accelerometers_has_one_column() -> None:
    result = make_analysis()
    result.estimate.curve.avar[:, 3:] = np.nan
    text = analysis_report.render_page(AnalysisPlotData(result))
    assert text.count("<svg") == 1
    assert "Accelerometers" not in text


@pytest.mark.long
def test_same_analysis_gives_the_same_page() -> None:
    result = make_analysis()
    result.estimate.curve.avar[:, 3:] = np.nan
    first, second = (analysis_report.render_page(AnalysisPlotData(result), "x") for _ in range(2))
    assert first == second


@pytest.mark.parametrize("name", ["matplotlib.figure", "jinja2"])
def test_missing_library_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=r"pip install \"imu-monitor\[plot\]\""):
        analysis_report.render_page(AnalysisPlotData(make_analysis()))


@pytest.mark.long
def test_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot write the report"):
        analysis_report.write_html_report(AnalysisPlotData(make_analysis()), tmp_path / "absent" / "report.html")
