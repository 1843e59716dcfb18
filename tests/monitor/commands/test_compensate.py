"""Tests of the command ``compensate``, from the input file to the recording, the JSON, the plot or the error."""

import json
from pathlib import Path

import numpy as np
import pytest

from drivers.recordings import load_samples
from tests.support.program import exit_status

RATE_HZ = 100.0
SIGMA = 1e-3


def write_recording(path: Path, seconds: float = 300.0, turn: float = 0.0, **more: np.ndarray) -> Path:
    """Write two gyro axes and an accelerometer axis; gz turns in the middle."""
    rng = np.random.default_rng(0)
    n = round(seconds * RATE_HZ)
    gz = 0.01 + SIGMA * rng.standard_normal(n)
    gz[n // 2 : n // 2 + 500] += turn
    gx = -0.02 + SIGMA * rng.standard_normal(n)
    az = 9.8 + 0.01 * rng.standard_normal(n)
    np.savez(path, t=np.arange(n) / RATE_HZ + 5.0, gx=gx, gz=gz, az=az, **more)
    return path


@pytest.mark.long
def test_compensated_recording_has_no_drift(tmp_path, capsys):
    recording, out = write_recording(tmp_path / "a.npz", turn=0.5), tmp_path / "out.csv"
    plot, summary = tmp_path / "a.png", tmp_path / "a.json"
    assert exit_status("compensate", recording, "--out", out, "--json", summary, "--plot", plot, "--units", "si") == 0
    text = capsys.readouterr().out
    assert "adaptive; evaluated on" in text
    assert "rms, rad/s" in text
    assert "→" in text
    before, after = load_samples(recording), load_samples(out)
    assert after.axes == ("gx", "gz", "az")
    np.testing.assert_allclose(after.t_s, before.t_s, atol=1e-9)
    np.testing.assert_array_equal(after.values[:, 5], before.values[:, 5])
    at_rest = after.values[4000:14_000, 2]
    assert np.sqrt(np.mean(at_rest**2)) < 0.3 * SIGMA
    assert after.values[15_010:15_490, 2].mean() == pytest.approx(0.5, abs=2e-4)
    found = json.loads(summary.read_bytes())
    assert found["schema"] == "imu-monitor/compensate/1"
    assert found["method"] == "adaptive"
    gz = found["axes"]["gz"]
    assert gz["after"]["deviation"] < 0.3 * gz["before"]["deviation"]
    assert gz["model"]["order"] == [0, 0]
    assert len(gz["intervals"]["end"]) == len(gz["intervals"]["expected"])
    assert set(found["axes"]) == {"gx", "gz"}
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize("method", ["fixed", "ar", "emd", "wavelet"])
def test_methods_are_evaluated_on_the_same_part(tmp_path, capsys, method):
    recording, out = write_recording(tmp_path / "a.npz"), tmp_path / "out.npz"
    assert exit_status("compensate", recording, "--out", out, "--method", method, "--json", "-") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["judged"] == pytest.approx(2.0 * found["learned"], rel=0.05)
    for axis in found["axes"].values():
        assert axis["after"]["deviation"] < 0.8 * axis["before"]["deviation"]


@pytest.mark.long
def test_order_option_sets_the_order_of_the_model(tmp_path, capsys):
    recording = write_recording(tmp_path / "a.npz")
    assert exit_status("compensate", recording, "--out", tmp_path / "out.npz", "--order", "2,1", "--json", "-") == 0
    model = json.loads(capsys.readouterr().out)["axes"]["gz"]["model"]
    assert model["order"] == [2, 1]
    for name in ("phi1", "phi2", "theta1"):
        assert model[name]["lo"] <= model[name]["value"] <= model[name]["hi"]


def test_missing_samples_and_temperature_are_preserved(tmp_path):
    recording = write_recording(tmp_path / "a.npz", temp=np.full(30_000, 25.0))
    with np.load(recording) as whole:
        kept = {name: np.delete(whole[name], np.s_[20_000:20_050]) for name in whole}
    np.savez(recording, **kept)
    assert exit_status("compensate", recording, "--out", tmp_path / "out.npz") == 0
    found = load_samples(tmp_path / "out.npz")
    assert len(found) == 29_950
    np.testing.assert_allclose(found.t_s, kept["t"], atol=2e-3)
    assert (found.temperature_c == 25.0).all()


def test_invalid_request_is_reported_in_one_line_and_nothing_is_written(tmp_path, capsys):
    recording, out = write_recording(tmp_path / "a.npz", seconds=60.0), tmp_path / "out.npz"
    np.savez(tmp_path / "b.npz", fs=RATE_HZ, az=np.random.default_rng(0).standard_normal(1000))
    moving = 0.5 * np.sin(np.arange(6000) / 20.0)
    np.savez(tmp_path / "c.npz", fs=RATE_HZ, gz=moving)
    for arguments, status, message in (
        ([recording, "--method", "adaptve"], 2, 'did you mean "adaptive"?'),
        ([recording, "--order", "3,1"], 2, "possible are 0,0 1,0 1,1 2,0 2,1"),
        ([tmp_path / "none.npz"], 2, "none.npz"),
        ([tmp_path / "b.npz"], 2, "there is no gyro axis"),
        ([tmp_path / "c.npz"], 3, "never at rest"),
        ([recording, "--rate", "-1"], 2, "is outside the supported range"),
        ([recording, "--plot", tmp_path / "a.pdf"], 2, "ending in .png"),
        ([recording, "--json", out], 2, "is also the output file of --out"),
    ):
        assert exit_status("compensate", *arguments, "--out", out) == status
        err = capsys.readouterr().err
        assert message in err
        assert err.count("\n") == 1
        assert not out.exists()
    assert exit_status("compensate", recording, "--out", recording) == 2
    assert "is also the output file of --out" in capsys.readouterr().err
