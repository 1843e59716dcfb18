"""The history behind the live surface: what a column holds, and that it stays bounded."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.estimation.estimate import Estimate
from monitor.publishing.rerun.bounded_allan_history import COLUMNS, AllanHistory
from tests.monitor.publishing import made

ESTIMATE = made.estimate()


def scaled(factor: float) -> Estimate:
    return replace(ESTIMATE, curve=replace(ESTIMATE.curve, avar=ESTIMATE.curve.avar * factor**2))


def test_a_column_is_the_geometric_mean_of_its_estimates() -> None:
    surface = AllanHistory(column_s=2.0)
    done = [
        surface.add_estimate_and_check_column_complete(float(t), scaled(factor))
        for t, factor in enumerate((1.0, 4.0, 2.0, 8.0, 8.0))
    ]
    assert done == [False, False, True, False, True]
    assert surface.ends_s == [2.0, 4.0]
    first, second = surface.log_ratio_to_median()[:, 3, 2]
    assert second - first == pytest.approx(np.log(8.0 / 2.0))
    assert first == pytest.approx(-second)  # the median of two is midway


def test_the_history_stays_bounded_and_keeps_its_whole_span() -> None:
    surface = AllanHistory(column_s=1.0)
    most = 0
    for t in range(5000):
        surface.add_estimate_and_check_column_complete(float(t), scaled(2.0 if t < 2500 else 6.0))
        most = max(most, len(surface.ends_s))
    assert COLUMNS / 2 <= len(surface.ends_s) < COLUMNS
    assert most < COLUMNS
    assert surface.column_s == 32.0
    assert surface.ends_s[0] < 40.0
    assert surface.ends_s[-1] > 4960.0
    course = surface.log_ratio_to_median()[:, 0, 0]
    ends = np.array(surface.ends_s)
    step = course[ends > 2600].mean() - course[ends < 2400].mean()
    assert step == pytest.approx(np.log(3.0))
    assert np.ptp(course[ends < 2400]) == pytest.approx(0.0, abs=1e-12)


def test_other_averaging_times_or_an_earlier_time_begin_anew() -> None:
    surface = AllanHistory(column_s=1.0)
    for t in range(10):
        surface.add_estimate_and_check_column_complete(float(t), ESTIMATE)
    assert len(surface.ends_s) == 9
    surface.add_estimate_and_check_column_complete(4.0, ESTIMATE)
    assert surface.ends_s == []
    surface.add_estimate_and_check_column_complete(5.0, ESTIMATE)
    assert surface.ends_s == [5.0]
    surface.add_estimate_and_check_column_complete(6.0, made.estimate(seconds=60.0))
    assert surface.ends_s == []
    assert surface.tau_s.size < ESTIMATE.curve.tau_s.size


def test_what_is_not_measured_has_no_colour() -> None:
    avar = ESTIMATE.curve.avar.copy()
    avar[:, 4] = np.nan
    avar[-1, 0] = 0.0
    some = replace(ESTIMATE, curve=replace(ESTIMATE.curve, avar=avar))
    surface = AllanHistory(column_s=1.0)
    assert surface.log_ratio_to_median().shape == (0, 0, 6)
    for t in range(3):
        surface.add_estimate_and_check_column_complete(float(t), some)
    relative = surface.log_ratio_to_median()
    assert np.isnan(relative[:, :, 4]).all()
    assert np.isnan(relative[:, -1, 0]).all()
    assert np.isfinite(relative[:, :-1, :4]).all()
