"""Tests of the Allan plots in the viewer."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.publishing.plots import axis_colours
from monitor.publishing.plots.allan_figure import READING_TAU_S
from monitor.publishing.rerun.allan_chart_geometry import HEIGHT, LABEL_ABOVE, RING_RADIUS, WIDTH, ChartDecadeRange
from monitor.publishing.rerun.allan_drawing import (
    DISCONNECTED_TEXT,
    DOT_RADIUS,
    FIT_WIDTH,
    KEY,
    MARKER_WIDTH,
    RING_WIDTH,
    AllanPlotPair,
)
from tests.monitor.publishing.example_results import make_comparison, make_estimate


def draw_example(estimate: Estimate | None = None, gap: ModelComparison | None = None) -> dict[str, Any]:
    """Return the Rerun components logged by the plots of an example, by path."""
    logged: dict[str, Any] = {}
    plots = AllanPlotPair(lambda path, *parts: logged.update({path: parts[0]}), "d")
    plots.draw(estimate or make_estimate(), gap)
    return logged


def list_labels(points: Any) -> list[str]:
    return list(points.labels.as_arrow_array().to_pylist()) if points.labels is not None else []


def count_lines(lines: Any) -> int:
    return len(lines.strips.as_arrow_array())


def select_lines(lines: Any, colour: axis_colours.Colour, radius: float) -> list[Any]:
    """Return the lines with a colour and a width."""
    red, green, blue = colour
    wanted = (red << 24) + (green << 16) + (blue << 8) + 255, pytest.approx(-radius)  # negative: points of the screen
    parts = [part.as_arrow_array().to_pylist() for part in (lines.strips, lines.colors, lines.radii)]
    return [strip for strip, *style in zip(*parts, strict=True) if tuple(style) == wanted]


def test_key_explains_the_signs_in_use() -> None:
    shown, gap = draw_example(), make_comparison(make_estimate())
    assert list_labels(shown["d/gyro/key/text"]) == ["measured", "fit", "95 %", "N, B, K"]
    assert not count_lines(shown["d/gyro/key/model"])
    shown = draw_example(gap=gap)
    assert list_labels(shown["d/accel/key/text"]) == ["measured", "fit", "95 %", "N, B, K", "model"]
    assert count_lines(shown["d/accel/key/model"]) > 0
    assert {f"d/gyro/key/{sign}" for sign in KEY if sign != "measured"} < set(shown)


def test_fit_that_does_not_describe_the_curve_is_grey_and_named() -> None:
    shown = draw_example(replace(make_estimate(), poorly_fitted_axes=("gz",)))
    assert list_labels(shown["d/gyro/note"]) == ["gz: fit does not describe the curve"]
    assert list_labels(shown["d/accel/note"]) == []
    assert "poor fit" in list_labels(shown["d/gyro/key/text"])
    assert len(select_lines(shown["d/gyro/curves"], axis_colours.GREY, FIT_WIDTH)) == 1
    assert len(select_lines(shown["d/gyro/curves"], axis_colours.AXIS_COLOURS["gx"], FIT_WIDTH)) == 1
    assert not select_lines(shown["d/gyro/curves"], axis_colours.AXIS_COLOURS["gz"], FIT_WIDTH)
    assert not select_lines(shown["d/accel/curves"], axis_colours.GREY, FIT_WIDTH)


def test_plots_of_a_disconnected_device_say_so() -> None:
    logged: list[tuple[str, Any]] = []
    plots = AllanPlotPair(lambda path, *parts: logged.append((path, parts[0])), "d")
    plots.show_connection(connected=False)  # nothing is drawn yet
    assert not logged
    plots.draw(make_estimate(), None)
    logged.clear()
    for connected in (True, False, False, True, True):
        plots.show_connection(connected)
    assert [(path, list_labels(points)) for path, points in logged] == [
        (f"d/{kind}/disconnected", text) for text in ([DISCONNECTED_TEXT], []) for kind in ("gyro", "accel")
    ]


def test_each_axis_has_its_own_marker() -> None:
    shown = draw_example()
    points = len(shown["d/gx"].positions)
    assert shown["d/gx"].radii.as_arrow_array().to_pylist() == [-DOT_RADIUS]  # negative: points of the screen
    for axis, corners in (("gy", 4), ("gz", 3)):
        assert not any(shown[f"d/{axis}"].radii.as_arrow_array().to_pylist())
        markers = select_lines(shown["d/gyro/curves"], axis_colours.AXIS_COLOURS[axis], MARKER_WIDTH)
        assert [len(one) - 1 for one in markers] == [corners] * points


def test_ring_of_n_is_at_one_second_and_at_the_level_of_n() -> None:
    logged, estimate = draw_example(), make_estimate()
    (outline, *_) = select_lines(logged["d/gyro/curves"], axis_colours.AXIS_COLOURS["gx"], RING_WIDTH)
    x, y = np.mean(outline[:-1], axis=0)
    at_tau = {
        tuple(point): label
        for point, label in zip(
            logged["d/gyro/ticks"].positions.as_arrow_array().to_pylist(),
            logged["d/gyro/ticks"].labels.as_arrow_array().to_pylist(),
            strict=True,
        )
    }
    (x_of_one_second,) = [point[0] for point, label in at_tau.items() if label == "1" and point[1] > HEIGHT]
    assert READING_TAU_S["N"] == 1.0
    np.testing.assert_allclose(x, x_of_one_second, atol=1e-4)
    n_degrees_per_hour = np.degrees(estimate.coefficients.value[1, 0]) * 3600.0
    ticks = [
        (point[1] + LABEL_ABOVE, float(label))
        for point, label in at_tau.items()
        if point[0] < 0.0 and point[1] < HEIGHT
    ]
    heights, levels = np.array(sorted(ticks)).T
    expected = np.interp(np.log10(n_degrees_per_hour), np.log10(levels[::-1]), heights[::-1])
    np.testing.assert_allclose(y, expected, atol=1e-3)
    assert 0.0 < x < WIDTH


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_letter_is_directly_below_its_lowest_ring_even_if_the_axes_differ(factor: float) -> None:
    estimate = make_estimate()
    scale = np.array([1.0, factor, factor, 1.0, 1.0, 1.0])  # a plot whose gx has the smallest coefficients
    coefficients, curve = estimate.coefficients, estimate.curve
    shown = draw_example(
        replace(
            estimate,
            coefficients=replace(coefficients, value=coefficients.value * scale),
            curve=replace(curve, avar=curve.avar * scale**2, lo=curve.lo * scale, hi=curve.hi * scale),
            fitted=estimate.fitted * scale**2,
        )
    )
    letters = shown["d/gyro/letters"]
    at = dict(zip(list_labels(letters), letters.positions.as_arrow_array().to_pylist(), strict=True))
    axes = ("gx", "gy", "gz")
    rings = [
        np.mean(outline[:-1], axis=0)
        for axis in axes
        for outline in select_lines(shown["d/gyro/curves"], axis_colours.AXIS_COLOURS[axis], RING_WIDTH)
    ]
    assert {"N", "B"} <= set(at)
    for x, y in at.values():
        lowest = max(ring[1] for ring in rings if abs(ring[0] - x) < 1e-4)
        assert y == pytest.approx(lowest + RING_RADIUS, abs=1e-4)


def test_letter_without_space_below_its_ring_is_beside_it() -> None:
    estimate = make_estimate()
    low = replace(estimate.coefficients, value=estimate.coefficients.value.copy())
    scale = ChartDecadeRange((0, 1), (0, 1))
    plots = AllanPlotPair(lambda *_: None, "d")
    for kind, axes in (("gyro", slice(0, 3)), ("accel", slice(3, 6))):
        low.value[1, axes] = 1.05 / plots._units.deviation(kind).factor  # N just above the lower end of the plot
        _, letters = plots._rings_and_letters(kind, scale, replace(estimate, coefficients=low))
        (x, y) = dict(zip(list_labels(letters), letters.positions.as_arrow_array().to_pylist(), strict=True))["N"]
        assert (x, y + LABEL_ABOVE) == pytest.approx((-0.8, HEIGHT * (1.0 - np.log10(1.05))), abs=1e-3)
