"""Tests that run the notebooks of the documentation whole, and check their results."""

from pathlib import Path
from typing import Any

import nbformat
import pytest
import yaml

import imu_monitor
from tests.support.notebooks import list_output_data, run_notebook

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
TRUE_NOISE = imu_monitor.load_model("consumer-mems").to_dict()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_valid_and_committed_without_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert 8 <= len(notebook.cells) <= 15
    assert notebook.metadata.keys() == {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in notebook.cells:
        assert cell.cell_type == "markdown" or (cell.outputs == [] and cell.execution_count is None)


@pytest.fixture
def temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make the current folder and the folder of temporary files empty folders, and return the latter."""
    folder = tmp_path / "temporary"
    for name in ("work", "temporary", "jupyter"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "jupyter"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "jupyter"))
    monkeypatch.chdir(tmp_path / "work")
    return folder


def run(name: str, expression: str, temporary_folder: Path) -> tuple[list[dict[str, str]], Any]:
    """Run a notebook, check that it leaves no file, and return its outputs and the value of an expression."""
    notebook, value = run_notebook(FOLDER / f"{name}.ipynb", expression)
    assert list(temporary_folder.iterdir()) == []
    assert list(Path.cwd().iterdir()) == []
    assert not [o for cell in notebook.cells for o in cell.get("outputs", ()) if o.get("name") == "stderr"]
    outputs = list_output_data(notebook)
    assert str(temporary_folder.parent) not in str(outputs)
    return outputs, value


@pytest.mark.long
def test_kalibr_file_contains_the_noise_of_the_simulated_sensor(temporary_folder: Path) -> None:
    outputs, (text, axes) = run("recording_to_kalibr", "[text, result.to_dict()['axes']]", temporary_folder)
    assert {"text/plain": text + "\n"} in outputs
    assert sum("<svg" in data.get("text/html", "") for data in outputs) == 1
    parameters = yaml.safe_load(text)
    assert parameters["rostopic"] == "/imu/data"
    for sensor in ("gyroscope", "accelerometer"):
        for symbol, name, effect in (
            ("N", "noise_density", "angle_random_walk"),
            ("K", "random_walk", "rate_random_walk"),
        ):
            found = [one["coefficients"][symbol] for axis, one in axes.items() if axis[0] == sensor[0]]
            worst = max(found, key=lambda one: one["value"])
            assert parameters[f"{sensor}_{name}"] == pytest.approx(worst["value"], rel=1e-6)
            true = TRUE_NOISE[f"{sensor[0]}x"][effect][symbol]
            assert all(one["lo"] <= true <= one["hi"] for one in found)


@pytest.mark.long
def test_live_estimates_become_certain_and_agree_with_the_simulated_sensor(temporary_folder: Path) -> None:
    expression = (
        "[[message['N'] for message in get_estimates()], estimate['gz'].coefficients['N'].value, daemon.returncode]"
    )
    outputs, (published, computed, status) = run("live_data_over_zenoh", expression, temporary_folder)
    assert status == 0
    assert sum("image/png" in data for data in outputs) == 1
    assert sum("<svg" in data.get("text/html", "") for data in outputs) == 1
    last = published[-1]
    assert last["hi"] - last["lo"] < 0.5 * last["value"]  # the first intervals are wider
    true = TRUE_NOISE["gz"]["angle_random_walk"]["N"]
    assert last["value"] == pytest.approx(true, rel=0.2)
    assert computed == pytest.approx(last["value"], rel=0.2)


@pytest.mark.long
def test_vibration_is_found_and_the_second_simulation_agrees(temporary_folder: Path) -> None:
    expression = (
        "[found.verdict, [[effect.name, getattr(effect, 'frequency', None)] for _, effect in found.model],"
        " [float(imu_monitor.analyze(one)['gz'].allan.deviation[1]) for one in (measurement, simulation, improved)]]"
    )
    outputs, (verdict, effects, deviations) = run("simulation_against_measurement", expression, temporary_folder)
    assert verdict == "explained"
    assert [frequency for name, frequency in effects if name == "sinusoidal"] == [pytest.approx(17.0, abs=1e-3)]
    measured, simulated, improved = deviations
    assert measured > 1.5 * simulated
    assert improved == pytest.approx(measured, rel=0.03)
    assert sum("image/png" in data for data in outputs) == 2
    assert sum("<svg" in data.get("text/html", "") for data in outputs) == 1
