"""Tests of the JSON report: keys of the schema, valid numbers and reproducible bytes."""

import json
from dataclasses import replace
from typing import Any

import numpy as np

from monitor.reconcile.json_report import encode_comparison, encode_report
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisModelDiagnostics,
    AxisResult,
    DiagnosticGap,
    Location,
    ParameterInterval,
    Reconciliation,
)
from monitor.reconcile.several_recordings.comparison import RecordingsComparison, compare_results
from tests.monitor.reconcile import samples
from tests.monitor.reconcile.runs_made import line, run, step


def write_json(r: Reconciliation) -> dict[str, Any]:
    return dict(json.loads(encode_report(r)))


def with_step(r: Reconciliation, **changed: object) -> Reconciliation:
    """Return the reconciliation with changes to the first step of gz."""
    gz = r.axes["gz"]
    return replace(r, axes={**r.axes, "gz": replace(gz, steps=(replace(gz.steps[0], **changed), *gz.steps[1:]))})


def test_step_follows_its_schema() -> None:
    report = write_json(samples.explained())
    assert report["schema"] == "imu-monitor/reconcile/1"
    assert report["verdict"] == "explained"
    assert report["axes"]["gz"]["verdict"] == "explained"
    assert report["axes"]["gz"]["left_over"] == []
    step = report["axes"]["gz"]["steps"][0]
    del step["scores"], step["because"]
    assert step == {
        "found": {
            "lens": "psd", "where": {"frequency": [17.1, 17.5]}, "gap": 41.2, "null95": 1.9, "threshold": 2.6,
        },
        "kind": "added",
        "effect": "sinusoidal",
        "parameters": {
            "amplitude": {"value": 1.5e-4, "lo": 1.474e-4, "hi": 1.526e-4},
            "frequency": {"value": 17.300012, "lo": 17.299912, "hi": 17.300112},
        },
        "confidence": 0.9983,
        "gain_nats": 848.0,
        "runners_up": [
            {"effect": "narrowband", "confidence": 0.0016},
            {"effect": "sample_rate_error", "confidence": 0.0001},
        ],
        "gap": {"before": 41.2, "after": samples.explained().axes["gz"].steps[0].after.gap,
                "null95": 1.9, "threshold": 2.6},
        "held_out_gap": {"before": 39.7, "after": 1.0, "null95": 1.9, "threshold": 2.6},
    }  # fmt: skip


def test_summary_and_the_ranked_findings_come_first() -> None:
    report = write_json(samples.partly_explained())
    assert list(report)[:3] == ["schema", "verdict", "summary"]
    assert report["summary"][0].startswith("The model differs from the recording on gz")
    assert report["gap_nats"] == 886.0
    (line,), (left,) = report["findings"], report["remaining"]
    assert (line["kind"], line["effect"], line["axes"]) == ("added", "sinusoidal", ["gz"])
    assert line["parameters"]["frequency"]["value"] == 17.300012
    assert line["allan"] == {"gz": {"ratio": 1.05, "tau": 0.02}}
    assert (left["axis"], left["group"], left["strongest"]["lens"]) == ("gz", "spectrum", "psd")
    assert line["share"] == report["explained_share"] == 1.0 - left["share"] == 848.0 / 886.0


def test_report_states_settings_notes_and_diagnostics() -> None:
    report = write_json(samples.explained())
    about = {name: report[name] for name in ("rate", "samples", "seconds", "seed", "fitted_first")}
    assert about == {"rate": 100.0, "samples": 360_000, "seconds": 3600.0, "seed": 7, "fitted_first": False}
    assert report["notes"] == ["12 missing samples <in 1 gap> & filled"]
    diagnostics = ["psd", "allan", "level", "distribution", "other_axes"]
    assert [score["lens"] for score in report["axes"]["gx"]["scores"]] == diagnostics
    assert [score["lens"] for score in report["axes"]["gz"]["steps"][1]["scores"]] == diagnostics


def test_single_event_has_a_reason_instead_of_a_held_out_gap() -> None:
    first, second = write_json(samples.explained())["axes"]["gz"]["steps"]
    assert second["held_out_gap"] is None
    assert second["held_out_reason"] == "a known term of another size is not held out"
    assert "held_out_reason" not in first


def test_threshold_of_a_gap_is_that_after_the_step() -> None:
    after = DiagnosticGap("psd", Location(), 1.0, 1.7, 2.2)
    step = write_json(with_step(samples.explained(), after=after))["axes"]["gz"]["steps"][0]
    assert step["gap"] == {"before": 41.2, "after": 1.0, "null95": 1.7, "threshold": 2.2}
    assert step["found"]["threshold"] == 2.6


