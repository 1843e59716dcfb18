"""When a configured rate stands, when the measured one takes its place, and when neither can be believed."""

import pytest

from drivers.timing.rate_check import RateCheck


@pytest.mark.parametrize(
    ("measured_hz", "uncertainty", "used_hz", "contradicted"),
    [
        (100.0, 0.0, 100.0, False),
        (100.3, 0.0, 100.0, False),  # a quarter of a percent of N at most
        (99.0, 0.0, 99.0, False),  # an oscillator may be off by this
        (99.0, 0.02, 100.0, False),  # not known well enough to say so
        (97.0, 0.01, 97.0, True),
        (97.0, 0.05, 100.0, False),
        (50.02, 0.001, 50.0, True),  # made with 50 Hz
        (200.0, 0.0, 200.0, True),
    ],
)
def test_which_rate_is_used(measured_hz: float, uncertainty: float, used_hz: float, contradicted: bool) -> None:
    check = RateCheck(100.0)
    assert (check.rate_hz, check.contradicted, check.measured_hz) == (100.0, False, None)
    check.compare_with_measured_rate(measured_hz, uncertainty)
    assert (check.rate_hz, check.contradicted, check.measured_hz) == (used_hz, contradicted, measured_hz)


def test_a_rate_that_drifts_about_the_limit_does_not_come_and_go() -> None:
    check = RateCheck(100.0)
    seen = []
    for measured_hz in (101.9, 102.1, 101.9, 102.1, 101.6, 101.4, 101.9):
        check.compare_with_measured_rate(measured_hz, 0.0)
        seen.append(check.contradicted)
    assert seen == [False, True, True, True, True, False, False]


def test_a_rate_in_use_does_not_follow_every_breath_of_the_measurement() -> None:
    check = RateCheck(100.0)
    used = []
    for measured_hz in (98.8, 98.81, 98.79, 98.6):
        check.compare_with_measured_rate(measured_hz, 0.0)
        used.append(check.rate_hz)
    assert used == [98.8, 98.8, 98.8, 98.6]
