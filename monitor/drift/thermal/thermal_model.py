"""A model of bias against temperature: its sizes, how sure they are, and what it expects of intervals to come.

A multi-step estimate knows temperature alone; a one-step estimate also knows the bias measured one interval before.
Intervals are those of the mean that is measured: they hold what the fit does not know of sizes and time constants, and
the scatter of the means. ``thermal`` chooses and fits models, ``recursion`` lets their sizes follow what comes.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.drift.thermal.thermal_response import Shape, equation, outside, responses

STEP: Final = 1e-3
"""Of the logarithm of a time constant, for its derivative."""
Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class ThermalModel:
    """The bias of one axis as a function of temperature and its past."""

    shape: Shape
    interval_s: float
    reference_c: float  # temperature at which the constant holds
    sizes: Floats  # [terms] constant, powers, lags: rad/s (m/s²) by powers of °C
    start: Floats  # [k] what each lag had left behind when the fit began
    phi: float  # of what is left, from one interval to the next
    sigma: float  # rad/s (m/s²): deviation of what no interval knows before
    covariance: Floats  # of sizes, start and logarithms of the time constants
    lowest_c: float
    highest_c: float

    @property
    def spread(self) -> float:
        """Deviation of what the model leaves of a mean."""
        return float(self.sigma / (1.0 - self.phi**2) ** 0.5)

    @property
    def slope(self) -> float:
        """Bias per °C, in the end, from the coldest to the warmest of the fit."""
        (lo, hi), powers = self.ends, np.arange(1, self.shape.powers + 1)
        chords = (hi**powers - lo**powers) / (hi - lo)
        return float(self.sizes[1 : 1 + self.shape.powers] @ chords + self.sizes[1 + self.shape.powers :].sum())

    @property
    def equation(self) -> dict[str, list[float] | float] | None:
        """a, b and c of its difference equation in T − reference; None of a polynomial that bends."""
        if self.shape.powers > 1:
            return None
        a, b, c = equation(self.shape, self.sizes, self.interval_s)
        return {"a": a.tolist(), "b": b.tolist(), "c": c}

    @property
    def ends(self) -> tuple[float, float]:
        """The coldest and the warmest of the fit less the reference, °C."""
        return self.lowest_c - self.reference_c, self.highest_c - self.reference_c


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a model expects of each interval."""

    bias: Floats  # [n] rad/s or m/s²
    lo: Floats  # [n] 95 % interval of the mean that is measured
    hi: Floats


def predicted(
    model: ThermalModel, temperature_c: Floats, measured: Floats | None = None, began: bool = False
) -> Prediction:
    """Multi-step from temperature [n] alone, or one-step beside the biases measured [n] until the interval before.

    Args:
        began: the first interval is the first of the fit, whose start is known; else temperature is taken to have been
            long what it is at first, and intervals are as wide as not knowing that asks for

    Beyond the temperatures of the fit nothing is known: the model goes on along its chord, and as much as that changes
    it by is added to the interval.
    """
    excess = whole(temperature_c) - model.reference_c
    columns = responses(model.shape, excess, model.interval_s, began=True, ends=model.ends)
    k = model.shape.memory
    if not began:
        columns[:, columns.shape[1] - k :] = 0.0
    sizes = np.concatenate([model.sizes, model.start if began else np.zeros(k)])
    bias, variance = expected(model, excess, columns, sizes, slopes(model, excess, sizes), measured)
    if not began and k:
        swing = (model.highest_c - model.lowest_c) / 12.0**0.5
        lags = model.sizes[1 + model.shape.powers :]
        p = np.exp(-model.interval_s / np.asarray(model.shape.constants_s))
        variance += ((lags * swing) ** 2 * p ** (2.0 * np.arange(excess.size)[:, None])).sum(axis=1)
    half = Z95 * np.sqrt(variance)
    return Prediction(bias, bias - half, bias + half)


def expected(
    model: ThermalModel, excess: Floats, columns: Floats, sizes: Floats, bends: Floats, measured: Floats | None
) -> tuple[Floats, Floats]:
    """Bias [n] and the variance [n] of a measured mean about it, of intervals that follow each other.

    Args:
        excess: [n] T − reference, °C
        columns: [n, terms + k] of ``responses``
        sizes: [terms + k] of the columns
        bends: [n, k] of ``slopes``
        measured: [n] what is measured, of which each but the last is known to the next; None: multi-step
    """
    bias = columns @ sizes
    rows = np.hstack([columns, bends])
    sigma = np.full(excess.size, model.spread)
    if measured is not None:
        known = np.isfinite(measured[:-1])
        last = np.where(known, measured[:-1] - bias[:-1], 0.0)
        rows[1:] -= model.phi * known[:, None] * rows[:-1]
        bias[1:] += model.phi * last
        sigma[1:][known] = model.sigma
    variance = np.einsum("ij,jk,ik->i", rows, model.covariance, rows) + sigma**2
    variance += (model.slope * outside(excess, model.ends)) ** 2
    return bias, variance


def whole(temperature_c: Floats) -> Floats:
    """Without holes: lags need to know what temperature was meanwhile."""
    there = np.flatnonzero(np.isfinite(temperature_c))
    return np.interp(np.arange(temperature_c.size), there, temperature_c[there])


def covariance(rows: Floats, sigma: float) -> Floats:
    """Of what is multiplied by the columns of white rows [n, m] of so large a deviation."""
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    scaled = rows / scale
    return np.asarray(sigma**2 * np.linalg.pinv(scaled.T @ scaled, rcond=1e-10) / np.outer(scale, scale))


def slopes(model: ThermalModel, excess: Floats, sizes: Floats) -> Floats:
    """Derivatives [n, k] of the bias by the logarithm of each time constant, at these sizes of columns."""
    return bent(model.shape, derivatives(model.shape, excess, model.interval_s), sizes)


def derivatives(shape: Shape, excess: Floats, interval_s: float) -> Floats:
    """Of each lag [n, k] and of what each left behind [n, k], by the logarithm of its own time constant: [n, 2 k]."""
    less, more = (
        responses(Shape(0, tuple(one * np.exp(by) for one in shape.constants_s)), excess, interval_s, began=True)
        for by in (-STEP, STEP)
    )
    return np.asarray((more - less)[:, 1:] / (2.0 * STEP))


def bent(shape: Shape, of_each: Floats, sizes: Floats) -> Floats:
    """What ``derivatives`` are together at these sizes [terms + k]: [n, k]."""
    k, first = shape.memory, 1 + shape.powers
    return np.asarray(of_each[:, :k] * sizes[first : first + k] + of_each[:, k:] * sizes[first + k :])
