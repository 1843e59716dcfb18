"""Tests of the texts of the viewer panels."""

import pytest

from monitor.common.unit_formatting import KINDS, UNIT_SYSTEMS, format_number
from monitor.publishing.rerun.panels.panel_text import events_text, health_text, noise_text, overview_text
from tests.monitor.publishing import example_results


def test_health_text_of_a_running_device_has_all_numbers():
    text = health_text("bench-1", example_results.make_health(), "stim300 on serial")
    for part in ("RUNNING", "bench-1", "stim300 on serial", "99.98 Hz", "1 h 00 min", "360,000", "2.10 ms"):
        assert part in text
    assert "zenoh **ok**" in text


def test_health_text_of_a_lost_device_shows_its_state_above_the_reason():
    text = health_text(
        "b", example_results.make_health(state="lost", rate_hz=None, latency_p50_s=None, text="port is gone")
    )
    assert 0 < text.index("## LOST") < text.index("port is gone")
    assert "no samples" in text
    assert "latency" not in text


def test_health_text_of_an_ended_recording_names_the_end_and_no_rate():
    text = health_text("b", example_results.make_health(state="ended", rate_hz=None, latency_p50_s=None))
    assert "## ENDED: end of the recording" in text
    assert "no samples" in text


def test_each_coefficient_has_its_unit():
    text = noise_text(example_results.make_estimate())
    for unit in ("µrad", "°/√h", "°/h/√h", "°/h/h", "µm/s", "m/s/√h", "µg/√h", "µg/h"):
        assert unit in text
    assert "≤ 2.23" in text  # this is R, 3e-9 rad/s², in °/h/h
    assert "**gx** | **gy** | **gz**" in text


@pytest.mark.parametrize("name", UNIT_SYSTEMS)
def test_tables_have_the_chosen_units(name: str) -> None:
    estimate, units = example_results.make_estimate(), UNIT_SYSTEMS[name]
    lines = [line for line in noise_text(estimate, units).splitlines() if line.startswith("| **")]
    rows = [line.split(" | ") for line in lines if "**gx**" not in line and "**ax**" not in line]
    columns = [(kind, column) for kind in KINDS for column in units.columns(kind)]
    assert [row[0] for row in rows] == [f"| **{one.symbol}** {one.unit.name}" for _, one in columns]
    n = [
        (row[1], one.unit)
        for row, (kind, one) in zip(rows, columns, strict=True)
        if (kind, one.symbol) == ("gyro", "N")
    ]
    assert [text.split(" ")[0] for text, _ in n] == [
        f"**{format_number(unit.factor * estimate.coefficients.value[1, 0])}**" for _, unit in n
    ]
    assert len(n) == (2 if name == "datasheet" else 1)


def test_gyroscope_alone_has_one_table():
    estimate = example_results.make_estimate()
    estimate.curve.avar[:, 3:] = float("nan")
    text = noise_text(estimate)
    assert "gz" in text
    assert "az" not in text


def test_device_without_samples_has_no_numbers():
    estimate = example_results.make_estimate()
    estimate.curve.avar[:] = float("nan")
    assert noise_text(estimate) == "Too few samples yet."


def test_overview_has_one_line_per_device():
    text = overview_text(
        {"a": example_results.make_health(), "b": example_results.make_health(state="waiting", rate_hz=None)}
    )
    assert text.startswith("no problem\n")
    assert "| **a** | running | 99.98 Hz |" in text
    assert "| **b** | waiting | — |" in text
    assert "| **c** | **LOST** | — |" in overview_text({"c": example_results.make_health(state="lost", rate_hz=None)})


def test_exceeded_limit_is_in_the_health_panel() -> None:
    assert "limits exceeded: **gz N, az B**" in health_text("b", example_results.make_health(crossed=("gz N", "az B")))
    assert "limit" not in health_text("b", example_results.make_health())


def test_overview_lists_problems_above_the_table() -> None:
    text = overview_text({f"d{i}": example_results.make_health(text=f"port {i // 2} is gone") for i in range(12)})
    assert text.splitlines()[:2] == ["- **d0, d1**: port 0 is gone", "- **d2, d3**: port 1 is gone"]
    assert "… and 2 more problems" in text
    assert text.index("more problems") < text.index("| device |")


def test_interval_is_in_percent_of_the_value() -> None:
    estimate = example_results.make_estimate()
    c = estimate.coefficients
    c.lo[1, 0], c.hi[1, 0] = 0.996 * c.value[1, 0], 1.004 * c.value[1, 0]
    c.lo[1, 1], c.hi[1, 1] = 0.79 * c.value[1, 1], 1.24 * c.value[1, 1]
    (row,) = [line for line in noise_text(estimate).splitlines() if line.startswith("| **N** °/√h")]
    assert "** ±0.4 % | " in row
    assert "** −21 +24 % | " in row


def test_events_are_listed_with_the_newest_first() -> None:
    lines = [(1.76e9, "", "back"), (1.76e9 + 86_400.0, "ERROR", "gone")]
    assert events_text(lines) == "- **10-10 08:53:20 ERROR** gone\n- 10-09 08:53:20 back"
