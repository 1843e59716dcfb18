"""Tests of the minimizers against known minima and SciPy."""

import numpy as np
import pytest
from scipy.optimize import minimize, rosen

from drivers.data_types import Floats
from monitor.common.minimization import minimize_bfgs, minimize_by_golden_section


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_bfgs_finds_the_minimum_of_a_quadratic_function(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n))
    hessian, minimum = root @ root.T + 0.1 * np.eye(n), rng.standard_normal(n)
    value, found = minimize_bfgs(lambda x: float((x - minimum) @ hessian @ (x - minimum)) + 3.0, np.zeros(n), 1e-6)
    assert found == pytest.approx(minimum, abs=1e-5)
    assert value == pytest.approx(3.0, abs=1e-9)


def test_bfgs_needs_few_more_evaluations_than_scipy() -> None:
    calls = 0

    def count_and_evaluate(x: Floats) -> float:
        nonlocal calls
        calls += 1
        return float(rosen(x))

    value, found = minimize_bfgs(count_and_evaluate, np.array([-1.2, 1.0, 0.5]), 1e-4)
    expected = minimize(rosen, [-1.2, 1.0, 0.5], method="BFGS", options={"gtol": 1e-4})
    assert found == pytest.approx(np.ones(3), abs=1e-3)
    assert value == pytest.approx(expected.fun, abs=1e-6)
    assert calls < 2 * expected.nfev


def test_bfgs_accepts_flat_and_infinite_function_values() -> None:
    value, found = minimize_bfgs(lambda _: 1.0, np.array([2.0, 3.0]), 1e-6)
    assert (value, found.tolist()) == (1.0, [2.0, 3.0])
    value, found = minimize_bfgs(lambda x: float(x[0] - np.log(x[0])) if x[0] > 0.0 else np.inf, np.array([9.0]), 1e-6)
    assert found == pytest.approx([1.0], abs=1e-5)
    assert value == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("minimum", [-1.0, -0.3, 0.7, 2.0])
def test_golden_section_search_finds_the_minimum(minimum: float) -> None:
    search = minimize_by_golden_section(lambda x: abs(x - minimum) ** 1.5, -1.0, 2.0, 1e-5)
    calls = 0
    while True:
        try:
            next(search)
        except StopIteration as end:
            value, found = end.value
            break
        calls += 1
    assert found == pytest.approx(minimum, abs=1e-5)
    assert value == abs(found - minimum) ** 1.5
    assert calls == 2 + 27  # 3 · 0.618^27 is just below the tolerance
