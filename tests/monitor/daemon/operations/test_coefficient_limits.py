"""Tests of coefficient limits, which are crossed when the whole interval stays beyond the limit for the hold time."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from drivers.errors import ConfigError
from monitor.daemon.operations.coefficient_limits import LimitMonitor, make_axis_limits
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status
from monitor.noise.model import NoiseModel
from monitor.publishing.messages.results import EventMessage
from monitor.settings.loading import Limit
from tests.monitor.publishing.example_results import make_estimate

RATE_HZ = 100.0
N_ABOVE = Limit(axes=("gz",), letter="N", above=2e-4, hold_s=60.0)
N_BELOW = Limit(axes=("gz",), letter="N", below=1e-4, hold_s=60.0)


def make_gz_estimate(
    at_s: float, value: float, error: float = 1e-6, status: Status = Status.ESTIMATED, letter: str = "N"
) -> Estimate:
    """Return an estimate with one coefficient of gz; ``error`` is half its confidence interval."""
    row, column = SYMBOLS.index(letter), AXES.index("gz")
    table = Coefficients(*(np.full((5, 6), np.nan) for _ in range(3)), np.zeros((5, 6), np.int8))
    table.status[row, column] = status
    if status != Status.UNESTIMATED:
        table.hi[row, column] = value + error
        table.lo[row, column] = 0.0 if status == Status.UPPER_BOUND else value - error
        table.value[row, column] = math.nan if status == Status.UPPER_BOUND else value
    samples = round(at_s * RATE_HZ)
    return replace(make_estimate(), t_ns=round(at_s * 1e9), rate_hz=RATE_HZ, samples=samples, coefficients=table)


def collect_events(
    limits: LimitMonitor, values_over_time: list[tuple[float, float]], **more: object
) -> list[tuple[float, Event]]:
    """Feed (time, value) pairs to the monitor and return its events with their times."""
    return [
        (at_s, e)
        for at_s, value in values_over_time
        for e in limits.check_estimate(make_gz_estimate(at_s, value, **more))  # type: ignore[arg-type]
    ]


def test_limit_crossing_and_return_give_one_event_each() -> None:
    limits = LimitMonitor([N_ABOVE], None)
    values_over_time = [(t, 1.5e-4 if t < 100 or t > 300 else 2.5e-4) for t in np.arange(0.0, 500.0, 0.5).tolist()]
    (up_s, up), (down_s, down) = collect_events(limits, values_over_time)
    assert (up.kind, up_s, up.since_ns) == ("limit_crossed", 160.0, 100_000_000_000)
    assert (down.kind, down_s, down.since_ns) == ("limit_back", 360.5, 300_500_000_000)
    assert up.axis == "gz"
    assert up.values["N"]["limit"] == 2e-4
    assert up.values["N"]["value"] == 2.5e-4
    assert up.sigma == pytest.approx(0.5e-4 / (1e-6 / 1.96), rel=1e-3)
    assert up.text == "gz angle random walk 0.859 °/√h is above 0.688 °/√h, its upper limit"
    assert down.text == "gz angle random walk 0.516 °/√h is no longer above 0.688 °/√h, its upper limit"


def test_interval_that_includes_the_limit_is_no_crossing() -> None:
    limits = LimitMonitor([N_ABOVE], None)
    assert collect_events(limits, [(float(t), 2.5e-4) for t in range(600)], error=0.6e-4) == []
    assert limits.coefficients_beyond_limits == ()


def test_one_estimate_below_the_limit_restarts_the_hold_time() -> None:
    limits = LimitMonitor([N_ABOVE], None)
    values_over_time = [(float(t), 1.9e-4 if t == 50 else 2.5e-4) for t in range(200)]
    assert [at_s for at_s, _ in collect_events(limits, values_over_time)] == [111.0]


def test_unestimated_value_neither_crosses_nor_resets_the_limit() -> None:
    limits = LimitMonitor([N_ABOVE], None)
    assert collect_events(limits, [(float(t), 2.5e-4) for t in range(59)]) == []
    assert limits.check_estimate(make_gz_estimate(59.0, 0.0, status=Status.UNESTIMATED)) == []
    assert [at_s for at_s, _ in collect_events(limits, [(60.0 + t, 2.5e-4) for t in range(100)])] == [120.0]
    unknown = [
        e
        for t in range(200, 400)
        for e in limits.check_estimate(make_gz_estimate(float(t), 0.0, status=Status.UNESTIMATED))
    ]
    assert unknown == []
    assert limits.coefficients_beyond_limits == ("gz N",)


def test_hold_time_counts_samples_and_not_time_without_data() -> None:
    limits = LimitMonitor([N_ABOVE], None)
    assert limits.check_estimate(make_gz_estimate(0.0, 2.5e-4)) == []
    later = replace(make_gz_estimate(0.5, 2.5e-4), t_ns=3_600_000_000_000)
    assert limits.check_estimate(later) == []
    assert limits.coefficients_beyond_limits == ()


def test_upper_bound_can_cross_only_a_lower_limit() -> None:
    both = LimitMonitor([N_ABOVE, N_BELOW], None)
    bound = [
        event
        for t in range(100)
        for event in both.check_estimate(make_gz_estimate(float(t), 0.4e-4, 0.1e-4, Status.UPPER_BOUND))
    ]
    assert [(event.kind, event.sigma) for event in bound] == [("limit_crossed", None)]
    assert bound[0].values["N"]["limit"] == 1e-4
    assert bound[0].text == "gz angle random walk at most 0.172 °/√h is below 0.344 °/√h, its lower limit"
    assert json.loads(EventMessage.from_result("d", 0.0, 1, bound[0]).encode())["what"]["N"]["value"] is None
    back = collect_events(both, [(100.0 + t, 1.5e-4) for t in range(100)])
    assert [event.kind for _, event in back] == ["limit_back"]
    high = LimitMonitor([N_ABOVE], None)
    assert [
        e for t in range(100) for e in high.check_estimate(make_gz_estimate(float(t), 9e-4, 1e-4, Status.UPPER_BOUND))
    ] == []


def test_upper_bound_returns_only_when_it_is_below_the_limit() -> None:
    limits = LimitMonitor([N_ABOVE], None)
    collect_events(limits, [(float(t), 2.5e-4) for t in range(61)])
    assert limits.coefficients_beyond_limits == ("gz N",)
    loose = [
        e
        for t in range(61, 200)
        for e in limits.check_estimate(make_gz_estimate(float(t), 2.5e-4, 1e-5, Status.UPPER_BOUND))
    ]
    assert loose == []
    tight = [
        e
        for t in range(200, 300)
        for e in limits.check_estimate(make_gz_estimate(float(t), 1e-4, 1e-5, Status.UPPER_BOUND))
    ]
    assert [event.kind for event in tight] == ["limit_back"]


def test_limit_relative_to_the_model_is_a_multiple_of_its_term() -> None:
    model = NoiseModel.from_toml('sample_rate = 100.0\n["g*".angle_random_walk]\nN = 1.0e-4')
    relative = Limit(axes=("gx", "gz"), letter="N", times_model=1.5, hold_s=1.0)
    assert [(b.axis, b.limit, b.upper) for b in make_axis_limits([relative], model)] == [
        ("gx", pytest.approx(1.5e-4), True),
        ("gz", pytest.approx(1.5e-4), True),
    ]
    ((_, event),) = collect_events(LimitMonitor([relative], model), [(float(t), 1.6e-4) for t in range(2)])
    assert event.text.endswith("its upper limit (1.5 times its model)")
    with pytest.raises(ConfigError, match=r"limit of K: times_model = 2, but the model in force has no K on gz"):
        LimitMonitor([Limit(axes=("gz",), letter="K", times_model=2.0, hold_s=1.0)], model)
    with pytest.raises(ConfigError, match="no N on ax"):
        LimitMonitor([Limit(axes=AXES, letter="N", times_model=2.0, hold_s=1.0)], model)


def test_new_limits_continue_the_state_of_equal_old_limits() -> None:
    old = LimitMonitor([N_ABOVE], None)
    collect_events(old, [(float(t), 2.5e-4) for t in range(61)])
    same, other = LimitMonitor([N_ABOVE, N_BELOW], None), LimitMonitor([N_BELOW], None)
    same.copy_states_from(old)
    other.copy_states_from(old)
    assert (same.coefficients_beyond_limits, other.coefficients_beyond_limits) == (("gz N",), ())
