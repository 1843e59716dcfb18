"""Tests of the figure of dynamic curves: marks of changes, labels, value ranges and time axis."""

from itertools import pairwise

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.estimation.allan.dynamic_allan import DynamicAllan, compute_dynamic_allan
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.publishing.plots.dynamic_figure import (
    BAND_ENDS_INSIDE,
    MIN_LABEL_DISTANCE,
    ChangeMark,
    _group_times,
    _shown_coefficients,
    draw_dynamic_panels,
)
from monitor.publishing.plots.style import COLOURS, DARK, select_time_unit


@pytest.fixture(scope="module")
def white_noise() -> DynamicAllan:
    """Compute dynamic curves of ten minutes of white noise with a window of one minute."""
    return compute_dynamic_allan(np.random.default_rng(1).standard_normal((6000, 6)), 10.0, 60.0, step_s=9.0)


def draw_panels(found: DynamicAllan, marks: list[ChangeMark], kind: str = "gyro"):
    figure = pytest.importorskip("matplotlib.figure").Figure(figsize=(7.2, 8.0), layout="constrained")
    draw_dynamic_panels(figure, found, kind, marks)
    figure.draw_without_rendering()
    count = 3 + len(_shown_coefficients(found, kind))
    return figure.axes[:count]


def list_mark_times_s(panel, colour: str) -> list[float]:
    """Return the times of the vertical marks of a colour in seconds; the time axis is in minutes."""
    return [
        60.0 * float(line.get_xdata()[0])
        for line in panel.lines
        if line.get_linestyle() == "--" and line.get_color() == colour
    ]


@pytest.mark.long
def test_change_is_marked_in_its_surface_and_in_all_coefficients(white_noise: DynamicAllan) -> None:
    gx, gy, gz, *coefficients = draw_panels(white_noise, [ChangeMark(300.0, "gy"), ChangeMark(240.0, "az")])
    assert [list_mark_times_s(panel, DARK) for panel in (gx, gy, gz)] == [[], [300.0], []]
    assert [[text.get_text() for text in panel.texts] for panel in (gx, gy, gz)] == [[], ["change"], []]
    assert coefficients
    assert all(list_mark_times_s(panel, COLOURS[1]) == [300.0] for panel in coefficients)
    assert not any(list_mark_times_s(panel, COLOURS[2]) for panel in coefficients)  # az is in the other figure
    ax, ay, az, *_ = draw_panels(white_noise, [ChangeMark(300.0, "gy"), ChangeMark(240.0, "az")], "accel")
    assert [list_mark_times_s(panel, DARK) for panel in (ax, ay, az)] == [[], [], [240.0]]


def test_marks_outside_the_time_axis_are_not_drawn(white_noise: DynamicAllan) -> None:
    drawn = draw_panels(white_noise, [ChangeMark(5.0, "gx"), ChangeMark(5000.0, "gx")])
    assert not any(panel.texts or list_mark_times_s(panel, DARK) for panel in drawn)
    assert drawn[0].get_xlim() == pytest.approx((55.5 / 60.0, (float(white_noise.t_s[-1]) + 4.5) / 60.0))


def test_labels_are_inside_the_panel_and_do_not_overlap(white_noise: DynamicAllan) -> None:
    """This also holds for many changes and for changes at the very end."""
    end = float(white_noise.t_s[-1])
    times = [60.0, 62.0, 200.0, 230.0, 231.0, 400.0, 470.0, end - 3.0, end]
    gx, *_ = draw_panels(white_noise, [ChangeMark(time, "gx") for time in times])
    assert len(list_mark_times_s(gx, DARK)) == len(times)
    counted = [text.get_text().split() for text in gx.texts]
    assert sum(int(parts[0]) if len(parts) == 2 else 1 for parts in counted) == len(times)
    boxes = sorted((text.get_window_extent() for text in gx.texts), key=lambda box: box.x0)
    assert all(before.x1 < after.x0 for before, after in pairwise(boxes))
    inside = gx.get_window_extent()
    assert all(inside.x0 <= box.x0 and box.x1 <= inside.x1 and box.y1 <= inside.y1 for box in boxes)


def test_grouped_times_keep_their_distance() -> None:
    times = np.random.default_rng(2).random(60) * 100.0
    groups = _group_times(times.tolist(), 8.0)
    assert sorted(time for group in groups for time in group) == sorted(times.tolist())
    middles = [np.mean(group) for group in groups]
    assert len(groups) > 3
    assert (np.diff(middles) >= 8.0).all()
    assert _group_times([], 1.0) == []
    assert MIN_LABEL_DISTANCE < 0.5


def test_coefficient_panel_shows_all_values_and_most_intervals(white_noise: DynamicAllan) -> None:
    *_, n = draw_panels(white_noise, [])
    gyros = [AXES.index(axis) for axis in ("gx", "gy", "gz")]
    assert _shown_coefficients(white_noise, "gyro")[-1] == "N"
    estimated = white_noise.status[:, 1, gyros] == Status.ESTIMATED
    factor = np.degrees(1.0) * 60.0
    low, high = n.get_ylim()
    values = white_noise.value[:, 1, gyros][estimated] * factor
    assert low < values.min()
    assert values.max() < high
    ends = (
        np.stack([white_noise.value_lo[:, 1, gyros][estimated], white_noise.value_hi[:, 1, gyros][estimated]]) * factor
    )
    assert ((ends >= low) & (ends <= high)).mean() > 2.0 * BAND_ENDS_INSIDE - 1.0


@pytest.mark.parametrize(
    ("span_s", "name"), [(599.0, "s"), (600.0, "min"), (10_800.0, "h"), (259_200.0, "d"), (1e9, "d")]
)
def test_time_axis_has_the_unit_of_its_span(span_s: float, name: str) -> None:
    assert select_time_unit(span_s)[0] == name
