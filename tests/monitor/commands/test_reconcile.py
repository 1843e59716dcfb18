"""Tests of ``reconcile`` with three recordings that share a spectral line, of which one also has a step."""

import json
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import ConfigError, NotReady, RecordingError
from monitor.cli import main
from monitor.commands import reconcile, simulate
from monitor.commands.reconcile import compare_recordings, unique_recording_names, write_report
from monitor.noise.effects import AngleRandomWalk, BiasInstability, BiasStep, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import Reconciliation
from tests.monitor.reconcile import samples

pytest.importorskip("jinja2")

KNOWN_MODEL = NoiseModel({"gz": (AngleRandomWalk(N=1.5e-4), BiasInstability(B=4e-5))}, 100.0)
LINE_MODEL = NoiseModel({"gz": (Sinusoidal(amplitude=1.5e-4, frequency=17.3),)})
STEP_MODEL = NoiseModel({"gz": (BiasStep(time=350.0, height=1e-3),)})
REPORT_FILES = ["report.html", "report.json", "model.toml"]


def simulate_recording(path: Path, model: NoiseModel, seed: int, seconds: float = 600.0) -> Path:
    simulate.run_simulation(simulate.SimulationRequest(model, path, seconds, seed))
    return path


def run_command(*arguments: str | Path) -> tuple[int, str, str]:
    """Run the program and return its status, standard output and standard error."""
    out, err, kept, handler = StringIO(), StringIO(), sys.argv, signal.getsignal(signal.SIGTERM)
    sys.argv = ["imu-monitor", *(str(argument) for argument in arguments)]
    try:
        with redirect_stdout(out), redirect_stderr(err):
            main()
    except SystemExit as ended:
        return int(ended.code or 0), out.getvalue(), err.getvalue()
    finally:
        sys.argv = kept
        signal.signal(signal.SIGTERM, handler)
    return 0, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def reconciled_folder_and_output(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Reconcile the three recordings and return the report folder and the printed text."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "known.toml").write_text(KNOWN_MODEL.to_toml())
    paths = [
        simulate_recording(
            folder / f"run{k}.csv", KNOWN_MODEL + LINE_MODEL + (STEP_MODEL if k == 2 else NoiseModel()), k
        )
        for k in (1, 2, 3)
    ]
    status, output, errors = run_command("reconcile", *paths, "--model", folder / "known.toml", "--out", folder / "out")
    assert (status, errors) == (0, "")
    return folder / "out", output


def read_report(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "report.json").read_bytes()))


def test_common_line_and_single_step_are_reported(reconciled_folder_and_output: tuple[Path, str]) -> None:
    found = read_report(reconciled_folder_and_output[0])
    assert found["schema"] == "imu-monitor/reconcile-runs/1"
    assert (found["verdict"], found["fitted_to"]) == ("explained", None)
    assert [(effect["name"], effect["verdict"], effect["seconds"]) for effect in found["recordings"]] == [
        (name, "explained", 600.0) for name in ("run1", "run2", "run3")
    ]
    (line,) = found["axes"]["gz"]["common"]
    assert (line["effect"], line["kind"], line["recordings"]) == ("sinusoidal", "added", ["run1", "run2", "run3"])
    assert line["consistent"] is True
    assert 0.01 <= line["p"] <= 1.0
    for name, true in (("amplitude", 1.5e-4), ("frequency", 17.3)):
        pooled = line["parameters"][name]
        assert pooled["lo"] <= true <= pooled["hi"]
        widths = [estimate["parameters"][name] for estimate in line["each"].values()]
        assert pooled["hi"] - pooled["lo"] < min(effect["hi"] - effect["lo"] for effect in widths)
    (step,) = (effect for effect in found["axes"]["gz"]["single"] if effect["effect"] == "bias_step")
    assert step["recordings"] == ["run2"]
    assert step["parameters"]["time"]["lo"] <= 350.0 <= step["parameters"]["time"]["hi"]
    assert [(recording["run"], recording["meaning"]) for recording in step["absent"]] == [
        ("run1", "may_differ"),
        ("run3", "may_differ"),
    ]


def test_combined_model_has_the_line_but_not_the_step(reconciled_folder_and_output: tuple[Path, str]) -> None:
    model = NoiseModel.from_toml((reconciled_folder_and_output[0] / "model.toml").read_text())
    assert [effect.name for effect in model.effects["gz"]] == ["angle_random_walk", "bias_instability", "sinusoidal"]
    assert model.effects["gz"][:2] == KNOWN_MODEL.effects["gz"]


@pytest.mark.long
def test_every_recording_has_its_own_report(reconciled_folder_and_output: tuple[Path, str]) -> None:
    folder = reconciled_folder_and_output[0]
    assert sorted(path.name for path in folder.iterdir()) == sorted([*REPORT_FILES, "run1", "run2", "run3"])
    for run in ("run1", "run2", "run3"):
        assert {*REPORT_FILES} <= {path.name for path in (folder / run).iterdir()}
        assert read_report(folder / run)["schema"] == "imu-monitor/reconcile/1"
        assert f'href="{run}/report.html"' in (folder / "report.html").read_text()


def test_curves_for_rerun_are_written_only_for_a_difference(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    write_report(samples.explained(), tmp_path, "first")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["reconcile.rrd", *REPORT_FILES])
    write_report(samples.agrees(), tmp_path, "second")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(REPORT_FILES)


def test_printed_summary_agrees_with_the_report(reconciled_folder_and_output: tuple[Path, str]) -> None:
    output = " ".join(reconciled_folder_and_output[1].split())
    assert "explained 3 recordings were compared with the model. Common to all: sinusoidal (gz)." in output
    assert "In some only: bias step (gz)." in output
    assert "may differ" not in output  # the reasons are printed with --details


