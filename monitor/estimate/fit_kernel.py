"""The arithmetic of ``fit``, compiled: weights, non-negative solution, intervals, one axis after another.

Everything is in units of one sample: avar of the axis, θ as in ``uncertainty``. Outputs are arrays of
the caller, one row an axis: ``theta``, ``lo``, ``hi``, ``status`` and ``entered`` hold Q N B K R,
``edf`` and ``fitted`` hold the τ; what stays NaN was not to be had. Sums and small solutions are
written out in loops because that compiles several times faster than array expressions do.
"""

from typing import Final

import numpy as np

from monitor.compiled import compiled
from monitor.estimate.uncertainty import NOISES, PAIRS

MIN_ROWS: Final = NOISES + 1
"""Fewer τ than this leave a fit no freedom to be contradicted."""

PASSES: Final = 4
"""Re-weightings; more of them move no coefficient by a tenth of its standard deviation."""

MISFIT: Final = 4.0
"""A short τ contradicts the fit when it is this many σ away."""

MISFIT_AGAIN: Final = 2.5
"""The same once one has: what is left of a band limit must not pull N."""

SHORT_ROWS: Final = 4
"""How many of the shortest τ in use are asked whether they contradict the fit."""

FILTER_MEMORY: Final = 16
"""Clusters of more samples are not left out: a filter that reaches so far would be no noise of the sensor."""

TWO_SIDED_95: Final = 1.959963984540054
ONE_SIDED_95: Final = 1.6448536269514722

Q, N, B, K, R = range(5)
WHITE: Final = PAIRS.index((N, N))


@compiled
def fit_axes(  # type: ignore[no-untyped-def]
    avar, level, terms, whole, columns, flat, covariance, slope, slope_variance, thresholds,
    entered, theta, lo, hi, status, edf, fitted, left_out
):  # fmt: skip
    """Fit axis by axis: ``avar`` [axes, m], ``level`` and ``flat`` as if the slope were all ramp, see ``fit``."""
    m = whole.size
    rows = np.empty(m, np.int64)
    stretch = np.empty(m)
    for axis in range(avar.shape[0]):
        count = 0
        for i in range(m):
            if avar[axis, i] > 0.0 and terms[axis, i] > 0.0 and whole[i] > 0.0:
                rows[count] = i
                stretch[i] = whole[i] / terms[axis, i]
                count += 1
        if count < MIN_ROWS:
            for a in range(5):
                entered[axis, a] = False
            continue
        left_out[axis] = _fit_axis(
            avar[axis], level[axis], rows[:count], stretch, columns, flat, covariance,
            slope[axis], slope_variance, thresholds,
            entered[axis], theta[axis], lo[axis], hi[axis], status[axis], edf[axis], fitted[axis],
        )  # fmt: skip


@compiled
def _fit_axis(  # type: ignore[no-untyped-def]
    avar, level, rows, stretch, columns, flat, covariance, slope, slope_variance, thresholds,
    entered, theta, lo, hi, status, edf, fitted
):  # fmt: skip
    variance, normal, right = np.empty(avar.size), np.empty((5, 5)), np.empty(5)
    straight = slope == slope
    if not straight:
        flat = columns
    first, free = _fit_terms(avar, level, rows, stretch, flat, covariance, variance, normal, right, theta)
    _judge(rows[first:], variance, stretch, flat, covariance, normal, right, thresholds, entered, theta, lo, hi, status)
    noise = 0.0
    if straight:
        noise = _judge_ramp(slope, slope_variance, thresholds, entered, theta, lo, hi, status)
    _variances(rows, theta, covariance, stretch, variance)
    for k in range(rows.size):
        i = rows[k]
        model, positive = 0.0, 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
            positive += columns[i, a] * max(theta[a], 0.0)
        fitted[i] = model if k >= first and model > 0.0 else np.nan
        # a ramp multiplies the noise of the mean second difference: 4 R² (m²/2)² Var(slope)
        variance[i] += 4.0 * theta[R] * columns[i, R] ** 2 * noise
        edf[i] = 2.0 * positive * positive / variance[i]
    if free:
        _bound_by_first_point(avar[rows[0]], edf[rows[0]], columns[rows[0], Q], entered, lo, hi, status)
    return first


@compiled
def _judge_ramp(slope, slope_variance, thresholds, entered, theta, lo, hi, status):  # type: ignore[no-untyped-def]
    """R is in when the slope is more than noise makes even with K at the upper end of its interval.

    Returns the variance of the slope under the fitted noise.
    """
    noise = 0.0
    for a in range(NOISES):
        noise += max(theta[a], 0.0) * slope_variance[a]
    most = noise
    if status[K] > 0:
        most += (hi[K] ** 2 - theta[K]) * slope_variance[K]
    entered[R] = status[K] > 0 and abs(slope) > thresholds[1 if entered[R] else 0] * np.sqrt(most)
    theta[R] = slope * slope if entered[R] else max(slope * slope - noise, 0.0)
    status[R] = 2 if entered[R] else 1
    lo[R] = max(abs(slope) - TWO_SIDED_95 * np.sqrt(most), 0.0) if entered[R] else 0.0
    hi[R] = abs(slope) + (TWO_SIDED_95 if entered[R] else ONE_SIDED_95) * np.sqrt(most)
    return noise


