"""Response of a bias to temperature, expressed as a linear combination of regressors.

A first-order lag describes heat that reaches the sensor with a delay: L_n = p L_{n−1} + (1 − p) T_n, with p =
exp(−Δt/τ). Networks of thermal resistances and capacitances have only real, positive time constants. A difference
equation

    Y_n + a_1 Y_{n−1} + … + a_k Y_{n−k} = b_0 T_n + … + b_m T_{n−m} + c

with the roots p_1 … p_k is therefore a stable sum of k lags. The order m is k − 1, or k if part of the bias follows the
temperature without delay. Each root also has an initial-state response p^n, which represents the effect of temperatures
before the first interval.

A polynomial describes a bias that follows the temperature without delay. Outside the temperature range of the fit, each
power of the temperature is extrapolated linearly.
"""

from dataclasses import dataclass

import numpy as np

from drivers.data_types import Floats
from monitor.common.compiled import compiled


@dataclass(frozen=True, slots=True)
class ThermalModelForm:
    """Form of a thermal model, given by the order of the polynomial and the time constants of the lags."""

    powers: int  # order of the polynomial in the temperature, which acts without delay
    constants_s: tuple[float, ...]  # time constants of the lags, s

    @property
    def difference_equation_order(self) -> int:
        """Return the order k of the difference equation, which is 0 for a polynomial."""
        return len(self.constants_s)

    @property
    def is_constant(self) -> bool:
        """Return True if the bias does not depend on temperature."""
        return not (self.powers or self.constants_s)

    @property
    def name(self) -> str:
        """Return the name of the model form for display.

        >>> ThermalModelForm(0, ()).name, ThermalModelForm(3, ()).name
        ('constant', 'polynomial 3')
        >>> ThermalModelForm(0, (3600.0,)).name, ThermalModelForm(1, (60.0, 600.0)).name
        ('difference 1, 0', 'difference 2, 2')
        """
        if order := self.difference_equation_order:
            return f"difference {order}, {order - 1 + min(self.powers, 1)}"
        return f"polynomial {self.powers}" if self.powers else "constant"


def compute_lag_roots(shape: ThermalModelForm, interval_s: float) -> Floats:
    """Return the root p = exp(−Δt/τ) of each lag.

    Parameters
    ----------
    shape : ThermalModelForm
        Form of the thermal model.
    interval_s : float
        Length of an interval, s.
    """
    return np.exp(-interval_s / np.asarray(shape.constants_s, dtype=np.float64))


def build_regressors(
    shape: ThermalModelForm,
    excess_c: Floats,
    interval_s: float,
    with_initial_state: bool = False,
    range_c: tuple[float, float] | None = None,
) -> Floats:
    """Return the regressors [n, terms]: constant, powers of the relative temperature, lags, initial-state responses.

    Parameters
    ----------
    shape : ThermalModelForm
        Form of the thermal model.
    excess_c : ndarray, shape (n,)
        Temperature relative to the reference temperature, °C, without missing values.
    interval_s : float
        Length of an interval, s.
    with_initial_state : bool
        True to add the initial-state response of each lag, False to assume a constant temperature before the first
        interval.
    range_c : (float, float) or None
        Temperature range of the fit, relative to the reference temperature, °C. Outside the range, powers are
        extrapolated linearly.

    Examples
    --------
    >>> build_regressors(ThermalModelForm(1, ()), np.array([0.0, 2.0]), 60.0).tolist()
    [[1.0, 0.0], [1.0, 2.0]]
    """
    n = excess_c.size
    columns = [np.ones(n)]
    columns += [_power(excess_c, power, range_c) for power in range(1, shape.powers + 1)]
    p = compute_lag_roots(shape, interval_s)
    columns += [apply_first_order_lag(excess_c, one) for one in p]
    if with_initial_state:
        columns += [one ** np.arange(n, dtype=np.float64) for one in p]
    return np.stack(columns, axis=1)


def temperature_beyond_range(excess_c: Floats, range_c: tuple[float, float]) -> Floats:
    """Return the signed distance of each temperature from the temperature range of the fit in °C, or 0 inside.

    Parameters
    ----------
    excess_c : ndarray, shape (n,)
        Temperature relative to the reference temperature, °C.
    range_c : (float, float)
        Temperature range of the fit, relative to the reference temperature, °C.
    """
    return excess_c - np.clip(excess_c, *range_c)


def _power(x: Floats, power: int, ends: tuple[float, float] | None) -> Floats:
    """Return a power of x.

    Outside the range ``ends``, the power is extrapolated linearly with its mean slope over the range.
    """
    if ends is None or ends[1] <= ends[0]:
        return np.asarray(x**power)
    chord = (ends[1] ** power - ends[0] ** power) / (ends[1] - ends[0])
    return np.asarray(np.clip(x, *ends) ** power + chord * temperature_beyond_range(x, ends))


@compiled
def apply_first_order_lag(values: Floats, root: float) -> Floats:
    """Apply a first-order lag L_n = p L_{n−1} + (1 − p) x_n, whose initial state is the first value.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Input of the lag.
    root : float
        Root of the lag, 0 < p < 1.
    """
    out = np.empty(values.size)
    level = values[0]
    for k in range(values.size):
        level = root * level + (1.0 - root) * values[k]
        out[k] = level
    return out


def difference_equation_coefficients(
    shape: ThermalModelForm, coefficients: Floats, interval_s: float
) -> tuple[Floats, Floats, float]:
    """Return the coefficients a [k], b [m + 1] and c of the difference equation in the relative temperature.

    Parameters
    ----------
    shape : ThermalModelForm
        Form of the thermal model.
    coefficients : ndarray, shape (terms,)
        Coefficients of the constant, the powers and the lags.
    interval_s : float
        Length of an interval, s.

    Examples
    --------
    >>> shape = ThermalModelForm(0, (1.0 / np.log(2.0),))
    >>> a, b, c = difference_equation_coefficients(shape, np.array([3.0, 10.0]), 1.0)
    >>> a.round(12).tolist(), b.round(12).tolist(), round(c, 12)
    ([-0.5], [5.0], 1.5)
    """
    p = compute_lag_roots(shape, interval_s)
    whole = np.poly(p) if p.size else np.ones(1)  # [k + 1] the value 1, followed by the coefficients a
    b = np.zeros(whole.size)
    if shape.powers:
        b += coefficients[1] * whole
    for i, one in enumerate(p):
        rest = np.poly(np.delete(p, i)) if p.size > 1 else np.ones(1)
        b[: rest.size] += coefficients[1 + shape.powers + i] * (1.0 - one) * rest
    last = b.size if shape.powers else b.size - 1
    return np.asarray(whole[1:], dtype=np.float64), b[: max(last, 1)], float(coefficients[0] * whole.sum())
