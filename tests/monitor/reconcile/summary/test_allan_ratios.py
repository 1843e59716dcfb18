"""Tests that each stated ratio of Allan deviations is a ratio of the plotted curves, and that of the two models."""

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    ExponentiallyCorrelated,
    Outliers,
    RateRandomWalk,
    Sinusoidal,
    TemperatureBias,
)
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.reconcile import reconcile
from monitor.reconcile.summary.ranked_findings import rank_findings

RATE_HZ, n = 100.0, 1 << 17
N, B, K = AngleRandomWalk(N=1e-4), BiasInstability(B=1e-5), RateRandomWalk(K=2e-6)
SLOW = ExponentiallyCorrelated(sigma=2e-4, correlation_time=5.0)
TEMPERATURE = TemperatureBias(coefficient=1e-4, reference=25.0)
SCENARIOS = {  # recorded effects of gx and gy, and the model under test; None is fitted to the recording
    "fitted slow terms are replaced": ({"gx": (N, B, SLOW), "gy": (N, K, SLOW)}, None),
    "fitted random walk is temperature": ({"gx": (N, B, TEMPERATURE), "gy": (N, K)}, None),
    "given random walk is absent": ({"gx": (N, B, SLOW), "gy": (N, B, SLOW)}, {"gx": (N, B), "gy": (N, B, K, SLOW)}),
    "two findings on an axis": (
        {"gx": (AngleRandomWalk(N=1.3e-4), Sinusoidal(amplitude=1e-4, frequency=17.3)), "gy": (N,)},
        {"gx": (N,), "gy": (N,)},
    ),
    "replaced samples": ({"gx": (N, Outliers(fraction=3e-3, scale=2e-2)), "gy": (N,)}, {"gx": (N,), "gy": (N,)}),
}


def allan_curves(result):
    return (next(one for one in end.plots if one.diagnostic == "allan") for end in (result.start, result.end))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_stated_ratio_is_the_ratio_of_the_plotted_curves(scenario):
    recorded, tested = SCENARIOS[scenario]
    t = np.arange(n) / RATE_HZ
    temperature_c = 25.0 + 3.0 * np.sin(2.0 * np.pi * t / 700.0) + t / 600.0
    values = NoiseModel(recorded).simulate(n, RATE_HZ, 1, temperature_c)
    axes = {axis: np.ascontiguousarray(values[:, AXES.index(axis)]) for axis in recorded}
    with_temperature = temperature_c if "temperature" in scenario else None
    result = reconcile(RecordedAxes(axes, RATE_HZ, with_temperature), tested and NoiseModel(tested, RATE_HZ), 1)
    stated = [(axis, one) for finding in rank_findings(result).findings for axis, one in finding.influences.items()]
    assert stated
    for axis, one in stated:
        before, after = allan_curves(result.axes[axis])
        at = int(np.argmin(np.abs(before.x - one.tau_s)))
        replaced = max(before.measured[at] ** 2 - after.measured[at] ** 2, 0.0)
        plotted = np.sqrt(after.expected[at] ** 2 + replaced) / before.expected[at]
        assert one.ratio == pytest.approx(plotted, rel=1e-6)
        if with_temperature is None:  # the Allan variance of a temperature effect has no closed form
            first, last = (
                model.avar(axis, np.array([one.tau_s]), 1.0 / RATE_HZ)[0] for model in (result.baseline, result.model)
            )
            assert one.ratio == pytest.approx(np.sqrt(last / first), rel=0.05)
