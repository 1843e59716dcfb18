"""Tests of the states of remote devices, which are derived from their messages."""

import dataclasses

import numpy as np
import pytest

from monitor.common import topics
from monitor.common.loss_of_samples import LossOfSamples
from monitor.publishing import remote_device_states
from monitor.publishing.messages.message import decode_message
from monitor.publishing.messages.results import CoefficientsMessage, ModelGapMessage, ResetReply, StatusMessage
from monitor.publishing.remote_device_states import DeviceCoefficients, RemoteDevice
from tests.monitor.publishing import example_results


def test_coefficients_are_decoded_unchanged() -> None:
    estimate = example_results.make_estimate(seconds=1000.0)
    payload = CoefficientsMessage.from_result("a", 1.0, 0, estimate).encode()
    found = DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload))
    for name in ("value", "lo", "hi", "status"):
        np.testing.assert_array_equal(getattr(found.coefficients, name), getattr(estimate.coefficients, name))
    assert found.axes == ("gx", "gy", "gz", "ax", "ay", "az")
    assert found.filled_s == 1000.0


def test_filled_time_is_that_of_the_window() -> None:
    """After a reset, more samples were received than the window contains."""
    estimate = dataclasses.replace(example_results.make_estimate(seconds=1800.0), samples=10_000_000)
    payload = CoefficientsMessage.from_result("a", 1.0, 0, estimate).encode()
    assert DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload)).filled_s == 1800.0


def test_additions_of_a_newer_daemon_are_ignored() -> None:
    payload = (
        StatusMessage.from_result("a", 1.0, 0, example_results.make_health()).encode()[:-1]
        + b',"novelty":[1,{"x":null}]}'
    )
    assert decode_message(StatusMessage, payload).received == 360_000
    axes = b'{"gz":{"N":{"value":1e-4,"lo":1e-5,"hi":1e-3,"status":"estimated"},"Z":{"status":"new"}},"mx":{}}'
    payload = b'{"schema":"imu-monitor/coefficients/1","samples":5,"axes":' + axes + b"}"
    found = DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload))
    assert found.axes == ("gz",)
    assert found.coefficients.value[1, 2] == 1e-4


