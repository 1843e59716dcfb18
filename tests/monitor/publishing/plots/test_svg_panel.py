"""Panels drawn as SVG elements: ticks, curves with many points, and gaps."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from monitor.publishing.plots.svg_panel import AxisScale, SvgPanel, render_svg

SVG = "{http://www.w3.org/2000/svg}"


def curves(x, y, log=False):
    panel = SvgPanel((10.0, 20.0, 100.0, 50.0), (1.0, 1001.0), (0.5, 4.5), (log, log))
    panel.draw_line(np.asarray(x), np.asarray(y), "#123456", 1.0)
    drawing = ElementTree.fromstring(render_svg(120.0, 80.0, [panel], "a <b>"))
    assert drawing.attrib["aria-label"] == "a <b>"
    return [
        np.array([float(one) for one in re.findall(r"-?[\d.]+", path.attrib["d"])]).reshape(-1, 2)
        for path in drawing.iter(f"{SVG}path")
    ]


@pytest.mark.parametrize(
    ("limits", "log", "expected"),
    [
        ((0.0, 10.0), False, [0.0, 5.0, 10.0]),
        ((-0.03, 0.11), False, [0.0, 0.1]),
        ((0.9, 30.0), True, [1.0, 2.0, 5.0, 10.0, 20.0]),
        ((1e-3, 1e4), True, [1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4]),
        ((1e-8, 1e10), True, [1e-8, 1e-5, 1e-2, 10.0, 1e4, 1e7, 1e10]),
        ((1.1, 1.9), True, [1.5]),
    ],
)
def test_ticks_are_round_numbers_within_the_limits(limits, log, expected):
    assert AxisScale(limits, (0.0, 100.0), log).ticks(40.0) == pytest.approx(expected)


def test_a_curve_with_many_points_keeps_every_extreme_value():
    x, y = np.linspace(1.0, 1001.0, 200_001), np.full(200_001, 1.0)
    y[[777, 150_000]] = 4.0
    y[88_888] = 0.5
    (drawn,) = curves(x, y)
    assert len(drawn) < 1000
    assert drawn[:, 1].max() == 70.0
    assert drawn[:, 1].min() == pytest.approx(26.25, abs=0.06)
    assert drawn[drawn[:, 1] < 30.0, 0] == pytest.approx([10.0 + x[777] / 10.0, 10.0 + x[150_000] / 10.0], abs=0.2)


def test_values_without_a_position_leave_gaps():
    y = np.array([1.0, 2.0, np.nan, 2.0, 0.0, 3.0, 4.0, 4.0])
    assert [len(one) for one in curves(np.arange(1.0, 9.0), y, log=True)] == [2, 3]
