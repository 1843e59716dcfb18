"""Tests of the history reply: documented layout, selection and decoding."""

import copy
import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.data_types import AXES
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.history.bucketed_history import HistoryTable, build_table
from monitor.history.history_row import STATES, HistoryRow, merge_rows
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.query_parameters import PARTS, HistoryQuery
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.messages.history import HistoryMessage, decode_history
from tests.monitor.publishing.example_results import make_estimate, make_health

T0 = 1_760_000_040.0
EVENT = StoredEvent(T0 + 30.0, "noise_changed", "gz rose", "gz", {"N": {"before": 1e-4, "after": 2e-4}}, T0, 9.1, 3)
ALL_PARTS = HistoryQuery(what=PARTS)


def make_history() -> HistoryTable:
    """Return three minutes: R is not estimated, then bounded, and then the device is lost."""
    minutes = MinuteAggregator()
    ages_s = [(0.0, 1000.0), (20.0, 1200.0), (60.0, 3600.0), (70.0, 3500.0)]
    rows = [
        minutes.add_estimate(T0 + at, make_estimate(seconds=seconds, seed=i)) for i, (at, seconds) in enumerate(ages_s)
    ]
    rows.append(minutes.add_health(T0 + 75.0, make_health(received=7000)))
    rows.append(minutes.add_temperature(T0 + 76.0, np.array([21.5])))
    rows.append(
        minutes.add_health(T0 + 130.0, make_health(state="lost", received=7000, rate_hz=None, latency_p99_s=None))
    )
    rows.append(minutes.flush())
    full: list[HistoryRow] = [row for row in rows if row is not None]
    return build_table("bench-1", TimeRange(T0, T0 + 180.0), 60, full, [EVENT], 1)


def test_layout_is_the_documented_one() -> None:
    reply = json.loads(HistoryMessage.build_reply(make_history(), ALL_PARTS, T0 + 130.0, 7000).encode())
    assert (reply["schema"], reply["device"], reply["t"], reply["samples"]) == (
        "imu-monitor/history/1", "bench-1", T0 + 130.0, 7000,
    )  # fmt: skip
    assert (reply["from"], reply["to"], reply["step"]) == (T0, T0 + 180.0, 60)
    assert reply["start"] == [int(T0), int(T0) + 60, int(T0) + 120]
    assert reply["width"] == [60, 60, 60]
    assert list(reply["axes"]) == list(AXES)
    n, r = reply["axes"]["gz"]["N"], reply["axes"]["gz"]["R"]
    assert n["status"] == ["estimated", "estimated", "unestimated"]
    assert n["n"] == [2, 2, 0]
    assert n["low"][0] < n["high"][0]
    assert n["lo"][0] < n["value"][0] < n["hi"][0]
    assert n["value"][2] is None
    assert r["status"] == ["unestimated", "upper_bound", "unestimated"]
    assert (r["value"][1], r["lo"][1], r["hi"][1]) == (None, 0.0, pytest.approx(3e-9))
    deviations = reply["deviations"]
    assert deviations["tau"][:3] == [0.01, 0.03, 0.1]
    assert len(deviations["axes"]["az"]["value"]) == 3
    assert len(deviations["axes"]["az"]["low"][0]) == len(deviations["tau"])
    status = reply["status"]
    assert status["state"] == ["ended", "running", "lost"]
    assert status["received"] == [0, 7000, 0]
    assert status["rate"]["value"] == [None, pytest.approx(99.98), None]
    assert status["temperature"]["high"] == [None, 21.5, None]
    (event,) = reply["events"]
    assert event == {
        "t": T0 + 30.0, "kind": "noise_changed", "axis": "gz", "what": {"N": {"before": 1e-4, "after": 2e-4}},
        "since": T0, "sigma": 9.1, "text": "gz rose", "stands_for": 3,
    }  # fmt: skip
    assert reply["events_in_all"] == 1


