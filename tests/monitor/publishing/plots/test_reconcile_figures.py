"""Tests of the figures of a reconciliation: positions, units, marked ranges and data with gaps."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from monitor.publishing.plots.reconcile_figures import (
    common_y_limits,
    diagnostic_comparison_svg,
    interval_chart_svg,
    range_on_x_axis,
    select_diagnostic_view,
    to_displayed_units,
    zoomed_view,
)
from monitor.publishing.plots.style import COLOURS, ORANGE
from monitor.reconcile.result import DiagnosticPlotData, Location, ParameterInterval
from tests.monitor.reconcile import samples

pytest.importorskip("matplotlib")

SVG = "{http://www.w3.org/2000/svg}"
START = samples.look("gz", n_true=samples.MORE_N, line=True)
PSD, ALLAN, LEVEL, DISTRIBUTION = START.plots
PEAK = Location(frequency=(17.1, 17.5))


def draw_views(
    *views: DiagnosticPlotData, where: Location | None = None, width: float = 4.0, height: float = 2.5
) -> ElementTree.Element:
    return ElementTree.fromstring(
        diagnostic_comparison_svg([(f"panel {i}", view) for i, view in enumerate(views)], "gz", width, height, where)
    )


def list_texts(element: ElementTree.Element) -> list[str]:
    return [node.text or "" for node in element.iter(f"{SVG}text")]


def parse_line_vertices(element: ElementTree.Element, colour: str) -> list[np.ndarray]:
    """Return the vertices [n, 2] of the open lines of a colour, in points."""
    return [
        np.array([float(number) for number in re.findall(r"-?[\d.]+", path.attrib["d"])]).reshape(-1, 2)
        for path in element.iter(f"{SVG}path")
        if f"stroke: {colour.lower()}" in path.attrib.get("style", "") and "fill: none" in path.attrib["style"]
    ]


def test_panels_have_conventional_names_and_units() -> None:
    labels = list_texts(draw_views(ALLAN, ALLAN))
    assert labels.count("Allan deviation, °/h") == 1  # both panels share one label
    assert labels.count("averaging time, s") == 2
    assert {"panel 0", "panel 1", "0.01", "100"} <= set(labels)
    assert "spectral density, (°/h)²/Hz" in list_texts(draw_views(PSD))
    assert "time, min" in list_texts(draw_views(LEVEL))
    assert {"value over its deviation", "density"} <= set(list_texts(draw_views(DISTRIBUTION)))


def test_point_of_the_curve_is_at_its_position() -> None:
    (vertices,) = parse_line_vertices(draw_views(ALLAN), COLOURS[2])
    low, high = np.log10(common_y_limits([to_displayed_units("", ALLAN, "gz", None)]))
    tau, sigma = np.log10(ALLAN.x), np.log10(ALLAN.measured * np.degrees(3600.0))
    left, right, top, bottom = 72.0 * np.array([0.58, 0.15, 0.30, 0.44])
    wide, tall = 288.0 - left - right, 180.0 - top - bottom
    assert vertices[:, 0] == pytest.approx(left + (tau - tau[0]) / np.ptp(tau) * wide, abs=0.06)
    assert vertices[:, 1] == pytest.approx(top + (high - sigma) / (high - low) * tall, abs=0.06)


def test_range_is_marked_where_the_diagnostic_resolves_it() -> None:
    def find_marks(element: ElementTree.Element) -> list[ElementTree.Element]:
        return [node for node in element.iter(f"{SVG}path") if ORANGE.lower() in node.attrib.get("style", "")]

    (mark,) = find_marks(draw_views(PSD, where=PEAK))
    x = [float(number) for number in re.findall(r"-?[\d.]+", mark.attrib["d"])][::2]
    ends = np.log10([PSD.x[0], PSD.x[-1]])
    peak = 41.76 + (np.log10(17.3) - ends[0]) / np.ptp(ends) * (288.0 - 52.56)
    assert min(x) < peak < max(x)
    assert "17.1 … 17.5 Hz" in list_texts(draw_views(PSD, where=PEAK))
    assert not find_marks(draw_views(LEVEL, where=PEAK))


def test_names_are_escaped_and_equal_data_give_equal_bytes() -> None:
    first, second = (diagnostic_comparison_svg([("a <b> & $x$", PSD)], "gz", 4.0, 2.5) for _ in range(2))
    assert first == second
    assert "a <b> & $x$" in list_texts(ElementTree.fromstring(first))


def test_almost_empty_bin_does_not_extend_the_scale_but_a_line_does() -> None:
    with_small_value = replace(PSD, measured=PSD.measured.copy())
    with_small_value.measured[3] = 1e-30
    low, high = common_y_limits([to_displayed_units("", with_small_value, "gz", None)])
    assert np.log10(high / low) < 6.0
    peak = replace(PSD, measured=PSD.measured.copy())
    peak.measured[300] = 1.0  # a line must stay visible
    assert common_y_limits([to_displayed_units("", peak, "gz", None)])[1] > 1.0


def test_adjacent_panels_have_a_common_scale() -> None:
    small = replace(LEVEL, measured=0.1 * LEVEL.measured, lo=0.1 * LEVEL.lo, hi=0.1 * LEVEL.hi)
    both = common_y_limits([to_displayed_units("", view, "gz", None) for view in (LEVEL, small)])
    assert both == common_y_limits([to_displayed_units("", LEVEL, "gz", None)])


def test_gaps_zeros_and_constants_can_be_drawn() -> None:
    broken = replace(ALLAN, measured=np.full_like(ALLAN.x, np.nan))
    holes = replace(PSD, measured=np.where(np.arange(PSD.x.size) % 3 == 0, np.nan, PSD.measured), lo=0 * PSD.lo)
    flat = replace(LEVEL, measured=0 * LEVEL.x, lo=0 * LEVEL.x, hi=0 * LEVEL.x)
    empty = replace(broken, expected=broken.measured, lo=broken.measured, hi=broken.measured)
    for view in (broken, holes, flat, empty):
        text = ElementTree.tostring(draw_views(view), "unicode")
        assert "nan" not in text
        assert "inf" not in text


def test_only_a_narrow_range_has_a_detail_plot() -> None:
    part = zoomed_view(PSD, PEAK)
    assert part is not None
    assert part.x[0] < 17.1
    assert part.x[-1] > 17.5
    assert part.x.size < PSD.x.size / 4
    assert part.measured.max() == PSD.measured[np.argmin(np.abs(PSD.x - 17.3))]
    assert zoomed_view(ALLAN, Location(tau=(0.01, 0.64))) is None
    assert zoomed_view(ALLAN, Location(tau=(1.0, 1.1))) is None  # three points are too few for a plot
    assert zoomed_view(PSD, Location()) is None


def test_range_lies_on_the_axis_of_each_view() -> None:
    where = Location(frequency=(1, 2), tau=(3, 4), time=(5, 6), temperature=(7, 8), value=(9, 10))
    assert [range_on_x_axis(view, where) for view in START.plots] == [(1, 2), (3, 4), (5, 6), None]
    assert range_on_x_axis(replace(LEVEL, x_name="temperature", x_unit="°C"), where) == (7, 8)
    assert range_on_x_axis(replace(LEVEL, x_name="lag"), where) == (3, 4)
    assert range_on_x_axis(replace(DISTRIBUTION, x_unit="rad/s"), where) == (9, 10)


def test_diagnostic_without_plot_uses_the_plot_of_its_range() -> None:
    assert select_diagnostic_view(START.plots, "allan", Location()) is ALLAN
    assert select_diagnostic_view(START.plots, "lines", PEAK) is PSD
    assert select_diagnostic_view(START.plots, "other_axes", Location(source="ax")) is None


def test_interval_chart_shortens_names_and_omits_values_without_interval() -> None:
    rows = [
        ("a" * 50, ParameterInterval(2.0, 1.0, 3.0)),
        ("b", ParameterInterval("ax")),
        ("all", ParameterInterval(2.0, 1.5, 2.5)),
    ]
    chart = ElementTree.fromstring(interval_chart_svg(rows, "amplitude, °/h", 1.0, COLOURS[0]))
    assert {f"{'a' * 31}…", "b", "all", "amplitude, °/h"} <= set(list_texts(chart))
    assert len(parse_line_vertices(chart, COLOURS[0])) == 1
