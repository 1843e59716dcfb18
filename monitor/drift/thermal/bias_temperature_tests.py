"""Tests of whether a bias depends on temperature, and whether it differs between heating and cooling (hysteresis).

A random walk of the bias can correlate with temperature by chance. The tests are therefore F tests in a generalised
least-squares regression. The noise model is the sum of white noise and a random walk with correlated increments. The
two parameters of the noise model are unknown, so the F test is repeated for each pair of parameters on a grid. A pair
is plausible if its restricted log-likelihood (Harville, J. Am. Stat. Assoc. 72, 1977) is within MAX_LIKELIHOOD_LOSS of
the maximum. The largest p-value among all plausible pairs is used. Measured false positive rates are listed in
docs/measurements/thermal-models.md.

Hysteresis is described by three kinds of regressors:

- differences between heating and cooling, which vanish at the ends of the temperature range;
- first-order lags, which represent heat that reaches the sensor with a delay;
- play operators of the Prandtl-Ishlinskii model (Visintin, Differential Models of Hysteresis, 1994, chapter III).

If the temperature rose and fell, the null hypothesis includes a linear drift with time. If the temperature only rose or
only fell, a drift with time cannot be distinguished from a dependence on temperature.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import incomplete_beta
from monitor.drift.thermal.interval_means import IntervalMeans
from monitor.drift.thermal.thermal_model import interpolate_missing_temperatures
from monitor.drift.thermal.thermal_response import apply_first_order_lag

SIGNIFICANCE: Final = 0.01
"""Maximum p-value at which a dependence or hysteresis is reported, after Bonferroni correction."""
MAIN_SHARE: Final = 0.5
"""Minimum explained share of the variance at which temperature is said to explain most of the variance."""
MAX_MEANS: Final = 150
"""Maximum number of interval means in a test. The computing time grows with the third power of this number."""
MIN_FREE: Final = 4
"""Minimum number of residual degrees of freedom of a regression."""
MAX_LIKELIHOOD_LOSS: Final = 2.0
"""Maximum amount by which the restricted log-likelihood of a plausible noise model is below the maximum."""
WALK_RATIOS: Final = (0.0, *np.geomspace(1e-3, 1e3, 9).tolist())
"""Grid of the variance of the random walk increments, divided by the variance of the white noise."""
INCREMENT_CORRELATIONS: Final = (0.0, 0.5, 0.8, 0.95)
"""Grid of the correlation between successive increments of the random walk."""
MIN_REVERSAL_SHARE: Final = 0.05
"""Minimum temperature change that counts as a reversal, as a fraction of the temperature range."""
MIN_REVERSAL_SIGMAS: Final = 3.0
"""Minimum temperature change that counts as a reversal, in standard errors of a mean temperature."""
LAG_INTERVALS: Final = (1.0, 2.5, 6.0, 15.0)
"""Time constants of the first-order lags, in intervals."""
PLAY_WIDTHS: Final = (0.05, 0.1, 0.2, 0.35)
"""Half-widths of the play operators, as fractions of the temperature range."""
LOOP_POWERS: Final = 4
"""Number of polynomial terms that describe the difference between heating and cooling."""
FOLDS: Final = 6
"""Number of folds of the cross-validation. Successive interval means belong to different folds."""
MIN_NEW_SHARE: Final = 1e-4
"""Minimum fraction of a regressor that must be linearly independent of the preceding regressors."""
CURVE_ORDER: Final = 3
"""Order of the polynomial in temperature that is used to test for a dependence."""
HYSTERESIS_CURVE_ORDER: Final = 5
"""Order of the polynomial in temperature to which regressors for hysteresis are added."""


@dataclass(frozen=True, slots=True)
class TemperatureDependence:
    """Significant dependence of a bias on temperature."""

    share: float  # cross-validated share of the variance of the interval means that temperature explains
    p_value: float  # p-value of the null hypothesis that the bias does not depend on temperature
    form: str  # "cubic", or "cubic with hysteresis"
    one_way: bool  # True if the temperature only rose or only fell
    interval_s: float

    @property
    def explains_most_variance(self) -> bool:
        """Return True if temperature explains at least half of the bias variance."""
        return self.share >= MAIN_SHARE


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """Difference in bias between heating and cooling."""

    size: float  # largest bias difference at one temperature, including a drift in between; rad/s or m/s²
    p_value: float  # p-value of the null hypothesis that there is no difference

    @property
    def hysteresis_is_significant(self) -> bool:
        """Return True if the hysteresis is statistically significant."""
        return self.p_value < SIGNIFICANCE


@dataclass(frozen=True, slots=True)
class _Regression:
    """Result of an F test of additional regressors."""

    p_value: float  # largest p-value among the plausible noise models
    likelihood: float  # largest restricted log-likelihood; comparable between regressions of the same means
    smooth: Floats  # [m] interval means after subtraction of the estimated white noise
    noise: tuple[float, float]  # variance ratio and correlation of the most likely noise model


def temperature_noise_c(temperature_c: Floats) -> float:
    """Return the standard deviation of the temperature noise in °C, estimated from second differences."""
    second = np.diff(temperature_c, 2)
    return float(np.median(np.abs(second))) / 6.0**0.5 / 0.6745 if second.size else 0.0


def heating_direction(temperature_c: Floats) -> Floats:
    """Return +1 where the temperature rises and -1 where it falls, or zeros if it is constant.

    The direction changes only if the temperature reverses by more than MIN_REVERSAL_SHARE of the temperature range and
    by more than MIN_REVERSAL_SIGMAS standard errors.

    Parameters
    ----------
    temperature_c : ndarray, shape (n,)
        Temperature in °C, without missing values.

    Examples
    --------
    >>> heating_direction(np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0])).tolist()
    [1.0, 1.0, 1.0, -1.0, -1.0, -1.0]
    """
    noise_c = temperature_noise_c(temperature_c)
    threshold = max(MIN_REVERSAL_SHARE * float(np.ptp(temperature_c)), MIN_REVERSAL_SIGMAS * noise_c)
    direction = np.zeros(temperature_c.size)
    highest = lowest = 0
    now = 0.0
    for at, value in enumerate(temperature_c.tolist()):
        if value > temperature_c[highest]:
            highest = at
        if value < temperature_c[lowest]:
            lowest = at
        if now >= 0.0 and temperature_c[highest] - value > threshold:
            now, lowest = -1.0, at
            direction[highest + 1 : at] = now
        elif now <= 0.0 and value - temperature_c[lowest] > threshold:
            now, highest = 1.0, at
            direction[lowest + 1 : at] = now
        direction[at] = now
    moved = np.flatnonzero(direction)
    if moved.size:
        direction[: moved[0]] = direction[moved[0]]
    return direction


def find_temperature_dependence(means: IntervalMeans) -> TemperatureDependence | None:
    """Test whether a bias depends on temperature.

    Parameters
    ----------
    means : IntervalMeans
        Interval means of the bias (rad/s or m/s²) and of the temperature (°C), which must vary.

    Returns
    -------
    TemperatureDependence or None
        Significant dependence that explains the largest share of the variance, or None if no dependence is significant.
    """
    pooled = _pooled(means)
    known, y = pooled.both_known, pooled.bias
    x, direction = _scaled(pooled)
    one_way = not _rose_and_fell(direction)
    curve = _polynomial(x, CURVE_ORDER)
    candidates = [("cubic", curve)]
    nuisance = np.zeros((x.size, 0))
    if not one_way:
        loops = _hysteresis_regressors(x, direction).values()
        candidates += [("cubic with hysteresis", np.hstack([curve, each])) for each in loops]
        nuisance = _linear_drift(x.size)
    found: TemperatureDependence | None = None
    for form, columns in candidates:
        tested = _regression(y, nuisance, columns, known)
        if tested is None or (p_value := len(candidates) * tested.p_value) >= SIGNIFICANCE:
            continue
        share = _validated_share(y, nuisance, columns, known, tested.noise)
        if found is None or share > found.share + 0.01:  # prefer a simpler form
            found = TemperatureDependence(share, p_value, form, one_way, means.interval_s)
    return found


def find_hysteresis(means: IntervalMeans) -> Hysteresis | None:
    """Test whether a bias differs between heating and cooling at the same temperature.

    Parameters
    ----------
    means : IntervalMeans
        Interval means of the bias (rad/s or m/s²) and of the temperature (°C), which must vary.

    Returns
    -------
    Hysteresis or None
        Hysteresis and its p-value, or None if the temperature did not both rise and fall, or if there are too few
        means.
    """
    pooled = _pooled(means)
    x, direction = _scaled(pooled)
    if not _rose_and_fell(direction):
        return None
    curve, loops = _polynomial(x, HYSTERESIS_CURVE_ORDER), _hysteresis_regressors(x, direction)
    # Single lags and play operators are also tested, because they leave more degrees of freedom than all four together.
    candidates = [*loops.values(), *loops["lag"].T[:, :, None], *loops["play"].T[:, :, None]]

    def fit_candidate_regressions(nuisance: Floats) -> list[_Regression]:
        tested = (_regression(pooled.bias, nuisance, each, pooled.both_known) for each in candidates)
        return [one for one in tested if one is not None]

    tests = fit_candidate_regressions(np.hstack([_linear_drift(x.size), curve]))
    # In a single temperature cycle, drift and hysteresis are nearly collinear, so the size of the hysteresis is fitted
    # without a drift term.
    fits = fit_candidate_regressions(curve)
    if not tests or not fits:
        return None
    best = max(fits, key=lambda one: one.likelihood)
    size = _loop_width(best.smooth, x[pooled.both_known], direction[pooled.both_known])
    return Hysteresis(size, min(len(tests) * min(one.p_value for one in tests), 1.0))


def _pooled(means: IntervalMeans) -> IntervalMeans:
    """Return the interval means, averaged in groups if there are more than MAX_MEANS of them."""
    group = -(-means.bias.size // MAX_MEANS)
    if group == 1:
        return means
    count = means.bias.size // group
    known = means.both_known[: count * group].reshape(count, group)
    rows = (np.where(known, part[: count * group].reshape(count, group), 0.0) for part in (means.bias, means.error))
    bias, error = (part.sum(axis=1) for part in rows)
    there = np.maximum(known.sum(axis=1), 1)
    enough = 2 * known.sum(axis=1) >= group
    temperature_c = (
        interpolate_missing_temperatures(means.temperature_c)[: count * group].reshape(count, group).mean(axis=1)
    )
    return IntervalMeans(
        group * means.interval_s,
        np.where(enough, bias / there, np.nan),
        error / there**1.5,
        temperature_c,
    )


def _scaled(means: IntervalMeans) -> tuple[Floats, Floats]:
    """Return the temperature, scaled to the range from -1 to 1, and the heating direction."""
    temperature_c = interpolate_missing_temperatures(means.temperature_c)
    lowest, swing = float(temperature_c.min()), float(np.ptp(temperature_c))
    return 2.0 * (temperature_c - lowest) / swing - 1.0, heating_direction(temperature_c)


def _rose_and_fell(direction: Floats) -> bool:
    """Return True if the temperature rose in at least three intervals and fell in at least three intervals."""
    return min(int((direction > 0.0).sum()), int((direction < 0.0).sum())) >= 3


def _polynomial(x: Floats, order: int) -> Floats:
    """Return the powers x, x², … up to ``order`` as columns [n, order]."""
    return np.stack([x**power for power in range(1, order + 1)], axis=1)


def _linear_drift(n: int) -> Floats:
    """Return a linear drift from -1 to 1 as a column [n, 1]."""
    return np.linspace(-1.0, 1.0, n)[:, None]


def _hysteresis_regressors(x: Floats, direction: Floats) -> Mapping[str, Floats]:
    """Return the regressors [n, k] of each kind of hysteresis."""
    return {
        "direction": np.stack([direction * (1.0 - x**2) * x**power for power in range(LOOP_POWERS)], axis=1),
        "lag": np.stack(
            [apply_first_order_lag(x, float(np.exp(-1.0 / constant))) - x for constant in LAG_INTERVALS], axis=1
        ),
        "play": np.stack([_play(x, 2.0 * width) - x for width in PLAY_WIDTHS], axis=1),
    }


def _play(x: Floats, half_width: float) -> Floats:
    """Return the output of a play operator, which follows its input x at a distance of at most ``half_width``.

    >>> _play(np.array([0.0, 1.0, 0.0, -1.0]), 0.25).tolist()
    [0.0, 0.75, 0.25, -0.75]
    """
    out = np.empty(x.size)
    level = float(x[0])
    for at, value in enumerate(x.tolist()):
        level = min(max(level, value - half_width), value + half_width)
        out[at] = level
    return out


def _regression(y: Floats, nuisance: Floats, tested: Floats, known: np.ndarray) -> _Regression | None:
    """Perform the F test of additional regressors, or return None if there are too few interval means."""
    if int(known.sum()) <= MIN_FREE + 1:
        return None
    whiteners, log_determinants = _whiteners(known.tobytes())
    own = nuisance.shape[1]
    columns = np.hstack([nuisance, tested])[known]
    columns = columns - columns.mean(axis=0)
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    _, r = np.linalg.qr(columns / scale)
    new = np.flatnonzero(np.abs(np.diag(r)) > MIN_NEW_SHARE)
    q, _ = np.linalg.qr((columns / scale)[:, new])
    at = int((new < own).sum())
    count, terms = whiteners.shape[1], new.size
    free = count - terms
    if free < MIN_FREE or terms == at:
        return None
    values = y[known] - y[known].mean()
    triangles = np.asarray(np.linalg.qr(whiteners @ np.column_stack([q, values]), mode="r"))
    gained = (triangles[:, at:terms, terms] ** 2).sum(axis=1)
    floor = np.finfo(float).eps ** 2 * float(values @ values)
    left = np.maximum(triangles[:, terms, terms] ** 2, max(floor, 1e-300))
    diagonal = np.abs(triangles[:, np.arange(terms), np.arange(terms)])
    likelihood = -0.5 * (free * np.log(left) + log_determinants) - np.log(np.maximum(diagonal, 1e-300)).sum(axis=1)
    unexplained = left / (left + gained)
    # These are the p-values of F = gained / (terms - at) / (left / free).
    p_values = incomplete_beta(0.5 * free, 0.5 * (terms - at), unexplained)
    best = int(likelihood.argmax())
    plausible = likelihood >= likelihood[best] - MAX_LIKELIHOOD_LOSS
    sizes = np.linalg.solve(triangles[best, :terms, :terms], triangles[best, :terms, terms])
    white = whiteners[best].T @ (whiteners[best] @ (values - q @ sizes))
    full = float((-0.5 * (count * np.log(left) + log_determinants)).max())
    return _Regression(float(p_values[plausible].max()), full, values - white, _noise_models()[best])


def _validated_share(
    y: Floats, nuisance: Floats, tested: Floats, known: np.ndarray, noise: tuple[float, float]
) -> float:
    """Return the cross-validated share of the bias variance that the regressors explain."""
    columns = np.hstack([nuisance, tested])[known]
    columns = columns - columns.mean(axis=0)
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    values = y[known] - y[known].mean()
    whitener, _ = _whitener(known, *noise)
    precision = whitener.T @ whitener
    left = np.empty(values.size)
    for fold in range(FOLDS):
        out = np.arange(values.size) % FOLDS == fold
        beside = precision[np.ix_(~out, out)]
        marginal = precision[np.ix_(~out, ~out)] - beside @ np.linalg.solve(precision[np.ix_(out, out)], beside.T)
        others = columns[~out]
        sizes = np.linalg.lstsq(others.T @ marginal @ others, others.T @ marginal @ values[~out], rcond=1e-12)[0]
        rest = values - columns[:, nuisance.shape[1] :] @ sizes[nuisance.shape[1] :]
        left[out] = rest[out] - rest[~out].mean()
    return 1.0 - float(np.mean(left**2) / np.var(values))


def _noise_models() -> list[tuple[float, float]]:
    """Return the variance ratio and the correlation of each noise model on the grid."""
    return [(ratio, one) for ratio in WALK_RATIOS for one in (INCREMENT_CORRELATIONS if ratio else (0.0,))]


@lru_cache(maxsize=4)
def _whiteners(known: bytes) -> tuple[Floats, Floats]:
    """Return the whitening matrices [g, m - 1, m] and the log determinants [g] of all g noise models."""
    there = np.frombuffer(known, np.bool_)
    made = [_whitener(there, *one) for one in _noise_models()]
    return np.stack([each for each, _ in made]), np.array([each for _, each in made])


def _whitener(known: np.ndarray, ratio: float, correlation: float) -> tuple[Floats, float]:
    """Return the matrix [m - 1, m] that whitens the differences between m interval means, and its log determinant.

    The covariance matrix of the differences is the sum of a matrix for white noise and a matrix for the random walk.
    The matrix for white noise is tridiagonal with the elements (-1, 2, -1). The increments of an averaged random walk
    have the variance 2/3, and neighbouring increments have the covariance 1/6.
    """
    n, at = known.size, np.flatnonzero(known)
    if correlation:
        row = (1.0 - correlation) / (1.0 + correlation) * correlation ** np.arange(n - 1)
    else:
        row = np.zeros(n - 1)
        row[:2] = (2.0 / 3.0, 1.0 / 6.0)
    walk = _toeplitz(np.asarray(row))[at[0] : at[-1], at[0] : at[-1]]
    firsts = at[:-1] - at[0]
    walk = np.add.reduceat(np.add.reduceat(walk, firsts, axis=0), firsts, axis=1)
    white = np.zeros(at.size - 1)
    white[:2] = (2.0, -1.0)
    covariance = ratio * walk + _toeplitz(white)
    lower = np.linalg.cholesky(covariance)
    differences = np.diff(np.eye(at.size), axis=0)
    return np.linalg.solve(lower, differences), 2.0 * float(np.log(np.diag(lower)).sum())


def _toeplitz(row: Floats) -> Floats:
    """Return the symmetric Toeplitz matrix [n, n] whose first row is ``row``."""
    at = np.arange(row.size)
    return np.asarray(row[np.abs(at[:, None] - at)])


def _loop_width(bias: Floats, x: Floats, direction: Floats) -> float:
    """Return the largest difference of the bias between heating and cooling at the same temperature."""
    grid = np.linspace(-0.95, 0.95, 39)
    legs: dict[float, list[Floats]] = {1.0: [], -1.0: []}
    for leg in np.split(np.arange(x.size), np.flatnonzero(np.diff(direction)) + 1):
        order = leg[np.argsort(x[leg], kind="stable")]
        if order.size > 1:
            inside = (grid >= x[order[0]]) & (grid <= x[order[-1]])
            legs[float(direction[leg[0]])].append(np.where(inside, np.interp(grid, x[order], bias[order]), np.nan))
    rising, falling = (_mean_of_legs(each, grid.size) for each in (legs[1.0], legs[-1.0]))
    difference = np.abs(rising - falling)
    return float(np.nanmax(difference)) if np.isfinite(difference).any() else 0.0


def _mean_of_legs(legs: list[Floats], n: int) -> Floats:
    """Average the bias of all temperature sweeps on a temperature grid, with NaN outside all sweeps."""
    rows = np.array(legs).reshape(len(legs), n)
    there = np.isfinite(rows)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(there, rows, 0.0).sum(axis=0) / there.sum(axis=0))
