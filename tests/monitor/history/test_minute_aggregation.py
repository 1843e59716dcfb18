"""Results of a device gathered by the minute, against sums over all of them."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from monitor.history.history_row import STATES, HistoryRow
from monitor.history.minute_aggregation import MinuteAggregator
from tests.monitor.history.made import numbers_of
from tests.monitor.publishing.made import estimate, health

T0 = 1_760_000_040.0  # a full minute
ESTIMATES = [estimate(seed=seed) for seed in range(4)]


def value(i: int) -> float:
    return float(np.float32(ESTIMATES[i].coefficients.value[1, 2]))


def gathered(minutes: MinuteAggregator, *rows: HistoryRow | None) -> list[HistoryRow]:
    return [row for row in (*rows, minutes.flush()) if row is not None]


@given(st.lists(st.tuples(st.floats(0.0, 400.0), st.integers(0, 3)), min_size=1, max_size=60))
def test_every_estimate_is_in_one_row(looks: list[tuple[float, int]]) -> None:
    looks = sorted(looks)
    minutes = MinuteAggregator()
    rows = gathered(minutes, *[minutes.add_estimate(T0 + at, ESTIMATES[i]) for at, i in looks])
    assert [row.start_s for row in rows] == sorted({int((T0 + at) // 60) * 60 for at, _ in looks})
    for row in rows:
        inside = [value(i) for at, i in looks if row.start_s <= T0 + at < row.end_s]
        assert numbers_of(row, "gz.N") == (len(inside), min(inside), max(inside), inside[-1])
        assert row.start_s <= row.newest_s <= row.end_s


def test_counts_are_what_came_in_the_minute_and_a_restart_begins_at_nothing() -> None:
    minutes = MinuteAggregator()
    reports = [(0.0, 100, 1), (59.0, 6000, 1), (60.0, 6100, 2), (90.0, 50, 0), (119.0, 3000, 5)]
    rows = gathered(
        minutes, *[minutes.add_health(T0 + at, health(received=received, lost=lost)) for at, received, lost in reports]
    )
    assert [row.counts[:2] for row in rows] == [(6000, 1), (100 + 3000, 1 + 5)]


def test_a_row_has_the_worst_state_and_the_temperature() -> None:
    minutes = MinuteAggregator()
    minutes.add_temperature(T0, np.array([20.0, np.nan, 22.0]))
    minutes.add_temperature(T0 + 1.0, np.array([np.nan]))
    minutes.add_temperature(T0 + 2.0, np.array([30.0]))
    minutes.add_health(T0 + 3.0, health(state="lost", rate_hz=None, latency_p99_s=None))
    minutes.add_health(T0 + 4.0, health(state="running"))
    (row,) = gathered(minutes)
    assert STATES[row.state] == "lost"
    assert numbers_of(row, "temperature") == (2, 21.0, 30.0, 30.0)
    assert numbers_of(row, "rate")[0] == 1


def test_a_moment_late_is_counted_with_the_others_and_an_older_time_is_not() -> None:
    minutes = MinuteAggregator()
    rows = [minutes.add_estimate(T0 + at, ESTIMATES[0]) for at in (0.0, -0.5, 1.0, -600.0, 2.0)]
    assert [(row.start_s, int(row.n[0])) for row in gathered(minutes, *rows)] == [
        (T0, 3),
        (T0 - 600.0, 1),
        (T0, 1),
    ]


def test_an_axis_that_comes_within_a_minute_makes_two_rows_of_it() -> None:
    avar = ESTIMATES[0].curve.avar.copy()
    avar[:, 3:] = np.nan
    fewer = replace(ESTIMATES[0], curve=replace(ESTIMATES[0].curve, avar=avar))
    minutes = MinuteAggregator()
    rows = gathered(minutes, *[minutes.add_estimate(T0 + i, one) for i, one in enumerate((fewer, fewer, ESTIMATES[0]))])
    assert [(row.start_s, numbers_of(row, "gz.N")[0], numbers_of(row, "az.N")[0]) for row in rows] == [
        (T0, 2, 0),
        (T0, 1, 1),
    ]


def test_where_nothing_came_there_is_no_row() -> None:
    minutes = MinuteAggregator()
    assert minutes.flush() is None
    assert minutes.add_temperature(T0, np.array([np.nan])) is None
    assert minutes.flush() is None
