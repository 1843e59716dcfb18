"""Tests of the command ``simulate``: file formats, samples, temperature, truth file and interruption."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.recordings import load_samples, save_samples
from drivers.recordings.formats import WRITABLE_TABLES
from monitor.commands import analyze
from monitor.commands.recording_loading import DecoderChoice, LoadingOptions, load_recording
from monitor.commands.simulate import CHUNK_ROWS, SimulationRequest, run_simulation
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.noise.model import NoiseModel

COEFFICIENTS = {"Q": 2e-5, "N": 1.5e-4, "B": 3e-4, "K": 2e-4, "R": 3e-5}
MODEL = NoiseModel.from_toml(
    """sample_rate = 50.0
[gz.quantization_noise]
Q = 2e-5
[gz.angle_random_walk]
N = 1.5e-4
[gz.bias_instability]
B = 3e-4
[gz.rate_random_walk]
K = 2e-4
[gz.rate_ramp]
R = 3e-5
"""
)
TEMPERATURE_MODEL = NoiseModel.from_toml(
    """sample_rate = 50.0
[temperature]
mean = 30.0
swing = 5.0
period = 100.0
[ax.temperature_bias]
coefficient = 1e-2
reference = 25.0
[gy.angle_random_walk]
N = 1e-9
[az.poisson_steps]
rate = 0.5
height = 1.0
"""
)


@pytest.fixture(params=WRITABLE_TABLES)
def output_path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return tmp_path / f"simulated{request.param}"


def test_five_terms_are_recovered_from_every_format(output_path: Path) -> None:
    """About one 95 % interval in twenty misses its value; with this seed, none does."""
    summary = run_simulation(SimulationRequest(MODEL, output_path, 1200.0, seed=2))
    assert (summary.samples, summary.rate_hz, summary.axes, summary.temperature, summary.truth) == (
        60_000,
        50.0,
        ("gz",),
        False,
        None,
    )
    found = analyze.analyze_recording(load_recording(output_path)).analysis.estimate.coefficients
    assert found.value.shape == (5, 6)
    assert found.status[1, 2] == Status.ESTIMATED
    for row, letter in enumerate(SYMBOLS):
        assert found.lo[row, 2] <= COEFFICIENTS[letter] <= found.hi[row, 2], letter


def test_recording_has_exactly_the_samples_of_the_model(output_path: Path) -> None:
    n = CHUNK_ROWS + 1000  # more than one block
    run_simulation(SimulationRequest(TEMPERATURE_MODEL, output_path, n / 50.0, seed=4))
    recording = load_samples(output_path)
    drawn = TEMPERATURE_MODEL.start_stream(50.0, 4).draw_samples_with_temperature(n)
    assert recording.axes == ("gy", "ax", "az")  # axes without effects are absent, not zero
    for axis in recording.axes:
        assert np.array_equal(recording.values[:, AXES.index(axis)], drawn.values[:, AXES.index(axis)])
    assert np.array_equal(recording.temperature_c, drawn.temperature_c)
    assert recording.t_s is not None
    assert np.array_equal(recording.t_s, np.arange(n) / 50.0)
    assert recording.notes == ()
    assert list(output_path.parent.iterdir()) == [output_path]


def test_rate_option_overrides_the_model_and_one_rate_is_required(tmp_path: Path) -> None:
    assert run_simulation(SimulationRequest(MODEL, tmp_path / "a.npz", 2.0, seed=1, rate_hz=200.0)).samples == 400
    with pytest.raises(ConfigError, match="no sample_rate; set the rate with --rate HZ"):
        run_simulation(SimulationRequest(NoiseModel(MODEL.effects), tmp_path / "b.npz", 2.0, seed=1))
    assert not (tmp_path / "b.npz").exists()


def test_temperature_is_taken_from_a_recording(tmp_path: Path) -> None:
    t_s = np.arange(0.0, 20.0, 0.5) + 1e6  # at another rate, from another origin
    temperature_c = 20.0 + (t_s - t_s[0])
    temperature_c[7] = np.nan
    save_samples(tmp_path / "oven.csv", t_s, np.zeros((t_s.size, 6)), temperature_c)
    summary = run_simulation(
        SimulationRequest(TEMPERATURE_MODEL, tmp_path / "x.npz", 30.0, seed=1, temperature_from=tmp_path / "oven.csv")
    )
    recording = load_samples(tmp_path / "x.npz")
    assert summary.temperature
    since_s = np.arange(1500) / 50.0
    assert recording.temperature_c == pytest.approx(20.0 + np.minimum(since_s, 19.5))  # the last temperature continues
    assert recording.values[:, 3] == pytest.approx(1e-2 * (recording.temperature_c - 25.0))


def test_temperature_is_taken_from_captured_bytes(tmp_path: Path) -> None:
    (tmp_path / "oven.txt").write_text("".join(f"0.0 {20.0 + 0.1 * i:.1f}\n" for i in range(300)))
    run_simulation(
        SimulationRequest(
            TEMPERATURE_MODEL,
            tmp_path / "x.npz",
            4.0,
            rate_hz=50.0,
            seed=1,
            temperature_from=tmp_path / "oven.txt",
            loading=LoadingOptions(
                decoder=DecoderChoice("text", {"columns": ["gx", "temperature"], "gyro_unit": "rad/s"})
            ),
        )
    )
    assert load_samples(tmp_path / "x.npz").temperature_c == pytest.approx(
        20.1 + 0.1 * np.arange(200),
        abs=1e-6,  # a capture may begin within a line, so that its first line is left out
    )


def test_temperature_recording_keeps_its_own_rate(tmp_path: Path) -> None:
    np.savez(tmp_path / "oven.npz", fs=1.0, gx=np.zeros(11), temperature=np.arange(11.0))
    run_simulation(
        SimulationRequest(
            TEMPERATURE_MODEL, tmp_path / "x.npz", 8.0, seed=1, rate_hz=20.0, temperature_from=tmp_path / "oven.npz"
        )
    )
    assert load_samples(tmp_path / "x.npz").temperature_c == pytest.approx(np.arange(160) / 20.0)


def test_temperature_recording_without_times_uses_the_rate_option(tmp_path: Path) -> None:
    (tmp_path / "oven.csv").write_text("gx,temperature\n" + "".join(f"0,{i}\n" for i in range(200)))
    wanted = SimulationRequest(
        TEMPERATURE_MODEL, tmp_path / "x.npz", 8.0, seed=1, temperature_from=tmp_path / "oven.csv"
    )
    with pytest.raises(ConfigError, match="give it with --rate HZ"):
        run_simulation(wanted)
    run_simulation(replace(wanted, rate_hz=20.0))
    assert load_samples(tmp_path / "x.npz").temperature_c == pytest.approx(np.arange(160.0))


def test_temperature_recording_without_temperature_is_refused(tmp_path: Path) -> None:
    save_samples(tmp_path / "cold.csv", np.arange(10.0), np.zeros((10, 6)))
    with pytest.raises(ConfigError, match=r"cold\.csv: has no temperature"):
        run_simulation(
            SimulationRequest(
                TEMPERATURE_MODEL, tmp_path / "x.npz", 30.0, seed=1, temperature_from=tmp_path / "cold.csv"
            )
        )
    assert not (tmp_path / "x.npz").exists()


def test_truth_file_has_the_model_and_the_drawn_events(tmp_path: Path) -> None:
    summary = run_simulation(SimulationRequest(TEMPERATURE_MODEL, tmp_path / "x.csv", 60.0, seed=9, truth=True))
    assert summary.truth == tmp_path / "x.csv.truth.json"
    truth = json.loads(summary.truth.read_bytes())
    assert truth["schema"] == "imu-monitor/truth/1"
    assert (truth["seed"], truth["rate"], truth["seconds"], truth["samples"]) == (9, 50.0, 60.0, 3000)
    assert truth["axes"] == ["gy", "ax", "az"]
    assert truth["model"] == tomllib.loads(TEMPERATURE_MODEL.to_toml())
    (steps,) = truth["drawn"]["az"]["poisson_steps"]
    values = load_samples(tmp_path / "x.csv").values[:, 5]
    jumps = np.flatnonzero(np.abs(np.diff(values, prepend=0.0)) > 1e-9)
    assert steps["count"] == len(steps["times"]) >= 10
    at = np.ceil(np.array(steps["times"]) * 50.0).astype(int)  # two steps may fall on the same sample
    assert np.array_equal(np.unique(at), jumps)
    assert values == pytest.approx([sum(np.array(steps["heights"])[at <= i]) for i in range(3000)])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["x.csv", "x.csv.truth.json"]


class Cancelled(BaseException):
    pass


@pytest.mark.parametrize("truth", [False, True])
def test_cancelled_simulation_leaves_no_file(output_path: Path, truth: bool) -> None:
    def cancel(what: str, share: float | None) -> None:
        if share:
            partial_file = any(file.name.endswith(".part") for file in output_path.parent.iterdir())
            assert partial_file or output_path.suffix == ".npz"  # .npz columns are collected in unnamed files
            raise Cancelled

    with pytest.raises(Cancelled):
        run_simulation(SimulationRequest(MODEL, output_path, 2.0 * CHUNK_ROWS / 50.0, seed=1, truth=truth), cancel)
    assert list(output_path.parent.iterdir()) == []


def test_progress_rises_to_one(tmp_path: Path) -> None:
    shares: list[float | None] = []
    run_simulation(
        SimulationRequest(MODEL, tmp_path / "x.npz", 2.5 * CHUNK_ROWS / 50.0, seed=1),
        lambda _what, share: shares.append(share),
    )
    assert shares[0] is None
    assert shares[1:4] == pytest.approx([0.4, 0.8, 1.0])


@pytest.mark.parametrize(
    ("model", "seconds", "message"),
    [
        (NoiseModel(sample_rate_hz=100.0), 1.0, "m: the model has no axis"),
        (MODEL, 1e-9, "1e-09 s at 50 Hz: 0 samples is outside the supported range"),
        (
            NoiseModel.from_toml("[gz.sinusoidal]\namplitude = 1.0\nfrequency = 30.0\n"),
            1.0,
            "m: gz.sinusoidal: .* 25 Hz",
        ),
        (NoiseModel.from_toml("[gz.temperature_bias]\ncoefficient = 1.0\nreference = 2.0\n"), 1.0, "m: .*temperature"),
    ],
)
def test_invalid_simulation_is_refused_and_nothing_is_written(
    model: NoiseModel, seconds: float, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        run_simulation(
            SimulationRequest(model, tmp_path / "x.npz", seconds, seed=1, rate_hz=50.0, truth=True, name="m")
        )
    assert list(tmp_path.iterdir()) == []
