"""Tests of Student's t noise against SciPy."""

import numpy as np
import pytest
from scipy.stats import kstest, t

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.noise.effects import AngleRandomWalk, ConstantBias, HeavyTails, NoiseStep
from monitor.noise.model import NoiseModel

GZ = AXES.index("gz")


@pytest.mark.parametrize("nu", [2.5, 5.0, 30.0])
def test_samples_follow_students_distribution(nu: float) -> None:
    model = NoiseModel({"gz": (AngleRandomWalk(N=0.1), HeavyTails(nu=nu))})
    values = model.simulate(50_000, 100.0, 1)[:, GZ]
    assert kstest(values * np.sqrt(nu / (nu - 2.0)), t(nu).cdf).pvalue > 0.001


def test_share_limits_the_number_of_changed_samples() -> None:
    model = NoiseModel({"gz": (AngleRandomWalk(N=0.1), HeavyTails(nu=2.1, share=0.2))})
    changed = model.simulate(50_000, 100.0, 1)[:, GZ]
    original = NoiseModel({"gz": (AngleRandomWalk(N=0.1),)}).simulate(50_000, 100.0, 1)[:, GZ]
    assert np.mean(changed != original) == pytest.approx(0.2, abs=0.01)


def test_only_white_noise_has_heavy_tails_and_noise_steps_scale_it() -> None:
    silent = NoiseModel({"gz": (AngleRandomWalk(N=0.1), HeavyTails(nu=4.0), NoiseStep(time=0.0, ratio=0.0))})
    assert not silent.simulate(100, 100.0, 1).any()
    with pytest.raises(ConfigError, match="gz has no angle_random_walk to multiply"):
        NoiseModel({"gz": (ConstantBias(value=1.0), HeavyTails(nu=4.0))}).simulate(1, 100.0, 1)
