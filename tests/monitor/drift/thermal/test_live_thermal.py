"""A device's samples in, intervals with what was expected of them out; however the samples are cut."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from drivers.data_types import make_block
from monitor.drift.thermal.live_thermal import KIND, LiveThermalModels
from tests.monitor.drift.made import COEFFICIENT, late, weather

RATE_HZ = 0.1
INTERVAL_S = 600.0
LENGTH = 60
PERIOD_NS = round(1e9 / RATE_HZ)


def day(hours: int, seed: int, step: float = 0.0, at_h: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """gz follows temperature an hour late, az does not, the others are not measured; a sample every 10 s."""
    rng = np.random.default_rng(seed)
    warmth = weather(hours, rng)
    inside = late(warmth, 1.0)
    t = np.arange(hours * 360) / 6.0
    minutes = np.arange(-48 * 60, hours * 60)
    values = np.full((t.size, 6), np.nan)
    values[:, 2] = COEFFICIENT * np.interp(t, minutes, inside) + 8e-6 * rng.standard_normal(t.size)
    values[:, 2] += step * (t >= 60.0 * at_h)
    values[:, 5] = 9.81 + 1e-4 * rng.standard_normal(t.size)
    return values, np.interp(t, minutes, warmth)


def fed(live, values, warmth, edges=None, lost=0, choose=True):
    """Looks of all samples, cut at the edges; ``lost`` samples are missing before the last piece."""
    looks = []
    edges = edges or [*range(0, len(values), LENGTH), len(values)]
    for lo, hi in pairwise(edges):
        missing = lost if hi == edges[-1] else 0
        t_ns = PERIOD_NS * (np.arange(lo, hi) + missing)
        looks += live.process_block(make_block(t_ns, values[lo:hi], warmth[lo:hi], None, missing))
        while choose and live.run_selection_step_if_active():
            pass
    return looks


@pytest.mark.long
def test_bias_is_expected_from_temperature():
    looks = fed(live := LiveThermalModels(RATE_HZ, INTERVAL_S), *day(24, 1))
    assert len(looks) == 144
    assert [list(look.axes) for look in looks] == [["gz", "az"]] * 144
    assert [look.t_ns for look in looks] == [PERIOD_NS * (LENGTH * (k + 1) - 1) for k in range(144)]
    last = looks[-1]
    assert last.interval_s == INTERVAL_S
    assert last.axes["gz"].slope == pytest.approx(COEFFICIENT, rel=0.2)
    assert abs(last.axes["az"].slope) < 1e-5
    inside = [look.axes["gz"].one_step.side_of_interval(look.axes["gz"].bias) == 0 for look in looks[20:]]
    assert np.mean(inside) > 0.85
    assert live.take_events() == []


STEP, AT_H = 2e-4, 12.0


@cache
def stepped():
    """Looks and events of a record whose bias steps, interval by interval."""
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    return fed(live, *day(14, 2, STEP, AT_H)), live.take_events()


@pytest.mark.long
@pytest.mark.parametrize("edges", [[1, 2, 59, 61, 1000, 3001], range(0, 5040, 7)], ids=["few", "many"])
def test_how_samples_are_cut_makes_no_difference(edges):
    values, warmth = day(14, 2, STEP, AT_H)
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    # choices are made at the end of each interval, as in the other
    looks = fed(live, values, warmth, sorted({*edges, *range(0, 5041, LENGTH)}))
    others, events = stepped()
    assert repr(looks) == repr(others)  # NaN for NaN
    assert live.take_events() == events


def test_a_step_of_the_bias_is_an_event():
    _, (event,) = stepped()
    assert (event.kind, event.axis) == (KIND, "gz")
    assert event.values["bias"]["size"] == pytest.approx(STEP, rel=0.15)
    assert event.since_ns == pytest.approx(AT_H * 3600e9, abs=INTERVAL_S * 1e9)
    assert event.t_ns - event.since_ns == pytest.approx(4 * INTERVAL_S * 1e9, rel=0.3)
    assert event.sigma > 5.0
    assert event.text.startswith("gz differs by +0.01")
    assert "4 of the last" in event.text


def test_without_temperature_nothing_is_kept():
    values, _ = day(2, 4)
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    assert fed(live, values, np.full(len(values), np.nan)) == []
    assert not live.is_selecting_model
    looks = fed(live, *day(1, 5), lost=0)  # it begins with the first temperature
    assert len(looks) == 6
    assert looks[0].axes["gz"].text.startswith("1 intervals")


def test_intervals_keep_their_places_across_a_hole():
    values, warmth = day(2, 6)
    looks = fed(LiveThermalModels(RATE_HZ, INTERVAL_S), values, warmth, [0, 300, 720], lost=LENGTH * 4 + 30)
    ends = np.array([look.t_ns for look in looks]) / PERIOD_NS + 1
    assert ends.tolist() == [60, 120, 180, 240, 300, *range(600, 961, 60)]  # half an interval is enough


def test_another_rate_begins_anew():
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    assert len(fed(live, *day(3, 7))) == 18
    live.set_rate(RATE_HZ * 1.001)
    assert fed(live, *day(1, 8))[-1].axes["gz"].one_step is not None
    live.set_rate(RATE_HZ * 2.0)
    looks = fed(live, *day(1, 8))
    assert len(looks) == 3
    assert looks[-1].axes["gz"].text.startswith("3 intervals")


@pytest.mark.long
def test_a_new_offset_leaves_nothing_of_the_interval_in_which_it_came():
    values, warmth = day(12, 9)
    live = LiveThermalModels(RATE_HZ, INTERVAL_S)
    fed(live, values[:4000], warmth[:4000])  # 40 samples into an interval
    live.learn_new_offset()
    looks = fed(live, values[4000:] + 1e-3, warmth[4000:])
    assert np.isnan(looks[0].axes["gz"].bias)
    assert looks[1].axes["gz"].bias == pytest.approx(np.mean(values[4020:4080, 2]) + 1e-3, rel=1e-9)
    assert looks[2].axes["gz"].one_step is None
    assert live.take_events() == []
