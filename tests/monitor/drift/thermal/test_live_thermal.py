"""Tests of live thermal models: predictions, events, gaps, rates and block sizes."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from drivers.data_types import make_block
from monitor.drift.thermal.live_thermal import KIND, LiveThermalModels
from tests.monitor.drift.thermal_biases import BIAS_SLOPE, apply_lag, simulate_temperature

RATE_HZ = 0.1
INTERVAL_S = 600.0
INTERVAL_SAMPLES = 60
PERIOD_NS = round(1e9 / RATE_HZ)


def simulate_hours(hours: int, seed: int, step: float = 0.0, at_h: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a sample every 10 s; gz follows temperature one hour late, az is independent, others are missing."""
    rng = np.random.default_rng(seed)
    temperature_c = simulate_temperature(hours, rng)
    inside = apply_lag(temperature_c, 1.0)
    t = np.arange(hours * 360) / 6.0
    minutes = np.arange(-48 * 60, hours * 60)
    values = np.full((t.size, 6), np.nan)
    values[:, 2] = BIAS_SLOPE * np.interp(t, minutes, inside) + 8e-6 * rng.standard_normal(t.size)
    values[:, 2] += step * (t >= 60.0 * at_h)
    values[:, 5] = 9.81 + 1e-4 * rng.standard_normal(t.size)
    return values, np.interp(t, minutes, temperature_c)


def process_in_blocks(live, values, temperature_c, edges=None, lost=0, choose=True):
    """Return the results of all blocks; ``lost`` samples are missing before the last block."""
    results = []
    edges = edges or [*range(0, len(values), INTERVAL_SAMPLES), len(values)]
    for lo, hi in pairwise(edges):
        missing = lost if hi == edges[-1] else 0
        t_ns = PERIOD_NS * (np.arange(lo, hi) + missing)
        results += live.process_block(make_block(t_ns, values[lo:hi], temperature_c[lo:hi], None, missing))
        while choose and live.run_selection_step_if_active():
            pass
    return results


@pytest.mark.long
def test_bias_is_predicted_from_temperature():
    results = process_in_blocks(live := LiveThermalModels(RATE_HZ, INTERVAL_S), *simulate_hours(24, 1))
    assert len(results) == 144
    assert [list(result.axes) for result in results] == [["gz", "az"]] * 144
    assert [result.t_ns for result in results] == [PERIOD_NS * (INTERVAL_SAMPLES * (k + 1) - 1) for k in range(144)]
    last = results[-1]
    assert last.interval_s == INTERVAL_S
    assert last.axes["gz"].slope == pytest.approx(BIAS_SLOPE, rel=0.2)
    assert abs(last.axes["az"].slope) < 1e-5
    inside = [result.axes["gz"].one_step.side_of_interval(result.axes["gz"].bias) == 0 for result in results[20:]]
    assert np.mean(inside) > 0.85
    assert live.take_events() == []


STEP, AT_H = 2e-4, 12.0


@cache
def simulate_bias_step():
    """Return results and events of a recording whose bias steps, processed one interval at a time."""
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    return process_in_blocks(live, *simulate_hours(14, 2, STEP, AT_H)), live.take_events()


@pytest.mark.long
@pytest.mark.parametrize("edges", [[1, 2, 59, 61, 1000, 3001], range(0, 5040, 7)], ids=["few", "many"])
def test_block_sizes_do_not_change_the_result(edges):
    values, temperature_c = simulate_hours(14, 2, STEP, AT_H)
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    # Models are selected at the end of each interval in both cases.
    results = process_in_blocks(live, values, temperature_c, sorted({*edges, *range(0, 5041, INTERVAL_SAMPLES)}))
    others, events = simulate_bias_step()
    assert repr(results) == repr(others)  # the texts are compared because NaN differs from NaN
    assert live.take_events() == events


def test_step_of_the_bias_is_an_event():
    _, (event,) = simulate_bias_step()
    assert (event.kind, event.axis) == (KIND, "gz")
    assert event.values["bias"]["size"] == pytest.approx(STEP, rel=0.15)
    assert event.since_ns == pytest.approx(AT_H * 3600e9, abs=INTERVAL_S * 1e9)
    assert event.t_ns - event.since_ns == pytest.approx(4 * INTERVAL_S * 1e9, rel=0.3)
    assert event.sigma > 5.0
    assert event.text.startswith("gz differs by +0.01")
    assert "4 of the last" in event.text


def test_intervals_without_temperature_are_not_stored():
    values, _ = simulate_hours(2, 4)
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    assert process_in_blocks(live, values, np.full(len(values), np.nan)) == []
    assert not live.is_selecting_model
    results = process_in_blocks(
        live, *simulate_hours(1, 5), lost=0
    )  # the history starts with the first known temperature
    assert len(results) == 6
    assert results[0].axes["gz"].text.startswith("1 intervals")


def test_intervals_keep_their_positions_across_a_gap():
    values, temperature_c = simulate_hours(2, 6)
    results = process_in_blocks(
        LiveThermalModels(RATE_HZ, INTERVAL_S), values, temperature_c, [0, 300, 720], lost=INTERVAL_SAMPLES * 4 + 30
    )
    ends = np.array([result.t_ns for result in results]) / PERIOD_NS + 1
    assert ends.tolist() == [60, 120, 180, 240, 300, *range(600, 961, 60)]  # half an interval gives a mean


def test_clearly_different_rate_starts_a_new_history():
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    assert len(process_in_blocks(live, *simulate_hours(3, 7))) == 18
    live.set_rate(RATE_HZ * 1.001)
    assert process_in_blocks(live, *simulate_hours(1, 8))[-1].axes["gz"].one_step is not None
    live.set_rate(RATE_HZ * 2.0)
    results = process_in_blocks(live, *simulate_hours(1, 8))
    assert len(results) == 3
    assert results[-1].axes["gz"].text.startswith("3 intervals")


@pytest.mark.long
def test_new_offset_discards_the_interval_in_which_it_occurred():
    values, temperature_c = simulate_hours(12, 9)
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    process_in_blocks(live, values[:4000], temperature_c[:4000])  # 40 samples into an interval
    live.learn_new_offset()
    results = process_in_blocks(live, values[4000:] + 1e-3, temperature_c[4000:])
    assert np.isnan(results[0].axes["gz"].bias)
    assert results[1].axes["gz"].bias == pytest.approx(np.mean(values[4020:4080, 2]) + 1e-3, rel=1e-9)
    assert results[2].axes["gz"].one_step is None
    assert live.take_events() == []
