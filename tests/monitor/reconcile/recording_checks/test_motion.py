import numpy as np

from monitor.reconcile.recording_checks.motion import check_motion
from monitor.reconcile.recording_checks.recording_under_test import RecordingUnderTest
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, draw, make_model

MODEL = make_model(gravity=True)


def moved(axes, begin=8000, length=300, size=40.0):
    recorded = {axis: y.copy() for axis, y in draw(MODEL, 4).values.items()}
    for axis in axes:
        y = recorded[axis]
        y[begin : begin + length] += size * np.std(np.diff(y)) * np.sin(np.arange(length) / 3.0)
    return recorded


def check(recorded, model=MODEL):
    return check_motion(RecordingUnderTest(recorded, RATE_HZ, model, None if model is None else draw(MODEL, 99).values))


def test_motion_is_removed_from_all_axes():
    marked, (finding,) = check(moved(("gx", "gy", "az")))
    assert (finding.kind, finding.corrected) == ("motion", True)
    assert {"gx", "gy", "az"} <= set(finding.axes)
    missing = np.flatnonzero(np.isnan(marked["ay"]))
    assert missing[0] <= 8000
    assert missing[-1] >= 8299
    assert missing.size < 600


def test_disturbance_of_one_axis_is_no_motion():
    assert check(moved(("gx",)))[1] == []


def test_without_a_model_motion_is_removed_too():
    assert len(check(moved(("gx", "ay")), None)[1]) == 1


def test_recording_in_motion_for_much_of_the_time_is_kept():
    recorded = {axis: y.copy() for axis, y in draw(MODEL, 4).values.items()}
    for begin in (2000, 7000, 12_000):
        for axis in ("gx", "gy", "ax"):
            y = recorded[axis]
            y[begin : begin + 2300] += 0.3 * np.sin(np.arange(2300) / 3.0)
    marked, (finding,) = check(recorded)
    assert finding.evidence["share"] > 0.4
    assert not finding.corrected
    assert "too much to remove" in finding.sentence
    assert not any(np.isnan(y).any() for y in marked.values())
