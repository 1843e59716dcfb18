"""Tests of the independent checks of ``reconcile``: present effects are confirmed, and absent effects are doubtful."""

import numpy as np
import pytest

from monitor.noise.effects import WanderingVariance
from tests.experiments.real_recordings.independent_checks import CheckedRecording, check_effect

RATE_HZ, DEVIATION_HZ = 100.0, 1.0
n = 100_000


def draw_recording(amplitude: float) -> CheckedRecording:
    """Draw white noise and a line whose frequency changes at random within one second."""
    rng = np.random.default_rng(3)
    steps_hz = np.repeat(DEVIATION_HZ * rng.standard_normal(n // 100), 100)
    line = amplitude * np.sin(2.0 * np.pi * np.cumsum(20.0 + steps_hz) / RATE_HZ)
    return CheckedRecording({"gx": line + rng.standard_normal(n)}, RATE_HZ, None)


@pytest.mark.parametrize("amplitude", [0.0, 0.5])
def test_wandering_line_is_confirmed_by_the_power_within_its_frequency_deviation(amplitude):
    parameters = {"frequency": 20.0, "frequency_deviation": DEVIATION_HZ}
    check = check_effect(draw_recording(amplitude), "gx", "wandering_line", parameters)
    assert check.confirmed == (amplitude > 0.0)


@pytest.mark.parametrize("deviation", [0.0, 0.4])
@pytest.mark.parametrize("correlation_time", [2.0, 100.0])
def test_wandering_variance_is_confirmed_by_the_correlation_of_adjacent_blocks(deviation, correlation_time):
    rng = np.random.default_rng(4)
    effect = WanderingVariance(deviation=deviation, correlation_time=correlation_time)
    gain = effect.start_gain(RATE_HZ, rng).compute_gain(0, n)
    recording = CheckedRecording({"gx": gain * rng.standard_normal(n)}, RATE_HZ, None)
    check = check_effect(recording, "gx", "wandering_variance", {"correlation_time": correlation_time})
    assert check.confirmed == (deviation > 0.0)
