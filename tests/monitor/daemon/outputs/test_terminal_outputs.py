"""Tests of the log lines about events and the status."""

from datetime import datetime
from typing import Any

from structlog.testing import capture_logs

from drivers.data_types import Event
from monitor.common.device_health import Health
from monitor.daemon.outputs.terminal_outputs import EventAndStatusLogOutput
from tests.monitor.publishing.example_results import make_health

START_S = 1_763_699_880.0


def write_log(messages: list[tuple[float, Health | Event]]) -> list[dict[str, Any]]:
    """Return the log lines for messages at the given times [s] after START_S, from the device ``a``."""
    now_s = START_S
    output = EventAndStatusLogOutput(lambda: now_s)
    with capture_logs() as logs:
        for seconds, message in messages:
            now_s = START_S + seconds
            if isinstance(message, Event):
                output.publish_event("a", now_s, 0, message)
            else:
                output.publish_health("a", now_s, message)
    return [dict(line) for line in logs]


def text_of_wrong_lines(second: int) -> Health:
    text = f"board: {100 * second} bytes without a sample; a line has 5 columns, expected 7: b'0.{second},it\\'s,1'"
    return make_health(state="waiting", text=text, bad=10 * second)


def test_repeated_warnings_are_written_at_growing_intervals_with_their_count() -> None:
    lines = write_log([(second, text_of_wrong_lines(second)) for second in range(120)])
    seconds = [int(line["text"].split()[1]) // 100 for line in lines]
    assert seconds == [0, 10, 30, 70]
    since = [f"{datetime.fromtimestamp(START_S + second).astimezone():%H:%M:%S}" for second in seconds]
    for i, rejected in enumerate([100, 200, 400]):
        assert lines[i + 1]["text"].endswith(f" (repeated, {rejected} lines or frames rejected since {since[i]})")


def test_another_kind_of_warning_is_written_at_once() -> None:
    other = make_health(state="waiting", text="board: silent for 3.1 s")
    lines = write_log(
        [(1, text_of_wrong_lines(1)), (2, text_of_wrong_lines(2)), (3, other), (4, text_of_wrong_lines(4))]
    )
    assert [line["text"] for line in lines] == [text_of_wrong_lines(1).text, other.text]


def test_warning_after_a_recovery_is_written_at_once() -> None:
    running = make_health()
    lines = write_log([(1, text_of_wrong_lines(1)), (2, running), (3, text_of_wrong_lines(3)), (4, running)])
    assert [line["text"] for line in lines] == [text_of_wrong_lines(1).text, "", text_of_wrong_lines(3).text, ""]


def test_repeated_events_become_one_line_with_their_number() -> None:
    messages: list[tuple[float, Health | Event]] = []
    for second in range(12):
        messages += [(second, Event("samples_lost", 0, f"{second + 1} samples missing")), (second, make_health())]
    lines = [line for line in write_log(messages) if line["event"] == "samples_lost"]
    since = f"{datetime.fromtimestamp(START_S).astimezone():%H:%M:%S}"
    assert [line["text"] for line in lines] == [
        "1 samples missing",
        f"11 samples missing (10 events of this kind since {since})",
    ]


def test_other_kinds_of_events_and_axes_are_written_at_once() -> None:
    events = [
        Event("moved", 0, "moved"),
        Event("noise_changed", 0, "N rose", "gx"),
        Event("noise_changed", 0, "N rose", "gy"),
    ]
    assert len(write_log([(0, event) for event in events])) == 3
