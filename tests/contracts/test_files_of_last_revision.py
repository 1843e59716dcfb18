"""Tests that files of the revision before the redesign can be read and give the same numbers as in that revision.

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


def assert_same(new: object, earlier: object, where: str = "$", rel: float = 1e-6) -> None:
    """Assert that the new JSON contains all keys, numbers and names of the earlier JSON. Sentences may differ."""
    if isinstance(earlier, dict):
        assert isinstance(new, dict), where
        missing = earlier.keys() - new.keys()
        assert not missing, f"{where}: {missing}"
        for key, value in earlier.items():
            assert_same(new[key], value, f"{where}.{key}", rel)
    elif isinstance(earlier, list):
        assert isinstance(new, list), where
        assert len(new) == len(earlier), where
        for i, (a, b) in enumerate(zip(new, earlier, strict=True)):
            assert_same(a, b, f"{where}[{i}]", rel)
    elif isinstance(earlier, float):
        assert new == pytest.approx(earlier, rel=rel, abs=1e-11), where
    elif isinstance(earlier, str) and " " in earlier:
        assert isinstance(new, str), where
    else:
        assert new == earlier, where


def assert_same_json(path: Path, name: str) -> None:
    assert_same(json.loads(path.read_text()), json.loads((EXPECTED / name).read_text()))


def assert_same_effects(path: Path, name: str) -> None:
    """Compare the decisions and the effects with their parameters. Later revisions have other diagnostics."""

    def extract_effects(report: Any) -> Any:
        steps = {axis: axis_report["steps"] for axis, axis_report in report["axes"].items()}
        return {
            "verdict": report["verdict"],
            "axes": {axis: axis_report["verdict"] for axis, axis_report in report["axes"].items()},
            "steps": {
                axis: [[step["kind"], step["effect"], step["parameters"]] for step in axis_steps]
                for axis, axis_steps in steps.items()
            },
        }

    assert_same(
        extract_effects(json.loads(path.read_text())),
        extract_effects(json.loads((EXPECTED / name).read_text())),
        rel=1e-4,
    )


def test_configuration_is_valid(files):
    assert exit_status("check", files / "service.toml") == 0


@pytest.mark.parametrize("suffix", ["csv", "npz", "parquet"])
def test_analysis_of_a_recording_is_the_same(files, suffix):
    out = files / "out.json"
    assert exit_status("analyze", files / f"recording.{suffix}", "--json", out) == 0
    assert_same_json(out, "analyze-recording.json")


def test_analysis_of_a_recorder_segment_is_the_same(files):
    out = files / "out.json"
    assert exit_status("analyze", files / "data/bench", "--json", out) == 0
    assert_same_json(out, "analyze-segments.json")


def test_history_is_the_same(files):
    out = files / "out.json"
    assert exit_status("history", files / "data", "--from", "2026-11-22", "--to", "2026-11-24", "--json", out) == 0
    assert_same_json(out, "history.json")


def test_simulated_samples_and_effects_found_by_reconcile_are_the_same(files):
    recording, out = files / "simulated.npz", files / "out.json"
    assert (
        exit_status("simulate", files / "model.toml", "--seconds", 20, "--rate", 20, "--seed", 4, "--out", recording)
        == 0
    )
    assert exit_status("analyze", recording, "--json", out) == 0
    assert_same_json(out, "analyze-simulated-model.json")
    assert (
        exit_status("simulate", files / "model.toml", "--seconds", 300, "--rate", 20, "--seed", 4, "--out", recording)
        == 0
    )
    report = files / "report"
    assert exit_status("reconcile", recording, "--model", files / "plain.toml", "--out", report, "--json", out) == 0
    assert_same_effects(out, "reconcile.json")
    # the model that the last revision wrote can be read, and agrees with the recording like the new one
    agreement = files / "again.json"
    options = ("--model", EXPECTED / "reconcile-model.toml", "--out", files / "report2", "--json", agreement)
    assert exit_status("reconcile", recording, *options) == 0
    assert json.loads(agreement.read_text())["verdict"] == "agrees"


def test_prediction_of_a_thermal_model_is_the_same(files):
    out = files / "out.json"
    temperature = files / "temperature.csv"
    assert exit_status("thermal", "fit", temperature, "--out", files / "new.json", "--json", out) == 0
    assert_same_json(out, "thermal-fit.json")
    assert exit_status("thermal", "predict", temperature, "--model", files / "thermal.json", "--json", out) == 0
    assert_same_json(out, "thermal-predict.json")


def test_exported_values_of_an_analysis_are_the_same(files):
    out = files / "imu.yaml"
    assert exit_status("export", EXPECTED / "analyze-recording.json", "--format", "kalibr", "--out", out) == 0

    def read_values(path):
        pairs = (line.split("#")[0].partition(":") for line in path.read_text().splitlines())
        return {key: value.strip() for key, _, value in pairs if value.strip()}

    assert read_values(out) == read_values(EXPECTED / "kalibr.yaml")


def test_all_formats_contain_the_same_samples(files):
    first, *others = (load_samples(files / f"recording.{suffix}") for suffix in ("npz", "csv", "parquet"))
    for other in others:
        np.testing.assert_allclose(other.values, first.values, rtol=1e-6, equal_nan=True)
