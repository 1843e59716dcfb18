"""Tests of the aggregation of results into history rows of one minute."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import AXES
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.history.history_row import STATES, HistoryRow
from monitor.history.minute_aggregation import TAU_S, EstimateToColumnsConverter, MinuteAggregator
from tests.monitor.history.random_rows import get_column_values
from tests.monitor.publishing.example_results import (
    compute_design_matrix,
    make_estimate,
    make_health,
    make_true_coefficients,
)

T0 = 1_760_000_040.0  # a multiple of one minute
ESTIMATES = [make_estimate(seed=seed) for seed in range(4)]


def get_gz_n(i: int) -> float:
    return float(np.float32(ESTIMATES[i].coefficients.value[1, 2]))


def collect_rows(minutes: MinuteAggregator, *rows: HistoryRow | None) -> list[HistoryRow]:
    return [row for row in (*rows, minutes.flush()) if row is not None]


@given(st.lists(st.tuples(st.floats(0.0, 400.0), st.integers(0, 3)), min_size=1, max_size=60))
def test_each_estimate_is_in_one_row(estimates_over_time: list[tuple[float, int]]) -> None:
    estimates_over_time = sorted(estimates_over_time)
    minutes = MinuteAggregator()
    rows = collect_rows(minutes, *[minutes.add_estimate(T0 + at, ESTIMATES[i]) for at, i in estimates_over_time])
    assert [row.start_s for row in rows] == sorted({int((T0 + at) // 60) * 60 for at, _ in estimates_over_time})
    for row in rows:
        inside = [get_gz_n(i) for at, i in estimates_over_time if row.start_s <= T0 + at < row.end_s]
        assert get_column_values(row, "gz.N") == (len(inside), min(inside), max(inside), inside[-1])
        assert row.start_s <= row.newest_s <= row.end_s


def test_counts_are_those_of_the_minute_and_restart_at_zero() -> None:
    minutes = MinuteAggregator()
    reports = [(0.0, 100, 1), (59.0, 6000, 1), (60.0, 6100, 2), (90.0, 50, 0), (119.0, 3000, 5)]
    rows = collect_rows(
        minutes,
        *[minutes.add_health(T0 + at, make_health(received=received, lost=lost)) for at, received, lost in reports],
    )
    assert [row.counts[:2] for row in rows] == [(6000, 1), (100 + 3000, 1 + 5)]


def test_row_has_the_worst_state_and_the_temperature() -> None:
    minutes = MinuteAggregator()
    minutes.add_temperature(T0, np.array([20.0, np.nan, 22.0]))
    minutes.add_temperature(T0 + 1.0, np.array([np.nan]))
    minutes.add_temperature(T0 + 2.0, np.array([30.0]))
    minutes.add_health(T0 + 3.0, make_health(state="lost", rate_hz=None, latency_p99_s=None))
    minutes.add_health(T0 + 4.0, make_health(state="running"))
    (row,) = collect_rows(minutes)
    assert STATES[row.state] == "lost"
    assert get_column_values(row, "temperature") == (2, 21.0, 30.0, 30.0)
    assert get_column_values(row, "rate")[0] == 1


def test_slightly_late_estimate_joins_the_minute_and_a_much_older_one_does_not() -> None:
    minutes = MinuteAggregator()
    rows = [minutes.add_estimate(T0 + at, ESTIMATES[0]) for at in (0.0, -0.5, 1.0, -600.0, 2.0)]
    assert [(row.start_s, int(row.n[0])) for row in collect_rows(minutes, *rows)] == [
        (T0, 3),
        (T0 - 600.0, 1),
        (T0, 1),
    ]


def test_new_axis_within_a_minute_starts_a_second_row() -> None:
    avar = ESTIMATES[0].curve.avar.copy()
    avar[:, 3:] = np.nan
    fewer = replace(ESTIMATES[0], curve=replace(ESTIMATES[0].curve, avar=avar))
    minutes = MinuteAggregator()
    rows = collect_rows(minutes, *[minutes.add_estimate(T0 + i, e) for i, e in enumerate((fewer, fewer, ESTIMATES[0]))])
    assert [(row.start_s, get_column_values(row, "gz.N")[0], get_column_values(row, "az.N")[0]) for row in rows] == [
        (T0, 2, 0),
        (T0, 1, 1),
    ]


def test_minute_without_results_has_no_row() -> None:
    minutes = MinuteAggregator()
    assert minutes.flush() is None
    assert minutes.add_temperature(T0, np.array([np.nan])) is None
    assert minutes.flush() is None


def convert_to_columns(found):
    numbers = EstimateToColumnsConverter(found)
    return dict(zip(numbers.names, numbers.convert_estimate(found), strict=True))


def test_coefficient_columns_follow_the_status() -> None:
    found = make_estimate(seconds=900.0)  # some are estimated, K is a bound, R is unestimated
    c, by_name = found.coefficients, convert_to_columns(found)
    seen = set()
    for row, letter in enumerate(SYMBOLS):
        for column, axis in enumerate(AXES):
            parts = [by_name[f"{axis}.{letter}{part}"] for part in ("", ".lo", ".hi", ".bound")]
            status = Status(int(c.status[row, column]))
            seen.add(status)
            nan = np.nan
            value, lo, hi = (part[row, column] for part in (c.value, c.lo, c.hi))
            expected = {
                Status.ESTIMATED: [value, lo, hi, nan],
                Status.UPPER_BOUND: [nan, nan, nan, hi],
                Status.UNESTIMATED: [nan] * 4,
            }[status]
            np.testing.assert_array_equal(parts, expected)
    assert seen == set(Status)


def test_deviations_are_interpolated_to_a_percent() -> None:
    exact = make_estimate()
    tau_s = exact.curve.tau_s
    avar = compute_design_matrix(tau_s) @ make_true_coefficients() ** 2
    by_name = convert_to_columns(replace(exact, curve=replace(exact.curve, avar=avar)))
    stored_tau_s = [tau for tau in TAU_S if f"gz.sigma.{tau:g}" in by_name]
    assert stored_tau_s == [tau for tau in TAU_S if tau_s[0] <= tau <= tau_s[-1]]
    for tau in stored_tau_s:
        truth = np.sqrt(compute_design_matrix(np.array([tau])) @ make_true_coefficients() ** 2)[0]
        found = [by_name[f"{axis}.sigma.{tau:g}"] for axis in AXES]
        np.testing.assert_allclose(found, truth, rtol=0.01)


def test_first_point_is_stored_even_if_the_next_is_missing() -> None:
    found = make_estimate()
    avar = found.curve.avar.copy()
    avar[1:] = np.nan
    assert convert_to_columns(replace(found, curve=replace(found.curve, avar=avar)))["gz.sigma.0.01"] == pytest.approx(
        np.sqrt(avar[0, 2]), rel=1e-12
    )


def test_constant_axis_has_zero_deviation() -> None:
    found = make_estimate()
    avar = found.curve.avar.copy()
    avar[:, 0] = 0.0
    by_name = convert_to_columns(replace(found, curve=replace(found.curve, avar=avar)))
    assert by_name["gx.sigma.0.01"] == 0.0
    assert by_name["gy.sigma.0.01"] > 0.0


def test_unmeasured_axes_are_not_stored_and_new_axes_do_not_match() -> None:
    found = make_estimate()
    avar = found.curve.avar.copy()
    avar[:, 3:] = np.nan
    fewer = replace(found, curve=replace(found.curve, avar=avar))
    numbers = EstimateToColumnsConverter(fewer)
    assert {name.split(".")[0] for name in numbers.names} == {"gx", "gy", "gz"}
    assert numbers.matches_axes_and_taus(fewer)
    assert not numbers.matches_axes_and_taus(found)
    assert not numbers.matches_axes_and_taus(replace(fewer, curve=replace(fewer.curve, tau_s=fewer.curve.tau_s * 1.1)))


def test_no_deviation_is_interpolated_between_distant_tau() -> None:
    found = make_estimate()
    few = [0, 8, 12]
    curve = replace(found.curve, tau_s=found.curve.tau_s[few], avar=found.curve.avar[few])
    assert [
        name for name in EstimateToColumnsConverter(replace(found, curve=curve)).names if name.startswith("gz.sigma")
    ] == ["gz.sigma.0.01"]