def test_status_may_have_no_time() -> None:
    assert (
        StatusMessage.decode(StatusMessage.from_result("a", None, 0, example_results.make_health()).encode()).t is None
    )


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"[]",
        b"\xff\xfe",
        b"{}",
        StatusMessage.from_result("a", 1.0, 0, example_results.make_health())
        .encode()
        .replace(b"status/1", b"status/2"),
        StatusMessage.from_result("a", 1.0, 0, example_results.make_health())
        .encode()
        .replace(b'"received":360000', b'"received":"many"'),
        ResetReply.from_result("a", 1.0, 5, "x").encode(),
    ],
)
def test_invalid_payload_is_a_value_error(payload: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - msgspec determines the text
        decode_message(StatusMessage, payload)


def test_unknown_coefficient_status_is_refused() -> None:
    payload = (
        CoefficientsMessage.from_result("a", 1.0, 0, example_results.make_estimate())
        .encode()
        .replace(b'"estimated"', b'"guessed"')
    )
    with pytest.raises(ValueError, match="guessed"):
        DeviceCoefficients.from_message(decode_message(CoefficientsMessage, payload))


def make_device(**changed: object) -> RemoteDevice:
    payload = StatusMessage.from_result("a", 1.0, 0, example_results.make_health(**changed)).encode()
    return RemoteDevice("imu/a", 100.0, status=StatusMessage.decode(payload))


def test_device_has_its_reported_state() -> None:
    for state in ("running", "waiting", "lost", "ended"):
        assert make_device(state=state).state(100.5) == state


def test_silent_or_removed_device_is_recognized() -> None:
    remote_device = make_device()
    assert remote_device.state(100.0 + remote_device_states.SILENCE_TIMEOUT_S - 0.1) == "running"
    assert remote_device.state(100.0 + remote_device_states.SILENCE_TIMEOUT_S + 0.1) == "silent"
    remote_device.token_exists = True
    assert remote_device.state(100.0 + remote_device_states.SILENCE_TIMEOUT_S + 0.1) == "silent"
    remote_device.token_exists = False
    assert remote_device.state(100.0 + remote_device_states.GONE_TIMEOUT_S - 0.1) == "running"
    assert remote_device.state(100.0 + remote_device_states.GONE_TIMEOUT_S + 0.1) == "gone"


def test_ended_replay_is_not_reported_as_gone() -> None:
    remote_device = make_device(state="ended")
    remote_device.token_exists = False
    assert remote_device.state(1e6) == "ended"


def test_device_without_status_is_present() -> None:
    assert RemoteDevice("imu/a", 100.0, token_exists=True).state(100.1) == "present"


def test_problems_determine_rank_and_description() -> None:
    assert make_device(state="lost", text="no such port").problems_first_rank(100.0) == 0
    assert make_device(state="waiting").problems_first_rank(100.0) == 1
    assert make_device().problems_first_rank(100.0) == 2
    assert make_device(state="ended").problems_first_rank(100.0) == 3
    assert make_device().describe_device_problems() == ""
    assert make_device(outputs={"zenoh": "off", "viewer": "ok"}).describe_device_problems() == ""
    stalled = make_device(outputs={"zenoh": "ok", "viewer": "stalled"}, text="odd", overflowed=1200)
    assert stalled.problems_first_rank(100.0) == 1
    assert stalled.describe_device_problems().startswith("odd; viewer: stalled; 1,200 samples overwritten")
    other_port = make_device(outputs={"zenoh": "ok, but the port is busy"})
    assert (other_port.problems_first_rank(100.0), other_port.describe_device_problems()) == (
        2,
        "zenoh: ok, but the port is busy",
    )


def test_key_is_split_into_device_and_topic() -> None:
    assert remote_device_states.split_device_and_topic("a/b/c/command/reset") == ("a/b/c", topics.RESET)
    assert remote_device_states.split_device_and_topic("status") is None
    assert remote_device_states.split_device_and_topic("/status") is None
    assert remote_device_states.split_device_and_topic("imu/bench-1/statuses") is None


def test_disagreement_with_the_model_is_a_problem() -> None:
    status = decode_message(
        StatusMessage, StatusMessage.from_result("a", 1.0, 0, example_results.make_health()).encode()
    )
    payload = ModelGapMessage.from_result(
        "a", 1.0, 0, example_results.make_comparison(scale=1.2, gz=False, gx=True)
    ).encode()
    remote_device = RemoteDevice("imu/a", 0.0, status)
    assert remote_device.problems_first_rank(0.0) == 2
    gap = decode_message(ModelGapMessage, payload)
    remote_device.update_from_message(gap)
    assert remote_device.problems_first_rank(0.0) == 1
    found = gap.axes["gz"]
    lo, hi = found.where.tau
    assert (
        remote_device.describe_device_problems()
        == f"gz disagrees with its model: {found.gap:.3g} σ at τ {lo:.3g} to {hi:.3g} s"
    )
    remote_device.update_from_message(
        decode_message(
            ModelGapMessage, ModelGapMessage.from_result("a", 1.0, 0, example_results.make_comparison(gz=True)).encode()
        )
    )
    assert (remote_device.problems_first_rank(0.0), remote_device.describe_device_problems()) == (2, "")


def test_loss_that_widens_the_intervals_is_described() -> None:
    costly, cheap = LossOfSamples(0.012, {"N": 0.002, "K": 0.04}), LossOfSamples(1e-4, {"N": 2e-4})
    said = "1.2 % of the samples are missing: intervals of K 4 % wider"
    assert make_device(loss=costly).describe_device_problems() == said
    assert not make_device(loss=cheap).describe_device_problems()


def test_exceeded_limit_is_a_problem() -> None:
    remote_device = make_device(crossed=("gz N",))
    assert remote_device.problems_first_rank(100.0) == 1
    assert remote_device.describe_device_problems() == "limits exceeded: gz N"
    many = make_device(crossed=tuple(f"gz {i}" for i in range(100)))
    assert many.describe_device_problems() == "limits exceeded: gz 0, gz 1, gz 2, gz 3, gz 4, gz 5 and 94 more"
