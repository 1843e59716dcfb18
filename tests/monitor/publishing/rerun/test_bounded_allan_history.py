"""Tests of the Allan history for the live surface: content of a column and bounded size."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.estimation.estimate import Estimate
from monitor.publishing.rerun.bounded_allan_history import COLUMNS, AllanHistory
from tests.monitor.publishing import example_results

ESTIMATE = example_results.make_estimate()


def scale_estimate(factor: float) -> Estimate:
    return replace(ESTIMATE, curve=replace(ESTIMATE.curve, avar=ESTIMATE.curve.avar * factor**2))


def test_column_is_the_geometric_mean_of_its_estimates() -> None:
    history = AllanHistory(column_s=2.0)
    done = [
        history.add_estimate_and_check_column_complete(float(t), scale_estimate(factor))
        for t, factor in enumerate((1.0, 4.0, 2.0, 8.0, 8.0))
    ]
    assert done == [False, False, True, False, True]
    assert history.ends_s == [2.0, 4.0]
    first, second = history.log_ratio_to_median()[:, 3, 2]
    assert second - first == pytest.approx(np.log(8.0 / 2.0))
    assert first == pytest.approx(-second)  # the median of two values is their mean


def test_history_is_bounded_and_covers_its_whole_span() -> None:
    history = AllanHistory(column_s=1.0)
    max_columns = 0
    for t in range(5000):
        history.add_estimate_and_check_column_complete(float(t), scale_estimate(2.0 if t < 2500 else 6.0))
        max_columns = max(max_columns, len(history.ends_s))
    assert COLUMNS / 2 <= len(history.ends_s) < COLUMNS
    assert max_columns < COLUMNS
    assert history.column_s == 32.0
    assert history.ends_s[0] < 40.0
    assert history.ends_s[-1] > 4960.0
    ratios = history.log_ratio_to_median()[:, 0, 0]
    ends = np.array(history.ends_s)
    step = ratios[ends > 2600].mean() - ratios[ends < 2400].mean()
    assert step == pytest.approx(np.log(3.0))
    assert np.ptp(ratios[ends < 2400]) == pytest.approx(0.0, abs=1e-12)


def test_different_tau_or_an_earlier_time_restart_the_history() -> None:
    history = AllanHistory(column_s=1.0)
    for t in range(10):
        history.add_estimate_and_check_column_complete(float(t), ESTIMATE)
    assert len(history.ends_s) == 9
    history.add_estimate_and_check_column_complete(4.0, ESTIMATE)
    assert history.ends_s == []
    history.add_estimate_and_check_column_complete(5.0, ESTIMATE)
    assert history.ends_s == [5.0]
    history.add_estimate_and_check_column_complete(6.0, example_results.make_estimate(seconds=60.0))
    assert history.ends_s == []
    assert history.tau_s.size < ESTIMATE.curve.tau_s.size


def test_unmeasured_values_are_nan() -> None:
    avar = ESTIMATE.curve.avar.copy()
    avar[:, 4] = np.nan
    avar[-1, 0] = 0.0
    partial = replace(ESTIMATE, curve=replace(ESTIMATE.curve, avar=avar))
    history = AllanHistory(column_s=1.0)
    assert history.log_ratio_to_median().shape == (0, 0, 6)
    for t in range(3):
        history.add_estimate_and_check_column_complete(float(t), partial)
    relative = history.log_ratio_to_median()
    assert np.isnan(relative[:, :, 4]).all()
    assert np.isnan(relative[:, -1, 0]).all()
    assert np.isfinite(relative[:, :-1, :4]).all()
