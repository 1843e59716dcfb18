import numpy as np
import pytest

from monitor.noise.effects import AngleRandomWalk, CommonVibration
from monitor.noise.model import NoiseModel


def make_vibration(number: float, gain: float, bandwidth: float = 1.0) -> CommonVibration:
    return CommonVibration(source_number=number, gain=gain, bandwidth=bandwidth, frequency=12.0)


def test_axes_share_one_series_with_their_own_gains():
    model = NoiseModel({"gx": (make_vibration(1, 2.0),), "ay": (AngleRandomWalk(N=0.0), make_vibration(1, -0.5))})
    drawn = model.simulate(3000, 100.0, 4)
    np.testing.assert_allclose(drawn[:, 4], -0.25 * drawn[:, 0], rtol=1e-12)
    assert np.std(drawn[:, 0]) > 0.5


def test_different_sources_are_independent():
    drawn = NoiseModel({"gx": (make_vibration(1, 2.0),), "gy": (make_vibration(2, 2.0),)}).simulate(100_000, 100.0, 4)
    assert np.corrcoef(drawn[:, :2].T)[0, 1] == pytest.approx(0.0, abs=0.1)


def test_different_bandwidth_keeps_the_coherence():
    drawn = NoiseModel({"gx": (make_vibration(1, 2.0),), "gy": (make_vibration(1, 2.0, 1.5),)}).simulate(
        100_000, 100.0, 4
    )
    assert np.corrcoef(drawn[:, :2].T)[0, 1] > 0.9
