import numpy as np
import pytest

from monitor.reconcile.recording_checks.corrupt_rows import check_corrupt_rows, compute_distances_from_neighbours
from monitor.reconcile.recording_checks.recording_under_test import RecordingUnderTest
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, draw, make_model

MODEL = make_model(gravity=True)


def values(seed=2):
    return {axis: y.copy() for axis, y in draw(MODEL, seed).values.items()}


def check(recorded):
    return check_corrupt_rows(RecordingUnderTest(recorded, RATE_HZ, MODEL, draw(MODEL, 99).values))


@pytest.mark.parametrize("row", [0, 1, 7000, 15_998, 15_999])
def test_corrupt_row_is_marked_on_all_axes(row):
    recorded = values()
    recorded["gy"][row] += 40.0 * np.std(np.diff(recorded["gy"]))
    marked, (finding,) = check(recorded)
    assert (finding.kind, finding.axes) == ("corrupt_rows", ("gy",))
    assert finding.parameters["time"].value == row / RATE_HZ
    assert all(np.flatnonzero(np.isnan(y)).tolist() == [row] for y in marked.values())


def test_first_row_of_zeros_is_found_by_gravity():
    recorded = values()
    for y in recorded.values():
        y[0] = 0.0
    _, (finding,) = check(recorded)
    assert "The first row is corrupt" in finding.sentence


def test_three_rows_in_succession_are_one_finding():
    recorded = values()
    recorded["ax"][5000:5003] += 100.0
    marked, (finding,) = check(recorded)
    assert finding.evidence["rows"] == 3.0
    assert np.flatnonzero(np.isnan(marked["gx"])).tolist() == [5000, 5001, 5002]


def test_step_is_no_spike():
    recorded = values()
    recorded["ax"][5000:] += 100.0
    assert check(recorded)[1] == []


def test_outliers_at_several_times_are_no_finding():
    recorded = values()
    recorded["ax"][[2000, 9000]] += 100.0
    assert check(recorded)[1] == []


def test_without_a_model_a_moderate_spike_on_one_axis_may_be_an_outlier():
    recorded = values()
    recorded["gx"][5000] += 30.0 * np.std(np.diff(recorded["gx"]))
    assert check_corrupt_rows(RecordingUnderTest(recorded, RATE_HZ))[1] == []
    recorded["gy"][5000] += 30.0 * np.std(np.diff(recorded["gy"]))
    assert len(check_corrupt_rows(RecordingUnderTest(recorded, RATE_HZ))[1]) == 1


def test_missing_samples_are_no_spikes():
    y = np.random.default_rng(0).standard_normal(5000)
    y[1000:1010] = np.nan
    _, distances = compute_distances_from_neighbours(y)
    assert distances.max() < 8.0


def test_constant_axis_has_no_distances():
    assert compute_distances_from_neighbours(np.ones(1000))[0].size == 0
