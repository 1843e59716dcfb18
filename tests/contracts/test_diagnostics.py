"""Tests that every diagnostic in ``DIAGNOSTICS`` has to pass.

A diagnostic finds no difference in data that are equal to the expectation. Its null distribution is valid for
simulated recordings. Its result depends only on its input. The data are one minute of white noise and random walk,
with a temperature and another axis. They are drawn without the simulator.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from monitor.reconcile.diagnostics.null_distribution import estimate_null_distributions, run_diagnostics
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS, WhitenessDeparture
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.preparation.cosine_bins import cosine_transform, inverse_cosine_transform
from tests.monitor.reconcile.axes import (
    RATE_HZ,
    WALK,
    WHITE,
    N,
    axes,
    correlated,
    make_temperature,
    time_s,
    walk,
    white,
    whiten,
)

NAMES = sorted(DIAGNOSTICS)
n = 6000
SIGMA = N * RATE_HZ**0.5
RUNS = 240
OTHER = correlated(n, np.random.default_rng(99_999), 1e-2, 1.0)


def whiten_by_white_noise(y: np.ndarray) -> WhitenedAxis:
    """Whiten a series by white noise of the same size."""
    return whiten(axes({"gx": OTHER, "gz": y}, (WHITE,), make_temperature(n))["gz"], (WHITE,))


@cache
def simulate_findings(first: int, runs: int) -> list[dict[str, WhitenessDeparture]]:
    """Return the findings on simulated recordings of one model."""
    found = []
    for seed in range(first, first + runs):
        rng = np.random.default_rng(seed)
        y = white(n, rng) + walk(n, rng)
        axis = axes({"gx": OTHER, "gz": y}, {"gx": (WHITE,), "gz": (WHITE, WALK)}, make_temperature(n))["gz"]
        found.append(dict(run_diagnostics(whiten(axis, (WHITE, WALK)))))
    return found


@cache
def estimate_all_null95(name: str) -> np.ndarray:
    """Return null95 of a diagnostic in nats, from six recordings with three axes at a time."""
    found = simulate_findings(0, 108)
    parts = [found[at : at + 18] for at in range(0, 108, 18)]
    each = [
        estimate_null_distributions({axis: part[k::3] for k, axis in enumerate(("gx", "gy", "gz"))}) for part in parts
    ]
    return np.array([null[axis][name].null95 for null in each for axis in null])


def median_null95(name: str) -> float:
    """Return the median of null95 over all estimates, in nats."""
    return float(np.median(estimate_all_null95(name)))


def draw_signs(size: int) -> np.ndarray:
    """Return ±SIGMA with random signs, shape [size]."""
    return SIGMA * np.random.default_rng(1).choice([-1.0, 1.0], size)


def make_impulse() -> np.ndarray:
    """Return an impulse, whose periodogram is flat, with a little noise in each bin of the cosine transform."""
    y = white(n, np.random.default_rng(0), 0.1 * N)
    y[1] = SIGMA * n**0.5
    return y


def make_impulses(apart: int) -> np.ndarray:
    """Return impulses that have the same power at each time and frequency."""
    y = np.zeros(n)
    y[apart // 2 :: apart] = draw_signs(y[apart // 2 :: apart].size) * apart**0.5
    return y


def make_noise_without_low_frequencies() -> np.ndarray:
    """Return white noise with reduced power at low frequencies, so that the level hardly changes."""
    coefficients = cosine_transform(white(n, np.random.default_rng(2)))
    coefficients[: n // 2] *= 0.2
    return inverse_cosine_transform(coefficients)


def make_noise_without_column(column: np.ndarray) -> np.ndarray:
    """Return white noise without the contributions of a column and of its square."""
    stacked = np.stack([np.ones(n), column, column**2], axis=1)
    y = white(n, np.random.default_rng(3))
    return y - stacked @ np.linalg.lstsq(stacked, y, rcond=None)[0]


DATA_EQUAL_TO_EXPECTATION: dict[str, Callable[[], np.ndarray]] = {
    "values": lambda: white(n, np.random.default_rng(4)),
    "psd": lambda: inverse_cosine_transform(draw_signs(n - 1)),
    "lines": make_impulse,
    "autocorrelation": lambda: inverse_cosine_transform(draw_signs(n - 1)),
    "level": make_noise_without_low_frequencies,
    "temperature": lambda: make_noise_without_column(make_temperature(n) - 25.0),
    "other_axes": lambda: make_noise_without_column(OTHER),
    "tails": lambda: np.random.default_rng(5).permutation(SIGMA * norm.ppf((np.arange(n) + 0.5) / n)),
    "variance": lambda: draw_signs(n),
    "spectrogram": lambda: make_impulses(128),
}
"""For each diagnostic, data that are equal to the expectation."""

ADD_DIFFERENCE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "values": lambda y: 5e-4 * np.rint(y / 5e-4),
    "psd": lambda y: y + correlated(n, np.random.default_rng(6), 5e-4, 0.02),
    "lines": lambda y: y + 4e-4 * np.sin(2.0 * np.pi * 17.3 * time_s(n)),
    "autocorrelation": lambda y: y + np.append(0.3 * y[1:], 0.0),
    "level": lambda y: y + 4e-4 * (time_s(n) > 23.0),
    "temperature": lambda y: y + 1e-4 * (make_temperature(n) - 25.0),
    "other_axes": lambda y: y + 0.02 * OTHER,
    "tails": lambda y: np.where(np.random.default_rng(7).random(n) < 2e-3, 8.0 * y, y),
    "variance": lambda y: np.where(time_s(n) < 40.0, y, 1.4 * y),
    "spectrogram": lambda y: y + 8e-4 * np.sin(2.0 * np.pi * 17.3 * time_s(n)) * (time_s(n) % 30.0 < 6.0),
}
"""For each diagnostic, a function that adds the difference that the diagnostic is meant to find."""


def test_every_diagnostic_is_tested():
    assert set(DATA_EQUAL_TO_EXPECTATION) == set(ADD_DIFFERENCE) == set(DIAGNOSTICS)


@pytest.mark.parametrize("name", NAMES)
def test_data_that_equal_the_expectation_have_no_gap(name):
    finding = DIAGNOSTICS[name](whiten_by_white_noise(DATA_EQUAL_TO_EXPECTATION[name]()))
    assert 0.0 <= finding.gain < 0.2 * median_null95(name)


@pytest.mark.parametrize("name", NAMES)
def test_added_difference_is_found(name):
    y = white(n, np.random.default_rng(8))
    finding, before = (
        DIAGNOSTICS[name](whiten_by_white_noise(ADD_DIFFERENCE[name](y))),
        DIAGNOSTICS[name](whiten_by_white_noise(y)),
    )
    assert finding.gain > 3.0 * median_null95(name)
    assert finding.gain > before.gain + 10.0


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_recordings_of_a_true_model_stay_below_the_null_distribution(name):
    gains = np.array([findings[name].gain for findings in simulate_findings(1000, RUNS)])
    assert np.all(np.isfinite(gains))
    assert np.all(gains >= 0.0)

    def count_above(factor: float) -> float:
        """Return the number of recordings above a multiple of null95, averaged over the null distributions."""
        return float(np.mean(gains > factor * estimate_all_null95(name)[:, None]) * RUNS)

    # 12 of 240 runs are expected; 28 or more occur once in 10 000 tests
    assert count_above(1.0) < 28
    if np.median(gains) > 0.0:  # if the gain of most runs is zero, 5 % is only an upper bound
        assert count_above(1.0) > 1.5  # 1 or fewer occur once in 10 000 tests
        assert count_above(0.5) >= 28
        assert count_above(2.0) <= 1.5


@pytest.mark.parametrize("name", NAMES)
def test_finding_depends_only_on_the_input_and_the_input_is_not_changed(name):
    rng = np.random.default_rng(9)
    y = ADD_DIFFERENCE[name](white(n, rng))
    copy = y.copy()
    first, second = whiten_by_white_noise(y), whiten_by_white_noise(copy)
    arrays = {field: getattr(first, field).copy() for field in ("coefficients", "weights", "series", "flat_series")}
    coefficients, samples = first.axis.coefficients.copy(), first.axis.repaired.copy()
    finding = DIAGNOSTICS[name](first)
    assert DIAGNOSTICS[name](first) == finding == DIAGNOSTICS[name](second)
    for field, before in arrays.items():
        np.testing.assert_array_equal(getattr(first, field), before)
    np.testing.assert_array_equal(first.axis.coefficients, coefficients)
    np.testing.assert_array_equal(first.axis.repaired, samples)
    np.testing.assert_array_equal(y, copy)


@pytest.mark.parametrize("name", NAMES)
def test_location_is_inside_the_recording(name):
    where = DIAGNOSTICS[name](whiten_by_white_noise(ADD_DIFFERENCE[name](white(n, np.random.default_rng(10))))).where
    limits = {
        "frequency": (-0.05, 0.5 * RATE_HZ + 0.05),
        "tau": (0.0, n / RATE_HZ),
        "time": (0.0, n / RATE_HZ),
        "temperature": (make_temperature(n).min() - 1e-9, make_temperature(n).max() + 1e-9),
    }
    for kind, place in where.resolved_location_dimensions().items():
        if kind in limits:
            assert limits[kind][0] <= place[0] <= place[1] <= limits[kind][1]
    if name == "other_axes":
        assert where.source == "gx"


def test_location_is_that_of_the_added_difference():
    def where(name):
        return DIAGNOSTICS[name](whiten_by_white_noise(ADD_DIFFERENCE[name](white(n, np.random.default_rng(11))))).where

    lo, hi = where("lines").frequency
    assert lo < 17.3 < hi
    assert hi - lo < 0.1
    lo, hi = where("psd").frequency
    assert 0.5 * (lo + hi) < 20.0
    assert where("level").time[0] == pytest.approx(23.0, abs=2.0)
    lo, hi = where("variance").time
    assert lo - 1.0 < 40.0 < hi + 1.0
    assert where("autocorrelation").tau == (0.01, 0.01)
    lo, hi = where("spectrogram").frequency
    assert lo < 17.3 < hi
