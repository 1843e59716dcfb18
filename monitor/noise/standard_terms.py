"""The five noise terms of IEEE Std 952 and their Allan variances.

The sum of the five Allan variances is σ²(τ) = 3Q²/τ² + N²/τ + (2 ln 2/π) B² + K²τ/3 + R²τ²/2.
"""

from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import Source
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRamp, RateRandomWalk

STANDARD_TERMS: Final[dict[str, type[Source]]] = {
    "Q": QuantizationNoise,
    "N": AngleRandomWalk,
    "B": BiasInstability,
    "K": RateRandomWalk,
    "R": RateRamp,
}
"""Effect that belongs to each noise coefficient, whose symbol is also the parameter name of the effect."""
UNIT_SOURCES: Final = tuple(term(**{symbol: 1.0}) for symbol, term in STANDARD_TERMS.items())
"""The five noise terms with unit coefficients."""


def unit_coefficient_allan_variances(tau_s: Floats, tau0_s: float) -> Floats:
    """Return the Allan variances [m, 5] of the five noise terms with unit coefficients.

    Parameters
    ----------
    tau_s : ndarray, shape (m,)
        Averaging times, s.
    tau0_s : float
        Sample interval, s.

    Examples
    --------
    >>> unit_coefficient_allan_variances(np.array([2.0]), 1e-6).round(4).tolist()
    [[0.75, 0.5, 0.4413, 0.6667, 2.0]]
    """
    return np.stack([source.avar(tau_s, tau0_s) for source in UNIT_SOURCES], axis=1)
