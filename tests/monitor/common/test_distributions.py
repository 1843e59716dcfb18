"""Tests of quantiles and tail probabilities against SciPy, over the documented ranges."""

import numpy as np
import pytest
from scipy.special import betainc, chdtri, ndtri, stdtrit

from monitor.common.distributions import (
    chi2_quantile,
    expand_chi2_quantile,
    incomplete_beta,
    normal_quantile,
    student_quantile,
)

TOLERANCE = 1e-12


def chi2_quantiles(edf, probability):
    return np.array([chi2_quantile(one, expand_chi2_quantile(probability)) for one in edf])


@pytest.mark.parametrize("probability", [0.001, 0.025, 0.5, 0.95, 0.975])
def test_chi2_quantile(probability: float) -> None:
    edf = np.concatenate([np.geomspace(0.01, 1e12, 20_001), np.arange(1.0, 2001.0)])
    expected = chdtri(edf, 1.0 - probability)
    comparable = expected > 1e-290  # smaller numbers have fewer digits
    np.testing.assert_allclose(chi2_quantiles(edf, probability)[comparable], expected[comparable], rtol=TOLERANCE)


def test_chi2_quantile_underflows_to_zero() -> None:
    assert chi2_quantiles([0.001], 0.025)[0] == chdtri(0.001, 0.975) == 0.0


def test_chi2_quantile_of_no_degrees_of_freedom_is_nan() -> None:
    found = chi2_quantiles([np.nan, 0.0, -1.0, 2.0], 0.975)
    assert np.isnan(found).tolist() == [True, True, True, False]
    assert found[3] == pytest.approx(-2.0 * np.log(0.025), rel=TOLERANCE)


def test_normal_quantile() -> None:
    tail = np.geomspace(1e-300, 0.4999, 2001)
    for probability in (*tail.tolist(), *(1.0 - tail[tail > 1e-16]).tolist()):
        assert normal_quantile(probability) == pytest.approx(float(ndtri(probability)), rel=TOLERANCE)
    assert normal_quantile(0.0) == -np.inf
    assert normal_quantile(1.0) == np.inf
    assert normal_quantile(0.5) == 0.0


@pytest.mark.parametrize("probability", [0.975, 0.99, 0.999])
def test_student_quantile(probability: float) -> None:
    for df in (*range(1, 100), *range(100, 990, 17), *range(990, 1010), 10_000, 10**6, 10**9):
        expected = float(stdtrit(df, probability))
        assert student_quantile(df, probability) == pytest.approx(expected, rel=TOLERANCE), df


def test_incomplete_beta() -> None:
    """Cover F tests with up to 1000 and 20 degrees of freedom; for probabilities near 1, test the complement."""
    x = np.concatenate([[0.0, 1.0], np.linspace(0.001, 0.999, 201), np.geomspace(1e-9, 1e-3, 61)])
    for a in (*(0.5 * np.arange(1, 20)), *(0.5 * np.arange(20, 160, 7)), 250.0, 500.0):
        for b in 0.5 * np.arange(1, 21):
            expected = betainc(a, b, x)
            comparable = expected > 1e-290
            found = incomplete_beta(a, b, x)[comparable]
            np.testing.assert_allclose(found, expected[comparable], 5.0 * TOLERANCE, err_msg=f"{a} {b}")