@pytest.mark.long
def test_without_a_model_the_terms_of_the_first_recording_are_used(tmp_path: Path) -> None:
    paths = tuple(
        simulate_recording(tmp_path / f"{name}.csv", KNOWN_MODEL + LINE_MODEL, seed, 200.0)
        for name, seed in (("a", 1), ("b", 2))
    )
    progress = []
    found = compare_recordings(
        paths, None, tmp_path / "out", report_progress=lambda what, _share: progress.append(what)
    )
    assert found.fitted_to == "a"
    first, second = (run.result for run in found.runs)
    assert first.fitted_first
    assert not second.fitted_first
    assert second.baseline == first.baseline == found.baseline
    assert second.notes[0] == "The model under test consists of the five noise terms of a."
    assert "five classic terms, fitted to a" in (tmp_path / "out" / "report.html").read_text()
    assert read_report(tmp_path / "out")["fitted_to"] == "a"
    reading = [what for what in progress if "reading" in what]
    assert list(dict.fromkeys(reading)) == ["a, 1 of 2: reading", "b, 2 of 2: reading"]
    assert progress[-1] == "writing"


def test_unusable_recording_is_left_out_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [
        simulate_recording(tmp_path / f"{name}.csv", KNOWN_MODEL, k, s)
        for k, (name, s) in enumerate((("a", 60), ("b", 60), ("short", 2)))
    ]
    found = compare_recordings(tuple(paths), KNOWN_MODEL, tmp_path / "out")
    assert [run.name for run in found.runs] == ["a", "b"]
    assert "200 samples" in found.without_result["short"]
    last = read_report(tmp_path / "out")["recordings"][-1]
    assert (last["name"], last["verdict"]) == ("short", None)
    assert "200 samples" in last["why"]


def test_at_least_two_usable_recordings_are_needed(tmp_path: Path) -> None:
    simulate_recording(tmp_path / "short.csv", KNOWN_MODEL, 1, 2.0)
    simulate_recording(tmp_path / "long.csv", KNOWN_MODEL, 2, 60.0)
    answer_file = tmp_path / "answer.json"
    paths = tmp_path / "short.csv", tmp_path / "long.csv"
    status, output, errors = run_command("reconcile", *paths, "--out", tmp_path / "out", "--json", answer_file)
    assert (status, output) == (3, "")
    assert errors.startswith(
        "imu-monitor: at least two recordings are needed for a comparison, but only 0 can be evaluated: short: "
    )
    answer = json.loads(answer_file.read_bytes())
    assert answer == read_report(tmp_path / "out")
    assert (answer["schema"], answer["verdict"]) == ("imu-monitor/reconcile-runs/1", None)
    assert not (tmp_path / "out" / "long").exists()  # the first recording, which should provide the model, is too short


def test_recording_names_are_file_names_made_unique(tmp_path: Path) -> None:
    paths = [Path("a/run.csv"), Path("b/run.csv.gz"), Path("c/RUN.NPZ"), Path("d/run-2.csv"), tmp_path / "segments"]
    assert list(unique_recording_names(paths)) == ["run", "run-2", "RUN", "run-2-2", "segments"]
    assert list(unique_recording_names([Path(".csv"), Path("x.parquet")])) == [".csv", "x"]


def test_invalid_request_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse_work(*_: object) -> Reconciliation:
        raise AssertionError("reconciliation was started")

    monkeypatch.setattr(reconcile, "reconcile_and_write_report", refuse_work)
    (tmp_path / "a.csv").touch()
    (tmp_path / "b").mkdir()
    a, b = tmp_path / "a.csv", tmp_path / "b"
    with pytest.raises(ConfigError, match=r"a\.csv: is given twice"):
        compare_recordings((a, tmp_path / "b" / ".." / "a.csv"), KNOWN_MODEL, tmp_path / "out")
    with pytest.raises(RecordingError, match=r"c\.csv: cannot be read"):
        compare_recordings((a, tmp_path / "c.csv"), KNOWN_MODEL, tmp_path / "out")
    with pytest.raises(ConfigError, match=r"--out: .*b is a recording"):
        compare_recordings((a, b), KNOWN_MODEL, tmp_path)
    assert not (tmp_path / "out").exists()


def test_single_recording_keeps_the_single_report(tmp_path: Path) -> None:
    path = simulate_recording(tmp_path / "a.csv", KNOWN_MODEL, 1, 60.0)
    (tmp_path / "known.toml").write_text(KNOWN_MODEL.to_toml())
    status, output, _ = run_command("reconcile", path, "--model", tmp_path / "known.toml", "--out", tmp_path / "out")
    assert status == 0
    assert output.startswith("● agrees The model agrees with the recording on one axis.\n6000 samples at 100 Hz, ")
    assert read_report(tmp_path / "out")["schema"] == "imu-monitor/reconcile/1"
    assert not [found for found in (tmp_path / "out").iterdir() if found.is_dir()]


def test_comparison_without_usable_recordings_is_refused(tmp_path: Path) -> None:
    paths = (
        simulate_recording(tmp_path / "s.csv", KNOWN_MODEL, 1, 2.0),
        simulate_recording(tmp_path / "t.csv", KNOWN_MODEL, 1, 2.0),
    )
    with pytest.raises(NotReady, match=r"0 can be evaluated: s: the recording has 200 samples"):
        compare_recordings(paths, None, tmp_path / "out")
    with pytest.raises(
        NotReady, match=r"0 can be evaluated: s: the recording has 200 samples.*; t: the recording has 200 samples"
    ):
        compare_recordings(paths, KNOWN_MODEL, tmp_path / "out")
