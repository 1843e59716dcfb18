"""Tests of the conversion of estimates to the columns of the history."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.history.estimate_to_columns import TAU_S, EstimateToColumnsConverter
from tests.monitor.publishing.example_results import compute_design_matrix, make_estimate, make_true_coefficients


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
