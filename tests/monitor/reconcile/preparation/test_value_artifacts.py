"""Tests of the detection of quantization steps, clipping and repeated samples."""

import numpy as np
import pytest

from monitor.reconcile.preparation.value_artifacts import (
    ValueArtifacts,
    detect_clipping,
    detect_quantization,
    detect_repeats,
)

N = 30_000
DEGREE = np.pi / 180.0


def draw_noise(seed=0, n=N):
    return np.random.default_rng(seed).standard_normal(n)


def repeat_samples(x, share, seed=1):
    toss = np.random.default_rng(seed).random(x.size) < share
    toss[0] = False
    return x[np.maximum.accumulate(np.where(toss, 0, np.arange(x.size)))], toss


def as_float32(x):
    return x.astype(np.float32).astype(float)


@pytest.mark.parametrize("step", [1.37e-5, 2.1e-3, 0.07, 0.61, 1.9])
@pytest.mark.parametrize("scale", [1.5e-3, 1.0, 400.0])
def test_values_on_a_grid_show_its_step(step, scale):
    found = detect_quantization(scale * step * np.rint((draw_noise() + 3.3) / step))
    assert found.step.value == pytest.approx(scale * step, rel=1e-9)
    assert found.step.lo <= scale * step <= found.step.hi * (1.0 + 1e-12)
    assert found.gain > 1e4


@pytest.mark.parametrize("step", [1.3e-3, 0.07, 0.61])
def test_grid_survives_float32_and_nine_digits(step):
    y = 1e-3 * step * np.rint((draw_noise() + 3.3) / step)
    for written in (as_float32(y), np.array([float(f"{x:.9g}") for x in y])):
        assert detect_quantization(written).step.value == pytest.approx(1e-3 * step, rel=1e-4)


def test_grid_with_an_offset_is_detected():
    assert detect_quantization(0.25 * np.rint(draw_noise() / 0.25) + 9.81).step.value == pytest.approx(0.25)


@pytest.mark.parametrize("decimals", [6, 8])
def test_coarse_grid_rounded_in_text_is_neither_the_grid_of_the_text_nor_clipping(decimals):
    step = np.radians(1.0 / 131.0)
    counts = np.rint(0.5 * np.random.default_rng(0).standard_normal(60_000))  # five levels
    written = np.radians(np.round(np.degrees(counts * step), decimals))
    found = detect_quantization(written)
    assert found.step.value == pytest.approx(step, rel=1e-3)
    assert found.levels == 5
    clipped = detect_clipping(written, found.step.value)
    assert clipped is None or clipped.gain < 3.0


@pytest.mark.parametrize(
    "written",
    [
        lambda x: x,
        as_float32,
        lambda x: as_float32(x + 9.81),
        lambda x: x.round(4),
        lambda x: (x + 9.81).round(3),
        lambda x: np.array([float(f"{v:.5g}") for v in x]),
        lambda x: DEGREE * x.round(3),
        lambda x: as_float32(DEGREE * x.round(3)),
        lambda x: 9.80665 * (x + 1.0).round(3),
    ],
    ids=["float64", "float32", "float32 of g", "decimals", "decimals of g", "digits", "degrees", "float32 deg", "g"],
)
def test_rounding_of_floats_and_text_is_no_grid(written):
    assert detect_quantization(written(draw_noise())) is None


def test_decimals_as_coarse_as_the_noise_are_a_grid():
    assert detect_quantization(draw_noise().round(0)).step.value == pytest.approx(1.0)


def test_one_value_off_the_grid_excludes_the_grid():
    y = 0.1 * np.rint(draw_noise() / 0.1)
    y[777] += 0.031
    assert detect_quantization(y) is None


@pytest.mark.parametrize("y", [np.zeros(0), np.full(100, np.nan), np.ones(5000), np.arange(9.0)])
def test_uninformative_values_give_no_result(y):
    assert detect_quantization(y) is None
    assert detect_clipping(y) is None
    assert detect_repeats(y) is None


def test_missing_samples_are_ignored():
    y = repeat_samples(np.clip(draw_noise(), -2.5, 2.5), 0.02)[0]
    y[draw_noise(3) > 1.0] = np.nan
    assert detect_clipping(y).limit.value == 2.5
    assert detect_repeats(y, limit=2.5).fraction.value == pytest.approx(0.02, rel=0.3)
    assert detect_quantization(0.1 * np.rint(y / 0.1)).step.value == pytest.approx(0.1)


