import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import Outliers, PoissonSteps
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks import checks
from monitor.reconcile.recording_checks.checks import FINDING_KINDS, check_recording
from tests.monitor.reconcile.recording_checks.recordings import changed, draw, make_model

MODEL = make_model(gravity=True)


def list_finding_kinds(recording, model=MODEL):
    return [one.kind for one in check_recording(recording, model, 1).findings]


@pytest.mark.parametrize(
    "model",
    [
        MODEL,
        make_model(),
        make_model(gravity=True, step=8.0),
        MODEL + NoiseModel({axis: (Outliers(fraction=5e-4, scale=0.05),) for axis in AXES}),
        MODEL + NoiseModel({axis: (PoissonSteps(rate=0.02, height=0.02),) for axis in AXES}),
    ],
    ids=["gravity", "no gravity", "coarse", "outliers", "steps"],
)
def test_recordings_of_the_model_have_no_findings(model):
    assert [list_finding_kinds(draw(model, seed), model) for seed in range(12)] == [[]] * 12


@pytest.mark.long
def test_no_recording_of_600_of_the_model_has_a_finding(monkeypatch):
    """None of 600 rejects a rate of 5 in 1000 with a probability of 95 %, as at most one of a thousand does."""
    for model in (MODEL, make_model()):
        simulated = checks._simulate(draw(model, 0), model, 1)  # the same for all seeds
        for y in simulated.values():
            y.flags.writeable = False
        monkeypatch.setattr(checks, "_simulate", lambda *_, simulated=simulated: simulated)
        for seed in range(300):
            assert list_finding_kinds(draw(model, seed), model) == [], seed


def test_without_a_model_a_clean_recording_has_no_findings():
    assert [list_finding_kinds(draw(MODEL, seed), None) for seed in range(12)] == [[]] * 12


def test_clean_recording_is_not_changed():
    recording = draw(MODEL, 1)
    checked = check_recording(recording, MODEL, 1).recording
    assert all(np.array_equal(checked.values[axis], recording.values[axis]) for axis in AXES)


def test_wrong_unit_and_swapped_axes_are_found_and_corrected_together():
    recording = draw(MODEL, 1)
    wrong = {
        "gx": recording.values["gy"] * np.pi / 180.0,
        "gy": recording.values["gx"] * np.pi / 180.0,
        "gz": recording.values["gz"] * np.pi / 180.0,
    }
    checked = check_recording(changed(recording, **wrong), MODEL, 1)
    assert [one.kind for one in checked.findings] == ["unit_error", "axes_permuted"]
    assert all(one.corrected for one in checked.findings)
    for axis in AXES:
        np.testing.assert_allclose(checked.recording.values[axis], recording.values[axis], rtol=1e-12)


def test_most_serious_finding_is_first():
    recording = draw(MODEL, 1)
    wrong = {axis: 1000.0 * recording.values[axis] for axis in AXES[:3]}
    wrong["ax"] = recording.values["ax"].copy()
    wrong["ax"][0] = 50.0
    found = list_finding_kinds(changed(recording, **wrong))
    assert found == ["unit_error", "corrupt_rows"]
    assert found == sorted(found, key=FINDING_KINDS.index)


def test_knock_does_not_hide_a_corrupt_row():
    recording = draw(MODEL, 1)
    t = np.arange(60)
    values = {axis: y.copy() for axis, y in recording.values.items()}
    for y in values.values():
        y[8000:8060] += 60.0 * np.std(np.diff(y)) * np.exp(-t / 15.0) * np.sin(1.1 * t)
        y[3000] += 50.0 * np.std(np.diff(y))
    found = check_recording(changed(recording, **values), MODEL, 1).findings
    assert [one.kind for one in found] == ["corrupt_rows", "motion"]
    assert found[0].parameters["time"].value == pytest.approx(30.0)


def test_too_short_recording_is_not_changed():
    recording = draw(MODEL, 1, 1000)
    assert check_recording(recording, MODEL, 1).recording is recording
