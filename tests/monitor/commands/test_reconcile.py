"""Several recordings through the command: three of one sensor, of which all have a line and one has a step."""

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
from monitor.commands.reconcile import RecordingsComparisonRequest, compare_recordings, unique_recording_names
from monitor.noise.effects import AngleRandomWalk, BiasInstability, BiasStep, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import Reconciliation

pytest.importorskip("jinja2")

KNOWN = NoiseModel({"gz": (AngleRandomWalk(N=1.5e-4), BiasInstability(B=4e-5))}, 100.0)
LINE = NoiseModel({"gz": (Sinusoidal(amplitude=1.5e-4, frequency=17.3),)})
STEP = NoiseModel({"gz": (BiasStep(time=350.0, height=1e-3),)})
FILES = ["report.html", "report.json", "model.toml"]


def recorded(path: Path, model: NoiseModel, seed: int, seconds: float = 600.0) -> Path:
    simulate.run_simulation(simulate.SimulationRequest(model, path, seconds, seed))
    return path


def command(*arguments: str | Path) -> tuple[int, str, str]:
    """The program itself: status, standard output, standard error."""
    out, err, kept, handler = StringIO(), StringIO(), sys.argv, signal.getsignal(signal.SIGTERM)
    sys.argv = ["imu-monitor", *(str(one) for one in arguments)]
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
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of three recordings that were compared with their model, and what was printed."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "known.toml").write_text(KNOWN.to_toml())
    paths = [recorded(folder / f"run{k}.csv", KNOWN + LINE + (STEP if k == 2 else NoiseModel()), k) for k in (1, 2, 3)]
    status, said, complaint = command("reconcile", *paths, "--model", folder / "known.toml", "--out", folder / "out")
    assert (status, complaint) == (0, "")
    return folder / "out", said


def report(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "report.json").read_bytes()))


def test_the_line_is_common_and_the_step_is_of_one(compared: tuple[Path, str]) -> None:
    found = report(compared[0])
    assert found["schema"] == "imu-monitor/reconcile-runs/1"
    assert (found["verdict"], found["fitted_to"]) == ("explained", None)
    assert [(one["name"], one["verdict"], one["seconds"]) for one in found["recordings"]] == [
        (name, "explained", 600.0) for name in ("run1", "run2", "run3")
    ]
    (line,) = found["axes"]["gz"]["common"]
    assert (line["effect"], line["kind"], line["recordings"]) == ("sinusoidal", "added", ["run1", "run2", "run3"])
    assert line["consistent"] is True
    assert 0.01 <= line["p"] <= 1.0
    for name, true in (("amplitude", 1.5e-4), ("frequency", 17.3)):
        pooled = line["parameters"][name]
        assert pooled["lo"] <= true <= pooled["hi"]
        widths = [each["parameters"][name] for each in line["each"].values()]
        assert pooled["hi"] - pooled["lo"] < min(one["hi"] - one["lo"] for one in widths)
    (step,) = (one for one in found["axes"]["gz"]["single"] if one["effect"] == "bias_step")
    assert step["recordings"] == ["run2"]
    assert step["parameters"]["time"]["lo"] <= 350.0 <= step["parameters"]["time"]["hi"]
    assert [(one["run"], one["meaning"]) for one in step["absent"]] == [("run1", "may_differ"), ("run3", "may_differ")]


def test_the_model_has_the_line_and_not_the_step(compared: tuple[Path, str]) -> None:
    model = NoiseModel.from_toml((compared[0] / "model.toml").read_text())
    assert [effect.name for effect in model.effects["gz"]] == ["angle_random_walk", "bias_instability", "sinusoidal"]
    assert model.effects["gz"][:2] == KNOWN.effects["gz"]


@pytest.mark.long
def test_every_recording_has_its_own_report(compared: tuple[Path, str]) -> None:
    folder = compared[0]
    assert sorted(path.name for path in folder.iterdir()) == sorted([*FILES, "run1", "run2", "run3"])
    for run in ("run1", "run2", "run3"):
        assert {*FILES} <= {path.name for path in (folder / run).iterdir()}
        assert report(folder / run)["schema"] == "imu-monitor/reconcile/1"
        assert f'href="{run}/report.html"' in (folder / "report.html").read_text()


def test_the_terminal_tells_the_same(compared: tuple[Path, str]) -> None:
    said = " ".join(compared[1].split())
    assert "explained 3 recordings were compared with the model. Common to all: sinusoidal (gz)." in said
    assert "added bias step" in said
    assert "not in run3: may differ: an effect that happens once need not happen in another recording" in said


