"""Messages read back: what ``message`` writes, and what anybody else may send."""

import dataclasses

import numpy as np
import pytest

from monitor.common import topics
from monitor.publishing import remote_device_states
from monitor.publishing.messages.message import decode_message
from monitor.publishing.messages.results import CoefficientsMessage, ModelGapMessage, ResetReply, StatusMessage
from monitor.publishing.remote_device_states import DeviceCoefficients, RemoteDevice
from tests.monitor.publishing import made


def test_coefficients_come_back_as_they_were() -> None:
    estimate = made.estimate(seconds=1000.0)
    payload = CoefficientsMessage.from_result("a", 1.0, 0, estimate).encode()
    found = DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload))
    for name in ("value", "lo", "hi", "status"):
        np.testing.assert_array_equal(getattr(found.coefficients, name), getattr(estimate.coefficients, name))
    assert found.axes == ("gx", "gy", "gz", "ax", "ay", "az")
    assert found.filled_s == 1000.0


def test_what_is_seen_is_what_the_window_holds() -> None:
    """Not what came since the start: after a reset that is more."""
    estimate = dataclasses.replace(made.estimate(seconds=1800.0), samples=10_000_000)
    payload = CoefficientsMessage.from_result("a", 1.0, 0, estimate).encode()
    assert DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload)).filled_s == 1800.0


def test_what_a_newer_daemon_adds_is_passed_over() -> None:
    payload = StatusMessage.from_result("a", 1.0, 0, made.health()).encode()[:-1] + b',"novelty":[1,{"x":null}]}'
    assert decode_message(StatusMessage, payload).received == 360_000
    axes = b'{"gz":{"N":{"value":1e-4,"lo":1e-5,"hi":1e-3,"status":"estimated"},"Z":{"status":"new"}},"mx":{}}'
    payload = b'{"schema":"imu-monitor/coefficients/1","samples":5,"axes":' + axes + b"}"
    found = DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload))
    assert found.axes == ("gz",)
    assert found.coefficients.value[1, 2] == 1e-4


def test_a_status_may_have_no_time_yet() -> None:
    assert StatusMessage.decode(StatusMessage.from_result("a", None, 0, made.health()).encode()).t is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"[]",
        b"\xff\xfe",
        b"{}",
        StatusMessage.from_result("a", 1.0, 0, made.health()).encode().replace(b"status/1", b"status/2"),
        StatusMessage.from_result("a", 1.0, 0, made.health())
        .encode()
        .replace(b'"received":360000', b'"received":"many"'),
        ResetReply.from_result("a", 1.0, 5, "x").encode(),
    ],
)
def test_anything_else_is_a_value_error(payload: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - the text is msgspec's
        decode_message(StatusMessage, payload)


def test_a_status_word_of_a_coefficient_that_is_not_known() -> None:
    payload = (
        CoefficientsMessage.from_result("a", 1.0, 0, made.estimate()).encode().replace(b'"estimated"', b'"guessed"')
    )
    with pytest.raises(ValueError, match="guessed"):
        DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload))


def device(**changed: object) -> RemoteDevice:
    payload = StatusMessage.from_result("a", 1.0, 0, made.health(**changed)).encode()
    return RemoteDevice("imu/a", 100.0, status=StatusMessage.decode(payload))


def test_a_device_that_speaks_is_what_it_says() -> None:
    for state in ("running", "waiting", "lost", "ended"):
        assert device(state=state).state(100.5) == state


def test_silence() -> None:
    one = device()
    assert one.state(100.0 + remote_device_states.SILENCE_TIMEOUT_S - 0.1) == "running"
    assert one.state(100.0 + remote_device_states.SILENCE_TIMEOUT_S + 0.1) == "silent"
    one.token_exists = True
    assert one.state(100.0 + remote_device_states.SILENCE_TIMEOUT_S + 0.1) == "silent"
    one.token_exists = False
    assert one.state(100.0 + remote_device_states.GONE_TIMEOUT_S - 0.1) == "running"
    assert one.state(100.0 + remote_device_states.GONE_TIMEOUT_S + 0.1) == "gone"


def test_a_replay_that_has_ended_is_not_missed() -> None:
    one = device(state="ended")
    one.token_exists = False
    assert one.state(1e6) == "ended"


def test_nothing_known_but_its_presence() -> None:
    assert RemoteDevice("imu/a", 100.0, token_exists=True).state(100.1) == "present"


def test_ranks_and_words_of_trouble() -> None:
    assert device(state="lost", text="no such port").problems_first_rank(100.0) == 0
    assert device(state="waiting").problems_first_rank(100.0) == 1
    assert device().problems_first_rank(100.0) == 2
    assert device(state="ended").problems_first_rank(100.0) == 3
    assert device().describe_problems() == ""
    assert device(outputs={"zenoh": "off", "viewer": "ok"}).describe_problems() == ""
    stalled = device(outputs={"zenoh": "ok", "viewer": "stalled"}, text="odd", overflowed=1200)
    assert stalled.problems_first_rank(100.0) == 1
    assert stalled.describe_problems().startswith("odd; viewer: stalled; 1,200 samples overwritten")
    elsewhere = device(outputs={"zenoh": "ok, but the port is busy"})
    assert (elsewhere.problems_first_rank(100.0), elsewhere.describe_problems()) == (
        2,
        "zenoh: ok, but the port is busy",
    )


def test_a_topic_of_two_parts_and_keys_that_are_none() -> None:
    assert remote_device_states.split_device_and_topic("a/b/c/command/reset") == ("a/b/c", topics.RESET)
    assert remote_device_states.split_device_and_topic("status") is None
    assert remote_device_states.split_device_and_topic("/status") is None
    assert remote_device_states.split_device_and_topic("imu/bench-1/statuses") is None


def test_disagreement_with_a_model_is_trouble_and_ranks_before_what_runs_well() -> None:
    status = decode_message(StatusMessage, StatusMessage.from_result("a", 1.0, 0, made.health()).encode())
    payload = ModelGapMessage.from_result("a", 1.0, 0, made.look(scale=1.2, gz=False, gx=True)).encode()
    one = RemoteDevice("imu/a", 0.0, status)
    assert one.problems_first_rank(0.0) == 2
    gap = decode_message(ModelGapMessage, payload)
    one.update_from_message(gap)
    assert one.problems_first_rank(0.0) == 1
    found = gap.axes["gz"]
    lo, hi = found.where.tau
    assert one.describe_problems() == f"gz disagrees with its model: {found.gap:.3g} σ at τ {lo:.3g} to {hi:.3g} s"
    one.update_from_message(
        decode_message(ModelGapMessage, ModelGapMessage.from_result("a", 1.0, 0, made.look(gz=True)).encode())
    )
    assert (one.problems_first_rank(0.0), one.describe_problems()) == (2, "")


def test_a_limit_that_is_passed_is_trouble() -> None:
    one = device(crossed=("gz N",))
    assert one.problems_first_rank(100.0) == 1
    assert one.describe_problems() == "limits exceeded: gz N"
    many = device(crossed=tuple(f"gz {i}" for i in range(100)))
    assert many.describe_problems() == "limits exceeded: gz 0, gz 1, gz 2, gz 3, gz 4, gz 5 and 94 more"
