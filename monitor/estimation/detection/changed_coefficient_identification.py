"""Identification of the noise coefficients Q, N, B and K that have changed.

The Haar variances before and after a change are compared at cluster sizes of 2^j samples (octave j). The difference δ_j
= after − before is a linear function of the changes of Q², N², B² and K². The factors are the sampled Allan variances
of the noise terms (IEEE Std 952 annex C). The variance of δ_j is 2F(after²/n_after + before²/n_before). Here n_before
and n_after are the numbers of averaged squares, and F is the factor defined in ``change_kernel``.

All 16 subsets of the four coefficients are fitted by weighted least squares. Each coefficient in the selected subset
must reduce χ² by ``CHI2_PER_LETTER``. All coefficients in a subset must change in the same direction, because two
opposite changes are less likely than a filter or a spectral line. Coefficients cannot become negative.

If no subset explains the change, the affected frequency band is reported. A Haar difference of clusters of length τ is
most sensitive at the frequency 0.371/τ. The reported band is extended by half an octave on both sides.

A change of Q can also be caused by a vibration near the Nyquist frequency. The Allan variance of a vibration at one
third of the sample rate is proportional to 1/τ² in all octaves, as for quantization noise.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.standard_terms import unit_coefficient_allan_variances

CHANGE_SYMBOLS: Final = "QNBK"
"""Symbols of the noise coefficients that are tested for a change."""
CHI2_PER_LETTER: Final = 9.0
"""Minimum decrease of χ² for each selected coefficient, which corresponds to 3σ."""
SHAPE_TOLERANCE: Final = 0.03
"""Assumed deviation of real noise from the standard noise terms, as a fraction of the variance."""
MAX_MISFIT_SIGMA: Final = 2.5
"""Maximum misfit of the selected subset of coefficients, in standard deviations of χ²."""
MIN_TERMS: Final = 8.0
"""Minimum number of squared Haar differences in an octave, both before and after the change."""
PEAK_F_TAU: Final = 0.371
"""Value of f τ at which the spectral response sin⁴(πfτ)/(πfτ)² of the Allan variance is largest."""


@dataclass(frozen=True, slots=True)
class HaarVariancesBeforeAfter:
    """Haar variances of one axis before and after a change, where element j belongs to clusters of 2^j samples."""

    before: Floats  # Haar variances in squared units of the axis
    n_before: Floats  # numbers of squared differences, divided by the factor F of ``change_kernel``
    after: Floats  # Haar variances in squared units of the axis
    n_after: Floats  # numbers of squared differences, divided by the factor F of ``change_kernel``

    @property
    def octaves_with_enough_terms(self) -> np.ndarray:
        """Boolean array that is True for octaves with enough data before and after the change."""
        return (self.n_after >= MIN_TERMS) & (self.n_before >= MIN_TERMS) & (self.before > 0.0)

    def log_likelihood_ratio_of_change(self) -> float:
        """Return the log-likelihood ratio of the hypotheses "all octaves changed" and "no octave changed".

        The value that is expected for unchanged noise is subtracted.
        """
        ok = self.octaves_with_enough_terms & (self.after > 0.0)
        n0, n1, v0, v1 = self.n_before[ok], self.n_after[ok], self.before[ok], self.after[ok]
        pooled = (n0 * v0 + n1 * v1) / (n0 + n1)
        gained = 0.5 * ((n0 + n1) * np.log(pooled) - n0 * np.log(v0) - n1 * np.log(v1))
        return float(max(gained.sum() - 0.5 * ok.sum(), 0.0))


def identify_changed_coefficients(octaves: HaarVariancesBeforeAfter, rate_hz: float) -> dict[str, tuple[float, float]]:
    """Return the noise coefficients that have changed, or the affected frequency band.

    Parameters
    ----------
    octaves : HaarVariancesBeforeAfter
        Haar variances before and after the change.
    rate_hz : float
        Sample rate in Hz.

    Returns
    -------
    dict of str to tuple of float
        Values before and after the change in SI units for each changed coefficient. If no coefficient explains the
        change, the key ``band`` contains the limits of the frequency band in Hz. In this case, the key ``rms`` contains
        the Haar deviations before and after the change. The dictionary is empty if no octave has enough data.
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
    for _ in range(3):  # A variance that is small by chance must not keep a large weight.
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
    """Return the changes of the coefficients in the best subset, their indices and the χ² of the fit."""
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
                # A coefficient that would become negative is set to zero.
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
    """Return the frequency band around the most significant octave.

    Neighbouring octaves belong to the band if their change is significant and at least half as large.
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
