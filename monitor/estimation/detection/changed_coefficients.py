"""Identification of the coefficients Q, N, B and K that changed, from the variances of octaves before and after.

The change of the Haar variances, δ_j = after − before, is linear in the changes of Q², N², B², K². The columns are the
sampled Allan variances of the terms (IEEE Std 952 annex C). The variance of δ_j is 2F(after²/n_after +
before²/n_before).

All 16 subsets of the coefficients are fitted by weighted least squares. Each coefficient must improve χ² by
``CHI2_PER_LETTER``, so that it is named if it is significant at 3σ beside the others. No coefficient may become
negative. None may rise while another falls, because two opposite changes at the same time are less likely than a filter
or a spectral line.

A subset with too large a misfit is rejected. In this case no coefficient explains the change, and the changed frequency
band is reported. A Haar difference of clusters τ responds most at f = 0.371/τ, and the band extends by half an octave
on both sides. Real sensors do not follow the standard terms exactly, so a misfit only counts beyond ``SHAPE_TOLERANCE``
of the variance.

Q also represents a vibration near the Nyquist frequency. A line at a third of the sample rate makes A²
sin⁴(πfτ)/(πfτ)², where sin⁴ is 9/16 at every octave, which is exactly the 1/τ² of Q. No statistic of octaves can
distinguish them, so the text for Q names both.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.noise.standard_terms import unit_allan_variances

CHANGE_SYMBOLS: Final = "QNBK"
"""Symbols of the coefficients that can change."""
CHI2_PER_LETTER: Final = 9.0
"""Minimum decrease of χ² for each coefficient."""
SHAPE_TOLERANCE: Final = 0.03
"""Share of the variance by which octaves may deviate from the shape of the terms."""
MAX_MISFIT_SIGMA: Final = 2.5
"""Largest misfit of a subset, in standard deviations of χ²."""
MIN_TERMS: Final = 8.0
"""Minimum number of terms of an octave before and after the change."""
PEAK_F_TAU: Final = 0.371
"""Value of f τ at which sin⁴(πfτ)/(πfτ)² is largest."""


@dataclass(frozen=True, slots=True)
class HaarVariancesBeforeAfter:
    """Haar variances of one axis before and after a change, arrays [J]; octave j has clusters of 2^j samples."""

    before: Floats  # variance, squared unit of the axis
    n_before: Floats  # number of terms, divided by their spread F
    after: Floats  # variance, squared unit of the axis
    n_after: Floats  # number of terms, divided by their spread F

    @property
    def usable_octaves(self) -> np.ndarray:
        """True for octaves with enough terms before and after the change."""
        return (self.n_after >= MIN_TERMS) & (self.n_before >= MIN_TERMS) & (self.before > 0.0)

    def evidence(self) -> float:
        """Return the log likelihood ratio of "each octave changed" over "none changed", minus its mean by chance."""
        ok = self.usable_octaves & (self.after > 0.0)
        n0, n1, v0, v1 = self.n_before[ok], self.n_after[ok], self.before[ok], self.after[ok]
        pooled = (n0 * v0 + n1 * v1) / (n0 + n1)
        gained = 0.5 * ((n0 + n1) * np.log(pooled) - n0 * np.log(v0) - n1 * np.log(v1))
        return float(max(gained.sum() - 0.5 * ok.sum(), 0.0))


def identify_noise_change(octaves: HaarVariancesBeforeAfter, rate_hz: float) -> dict[str, tuple[float, float]]:
    """Return the coefficients that changed, or the frequency band if no coefficient explains the change.

    Parameters
    ----------
    octaves : HaarVariancesBeforeAfter
        Variances before and after the change.
    rate_hz : float
        Sample rate in Hz.

    Returns
    -------
    dict of str to tuple of float
        Value before and after in SI for each letter. Without a letter, ``band`` holds the lowest and highest frequency
        in Hz, and ``rms`` the Haar deviation before and after at the octave that changed most. Empty if no octave has
        enough terms.
    """
    ok = octaves.usable_octaves
    if not ok.any():
        return {}
    tau0 = 1.0 / rate_hz
    tau = np.asarray(tau0 * 2.0 ** np.flatnonzero(ok), np.float64)
    columns = unit_allan_variances(tau, tau0)[:, : len(CHANGE_SYMBOLS)]
    v0, v1, n0, n1 = octaves.before[ok], octaves.after[ok], octaves.n_before[ok], octaves.n_after[ok]
    floor, _, _ = _select_letters(
        columns, v0, 2.0 * v0**2 / n0 + (SHAPE_TOLERANCE * v0) ** 2, np.zeros(len(CHANGE_SYMBOLS))
    )
    change, misfit, var = np.zeros(len(CHANGE_SYMBOLS)), np.inf, 2.0 * (v1**2 / n1 + v0**2 / n0)
    for _ in range(3):  # weights from the model, so that a variance that is small by chance gets no large weight
        change, chosen, misfit = _select_letters(columns, v1 - v0, var + (SHAPE_TOLERANCE * v1) ** 2, floor)
        model = np.maximum(v0 + columns @ change, 0.2 * v1)
        var = 2.0 * (model**2 / n1 + v0**2 / n0)
    free = v0.size - len(chosen)
    if chosen and misfit <= free + MAX_MISFIT_SIGMA * np.sqrt(2.0 * max(free, 1)):
        after = np.sqrt(np.maximum(floor + change, 0.0))
        return {CHANGE_SYMBOLS[i]: (float(np.sqrt(floor[i])), float(after[i])) for i in chosen}
    return _find_band(tau, v0, v1, np.sqrt(var), rate_hz)


def _select_letters(
    columns: Floats, values: Floats, var: Floats, floor: Floats
) -> tuple[Floats, tuple[int, ...], float]:
    """Return the coefficients, the indices and the χ² of the subset with the smallest penalized χ²."""
    weight = 1.0 / np.sqrt(var)
    best, which = np.zeros(len(CHANGE_SYMBOLS)), tuple[int, ...]()
    least = price = float(((values * weight) ** 2).sum())
    for size in range(1, min(len(CHANGE_SYMBOLS), values.size) + 1):
        for chosen in combinations(range(len(CHANGE_SYMBOLS)), size):
            a = columns[:, chosen] * weight[:, None]
            scale = np.linalg.norm(a, axis=0)
            scaled, *_ = np.linalg.lstsq(a / scale, values * weight, rcond=1e-9)
            x = scaled / scale
            if (x < -floor[list(chosen)]).any():
                # a coefficient that would become negative is set to zero, which is allowed if it fits
                x = np.maximum(x, -floor[list(chosen)])
            if (x > 0.0).any() and (x < 0.0).any():
                continue
            chi2 = float(((values * weight - a @ x) ** 2).sum())
            if chi2 + CHI2_PER_LETTER * size < price:
                price, least, which = chi2 + CHI2_PER_LETTER * size, chi2, chosen
                best = np.zeros(len(CHANGE_SYMBOLS))
                best[list(chosen)] = x
    return best, which, least


def _find_band(tau: Floats, v0: Floats, v1: Floats, sigma: Floats, rate_hz: float) -> dict[str, tuple[float, float]]:
    """Return the band of octaves around the most significant one.

    The band includes neighbours that are significant and change by at least half as much.
    """
    relative, strength = v1 / v0 - 1.0, np.abs(v1 - v0) / sigma
    top = int(strength.argmax())
    belongs = (strength > 3.0) & (relative * np.sign(relative[top]) > 0.5 * abs(relative[top]))
    low = high = top
    while low > 0 and belongs[low - 1]:
        low -= 1
    while high + 1 < tau.size and belongs[high + 1]:
        high += 1
    half = np.sqrt(2.0)
    edges = PEAK_F_TAU / tau[high] / half, min(PEAK_F_TAU / tau[low] * half, 0.5 * rate_hz)
    return {"band": (float(edges[0]), float(edges[1])), "rms": (float(np.sqrt(v0[top])), float(np.sqrt(v1[top])))}
