"""The experiment of "Dynamic extraction of random drift error coefficients of MEMS gyroscopes", as a service.

600 s at 100 Hz in a window of 100 s, fitted at every sample. At 250 s, on all six axes, N goes from 1.5e-4 to 3e-4,
B from 4e-5 to 3e-4, K from 1.5e-6 to 1e-4 and R from 0 to 1e-4; Q stays at 2e-5 (SI units of the axis). An Allan
curve of the whole record shows neither the one sensor nor the other.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.estimation.estimate import CoefficientsAfterEachSample, Estimate
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRamp, RateRandomWalk
from monitor.noise.model import NoiseModel
from tests.support.waiting import wait_for
from tests.system.rig import Caught, running

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


class Kept(Caught):
    """Keeps the course of the coefficients too."""

    def __init__(self) -> None:
        super().__init__()
        self.course: list[CoefficientsAfterEachSample] = []

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        super().publish_result(device, unix_s, received, result)
        if isinstance(result, Estimate) and result.history is not None:
            self.course.append(result.history)


def sensor(k: dict[str, float]) -> NoiseModel:
    sources = (
        QuantizationNoise(Q=k["Q"]),
        AngleRandomWalk(N=k["N"]),
        BiasInstability(B=k["B"]),
        RateRandomWalk(K=k["K"]),
        RateRamp(R=k["R"]),
    )
    return NoiseModel(dict.fromkeys(AXES, sources))


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    folder: Path = tmp_path_factory.mktemp("jump")
    values = np.concatenate(
        [sensor(BEFORE).simulate(25_000, RATE_HZ, seed=3), sensor(AFTER).simulate(35_000, RATE_HZ, seed=4)]
    )
    np.savez(folder / "jump.npz", fs=RATE_HZ, **dict(zip(AXES, values.T, strict=True)))
    with running(folder, CONFIG, kept := Kept()) as service:
        wait_for(lambda: service.station("gyro").replay_finished, "the recording's end")
    return kept


def course(kept: Kept) -> tuple[np.ndarray, np.ndarray]:
    """Seconds since the start, and Q N B K R [n, 5, 6] after every sample."""
    t_ns = np.concatenate([part.t_ns for part in kept.course])
    return (t_ns - t_ns[0]) / 1e9, np.concatenate([part.value for part in kept.course])


def test_every_sample_has_its_coefficients(walked: Kept) -> None:
    t_s, value = course(walked)
    assert t_s.size == 60_000
    assert np.diff(t_s) == pytest.approx(1.0 / RATE_HZ, abs=1e-6)
    assert np.isfinite(value[2000:, 1]).mean() > 0.998  # but for a second after it began anew


def test_the_jump_is_told_with_its_time_size_and_letters(walked: Kept) -> None:
    began_ns = walked.course[0].t_ns[0]
    first = {}
    for _, event in walked.events:
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


def test_n_rises_at_once_and_q_stays(walked: Kept) -> None:
    t_s, value = course(walked)
    n, q = value[:, 1], value[:, 0]
    assert n[(t_s > 100.0) & (t_s < JUMP_S)] == pytest.approx(BEFORE["N"], rel=0.12)
    # the fit begins anew at the change: no need to wait until the old noise has left the window
    assert np.nanmedian(n[(t_s > JUMP_S + 30.0) & (t_s < JUMP_S + 60.0)]) == pytest.approx(AFTER["N"], rel=0.1)
    assert np.nanmedian(q[(t_s > 150.0) & (t_s < JUMP_S)]) == pytest.approx(BEFORE["Q"], rel=0.03)
    assert np.nanmedian(q[t_s > JUMP_S + 60.0]) == pytest.approx(AFTER["Q"], rel=0.03)


def test_at_the_end_the_fit_is_that_of_the_new_sensor(walked: Kept) -> None:
    found = walked.estimates["gyro"].coefficients
    held = 0
    for row, letter in enumerate(SYMBOLS):
        status, lo, hi = found.status[row], found.lo[row], found.hi[row]
        held += int(((status > Status.UNESTIMATED) & (lo <= AFTER[letter]) & (hi >= AFTER[letter])).sum())
        if letter in "QN":
            assert (status == Status.ESTIMATED).all()
    assert held >= 27  # of 30 at 95 %
    ramps = found.status[4] == Status.ESTIMATED
    assert ramps.any()
    assert found.value[4, ramps] == pytest.approx(AFTER["R"], rel=0.4)
