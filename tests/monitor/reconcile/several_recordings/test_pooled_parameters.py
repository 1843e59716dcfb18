"""Tests of pooled parameters: weighted mean, χ² of a true model, and wider intervals if recordings differ."""

import numpy as np
import pytest
from scipy import stats

from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.several_recordings.pooled_parameters import (
    MIN_AGREEMENT_PROBABILITY,
    agreement_probability,
    distance_in_sigma,
    pool_parameter,
)

Z95 = 1.959964  # normal distribution, two-sided


def normal_interval(value: float, deviation: float) -> ParameterInterval:
    return ParameterInterval(value, value - Z95 * deviation, value + Z95 * deviation)


def test_weights_are_inverse_variances() -> None:
    both = pool_parameter([normal_interval(1.0, 0.1), normal_interval(1.3, 0.2)])
    mean = (1.0 / 0.01 + 1.3 / 0.04) / (1 / 0.01 + 1 / 0.04)
    half = Z95 / np.sqrt(1 / 0.01 + 1 / 0.04)
    assert [both.bounds.value, both.bounds.lo, both.bounds.hi] == pytest.approx([mean, mean - half, mean + half])
    assert both.chi2 == pytest.approx(0.3**2 / (0.01 + 0.04))
    assert both.p_value == pytest.approx(stats.chi2(1).sf(1.8))


def test_geometric_intervals_are_averaged_as_logarithms() -> None:
    both = pool_parameter([ParameterInterval(1.0, 0.5, 2.0), ParameterInterval(4.0, 2.0, 8.0)])
    assert both.bounds.value == pytest.approx(2.0)
    assert both.bounds.lo is not None
    assert both.bounds.hi is not None
    assert both.bounds.lo * both.bounds.hi == pytest.approx(4.0)


def test_interval_contains_the_scatter_of_different_recordings() -> None:
    values = [normal_interval(v, 0.01) for v in (1.0, 2.0, 3.0)]
    together = pool_parameter(values)
    assert together.p_value is not None
    assert together.p_value < MIN_AGREEMENT_PROBABILITY
    assert together.bounds.hi is not None
    # χ²/ν is the sample variance over 0.01²: the interval is that of a mean of three values that scatter by 1
    assert together.bounds.hi - 2.0 == pytest.approx(Z95 / np.sqrt(3))


def test_equal_intervals_count_twice() -> None:
    both = pool_parameter([normal_interval(1.0, 0.1)] * 2)
    assert both.freedom == 1
    assert both.p_value == 1.0
    assert both.bounds.hi == pytest.approx(1.0 + Z95 * 0.1 / np.sqrt(2))


@pytest.mark.parametrize("runs", [2, 5])
def test_p_values_of_equal_parameters_are_uniform(runs: int) -> None:
    rng = np.random.default_rng(3)
    p = [
        pool_parameter([normal_interval(10.0 + rng.standard_normal(), 1.0) for _ in range(runs)]).p_value
        for _ in range(2000)
    ]
    assert stats.kstest(np.array(p, float), "uniform").pvalue > 0.001


def test_parameters_without_an_interval_are_not_pooled() -> None:
    assert pool_parameter([ParameterInterval("ax"), ParameterInterval("ax")]).bounds == ParameterInterval("ax")
    assert pool_parameter([ParameterInterval(2.0), ParameterInterval(2.0)]).p_value is None
    one = pool_parameter([ParameterInterval(5.0), normal_interval(1.0, 0.1), ParameterInterval(7.0, 6.0, np.inf)])
    assert (one.bounds, one.p_value) == (normal_interval(1.0, 0.1), None)
    assert agreement_probability([one]) is None


def test_several_parameters_have_a_common_p_value() -> None:
    parameters = [pool_parameter([normal_interval(0.0, 1.0), normal_interval(d, 1.0)]) for d in (1.0, 2.0)]
    assert agreement_probability(parameters) == pytest.approx(stats.chi2(2).sf(0.5 + 2.0))


def test_deviations_have_the_scale_of_the_interval() -> None:
    assert distance_in_sigma(normal_interval(1.0, 0.1), 1.2) == pytest.approx(2.0)
    factor = 1.5
    log_even = ParameterInterval(1.0, factor**-Z95, factor**Z95)
    assert distance_in_sigma(log_even, factor**3) == pytest.approx(3.0)
    assert distance_in_sigma(log_even, 0.0) == np.inf
    assert distance_in_sigma(ParameterInterval(1.0), 7.0) == 0.0
