"""Contract of the diagnostics, which are found by listing ``DIAGNOSTICS``.

A diagnostic finds no difference in data that are equal to the expectation. Its null distribution holds for simulated
recordings. It depends on nothing but its input. The data are one minute of white noise and random walk, drawn by SciPy,
with a temperature and another axis.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from monitor.reconcile.diagnostics.null_distribution import estimate_null_distributions, run_diagnostics
from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS, Finding
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.preparation.cosine_bins import cosine_transform, inverse_cosine_transform
from tests.monitor.reconcile.axes import RATE_HZ, WALK, WHITE, N, axes, correlated, seen, time_s, walk, warmth, white

NAMES = sorted(DIAGNOSTICS)
n = 6000
SIGMA = N * RATE_HZ**0.5
RUNS = 240
OTHER = correlated(n, np.random.default_rng(99_999), 1e-2, 1.0)


def whitened_by_white_noise(y: np.ndarray) -> WhitenedAxis:
    """Whiten a series by white noise of the same size."""
    return seen(axes({"gx": OTHER, "gz": y}, (WHITE,), warmth(n))["gz"], (WHITE,))


@cache
def findings(first: int, runs: int) -> list[dict[str, Finding]]:
    """Return the findings on simulated recordings of one model."""
    found = []
    for seed in range(first, first + runs):
        rng = np.random.default_rng(seed)
        y = white(n, rng) + walk(n, rng)
        one = axes({"gx": OTHER, "gz": y}, {"gx": (WHITE,), "gz": (WHITE, WALK)}, warmth(n))["gz"]
        found.append(dict(run_diagnostics(seen(one, (WHITE, WALK)))))
    return found


@cache
def all_nulls(name: str) -> np.ndarray:
    """Return null95 of a diagnostic in nats, from six recordings with three axes at a time."""
    found = findings(0, 108)
    parts = [found[at : at + 18] for at in range(0, 108, 18)]
    each = [
        estimate_null_distributions({axis: part[k::3] for k, axis in enumerate(("gx", "gy", "gz"))}) for part in parts
    ]
    return np.array([null[axis][name].null95 for null in each for axis in null])


def null95(name: str) -> float:
    return float(np.median(all_nulls(name)))


def signs(size: int) -> np.ndarray:
    return SIGMA * np.random.default_rng(1).choice([-1.0, 1.0], size)


def impulse() -> np.ndarray:
    """Return an impulse, whose periodogram is flat, with a little noise in each bin of the cosine transform."""
    y = white(n, np.random.default_rng(0), 0.1 * N)
    y[1] = SIGMA * n**0.5
    return y


def impulses(apart: int) -> np.ndarray:
    """Return impulses that have the same power at each time and frequency."""
    y = np.zeros(n)
    y[apart // 2 :: apart] = signs(y[apart // 2 :: apart].size) * apart**0.5
    return y


def flat() -> np.ndarray:
    """Return white noise with reduced power at low frequencies, so that the level hardly changes."""
    coefficients = cosine_transform(white(n, np.random.default_rng(2)))
    coefficients[: n // 2] *= 0.2
    return inverse_cosine_transform(coefficients)


def without(column: np.ndarray) -> np.ndarray:
    """Return white noise without the contributions of a column and of its square."""
    stacked = np.stack([np.ones(n), column, column**2], axis=1)
    y = white(n, np.random.default_rng(3))
    return y - stacked @ np.linalg.lstsq(stacked, y, rcond=None)[0]


EQUAL: dict[str, Callable[[], np.ndarray]] = {
    "values": lambda: white(n, np.random.default_rng(4)),
    "psd": lambda: inverse_cosine_transform(signs(n - 1)),
    "lines": impulse,
    "autocorrelation": lambda: inverse_cosine_transform(signs(n - 1)),
    "level": flat,
    "temperature": lambda: without(warmth(n) - 25.0),
    "other_axes": lambda: without(OTHER),
    "tails": lambda: np.random.default_rng(5).permutation(SIGMA * norm.ppf((np.arange(n) + 0.5) / n)),
    "variance": lambda: signs(n),
    "spectrogram": lambda: impulses(128),
}
"""For each diagnostic, data that are equal to the expectation."""

HIDDEN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "values": lambda y: 5e-4 * np.rint(y / 5e-4),
    "psd": lambda y: y + correlated(n, np.random.default_rng(6), 5e-4, 0.02),
    "lines": lambda y: y + 4e-4 * np.sin(2.0 * np.pi * 17.3 * time_s(n)),
    "autocorrelation": lambda y: y + np.append(0.3 * y[1:], 0.0),
    "level": lambda y: y + 4e-4 * (time_s(n) > 23.0),
    "temperature": lambda y: y + 1e-4 * (warmth(n) - 25.0),
    "other_axes": lambda y: y + 0.02 * OTHER,
    "tails": lambda y: np.where(np.random.default_rng(7).random(n) < 2e-3, 8.0 * y, y),
    "variance": lambda y: np.where(time_s(n) < 40.0, y, 1.4 * y),
    "spectrogram": lambda y: y + 8e-4 * np.sin(2.0 * np.pi * 17.3 * time_s(n)) * (time_s(n) % 30.0 < 6.0),
}
"""For each diagnostic, a function that adds the difference that the diagnostic is meant to find."""


def test_every_diagnostic_is_tested():
    assert set(EQUAL) == set(HIDDEN) == set(DIAGNOSTICS)


@pytest.mark.parametrize("name", NAMES)
def test_data_that_equal_the_expectation_have_no_gap(name):
    found = DIAGNOSTICS[name](whitened_by_white_noise(EQUAL[name]()))
    assert 0.0 <= found.gain < 0.2 * null95(name)


@pytest.mark.parametrize("name", NAMES)
def test_hidden_difference_is_found(name):
    y = white(n, np.random.default_rng(8))
    found, before = (
        DIAGNOSTICS[name](whitened_by_white_noise(HIDDEN[name](y))),
        DIAGNOSTICS[name](whitened_by_white_noise(y)),
    )
    assert found.gain > 3.0 * null95(name)
    assert found.gain > before.gain + 10.0


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_recordings_of_a_true_model_stay_below_the_null_distribution(name):
    gains = np.array([one[name].gain for one in findings(1000, RUNS)])
    assert np.all(np.isfinite(gains))
    assert np.all(gains >= 0.0)

    def beyond(factor: float) -> float:
        """Return the number of recordings above a multiple of null95, averaged over the null distributions."""
        return float(np.mean(gains > factor * all_nulls(name)[:, None]) * RUNS)

    # of 240 runs 12 are expected: 28 or more once in 10 000
    assert beyond(1.0) < 28
    if np.median(gains) > 0.0:  # where most runs show nothing at all, 95 of 100 is no more than a bound
        assert beyond(1.0) > 1.5  # 1 or less once in 10 000
        assert beyond(0.5) >= 28
        assert beyond(2.0) <= 1.5


@pytest.mark.parametrize("name", NAMES)
def test_finding_depends_only_on_the_input_and_the_input_is_not_changed(name):
    rng = np.random.default_rng(9)
    y = HIDDEN[name](white(n, rng))
    kept = y.copy()
    one, other = whitened_by_white_noise(y), whitened_by_white_noise(kept)
    arrays = {field: getattr(one, field).copy() for field in ("coefficients", "weights", "series", "flat_series")}
    coefficients, samples = one.axis.coefficients.copy(), one.axis.repaired.copy()
    found = DIAGNOSTICS[name](one)
    assert DIAGNOSTICS[name](one) == found == DIAGNOSTICS[name](other)
    for field, before in arrays.items():
        np.testing.assert_array_equal(getattr(one, field), before)
    np.testing.assert_array_equal(one.axis.coefficients, coefficients)
    np.testing.assert_array_equal(one.axis.repaired, samples)
    np.testing.assert_array_equal(y, kept)


@pytest.mark.parametrize("name", NAMES)
def test_location_is_inside_the_recording(name):
    where = DIAGNOSTICS[name](whitened_by_white_noise(HIDDEN[name](white(n, np.random.default_rng(10))))).where
    limits = {
        "frequency": (-0.05, 0.5 * RATE_HZ + 0.05),
        "tau": (0.0, n / RATE_HZ),
        "time": (0.0, n / RATE_HZ),
        "temperature": (warmth(n).min() - 1e-9, warmth(n).max() + 1e-9),
    }
    for kind, place in where.resolved_location_dimensions().items():
        if kind in limits:
            assert limits[kind][0] <= place[0] <= place[1] <= limits[kind][1]
    if name == "other_axes":
        assert where.source == "gx"


def test_location_is_that_of_the_hidden_difference():
    def where(name):
        return DIAGNOSTICS[name](whitened_by_white_noise(HIDDEN[name](white(n, np.random.default_rng(11))))).where

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
