import numpy as np
import pytest

from monitor.reconcile.recording_checks.missing_and_repeated_rows import check_stuck_values, find_longest_run_bounds
from monitor.reconcile.recording_checks.recording_under_test import RecordingUnderTest
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, draw, make_model


def values(step=0.0, seed=2):
    return {axis: y.copy() for axis, y in draw(make_model(step=step), seed).values.items()}


@pytest.mark.parametrize("step", [0.0, 8.0], ids=["fine", "coarse"])
@pytest.mark.parametrize("length", [200, 8000])
def test_stuck_axis_is_marked(step, length):
    recorded = values(step)
    recorded["gz"][4000 : 4000 + length] = recorded["gz"][3999]
    marked, (finding,) = check_stuck_values(
        RecordingUnderTest(recorded, RATE_HZ, simulated=draw(make_model(step=step), 9).values)
    )
    assert (finding.kind, finding.axes) == ("stuck_axis", ("gz",))
    assert finding.parameters["time"].value == pytest.approx(40.0, abs=0.1)
    assert finding.parameters["duration"].value == pytest.approx(length / RATE_HZ, abs=0.1)
    missing = np.isnan(marked["gz"])
    assert missing.sum() == pytest.approx(length, abs=10)
    assert not any(np.isnan(y).any() for axis, y in marked.items() if axis != "gz")


def test_rows_that_keep_all_values_are_one_finding():
    recorded = values()
    for y in recorded.values():
        y[4000:4300] = y[3999]
    _, (finding,) = check_stuck_values(RecordingUnderTest(recorded, RATE_HZ))
    assert (finding.kind, len(finding.axes)) == ("frozen_rows", 6)


def test_constant_axis_is_kept_for_the_note_about_it():
    recorded = values()
    recorded["ax"][:] = 0.0
    marked, (finding,) = check_stuck_values(RecordingUnderTest(recorded, RATE_HZ))
    assert finding.kind == "stuck_axis"
    assert np.array_equal(marked["ax"], recorded["ax"])


def test_clipping_is_not_stuck():
    recorded = values()
    recorded["ax"] = np.minimum(recorded["ax"], np.quantile(recorded["ax"], 0.999))
    recorded["ax"][4000:4100] = recorded["ax"].max()
    assert check_stuck_values(RecordingUnderTest(recorded, RATE_HZ))[1] == []


@pytest.mark.parametrize("noise", [0.15, 0.3, 1.0])
def test_coarse_values_repeat_by_chance(noise):
    rng = np.random.default_rng(3)
    for _ in range(20):
        y = np.rint(noise * rng.standard_normal(20_000) + 0.3)
        assert check_stuck_values(RecordingUnderTest({"gx": y}, RATE_HZ))[1] == []


def test_longest_run_ignores_missing_samples():
    assert find_longest_run_bounds(np.array([1.0, np.nan, np.nan, np.nan, 2.0, 2.0])) == (4, 6)
