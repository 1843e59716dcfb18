"""Test of a step in the noise coefficients during a replay.

The experiment is that of "Dynamic extraction of random drift error coefficients of MEMS gyroscopes". The recording has
600 s at 100 Hz. The window has 100 s, and the coefficients are fitted at every sample. At 250 s, on all six axes, N
goes from 1.5e-4 to 3e-4, B from 4e-5 to 3e-4, K from 1.5e-6 to 1e-4 and R from 0 to 1e-4. Q stays at 2e-5 (SI units of
the axis). An Allan curve of the whole recording shows the noise of neither part.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.estimation.estimate import CoefficientsAfterEachSample, Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRamp, RateRandomWalk
from monitor.noise.model import NoiseModel
from tests.support.waiting import wait_for
from tests.system.rig import RecordingOutput, run_service

RATE_HZ = 100.0
JUMP_S = 250.0
BEFORE = {"Q": 2e-5, "N": 1.5e-4, "B": 4e-5, "K": 1.5e-6, "R": 0.0}
AFTER = {"Q": 2e-5, "N": 3e-4, "B": 3e-4, "K": 1e-4, "R": 1e-4}
CONFIG = """
[[device]]
name = "gyro"
window = 100.0
refit = "every sample"
publish = "every block"
[device.driver]
link = "replay"
path = "jump.npz"
speed = "max"
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""


class HistoryOutput(RecordingOutput):
    """Output that also stores the history of the coefficients."""

    def __init__(self) -> None:
        super().__init__()
        self.histories: list[CoefficientsAfterEachSample] = []

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        super().publish_result(device, unix_s, received, result)
        if isinstance(result, Estimate) and result.history is not None:
            self.histories.append(result.history)


def build_model(k: dict[str, float]) -> NoiseModel:
    sources = (
        QuantizationNoise(Q=k["Q"]),
        AngleRandomWalk(N=k["N"]),
        BiasInstability(B=k["B"]),
        RateRandomWalk(K=k["K"]),
        RateRamp(R=k["R"]),
    )
    return NoiseModel(dict.fromkeys(AXES, sources))


@pytest.fixture(scope="module")
def replay_output(tmp_path_factory: pytest.TempPathFactory) -> HistoryOutput:
    folder: Path = tmp_path_factory.mktemp("jump")
    values = np.concatenate(
        [build_model(BEFORE).simulate(25_000, RATE_HZ, seed=5), build_model(AFTER).simulate(35_000, RATE_HZ, seed=6)]
    )
    np.savez(folder / "jump.npz", fs=RATE_HZ, **dict(zip(AXES, values.T, strict=True)))
    with run_service(folder, CONFIG, output := HistoryOutput()) as run:
        wait_for(lambda: run.worker("gyro").replay_finished, "the recording's end")
    return output


def coefficient_history(output: HistoryOutput) -> tuple[np.ndarray, np.ndarray]:
    """Return the time since the start [s, n] and Q N B K R [n, 5, 6] after every sample."""
    t_ns = np.concatenate([part.t_ns for part in output.histories])
    return (t_ns - t_ns[0]) / 1e9, np.concatenate([part.value for part in output.histories])


def test_every_sample_has_its_coefficients(replay_output: HistoryOutput) -> None:
    t_s, value = coefficient_history(replay_output)
    assert t_s.size == 60_000
    assert np.diff(t_s) == pytest.approx(1.0 / RATE_HZ, abs=1e-6)
    assert np.isfinite(value[2000:, 1]).mean() > 0.998  # the fit has no result in the first second after its restart


def test_event_gives_time_and_coefficients_of_the_noise_step(replay_output: HistoryOutput) -> None:
    began_ns = replay_output.histories[0].t_ns[0]
    first = {}
    for _, event in replay_output.events:
        if event.kind == "noise_changed":
            first.setdefault(event.axis, event)
    assert set(first) == set(AXES)
    for event in first.values():
        assert event.since_ns is not None
        assert (event.since_ns - began_ns) / 1e9 == pytest.approx(JUMP_S, abs=3.0)
        assert (event.t_ns - began_ns) / 1e9 < JUMP_S + 15.0
        assert event.values["N"]["before"] == pytest.approx(BEFORE["N"], rel=0.1)
        assert event.values["N"]["after"] == pytest.approx(AFTER["N"], rel=0.25)
        assert "Q" not in event.values


def test_n_rises_at_once_and_q_stays(replay_output: HistoryOutput) -> None:
    t_s, value = coefficient_history(replay_output)
    n, q = value[:, 1], value[:, 0]
    assert n[(t_s > 100.0) & (t_s < JUMP_S)] == pytest.approx(BEFORE["N"], rel=0.12)
    # the fit restarts at the change, so the old noise does not need to leave the window
    assert np.nanmedian(n[(t_s > JUMP_S + 30.0) & (t_s < JUMP_S + 60.0)]) == pytest.approx(AFTER["N"], rel=0.1)
    assert np.nanmedian(q[(t_s > 150.0) & (t_s < JUMP_S)]) == pytest.approx(BEFORE["Q"], rel=0.03)
    assert np.nanmedian(q[t_s > JUMP_S + 60.0]) == pytest.approx(AFTER["Q"], rel=0.03)


def test_final_intervals_contain_the_new_coefficients(replay_output: HistoryOutput) -> None:
    found = replay_output.estimates["gyro"].coefficients
    covered = 0
    for row, letter in enumerate(SYMBOLS):
        status, lo, hi = found.status[row], found.lo[row], found.hi[row]
        covered += int(((status > Status.UNESTIMATED) & (lo <= AFTER[letter]) & (hi >= AFTER[letter])).sum())
        if letter in "QN":
            assert (status == Status.ESTIMATED).all()
    assert covered >= 27  # of 30 at 95 %
    ramps = found.status[4] == Status.ESTIMATED
    assert ramps.any()
    assert found.value[4, ramps] == pytest.approx(AFTER["R"], rel=0.4)
