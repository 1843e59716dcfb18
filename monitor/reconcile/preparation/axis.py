"""Fit of effects to one axis of a recording, by maximum likelihood.

An ``Axis`` holds the repaired samples of one axis, the transforms of the axes that may leak into it, and the
temperature. ``Axis.fit`` takes the effects of the axis and the indices of the noise terms whose size is fixed, and
returns the maximum of the likelihood. Regressors and their products are cached, because every trial asks for the same
ramp, line or delayed temperature again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, TypeGuard

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect, Leak, Transform
from monitor.noise.effects import (
    TRANSFORM_ORDER,
    AngleRandomWalk,
    BandwidthLimit,
    Bias,
    NoiseStep,
    Resolution,
    SampleHold,
    Saturation,
)
from monitor.noise.spectrum import Spectrum, white_noise_spectrum
from monitor.reconcile.likelihood.effect_terms import (
    DETERMINISTIC_SIZE_PARAMETERS,
    NOISE_SIZE_PARAMETERS,
    regressors,
    size,
    unit_spectrum,
    with_factors,
    with_size,
)
from monitor.reconcile.likelihood.whittle import BinSums, WhittleFit, maximise_whittle
from monitor.reconcile.preparation.cosine_bins import Bins, cosine_transform
from monitor.reconcile.preparation.value_statistics import Clipping, QuantizationGrid, RepeatedSamples

MIN_BIN_POWER_RATIO: Final = 1e-4
"""Smallest power of a bin relative to the median bin. In the stop band of a filter, weaker bins contain only the effect
of the ends of the recording.
"""
MIN_STOP_BAND_FRACTION: Final = 0.02
"""Lowest frequency of a stop band, as a fraction of the sample rate. Below it, a bin of one coefficient may be weak by
chance.
"""
MAX_CACHE_BYTES: Final = 1 << 28
"""Largest memory of the cached regressors, in bytes."""
MIN_CACHED_SERIES: Final = 16
"""Number of cached series that is kept for recordings of any length: as many as the diagnostics use."""
MAX_CACHED_PRODUCTS: Final = 4096
"""Largest number of cached sums over bins for each axis."""
Effects = tuple[Effect, ...]
"""Effects of one axis in a fixed order."""
CURVATURE_REGRESSOR: Final = Bias(value=1.0)
"""Marker for the regressor t². As an effect, a constant bias would have no influence."""


@dataclass(frozen=True, slots=True)
class Likely:
    """Effects of an axis at the maximum of the likelihood."""

    effects: Effects  # with fitted sizes
    held: frozenset[int]  # indices of effects whose size was not fitted
    log_likelihood: float
    fitted: WhittleFit
    noises: tuple[int, ...]  # index in ``effects`` of each fitted θ
    courses: tuple[tuple[int, slice], ...]  # index in ``effects`` and slice of β of each deterministic effect
    behind: float = 0.0  # variance of a coefficient due to the white noise floor after a low-pass filter

    def error(self, at: int) -> float:
        """Return the standard error of the size of the effect with index ``at``, or NaN if the size was fixed."""
        if at in self.noises:
            noise = self.noises.index(at)
            covariance = np.linalg.pinv(self.fitted.theta_information)
            theta = float(self.fitted.theta[noise])
            return 0.5 * float(np.sqrt(covariance[noise, noise] / theta)) if theta > 0.0 else float("nan")
        for index, place in self.courses:
            if index == at:  # the two columns of one effect, a sine and its cosine, have equal errors
                return float(np.sqrt(np.diag(self.fitted.beta_covariance)[place].mean()))
        return float("nan")


@dataclass(frozen=True, slots=True)
class ValueStatistics:
    """Statistics of the measured values of an axis: quantization levels, clipping and repeated samples."""

    levels: QuantizationGrid | None
    clipped: Clipping | None
    repeats: RepeatedSamples | None


class RegressorCache:
    """Cached transforms of the regressors that depend on time and temperature.

    Every trial uses the same regressors again.

    Parameters
    ----------
    n : int
        Number of samples.
    rate_hz : float
        Sample rate in Hz.
    temperature_c : ndarray of float64, shape (n,), or None
        Temperature in °C.
    """

    def __init__(self, n: int, rate_hz: float, temperature_c: Floats | None) -> None:
        def make(effect: Effect) -> list[Floats]:
            return [cosine_transform(one) for one in regressors(effect, n, rate_hz, temperature_c)]

        self.curve = cosine_transform(np.linspace(-1.0, 1.0, n) ** 2)
        """[n − 1] transform of t², a drift that corresponds to no named effect."""
        self.steps = 0.25 / n / np.sin(0.5 * np.pi * np.arange(1, n) / n) ** 2
        """[n − 1] mean squares of the coefficients of a unit step, averaged over all step times."""
        self._make = lru_cache(max(MIN_CACHED_SERIES, MAX_CACHE_BYTES // (8 * n)))(make)

    def columns(self, effect: Effect) -> list[Floats]:
        """Return the transforms of the regressors of a deterministic effect with size one, each of shape (n − 1,)."""
        return self._make(with_factors(effect, np.ones(2)))


@dataclass(slots=True)
class Axis:
    """Samples, transforms and bins of one axis of one recording."""

    name: str
    raw: Floats  # [n] rad/s or m/s² as measured; NaN = missing
    repaired: Floats  # [n] rad/s or m/s², repaired
    coefficients: Floats  # [n − 1] cosine transform of ``y``
    bins: Bins
    others: Mapping[str, Floats]  # [n − 1] transforms of the axes that may leak into it
    temperature_c: Floats | None  # [n] °C
    shown: ValueStatistics
    courses: "RegressorCache"  # shared by all axes of a recording and of its simulations
    used_bins: Floats = field(init=False)  # [m] 1 for bins that are used, 0 for bins deep in a stop band
    _products: dict[tuple[object, ...], Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        power = self.bins.sums(self.coefficients**2) / self.bins.count
        slow = self.bins.f_hz < MIN_STOP_BAND_FRACTION * self.bins.rate_hz
        self.used_bins = ((power > MIN_BIN_POWER_RATIO * np.median(power)) | slow).astype(np.float64)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.repaired.size

    @property
    def rate_hz(self) -> float:
        """Stated sample rate in Hz."""
        return self.bins.rate_hz

    def rebinned(self, bins: Bins) -> "Axis":
        """Return the same axis with other bins."""
        return Axis(
            self.name,
            self.raw,
            self.repaired,
            self.coefficients,
            bins,
            self.others,
            self.temperature_c,
            self.shown,
            self.courses,
        )

    def columns(self, effect: Effect) -> list[Floats]:
        """Return the transforms of the regressors of a deterministic effect with size one, each of shape (n − 1,)."""
        return [self.others[effect.source]] if isinstance(effect, Leak) else self.courses.columns(effect)

    def fit(
        self,
        effects: Sequence[Effect],
        held: frozenset[int] = frozenset(),
        extra: Floats | None = None,
        curved: bool = False,
        floor: bool = True,
    ) -> Likely:
        """Return the maximum of the likelihood over all sizes that are not fixed.

        Parameters
        ----------
        effects : sequence of Effect
            Effects of the axis. Their shapes stay fixed, and their sizes are the starting values.
        held : frozenset of int, optional
            Indices of the noise effects whose size is fixed.
        extra : ndarray of float64, shape (r, m), optional
            Additional variance bases without an effect, for θ = 1.
        curved : bool, optional
            If True, t² is an additional regressor without an effect.
        floor : bool, optional
            If True and the effects contain a low-pass filter, white noise is added after the filter. A real sensor
            aliases and its converter is noisy. The null of a digital filter at half the sample rate is therefore never
            observed.

        Returns
        -------
        Likely
            Effects with fitted sizes and their log-likelihood.
        """
        f_hz, tau0_s = self.bins.f_hz, 1.0 / self.rate_hz
        transforms = sorted(
            (e for e in effects if self._changes_spectrum(e)), key=lambda e: TRANSFORM_ORDER.index(type(e))
        )
        constant = apply_transforms(transforms, Spectrum(np.zeros_like, np.zeros_like, tau0_s), f_hz) / tau0_s
        noises, bases, start = [], [], []
        for at, effect in enumerate(effects):
            if type(effect) not in NOISE_SIZE_PARAMETERS:
                continue
            made = self._variance_basis(effect, effects, transforms)
            if at in held:
                constant = constant + size(effect) ** 2 * made
            else:
                noises.append(at)
                bases.append(made)
                start.append(min(size(effect) ** 2, self._full_power_theta(made)))
        floor = floor and any(isinstance(one, BandwidthLimit) for one in transforms)
        if floor:
            bases.append(np.ones_like(f_hz))
            start.append(1e-3 * self._full_power_theta(bases[-1]))
        for row in extra if extra is not None else ():
            bases.append(row)
            start.append(1e-2 * self._full_power_theta(row))
        courses: list[tuple[int, slice]] = []
        regressors: list[tuple[Effect, int]] = []
        for at, effect in enumerate(effects):
            if type(effect) in DETERMINISTIC_SIZE_PARAMETERS:
                made_columns = self.columns(effect)
                courses.append((at, slice(len(regressors), len(regressors) + len(made_columns))))
                regressors += [(effect, i) for i in range(len(made_columns))]
        if curved:
            regressors.append((CURVATURE_REGRESSOR, 0))
        found = self._binned_sums(regressors)
        stacked = np.asarray(bases).reshape(len(bases), f_hz.size)
        fitted = maximise_whittle(
            self.bins.count * self.used_bins, found, stacked, constant, np.asarray(start, np.float64)
        )
        return Likely(
            self._with_fitted_sizes(effects, noises, courses, fitted),
            held,
            fitted.log_likelihood,
            fitted,
            tuple(noises),
            tuple(courses),
            float(fitted.theta[len(noises)]) if floor else 0.0,
        )

    def with_beta(self, likely: Likely, beta: Floats) -> Likely:
        """Return the fit with given sizes of the deterministic effects and unchanged noise.

        Parameters
        ----------
        likely : Likely
            Fit whose noise is kept.
        beta : ndarray of float64, shape (q,)
            Sizes of the regressors, in SI units of the axis.
        """
        fitted = likely.fitted
        regressors = [(likely.effects[at], i) for at, place in likely.courses for i in range(place.stop - place.start)]
        found = self._binned_sums(regressors)
        residual = found.power - 2.0 * beta @ found.cross + np.einsum("i,j,ijb->b", beta, beta, found.gram)
        count = self.bins.count * self.used_bins
        value = -0.5 * float((count * np.log(fitted.variance) + residual / fitted.variance).sum())
        changed = replace(fitted, beta=beta, residual=np.maximum(residual, 0.0), log_likelihood=value)
        return replace(likely, fitted=changed, log_likelihood=value)

    def residual(self, likely: Likely) -> Floats:
        """Return the coefficients, shape (n − 1,), with all fitted deterministic effects removed."""
        left = self.coefficients.copy()
        for at, place in likely.courses:
            for factor, column in zip(likely.fitted.beta[place], self.columns(likely.effects[at]), strict=True):
                left -= factor * column
        return left

    def _changes_spectrum(self, effect: Effect) -> TypeGuard[Transform]:
        """Return True if a transform changes the spectrum. Repeats whose positions are known have been replaced and do
        not.
        """
        mended = isinstance(effect, SampleHold) and self.shown.repeats is not None and self.shown.repeats.mask.any()
        return isinstance(effect, Transform) and not mended

    def _variance_basis(self, effect: Effect, effects: Sequence[Effect], transforms: Sequence[Transform]) -> Floats:
        """Return the variance, shape (m,), of the coefficients of each bin for a noise effect with size one."""
        tau0_s = 1.0 / self.rate_hz
        share = 1.0
        if isinstance(effect, AngleRandomWalk):
            for other in effects:
                if isinstance(other, NoiseStep):
                    later = 1.0 - min(other.time * self.rate_hz / self.n, 1.0)
                    share *= 1.0 + later * (other.ratio**2 - 1.0)  # mean variance over the recording
        raw = Spectrum(lambda f: share * unit_spectrum(effect, f, tau0_s), None, tau0_s)
        empty = Spectrum(np.zeros_like, np.zeros_like, tau0_s)
        with_it = apply_transforms(transforms, raw, self.bins.f_hz)
        return np.asarray((with_it - apply_transforms(transforms, empty, self.bins.f_hz)) / tau0_s)

    def _full_power_theta(self, basis: Floats) -> float:
        """Return the θ for which a basis would have the total power of the axis."""
        return float(
            self._binned_product(None, None).sum() / max((self.bins.count * self.used_bins * basis).sum(), 1e-300)
        )

    def _binned_sums(self, regressors: Sequence[tuple[Effect, int]]) -> BinSums:
        """Return the sums over bins of the products of the axis and its regressors."""
        q, m = len(regressors), self.bins.count.size
        cross, gram = np.empty((q, m)), np.empty((q, q, m))
        for i, one in enumerate(regressors):
            cross[i] = self._binned_product(one, None)
            for j in range(i + 1):
                gram[i, j] = gram[j, i] = self._binned_product(one, regressors[j])
        return BinSums(self._binned_product(None, None), cross, gram)

    def _binned_product(self, one: tuple[Effect, int] | None, other: tuple[Effect, int] | None) -> Floats:
        """Return the sums over bins of the product of two columns. None means the axis itself."""
        key = (_regressor_key(one), _regressor_key(other))
        if key not in self._products:
            a, b = (self._regressor(x) for x in (one, other))
            if len(self._products) > MAX_CACHED_PRODUCTS:
                self._products.clear()
            self._products[key] = self.bins.sums(a * b) * self.used_bins
        return self._products[key]

    def _regressor(self, one: tuple[Effect, int] | None) -> Floats:
        """Return the transform of a regressor, or of the axis itself for None."""
        if one is None:
            return self.coefficients
        return self.courses.curve if one[0] is CURVATURE_REGRESSOR else self.columns(one[0])[one[1]]

    @staticmethod
    def _with_fitted_sizes(
        effects: Sequence[Effect], noises: Sequence[int], courses: Sequence[tuple[int, slice]], fitted: WhittleFit
    ) -> Effects:
        """Return the effects with their fitted sizes."""
        found = list(effects)
        for theta, at in zip(fitted.theta, noises, strict=False):  # bases without an effect come last
            found[at] = with_size(found[at], float(theta) ** 0.5)
        for at, place in courses:
            found[at] = with_factors(found[at], fitted.beta[place])
        return tuple(found)


def apply_transforms(transforms: Sequence[Transform], spectrum: Spectrum, f_hz: Floats) -> Floats:
    """Return the spectral density after the transforms of an axis.

    Rounding adds white noise, also if its steps are coarse.

    Parameters
    ----------
    transforms : sequence of Transform
        Transforms in the order in which they act.
    spectrum : Spectrum
        Spectrum before the transforms.
    f_hz : ndarray of float64, shape (m,)
        Frequencies in Hz.

    Returns
    -------
    ndarray of float64, shape (m,)
        Two-sided spectral density in unit²/Hz.
    """
    for one in transforms:
        if isinstance(one, Saturation):
            continue  # clipped samples have been restored before
        if isinstance(one, Resolution):
            spectrum = spectrum + white_noise_spectrum(one.step**2 / 12.0, spectrum.tau0_s)
        else:
            spectrum = one.transform_spectrum(spectrum)
    return spectrum.density(f_hz)


def _regressor_key(one: tuple[Effect, int] | None) -> tuple[object, int] | None:
    """Return the cache key of a regressor."""
    if one is None:
        return None
    effect, at = one
    if effect is CURVATURE_REGRESSOR:
        return effect, at
    return (with_size(effect, 1.0) if isinstance(effect, Leak) else with_factors(effect, np.ones(2)), at)