@pytest.mark.long
def test_without_a_model_that_of_the_first_is_for_all(tmp_path: Path) -> None:
    paths = tuple(recorded(tmp_path / f"{name}.csv", KNOWN + LINE, seed, 200.0) for name, seed in (("a", 1), ("b", 2)))
    told = []
    found = compare_recordings(
        RecordingsComparisonRequest(paths, None, tmp_path / "out"), lambda what, _share: told.append(what)
    )
    assert found.fitted_to == "a"
    first, second = (run.result for run in found.runs)
    assert first.fitted_first
    assert not second.fitted_first
    assert second.baseline == first.baseline == found.baseline
    assert second.notes[0] == "The model under test consists of the five noise terms of a."
    assert "five classic terms, fitted to a" in (tmp_path / "out" / "report.html").read_text()
    assert report(tmp_path / "out")["fitted_to"] == "a"
    assert [what for what in told if "reading" in what] == ["a, 1 of 2: reading", "b, 2 of 2: reading"]
    assert told[-1] == "writing"


def test_a_recording_without_an_answer_is_left_out_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [
        recorded(tmp_path / f"{name}.csv", KNOWN, k, s)
        for k, (name, s) in enumerate((("a", 60), ("b", 60), ("short", 2)))
    ]
    found = compare_recordings(RecordingsComparisonRequest(tuple(paths), KNOWN, tmp_path / "out"))
    assert [run.name for run in found.runs] == ["a", "b"]
    assert "200 samples" in found.without_result["short"]
    last = report(tmp_path / "out")["recordings"][-1]
    assert (last["name"], last["verdict"]) == ("short", None)
    assert "200 samples" in last["why"]


def test_two_answers_at_least_are_needed(tmp_path: Path) -> None:
    recorded(tmp_path / "short.csv", KNOWN, 1, 2.0)
    recorded(tmp_path / "long.csv", KNOWN, 2, 60.0)
    answer_file = tmp_path / "answer.json"
    paths = tmp_path / "short.csv", tmp_path / "long.csv"
    status, said, complaint = command("reconcile", *paths, "--out", tmp_path / "out", "--json", answer_file)
    assert (status, said) == (3, "")
    assert complaint.startswith(
        "imu-monitor: at least two recordings are needed for a comparison, but only 0 can be evaluated: short: "
    )
    answer = json.loads(answer_file.read_bytes())
    assert answer == report(tmp_path / "out")
    assert (answer["schema"], answer["verdict"]) == ("imu-monitor/reconcile-runs/1", None)
    assert not (tmp_path / "out" / "long").exists()  # the model was to be fitted to the first


def test_names_are_those_of_the_files_and_differ(tmp_path: Path) -> None:
    paths = [Path("a/run.csv"), Path("b/run.csv.gz"), Path("c/RUN.NPZ"), Path("d/run-2.csv"), tmp_path / "segments"]
    assert list(unique_recording_names(paths)) == ["run", "run-2", "RUN", "run-2-2", "segments"]
    assert list(unique_recording_names([Path(".csv"), Path("x.parquet")])) == [".csv", "x"]


def test_what_cannot_be_compared_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def worked(*_: object) -> Reconciliation:
        raise AssertionError("worked")

    monkeypatch.setattr(reconcile, "reconcile_and_write_report", worked)
    (tmp_path / "a.csv").touch()
    (tmp_path / "b").mkdir()
    a, b = tmp_path / "a.csv", tmp_path / "b"
    with pytest.raises(ConfigError, match=r"a\.csv: is given twice"):
        compare_recordings(RecordingsComparisonRequest((a, tmp_path / "b" / ".." / "a.csv"), KNOWN, tmp_path / "out"))
    with pytest.raises(RecordingError, match=r"c\.csv: cannot be read"):
        compare_recordings(RecordingsComparisonRequest((a, tmp_path / "c.csv"), KNOWN, tmp_path / "out"))
    with pytest.raises(ConfigError, match=r"--out: .*b is a recording"):
        compare_recordings(RecordingsComparisonRequest((a, b), KNOWN, tmp_path))
    assert not (tmp_path / "out").exists()


def test_one_recording_is_reported_as_before(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.csv", KNOWN, 1, 60.0)
    (tmp_path / "known.toml").write_text(KNOWN.to_toml())
    status, said, _ = command("reconcile", path, "--model", tmp_path / "known.toml", "--out", tmp_path / "out")
    assert status == 0
    assert said.startswith("● agrees The model agrees with the recording on one axis.\n6000 samples at 100 Hz, ")
    assert report(tmp_path / "out")["schema"] == "imu-monitor/reconcile/1"
    assert not [found for found in (tmp_path / "out").iterdir() if found.is_dir()]


def test_the_first_without_an_answer_ends_it_where_the_model_was_to_be_its(tmp_path: Path) -> None:
    paths = (recorded(tmp_path / "s.csv", KNOWN, 1, 2.0), recorded(tmp_path / "t.csv", KNOWN, 1, 2.0))
    with pytest.raises(NotReady, match=r"0 can be evaluated: s: the recording has 200 samples"):
        compare_recordings(RecordingsComparisonRequest(paths, None, tmp_path / "out"))
    with pytest.raises(
        NotReady, match=r"0 can be evaluated: s: the recording has 200 samples.*; t: the recording has 200 samples"
    ):
        compare_recordings(RecordingsComparisonRequest(paths, KNOWN, tmp_path / "out"))
