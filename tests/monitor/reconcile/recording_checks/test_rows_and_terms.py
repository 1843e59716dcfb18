import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import AngleRandomWalk, ExponentiallyCorrelated, RandomSampleHold, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.missing_and_repeated_rows import check_missing_rows, check_repeated_rows
from monitor.reconcile.recording_checks.recording_under_test import RecordingUnderTest
from monitor.reconcile.recording_checks.untestable_slow_terms import check_slow_terms
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, draw, make_model

MODEL = make_model(step=8.0)


def values():
    return {axis: y.copy() for axis, y in draw(MODEL, 2).values.items()}


def test_holes_are_counted():
    recorded = values()
    for y in recorded.values():
        y[100:110] = np.nan
        y[5000:5200] = np.nan
    recorded["gx"][9000:9999] = np.nan  # one axis is no row
    _, (finding,) = check_missing_rows(RecordingUnderTest(recorded, RATE_HZ))
    assert finding.evidence == {"rows": 210.0, "holes": 2.0, "share": 210 / 16_000}
    assert (finding.parameters["time"].value, finding.parameters["duration"].value) == (50.0, 2.0)


def test_complete_recording_has_no_holes():
    assert check_missing_rows(RecordingUnderTest(values(), RATE_HZ))[1] == []


def test_repeated_rows_are_measured_and_kept():
    recorded = values()
    again = 1 + np.flatnonzero(np.random.default_rng(0).random(15_999) < 0.2)
    for y in recorded.values():
        for row in again:
            y[row] = y[row - 1]
    _, (finding,) = check_repeated_rows(RecordingUnderTest(recorded, RATE_HZ, MODEL))
    assert finding.parameters["share"].value == pytest.approx(0.2, abs=0.02)
    assert not finding.corrected


def test_repeats_of_the_model_or_by_chance_are_no_finding():
    assert check_repeated_rows(RecordingUnderTest(values(), RATE_HZ, MODEL))[1] == []
    held = MODEL + NoiseModel({"gx": (RandomSampleHold(fraction=0.2),)})
    recorded = {axis: y.repeat(2) for axis, y in values().items()}
    assert check_repeated_rows(RecordingUnderTest(recorded, RATE_HZ, held))[1] == []
    assert len(check_repeated_rows(RecordingUnderTest(recorded, RATE_HZ, MODEL))[1]) == 1


def test_term_slower_than_the_recording_is_named():
    slow = NoiseModel({
        "gx": (AngleRandomWalk(N=1e-4), ExponentiallyCorrelated(sigma=1e-4, correlation_time=500.0)),
        "gy": (AngleRandomWalk(N=1e-4), RateRandomWalk(K=1e-7)),
        "gz": (AngleRandomWalk(N=1e-4), RateRandomWalk(K=1e-4)),
    })  # fmt: skip
    gyroscopes = {axis: np.zeros(16_000) for axis in AXES[:3]}
    _, (finding,) = check_slow_terms(RecordingUnderTest(gyroscopes, RATE_HZ, slow))
    assert finding.axes == ("gx", "gy")
    assert "exponentially correlated of gx; rate random walk of gy" in finding.sentence
    long = {axis: np.broadcast_to(0.0, 100_000_000) for axis in AXES[:3]}
    assert check_slow_terms(RecordingUnderTest(long, RATE_HZ, slow))[1] == []