@compiled
def _fit_terms(  # type: ignore[no-untyped-def]
    avar, level, rows, stretch, columns, covariance, variance, normal, right, theta
):
    """Re-weighted Q N B K; how many of the shortest τ were left out, and whether Q² was set free."""
    first = 0
    free = False
    asking = True
    while True:
        used = rows[first:]
        for i in used:  # white noise of that level, to begin with
            variance[i] = avar[i] * avar[i] * covariance[i, i, WHITE] / columns[i, N] ** 2
        for _ in range(PASSES):
            _normal_equations(level, used, variance, columns, normal, right)
            _solve_nonnegative(normal, right, free, theta)
            _variances(used, theta, covariance, stretch, variance)
        limit = MISFIT_AGAIN if free else MISFIT
        if not asking or not _contradicted(level, used[:SHORT_ROWS], theta, columns, variance, limit):
            break
        if not free:
            free = True
        elif used.size > MIN_ROWS and columns[used[0], N] * FILTER_MEMORY >= 1.0:
            first += 1
        else:  # no filter: a line, motion, or what else the five terms do not know
            first, free, asking = 0, False, False
    _normal_equations(level, used, variance, columns, normal, right)
    return first, free


@compiled
def _normal_equations(avar, rows, variance, columns, normal, right):  # type: ignore[no-untyped-def]
    normal[:] = 0.0
    right[:] = 0.0
    for i in rows:
        weight = 1.0 / variance[i]
        for a in range(5):
            x = weight * columns[i, a]
            right[a] += x * avar[i]
            for b in range(a + 1):
                normal[a, b] += x * columns[i, b]
    for a in range(5):
        for b in range(a):
            normal[b, a] = normal[a, b]


@compiled
def _variances(rows, theta, covariance, stretch, variance):  # type: ignore[no-untyped-def]
    """Var σ²_i of the model; a negative Q² stands for a band limit and adds none."""
    products = np.empty(10)
    for pair in range(10):
        a, b = PAIRS[pair]
        products[pair] = max(theta[a], 0.0) * max(theta[b], 0.0) * (1.0 if a == b else 2.0)
    for i in rows:
        total = 0.0
        for pair in range(10):
            total += products[pair] * covariance[i, i, pair]
        variance[i] = total * stretch[i]


@compiled
def _solve_nonnegative(normal, right, free, theta):  # type: ignore[no-untyped-def]
    """Least squares with Q N B K not negative (Q may be, if free): the subset that meets Kuhn and Tucker.

    Terms in the subset are positive, and none of those left out would lower the error by growing.
    """
    for subset in range(2**NOISES - 1, 0, -1):
        if not _solve(normal, right, subset, theta):
            continue
        allowed = True
        for a in range(NOISES):
            if subset >> a & 1:
                allowed = allowed and (theta[a] >= 0.0 or (free and a == Q))
            else:
                pull = right[a]
                for b in range(NOISES):
                    pull -= normal[a, b] * theta[b]
                allowed = allowed and pull <= 1e-9 * abs(right[a])
        if allowed:
            return
    for a in range(5):
        theta[a] = 0.0
    theta[N] = right[N] / normal[N, N]


@compiled
def _solve(normal, right, subset, solution):  # type: ignore[no-untyped-def]
    """Cholesky on the columns of a subset, each scaled to one; False when they cannot be told apart."""
    factor = np.zeros((5, 5))
    solution[:] = 0.0
    for a in range(5):
        if not subset >> a & 1:
            continue
        y = right[a] / np.sqrt(normal[a, a])
        for b in range(a + 1):
            if not subset >> b & 1:
                continue
            x = normal[a, b] / np.sqrt(normal[a, a] * normal[b, b])
            for c in range(b):
                x -= factor[a, c] * factor[b, c]
            if b < a:
                factor[a, b] = x / factor[b, b]
            elif x < 1e-12:
                return False
            else:
                factor[a, a] = np.sqrt(x)
        for c in range(a):
            y -= factor[a, c] * solution[c]
        solution[a] = y / factor[a, a]
    for a in range(4, -1, -1):
        if not subset >> a & 1:
            continue
        x = solution[a]
        for c in range(a + 1, 5):
            x -= factor[c, a] * solution[c]
        solution[a] = x / factor[a, a]
    for a in range(5):
        if subset >> a & 1:
            solution[a] /= np.sqrt(normal[a, a])
    return True


@compiled
def _contradicted(avar, rows, theta, columns, variance, limit):  # type: ignore[no-untyped-def]
    """Whether a row lies ``limit`` σ off; χ² made normal by its cube root (Wilson & Hilferty 1931)."""
    for i in rows:
        model = 0.0
        for a in range(5):
            model += columns[i, a] * theta[a]
        if model <= 0.0:
            return True
        spread = variance[i] / (9.0 * model * model)  # 2/(9 edf)
        if abs((avar[i] / model) ** (1.0 / 3.0) - 1.0 + spread) > limit * np.sqrt(spread):
            return True
    return False


