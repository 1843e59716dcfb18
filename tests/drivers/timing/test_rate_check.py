"""Tests of the comparison of the configured rate with the measured rate."""

import pytest

from drivers.timing.rate_check import RateCheck


@pytest.mark.parametrize(
    ("measured_hz", "uncertainty", "used_hz", "contradicted"),
    [
        (100.0, 0.0, 100.0, False),
        (100.3, 0.0, 100.0, False),  # changes N by less than a quarter of a percent
        (99.0, 0.0, 99.0, False),  # within the tolerance of an oscillator
        (99.0, 0.02, 100.0, False),  # too uncertain to contradict the configured rate
        (97.0, 0.01, 97.0, True),
        (97.0, 0.05, 100.0, False),
        (50.02, 0.001, 50.0, True),  # snapped to the standard rate of 50 Hz
        (200.0, 0.0, 200.0, True),
    ],
)
def test_measured_rate_replaces_a_contradicted_rate(
    measured_hz: float, uncertainty: float, used_hz: float, contradicted: bool
) -> None:
    check = RateCheck(100.0)
    assert (check.rate_hz, check.contradicted, check.measured_hz) == (100.0, False, None)
    check.compare_with_measured_rate(measured_hz, uncertainty)
    assert (check.rate_hz, check.contradicted, check.measured_hz) == (used_hz, contradicted, measured_hz)


def test_contradiction_has_hysteresis() -> None:
    check = RateCheck(100.0)
    contradicted = []
    for measured_hz in (101.9, 102.1, 101.9, 102.1, 101.6, 101.4, 101.9):
        check.compare_with_measured_rate(measured_hz, 0.0)
        contradicted.append(check.contradicted)
    assert contradicted == [False, True, True, True, True, False, False]


def test_used_rate_ignores_small_changes_of_the_measured_rate() -> None:
    check = RateCheck(100.0)
    used_rates_hz = []
    for measured_hz in (98.8, 98.81, 98.79, 98.6):
        check.compare_with_measured_rate(measured_hz, 0.0)
        used_rates_hz.append(check.rate_hz)
    assert used_rates_hz == [98.8, 98.8, 98.8, 98.6]
