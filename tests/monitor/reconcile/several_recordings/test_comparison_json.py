"""Tests of the JSON report of several recordings: keys, valid numbers and reproducible bytes."""

import json
from dataclasses import replace
from typing import Any

from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.several_recordings.comparison import RecordingsComparison, compare_results
from monitor.reconcile.several_recordings.comparison_json import encode_comparison
from tests.monitor.reconcile.runs_made import line, run, step


def make_comparison() -> RecordingsComparison:
    leak = step("cross_axis", source=ParameterInterval("gx"), coefficient=ParameterInterval(0.1))
    return compare_results([run("a", line()), run("b", line(), leak)], None, {"c": "too short"})


def write_json(c: RecordingsComparison) -> dict[str, Any]:
    return dict(json.loads(encode_comparison(c)))


def test_keys_are_those_of_the_schema() -> None:
    report = write_json(make_comparison())
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


def test_unknown_values_are_null_or_absent() -> None:
    (single,) = write_json(make_comparison())["axes"]["gz"]["single"]
    assert single["parameters"] == {"source": {"value": "gx"}, "coefficient": {"value": 0.1, "lo": None, "hi": None}}
    assert (single["consistent"], single["p"]) == (None, None)
    assert single["absent"] == [{"run": "a", "meaning": "too_faint", "because": "the recording does not contain gx"}]


def test_nan_is_null() -> None:
    wrong = replace(line(), confidence=float("nan"))
    (single,) = write_json(compare_results([run("a", wrong), run("b")]))["axes"]["gz"]["single"]
    assert single["each"]["a"]["confidence"] is None


def test_same_comparison_gives_the_same_bytes() -> None:
    assert encode_comparison(make_comparison()) == encode_comparison(make_comparison())
