"""Test of whether a bias differs between heating and cooling at the same temperature (hysteresis).

Hysteresis is described by three kinds of regressors:

- differences between heating and cooling, which vanish at the ends of the temperature range;
- first-order lags, which represent heat that reaches the sensor with a delay;
- play operators of the Prandtl-Ishlinskii model (Visintin, Differential Models of Hysteresis, 1994, chapter III).

The tests are F tests beside the slow noise of the axis, see ``interval_regression``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.drift.thermal.interval_means import IntervalMeans, average_groups, interpolate_missing_temperatures
from monitor.drift.thermal.interval_regression import estimate_white_noise, f_test
from monitor.drift.thermal.thermal_response import apply_first_order_lag

SIGNIFICANCE: Final = 0.01
"""Maximum p-value at which hysteresis is reported, after Bonferroni correction."""
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
CURVE_ORDER: Final = 5
"""Order of the polynomial in temperature to which regressors for hysteresis are added."""


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """Difference in bias between heating and cooling."""

    size: float  # largest bias difference at one temperature, including a drift in between; rad/s or m/s²
    p_value: float  # p-value of the null hypothesis that there is no difference
    share: float  # share of the variance of the interval means that temperature and hysteresis explain

    @property
    def is_significant(self) -> bool:
        """Return True if the hysteresis is statistically significant."""
        return self.p_value < SIGNIFICANCE


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
    means = average_groups(means)
    x, direction = _scaled(means)
    if not rose_and_fell(direction):
        return None
    y, known = means.bias, means.both_known
    curve, loops = _polynomial(x, CURVE_ORDER), _hysteresis_regressors(x, direction)
    # Single lags and play operators are also tested, because they leave more degrees of freedom than all four together.
    candidates = [*loops.values(), *loops["lag"].T[:, :, None], *loops["play"].T[:, :, None]]
    with_drift = np.hstack([np.linspace(-1.0, 1.0, x.size)[:, None], curve])
    tests = [found for each in candidates if (found := f_test(y, with_drift, each, known)) is not None]
    # In a single temperature cycle, drift and hysteresis are nearly collinear, so the size of the hysteresis is fitted
    # without a drift term.
    fits = [(found, each) for each in candidates if (found := f_test(y, curve, each, known)) is not None]
    if not tests or not fits:
        return None
    best, columns = max(fits, key=lambda one: one[0].likelihood)
    residuals = (y - np.hstack([curve, columns]) @ best.coefficients)[known]
    smooth = y[known] - estimate_white_noise(residuals, known, best.noise)
    size = _loop_width(smooth, x[known], direction[known])
    share = 1.0 - float(np.var(residuals) / np.var(y[known]))
    return Hysteresis(size, min(len(tests) * min(one.p_value for one in tests), 1.0), share)


def _scaled(means: IntervalMeans) -> tuple[Floats, Floats]:
    """Return the temperature, scaled to the range from -1 to 1, and the heating direction."""
    temperature_c = interpolate_missing_temperatures(means.temperature_c)
    lowest, swing = float(temperature_c.min()), float(np.ptp(temperature_c))
    return 2.0 * (temperature_c - lowest) / swing - 1.0, heating_direction(temperature_c)


def rose_and_fell(direction: Floats) -> bool:
    """Return True if the temperature rose in at least three intervals and fell in at least three intervals."""
    return min(int((direction > 0.0).sum()), int((direction < 0.0).sum())) >= 3


def _polynomial(x: Floats, order: int) -> Floats:
    """Return the powers x, x², … up to ``order`` as columns [n, order]."""
    return np.stack([x**power for power in range(1, order + 1)], axis=1)


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
