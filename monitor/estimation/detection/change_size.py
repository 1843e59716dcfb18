"""From variances of octaves before and after a change to the letters that changed, and by how much.

The change of the Haar variances, δ_j = after − before, is linear in the changes of Q², N², B², K² (the columns are
their Allan variances as sampled, IEEE Std 952 annex C), with variance 2F(after²/n_after + before²/n_before). All 16
sets of letters are fitted by weighted least squares; each letter must pay PAY, so that one is named when it stands out
by 3σ beside the others; none may fall below nothing, and none rises while another falls: at one moment that is
rather a filter or a line than two changes. A set that leaves misfit is refused: then no letter explains
the change, and it is a band of frequencies that changed: where a Haar difference of clusters τ responds most,
f = 0.371/τ, half an octave to both sides. The standard's letters are no law of a sensor, so a misfit counts only
beyond SHAPE of the variance.

Q stands for a vibration near Nyquist too: a line at a third of the sample rate makes A² sin⁴(πfτ)/(πfτ)², where sin⁴ is
9/16 at every octave, so exactly Q's 1/τ². No statistic of octaves tells them apart, and the words for Q name both.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.estimation.fit.coefficient_fit import UNIT_SOURCES

LETTERS: Final = "QNBK"
PAY: Final = 9.0
"""χ² that each letter must gain."""
SHAPE: Final = 0.03
"""Share of the variance by which octaves may miss the letters' shape and be explained still."""
MISFIT: Final = 2.5
"""σ of χ² by which a set of letters may miss."""
FEWEST_AFTER: Final = 8.0
"""Terms of an octave after the change, for it to be asked."""
PEAK: Final = 0.371
"""f τ at which sin⁴(πfτ)/(πfτ)² is largest."""


@dataclass(frozen=True, slots=True)
class Octaves:
    """Haar variances of one axis before and after; all arrays [J], octave j has clusters of 2^j samples."""

    before: Floats  # unit²
    n_before: Floats  # terms, divided by their spread F
    after: Floats  # unit²
    n_after: Floats

    @property
    def usable(self) -> np.ndarray:
        """Octaves with enough of both."""
        return (self.n_after >= FEWEST_AFTER) & (self.n_before >= FEWEST_AFTER) & (self.before > 0.0)

    def evidence(self) -> float:
        """Log likelihood of "each octave's variance changed" over "none did", less what chance gives."""
        ok = self.usable & (self.after > 0.0)
        n0, n1, v0, v1 = self.n_before[ok], self.n_after[ok], self.before[ok], self.after[ok]
        pooled = (n0 * v0 + n1 * v1) / (n0 + n1)
        gained = 0.5 * ((n0 + n1) * np.log(pooled) - n0 * np.log(v0) - n1 * np.log(v1))
        return float(max(gained.sum() - 0.5 * ok.sum(), 0.0))


def named(octaves: Octaves, rate_hz: float) -> dict[str, tuple[float, float]]:
    """Letters that changed, each with its value before and after, SI; or the band and its rms.

    Without a letter: ``band``, its lowest and highest frequency in Hz, and ``rms``, the Haar deviation before and
    after at the octave that changed most. Empty where no octave has data enough.
    """
    ok = octaves.usable
    if not ok.any():
        return {}
    tau0 = 1.0 / rate_hz
    tau = np.asarray(tau0 * 2.0 ** np.flatnonzero(ok), np.float64)
    columns = np.stack([source.avar(tau, tau0) for source in UNIT_SOURCES[: len(LETTERS)]], axis=1)
    v0, v1, n0, n1 = octaves.before[ok], octaves.after[ok], octaves.n_before[ok], octaves.n_after[ok]
    floor, _, _ = _best(columns, v0, 2.0 * v0**2 / n0 + (SHAPE * v0) ** 2, np.zeros(len(LETTERS)))
    change, misfit, var = np.zeros(len(LETTERS)), np.inf, 2.0 * (v1**2 / n1 + v0**2 / n0)
    for _ in range(3):  # a small variance by chance must not have the large weight: take the model's
        change, chosen, misfit = _best(columns, v1 - v0, var + (SHAPE * v1) ** 2, floor)
        model = np.maximum(v0 + columns @ change, 0.2 * v1)
        var = 2.0 * (model**2 / n1 + v0**2 / n0)
    free = v0.size - len(chosen)
    if chosen and misfit <= free + MISFIT * np.sqrt(2.0 * max(free, 1)):
        after = np.sqrt(np.maximum(floor + change, 0.0))
        return {LETTERS[i]: (float(np.sqrt(floor[i])), float(after[i])) for i in chosen}
    return _band(tau, v0, v1, np.sqrt(var), rate_hz)


def _best(columns: Floats, values: Floats, var: Floats, floor: Floats) -> tuple[Floats, tuple[int, ...], float]:
    """The set of letters of least χ² with PAY for each: their coefficients, which, and χ²."""
    weight = 1.0 / np.sqrt(var)
    best, which = np.zeros(len(LETTERS)), tuple[int, ...]()
    least = price = float(((values * weight) ** 2).sum())
    for size in range(1, min(len(LETTERS), values.size) + 1):
        for chosen in combinations(range(len(LETTERS)), size):
            a = columns[:, chosen] * weight[:, None]
            scale = np.linalg.norm(a, axis=0)
            scaled, *_ = np.linalg.lstsq(a / scale, values * weight, rcond=1e-9)
            x = scaled / scale
            if (x < -floor[list(chosen)]).any():
                # a letter that would fall below nothing is at nothing: allowed if that fits
                x = np.maximum(x, -floor[list(chosen)])
            if (x > 0.0).any() and (x < 0.0).any():
                continue
            chi2 = float(((values * weight - a @ x) ** 2).sum())
            if chi2 + PAY * size < price:
                price, least, which = chi2 + PAY * size, chi2, chosen
                best = np.zeros(len(LETTERS))
                best[list(chosen)] = x
    return best, which, least


def _band(tau: Floats, v0: Floats, v1: Floats, sigma: Floats, rate_hz: float) -> dict[str, tuple[float, float]]:
    """Octaves around the one that stands out most, as far as they stand out and change half as much as it does."""
    relative, strength = v1 / v0 - 1.0, np.abs(v1 - v0) / sigma
    top = int(strength.argmax())
    belongs = (strength > 3.0) & (relative * np.sign(relative[top]) > 0.5 * abs(relative[top]))
    low = high = top
    while low > 0 and belongs[low - 1]:
        low -= 1
    while high + 1 < tau.size and belongs[high + 1]:
        high += 1
    half = np.sqrt(2.0)
    edges = PEAK / tau[high] / half, min(PEAK / tau[low] * half, 0.5 * rate_hz)
    return {"band": (float(edges[0]), float(edges[1])), "rms": (float(np.sqrt(v0[top])), float(np.sqrt(v1[top])))}
