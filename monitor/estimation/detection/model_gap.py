"""Does the live window still agree with the sensor's model: measured Allan curve against the model's, axis by axis.

Comes in: the curve of a look at the window, and the model in force. Goes out, for each axis that the model knows: how
many standard deviations apart the two are at each τ, the largest of them (the gap), where it is, and the limits that
chance stays under. ``Agreement`` turns looks into events: it holds a verdict until new samples have confirmed another.

If the model is true, ν σ²(τ)/σ²_model(τ) is χ² with ν degrees of freedom, nearly; the cube root of a χ² is nearly
normal (Wilson & Hilferty, PNAS 17, 1931), which gives

    z(τ) = ((σ²/σ²_model)^(1/3) − 1 + 2/(9ν)) / √(2/(9ν)).

ν = 2 σ⁴_model/Var comes from the model, not from the fit: the exact covariance of ``uncertainty`` for its Q N B K, and
for all else that it has (resonance, low-pass, correlated noise) the integral 4/M ∫ (S G)² df of M terms through the
kernel G of the variance, right where the window is long against the memory of the noise. τ with fewer than FEWEST_EDF
degrees of freedom are not judged: there a sum of squares is further from χ² than the limits can bear.

Whatever the correlation of normal z_i, P(all |z_i| < c) ≥ ∏ P(|z_i| < c) (Šidák, J. Am. Stat. Assoc. 62, 1967). So the
limits pay for every τ by its number, and for the axes: of 100 independent windows of a true model one at most passes
``threshold`` on any of them. Overlapping τ are correlated, and the true share is lower: of 2500 simulated windows of
six axes and 14 octaves 0.5 % passed with Q N B K, 0.9 % with random walk alone. Telegraph noise and jumps are no
Gaussian noise, and with them it is higher.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats, Ints
from monitor.common.distributions import normal_quantile
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.uncertainty import NOISES, PAIRS, AxisTables, K, Table
from monitor.estimation.estimate import Estimate
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.bias_instability import BiasInstability
from monitor.noise.effects.quantization_noise import QuantizationNoise
from monitor.noise.effects.rate_random_walk import RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.noise.spectrum import BELOW, Spectrum, frequencies

FEWEST_EDF: Final = 2.0
FEWEST: Final = 1000
"""Samples of an axis before it is judged: N to 3 %."""
FALSE_ALARM: Final = 0.01
"""Of independent windows of a true model: how many pass the threshold on some axis."""
FALSE_ALARM_WATCHED: Final = 0.001
"""The same of ``alarm``."""


@dataclass(frozen=True, slots=True)
class AxisGap:
    """One axis of the window beside its model."""

    axis: str
    measured: Floats  # [m] Allan deviation, unit of the axis; NaN where the window is too short
    model: Floats  # [m] of the model; NaN where it is not known
    z: Floats  # [m] standard deviations above the model; NaN where not judged
    gap: float  # the largest |z|
    tau_s: tuple[float, float]  # where: the τ round the largest that are on the same side and past the threshold
    at: int  # row of the largest
    null95: float  # 95 of 100 windows of a true model stay below, this axis alone
    threshold: float  # 99 of 100 stay below on all axes
    alarm: float  # 999 of 1000 do: for whoever looks again and again
    samples: int  # of this axis in the window

    @property
    def passes(self) -> bool:
        """Whether this is more than chance."""
        return self.gap > self.threshold

    @property
    def ratio(self) -> float:
        """Measured over model, of deviations, where the gap is largest."""
        return float(self.measured[self.at] / self.model[self.at])


@dataclass(frozen=True, slots=True)
class ModelGap:
    """One look at all axes."""

    t_ns: int  # newest sample
    rate_hz: float
    window_s: float
    samples: int  # received since start
    n: int  # samples in the window
    tau_s: Floats  # [m]
    axes: Mapping[str, AxisGap]  # those that can be judged, in AXES order
    agrees: Mapping[str, bool] = field(default_factory=dict)  # the verdicts that stand, see ``agreement``


class ModelInForce:
    """A model, ready to be laid beside the curves of one window.

    Args:
        model: of the sensor
        length: samples in the full window
    """

    def __init__(self, model: NoiseModel, length: int) -> None:
        self._model = model
        self._length = length
        self._expected: dict[str, _Expected] = {}
        self._tables = AxisTables(np.empty(0, np.int64), length)
        self._of: tuple[float, tuple[int, ...]] = (0.0, ())  # rate and cluster sizes that these are for

    def look(self, estimate: Estimate) -> ModelGap:
        """Each axis that is measured, known to the model and long enough beside the model."""
        curve = estimate.curve
        tables = self._prepare(curve.factors, estimate.rate_hz)
        found: dict[str, AxisGap] = {}
        for axis, expected in self._expected.items():
            i = AXES.index(axis)
            terms = curve.terms[:, i]
            n = samples_of(curve, i)
            if n < FEWEST:
                continue
            edf = expected.edf(tables.of(i, n, curve.n).at(n), terms)
            one = _axis_gap(axis, curve.tau_s, curve.avar[:, i], expected.avar, edf, n, len(self._expected))
            if one is not None:
                found[axis] = one
        return ModelGap(
            estimate.t_ns, estimate.rate_hz, estimate.window_s, estimate.samples, curve.n, curve.tau_s, found
        )

    def _prepare(self, factors: Ints, rate_hz: float) -> AxisTables:
        """What the model says at these τ, once for each rate and list."""
        of = (rate_hz, tuple(factors.tolist()))
        if self._of[1] != of[1]:
            self._tables = AxisTables(factors, self._length)
        if self._of != of:
            named = (axis for axis in AXES if self._model.effects.get(axis))
            known = {axis: _Expected.of(self._model, axis, factors, rate_hz) for axis in named}
            self._expected = {axis: one for axis, one in known.items() if (one.avar > 0.0).any()}
            self._of = of
        return self._tables


def samples_of(curve: AllanCurve, axis: int) -> int:
    """How many samples of an axis the window holds: fewer than ``curve.n`` where it began anew."""
    terms = curve.terms[:, axis]
    return int((terms + 2 * curve.factors - 1)[terms > 0].max(initial=0))


@dataclass(frozen=True, slots=True)
class _Expected:
    """What the model says of one axis at m averaging times."""

    avar: Floats  # [m] unit²
    shape: Floats  # [4] Q² N² B² K² at τ0 = 1
    more: Floats  # [m] variance of the Allan variance of one term, beyond that of the shape; unit⁴

    @classmethod
    def of(cls, model: NoiseModel, axis: str, factors: Ints, rate_hz: float) -> "_Expected":
        spectrum = model.spectrum(axis, 1.0 / rate_hz)
        tau_s = factors / rate_hz
        shape, classic = _classic(model, axis, rate_hz)
        more = _beyond(spectrum, classic, factors, rate_hz)
        # a ramp adds no variance of its own, but it multiplies that of the noise on it: no more than random walk of
        # the same size would
        shape[K] += 1.5 * spectrum.slope**2 * float(tau_s.max()) / rate_hz
        return cls(spectrum.allan(tau_s), shape, more)

    def edf(self, table: Table, terms: Ints) -> Floats:
        """Degrees of freedom [m] of so many terms; NaN where there are none."""
        pairs = np.array([self.shape[a] * self.shape[b] * (1.0 if a == b else 2.0) for a, b in PAIRS])
        exact = np.einsum("iik,k->i", table.covariance, pairs)
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = exact * table.terms / terms + self.more / terms
            return np.where((terms > 0) & (variance > 0.0), 2.0 * self.avar**2 / variance, np.nan)


def _classic(model: NoiseModel, axis: str, rate_hz: float) -> tuple[Floats, NoiseModel]:
    """Q² N² B² K² of an axis at τ0 = 1, and the model of these alone."""
    kinds = (QuantizationNoise, AngleRandomWalk, BiasInstability, RateRandomWalk)
    letters = ("Q", "N", "B", "K")
    powers = (2.0, 1.0, 0.0, -1.0)
    effects = tuple(effect for effect in model.effects[axis] if isinstance(effect, kinds))
    shape = np.zeros(NOISES)
    for effect in effects:
        row = kinds.index(type(effect))
        shape[row] += getattr(effect, letters[row]) ** 2 * rate_hz ** powers[row]
    return shape, NoiseModel({axis: effects})


def _beyond(spectrum: Spectrum, classic: NoiseModel, factors: Ints, rate_hz: float) -> Floats:
    """4 ∫ (S² − S_classic²) G² df, with the lines' 4 Σ P S G², at τ0 = 1; times 1/M it is a variance.

    d is a second difference, of spectrum S G with G = 2 sin⁴(πνm)/(m sin πν)², and over M terms Var(mean d²) is
    2/M Σ_c r(c)², by Parseval 2/M ∫ (S G)² dν. A line of mean square P adds 4/M P S G² at its frequency.
    """
    (axis,) = classic.effects
    f_hz = frequencies(BELOW * rate_hz / float(factors.max()), 1.0 / rate_hz, spectrum.peaks)
    own, known = (s.density(f_hz) * rate_hz for s in (spectrum, classic.spectrum(axis, 1.0 / rate_hz)))
    difference = own**2 - known**2
    if not difference.any() and not spectrum.lines:
        return np.zeros(factors.size)
    nu = f_hz / rate_hz
    more = [4.0 * np.trapezoid(difference * _kernel(nu, m) ** 2, nu) for m in factors.tolist()]
    for line_hz, mean_square in spectrum.lines:
        at = np.array([line_hz])
        here = float(spectrum.density(at)[0]) * rate_hz
        more = [
            one + 4.0 * mean_square * here * float(_kernel(at / rate_hz, m)[0]) ** 2
            for one, m in zip(more, factors.tolist(), strict=True)
        ]
    return np.array(more)


def _kernel(nu: Floats, m: int) -> Floats:
    return np.asarray(2.0 * np.sin(np.pi * nu * m) ** 4 / (m * np.sin(np.pi * nu)) ** 2)


def _axis_gap(
    axis: str, tau_s: Floats, avar: Floats, expected: Floats, edf: Floats, samples: int, axes: int
) -> AxisGap | None:
    """One axis, of so many that the model knows; None where no τ can be judged."""
    expected = np.where(expected > 0.0, expected, np.nan)
    z = normal_score(avar / expected, edf)
    judged = np.isfinite(z)
    if not judged.any():
        return None
    count = int(judged.sum())
    threshold, alarm = (limit(share, axes * count) for share in (FALSE_ALARM, FALSE_ALARM_WATCHED))
    size = np.where(judged, np.abs(z), -1.0)
    at = int(size.argmax())
    alike = (size > threshold) & (np.sign(z) == np.sign(z[at]))
    first = last = at
    while first > 0 and alike[first - 1]:
        first -= 1
    while last + 1 < alike.size and alike[last + 1]:
        last += 1
    where = float(tau_s[first]), float(tau_s[last])
    null95 = limit(0.05, count)
    return AxisGap(
        axis, np.sqrt(avar), np.sqrt(expected), z, float(size[at]), where, at, null95, threshold, alarm, samples
    )


def normal_score(ratio: Floats, edf: Floats) -> Floats:
    """How many standard deviations χ²/ν is above one, by its cube root; NaN below FEWEST_EDF.

    The 97.5 % point of χ² with 100 degrees of freedom is 129.561:

    >>> round(float(normal_score(np.array([1.29561]), np.array([100.0]))[0]), 2)
    1.96
    """
    spread = 2.0 / (9.0 * np.where(edf >= FEWEST_EDF, edf, np.nan))
    return np.asarray((np.cbrt(ratio) - 1.0 + spread) / np.sqrt(spread))


def limit(share: float, numbers: int) -> float:
    """What the largest of so many |z| stays below, but for this share; for independent ones exactly, else at most.

    >>> f"{limit(0.05, 1):.3f} {limit(0.01, 6 * 14):.3f}"
    '1.960 3.847'
    """
    return -normal_quantile(float(-0.5 * np.expm1(np.log1p(-share) / numbers)))
