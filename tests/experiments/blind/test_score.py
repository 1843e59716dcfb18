"""Tests of the score of hand-written reports, of the tables, and of the runs of the blind trials."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.experiments.blind import cases, recipes, run, tables
from tests.experiments.blind.score import Outcome, score


def make_step(effect: str, kind: str = "added", confidence: float = 0.99, **parameters: Any) -> dict[str, Any]:
    values = {
        name: {"value": bounds}
        if isinstance(bounds, str)
        else {"value": sum(bounds) / 2, "lo": bounds[0], "hi": bounds[1]}
        for name, bounds in parameters.items()
    }
    return {"kind": kind, "effect": effect, "confidence": confidence, "parameters": values}


def make_report(
    verdict: str = "explained",
    left_over: tuple[str, ...] = (),
    more: dict[str, list[dict[str, Any]]] | None = None,
    **axes: list[dict[str, Any]],
) -> dict[str, Any]:
    results: dict[str, dict[str, Any]] = {
        axis: {"verdict": "agrees", "steps": [], "left_over": []} for axis in ("gx", "gy", "gz", "ax", "ay", "az")
    }
    for axis, steps in {**(more or {}), **axes}.items():
        results[axis] = {
            "verdict": verdict,
            "steps": steps,
            "left_over": [{"lens": diagnostic} for diagnostic in left_over],
        }
    return {"schema": "imu-monitor/reconcile/1", "verdict": verdict, "axes": results}


def make_hidden_effect(axis: str, effect: str, **parameters: Any) -> dict[str, Any]:
    return {"axis": axis, "effect": effect, "parameters": parameters, "gain": 80.0, "margin": 20.0, "wrong": "x"}


def make_truth(*effects: dict[str, Any], case: str = "", foreign: str = "") -> dict[str, Any]:
    return {
        "case": case
        or "+".join(effect["effect"] for effect in effects)
        or (f"foreign:{foreign}" if foreign else "null"),
        "level": "plain",
        "seed": 0,
        "baseline": "exact",
        "hidden": list(effects),
        "foreign": [{"axis": "gz", "name": foreign, "size": 1.0}] if foreign else [],
    }


HIDDEN_LINE = make_hidden_effect("gz", "sinusoidal", amplitude=1.0, frequency=17.0, phase=0.1)


def score_report(truth: dict[str, Any], report: dict[str, Any] | None, status: int = 0) -> Outcome:
    return score(truth, report, status, 1.0)


def test_right_name_on_the_right_axis() -> None:
    found = score_report(
        make_truth(HIDDEN_LINE), make_report(gz=[make_step("sinusoidal", amplitude=(0.9, 1.2), frequency=(17.1, 17.2))])
    )
    assert found.right
    assert found.closed
    assert found.confused == (("sinusoidal", "sinusoidal"),)
    assert found.coverage == (("sinusoidal", "amplitude", True), ("sinusoidal", "frequency", False))


def test_right_name_on_the_wrong_axis_is_false_and_missed() -> None:
    found = score_report(make_truth(HIDDEN_LINE), make_report(gy=[make_step("sinusoidal")]))
    assert not found.right
    assert [(name.axis, name.effect) for name in found.false] == [("gy", "sinusoidal")]
    assert [(name.axis, name.effect) for name in found.missed] == [("gz", "sinusoidal")]
    assert found.confused == (("sinusoidal", "(agrees)"),)


def test_wrong_name_is_counted_as_confusion() -> None:
    found = score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("narrowband")]))
    assert found.confused == (("sinusoidal", "narrowband"),)
    assert len(found.false) == len(found.missed) == 1


def test_case_with_right_and_false_name_is_not_right() -> None:
    found = score_report(
        make_truth(HIDDEN_LINE), make_report(gz=[make_step("sinusoidal")], ax=[make_step("outliers", confidence=0.6)])
    )
    assert not found.right
    assert not found.missed
    assert [name.confidence for name in found.false] == [0.6]


def test_name_given_twice_is_false_once() -> None:
    found = score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("sinusoidal"), make_step("sinusoidal")]))
    assert [name.right for name in found.names] == [True, False]


def test_changed_sizes_are_not_names() -> None:
    found = score_report(
        make_truth(HIDDEN_LINE), make_report(gz=[make_step("angle_random_walk", "retuned"), make_step("sinusoidal")])
    )
    assert found.right
    assert found.retuned == 1
    missed = score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("angle_random_walk", "retuned")]))
    assert missed.confused == (("sinusoidal", "(retuned)"),)


def test_leak_needs_its_source() -> None:
    leak = make_hidden_effect("gx", "cross_axis", source="gy", coefficient=0.01)
    assert score_report(make_truth(leak), make_report(gx=[make_step("cross_axis", source="gy")])).right
    assert not score_report(make_truth(leak), make_report(gx=[make_step("cross_axis", source="gz")])).right
    assert not score_report(make_truth(leak), make_report(gy=[make_step("cross_axis", source="gx")])).right


def test_clock_error_may_be_named_on_any_axis_and_on_several() -> None:
    wrong_clock = make_hidden_effect("gx", "sample_rate_error", ratio=1.01)
    axes = {"gy": [make_step("sample_rate_error", ratio=(1.0, 1.02))], "az": [make_step("sample_rate_error")]}
    found = score_report(make_truth(wrong_clock), make_report(more=axes))
    assert found.right
    assert found.coverage == (("sample_rate_error", "ratio", True),)
    assert not score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("sinusoidal")], more=axes)).right


def test_pair_on_one_axis_needs_both_names() -> None:
    bias_step = make_hidden_effect("gz", "bias_step", time=10.0, height=1.0)
    both = make_report(gz=[make_step("bias_step"), make_step("sinusoidal")])
    assert score_report(make_truth(HIDDEN_LINE, bias_step), both).right
    half = score_report(
        make_truth(HIDDEN_LINE, bias_step), make_report("partly_explained", ("psd",), gz=[make_step("bias_step")])
    )
    assert not half.right
    assert not half.closed
    assert set(half.confused) == {("bias_step", "bias_step"), ("sinusoidal", "(partly_explained)")}


def test_coverage_of_phase_is_periodic() -> None:
    turned = make_report(gz=[make_step("sinusoidal", phase=(6.3, 6.5))])
    assert score_report(make_truth(HIDDEN_LINE), turned).coverage[0][2]
    wrong = make_report(gz=[make_step("sinusoidal", phase=(3.0, 3.5))])
    assert not score_report(make_truth(HIDDEN_LINE), wrong).coverage[0][2]


def test_recording_without_hidden_effect() -> None:
    assert score_report(make_truth(), make_report("agrees")).right
    assert not score_report(make_truth(), make_report(gx=[make_step("bias_step")])).right
    assert not score_report(make_truth(), None, 3).right


@pytest.mark.parametrize(
    ("verdict", "names", "honest", "false"),
    [
        ("unexplained", [], True, 0),
        ("partly_explained", ["narrowband"], True, 1),
        ("explained", ["narrowband"], False, 1),
        ("agrees", [], False, 0),
    ],
)
def test_answers_to_a_foreign_effect(verdict: str, names: list[str], honest: bool, false: int) -> None:
    found = score_report(make_truth(foreign="chirp"), make_report(verdict, gz=[make_step(name) for name in names]))
    assert found.right == found.honest == honest
    assert len(found.false) == false


def test_parts_of_a_foreign_effect_are_right_on_its_axis() -> None:
    parts = [make_step("exponentially_correlated"), make_step("exponentially_correlated")]
    assert score_report(make_truth(foreign="two_correlated"), make_report(gz=parts)).right
    assert not score_report(make_truth(foreign="two_correlated"), make_report(gx=parts)).right


def test_outcome_is_unchanged_by_writing_and_reading(tmp_path: Path) -> None:
    found = score_report(
        make_truth(HIDDEN_LINE),
        make_report(gz=[make_step("narrowband"), make_step("sinusoidal", amplitude=(0.9, 1.1))]),
    )
    file = tmp_path / "results.jsonl"
    file.write_text(json.dumps({"key": "k", **found.json()}) + "\n")
    assert run.read_outcomes(file) == [found]


def test_continued_run_skips_stored_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def run_without_program(job: run.Job, in_process: bool, keep: Path | None) -> Outcome:
        ran.append(job.key)
        return score_report(make_truth(), make_report("agrees"))

    monkeypatch.setattr(run, "run_job", run_without_program)
    todo = run.make_jobs("nulls", "plain", range(2), 600.0)
    file = tmp_path / "results.jsonl"
    assert len(list(run.run_all(todo[:3], file, 1))) == 3
    assert len(list(run.run_all(todo, file, 1))) == 1
    assert ran == [job.key for job in todo]
    assert len(run.read_outcomes(file)) == 4


def test_sets_and_their_cases() -> None:
    assert len(run.make_jobs("singles", "faint", range(3), 3600.0)) == 3 * len(cases.SINGLES)
    assert {job.baseline for job in run.make_jobs("off", "plain", range(1), 3600.0)} == {"off"}
    assert {(job.axes, job.seconds) for job in run.make_jobs("nulls", "plain", range(1), 3600.0)} == {
        (6, 600.0),
        (1, 3600.0),
    }
    assert [job.name for job in run.make_jobs("singles", "plain", range(1), 60.0, ["outliers"])] == ["outliers"]
    with pytest.raises(ValueError, match="no set"):
        run.make_jobs("everything", "plain", range(1), 60.0)


def test_shares() -> None:
    assert tables.format_share(0, 300) == "0.0 % (0.0–1.3) 0 of 300"
    assert tables.format_share(98, 100) == "98.0 % (93.0–99.4) 98 of 100"
    assert tables.format_share(0, 0) == "—"


def test_tables_contain_the_counts() -> None:
    outcomes = [
        score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("sinusoidal", amplitude=(0.9, 1.1))])),
        score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("narrowband", confidence=0.97)])),
        score_report(make_truth(), make_report("agrees")),
        score_report(make_truth(foreign="chirp"), make_report("unexplained", ("psd",), gz=[])),
    ]
    text = tables.format_report(outcomes)
    assert "| single plain, exact baseline | 50.0 % (9.5–90.5) 1 of 2 |" in text
    assert "| sinusoidal | 1 | 1 narrowband |" in text
    assert "| sinusoidal | amplitude | 100.0 % (20.7–100.0) 1 of 1 |" in text
    assert "that are wrong, of all names: 50.0 % (9.5–90.5) 1 of 2." in text
    assert "| sinusoidal plain exact | 0 | gz narrowband | 0.97 |" in text
    assert "| foreign, exact baseline | 100.0 %" in text


def test_run_gives_the_program_files_and_reads_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files: list[str] = []

    def program() -> None:
        _, command, recording, option, model, _, out, _, seed = sys.argv
        assert (command, option, seed) == ("reconcile", "--model", "3")
        files.extend(sorted(path.name for path in Path(recording).parent.iterdir()))
        assert "angle_random_walk" in Path(model).read_text()
        Path(out).mkdir()
        (Path(out) / "report.json").write_text(json.dumps(make_report("agrees")))
        raise SystemExit(0)

    monkeypatch.setattr("monitor.cli.main", program)
    found = run.run_job(run.Job("null", "plain", 3, 10.0), in_process=True, keep=tmp_path)
    assert found.right
    assert files == ["model.toml", "recording.npz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "null_plain_3_10s_100Hz_6_exact",
        "null_plain_3_10s_100Hz_6_exact.truth.json",
    ]


def test_run_ended_by_a_signal_raises_keyboard_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    def program() -> None:
        raise SystemExit(143)

    monkeypatch.setattr("monitor.cli.main", program)
    with pytest.raises(KeyboardInterrupt, match="143"):
        run.run_job(run.Job("null", "plain", 3, 10.0), in_process=True)


def test_failed_run_prints_the_output_of_the_program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def program() -> None:
        print("imu-monitor: no", file=sys.stderr)
        raise SystemExit(2)

    monkeypatch.setattr("monitor.cli.main", program)
    found = run.run_job(run.Job("null", "plain", 3, 10.0), in_process=True)
    assert (found.exit_status, found.verdict, found.right) == (2, "", False)
    assert "exit status 2: imu-monitor: no" in capsys.readouterr().err


def test_power_curve_and_reliability_by_size_and_confidence() -> None:
    content = {**make_truth(HIDDEN_LINE), "size": 0.5}
    found = score_report(content, make_report(gz=[make_step("sinusoidal", confidence=0.95)]))
    wrong = score_report(content, make_report(gz=[make_step("narrowband", confidence=0.6)]))
    plain = score_report(make_truth(HIDDEN_LINE), make_report(gz=[make_step("sinusoidal", confidence=0.97)]))
    text = tables.format_report([found, wrong, plain])
    assert "| identifiable singles | 50.0 % (9.5–90.5) 1 of 2 |" in text
    assert "| sinusoidal | 1 of 2 |" in text  # the recording without a factor on the size is not part of the curve
    rows = {line.split(" | ")[0]: line.split(" | ")[1:] for line in text.splitlines()}
    assert rows["| 0.9–0.99"] == ["0.960", "100.0 % (34.2–100.0) 2 of 2 |"]
    assert rows["| 0.5–0.8"] == ["0.600", "0.0 % (0.0–79.3) 0 of 1 |"]


def test_set_all_has_sizes_only_for_hidden_effects() -> None:
    todo = run.make_jobs("all", "plain", range(1), 600.0, sizes=(0.25, 1.0))
    assert {job.name for job in todo} == {*cases.SINGLES, *cases.PAIRS, *cases.FOREIGN, "null"}
    assert {job.name for job in todo if job.sizes is None} == {*cases.FOREIGN, "null"}
    assert len({job.key for job in todo}) == len(todo)


@pytest.mark.parametrize("name", ["bias_step", "noise_step", "saturation", "resolution"])
def test_factor_on_the_size_changes_only_the_size(name: str) -> None:
    plain = cases.make_case(name, seed=1, seconds=600.0, axes=1)
    half = cases.make_case(name, seed=1, seconds=600.0, axes=1, sizes=(0.5, 0.5))
    whole, part = plain.truth["hidden"][0], half.truth["hidden"][0]
    size = recipes.RECIPES[name].size
    assert half.truth["size"] == pytest.approx(0.5)
    assert {k for k, v in whole["parameters"].items() if part["parameters"][k] != v} == {size}
    if name == "bias_step":
        assert part["parameters"][size] == pytest.approx(0.5 * whole["parameters"][size])
        assert part["gain"] < 0.5 * whole["gain"]
