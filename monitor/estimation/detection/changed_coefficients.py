"""Identification of the coefficients Q, N, B and K that changed, from the variances of octaves before and after.

The change of the Haar variance of octave j, δ_j = after − before, is linear in the changes of Q², N², B² and K². The
factors are the sampled Allan variances of the terms (IEEE Std 952 annex C). If the variances are means of n_before and
n_after terms with spread F, the variance of δ_j is 2F(after²/n_after + before²/n_before).

All 16 subsets of the coefficients are fitted by weighted least squares. Each coefficient of a subset must decrease χ²
by ``CHI2_PER_LETTER``, which corresponds to a significance of 3σ. No coefficient may become negative. All coefficients
of a subset must change in the same direction, because two opposite changes at the same time are less likely than a
filter or a spectral line.

If the misfit of the best subset is too large, no coefficient explains the change, and the changed frequency band is
reported. A Haar difference of clusters of length τ is most sensitive at f = 0.371/τ. The band extends by half an octave
on both sides. Real sensors do not follow the standard terms exactly, so deviations up to ``SHAPE_TOLERANCE`` of the
variance are tolerated.

Q also represents a vibration near the Nyquist frequency. A line of amplitude A contributes A² sin⁴(πfτ)/(πfτ)². At a
third of the sample rate, sin⁴ is 9/16 at every octave, so the contribution is proportional to 1/τ², as for Q. Octaves
cannot distinguish quantization noise and such a vibration, so the text for a change of Q names both causes.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.standard_terms import unit_coefficient_allan_variances

CHANGE_SYMBOLS: Final = "QNBK"
"""Symbols of the coefficients that can change."""
CHI2_PER_LETTER: Final = 9.0
"""Minimum decrease of χ² for each coefficient."""
SHAPE_TOLERANCE: Final = 0.03
"""Tolerated deviation of an octave from the standard terms, as a share of the variance."""
MAX_MISFIT_SIGMA: Final = 2.5
"""Largest misfit of a subset, in standard deviations of χ²."""
MIN_TERMS: Final = 8.0
"""Minimum number of terms of an octave before and after the change."""
PEAK_F_TAU: Final = 0.371
"""Value of f τ at which sin⁴(πfτ)/(πfτ)² is largest."""


@dataclass(frozen=True, slots=True)
class HaarVariancesBeforeAfter:
    """Haar variances of one axis before and after a change. Element j of each array is for clusters of 2^j samples."""

    before: Floats  # variance, squared unit of the axis
    n_before: Floats  # number of terms, divided by their spread F
    after: Floats  # variance, squared unit of the axis
    n_after: Floats  # number of terms, divided by their spread F

    @property
    def octaves_with_enough_terms(self) -> np.ndarray:
        """Boolean array, True for octaves with enough terms before and after the change."""
        return (self.n_after >= MIN_TERMS) & (self.n_before >= MIN_TERMS) & (self.before > 0.0)

    def log_likelihood_ratio_of_change(self) -> float:
        """Return the logarithm of the likelihood ratio of "all octaves changed" and "no octave changed".

        The expectation without a change is subtracted.
        """
        ok = self.octaves_with_enough_terms & (self.after > 0.0)
        n0, n1, v0, v1 = self.n_before[ok], self.n_after[ok], self.before[ok], self.after[ok]
        pooled = (n0 * v0 + n1 * v1) / (n0 + n1)
        gained = 0.5 * ((n0 + n1) * np.log(pooled) - n0 * np.log(v0) - n1 * np.log(v1))
        return float(max(gained.sum() - 0.5 * ok.sum(), 0.0))


def identify_changed_coefficients(octaves: HaarVariancesBeforeAfter, rate_hz: float) -> dict[str, tuple[float, float]]:
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
        Value before and after in SI for each changed coefficient. If no coefficient explains the change, ``band``
        contains the lowest and the highest frequency in Hz. ``rms`` then contains the Haar deviation before and after
        at the octave that changed most. The dictionary is empty if no octave has enough terms.
    """
    ok = octaves.octaves_with_enough_terms
    if not ok.any():
        return {}
    tau0 = 1.0 / rate_hz
    tau = np.asarray(tau0 * 2.0 ** np.flatnonzero(ok), np.float64)
    columns = unit_coefficient_allan_variances(tau, tau0)[:, : len(CHANGE_SYMBOLS)]
    v0, v1, n0, n1 = octaves.before[ok], octaves.after[ok], octaves.n_before[ok], octaves.n_after[ok]
    floor, _, _ = _select_letters(
        columns, v0, 2.0 * v0**2 / n0 + (SHAPE_TOLERANCE * v0) ** 2, np.zeros(len(CHANGE_SYMBOLS))
    )
    change, misfit, var = np.zeros(len(CHANGE_SYMBOLS)), np.inf, 2.0 * (v1**2 / n1 + v0**2 / n0)
    for _ in range(3):  # weights from the model, because a variance that is small by chance must not get a large weight
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
    """Return the changes, the indices and the χ² of the subset of coefficients with the smallest penalized χ²."""
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
                # A coefficient that would become negative is set to zero, and χ² is computed with this value.
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

    The band includes neighbouring octaves that changed significantly and by at least half the relative amount.
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
