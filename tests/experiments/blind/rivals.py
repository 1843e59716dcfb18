"""Wrong names: how much each could gain at best on an axis in which something else is hidden.

The baseline's terms are retuned beside every name, by maximum likelihood in the logarithms of their sizes. Names
are: Q, N, B, K where the baseline has none, correlated noise of up to T/30, and as regressors beside retuned terms
ramp, transient, step, temperature and lag, with their times on grids.
"""

from functools import lru_cache
from typing import Final

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from tests.experiments.blind.processes import Floats
from tests.experiments.blind.spectra import SHAPES, coefficients, density, frequencies
from tests.experiments.blind.world import Effect

SINGLE: Final = 2048  # coefficients looked at one by one; above, 150 bins
LONGEST: Final = 30.0  # correlated noise of more than T/30 differs from a random walk in a handful of coefficients
DRIFTS: Final = ("quantization_noise", "angle_random_walk", "bias_instability", "rate_random_walk")


class Rivals:
    """Wrong names, fitted to an axis: its low coefficients one by one, the others in bins.

    Args:
        y: [n − 1] coefficients
        v: [n − 1] their variances under the baseline
        baseline: the Gaussian terms and transforms of the axis
        rate: Hz
        temperature: [n] °C, if there is one
    """

    def __init__(self, y: Floats, v: Floats, baseline: list[Effect], rate: float, temperature: Floats | None) -> None:
        n = y.size + 1
        self.n, self.baseline, self.temperature = n, baseline, temperature
        single = min(SINGLE, (n - 1) // 4)
        edges = np.unique(np.geomspace(single, n - 1, 150).astype(np.int64))
        starts = np.concatenate([np.arange(single), edges[:-1]])
        self.count = np.diff(np.append(starts, n - 1)).astype(np.float64)
        self.power = np.add.reduceat(y**2, starts) / self.count
        self.f = np.add.reduceat(frequencies(n, rate), starts) / self.count
        self.single = single
        self.rate = rate
        self.seconds = n / rate
        self.transfer = np.add.reduceat(v, starts) / self.count
        self.y = y[:single]
        self.base = self._value(self.power, self.transfer)

    def all(self, without: str) -> dict[str, float]:
        """Name -> gain over the baseline."""
        found = {"retuned": self._fit(self._terms())}
        for name, shape in self._shapes():
            if name != without:
                found[name] = max(found.get(name, -np.inf), self._fit([*self._terms(), shape]))
        variance = self._fitted(self._terms())
        for name, columns in self._regressors().items():
            if name != without:
                found[name] = self._with_regressor(columns, variance)
        return found

    def retuned_one(self) -> float:
        """The best single term of another size."""
        terms = self._terms()
        best = 0.0
        for k, term in enumerate(terms):
            rest = sum((other for j, other in enumerate(terms) if j != k), np.zeros_like(term))
            best = max(best, self._fit([term], rest))
        return best

    def _value(self, power: Floats, variance: Floats) -> float:
        return float(-0.5 * np.sum(self.count * (np.log(variance) + power / variance)))

    def _terms(self) -> list[Floats]:
        terms = [density([one], self.f, self.rate) * self.rate for one in self.baseline]
        return [term for term in terms if term.any()]

    def _shapes(self) -> list[tuple[str, Floats]]:
        level = float(np.mean(self.transfer[-50:]))
        present = {one.name for one in self.baseline}
        shapes = []
        for name, parameter in zip(DRIFTS, "QNBK", strict=True):
            if name not in present:
                unit = SHAPES[name](self.f, 1.0 / self.rate, **{parameter: 1.0}) * self.rate
                shapes.append((name, 0.01 * level * unit / unit.mean()))
        for time_s in np.geomspace(1.0, self.seconds / LONGEST, 6):
            unit = SHAPES["exponentially_correlated"](self.f, 1.0 / self.rate, 1e-2 * np.sqrt(level), float(time_s))
            shapes.append(("exponentially_correlated", unit * self.rate))
        return shapes

    def _fitted(self, terms: list[Floats], fixed: Floats | float = 0.0, power: Floats | None = None) -> Floats:
        """Variances with the sizes of ``terms`` fitted."""
        measured = self.power if power is None else power
        stack = np.stack(terms)

        def cost(log_sizes: Floats) -> tuple[float, Floats]:
            parts = np.exp(log_sizes)[:, None] * stack
            variance = parts.sum(axis=0) + fixed
            slope = 0.5 * self.count * (1.0 - measured / variance) / variance
            return self.base - self._value(measured, variance), parts @ slope

        found = minimize(cost, np.zeros(len(terms)), jac=True, method="L-BFGS-B", bounds=[(-14.0, 14.0)] * len(terms))
        return np.asarray(np.exp(found.x) @ stack + fixed)

    def _fit(self, terms: list[Floats], fixed: Floats | float = 0.0) -> float:
        return self._value(self.power, self._fitted(terms, fixed)) - self.base

    def _regressors(self) -> dict[str, Floats]:
        """Name -> [k, single] candidates."""
        columns = dict(_clockwork(self.n, self.rate, self.single))
        temperature = self.temperature
        if temperature is not None:
            columns["temperature_bias"] = coefficients(temperature)[None, : self.single]
            late = []
            for time_s in np.geomspace(self.seconds / 120.0, self.seconds / 4.0, 7):
                stay = np.exp(-1.0 / (time_s * self.rate))
                late.append(coefficients(lfilter([0.0, 1.0 - stay], [1.0, -stay], temperature - temperature[0])))
            columns["temperature_lag"] = np.stack(late)[:, : self.single]
        return columns

    def _with_regressor(self, columns: Floats, variance: Floats) -> float:
        """The best of the columns, beside terms that are refitted to what it leaves."""
        for _ in range(3):
            weight = 1.0 / variance[: self.single]
            along, square = columns @ (weight * self.y), columns**2 @ weight
            best = int(np.argmax(along**2 / square))
            rest = self.y - along[best] / square[best] * columns[best]
            power = np.concatenate([rest**2, self.power[self.single :]])
            variance = self._fitted(self._terms(), power=power)
        return self._value(power, variance) - self.base


@lru_cache(maxsize=4)
def _clockwork(n: int, rate_hz: float, single: int) -> tuple[tuple[str, Floats], ...]:
    """Regressors of the clock alone."""
    t = np.arange(n) / n
    steps = [coefficients((t >= at).astype(np.float64))[:single] for at in np.linspace(0.02, 0.98, 97)]
    decays = [coefficients(np.exp(-t / time))[:single] for time in np.geomspace(0.01, 0.3, 8)]
    return (
        ("rate_ramp", coefficients(t)[None, :single]),
        ("turn_on_transient", np.stack(decays)),
        ("bias_step", np.stack(steps)),
    )
