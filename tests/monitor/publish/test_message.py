"""The JSON on the wire, key by key as the README's table of keys says."""

import json
from typing import Any

import numpy as np
import pytest

from drivers.sample import AXES, Event
from monitor import topics
from monitor.estimate.coefficients import LETTERS
from monitor.publish import message
from tests.monitor.publish import made

UNIX_S = 1763700000.01


def parsed(payload: bytes) -> dict[str, Any]:
    def refuse(word: str) -> float:
        raise AssertionError(f"{word} is not JSON")

    found: dict[str, Any] = json.loads(payload, parse_constant=refuse)
    return found


def gyro_z_only() -> Any:
    """An estimate of a device that measures gz alone, after ten minutes."""
    whole = made.estimate(seconds=600.0)
    for table in (whole.curve.avar, whole.curve.lo, whole.curve.hi):
        table[:, [0, 1, 3, 4, 5]] = np.nan
    return whole


ALL = {
    topics.ALLAN: message.allan("bench-1", UNIX_S, made.estimate()),
    topics.COEFFICIENTS: message.coefficients("bench-1", UNIX_S, made.estimate()),
    topics.TOTAL: message.total("bench-1", UNIX_S, 360_000, *made.slow_curves()),
    topics.EVENT: message.event("bench-1", UNIX_S, 360_000, Event("link_back", 0, "back"), None),
    topics.STATUS: message.status("bench-1", UNIX_S, made.health()),
    topics.RESET: message.reply("bench-1", UNIX_S, 360_000, "the window is empty"),
}


@pytest.mark.parametrize("topic", ALL, ids=lambda topic: topic.name)
def test_every_payload_says_what_whose_when_and_how_many(topic: topics.Topic) -> None:
    found = parsed(ALL[topic])
    assert list(found)[:4] == ["schema", "device", "t", "samples"]
    assert found["schema"] == f"imu-monitor/{topic.name.rpartition('/')[2]}/1"
    assert (found["device"], found["t"], found["samples"]) == ("bench-1", UNIX_S, 360_000)


def test_every_json_topic_has_a_message() -> None:
    assert {topic for topic in topics.TOPICS if topic.encoding == topics.JSON} == set(ALL)


def test_coefficients() -> None:
    estimate = made.estimate()
    found = parsed(ALL[topics.COEFFICIENTS])
    assert found["window"] == 3600.0
    assert found["rate"] == 100.0
    assert list(found["axes"]) == list(AXES)
    assert all(list(axis) == list(LETTERS) for axis in found["axes"].values())
    n = found["axes"]["gz"]["N"]
    at = LETTERS.index("N"), AXES.index("gz")
    assert n == {
        "value": estimate.coefficients.value[at],
        "lo": estimate.coefficients.lo[at],
        "hi": estimate.coefficients.hi[at],
        "status": "estimated",
    }
    assert found["axes"]["gz"]["R"] == {"value": None, "lo": 0.0, "hi": 3e-9, "status": "upper_bound"}


def test_total_and_hadamard_have_their_own_tau() -> None:
    total, hadamard = made.slow_curves()
    found = parsed(ALL[topics.TOTAL])
    assert found["total"]["tau"] == total.tau_s.tolist()
    assert found["hadamard"]["tau"] == hadamard.tau_s.tolist()
    assert list(found["total"]["axes"]) == list(AXES)
    gz = found["total"]["axes"]["gz"]
    assert gz["deviation"] == np.sqrt(total.tvar[:, 2]).tolist()
    assert gz["lo"][0] == total.lo[0, 2]
    assert gz["hi"][-1] is None  # beyond half the window there is no interval


def test_too_few_data_are_null_and_say_so() -> None:
    found = parsed(message.coefficients("a", UNIX_S, made.estimate(seconds=600.0)))
    assert found["axes"]["ax"]["R"] == {"value": None, "lo": None, "hi": None, "status": "unestimated"}


def test_axes_that_are_not_measured_are_absent() -> None:
    estimate = gyro_z_only()
    assert list(parsed(message.coefficients("a", UNIX_S, estimate))["axes"]) == ["gz"]
    assert list(parsed(message.allan("a", UNIX_S, estimate))["axes"]) == ["gz"]


def test_allan() -> None:
    estimate = gyro_z_only()
    estimate.curve.avar[-1, 2] = estimate.curve.lo[-1, 2] = estimate.curve.hi[-1, 2] = np.nan
    found = parsed(message.allan("a", UNIX_S, estimate))
    assert found["tau"] == estimate.curve.tau_s.tolist()
    assert set(found["axes"]["gz"]) == {"deviation", "lo", "hi"}
    gz = found["axes"]["gz"]
    assert gz["deviation"][:-1] == np.sqrt(estimate.curve.avar[:-1, 2]).tolist()
    assert gz["deviation"][-1] is gz["lo"][-1] is gz["hi"][-1] is None
    assert all(lo < d < hi for lo, d, hi in list(zip(gz["lo"], gz["deviation"], gz["hi"], strict=True))[:-1])


def test_event() -> None:
    what = Event(
        "noise_changed",
        5,
        "gz angle random walk rose by 47 %",
        axis="gz",
        what={"N": {"before": 1.5e-4, "after": 2.2e-4}},
        since_ns=1,
        sigma=9.1,
    )
    found = parsed(message.event("bench-1", UNIX_S, 7, what, 1763699980.0))
    assert {key: found[key] for key in list(found)[4:]} == {
        "kind": "noise_changed",
        "axis": "gz",
        "what": {"N": {"before": 1.5e-4, "after": 2.2e-4}},
        "since": 1763699980.0,
        "sigma": 9.1,
        "text": "gz angle random walk rose by 47 %",
    }


def test_status() -> None:
    health = made.health(outputs={"zenoh": "ok", "viewer": "stalled"}, text="…", rate_hz=None, latency_p99_s=None)
    found = parsed(message.status("bench-1", UNIX_S, health))
    assert {key: found[key] for key in list(found)[4:]} == {
        "state": "running",
        "rate": None,
        "received": 360_000,
        "lost": 3,
        "bad": 1,
        "overflowed": 0,
        "latency": {"p50": 0.0021, "p99": None},
        "memory": 182_000_000,
        "outputs": {"zenoh": "ok", "viewer": "stalled"},
        "uptime": 3600.0,
        "repeated": 0,
        "late": 0,
        "moving": False,
        "moved": 0,
        "text": "…",
    }


def test_reply() -> None:
    assert parsed(ALL[topics.RESET])["text"] == "the window is empty"
