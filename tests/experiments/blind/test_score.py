"""The scorer against reports written by hand, and the tables against counts done by hand."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.experiments.blind import cases, recipes, run, tables
from tests.experiments.blind.score import Outcome, score


def step(effect: str, kind: str = "added", confidence: float = 0.99, **parameters: Any) -> dict[str, Any]:
    told = {
        name: {"value": bounds}
        if isinstance(bounds, str)
        else {"value": sum(bounds) / 2, "lo": bounds[0], "hi": bounds[1]}
        for name, bounds in parameters.items()
    }
    return {"kind": kind, "effect": effect, "confidence": confidence, "parameters": told}


def report(
    verdict: str = "explained",
    left_over: tuple[str, ...] = (),
    more: dict[str, list[dict[str, Any]]] | None = None,
    **axes: list[dict[str, Any]],
) -> dict[str, Any]:
    told: dict[str, dict[str, Any]] = {
        axis: {"verdict": "agrees", "steps": [], "left_over": []} for axis in ("gx", "gy", "gz", "ax", "ay", "az")
    }
    for axis, steps in {**(more or {}), **axes}.items():
        told[axis] = {
            "verdict": verdict,
            "steps": steps,
            "left_over": [{"lens": diagnostic} for diagnostic in left_over],
        }
    return {"schema": "imu-monitor/reconcile/1", "verdict": verdict, "axes": told}


def hidden(axis: str, effect: str, **parameters: Any) -> dict[str, Any]:
    return {"axis": axis, "effect": effect, "parameters": parameters, "gain": 80.0, "margin": 20.0, "wrong": "x"}


def truth(*effects: dict[str, Any], case: str = "", foreign: str = "") -> dict[str, Any]:
    return {
        "case": case or "+".join(one["effect"] for one in effects) or (f"foreign:{foreign}" if foreign else "null"),
        "level": "plain",
        "seed": 0,
        "baseline": "exact",
        "hidden": list(effects),
        "foreign": [{"axis": "gz", "name": foreign, "size": 1.0}] if foreign else [],
    }


LINE = hidden("gz", "sinusoidal", amplitude=1.0, frequency=17.0, phase=0.1)


def judged(told: dict[str, Any], said: dict[str, Any] | None, status: int = 0) -> Outcome:
    return score(told, said, status, 1.0)


def test_right_name_on_the_right_axis() -> None:
    found = judged(truth(LINE), report(gz=[step("sinusoidal", amplitude=(0.9, 1.2), frequency=(17.1, 17.2))]))
    assert found.right
    assert found.closed
    assert found.confused == (("sinusoidal", "sinusoidal"),)
    assert found.coverage == (("sinusoidal", "amplitude", True), ("sinusoidal", "frequency", False))


def test_right_name_on_the_wrong_axis_is_false_and_missed() -> None:
    found = judged(truth(LINE), report(gy=[step("sinusoidal")]))
    assert not found.right
    assert [(name.axis, name.effect) for name in found.false] == [("gy", "sinusoidal")]
    assert [(name.axis, name.effect) for name in found.missed] == [("gz", "sinusoidal")]
    assert found.confused == (("sinusoidal", "(agrees)"),)


def test_wrong_name_fills_the_matrix() -> None:
    found = judged(truth(LINE), report(gz=[step("narrowband")]))
    assert found.confused == (("sinusoidal", "narrowband"),)
    assert len(found.false) == len(found.missed) == 1


def test_right_name_beside_a_false_one_is_not_right() -> None:
    found = judged(truth(LINE), report(gz=[step("sinusoidal")], ax=[step("outliers", confidence=0.6)]))
    assert not found.right
    assert not found.missed
    assert [name.confidence for name in found.false] == [0.6]


def test_name_given_twice_is_false_once() -> None:
    found = judged(truth(LINE), report(gz=[step("sinusoidal"), step("sinusoidal")]))
    assert [name.right for name in found.names] == [True, False]


def test_retuned_terms_are_no_names() -> None:
    found = judged(truth(LINE), report(gz=[step("angle_random_walk", "retuned"), step("sinusoidal")]))
    assert found.right
    assert found.retuned == 1
    missed = judged(truth(LINE), report(gz=[step("angle_random_walk", "retuned")]))
    assert missed.confused == (("sinusoidal", "(retuned)"),)


def test_leak_needs_its_source() -> None:
    leak = hidden("gx", "cross_axis", source="gy", coefficient=0.01)
    assert judged(truth(leak), report(gx=[step("cross_axis", source="gy")])).right
    assert not judged(truth(leak), report(gx=[step("cross_axis", source="gz")])).right
    assert not judged(truth(leak), report(gy=[step("cross_axis", source="gx")])).right


def test_clock_error_may_stand_on_any_axis_and_on_several() -> None:
    wrong_clock = hidden("gx", "sample_rate_error", ratio=1.01)
    axes = {"gy": [step("sample_rate_error", ratio=(1.0, 1.02))], "az": [step("sample_rate_error")]}
    found = judged(truth(wrong_clock), report(more=axes))
    assert found.right
    assert found.coverage == (("sample_rate_error", "ratio", True),)
    assert not judged(truth(LINE), report(gz=[step("sinusoidal")], more=axes)).right


def test_two_of_a_pair_on_one_axis() -> None:
    jump = hidden("gz", "bias_step", time=10.0, height=1.0)
    both = report(gz=[step("bias_step"), step("sinusoidal")])
    assert judged(truth(LINE, jump), both).right
    half = judged(truth(LINE, jump), report("partly_explained", ("psd",), gz=[step("bias_step")]))
    assert not half.right
    assert not half.closed
    assert set(half.confused) == {("bias_step", "bias_step"), ("sinusoidal", "(partly_explained)")}


def test_phase_is_judged_on_the_circle() -> None:
    assert judged(truth(LINE), report(gz=[step("sinusoidal", phase=(6.3, 6.5))])).coverage[0][2]
    assert not judged(truth(LINE), report(gz=[step("sinusoidal", phase=(3.0, 3.5))])).coverage[0][2]


def test_null() -> None:
    assert judged(truth(), report("agrees")).right
    assert not judged(truth(), report(gx=[step("bias_step")])).right
    assert not judged(truth(), None, 3).right


@pytest.mark.parametrize(
    ("verdict", "names", "honest", "false"),
    [
        ("unexplained", [], True, 0),
        ("partly_explained", ["narrowband"], True, 1),
        ("explained", ["narrowband"], False, 1),
        ("agrees", [], False, 0),
    ],
)
def test_foreign_effect(verdict: str, names: list[str], honest: bool, false: int) -> None:
    found = judged(truth(foreign="chirp"), report(verdict, gz=[step(name) for name in names]))
    assert found.right == found.honest == honest
    assert len(found.false) == false


def test_parts_of_a_foreign_effect_are_right_on_its_axis() -> None:
    parts = [step("exponentially_correlated"), step("exponentially_correlated")]
    assert judged(truth(foreign="two_correlated"), report(gz=parts)).right
    assert not judged(truth(foreign="two_correlated"), report(gx=parts)).right


def test_outcome_survives_its_file(tmp_path: Path) -> None:
    found = judged(truth(LINE), report(gz=[step("narrowband"), step("sinusoidal", amplitude=(0.9, 1.1))]))
    file = tmp_path / "results.jsonl"
    file.write_text(json.dumps({"key": "k", **found.json()}) + "\n")
    assert run.outcomes(file) == [found]


def test_only_what_is_missing_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def pretend(job: run.Job, in_process: bool, keep: Path | None) -> Outcome:
        ran.append(job.key)
        return judged(truth(), report("agrees"))

    monkeypatch.setattr(run, "run", pretend)
    todo = run.jobs("nulls", "plain", range(2), 600.0)
    file = tmp_path / "results.jsonl"
    assert len(list(run.run_all(todo[:3], file, 1))) == 3
    assert len(list(run.run_all(todo, file, 1))) == 1
    assert ran == [job.key for job in todo]
    assert len(run.outcomes(file)) == 4


def test_sets_and_their_cases() -> None:
    assert len(run.jobs("singles", "faint", range(3), 3600.0)) == 3 * len(cases.SINGLES)
    assert {job.baseline for job in run.jobs("off", "plain", range(1), 3600.0)} == {"off"}
    assert {(job.axes, job.seconds) for job in run.jobs("nulls", "plain", range(1), 3600.0)} == {
        (6, 600.0),
        (1, 3600.0),
    }
    assert [job.name for job in run.jobs("singles", "plain", range(1), 60.0, ["outliers"])] == ["outliers"]
    with pytest.raises(ValueError, match="no set"):
        run.jobs("everything", "plain", range(1), 60.0)


def test_shares() -> None:
    assert tables.share(0, 300) == "0.0 % (0.0–1.3) 0 of 300"
    assert tables.share(98, 100) == "98.0 % (93.0–99.4) 98 of 100"
    assert tables.share(0, 0) == "—"


def test_report_counts() -> None:
    outcomes = [
        judged(truth(LINE), report(gz=[step("sinusoidal", amplitude=(0.9, 1.1))])),
        judged(truth(LINE), report(gz=[step("narrowband", confidence=0.97)])),
        judged(truth(), report("agrees")),
        judged(truth(foreign="chirp"), report("unexplained", ("psd",), gz=[])),
    ]
    text = tables.report(outcomes)
    assert "| single plain, exact baseline | 50.0 % (9.5–90.5) 1 of 2 |" in text
    assert "| sinusoidal | 1 | 1 narrowband |" in text
    assert "| sinusoidal | amplitude | 100.0 % (20.7–100.0) 1 of 1 |" in text
    assert "that are wrong, of all names: 50.0 % (9.5–90.5) 1 of 2." in text
    assert "| sinusoidal plain exact | 0 | gz narrowband | 0.97 |" in text
    assert "| foreign, exact baseline | 100.0 %" in text


def test_run_gives_the_program_files_and_reads_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def program() -> None:
        _, command, recording, option, model, _, out, _, seed = sys.argv
        assert (command, option, seed) == ("reconcile", "--model", "3")
        seen.extend(sorted(path.name for path in Path(recording).parent.iterdir()))
        assert "angle_random_walk" in Path(model).read_text()
        Path(out).mkdir()
        (Path(out) / "report.json").write_text(json.dumps(report("agrees")))
        raise SystemExit(0)

    monkeypatch.setattr("monitor.cli.main", program)
    found = run.run(run.Job("null", "plain", 3, 10.0), in_process=True, keep=tmp_path)
    assert found.right
    assert seen == ["model.toml", "recording.npz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "null_plain_3_10s_100Hz_6_exact",
        "null_plain_3_10s_100Hz_6_exact.truth.json",
    ]


def test_run_that_was_stopped_is_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def program() -> None:
        raise SystemExit(143)

    monkeypatch.setattr("monitor.cli.main", program)
    with pytest.raises(KeyboardInterrupt, match="143"):
        run.run(run.Job("null", "plain", 3, 10.0), in_process=True)


def test_run_tells_what_the_program_said_when_it_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def program() -> None:
        print("imu-monitor: no", file=sys.stderr)
        raise SystemExit(2)

    monkeypatch.setattr("monitor.cli.main", program)
    found = run.run(run.Job("null", "plain", 3, 10.0), in_process=True)
    assert (found.exit_status, found.verdict, found.right) == (2, "", False)
    assert "exit status 2: imu-monitor: no" in capsys.readouterr().err


def test_power_curve_and_reliability_count_by_size_and_confidence() -> None:
    told = {**truth(LINE), "size": 0.5}
    found = judged(told, report(gz=[step("sinusoidal", confidence=0.95)]))
    wrong = judged(told, report(gz=[step("narrowband", confidence=0.6)]))
    plain = judged(truth(LINE), report(gz=[step("sinusoidal", confidence=0.97)]))
    text = tables.report([found, wrong, plain])
    assert "| identifiable singles | 50.0 % (9.5–90.5) 1 of 2 |" in text
    assert "| sinusoidal | 1 of 2 |" in text  # the recording of the level's own size is no point of the curve
    rows = {line.split(" | ")[0]: line.split(" | ")[1:] for line in text.splitlines()}
    assert rows["| 0.9–0.99"] == ["0.960", "100.0 % (34.2–100.0) 2 of 2 |"]
    assert rows["| 0.5–0.8"] == ["0.600", "0.0 % (0.0–79.3) 0 of 1 |"]


def test_all_sets_in_one_run_have_sizes_where_a_size_is_hidden() -> None:
    todo = run.jobs("all", "plain", range(1), 600.0, sizes=(0.25, 1.0))
    assert {job.name for job in todo} == {*cases.SINGLES, *cases.PAIRS, *cases.FOREIGN, "null"}
    assert {job.name for job in todo if job.sizes is None} == {*cases.FOREIGN, "null"}
    assert len({job.key for job in todo}) == len(todo)


@pytest.mark.parametrize("name", ["bias_step", "noise_step", "saturation", "resolution"])
def test_multiple_of_a_size_changes_nothing_else(name: str) -> None:
    plain = cases.case(name, seed=1, seconds=600.0, axes=1)
    half = cases.case(name, seed=1, seconds=600.0, axes=1, sizes=(0.5, 0.5))
    whole, part = plain.truth["hidden"][0], half.truth["hidden"][0]
    size = recipes.RECIPES[name].size
    assert half.truth["size"] == pytest.approx(0.5)
    assert {k for k, v in whole["parameters"].items() if part["parameters"][k] != v} == {size}
    if name == "bias_step":
        assert part["parameters"][size] == pytest.approx(0.5 * whole["parameters"][size])
        assert part["gain"] < 0.5 * whole["gain"]
