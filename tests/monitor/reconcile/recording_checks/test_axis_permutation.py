from itertools import permutations

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import AngleRandomWalk, Narrowband
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.axis_permutation import (
    compute_resonance_log_power_variances,
    compute_robust_spectrum,
    reorder_axes,
)
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


def test_a_factor_of_the_samples_is_a_factor_of_all_bands():
    y = np.random.default_rng(0).standard_normal(20_000)
    one, two = compute_robust_spectrum(y, 100.0), compute_robust_spectrum(np.pi * y + 7.0, 100.0)
    np.testing.assert_allclose(two.log_power - one.log_power, 2.0 * np.log(np.pi), atol=1e-9)


def test_the_error_is_the_scatter_between_recordings():
    rng = np.random.default_rng(1)
    many = [compute_robust_spectrum(rng.standard_normal(16_000), 100.0) for _ in range(200)]
    scatter = np.std([one.log_power for one in many], axis=0)
    told = np.mean([one.error for one in many], axis=0)
    assert 0.8 < np.median(told / scatter) < 1.25


def test_a_knock_and_a_hole_change_little():
    y = np.random.default_rng(2).standard_normal(20_000)
    changed = y.copy()
    changed[5000:5050] += 100.0
    changed[9000:9600] = np.nan
    one, two = compute_robust_spectrum(y, 100.0), compute_robust_spectrum(changed, 100.0)
    assert np.abs(two.log_power - one.log_power).max() < 5.0 * one.error.max()


def test_too_few_samples_or_no_noise_give_no_spectrum():
    assert compute_robust_spectrum(np.full(20_000, np.nan), 100.0) is None
    assert compute_robust_spectrum(np.ones(20_000), 100.0) is None