def test_nan_is_null_and_an_axis_parameter_has_no_interval() -> None:
    parameters = {
        "source": ParameterInterval("ax"),
        "coefficient": ParameterInterval(np.float64(2e-4), np.nan, np.inf),
        "order": ParameterInterval(2),
    }
    found = DiagnosticGap("other_axes", Location(source="ax", value=(-np.inf, 0.1)), np.inf, np.nan, 2.5)
    changed = with_step(samples.explained(), parameters=parameters, before=found, confidence=np.nan)
    step = write_json(changed)["axes"]["gz"]["steps"][0]
    assert step["parameters"] == {
        "source": {"value": "ax"},
        "coefficient": {"value": 2e-4, "lo": None, "hi": None},
        "order": {"value": 2.0, "lo": None, "hi": None},
    }
    assert step["found"] == {
        "lens": "other_axes", "where": {"value": [None, 0.1], "source": "ax"},
        "gap": None, "null95": None, "threshold": 2.5,
    }  # fmt: skip
    assert step["confidence"] is None


def test_remaining_gap_has_a_place_and_no_effect() -> None:
    axis = write_json(samples.unexplained())["axes"]["ax"]
    assert axis["verdict"] == "unexplained"
    assert axis["steps"] == []
    assert axis["left_over"] == [
        {"lens": "psd", "where": {"frequency": [6.0, 11.0]}, "gap": 7.9, "null95": 1.9, "threshold": 2.6}
    ]


def test_same_reconciliation_gives_the_same_bytes_in_the_order_of_the_axes() -> None:
    r = samples.explained()
    backwards = replace(r, axes=dict(reversed(r.axes.items())))
    assert encode_report(samples.explained()) == encode_report(r) == encode_report(backwards)
    assert list(write_json(backwards)["axes"]) == ["gx", "gy", "gz", "ax", "ay", "az"]


def test_numpy_numbers_are_written_as_numbers() -> None:
    score = DiagnosticGap(
        "psd", Location(frequency=(np.float64(1), np.float64(2))), np.float64(3), np.float64(1), np.float64(2)
    )
    look = AxisModelDiagnostics((score,), ())
    step = AddedOrResizedEffect(
        "added",
        "bias_step",
        {"time": ParameterInterval(np.float64(3))},
        np.float64(0.5),
        (),
        score,
        score,
        None,
        "once",
        "it jumps",
        look,
    )
    axes = {"gx": AxisResult("gx", "explained", look, (step,), (), look)}
    model = samples.explained().model
    r = Reconciliation("explained", axes, model, model, False, np.float64(10), np.int64(20), np.float64(2), np.int64(1))
    report = write_json(r)
    assert report["samples"] == 20
    assert report["axes"]["gx"]["steps"][0]["found"]["where"] == {"frequency": [1.0, 2.0]}


def made() -> RecordingsComparison:
    leak = step("cross_axis", source=ParameterInterval("gx"), coefficient=ParameterInterval(0.1))
    return compare_results([run("a", line()), run("b", line(), leak)], None, {"c": "too short"})


def written_comparison(c: RecordingsComparison) -> dict[str, Any]:
    return dict(json.loads(encode_comparison(c)))


def test_keys_are_those_of_the_schema() -> None:
    report = written_comparison(made())
    assert {name: report[name] for name in ("schema", "verdict", "seed", "fitted_to")} == {
        "schema": "imu-monitor/reconcile-runs/1", "verdict": "explained", "seed": 7, "fitted_to": None,
    }  # fmt: skip
    assert report["recordings"] == [
        {"name": "a", "folder": "a", "verdict": "explained", "rate": 100.0, "samples": 360_000, "seconds": 600.0},
        {"name": "b", "folder": "b", "verdict": "explained", "rate": 100.0, "samples": 360_000, "seconds": 600.0},
        {"name": "c", "folder": "c", "verdict": None, "why": "too short"},
    ]
    axis = report["axes"]["gz"]
    assert axis["verdicts"] == {"a": "explained", "b": "explained"}
    (common,) = axis["common"]
    assert common["recordings"] == ["a", "b"]
    assert common["consistent"] is True
    assert common["p"] == common["parameters"]["amplitude"]["p"] == 1.0
    assert common["each"]["a"]["parameters"]["phase"] == {"value": 1.0, "lo": 0.9, "hi": 1.1}
    assert common["each"]["a"]["gap"] == {"before": 30.0, "after": 1.2}


def test_what_is_not_known_is_null_or_absent() -> None:
    (single,) = written_comparison(made())["axes"]["gz"]["single"]
    assert single["parameters"] == {"source": {"value": "gx"}, "coefficient": {"value": 0.1, "lo": None, "hi": None}}
    assert (single["consistent"], single["p"]) == (None, None)
    assert single["absent"] == [{"run": "a", "meaning": "too_faint", "because": "the recording does not contain gx"}]


def test_what_is_no_number_is_null() -> None:
    wrong = replace(line(), confidence=float("nan"))
    (single,) = written_comparison(compare_results([run("a", wrong), run("b")]))["axes"]["gz"]["single"]
    assert single["each"]["a"]["confidence"] is None


def test_the_same_comparison_gives_the_same_bytes() -> None:
    assert encode_comparison(made()) == encode_comparison(made())
