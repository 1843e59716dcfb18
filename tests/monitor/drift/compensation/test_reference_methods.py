"""Tests of the published denoising methods that serve as references."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from drivers.errors import NotReady
from monitor.drift.compensation import reference_methods
from monitor.drift.compensation.reference_methods import PIECE, REFERENCE_METHODS, apply_reference_method

SAMPLE_COUNT = 40_000


def add_noise(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    z = 5.0 + truth + np.random.default_rng(0).standard_normal(SAMPLE_COUNT)
    return z, z[: SAMPLE_COUNT // 2]


@pytest.mark.long
@pytest.mark.parametrize("name", REFERENCE_METHODS)
def test_noise_at_rest_is_reduced_and_missing_values_stay_missing(name):
    z, learned = add_noise(np.zeros(SAMPLE_COUNT))
    z[[3, 30_000]] = np.nan
    out = apply_reference_method(z, learned, REFERENCE_METHODS[name])
    assert np.isnan(out).sum() == 2
    known = out[np.isfinite(out)]
    assert abs(known.mean()) < 0.05
    assert known.std() < 0.75


@pytest.mark.long
def test_autoregression_halves_motion_and_emd_preserves_it():
    t = np.arange(SAMPLE_COUNT) / 100.0
    truth = np.where(t > 200.0, 30.0 * np.sin(np.pi * t), 0.0)
    z, learned = add_noise(truth)
    error_std = {
        name: np.std((apply_reference_method(z, learned, REFERENCE_METHODS[name]) - truth)[SAMPLE_COUNT // 2 :])
        for name in ("ar", "emd")
    }
    assert error_std["ar"] > 5.0
    assert error_std["emd"] < 1.0


@pytest.mark.long
def test_pieces_are_joined_without_steps():
    z, learned = add_noise(np.linspace(0.0, 200.0, SAMPLE_COUNT))
    out = apply_reference_method(z, learned, REFERENCE_METHODS["emd"])
    assert SAMPLE_COUNT > 2 * PIECE
    slope = np.polyfit(np.arange(SAMPLE_COUNT), out, 1)
    assert np.abs(out - np.polyval(slope, np.arange(SAMPLE_COUNT))).max() < 5.0


def test_too_little_training_data_is_refused():
    with pytest.raises(NotReady, match="100 are needed"):
        apply_reference_method(np.zeros(1000), np.zeros(50), REFERENCE_METHODS["ar"])


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("new", [1e-8, 1e-2, 1.0, 1e4])
def test_steady_covariance_solves_the_riccati_equation(order, new):
    rng = np.random.default_rng(order)
    step = np.eye(order, k=-1)
    step[0] = -np.poly(rng.uniform(-0.95, 0.95, order))[1:]
    p = reference_methods._steady_covariance(step, new)
    gain = p[:, 0] / (1.0 + p[0, 0])
    noise = np.zeros((order, order))
    noise[0, 0] = new
    again = step @ (p - np.outer(gain, p[0])) @ step.T + noise
    assert p == pytest.approx(again, rel=1e-12, abs=1e-12 * np.abs(p).max())
    # The residual of SciPy's solver grows to 1e-5 for high orders and little noise.
    expected = solve_discrete_are(step.T, np.eye(order)[:, :1], noise, np.eye(1))
    assert p == pytest.approx(expected, rel=1e-2, abs=1e-2 * np.abs(p).max())
