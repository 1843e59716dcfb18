from itertools import permutations

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import AngleRandomWalk, Narrowband
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.axis_permutation import compute_resonance_log_power_variances, reorder_axes
from monitor.reconcile.recording_checks.checks import check_recording
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, changed, draw, make_model

MODEL = make_model()


@pytest.mark.parametrize("order", [one for one in permutations((0, 1, 2)) if one != (0, 1, 2)])
@pytest.mark.parametrize("triad", [AXES[:3], AXES[3:]])
def test_permuted_axes_are_restored(order, triad):
    recording = draw(MODEL, 5)
    wrong = changed(recording, **{triad[at]: recording.values[triad[to]] for at, to in enumerate(order)})
    checked = check_recording(wrong, MODEL, 1)
    (finding,) = checked.findings
    assert finding.kind == "axes_permuted"
    assert set(finding.axes) == {triad[at] for at, to in enumerate(order) if at != to}
    assert {axis: one.value for axis, one in finding.parameters.items()} == {
        triad[at]: triad[to] for at, to in enumerate(order) if at != to
    }
    for axis in AXES:
        assert np.array_equal(checked.recording.values[axis], recording.values[axis])


def test_axes_with_the_same_noise_keep_their_order():
    model = NoiseModel({axis: (AngleRandomWalk(N=1e-4),) for axis in AXES}, RATE_HZ)
    recording = draw(model, 5)
    swapped = changed(recording, gx=recording.values["gy"], gy=recording.values["gx"])
    assert check_recording(swapped, model, 1).findings == ()


def test_other_noise_level_on_one_axis_is_no_permutation():
    recording = draw(MODEL, 5)
    assert check_recording(changed(recording, gx=1.3 * recording.values["gx"]), MODEL, 1).findings == ()


@pytest.mark.parametrize("seed", range(3))
def test_slow_noise_on_one_of_two_similar_axes_is_no_permutation(seed):
    """With slow noise, gx is closer to the model of gy than to its own model, but fits neither."""
    densities = {"gx": 1.0e-4, "gy": 1.1e-4, "gz": 0.8e-4}
    model = NoiseModel({axis: (AngleRandomWalk(N=N),) for axis, N in densities.items()}, RATE_HZ)
    recording = draw(model, seed)
    n = recording.values["gx"].size
    drift = np.cumsum(3e-3 * RATE_HZ**-0.5 * np.random.default_rng(seed).standard_normal(n) / RATE_HZ)
    louder = 1.35 * recording.values["gx"] + drift
    assert check_recording(changed(recording, gx=louder), model, seed).findings == ()


def test_reordering_is_the_inverse_of_the_permutation():
    values = {axis: k for k, axis in enumerate(AXES)}
    assert reorder_axes(values, AXES[3:], (2, 0, 1)) == {**values, "az": 3, "ax": 4, "ay": 5}


def test_power_of_a_narrow_resonance_is_uncertain():
    ((f_hz, variance),) = compute_resonance_log_power_variances(
        [Narrowband(sigma=1.0, frequency=9.0, bandwidth=1e-3), AngleRandomWalk(N=1.0)], 10.0
    )
    assert f_hz == 9.0
    assert 1.9 < variance < 2.0
