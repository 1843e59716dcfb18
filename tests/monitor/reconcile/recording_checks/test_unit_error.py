from math import log

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.reconcile.recording_checks.axis_permutation import TriadOrder
from monitor.reconcile.recording_checks.checks import check_recording
from monitor.reconcile.recording_checks.unit_error import (
    CONVERSIONS,
    FULL_SCALES,
    TriadEvidence,
    collect_triad_evidence,
    find_unit_error,
)
from tests.monitor.reconcile.recording_checks.recordings import changed, draw, make_model

GYROS, ACCELEROMETERS = AXES[:3], AXES[3:]


def noise(*ratios):
    return TriadOrder((0, 1, 2), 0.0, np.log(ratios), 0.05)


def factor_of(triad, evidence):
    found = find_unit_error(triad, evidence)
    return None if found is None else found[0]


@pytest.mark.parametrize("name", ["π/180", "180/π", "1000", "1/1000", "2", "1/2", "4"])
def test_wrong_unit_of_the_gyroscopes_is_corrected(name):
    model, factor = make_model(), {**CONVERSIONS, **FULL_SCALES}[name]
    recording = draw(model, 3)
    wrong = changed(recording, **{axis: factor * recording.values[axis] for axis in GYROS})
    (finding,) = (found := check_recording(wrong, model, 1)).findings
    assert (finding.kind, finding.axes, finding.corrected) == ("unit_error", GYROS, True)
    assert name in finding.sentence
    bounds = finding.parameters["factor"]
    assert bounds.lo < factor < bounds.hi
    for axis in GYROS:
        np.testing.assert_allclose(found.recording.values[axis], recording.values[axis], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "with_model"),
    [
        ("9.80665", True),
        *((name, m) for name in ("1/9.80665", "1000", "1000/9.80665", "2", "1/4") for m in (True, False)),
    ],
)
def test_wrong_unit_of_the_accelerometers_is_corrected(name, with_model):
    model, factor = make_model(gravity=True), {**CONVERSIONS, **FULL_SCALES}[name]
    recording = draw(model, 3)
    wrong = changed(recording, **{axis: factor * recording.values[axis] for axis in ACCELEROMETERS})
    (finding,) = check_recording(wrong, model if with_model else None, 1).findings
    assert (finding.kind, finding.axes) == ("unit_error", ACCELEROMETERS)
    assert finding.evidence["nearest_factor"] == factor


def test_factor_far_from_the_list_is_no_unit_error():
    assert factor_of(GYROS, TriadEvidence(noise(5.7, 5.6, 5.8), None, None)) is None
    assert factor_of(GYROS, TriadEvidence(noise(30.0, 30.0, 30.0), None, None)) is None


def test_axes_with_different_factors_are_no_unit_error():
    assert factor_of(GYROS, TriadEvidence(noise(57.3, 57.3, 1.0), None, None)) is None


def test_louder_surroundings_are_no_full_scale_error():
    assert factor_of(GYROS, TriadEvidence(noise(2.0, 2.5, 1.8), None, None)) is None
    assert factor_of(ACCELEROMETERS, TriadEvidence(noise(2.0, 2.0, 2.0), 1.0, None)) is None
    assert factor_of(GYROS, TriadEvidence(noise(2.0, 2.0, 2.0), None, None)) == 2.0


def test_quantization_steps_decide_between_near_factors():
    assert factor_of(GYROS, TriadEvidence(noise(1.45, 1.4, 1.5), None, 2.0)) == 2.0
    assert factor_of(GYROS, TriadEvidence(noise(1.0, 1.0, 1.0), None, 2.0)) is None
    assert factor_of(GYROS, TriadEvidence(noise(1.0, 1.0, 1.0), None, 1.0)) is None


def test_ratio_of_the_steps_is_measured():
    model = make_model(step=8.0)
    recording = draw(model, 1)
    for factor in (1.0, 0.5, np.pi / 180.0, 1000.0):
        values = {axis: factor * recording.values[axis] for axis in GYROS}
        assert collect_triad_evidence(values, GYROS, model, None).step == pytest.approx(factor)


def test_gravity_distinguishes_g_from_a_full_scale():
    assert factor_of(ACCELEROMETERS, TriadEvidence(noise(9.0, 8.8, 8.9), 9.81, None)) == CONVERSIONS["9.80665"]
    assert factor_of(ACCELEROMETERS, TriadEvidence(noise(9.0, 8.8, 8.9), 8.02, None)) == 8.0


def test_interval_holds_the_scatter_from_run_to_run():
    found = find_unit_error(GYROS, TriadEvidence(noise(57.0, 60.0, 55.0), None, None))
    assert found is not None
    bounds = found[1].parameters["factor"]
    assert log(bounds.hi / bounds.lo) == pytest.approx(2.0 * 1.96 * 0.05, rel=1e-3)