@pytest.mark.parametrize("limit", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("mean", [0.0, -0.4])
def test_clipped_noise_shows_its_limit(limit, mean):
    x = draw_noise() + mean
    found = detect_clipping(np.clip(x, -limit, limit))
    assert found.limit.lo <= limit <= found.limit.hi
    assert found.count == np.count_nonzero(np.abs(x) >= limit)
    assert found.symmetric
    assert found.gain > 50.0


def test_clipping_at_one_end_and_a_limit_that_is_exceeded_elsewhere():
    x = draw_noise()
    one = detect_clipping(np.clip(x + 2.0, -3.5, 3.5))
    assert one.symmetric
    passed = detect_clipping(np.minimum(x, 2.0))
    assert not passed.symmetric


@pytest.mark.parametrize("step", [0.1, 0.4])
def test_clipped_and_stepped_noise_shows_its_limit_to_half_a_step(step):
    found = detect_clipping(step * np.rint(np.clip(draw_noise(n=360_000), -1.9, 1.9) / step), step)
    assert found.limit.lo <= 1.9 <= found.limit.hi
    assert found.gain > 50.0


def draw_line(n=N):
    return 8.0 * np.sin(2.0 * np.pi * 0.173 * np.arange(n))


@pytest.mark.parametrize(
    "x",
    [
        draw_noise(),
        draw_noise() + np.cumsum(0.02 * draw_noise(1)),
        0.3 * draw_noise() + draw_line(),
        np.random.default_rng(2).standard_t(4, N),
        draw_noise() * np.where(np.arange(N) < N // 2, 1.0, 3.0),
        np.convolve(draw_noise(), [0.3, 0.5, 0.3], mode="same"),
        repeat_samples(draw_noise(), 0.3)[0],
    ],
    ids=["white", "walk", "line", "t", "step", "coloured", "held"],
)
@pytest.mark.parametrize("step", [0.0, 0.05, 0.5])
def test_other_signals_are_not_clipped(x, step):
    found = detect_clipping(step * np.rint(x / step) if step else x, step)
    assert found is None or found.gain < 8.0


@pytest.mark.parametrize("share", [5e-4, 0.02, 0.4])
def test_each_repeat_of_continuous_values_is_known(share):
    y, which = repeat_samples(draw_noise(), share)
    found = detect_repeats(y)
    assert np.array_equal(found.mask, which)
    assert found.fraction.lo <= share <= found.fraction.hi
    assert found.gain > 20.0


@pytest.mark.parametrize("step", [1e-3, 0.1, 0.7])
def test_repeats_of_stepped_values_are_counted(step):
    y = step * np.rint(repeat_samples(draw_noise(n=200_000), 0.05)[0] / step)
    found = detect_repeats(y, step)
    assert found.fraction.value == pytest.approx(0.05, rel=0.15)
    assert found.fraction.lo < found.fraction.value < found.fraction.hi
    assert not found.mask.any()
    assert found.gain > 50.0


def test_clipped_samples_are_no_repeats():
    y = np.clip(draw_noise(), -1.0, 1.0)
    assert np.count_nonzero(np.diff(y) == 0.0) > 1000
    assert detect_repeats(y, limit=1.0) is None


@pytest.mark.parametrize(
    "x",
    [
        draw_noise(),
        np.convolve(draw_noise(), [0.2, 0.6, 0.2], mode="same"),
        np.random.default_rng(2).standard_t(4, N),
        draw_noise() * np.where(np.arange(N) < N // 2, 1.0, 3.0),
        np.where(draw_noise(4) > 2.0, 9.0, 1.0) * draw_noise(),
        draw_noise() + draw_line(),
    ],
    ids=["white", "coloured", "t", "step", "outliers", "line"],
)
@pytest.mark.parametrize("step", [0.0, 0.01, 0.3, 0.9, 3.0])
def test_other_signals_have_no_repeats(x, step):
    found = detect_repeats(step * np.rint(x / step) if step else x, step)
    assert found is None or found.gain < 8.0


def test_repeats_on_an_unknown_grid_are_not_known():
    found = detect_repeats(0.05 * np.rint(draw_noise() / 0.05))
    assert found is None or (found.gain < 8.0 and not found.mask.any())


def test_grid_much_finer_than_the_noise_is_no_artifact():
    step = 0.0051373
    y = step * np.rint(np.random.default_rng(3).standard_normal(100_000) / step)
    assert detect_quantization(y).step.value == pytest.approx(step, rel=1e-6)
    found = ValueArtifacts(y)
    assert found.quantization is None
    assert found.repeats is None or found.repeats.gain < 1.0  # equal values are expected on this grid
    assert ValueArtifacts(3.0 * step * np.rint(y / (3.0 * step))).quantization is not None
