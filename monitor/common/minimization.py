"""Local minimization of functions of one or several variables.

Sources: Nocedal & Wright, Numerical Optimization, 2006, algorithm 6.1 (BFGS); Kiefer, Proc. Am. Math. Soc. 4, 1953
(golden-section search).
"""

from collections.abc import Callable, Generator
from math import ceil, inf, log, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FORWARD_DIFFERENCE_STEP: Final = 2.0**-26
"""Relative step of a forward difference, which is the square root of the rounding error."""
WOLFE_DECREASE: Final = 1e-4
WOLFE_CURVATURE: Final = 0.9
MAX_BISECTIONS: Final = 40
MAX_ITERATIONS_PER_VARIABLE: Final = 200
INVERSE_GOLDEN_RATIO: Final = (sqrt(5.0) - 1.0) / 2.0


def minimize_bfgs(
    function: Callable[[Floats], float], start: Floats, gradient_tolerance: float
) -> tuple[float, Floats]:
    """Minimize a function of several variables with the BFGS algorithm.

    Parameters
    ----------
    function : callable
        Smooth function of a float64 array [n].
    start : float64 [n]
        Start of the search.
    gradient_tolerance : float
        Largest component of the gradient at which the search ends.

    Returns
    -------
    value : float
        Minimum value of the function.
    x : float64 [n]
        Position of the minimum.
    """
    x, value = np.array(start, np.float64), function(start)
    slope, inverse = _gradient(function, x, value), np.eye(x.size)
    for iteration in range(MAX_ITERATIONS_PER_VARIABLE * x.size):
        if not np.abs(slope).max() > gradient_tolerance:
            break
        direction = -inverse @ slope
        if not slope @ direction < 0.0:
            inverse, direction = np.eye(x.size), -slope
        # the first direction has the length of the gradient, which is unrelated to the distance to the minimum
        first = 1.0 if iteration else min(1.0, 1.0 / float(np.linalg.norm(slope)))
        found = _line_search(function, x, value, slope, direction, first)
        if found is None:
            break
        step, less, new = found
        moved, change = step * direction, new - slope
        x, value, slope = x + moved, less, new
        scale = float(moved @ change)
        if scale > 0.0:
            if iteration == 0:
                inverse *= scale / float(change @ change)
            left = np.eye(x.size) - np.outer(moved, change) / scale
            inverse = left @ inverse @ left.T + np.outer(moved, moved) / scale
    return value, x


def _line_search(
    function: Callable[[Floats], float], x: Floats, value: float, slope: Floats, direction: Floats, step: float
) -> tuple[float, float, Floats] | None:
    """Return step, value and gradient at a point that satisfies the Wolfe conditions, or at the lowest point.

    Return None if no step decreases the function.
    """
    falling = float(slope @ direction)
    low, high = 0.0, inf
    best: tuple[float, float, Floats] | None = None
    for _ in range(MAX_BISECTIONS):
        there = x + step * direction
        less = function(there)
        if not less <= value + WOLFE_DECREASE * step * falling:
            high = step
        else:
            new = _gradient(function, there, less)
            if less < value and (best is None or less < best[1]):
                best = step, less, new
            if float(new @ direction) >= WOLFE_CURVATURE * falling:
                return best
            low = step
        if high - low <= FORWARD_DIFFERENCE_STEP * high * 1e-3:
            break
        step = 0.5 * (low + high) if high < inf else 2.0 * step
    return best


def _gradient(function: Callable[[Floats], float], x: Floats, value: float) -> Floats:
    """Return the gradient [n] at ``x``, computed by forward differences."""
    found = np.empty(x.size)
    for i in range(x.size):
        beside = x.copy()
        beside[i] += FORWARD_DIFFERENCE_STEP * max(1.0, abs(float(x[i])))
        found[i] = (function(beside) - value) / (beside[i] - x[i])
    return found


def minimize_by_golden_section(
    function: Callable[[float], float], low: float, high: float, tolerance: float
) -> Generator[None, None, tuple[float, float]]:
    """Minimize a function in an interval by golden-section search. The generator yields after each function call.

    Parameters
    ----------
    function : callable
        Function of a float with one minimum between ``low`` and ``high``.
    low, high : float
        Ends of the interval.
    tolerance : float
        Maximum error of the position of the minimum.

    Returns
    -------
    value : float
        Minimum value of the function.
    position : float
        Position of the minimum.

    Examples
    --------
    >>> def run(search):
    ...     while True:
    ...         try:
    ...             next(search)
    ...         except StopIteration as end:
    ...             return end.value
    >>> value, place = run(minimize_by_golden_section(lambda x: (x - 1.0) ** 2 + 2.0, 0.0, 3.0, 1e-6))
    >>> round(value, 9), round(place, 5)
    (2.0, 1.0)
    """
    left, right = high - INVERSE_GOLDEN_RATIO * (high - low), low + INVERSE_GOLDEN_RATIO * (high - low)
    at_left = function(left)
    yield
    at_right = function(right)
    yield
    for _ in range(max(ceil(log(tolerance / (high - low)) / log(INVERSE_GOLDEN_RATIO)), 0)):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - INVERSE_GOLDEN_RATIO * (high - low)
            at_left = function(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + INVERSE_GOLDEN_RATIO * (high - low)
            at_right = function(right)
        yield
    return min((at_left, left), (at_right, right))
