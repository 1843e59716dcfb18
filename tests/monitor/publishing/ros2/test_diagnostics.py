"""Tests of the diagnostics for ROS 2."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import Event
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.publishing.ros2.diagnostics import DiagnosticStatus, Level, build_device_status, encode_diagnostic_array
from tests.monitor.publishing.example_results import make_estimate, make_health
from tests.support.ros2_messages import DIAGNOSTIC_ARRAY, decode, stamp_ns

TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
STATUS = st.builds(
    DiagnosticStatus, st.sampled_from(Level), TEXT, TEXT, TEXT, st.lists(st.tuples(TEXT, TEXT), max_size=4)
)


@given(st.integers(0, 2**31 * 1_000_000_000 - 1), st.lists(STATUS, max_size=4))
def test_every_field_is_decoded(t_ns: int, statuses: list[DiagnosticStatus]) -> None:
    message = decode(encode_diagnostic_array(t_ns, statuses), DIAGNOSTIC_ARRAY)
    assert stamp_ns(message) == t_ns
    assert message.header.frame_id == ""
    found = [
        DiagnosticStatus(
            Level(one.level), one.name, one.message, one.hardware_id, [(pair.key, pair.value) for pair in one.values]
        )
        for one in message.status
    ]
    assert found == statuses


def test_text_that_is_not_unicode_is_replaced() -> None:
    status = DiagnosticStatus(Level.OK, "a", "file \udcff", "", [])
    [found] = decode(encode_diagnostic_array(0, [status]), DIAGNOSTIC_ARRAY).status
    assert found.message == "file ?"


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
