"""What others do: noise falls, holes stay holes, and what each does to motion."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from drivers.errors import NotReady
from monitor.drift.compensation import reference_methods
from monitor.drift.compensation.reference_methods import PIECE, REFERENCE_METHODS, apply_reference_method

N = 40_000


def noisy(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    z = 5.0 + truth + np.random.default_rng(0).standard_normal(N)
    return z, z[: N // 2]


@pytest.mark.long
@pytest.mark.parametrize("name", REFERENCE_METHODS)
def test_noise_at_rest_falls_and_holes_stay(name):
    z, learned = noisy(np.zeros(N))
    z[[3, 30_000]] = np.nan
    out = apply_reference_method(z, learned, REFERENCE_METHODS[name])
    assert np.isnan(out).sum() == 2
    left = out[np.isfinite(out)]
    assert abs(left.mean()) < 0.05
    assert left.std() < 0.75


@pytest.mark.long
def test_motion_is_halved_by_an_autoregression_and_kept_by_modes():
    t = np.arange(N) / 100.0
    truth = np.where(t > 200.0, 30.0 * np.sin(np.pi * t), 0.0)
    z, learned = noisy(truth)
    off = {
        name: np.std((apply_reference_method(z, learned, REFERENCE_METHODS[name]) - truth)[N // 2 :])
        for name in ("ar", "emd")
    }
    assert off["ar"] > 5.0
    assert off["emd"] < 1.0


@pytest.mark.long
def test_pieces_fade_into_each_other():
    z, learned = noisy(np.linspace(0.0, 200.0, N))
    out = apply_reference_method(z, learned, REFERENCE_METHODS["emd"])
    assert N > 2 * PIECE
    slope = np.polyfit(np.arange(N), out, 1)
    assert np.abs(out - np.polyval(slope, np.arange(N))).max() < 5.0


def test_too_little_rest_is_refused():
    with pytest.raises(NotReady, match="100 are needed"):
        apply_reference_method(np.zeros(1000), np.zeros(50), REFERENCE_METHODS["ar"])


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("new", [1e-8, 1e-2, 1.0, 1e4])
def test_the_steady_covariance_solves_the_riccati_equation(order, new):
    rng = np.random.default_rng(order)
    step = np.eye(order, k=-1)
    step[0] = -np.poly(rng.uniform(-0.95, 0.95, order))[1:]
    p = reference_methods._steady_covariance(step, new)
    gain = p[:, 0] / (1.0 + p[0, 0])
    noise = np.zeros((order, order))
    noise[0, 0] = new
    again = step @ (p - np.outer(gain, p[0])) @ step.T + noise
    assert p == pytest.approx(again, rel=1e-12, abs=1e-12 * np.abs(p).max())
    # SciPy's own residual grows to 1e-5 for high orders and little noise
    expected = solve_discrete_are(step.T, np.eye(order)[:, :1], noise, np.eye(1))
    assert p == pytest.approx(expected, rel=1e-2, abs=1e-2 * np.abs(p).max())
