"""What a bias makes of temperature, as a sum of responses that are linear in their sizes.

A **lag** is heat that reaches the sensor late: L_n = p L_{n−1} + (1 − p) T_n, p = exp(−Δt/τ). Resistances and
capacities of heat have real, positive time constants only, so a difference equation

    Y_n + a_1 Y_{n−1} + … + a_k Y_{n−k} = b_0 T_n + … + b_m T_{n−m} + c

whose roots are p_1 … p_k is k lags side by side, each of its own size; m = k − 1, or m = k where some of the bias
follows at once. It is stable by construction. Each root also leaves p^n, what the time before the first interval left
behind.

A **polynomial** in T is the established alternative: no memory. Outside the temperatures of its fit it goes on
along the chord between their ends, as a power would run away.
"""

from dataclasses import dataclass

import numpy as np

from drivers.sample import Floats
from monitor.common.compiled import compiled


@dataclass(frozen=True, slots=True)
class Shape:
    """What is not linear: the form of the model."""

    powers: int  # of T − reference, at once
    constants_s: tuple[float, ...]  # time constants of the lags, s

    @property
    def memory(self) -> int:
        """Order k of the difference equation; 0 for a polynomial."""
        return len(self.constants_s)

    @property
    def name(self) -> str:
        """For people.

        >>> Shape(0, ()).name, Shape(3, ()).name, Shape(0, (3600.0,)).name, Shape(1, (60.0, 600.0)).name
        ('constant', 'polynomial 3', 'difference 1, 0', 'difference 2, 2')
        """
        if self.memory:
            return f"difference {self.memory}, {self.memory - 1 + min(self.powers, 1)}"
        return f"polynomial {self.powers}" if self.powers else "constant"


def roots(shape: Shape, interval_s: float) -> Floats:
    """p of each lag."""
    return np.exp(-interval_s / np.asarray(shape.constants_s, dtype=np.float64))


def responses(
    shape: Shape, excess_c: Floats, interval_s: float, began: bool = False, ends: tuple[float, float] | None = None
) -> Floats:
    """Columns [n, terms]: one, powers of T − reference, lags, and what was left behind at the start.

    Args:
        excess_c: [n] T − reference, °C, without holes
        ends: T − reference of the coldest and the warmest that was fitted, °C; beyond them powers are chords
        began: each lag has a start of its own, as the temperature before is not known; else it was what it is at first

    >>> responses(Shape(1, ()), np.array([0.0, 2.0]), 60.0).tolist()
    [[1.0, 0.0], [1.0, 2.0]]
    """
    n = excess_c.size
    columns = [np.ones(n)]
    columns += [_power(excess_c, power, ends) for power in range(1, shape.powers + 1)]
    p = roots(shape, interval_s)
    columns += [lagged(excess_c, one) for one in p]
    if began:
        columns += [one ** np.arange(n, dtype=np.float64) for one in p]
    return np.stack(columns, axis=1)


def outside(excess_c: Floats, ends: tuple[float, float]) -> Floats:
    """How far each is beyond the ends, °C."""
    return excess_c - np.clip(excess_c, *ends)


def _power(x: Floats, power: int, ends: tuple[float, float] | None) -> Floats:
    if ends is None or ends[1] <= ends[0]:
        return np.asarray(x**power)
    chord = (ends[1] ** power - ends[0] ** power) / (ends[1] - ends[0])
    return np.asarray(np.clip(x, *ends) ** power + chord * outside(x, ends))


@compiled
def lagged(x, p):  # type: ignore[no-untyped-def]
    """L_n = p L_{n−1} + (1 − p) x_n, settled at the first."""
    out = np.empty(x.size)
    level = x[0]
    for k in range(x.size):
        level = p * level + (1.0 - p) * x[k]
        out[k] = level
    return out


def solved(columns: Floats, y: Floats) -> Floats:
    """Sizes [terms] by least squares, columns scaled so that units do not matter."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    found = np.linalg.lstsq(columns / scale, y, rcond=1e-10)[0]
    return np.asarray(found / scale)


def equation(shape: Shape, sizes: Floats, interval_s: float) -> tuple[Floats, Floats, float]:
    """a [k], b [m + 1] and c of the difference equation in T − reference.

    >>> a, b, c = equation(Shape(0, (1.0 / np.log(2.0),)), np.array([3.0, 10.0]), 1.0)
    >>> a.round(12).tolist(), b.round(12).tolist(), round(c, 12)
    ([-0.5], [5.0], 1.5)
    """
    p = roots(shape, interval_s)
    whole = np.poly(p) if p.size else np.ones(1)  # [k + 1], 1 and a
    b = np.zeros(whole.size)
    if shape.powers:
        b += sizes[1] * whole
    for i, one in enumerate(p):
        rest = np.poly(np.delete(p, i)) if p.size > 1 else np.ones(1)
        b[: rest.size] += sizes[1 + shape.powers + i] * (1.0 - one) * rest
    last = b.size if shape.powers else b.size - 1
    return np.asarray(whole[1:], dtype=np.float64), b[: max(last, 1)], float(sizes[0] * whole.sum())
