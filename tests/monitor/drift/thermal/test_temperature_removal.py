"""Drift that was temperature: taken out it is gone, and what was drift by itself stays."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from drivers.data_types import make_block
from monitor.drift.thermal.temperature_removal import (
    interpolate_with_zero_mean,
    remove_temperature_effect,
    temperature_varied,
)
from monitor.estimation.analysis import analyze
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.publishing.terminal.thermal_output import notes_on_temperature_dependence

RATE_HZ = 2.0
N = 1e-4
SECONDS = 6 * 3600.0


@pytest.fixture(scope="module")
def warm():
    """gx: white noise and temperature; gy: white noise and its own random walk; the others are not measured."""
    rng = np.random.default_rng(3)
    n = round(SECONDS * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    warmth = 25.0 + 2.0 * np.sin(2.0 * np.pi * t / 7200.0) + 1.5 * np.sin(2.0 * np.pi * t / 3100.0)
    values = np.full((n, 6), np.nan)
    values[:, :2] = N * RATE_HZ**0.5 * rng.standard_normal((n, 2))
    values[:, 0] += 3e-5 * (warmth - 25.0)
    values[:, 1] += 3e-6 / RATE_HZ**0.5 * rng.standard_normal(n).cumsum()
    samples = make_block(np.rint(1e9 * t).astype(np.int64), values, warmth)
    return analyze([samples], RATE_HZ), warmth


@pytest.mark.long
def test_what_was_temperature_is_gone_and_the_rest_stays(warm):
    result, warmth = warm
    found = remove_temperature_effect(result, warmth)
    assert found.models["gx"] == "polynomial 1"
    k = SYMBOLS.index("K")
    assert found.before.status[k, 0] == found.before.status[k, 1] == Status.ESTIMATED
    assert found.variance_share_of_temperature("K", "gx") > 0.9
    assert found.coefficient_decreased_significantly("K", "gx")
    assert found.coefficients.value[k, 1] == pytest.approx(3e-6, rel=0.4)
    assert not found.coefficient_decreased_significantly("K", "gy")
    assert found.coefficients.value[1, 0] == pytest.approx(N, rel=0.03)  # N is as it was
    assert "gy" not in found.dependences
    assert found.axes_explained_by_temperature == ("gx",)
    (note,) = notes_on_temperature_dependence(found)
    assert note.startswith("gx follows its temperature: a cubic explains ")
    assert "without temperature (polynomial 1), K falls from " in note


@pytest.mark.long
def test_temperature_that_explains_nothing_takes_nothing(warm):
    result, warmth = warm
    still = result.values.copy()
    still[:, 0] = np.random.default_rng(4).standard_normal(len(still))
    still[:, 1] = np.nan
    assert remove_temperature_effect(replace(result, values=still), warmth) is None


def test_temperature_that_stayed_is_no_question():
    assert not temperature_varied(np.full(100, np.nan))
    assert not temperature_varied(25.0 + 0.04 * np.sin(np.arange(100.0)))
    assert temperature_varied(np.array([np.nan, 25.0, 26.0]))


def test_the_course_has_neither_steps_nor_corners():
    means = np.sin(2.0 * np.pi * (np.arange(20) + 0.5) / 20.0)
    course = interpolate_with_zero_mean(means, 50, 1020)
    want = np.sin(2.0 * np.pi * (np.arange(1000) + 0.5) / 1000.0)
    np.testing.assert_allclose(course[:1000] - course[:1000].mean(), want, atol=0.03)
    assert np.abs(np.diff(course, 2)).max() < 3.0 * np.abs(np.diff(want, 2)).max()
    assert np.ptp(np.diff(course[996:])) < 1e-12  # straight beyond the last middle


@pytest.mark.parametrize(("count", "length", "n"), [(2, 5, 10), (3, 4, 13), (72, 101, 7272), (500, 7, 3503)])
def test_the_course_is_a_natural_spline(count: int, length: int, n: int) -> None:
    course = np.random.default_rng(count).standard_normal(count)
    middle = (np.arange(count) + 0.5) * length - 0.5
    spline = CubicSpline(middle, course, bc_type="natural")
    at = np.arange(n, dtype=np.float64)
    inside = np.clip(at, middle[0], middle[-1])
    expected = spline(inside) + np.where(at < middle[0], spline(middle[0], 1), spline(middle[-1], 1)) * (at - inside)
    assert interpolate_with_zero_mean(course, length, n) == pytest.approx(expected - expected.mean(), abs=1e-12)
