"""The drawings of a reconciliation: what stands where, in which unit, and what never leaves its panel."""

import re
from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

from monitor.publishing.plots.reconcile_chart import along, chart, height_of, near, plotted, view_at
from monitor.reconcile.result import Location, PlotData
from tests.monitor.reconcile import samples

SVG = "{http://www.w3.org/2000/svg}"
START = samples.look("gz", n_true=samples.MORE_N, line=True)
PSD, ALLAN, LEVEL, DISTRIBUTION = START.views
PEAK = Location(frequency=(17.1, 17.5))


def drawing(
    *views: PlotData, where: Location | None = None, width: float = 400.0, height: float = 250.0
) -> ElementTree.Element:
    text = chart([(f"panel {i}", view) for i, view in enumerate(views)], "gz", width, height, where)
    return ElementTree.fromstring(text.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1))


def texts(element: ElementTree.Element) -> list[str]:
    return [one.text or "" for one in element.iter(f"{SVG}text")]


def vertices(path: str) -> np.ndarray:
    """[n, 2] px of a path as it is written: a place, then ways."""
    numbers = np.array([float(one) for one in re.findall(r"-?[\d.]+", path)]).reshape(-1, 2)
    return np.cumsum(numbers, axis=0)


def test_panels_have_names_and_units_of_the_field() -> None:
    words = texts(drawing(ALLAN, ALLAN))
    assert words.count("Allan deviation, °/h") == 1  # of both panels
    assert words.count("averaging time, s") == 2
    assert {"panel 0", "panel 1", "0.01", "100"} <= set(words)
    assert "spectral density, (°/h)²/Hz" in texts(drawing(PSD))
    assert "time, min" in texts(drawing(LEVEL))
    assert {"value over its deviation", "density"} <= set(texts(drawing(DISTRIBUTION)))


def test_a_point_of_the_curve_stands_at_its_place() -> None:
    (_, curve, *_) = [one.attrib["d"] for one in drawing(ALLAN).iter(f"{SVG}path") if "Z" not in one.attrib["d"]][1:]
    at = vertices(curve)
    low, high = np.log10(height_of([plotted("", ALLAN, "gz", None)]))
    tau, sigma = np.log10(ALLAN.x), np.log10(ALLAN.measured * np.degrees(3600.0))
    wide, tall = 400.0 - 54.0 - 16.0, 250.0 - 28.0 - 40.0
    assert at[:, 0] == pytest.approx((tau - tau[0]) / np.ptp(tau) * wide, abs=0.06)
    assert at[:, 1] == pytest.approx((high - sigma) / (high - low) * tall, abs=0.06)


def test_a_place_is_marked_where_it_is_and_named_beside_it() -> None:
    (mark,) = [one for one in drawing(PSD, where=PEAK).iter(f"{SVG}rect") if "opacity" in one.attrib]
    a = float(mark.attrib["x"])
    b = a + float(mark.attrib["width"])
    ends = np.log10([PSD.x[0], PSD.x[-1]])
    peak = (np.log10(17.3) - ends[0]) / np.ptp(ends) * 330.0
    assert a < peak < b
    assert b - a == pytest.approx(5.0, abs=0.1)  # never too narrow to be seen
    assert "17.1 … 17.5 Hz" in texts(drawing(PSD, where=PEAK))
    assert not [one for one in drawing(LEVEL, where=PEAK).iter(f"{SVG}rect") if "opacity" in one.attrib]


def test_no_word_leaves_the_drawing_and_no_labels_touch() -> None:
    for views in ((PSD, PSD), (ALLAN, ALLAN), (LEVEL, LEVEL), (DISTRIBUTION,)):
        for width in (300.0, 680.0):
            root = drawing(*views, width=width)
            below: dict[str, list[tuple[float, float]]] = {}
            for word in root.findall(f"{SVG}text"):
                half = 0.5 * 6.3 * len(word.text or "")
                middle = (
                    float(word.attrib["x"]) + {"start": half, "middle": 0.0, "end": -half}[word.attrib["text-anchor"]]
                )
                assert middle - half > -1.0, word.text
                assert middle + half < width + 1.0, word.text
                if word.attrib["text-anchor"] == "middle":
                    below.setdefault(word.attrib["y"], []).append((middle - half, middle + half))
            for row in below.values():
                ordered = sorted(row)
                assert all(a[1] < b[0] for a, b in pairwise(ordered))


def test_an_almost_empty_bin_does_not_press_the_curves_flat() -> None:
    deep = replace(PSD, measured=PSD.measured.copy())
    deep.measured[3] = 1e-30
    low, high = height_of([plotted("", deep, "gz", None)])
    assert np.log10(high / low) < 6.0
    peak = replace(PSD, measured=PSD.measured.copy())
    peak.measured[300] = 1.0  # but a line is what one looks for
    assert height_of([plotted("", peak, "gz", None)])[1] > 1.0


def test_panels_side_by_side_have_one_height() -> None:
    small = replace(LEVEL, measured=0.1 * LEVEL.measured, lo=0.1 * LEVEL.lo, hi=0.1 * LEVEL.hi)
    both = height_of([plotted("", one, "gz", None) for one in (LEVEL, small)])
    assert both == height_of([plotted("", LEVEL, "gz", None)])


def test_gaps_zeros_and_constants_can_be_drawn() -> None:
    broken = replace(ALLAN, measured=np.full_like(ALLAN.x, np.nan))
    holes = replace(PSD, measured=np.where(np.arange(PSD.x.size) % 3 == 0, np.nan, PSD.measured), lo=0 * PSD.lo)
    flat = replace(LEVEL, measured=0 * LEVEL.x, lo=0 * LEVEL.x, hi=0 * LEVEL.x)
    nothing = replace(broken, expected=broken.measured, lo=broken.measured, hi=broken.measured)
    for view in (broken, holes, flat, nothing):
        text = ElementTree.tostring(drawing(view), "unicode")
        assert "nan" not in text
        assert "inf" not in text


def test_a_narrow_place_has_a_panel_of_its_own_and_a_wide_one_has_not() -> None:
    part = near(PSD, PEAK)
    assert part is not None
    assert part.x[0] < 17.1
    assert part.x[-1] > 17.5
    assert part.x.size < PSD.x.size / 4
    assert part.measured.max() == PSD.measured[np.argmin(np.abs(PSD.x - 17.3))]
    assert near(ALLAN, Location(tau=(0.01, 0.64))) is None
    assert near(ALLAN, Location(tau=(1.0, 1.1))) is None  # three points are no picture
    assert near(PSD, Location()) is None


def test_each_place_lies_along_the_views_that_know_it() -> None:
    where = Location(frequency=(1, 2), tau=(3, 4), time=(5, 6), temperature=(7, 8), value=(9, 10))
    assert [along(view, where) for view in START.views] == [(1, 2), (3, 4), (5, 6), None]
    assert along(replace(LEVEL, x_name="temperature", x_unit="°C"), where) == (7, 8)
    assert along(replace(LEVEL, x_name="lag"), where) == (3, 4)
    assert along(replace(DISTRIBUTION, x_unit="rad/s"), where) == (9, 10)


def test_a_lens_without_picture_borrows_the_one_along_its_place() -> None:
    assert view_at(START.views, "allan", Location()) is ALLAN
    assert view_at(START.views, "lines", PEAK) is PSD
    assert view_at(START.views, "other_axes", Location(source="ax")) is None
