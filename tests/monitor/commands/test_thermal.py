"""Tests of the commands ``thermal fit`` and ``thermal predict``: tables, JSON, model files and errors."""

import json
from pathlib import Path

import numpy as np
import pytest

from monitor.commands import thermal
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, apply_lag, simulate_temperature
from tests.support.program import exit_status

HOURS = 36


def write_recording(path: Path, seed: int, lag_h: float = 2.0, offset: float = 0.0) -> Path:
    """Write a recording of gz with one sample per minute."""
    rng = np.random.default_rng(seed)
    temperature_c = simulate_temperature(HOURS, rng)
    bias = BIAS_SLOPE * apply_lag(temperature_c, lag_h) + offset + 2e-6 * rng.standard_normal(temperature_c.size)
    t = 60.0 * np.arange(60 * HOURS)
    np.savez(path, t=t, gz=bias[-t.size :], temp=temperature_c[-t.size :])
    return path


@pytest.mark.long
def test_model_of_one_recording_predicts_another(tmp_path, capsys):
    first, second = write_recording(tmp_path / "a.npz", 1), write_recording(tmp_path / "b.npz", 2, offset=1e-4)
    model, plot, out = tmp_path / "m.json", tmp_path / "a.png", tmp_path / "out.json"
    fit = ("thermal", "fit", first, "--interval", "1h", "--out", model, "--plot", plot, "--json", out)
    assert exit_status(*fit, "--units", "si") == 0
    text = capsys.readouterr().out
    assert "difference 1" in text
    assert "rad/s" in text
    assert "°/h" not in text
    found = json.loads(out.read_bytes())
    assert found["schema"] == "imu-monitor/thermal-fit/1"
    gz = found["axes"]["gz"]
    assert gz["slope"] == pytest.approx(BIAS_SLOPE, rel=0.1)
    assert gz["time_constants"][0] == pytest.approx(7200.0, rel=0.3)
    assert gz["equation"]["a"][0] == pytest.approx(-np.exp(-found["interval"] / gz["time_constants"][0]))
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert exit_status("thermal", "predict", second, "--model", model, "--json", out, "--plot", plot) == 0
    found = json.loads(out.read_bytes())
    assert found["schema"] == "imu-monitor/thermal-predict/1"
    prediction = found["axes"]["gz"]
    assert prediction["offset"] == pytest.approx(1e-4, rel=0.05)
    assert prediction["rms_offset_out"] < 0.2 * prediction["rms_alone"]


def test_table_fits_eighty_columns_and_names_what_is_constant(tmp_path, capsys, monkeypatch):
    """gx follows its temperature beside a random walk, gy is a random walk, and az follows with a lag."""
    rng = np.random.default_rng(5)
    n = 7200
    t = np.arange(n)
    temperature_c = 25.0 + 3.0 * np.sin(2.0 * np.pi * t / 1800.0)
    walks = 1e-4 / n**0.5 * rng.standard_normal((3, n)).cumsum(axis=1) + 2e-5 * rng.standard_normal((3, n))
    lagged, level = np.empty(n), 25.0
    for k in range(n):
        level += (temperature_c[k] - level) / 300.0
        lagged[k] = level
    path = tmp_path / "x.npz"
    np.savez(
        path,
        fs=1.0,
        temp=temperature_c,
        gx=walks[0] - 5e-5 * temperature_c,
        gy=walks[1],
        az=9.81 + walks[2] + 1e-2 * lagged,
    )
    monkeypatch.setenv("COLUMNS", "80")
    assert exit_status("thermal", "fit", path, "--json", tmp_path / "out.json") == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line for line in lines if line[:2] in ("gx", "gy", "az") and "note" not in line}
    assert all(len(line.rstrip()) <= 80 for line in rows.values())
    assert rows["gx"].startswith("gx    polynomial 1")
    assert " … " in rows["gx"]
    assert rows["gy"].split()[1:5] == ["constant", "—", "—", "—"]
    assert rows["az"].startswith("az    difference")
    assert any(line.startswith("note: az follows its temperature with a lag of ") for line in lines)
    axes = json.loads((tmp_path / "out.json").read_bytes())["axes"]
    assert axes["gx"]["slope_interval"][0] < -5e-5 < axes["gx"]["slope_interval"][1]
    assert axes["gx"]["sizes_interval"][1] == pytest.approx(axes["gx"]["slope_interval"])
    assert len(axes["az"]["time_constants_interval"]) == len(axes["az"]["time_constants"])
    assert axes["gy"]["slope"] == 0.0
    assert axes["gy"]["p_value"] > 0.02