def test_only_requested_parts_are_in_the_reply() -> None:
    query = HistoryQuery(what=("coefficients",), axes=("gz",), symbols=("B", "N"))
    reply = json.loads(HistoryMessage.build_reply(make_history(), query, T0, 1).encode())
    assert set(reply) & {"deviations", "status", "events"} == set()
    assert {axis: list(letters) for axis, letters in reply["axes"].items()} == {"gz": ["B", "N"]}


def test_decoded_history_equals_the_original() -> None:
    history = make_history()
    found = decode_history(HistoryMessage.build_reply(history, ALL_PARTS, T0, 1).encode())
    assert (found.device, found.span, found.step_s) == (history.device, history.span, history.step_s)
    assert (found.events, found.events_in_all) == (history.events, history.events_in_all)
    np.testing.assert_array_equal(found.start_s, history.start_s)
    np.testing.assert_array_equal(found.width_s, history.width_s)
    np.testing.assert_array_equal(found.counts, history.counts)
    np.testing.assert_array_equal(found.state, history.state)
    names = [f"{axis}.{letter}" for axis in AXES for letter in SYMBOLS]
    for name in [*names, "rate", "memory", "temperature", *(f"gz.sigma.{tau}" for tau in history.list_tau_labels())]:
        for part in ("low", "high", "last"):
            np.testing.assert_array_equal(
                getattr(found.select_column(name), part), getattr(history.select_column(name), part), name
            )
    for name in names:
        np.testing.assert_array_equal(found.select_column(name).n, history.select_column(name).n)
        for end in (".lo", ".hi", ".bound"):
            np.testing.assert_array_equal(found.select_column(name + end).last, history.select_column(name + end).last)


def test_bucket_with_estimates_and_a_bound_shows_only_the_estimates() -> None:
    minutes, rows = MinuteAggregator(), []
    for i, seconds in enumerate((3600.0, 200.0)):  # B is estimated first and only bounded later
        rows.append(minutes.add_estimate(T0 + i, make_estimate(seconds=seconds)))
    row = merge_rows([r for r in (*rows, minutes.flush()) if r is not None], int(T0), 60)
    table = build_table("a", TimeRange(T0, T0 + 60.0), 60, [row], [], 0)
    letter = json.loads(HistoryMessage.build_reply(table, ALL_PARTS, T0, 1).encode())["axes"]["gz"]["B"]
    assert (letter["status"], letter["n"]) == (["estimated"], [1])
    assert letter["lo"][0] < letter["value"][0] < letter["hi"][0]


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_payload_is_decoded_or_a_value_error(data: st.DataObject) -> None:
    reply = json.loads(HistoryMessage.build_reply(make_history(), ALL_PARTS, T0, 1).encode())
    junk = st.sampled_from([None, [], {}, -1, 1e300, 10**30, "x", [None], [[1.0]], {"gz": 1}, [1.0, None, "x"]])
    for _ in range(data.draw(st.integers(1, 3))):
        at = reply
        while True:
            key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            if not isinstance(at[key], dict | list) or not at[key] or data.draw(st.booleans()):
                at[key] = copy.deepcopy(data.draw(junk))
                break
            at = at[key]
    try:
        found = decode_history(msgspec.json.encode(reply))
    except ValueError:
        return
    assert len(found) == len(found.width_s) == len(found.state)
    assert found.low.shape == (len(found), len(found.names))


def test_received_texts_cannot_control_the_terminal() -> None:
    strange = replace(make_history(), device="a\x1b[31m", events=(replace(EVENT, text="b\x1b]0;c\x07", kind="k\n"),))
    found = decode_history(HistoryMessage.build_reply(strange, ALL_PARTS, T0, 1).encode())
    assert (found.device, found.events[0].kind, found.events[0].text) == ("a [31m", "k ", "b ]0;c ")


def test_states_are_the_documented_ones() -> None:
    assert set(STATES) == {"running", "waiting", "lost", "ended"}
