"""What a person reads in the panels."""

from monitor.publishing.rerun.panels.panel_text import health_text, noise_text, overview_text
from tests.monitor.publishing import made


def test_a_healthy_device():
    text = health_text("bench-1", made.health(), "stim300 on serial")
    for part in ("RUNNING", "bench-1", "stim300 on serial", "99.98 Hz", "1 h 00 min", "360,000", "2.10 ms"):
        assert part in text
    assert "zenoh **ok**" in text


def test_a_lost_device_says_so_first():
    text = health_text("b", made.health(state="lost", rate_hz=None, latency_p50_s=None, text="port is gone"))
    assert text.startswith("## LOST")
    assert "port is gone" in text
    assert "rate not known yet" in text


def test_every_coefficient_stands_with_its_unit():
    text = noise_text(made.estimate())
    for unit in ("µrad", "°/√h", "°/h/√h", "°/h/h", "µm/s", "m/s/√h", "µg/√h", "µg/h"):
        assert unit in text
    assert "≤ 2.23" in text  # R: 3e-9 rad/s² in °/h/h
    assert "gx | gy | gz" in text


def test_a_gyroscope_alone_has_one_table():
    estimate = made.estimate()
    estimate.curve.avar[:, 3:] = float("nan")
    text = noise_text(estimate)
    assert "gz" in text
    assert "az" not in text


def test_a_device_that_has_just_started_has_no_numbers():
    estimate = made.estimate()
    estimate.curve.avar[:] = float("nan")
    assert noise_text(estimate) == "Too few samples yet."


def test_the_overview_has_a_line_a_device():
    text = overview_text({"a": made.health(), "b": made.health(state="waiting", rate_hz=None)})
    assert "| **a** | running | 99.98 Hz |" in text
    assert "| **b** | waiting | — |" in text


def test_a_limit_that_is_passed_stands_in_the_health_panel() -> None:
    assert "limits exceeded: **gz N, az B**" in health_text("b", made.health(crossed=("gz N", "az B")))
    assert "limit" not in health_text("b", made.health())
