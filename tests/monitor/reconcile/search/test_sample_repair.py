"""Tests that missing, repeated, clipped and outlying samples are repaired only if the model has these effects."""

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.noise.effects import AngleRandomWalk, Outliers, RandomSampleHold, Resolution, Saturation
from monitor.reconcile.preparation.value_artifacts import ValueArtifacts
from monitor.reconcile.search.sample_repair import (
    _may_leak,
    _repair_samples,
    repair_axis_again,
)
from tests.monitor.reconcile.axes import RATE_HZ, WHITE, N, axes, axis, correlated, white

n = 12_000
SIGMA = N * RATE_HZ**0.5
RNG = 7


def draw_noise(seed=0):
    return white(n, np.random.default_rng(seed))


def test_gaps_are_filled_from_adjacent_samples():
    y = correlated(n, np.random.default_rng(1), 1e-3, 2.0) + white(n, np.random.default_rng(2), 0.1 * N)
    holed = y.copy()
    lost = np.random.default_rng(3).random(n) < 0.1
    lost[5000:5100] = True
    holed[lost] = np.nan
    one = axis(holed, (WHITE,))
    np.testing.assert_array_equal(one.repaired[~lost], y[~lost])
    assert np.isfinite(one.repaired).all()
    assert np.std(one.repaired[lost] - y[lost]) < 0.5 * np.std(y)
    assert np.isnan(one.raw[lost]).all()


def test_input_is_not_changed():
    y = draw_noise()
    y[::50] = np.nan
    kept = y.copy()
    axes({"gx": y, "gz": draw_noise(1)}, (WHITE, Outliers(fraction=0.01, scale=1e-2), Saturation(limit=1.5e-3)))
    np.testing.assert_array_equal(y, kept)


def test_repeats_are_repaired_if_the_model_has_them():
    y, rng = draw_noise(), np.random.default_rng(4)
    held = rng.random(n) < 0.2
    held[0] = False
    for at in np.flatnonzero(held):
        y[at] = y[at - 1]
    shown = ValueArtifacts(y)
    assert shown.repeats is not None
    assert shown.repeats.fraction.value == pytest.approx(0.2, abs=0.03)
    as_it_is = _repair_samples(y, shown, (WHITE,), np.random.default_rng(RNG))
    np.testing.assert_array_equal(as_it_is, y)
    put_right = _repair_samples(y, shown, (WHITE, RandomSampleHold(fraction=0.2)), np.random.default_rng(RNG))
    assert np.count_nonzero(np.diff(put_right) == 0.0) == 0
    np.testing.assert_array_equal(put_right[~held], y[~held])
    assert np.std(put_right) == pytest.approx(SIGMA, rel=0.03)


def test_clipped_samples_are_drawn_beyond_the_limit():
    y = draw_noise()
    limit = 2.0 * SIGMA
    clipped = np.clip(y, -limit, limit)
    shown = ValueArtifacts(clipped)
    assert shown.clipping is not None
    mended = _repair_samples(clipped, shown, (WHITE, Saturation(limit=limit)), np.random.default_rng(RNG))
    at_limit = np.abs(clipped) >= limit
    np.testing.assert_array_equal(mended[~at_limit], clipped[~at_limit])
    assert np.all(np.abs(mended[at_limit]) >= limit * (1 - 1e-9))
    assert np.all(np.sign(mended[at_limit]) == np.sign(clipped[at_limit]))
    assert np.std(clipped) < 0.97 * SIGMA
    assert np.std(mended) == pytest.approx(SIGMA, rel=0.025)
    np.testing.assert_array_equal(_repair_samples(clipped, shown, (WHITE,), np.random.default_rng(RNG)), clipped)


def test_outliers_are_treated_as_missing_if_the_model_has_them():
    y, rng = draw_noise(), np.random.default_rng(5)
    far = rng.choice(n, 30, replace=False)
    y[far] += 20.0 * SIGMA * rng.choice([-1.0, 1.0], 30)
    plain = axis(y, (WHITE,))
    np.testing.assert_array_equal(plain.repaired, y)
    mended = axis(y, (WHITE, Outliers(fraction=30 / n, scale=20.0 * SIGMA)))
    assert np.abs(mended.repaired[far]).max() < 6.0 * SIGMA
    changed = np.flatnonzero(mended.repaired != y)
    assert set(far) <= set(changed)
    assert changed.size < 40
    np.testing.assert_array_equal(mended.raw, y)


def test_same_generator_gives_the_same_axis():
    y = draw_noise()
    y[::9] = np.nan
    one, other = axis(y, (WHITE,)), axis(y, (WHITE,))
    np.testing.assert_array_equal(one.coefficients, other.coefficients)
    third = axes({"gz": y}, (WHITE,), seed=1)["gz"]
    assert not np.array_equal(one.coefficients, third.coefficients)


def test_repair_for_other_effects_equals_a_new_preparation():
    y = np.clip(draw_noise(), -1.5 * SIGMA, 1.5 * SIGMA)
    model = (WHITE, Saturation(limit=1.5 * SIGMA))
    later = repair_axis_again(axis(y, (WHITE,)), model, np.random.default_rng(0))
    np.testing.assert_allclose(later.coefficients, axis(y, model).coefficients)
    back = repair_axis_again(later, (WHITE,), np.random.default_rng(0))
    np.testing.assert_array_equal(back.repaired, y)


def test_axes_leak_only_into_possible_targets():
    into = {one: {other for other in AXES if _may_leak(other, one)} for one in AXES}
    assert into["gx"] == {"gy", "gz", "ax", "ay", "az"}
    assert into["ay"] == {"ax", "az"}
    every = axes({name: draw_noise(k) for k, name in enumerate(AXES)}, (AngleRandomWalk(N=N),))
    assert {name: set(one.leak_sources) for name, one in every.items()} == into


def test_artifacts_of_values_are_detected():
    y = draw_noise()
    shown = ValueArtifacts(y)
    assert shown.quantization is None
    coarse = ValueArtifacts(4e-4 * np.rint(y / 4e-4))
    assert coarse.quantization is not None
    assert coarse.quantization.step.value == pytest.approx(4e-4)
    # repeats of coarse values are no repeats of samples
    one = axis(4e-4 * np.rint(y / 4e-4), (WHITE, Resolution(step=4e-4)))
    np.testing.assert_array_equal(one.repaired, one.raw)