def test_model_file_preserves_all_parameters(tmp_path):
    study = thermal.fit_thermal_models(write_recording(tmp_path / "a.npz", 3), 3600.0)
    path = tmp_path / "m.json"
    path.write_bytes(thermal.encode_model_file(study))
    saved, loaded = study.fits["gz"].model, thermal.read_model_file(path)["gz"]
    written = json.loads(path.read_bytes())
    assert written["schema"] == "imu-monitor/thermal-model/1"
    assert written["axes"]["gz"]["equation"] == saved.equation == loaded.equation
    assert saved.shape == loaded.shape
    for name in ("coefficients", "initial_state", "covariance"):
        np.testing.assert_array_equal(getattr(saved, name), getattr(loaded, name))
    assert (saved.phi, saved.sigma, saved.reference_c) == (loaded.phi, loaded.sigma, loaded.reference_c)


def test_almost_constant_temperature_is_refused(tmp_path, capsys):
    path = tmp_path / "cold.npz"
    n = 4000
    rng = np.random.default_rng(4)
    np.savez(path, fs=1.0, gz=1e-5 * rng.standard_normal(n), temp=25.0 + 0.01 * rng.standard_normal(n))
    out = tmp_path / "out.json"
    assert exit_status("thermal", "fit", path, "--json", out) == 3
    assert "temperature hardly changed" in capsys.readouterr().err
    assert "temperature hardly changed" in json.loads(out.read_bytes())["refused"]["gz"]


def test_recording_without_temperature_is_refused(tmp_path, capsys):
    path = tmp_path / "none.npz"
    np.savez(path, fs=1.0, gz=1e-5 * np.arange(100.0))
    assert exit_status("thermal", "fit", path) == 2
    assert "there is no temperature" in capsys.readouterr().err


def make_model_file_content(tmp_path):
    return json.loads(
        thermal.encode_model_file(thermal.fit_thermal_models(write_recording(tmp_path / "a.npz", 3), 3600.0))
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(schema="imu-monitor/thermal-model/9"), 'schema "imu-monitor/thermal-model/9"'),
        (lambda m: m.update(interval=0.0), "interval: 0 s"),
        (lambda m: m["axes"].clear(), "there is no axis in the file"),
        (lambda m: m["axes"].update(gq=m["axes"].pop("gz")), "axes.gq: no such axis"),
        (lambda m: m["axes"]["gz"].update(sizes=[1.0]), "axes.gz: sizes: 1 values"),
        (lambda m: m["axes"]["gz"].update(time_constants=[-1.0]), "axes.gz: time_constants"),
        (lambda m: m["axes"]["gz"].update(temperature=[25.0, 25.0]), "axes.gz: temperature"),
        (lambda m: m["axes"]["gz"].update(phi=1.0), "axes.gz: phi: 1"),
        (lambda m: m["axes"]["gz"].update(covariance=[[1.0]]), "axes.gz: covariance"),
        (lambda m: m["axes"]["gz"].pop("sigma"), "sigma"),
    ],
)
def test_invalid_model_file_is_refused_with_the_key(tmp_path, capsys, change, message):
    model = make_model_file_content(tmp_path)
    change(model)
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(model))
    assert exit_status("thermal", "predict", tmp_path / "a.npz", "--model", path) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


def test_missing_model_file_is_refused(tmp_path, capsys):
    assert (
        exit_status("thermal", "predict", write_recording(tmp_path / "a.npz", 3), "--model", tmp_path / "nowhere.json")
        == 2
    )
    assert "nowhere.json: cannot be read" in capsys.readouterr().err
