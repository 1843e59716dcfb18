"""What others do: noise falls, holes stay holes, and what each does to motion."""

import numpy as np
import pytest

from drivers.errors import NotReady
from monitor.drift.variants import PIECE, VARIANTS, compensated

N = 40_000


def noisy(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    z = 5.0 + truth + np.random.default_rng(0).standard_normal(N)
    return z, z[: N // 2]


@pytest.mark.long
@pytest.mark.parametrize("name", VARIANTS)
def test_noise_at_rest_falls_and_holes_stay(name):
    z, learned = noisy(np.zeros(N))
    z[[3, 30_000]] = np.nan
    out = compensated(z, learned, VARIANTS[name])
    assert np.isnan(out).sum() == 2
    left = out[np.isfinite(out)]
    assert abs(left.mean()) < 0.05
    assert left.std() < 0.75


@pytest.mark.long
def test_motion_is_halved_by_an_autoregression_and_kept_by_modes():
    t = np.arange(N) / 100.0
    truth = np.where(t > 200.0, 30.0 * np.sin(np.pi * t), 0.0)
    z, learned = noisy(truth)
    off = {name: np.std((compensated(z, learned, VARIANTS[name]) - truth)[N // 2 :]) for name in ("ar", "emd")}
    assert off["ar"] > 5.0
    assert off["emd"] < 1.0


def test_pieces_fade_into_each_other():
    z, learned = noisy(np.linspace(0.0, 200.0, N))
    out = compensated(z, learned, VARIANTS["emd"])
    assert N > 2 * PIECE
    slope = np.polyfit(np.arange(N), out, 1)
    assert np.abs(out - np.polyval(slope, np.arange(N))).max() < 5.0


def test_too_little_rest_is_refused():
    with pytest.raises(NotReady, match="100 are needed"):
        compensated(np.zeros(1000), np.zeros(50), VARIANTS["ar"])
