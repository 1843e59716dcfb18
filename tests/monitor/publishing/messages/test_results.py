"""Tests of the JSON messages, key by key as in the README."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from monitor.common import topics
from monitor.common.loss_of_samples import NO_LOSS, LossOfSamples
from monitor.estimation.allan.dynamic_allan import compute_dynamic_allan
from monitor.estimation.allan.hadamard import compute_hadamard_curve
from monitor.estimation.allan.total import compute_total_curve
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.motion_detection import MotionEpisode
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.publishing.messages.analysis_json import AnalysisMessage
from monitor.publishing.messages.results import (
    AllanMessage,
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    ReconcileReply,
    ResetReply,
    StatusMessage,
    ThermalPredictionMessage,
    TotalAndHadamardCurves,
    TotalAndHadamardMessage,
)
from tests.monitor.publishing import example_results

UNIX_S = 1763700000.01


def parse_json(payload: bytes) -> dict[str, Any]:
    def refuse_constant(word: str) -> float:
        raise AssertionError(f"{word} is not JSON")

    found: dict[str, Any] = json.loads(payload, parse_constant=refuse_constant)
    return found


def make_estimate_of_gz() -> Any:
    """Return an estimate of a device that measures only gz, after ten minutes."""
    whole = example_results.make_estimate(seconds=600.0)
    for table in (whole.curve.avar, whole.curve.lo, whole.curve.hi):
        table[:, [0, 1, 3, 4, 5]] = np.nan
    return whole


PAYLOADS = {
    topics.ALLAN: AllanMessage.from_result("bench-1", UNIX_S, 0, example_results.make_estimate()).encode(),
    topics.COEFFICIENTS: CoefficientsMessage.from_result(
        "bench-1", UNIX_S, 0, example_results.make_estimate()
    ).encode(),
    topics.TOTAL: TotalAndHadamardMessage.from_result(
        "bench-1", UNIX_S, 360_000, TotalAndHadamardCurves(*example_results.make_total_and_hadamard_curves())
    ).encode(),
    topics.GAP: ModelGapMessage.from_result(
        "bench-1", UNIX_S, 0, example_results.make_comparison(gz=False, gx=True)
    ).encode(),
    topics.THERMAL: ThermalPredictionMessage.from_result(
        "bench-1", UNIX_S, 360_000, example_results.make_thermal_result()
    ).encode(),
    topics.EVENT: EventMessage.from_result("bench-1", UNIX_S, 360_000, Event("link_back", 0, "back")).encode(),
    topics.STATUS: StatusMessage.from_result("bench-1", UNIX_S, 0, example_results.make_health()).encode(),
    topics.RESET: ResetReply.from_result("bench-1", UNIX_S, 360_000, "the window is empty").encode(),
    topics.RECONCILE: ReconcileReply(device="bench-1", t=UNIX_S, samples=360_000).encode_report(
        {"schema": "x", "verdict": "agrees"}, 0, None, 20
    ),
}


@pytest.mark.parametrize("topic", PAYLOADS, ids=lambda topic: topic.name)
def test_each_payload_starts_with_schema_device_time_and_samples(topic: topics.ZenohTopic) -> None:
    found = parse_json(PAYLOADS[topic])
    assert list(found)[:4] == ["schema", "device", "t", "samples"]
    assert found["schema"] == f"imu-monitor/{topic.name.rpartition('/')[2]}/1"
    assert (found["device"], found["t"], found["samples"]) == ("bench-1", UNIX_S, 360_000)


def test_each_json_topic_has_a_message() -> None:
    # The message of the history has its own tests.
    assert {topic for topic in topics.TOPICS if topic.encoding == topics.JSON} - {topics.HISTORY} == set(PAYLOADS)


def test_coefficients_have_value_interval_and_status() -> None:
    estimate = example_results.make_estimate()
    found = parse_json(PAYLOADS[topics.COEFFICIENTS])
    assert found["window"] == 3600.0
    assert found["rate"] == 100.0
    assert list(found["axes"]) == list(AXES)
    assert all(list(axis) == list(SYMBOLS) for axis in found["axes"].values())
    n = found["axes"]["gz"]["N"]
    at = SYMBOLS.index("N"), AXES.index("gz")
    assert n == {
        "value": estimate.coefficients.value[at],
        "lo": estimate.coefficients.lo[at],
        "hi": estimate.coefficients.hi[at],
        "status": "estimated",
    }
    assert found["axes"]["gz"]["R"] == {"value": None, "lo": 0.0, "hi": 3e-9, "status": "upper_bound"}


@pytest.mark.long
def test_total_and_hadamard_have_their_own_tau() -> None:
    total, hadamard = example_results.make_total_and_hadamard_curves()
    found = parse_json(PAYLOADS[topics.TOTAL])
    assert found["total"]["tau"] == total.tau_s.tolist()
    assert found["hadamard"]["tau"] == hadamard.tau_s.tolist()
    assert list(found["total"]["axes"]) == list(AXES)
    gz = found["total"]["axes"]["gz"]
    assert gz["deviation"] == np.sqrt(total.variance[:, 2]).tolist()
    assert gz["lo"][0] == total.lo[0, 2]
    assert gz["hi"][-1] is None  # beyond half the window there is no interval


def test_thermal_message_has_predictions_per_axis() -> None:
    found = parse_json(PAYLOADS[topics.THERMAL])
    assert (found["interval"], found["temperature"]) == (600.0, 25.5)
    assert found["axes"] == {
        "gz": {
            "bias": 3e-4,
            "error": 1e-6,
            "multi_step": {"bias": 2e-4, "lo": 1e-4, "hi": 3e-4},
            "one_step": {"bias": 2.2e-4, "lo": 1.8e-4, "hi": 2.6e-4},
            "model": "polynomial 1",
            "slope": 2e-5,
            "text": "",
        },
        "az": {
            "bias": 9.81,
            "error": None,
            "multi_step": None,
            "one_step": None,
            "model": None,
            "slope": None,
            "text": "temperature hardly changed",
        },
    }


def test_gap_message_has_threshold_range_and_agreement() -> None:
    comparison = example_results.make_comparison(
        example_results.make_estimate(seconds=600.0), scale=1.1, gz=False, gx=True
    )
    found = parse_json(ModelGapMessage.from_result("a", UNIX_S, 0, comparison).encode())
    assert (found["rate"], found["window"], found["filled"]) == (100.0, 3600.0, 600.0)
    assert found["tau"] == comparison.tau_s.tolist()
    assert list(found["axes"]) == list(AXES)
    gz = found["axes"]["gz"]
    axis = comparison.axes["gz"]
    assert (gz["gap"], gz["threshold"], gz["null95"]) == (axis.gap, axis.threshold, axis.null95)
    assert gz["null95"] < gz["threshold"] < gz["gap"]
    assert gz["ratio"] == pytest.approx(1 / 1.1, rel=0.02)
    assert gz["where"] == {"tau": list(axis.tau_s)}
    assert gz["measured"] == axis.measured.tolist()
    assert gz["model"] == axis.model.tolist()
    assert len(gz["z"]) == len(found["tau"])
    assert [found["axes"][axis]["agrees"] for axis in ("gx", "gy", "gz")] == [True, None, False]


def test_unknown_model_value_is_null() -> None:
    comparison = example_results.make_comparison(example_results.make_estimate(seconds=600.0))
    comparison.axes["gz"].z[0] = np.nan
    assert parse_json(ModelGapMessage.from_result("a", UNIX_S, 0, comparison).encode())["axes"]["gz"]["z"][0] is None


def test_report_keys_are_kept_except_the_common_ones() -> None:
    result = {"schema": "x", "samples": 5, "verdict": "explained", "axes": {"gz": {"steps": []}}}
    found = parse_json(ReconcileReply(device="a", t=UNIX_S, samples=360_000).encode_report(result, 3, "/reports/a", 20))
    assert (found["schema"], found["samples"]) == ("imu-monitor/reconcile/1", 360_000)
    assert (found["verdict"], found["axes"], found["exit"], found["folder"]) == (
        "explained", {"gz": {"steps": []}}, 3, "/reports/a"
    )  # fmt: skip


def test_unestimated_coefficient_is_null() -> None:
    found = parse_json(
        CoefficientsMessage.from_result("a", UNIX_S, 0, example_results.make_estimate(seconds=600.0)).encode()
    )
    assert found["axes"]["ax"]["R"] == {"value": None, "lo": None, "hi": None, "status": "unestimated"}


def test_unmeasured_axes_are_absent() -> None:
    estimate = make_estimate_of_gz()
    assert list(parse_json(CoefficientsMessage.from_result("a", UNIX_S, 0, estimate).encode())["axes"]) == ["gz"]
    assert list(parse_json(AllanMessage.from_result("a", UNIX_S, 0, estimate).encode())["axes"]) == ["gz"]


def test_allan_message_has_deviation_and_interval() -> None:
    estimate = make_estimate_of_gz()
    estimate.curve.avar[-1, 2] = estimate.curve.lo[-1, 2] = estimate.curve.hi[-1, 2] = np.nan
    found = parse_json(AllanMessage.from_result("a", UNIX_S, 0, estimate).encode())
    assert found["tau"] == estimate.curve.tau_s.tolist()
    assert set(found["axes"]["gz"]) == {"deviation", "lo", "hi"}
    gz = found["axes"]["gz"]
    assert gz["deviation"][:-1] == np.sqrt(estimate.curve.avar[:-1, 2]).tolist()
    assert gz["deviation"][-1] is gz["lo"][-1] is gz["hi"][-1] is None
    assert all(lo < d < hi for lo, d, hi in list(zip(gz["lo"], gz["deviation"], gz["hi"], strict=True))[:-1])


def test_event_message_has_all_fields() -> None:
    what = Event(
        "noise_changed",
        21_000_000_000,
        "gz angle random walk rose by 47 %",
        axis="gz",
        values={"N": {"before": 1.5e-4, "after": 2.2e-4}},
        since_ns=1_000_000_000,
        sigma=9.1,
    )
    found = parse_json(EventMessage.from_result("bench-1", UNIX_S, 7, what).encode())
    assert {key: found[key] for key in list(found)[4:]} == {
        "kind": "noise_changed",
        "axis": "gz",
        "what": {"N": {"before": 1.5e-4, "after": 2.2e-4}},
        "since": UNIX_S - 20.0,
        "sigma": 9.1,
        "text": "gz angle random walk rose by 47 %",
    }


def test_status_message_has_all_fields() -> None:
    health = example_results.make_health(
        outputs={"zenoh": "ok", "viewer": "stalled"}, text="…", rate_hz=None, latency_p99_s=None
    )
    found = parse_json(StatusMessage.from_result("bench-1", UNIX_S, 0, health).encode())
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
        "crossed": [],
        "loss": {"share": 0.0, "wider": {}},
        "text": "…",
    }


def test_status_of_an_earlier_revision_states_no_loss() -> None:
    sent = json.loads(StatusMessage.from_result("a", UNIX_S, 0, example_results.make_health()).encode())
    del sent["loss"]
    assert StatusMessage.decode(json.dumps(sent).encode()).to_health().loss == NO_LOSS


def test_loss_of_samples_in_a_status_message() -> None:
    loss = LossOfSamples(0.012, {"N": 0.006, "K": 0.04})
    sent = json.loads(StatusMessage.from_result("a", UNIX_S, 0, example_results.make_health(loss=loss)).encode())
    sent["loss"]["wider"]["\x1b[2J"] = 1.0
    assert StatusMessage.decode(json.dumps(sent).encode()).to_health().loss == loss


def test_reset_reply_has_a_text() -> None:
    assert parse_json(PAYLOADS[topics.RESET])["text"] == "the window is empty"


# --- analyze ---------------------------------------------------------------------------------------


def make_analysis_message(**more: Any) -> dict[str, Any]:
    whole = example_results.make_estimate()
    either = np.array([False, True, False, False, False, False])
    result = replace(example_results.make_analysis(replace(whole, k_or_r=either), notes=("a note",)), **more)
    theta = np.zeros((5, 6)) + example_results.make_true_coefficients() ** 2
    values = 1e-3 * np.random.default_rng(1).standard_normal((3000, 6))
    return parse_json(
        AnalysisMessage.from_analysis(
            result,
            compute_total_curve(values, 100.0, theta, np.array([1, 1000, 2900])),
            compute_hadamard_curve(values, 100.0, theta, np.array([1, 1000])),
            compute_dynamic_allan(values, 100.0, 10.0, (0.01, 0.1, 0.2, 0.4, 1.0), step_s=5.0),
        ).encode()
    )


def test_analysis_message_has_all_curves() -> None:
    found = make_analysis_message()
    assert list(found) == [
        "schema", "rate", "samples", "seconds", "notes", "axes", "motions", "changes", "dynamic"
    ]  # fmt: skip
    gz = found["axes"]["gz"]
    assert list(gz) == ["allan", "total", "hadamard", "coefficients", "bandwidth"]
    for name, rows in (("allan", len(example_results.make_estimate().curve.tau_s)), ("total", 3), ("hadamard", 2)):
        assert list(gz[name]) == ["tau", "deviation", "lo", "hi"]
        assert {len(column) for column in gz[name].values()} == {rows}
    assert gz["total"]["tau"] == [0.01, 10.0, 29.0]
    assert gz["total"]["deviation"][2] > 0.0
    assert gz["total"]["lo"][1] < gz["total"]["deviation"][1] < gz["total"]["hi"][1]
    assert gz["total"]["lo"][2] is gz["total"]["hi"][2] is None  # beyond half the record


def test_ambiguous_k_and_r_refer_to_each_other() -> None:
    axes = make_analysis_message()["axes"]
    assert [axes["gy"]["coefficients"][letter].get("or") for letter in SYMBOLS] == [None, None, None, "R", "K"]
    assert not any("or" in coefficient for coefficient in axes["gz"]["coefficients"].values())


def test_bandwidth_is_a_number_or_null() -> None:
    shown = make_analysis_message(bandwidth_hz=np.array([np.nan, 33.2, np.nan, np.nan, np.nan, np.nan]))["axes"]
    assert (shown["gx"]["bandwidth"], shown["gy"]["bandwidth"]) == (None, 33.2)


def test_motions_and_changes_have_their_times() -> None:
    motion = MotionEpisode("knock", 250, 400, 0.5, "gx", 0.3, "knocked: gx up to 17 °/s")
    noise = Change(
        "noise_changed", 2, 25_000, 25_100, 9.1, {"N": (1.5e-4, 2.2e-4)}, "gz angle random walk rose by 47 %"
    )
    line = Change("noise_changed", 0, 30_000, 30_100, 12.0, {"band": (10.0, 20.0), "rms": (1e-3, 2e-3)}, "gx noise")
    found = make_analysis_message(motions=(motion,), changes=(noise, line))
    assert found["motions"] == [
        {"kind": "knock", "axis": "gx", "t": 2.5, "seconds": 0.5, "peak": 0.3, "text": "knocked: gx up to 17 °/s"}
    ]
    assert found["changes"][0] == {
        "kind": "noise_changed",
        "axis": "gz",
        "t": 250.0,
        "sigma": 9.1,
        "what": {"N": {"before": 1.5e-4, "after": 2.2e-4}},
        "text": "gz angle random walk rose by 47 %",
    }
    assert found["changes"][1]["what"] == {"band": {"from": 10.0, "to": 20.0}, "rms": {"before": 1e-3, "after": 2e-3}}


def test_dynamic_curves_are_lists_over_time() -> None:
    found = make_analysis_message()["dynamic"]
    assert (found["window"], found["t"]) == (10.0, [10.0, 15.0, 20.0, 25.0, 30.0])
    assert found["tau"] == [0.01, 0.1, 0.2, 0.4, 1.0]
    assert list(found["axes"]) == list(AXES)
    gz = found["axes"]["gz"]
    assert np.shape(gz["deviation"]) == np.shape(gz["lo"]) == np.shape(gz["hi"]) == (5, 5)
    n = gz["coefficients"]["N"]
    assert n["status"] == ["estimated"] * 5
    assert all(lo < value < hi for lo, value, hi in zip(n["lo"], n["value"], n["hi"], strict=True))
    assert n["value"] == pytest.approx([1e-4] * 5, rel=0.3)
    assert [value is None for value in gz["coefficients"]["K"]["value"]] == [
        status != "estimated" for status in gz["coefficients"]["K"]["status"]
    ]


def test_parts_that_were_not_computed_are_absent() -> None:
    found = parse_json(AnalysisMessage.from_analysis(example_results.make_analysis()).encode())
    assert "dynamic" not in found
    assert list(found["axes"]["gz"]) == ["allan", "coefficients", "bandwidth"]
    assert found["motions"] == found["changes"] == []
