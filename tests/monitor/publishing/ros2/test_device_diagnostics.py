"""Tests of the diagnostic status of a device."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import Event
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.publishing.ros2.device_diagnostics import build_device_status
from monitor.publishing.ros2.diagnostic_array import Level
from tests.monitor.publishing.example_results import make_estimate, make_health

RUNNING = replace(make_health(), state="running", text="", crossed=())
EVENT = Event("moved", 0, "moved by 3 °/s")


@pytest.mark.parametrize(
    ("changes", "level", "message"),
    [
        ({}, Level.OK, "running"),
        ({"text": "late frames"}, Level.WARN, "late frames"),
        ({"crossed": ("gz N", "ax B")}, Level.WARN, "crossed limits: gz N, ax B"),
        ({"state": "lost", "text": "unplugged"}, Level.ERROR, "unplugged"),
        ({"state": "waiting", "text": "waiting for a"}, Level.STALE, "waiting for a"),
        ({"state": "ended"}, Level.STALE, "ended"),
    ],
)
def test_level_and_message(changes: dict[str, object], level: Level, message: str) -> None:
    found = build_device_status("bench-1", replace(RUNNING, **changes), None, None, 0.0)
    assert (found.level, found.message) == (level, message)
    assert (found.name, found.hardware_id) == ("imu_monitor: bench-1", "bench-1")


def test_values_of_the_samples_and_of_the_last_event() -> None:
    health = replace(RUNNING, rate_hz=99.98, received=1000, lost=3, bad=2, moving=True)
    found = dict(build_device_status("a", health, None, EVENT, 90.0).values)
    assert found == {
        "state": "running", "rate (Hz)": "99.9800", "received (samples)": "1000", "lost (samples)": "3",
        "bad (samples)": "2", "moving": "True", "last event": "moved: moved by 3 °/s",
        "last event time (UTC)": "1970-01-01 00:01:30",
    }  # fmt: skip
    assert "rate (Hz)" not in dict(build_device_status("a", replace(RUNNING, rate_hz=None), None, None, 0.0).values)


def test_coefficients_are_in_si_units() -> None:
    estimate = make_estimate()
    found = dict(build_device_status("a", RUNNING, estimate.coefficients, None, 0.0).values)
    for key, symbol, column in (
        ("N gx (rad/s/√Hz)", "N", 0),
        ("B gy (rad/s)", "B", 1),
        ("K ax (m/s³/√Hz)", "K", 3),
    ):
        np.testing.assert_allclose(float(found[key]), estimate.coefficients.value[SYMBOLS.index(symbol), column], 5e-3)


def test_bounds_are_marked_and_unknown_coefficients_are_left_out() -> None:
    early = make_estimate(seconds=200.0)
    found = dict(build_device_status("a", RUNNING, early.coefficients, None, 0.0).values)
    assert found["B gx (rad/s)"].startswith("≤ ")
    unknown = early.without_coefficients().coefficients
    assert not any("(rad" in key for key, _ in build_device_status("a", RUNNING, unknown, None, 0.0).values)