@compiled
def _judge(  # type: ignore[no-untyped-def]
    rows, variance, stretch, columns, covariance, normal, right, thresholds, entered, theta, lo, hi, status
):
    """Which terms are in, and the interval of each: see the head of the module."""
    gain = np.empty(rows.size)
    unit = np.empty(5)
    solution = np.empty(5)
    forms = np.empty(10)
    for a in range(5):
        subset = (2**NOISES - 1) | (1 << a)
        unit[:] = 0.0
        unit[a] = 1.0
        if not _solve(normal, unit, subset, solution):
            entered[a] = False
            continue
        estimate = 0.0
        for c in range(5):
            estimate += solution[c] * right[c]
        for k in range(rows.size):
            x = 0.0
            for c in range(5):
                x += solution[c] * columns[rows[k], c]
            gain[k] = x / variance[rows[k]] * np.sqrt(stretch[rows[k]])
        _quadratic_forms(gain, rows, covariance, forms)
        c0, c1, c2 = 0.0, 0.0, 0.0
        for pair in range(10):
            b, c = PAIRS[pair]
            if b == a and c == a:
                c2 = forms[pair]
            elif b == a or c == a:
                c1 += 2.0 * max(theta[b + c - a], 0.0) * forms[pair]
            else:
                c0 += max(theta[b], 0.0) * max(theta[c], 0.0) * forms[pair] * (1.0 if b == c else 2.0)
        threshold = thresholds[1] if entered[a] else thresholds[0]
        entered[a] = a != R and theta[a] > 0.0 and estimate > threshold * np.sqrt(c0)
        if entered[a]:
            status[a] = 2
            value = np.sqrt(theta[a])
            lo[a] = min(value, _interval_end(estimate, c0, c1, c2, TWO_SIDED_95))
            hi[a] = max(value, _interval_end(estimate, c0, c1, c2, -TWO_SIDED_95))
        else:
            # a bound below what an estimate of zero would give claims more than the curve can know
            bound = _interval_end(max(estimate, 0.0), c0, c1, c2, -ONE_SIDED_95)
            if bound < np.inf:
                status[a] = 1
                lo[a] = 0.0
                hi[a] = bound


@compiled
def _quadratic_forms(gain, rows, covariance, forms):  # type: ignore[no-untyped-def]
    """g C^ab g of all pairs of noises; ten scalars, because sums in an array take three times as long."""
    f0 = f1 = f2 = f3 = f4 = f5 = f6 = f7 = f8 = f9 = 0.0
    for k in range(rows.size):
        for j in range(k + 1):
            weight = gain[k] * gain[j] * (1.0 if j == k else 2.0)
            c = covariance[rows[k], rows[j]]
            f0 += weight * c[0]
            f1 += weight * c[1]
            f2 += weight * c[2]
            f3 += weight * c[3]
            f4 += weight * c[4]
            f5 += weight * c[5]
            f6 += weight * c[6]
            f7 += weight * c[7]
            f8 += weight * c[8]
            f9 += weight * c[9]
    sums = (f0, f1, f2, f3, f4, f5, f6, f7, f8, f9)
    for pair in range(10):
        forms[pair] = sums[pair]


@compiled
def _interval_end(estimate, c0, c1, c2, z):  # type: ignore[no-untyped-def]
    """√t where the estimate lies k √v(t) above t; k is the Pearson-III quantile of probability Φ(z).

    Wilson & Hilferty: k = (2/s)[(1 + s z/6 − s²/36)³ − 1], skewness s = 2 √c2 as of χ² with 2/c2 degrees of
    freedom. t solves (1 − k²c2) t² − (2û + k²c1) t + û² − k²c0 = 0; the end is clipped at zero.
    """
    s = 2.0 * np.sqrt(c2)
    k = z if s < 1e-6 else 2.0 / s * (max(1.0 + s * z / 6.0 - s * s / 36.0, 0.0) ** 3 - 1.0)
    a = 1.0 - k * k * c2
    b = estimate + 0.5 * k * k * c1
    root = b * b - a * (estimate * estimate - k * k * c0)
    if root < 0.0:
        return 0.0 if z > 0.0 else np.inf
    if a <= 1e-9:
        return 0.0 if z > 0.0 else np.inf
    t = (b - np.sqrt(root)) / a if z > 0.0 else (b + np.sqrt(root)) / a
    return np.sqrt(max(t, 0.0))


@compiled
def _bound_by_first_point(avar, edf, column, entered, lo, hi, status):  # type: ignore[no-untyped-def]
    """Q is hidden behind the sensor's band limit: it makes no more than the whole of the first point."""
    entered[Q] = False
    status[Q] = 1
    lo[Q] = 0.0
    spread = 2.0 / (9.0 * max(edf, 1.0))
    hi[Q] = np.sqrt(avar / column / max(1.0 - spread - ONE_SIDED_95 * np.sqrt(spread), 0.05) ** 3)
