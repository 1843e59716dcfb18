"""Tests of the plot data: curves equal the measured values, and bands contain the stated share of recordings."""

import allantools
import numpy as np
import pytest
from scipy.special import erfc

from monitor.noise.effects import RandomSampleHold
from monitor.noise.model import NoiseModel
from monitor.reconcile.diagnostics.plot_data import build_plot_data
from tests.monitor.reconcile.axes import (
    RATE_HZ,
    TERMS,
    WALK,
    WHITE,
    N,
    axis,
    make_temperature,
    time_s,
    walk,
    white,
    whiten,
)

n = 24_000
MODEL = (WHITE, WALK)


def draw_noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def drawn(y, model=MODEL, temperature_c=None):
    return {view.diagnostic: view for view in build_plot_data(whiten(axis(y, model, temperature_c), model))}


def test_every_plot_has_data():
    found = drawn(draw_noise() + 0.5, TERMS, make_temperature(n))
    assert set(found) == {"psd", "allan", "level", "variance", "tails", "autocorrelation", "temperature"}
    for view in found.values():
        arrays = (view.x, view.measured, view.expected, view.lo, view.hi)
        assert {one.shape for one in arrays} == {view.x.shape}
        assert 4 < view.x.size <= 300
        assert all(np.isfinite(one).all() for one in arrays)
        assert np.all(np.diff(view.x) > 0.0)
        assert np.all(view.lo <= view.expected)
        assert np.all(view.expected <= view.hi)
        if view.log:
            assert all((one > 0.0).all() for one in arrays)
        assert view.x_name
        assert view.y_name
        assert view.x_unit
        assert view.y_unit


def test_plots_have_the_units_of_the_axis():
    units = {view.diagnostic: view.y_unit for view in build_plot_data(whiten(axis(draw_noise()), MODEL))}
    assert units["psd"] == "(rad/s)²/Hz"
    assert units["allan"] == units["level"] == "rad/s"


def test_without_temperature_there_is_no_temperature_plot():
    assert "temperature" not in drawn(draw_noise())
    assert "temperature" not in drawn(draw_noise(), temperature_c=np.full(n, 25.0))


def test_spectrum_equals_the_model_and_its_band_contains_the_data():
    inside = []
    for seed in range(6):
        view = drawn(draw_noise(seed))["psd"]
        expected = NoiseModel({"gz": MODEL}).two_sided_psd("gz", view.x, 1.0 / RATE_HZ)
        assert np.median(view.expected / expected) == pytest.approx(1.0, abs=0.01)
        assert view.expected == pytest.approx(expected, rel=0.25)  # wide points where it is steep
        inside.append(np.mean((view.lo <= view.measured) & (view.measured <= view.hi)))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.025)


def test_allan_deviation_equals_allantools_and_the_model():
    y = draw_noise(1)
    view = drawn(y)["allan"]
    _, peers, _, _ = allantools.oadev(y, rate=RATE_HZ, data_type="freq", taus=view.x)
    assert view.measured == pytest.approx(peers, rel=1e-6)
    expected = np.sqrt(NoiseModel({"gz": MODEL}).avar("gz", view.x, 1.0 / RATE_HZ))
    short = view.x < 30.0
    assert view.expected[short] == pytest.approx(expected[short], rel=0.05)
    assert view.x[0] == pytest.approx(1.0 / RATE_HZ)


def test_allan_band_contains_simulated_recordings():
    inside = np.array(
        [(v.lo <= v.measured) & (v.measured <= v.hi) for v in (drawn(draw_noise(k))["allan"] for k in range(40))]
    )
    short = slice(0, inside.shape[1] - 3)  # at the longest τ there are a handful of intervals
    assert inside[:, short].mean() == pytest.approx(0.95, abs=0.04)


def test_level_is_the_mean_of_blocks_and_a_step_exceeds_the_band():
    y = draw_noise(2) + 0.7
    view = drawn(y)["level"]
    size = n // view.x.size
    assert view.measured[3] == pytest.approx(y[3 * size : 4 * size].mean())
    assert view.x[3] == pytest.approx(3.5 * size / RATE_HZ)
    assert np.mean((view.lo <= view.measured) & (view.measured <= view.hi)) > 0.85
    step = drawn(y + 3e-3 * (time_s(n) > 120.0))["level"]
    assert np.mean((step.lo <= step.measured) & (step.measured <= step.hi)) < 0.3


def test_noise_level_over_time_is_measured():
    steady = drawn(draw_noise(3))["variance"]
    assert np.mean((steady.lo <= steady.measured) & (steady.measured <= steady.hi)) == pytest.approx(0.95, abs=0.05)
    louder = drawn(draw_noise(3) * np.where(time_s(n) < 120.0, 1.0, 2.0))["variance"]
    half = louder.x.size // 2
    assert louder.measured[half + 2 :].mean() / louder.measured[: half - 2].mean() == pytest.approx(2.0, rel=0.05)


def test_tails_equal_those_of_a_gaussian():
    view = drawn(draw_noise(4))["tails"]
    near = view.x < 3.0
    assert view.expected[near] == pytest.approx(erfc(view.x[near] / 2**0.5))
    assert view.measured[near] == pytest.approx(view.expected[near], rel=0.35)
    y = draw_noise(4)
    y[::2000] += 30.0 * N * RATE_HZ**0.5
    far = drawn(y)["tails"]
    assert far.measured[far.x > 5.0].max() > 10 * far.hi[far.x > 5.0].max() or far.x[-1] > 20.0
    assert np.any(far.measured > far.hi)


def test_level_follows_temperature():
    warm = make_temperature(n)
    view = drawn(draw_noise(5) + 1e-3 * (warm - 25.0), MODEL, warm)["temperature"]
    slope, _ = np.polyfit(view.x, view.measured, 1)
    assert slope == pytest.approx(1e-3, rel=0.05)
    assert np.mean((view.measured < view.lo) | (view.measured > view.hi)) > 0.5
    steady = drawn(draw_noise(5), MODEL, warm)["temperature"]
    assert np.mean((steady.lo <= steady.measured) & (steady.measured <= steady.hi)) > 0.7


def test_correlation_of_adjacent_samples_is_measured():
    view = drawn(draw_noise(6))["autocorrelation"]
    assert view.x[0] == pytest.approx(1.0 / RATE_HZ)
    assert np.mean(np.abs(view.measured) <= view.hi) > 0.85
    y = draw_noise(6)
    y[1:] += 0.5 * y[:-1]
    assert drawn(y)["autocorrelation"].measured[0] > 10 * view.hi[0]


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_runs_of_equal_values_are_compared_with_the_fraction_of_the_model(step):
    rng = np.random.default_rng(7)
    y = white(n, rng)
    if step:
        y = step * N * RATE_HZ**0.5 * np.rint(y / (step * N * RATE_HZ**0.5))
    for at in np.flatnonzero(rng.random(n) < 0.2):
        y[at] = y[at - 1] if at else y[at]
    before = drawn(y, (WHITE,))["values"]
    assert (before.measured > before.hi)[1:4].all()
    after = drawn(y, (WHITE, RandomSampleHold(fraction=0.2)))["values"]
    assert after.measured[:4] == pytest.approx(after.expected[:4], rel=0.15)
    assert "values" not in drawn(draw_noise())
