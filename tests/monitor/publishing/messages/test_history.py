"""The answer of a history: its layout, and that what is read is what was kept."""

import copy
import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.data_types import AXES
from monitor.estimation.fit.coefficient_values import SYMBOLS
from monitor.history.history_row import STATES, HistoryRow, merge_rows
from monitor.history.history_table import HistoryTable, build_table
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.query_parameters import PARTS, HistoryQuery
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.messages.history import HistoryMessage, decode_history
from tests.monitor.publishing.made import estimate, health

T0 = 1_760_000_040.0
EVENT = StoredEvent(T0 + 30.0, "noise_changed", "gz rose", "gz", {"N": {"before": 1e-4, "after": 2e-4}}, T0, 9.1, 3)
ALL = HistoryQuery(what=PARTS)


def made() -> HistoryTable:
    """Three minutes: R not estimated, then bounded; then the device is lost."""
    minutes = MinuteAggregator()
    looks = [(0.0, 1000.0), (20.0, 1200.0), (60.0, 3600.0), (70.0, 3500.0)]
    rows = [minutes.add_estimate(T0 + at, estimate(seconds=seconds, seed=i)) for i, (at, seconds) in enumerate(looks)]
    rows.append(minutes.add_health(T0 + 75.0, health(received=7000)))
    rows.append(minutes.add_temperature(T0 + 76.0, np.array([21.5])))
    rows.append(minutes.add_health(T0 + 130.0, health(state="lost", received=7000, rate_hz=None, latency_p99_s=None)))
    rows.append(minutes.flush())
    full: list[HistoryRow] = [row for row in rows if row is not None]
    return build_table("bench-1", TimeRange(T0, T0 + 180.0), 60, full, [EVENT], 1)


def test_the_layout_is_the_documented_one() -> None:
    said = json.loads(HistoryMessage.build_reply(made(), ALL, T0 + 130.0, 7000).encode())
    assert (said["schema"], said["device"], said["t"], said["samples"]) == (
        "imu-monitor/history/1", "bench-1", T0 + 130.0, 7000,
    )  # fmt: skip
    assert (said["from"], said["to"], said["step"]) == (T0, T0 + 180.0, 60)
    assert said["start"] == [int(T0), int(T0) + 60, int(T0) + 120]
    assert said["width"] == [60, 60, 60]
    assert list(said["axes"]) == list(AXES)
    n, r = said["axes"]["gz"]["N"], said["axes"]["gz"]["R"]
    assert n["status"] == ["estimated", "estimated", "unestimated"]
    assert n["n"] == [2, 2, 0]
    assert n["low"][0] < n["high"][0]
    assert n["lo"][0] < n["value"][0] < n["hi"][0]
    assert n["value"][2] is None
    assert r["status"] == ["unestimated", "upper_bound", "unestimated"]
    assert (r["value"][1], r["lo"][1], r["hi"][1]) == (None, 0.0, pytest.approx(3e-9))
    deviations = said["deviations"]
    assert deviations["tau"][:3] == [0.01, 0.03, 0.1]
    assert len(deviations["axes"]["az"]["value"]) == 3
    assert len(deviations["axes"]["az"]["low"][0]) == len(deviations["tau"])
    status = said["status"]
    assert status["state"] == ["ended", "running", "lost"]
    assert status["received"] == [0, 7000, 0]
    assert status["rate"]["value"] == [None, pytest.approx(99.98), None]
    assert status["temperature"]["high"] == [None, 21.5, None]
    (event,) = said["events"]
    assert event == {
        "t": T0 + 30.0, "kind": "noise_changed", "axis": "gz", "what": {"N": {"before": 1e-4, "after": 2e-4}},
        "since": T0, "sigma": 9.1, "text": "gz rose", "stands_for": 3,
    }  # fmt: skip
    assert said["events_in_all"] == 1


def test_only_what_is_asked_for_is_said() -> None:
    asked = HistoryQuery(what=("coefficients",), axes=("gz",), symbols=("B", "N"))
    said = json.loads(HistoryMessage.build_reply(made(), asked, T0, 1).encode())
    assert set(said) & {"deviations", "status", "events"} == set()
    assert {axis: list(letters) for axis, letters in said["axes"].items()} == {"gz": ["B", "N"]}


def test_what_is_read_is_what_was_kept() -> None:
    kept = made()
    found = decode_history(HistoryMessage.build_reply(kept, ALL, T0, 1).encode())
    assert (found.device, found.span, found.step_s) == (kept.device, kept.span, kept.step_s)
    assert (found.events, found.events_in_all) == (kept.events, kept.events_in_all)
    np.testing.assert_array_equal(found.start_s, kept.start_s)
    np.testing.assert_array_equal(found.width_s, kept.width_s)
    np.testing.assert_array_equal(found.counts, kept.counts)
    np.testing.assert_array_equal(found.state, kept.state)
    names = [f"{axis}.{letter}" for axis in AXES for letter in SYMBOLS]
    for name in [*names, "rate", "memory", "temperature", *(f"gz.sigma.{tau}" for tau in kept.list_tau_labels())]:
        for part in ("low", "high", "last"):
            np.testing.assert_array_equal(
                getattr(found.select_column(name), part), getattr(kept.select_column(name), part), name
            )
    for name in names:
        np.testing.assert_array_equal(found.select_column(name).n, kept.select_column(name).n)
        for end in (".lo", ".hi", ".bound"):
            np.testing.assert_array_equal(found.select_column(name + end).last, kept.select_column(name + end).last)


def test_a_bound_within_a_bucket_of_estimates_is_not_shown_as_its_interval() -> None:
    minutes, rows = MinuteAggregator(), []
    for i, seconds in enumerate((3600.0, 200.0)):  # B is estimated, then only bounded
        rows.append(minutes.add_estimate(T0 + i, estimate(seconds=seconds)))
    row = merge_rows([one for one in (*rows, minutes.flush()) if one is not None], int(T0), 60)
    one = build_table("a", TimeRange(T0, T0 + 60.0), 60, [row], [], 0)
    letter = json.loads(HistoryMessage.build_reply(one, ALL, T0, 1).encode())["axes"]["gz"]["B"]
    assert (letter["status"], letter["n"]) == (["estimated"], [1])
    assert letter["lo"][0] < letter["value"][0] < letter["hi"][0]


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_payload_is_an_answer_or_a_value_error(data: st.DataObject) -> None:
    said = json.loads(HistoryMessage.build_reply(made(), ALL, T0, 1).encode())
    junk = st.sampled_from([None, [], {}, -1, 1e300, 10**30, "x", [None], [[1.0]], {"gz": 1}, [1.0, None, "x"]])
    for _ in range(data.draw(st.integers(1, 3))):
        at = said
        while True:
            key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            if not isinstance(at[key], dict | list) or not at[key] or data.draw(st.booleans()):
                at[key] = copy.deepcopy(data.draw(junk))
                break
            at = at[key]
    try:
        found = decode_history(msgspec.json.encode(said))
    except ValueError:
        return
    assert len(found) == len(found.width_s) == len(found.state)
    assert found.low.shape == (len(found), len(found.names))


def test_texts_of_strangers_do_not_steer_the_terminal() -> None:
    strange = replace(made(), device="a\x1b[31m", events=(replace(EVENT, text="b\x1b]0;c\x07", kind="k\n"),))
    found = decode_history(HistoryMessage.build_reply(strange, ALL, T0, 1).encode())
    assert (found.device, found.events[0].kind, found.events[0].text) == ("a [31m", "k ", "b ]0;c ")


def test_states_are_known() -> None:
    assert set(STATES) == {"running", "waiting", "lost", "ended"}
