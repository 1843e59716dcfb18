"""What is kept of an estimate, against its own arrays."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.history.estimate_to_columns import TAU_S, EstimateToColumnsConverter
from tests.monitor.publishing.made import estimate, terms, true_coefficients


def kept(found):
    numbers = EstimateToColumnsConverter(found)
    return dict(zip(numbers.names, numbers.convert_estimate(found), strict=True))


def test_each_letter_has_its_numbers_by_its_status() -> None:
    found = estimate(seconds=900.0)  # some estimated, K a bound, R not yet
    c, by_name = found.coefficients, kept(found)
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


def test_deviations_are_read_off_the_curve_to_a_percent() -> None:
    exact = estimate()
    tau_s = exact.curve.tau_s
    avar = terms(tau_s) @ true_coefficients() ** 2
    by_name = kept(replace(exact, curve=replace(exact.curve, avar=avar)))
    read = [tau for tau in TAU_S if f"gz.sigma.{tau:g}" in by_name]
    assert read == [tau for tau in TAU_S if tau_s[0] <= tau <= tau_s[-1]]
    for tau in read:
        truth = np.sqrt(terms(np.array([tau])) @ true_coefficients() ** 2)[0]
        found = [by_name[f"{axis}.sigma.{tau:g}"] for axis in AXES]
        np.testing.assert_allclose(found, truth, rtol=0.01)


def test_a_point_of_the_curve_is_taken_as_it_is_even_where_the_next_is_not_there_yet() -> None:
    found = estimate()
    avar = found.curve.avar.copy()
    avar[1:] = np.nan
    assert kept(replace(found, curve=replace(found.curve, avar=avar)))["gz.sigma.0.01"] == pytest.approx(
        np.sqrt(avar[0, 2]), rel=1e-12
    )


def test_an_axis_that_never_moves_has_a_deviation_of_zero() -> None:
    found = estimate()
    avar = found.curve.avar.copy()
    avar[:, 0] = 0.0
    by_name = kept(replace(found, curve=replace(found.curve, avar=avar)))
    assert by_name["gx.sigma.0.01"] == 0.0
    assert by_name["gy.sigma.0.01"] > 0.0


def test_axes_that_are_not_measured_are_not_kept_and_new_ones_do_not_fit() -> None:
    found = estimate()
    avar = found.curve.avar.copy()
    avar[:, 3:] = np.nan
    fewer = replace(found, curve=replace(found.curve, avar=avar))
    numbers = EstimateToColumnsConverter(fewer)
    assert {name.split(".")[0] for name in numbers.names} == {"gx", "gy", "gz"}
    assert numbers.matches_axes_and_taus(fewer)
    assert not numbers.matches_axes_and_taus(found)
    assert not numbers.matches_axes_and_taus(replace(fewer, curve=replace(fewer.curve, tau_s=fewer.curve.tau_s * 1.1)))


def test_between_averaging_times_far_apart_nothing_is_made_up() -> None:
    found = estimate()
    few = [0, 8, 12]
    curve = replace(found.curve, tau_s=found.curve.tau_s[few], avar=found.curve.avar[few])
    assert [
        name for name in EstimateToColumnsConverter(replace(found, curve=curve)).names if name.startswith("gz.sigma")
    ] == ["gz.sigma.0.01"]
