"""Tests of the removal of temperature effects, which must leave other drift unchanged."""

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
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing.terminal.thermal_output import notes_on_temperature_dependence

RATE_HZ = 2.0
ANGLE_RANDOM_WALK = 1e-4
SECONDS = 6 * 3600.0


@pytest.fixture(scope="module")
def analysis():
    """Simulate gx with noise and temperature dependence, gy with noise and a random walk, and no other axes."""
    rng = np.random.default_rng(3)
    n = round(SECONDS * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    temperature_c = 25.0 + 2.0 * np.sin(2.0 * np.pi * t / 7200.0) + 1.5 * np.sin(2.0 * np.pi * t / 3100.0)
    values = np.full((n, 6), np.nan)
    values[:, :2] = ANGLE_RANDOM_WALK * RATE_HZ**0.5 * rng.standard_normal((n, 2))
    values[:, 0] += 3e-5 * (temperature_c - 25.0)
    values[:, 1] += 3e-6 / RATE_HZ**0.5 * rng.standard_normal(n).cumsum()
    samples = make_block(np.rint(1e9 * t).astype(np.int64), values, temperature_c)
    return analyze([samples], RATE_HZ)


@pytest.mark.long
def test_temperature_effect_is_removed_and_other_drift_stays(analysis):
    found = remove_temperature_effect(analysis)
    assert found.models["gx"] == "polynomial 1"
    k = SYMBOLS.index("K")
    assert found.before.status[k, 0] == found.before.status[k, 1] == Status.ESTIMATED
    assert found.variance_share_of_temperature("K", "gx") > 0.9
    assert found.coefficient_decreased_significantly("K", "gx")
    assert found.coefficients.value[k, 1] == pytest.approx(3e-6, rel=0.4)
    assert not found.coefficient_decreased_significantly("K", "gy")
    assert found.coefficients.value[1, 0] == pytest.approx(ANGLE_RANDOM_WALK, rel=0.03)  # N is unchanged
    assert "gy" not in found.dependences
    assert found.axes_explained_by_temperature == ("gx",)
    (note,) = notes_on_temperature_dependence(found)
    assert note.startswith("gx follows its temperature: polynomial 1 explains ")
    assert "without temperature (polynomial 1), K falls from " in note


@pytest.mark.long
def test_unrelated_temperature_removes_nothing(analysis):
    values = analysis.values.copy()
    values[:, 0] = np.random.default_rng(4).standard_normal(len(values))
    values[:, 1] = np.nan
    assert remove_temperature_effect(replace(analysis, values=values)) is None


def test_constant_temperature_is_recognized():
    assert not temperature_varied(np.full(100, np.nan))
    assert not temperature_varied(25.0 + 0.04 * np.sin(np.arange(100.0)))
    assert temperature_varied(np.array([np.nan, 25.0, 26.0]))


def test_interpolated_drift_is_smooth():
    means = np.sin(2.0 * np.pi * (np.arange(20) + 0.5) / 20.0)
    drift = interpolate_with_zero_mean(means, 50, 1020)
    want = np.sin(2.0 * np.pi * (np.arange(1000) + 0.5) / 1000.0)
    np.testing.assert_allclose(drift[:1000] - drift[:1000].mean(), want, atol=0.03)
    assert np.abs(np.diff(drift, 2)).max() < 3.0 * np.abs(np.diff(want, 2)).max()
    assert np.ptp(np.diff(drift[996:])) < 1e-12  # linear beyond the middle of the last interval


@pytest.mark.parametrize(("count", "length", "n"), [(2, 5, 10), (3, 4, 13), (72, 101, 7272), (500, 7, 3503)])
def test_interpolated_drift_is_a_natural_spline(count: int, length: int, n: int) -> None:
    drift = np.random.default_rng(count).standard_normal(count)
    middle = (np.arange(count) + 0.5) * length - 0.5
    spline = CubicSpline(middle, drift, bc_type="natural")
    at = np.arange(n, dtype=np.float64)
    inside = np.clip(at, middle[0], middle[-1])
    expected = spline(inside) + np.where(at < middle[0], spline(middle[0], 1), spline(middle[-1], 1)) * (at - inside)
    assert interpolate_with_zero_mean(drift, length, n) == pytest.approx(expected - expected.mean(), abs=1e-12)
