"""Tests of the logarithmic chart and of the decimation of fast samples."""

import numpy as np
import pytest

from monitor.publishing.rerun.allan_chart_geometry import (
    HEIGHT,
    WIDTH,
    ChartDecadeRange,
    band_outline,
    chart_grid,
    decade_range,
    finite_sections,
)
from monitor.publishing.rerun.panels.sample_panels import ROWS_PER_FLUSH, ROWS_PER_S, average_buckets, decimate_extremes


def test_decade_limits_are_the_corners_of_the_chart():
    scale = ChartDecadeRange((-2, 3), (0, 3))
    at = scale.to_chart_positions(np.array([0.01, 1000.0, 1.0]), np.array([1000.0, 1.0, 0.0]))
    assert at[0] == pytest.approx([0.0, 0.0])
    assert at[1] == pytest.approx([WIDTH, HEIGHT])
    assert np.isnan(at[2, 1])


def test_white_noise_has_slope_minus_one_half():
    scale = ChartDecadeRange((0, 4), (0, 4))
    tau = np.array([1.0, 10.0, 100.0])
    at = scale.to_chart_positions(tau, 1000.0 / np.sqrt(tau))
    assert np.diff(at[:, 1]) / HEIGHT * 4 == pytest.approx(0.5)


def test_decade_range_contains_the_data_tightly():
    assert decade_range([np.array([0.01, 655.0])]) == (-2, 3)
    assert decade_range([np.array([10.0, 1000.0])]) == (1, 3)
    assert decade_range([np.array([np.nan, 3.0, -1.0])]) == (0, 2)
    assert decade_range([np.array([np.nan])]) == (0, 2)


def test_every_decade_has_a_labelled_tick():
    drawn = chart_grid(ChartDecadeRange((-2, 3), (-1, 2)))
    labels = [label for _, _, label in drawn.ticks]
    assert labels == ["0.01", "0.1", "1", "10", "100", "1000", "0.1", "1", "10", "100"]
    assert len(drawn.minor) == 8 * (5 + 3)
    assert all((line >= 0).all() and (line <= [WIDTH, HEIGHT]).all() for line in drawn.minor + drawn.major)


def test_missing_point_interrupts_a_line():
    line = np.array([[0.0, 1], [1, 1], [2, np.nan], [3, 1], [4, 1], [5, 1], [6, np.nan], [7, 1]])
    assert [part[:, 0].tolist() for part in finite_sections(line)] == [[0, 1], [3, 4, 5]]


def test_band_is_inside_the_chart():
    low = np.array([[0.0, 5.0], [8.0, HEIGHT + 30.0]])
    high = np.array([[0.0, 4.0], [8.0, 2.0]])
    bottom, top = band_outline(low, high)
    assert bottom.tolist() == [[0.0, 5.0], [8.0, HEIGHT]]
    assert top.tolist() == high.tolist()


def test_slow_samples_are_all_drawn():
    t = 1.76e9 + np.arange(50) / 100
    y = np.sin(t)
    drawn_t, drawn = decimate_extremes(t, y)
    assert (drawn_t == t).all()
    assert (drawn == y).all()


def test_decimated_samples_keep_the_outlier():
    rng = np.random.default_rng(3)
    t = 1.76e9 + np.arange(20_000) / 4000
    y = rng.standard_normal(t.size)
    y[7777], y[11] = 40.0, np.nan
    drawn_t, drawn = decimate_extremes(t, y)
    assert drawn.size <= ROWS_PER_S * 5.0
    assert drawn.max() == 40.0
    assert drawn_t[drawn.argmax()] == t[7777]
    assert (np.diff(drawn_t) > 0).all()
    assert drawn.min() == np.nanmin(y)


def test_number_of_drawn_rows_is_bounded():
    t = 1.76e9 + np.arange(400_000) / 100
    drawn_t, _ = decimate_extremes(t, np.random.default_rng(1).standard_normal(t.size))
    assert drawn_t.size <= ROWS_PER_FLUSH + 4


def test_temperature_is_averaged():
    t = 1.76e9 + np.arange(1000) / 1000
    mean_t, mean = average_buckets(t, np.where(t - 1.76e9 < 0.5, 20.0, 30.0), 2.0)
    assert mean.tolist() == [20.0, 30.0]
    assert mean_t - 1.76e9 == pytest.approx([0.2495, 0.7495], abs=1e-6)
    assert average_buckets(t, np.full(1000, np.nan), 2.0)[0].size == 0
