"""Allan variance of a whole recording at once, by cumulative sums: the reference for the window.

Shares no arithmetic with ``window``: phase is a float64 of the mean-free rate, sums are NumPy's.
"""

from typing import Literal

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints

TauGrid = Literal["octave", "decade10"] | tuple[float, ...]


def overlapping(values: Floats, factors: Ints) -> tuple[Floats, Ints]:
    """Overlapping Allan variance [m, k] of rates [n, k], and the number of its terms [m, k].

    NIST SP 1065 eq. 11 on rates: σ²(m) = Σ (x_{k+2m} - 2x_{k+m} + x_k)² / (2 m² C), with phase x in samples of the
    rate, so that τ0 does not enter. What is not finite is missing: terms that touch it are left out.

    >>> overlapping(np.tile([1.0, 2.0], 50)[:, None], np.array([1, 2]))[0].ravel().tolist()
    [0.5, 0.0]
    """
    values = values.astype(np.float64)  # recordings come in float32, whose sums hold no Allan variance
    absent = ~np.isfinite(values)
    values[absent] = 0.0
    # phase of the mean-free rate stays small, and so keeps its digits
    values -= values.sum(axis=0) / np.maximum((~absent).sum(axis=0), 1)
    values[absent] = 0.0
    phase = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    gaps = np.concatenate([np.zeros((1, values.shape[1]), np.int64), np.cumsum(absent, axis=0)])
    avar = np.full((factors.size, values.shape[1]), np.nan)
    terms = np.zeros((factors.size, values.shape[1]), np.int64)
    for i, m in enumerate(factors):
        if 2 * m >= len(phase):
            break
        d = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
        whole = gaps[2 * m :] == gaps[: -2 * m]
        terms[i] = whole.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            avar[i] = np.where(whole, d * d, 0.0).sum(axis=0) / (2.0 * m * m * terms[i])
    return avar, terms


def slope(values: Floats) -> Floats:
    """Slope of the rate [k] over a recording [n, k], unit a sample, from its first and last third; NaN as there.

    >>> slope(0.5 * np.arange(9.0)[:, None]).tolist()
    [0.5]
    """
    third = len(values) // 3
    if third == 0:
        return np.full(values.shape[1], np.nan)
    newest = values[len(values) - 3 * third :]
    result: Floats = (newest[2 * third :].mean(axis=0) - newest[:third].mean(axis=0)) / (2.0 * third)
    return np.where(np.isnan(newest).any(axis=0), np.nan, result)


def cluster_sizes(samples: int, rate_hz: float, tau: TauGrid = "octave") -> Ints:
    """Cluster sizes m for a window of that many samples: τ = m/rate.

    ``octave``: 1, 2, 4, …; ``decade10``: ten a decade; else the nearest m of each τ in seconds. The longest named by
    a grid is a quarter of the window, where each estimate still rests on several independent terms; τ asked for by the
    user may reach half of it.

    Raises:
        ConfigError: no τ of the list lies between one sample and half the window
    """
    longest = samples // 4
    if tau == "octave":
        return 2 ** np.arange(max(longest, 1).bit_length(), dtype=np.int64)
    if tau == "decade10":
        exponents = np.arange(0, np.log10(max(longest, 1)) + 1e-9, 0.1)
        return np.unique(np.rint(10.0**exponents).astype(np.int64))
    wanted = np.rint(np.array(tau, float) * rate_hz).astype(np.int64)
    possible = np.unique(wanted[(wanted >= 1) & (2 * wanted <= samples)])
    if possible.size == 0:
        raise ConfigError(
            f"tau: none of {list(tau)} s lies between one sample ({1 / rate_hz:g} s) "
            f"and half the window ({samples / 2 / rate_hz:g} s)"
        )
    return possible
