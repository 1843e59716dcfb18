"""Files that the revision before the redesign wrote are read, and give the numbers that this revision found in them.

``files_of_last_revision`` holds a configuration, recordings in three formats, the recorder's segment and history of a
simulated device, a noise model and a thermal model. ``expected`` holds the JSON of the commands of that revision.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.recordings import load_samples
from tests.support.program import exit_status

FILES = Path(__file__).with_name("files_of_last_revision")
EXPECTED = FILES / "expected"


@pytest.fixture
def files(tmp_path):
    """Return a copy of the files, because reading a history opens its database for writing."""
    return Path(shutil.copytree(FILES, tmp_path / "files"))


def assert_same(now: object, before: object, where: str = "$", rel: float = 1e-6) -> None:
    """Assert that all keys, numbers and names of the earlier JSON are in the new JSON. Sentences may be reworded."""
    if isinstance(before, dict):
        assert isinstance(now, dict), where
        missing = before.keys() - now.keys()
        assert not missing, f"{where}: {missing}"
        for key, value in before.items():
            assert_same(now[key], value, f"{where}.{key}", rel)
    elif isinstance(before, list):
        assert isinstance(now, list), where
        assert len(now) == len(before), where
        for i, (a, b) in enumerate(zip(now, before, strict=True)):
            assert_same(a, b, f"{where}[{i}]", rel)
    elif isinstance(before, float):
        assert now == pytest.approx(before, rel=rel, abs=1e-11), where
    elif isinstance(before, str) and " " in before:
        assert isinstance(now, str), where
    else:
        assert now == before, where


def assert_json(path: Path, name: str) -> None:
    assert_same(json.loads(path.read_text()), json.loads((EXPECTED / name).read_text()))


def assert_found_effects(path: Path, name: str) -> None:
    """Compare the decisions and the effects with their parameters. Later revisions have other diagnostics."""

    def effects(report: Any) -> Any:
        steps = {axis: one["steps"] for axis, one in report["axes"].items()}
        return {
            "verdict": report["verdict"],
            "axes": {axis: one["verdict"] for axis, one in report["axes"].items()},
            "steps": {axis: [[s["kind"], s["effect"], s["parameters"]] for s in each] for axis, each in steps.items()},
        }

    assert_same(effects(json.loads(path.read_text())), effects(json.loads((EXPECTED / name).read_text())), rel=1e-4)


def test_the_configuration_is_valid(files):
    assert exit_status("check", files / "service.toml") == 0


@pytest.mark.parametrize("suffix", ["csv", "npz", "parquet"])
def test_a_recording_gives_the_same_analysis(files, suffix):
    out = files / "out.json"
    assert exit_status("analyze", files / f"recording.{suffix}", "--json", out) == 0
    assert_json(out, "analyze-recording.json")


def test_a_segment_of_the_recorder_gives_the_same_analysis(files):
    out = files / "out.json"
    assert exit_status("analyze", files / "data/bench", "--json", out) == 0
    assert_json(out, "analyze-segments.json")


def test_the_history_is_the_same(files):
    out = files / "out.json"
    assert exit_status("history", files / "data", "--from", "2026-11-22", "--to", "2026-11-24", "--json", out) == 0
    assert_json(out, "history.json")


def test_a_model_draws_the_same_samples_and_reconcile_finds_the_same_effects(files):
    recording, out = files / "simulated.npz", files / "out.json"
    assert (
        exit_status("simulate", files / "model.toml", "--seconds", 20, "--rate", 20, "--seed", 4, "--out", recording)
        == 0
    )
    assert exit_status("analyze", recording, "--json", out) == 0
    assert_json(out, "analyze-simulated-model.json")
    assert (
        exit_status("simulate", files / "model.toml", "--seconds", 300, "--rate", 20, "--seed", 4, "--out", recording)
        == 0
    )
    report = files / "report"
    assert exit_status("reconcile", recording, "--model", files / "plain.toml", "--out", report, "--json", out) == 0
    assert_found_effects(out, "reconcile.json")
    # the model that the last revision wrote is read, and agrees with the recording as the new one does
    again = files / "again.json"
    options = ("--model", EXPECTED / "reconcile-model.toml", "--out", files / "report2", "--json", again)
    assert exit_status("reconcile", recording, *options) == 0
    assert json.loads(again.read_text())["verdict"] == "agrees"


def test_a_thermal_model_predicts_the_same(files):
    out = files / "out.json"
    temperature = files / "temperature.csv"
    assert exit_status("thermal", "fit", temperature, "--out", files / "new.json", "--json", out) == 0
    assert_json(out, "thermal-fit.json")
    assert exit_status("thermal", "predict", temperature, "--model", files / "thermal.json", "--json", out) == 0
    assert_json(out, "thermal-predict.json")


def test_the_result_of_an_analysis_is_exported_with_the_same_values(files):
    out = files / "imu.yaml"
    assert exit_status("export", EXPECTED / "analyze-recording.json", "--format", "kalibr", "--out", out) == 0

    def values(path):
        pairs = (line.split("#")[0].partition(":") for line in path.read_text().splitlines())
        return {key: value.strip() for key, _, value in pairs if value.strip()}

    assert values(out) == values(EXPECTED / "kalibr.yaml")


def test_all_formats_hold_the_same_samples(files):
    first, *others = (load_samples(files / f"recording.{suffix}") for suffix in ("npz", "csv", "parquet"))
    for other in others:
        np.testing.assert_allclose(other.values, first.values, rtol=1e-6, equal_nan=True)
