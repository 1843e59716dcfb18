"""Maximum-likelihood fit of effects to one axis of a recording.

The fit maximises the Whittle likelihood over the sizes of the effects. Many candidate effects have the same regressors,
so the regressors and the sums over frequency bins are cached.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import AxisLeak, Effect, Source, Transform
from monitor.noise.effects import (
    TRANSFORM_ORDER,
    AngleRandomWalk,
    BandwidthLimit,
    Bias,
    NoiseStep,
    RandomSampleHold,
    Resolution,
    Saturation,
)
from monitor.noise.spectrum import Spectrum, white_noise_spectrum
from monitor.reconcile.likelihood.effect_roles import (
    DETERMINISTIC_SIZE_PARAMETERS,
    NOISE_SIZE_PARAMETERS,
    build_unit_regressors,
    effect_size,
    with_effect_size,
    with_regressor_factors,
)
from monitor.reconcile.likelihood.whittle_fit import BinnedProductSums, WhittleFit, maximise_whittle_likelihood
from monitor.reconcile.preparation.cosine_bins import FrequencyBins, cosine_transform
from monitor.reconcile.preparation.value_artifacts import Clipping, QuantizationGrid, RepeatedSamples

MIN_BIN_POWER_RATIO: Final = 1e-4
"""Smallest power of a bin in the fit, relative to the median bin. The stop band of a filter has less power.
"""
MIN_STOP_BAND_FRACTION: Final = 0.02
"""Lowest frequency of a stop band, as a fraction of the sample rate.
"""
MAX_CACHE_BYTES: Final = 1 << 28
MIN_CACHED_SERIES: Final = 16
"""Smallest number of cached series. The diagnostics use 16 series."""
MAX_CACHED_PRODUCTS: Final = 4096
INITIAL_FLOOR_RATIO: Final = 1e-3
"""Starting value of the white noise behind a low-pass filter, relative to the total power."""
INITIAL_EXTRA_RATIO: Final = 1e-2
"""Starting value of an additional variance basis, relative to the total power."""
Effects = tuple[Effect, ...]
"""Effects of one axis."""
Regressor = tuple[Effect, int]
"""Deterministic effect and the index of one of its one or two regressors."""
CURVATURE: Final[Regressor] = (Bias(value=1.0), 0)
"""Marker for the regressor t²."""


@dataclass(frozen=True, slots=True)
class ValueArtifacts:
    """Quantization, clipping and repeated samples of an axis."""

    quantization: QuantizationGrid | None
    clipping: Clipping | None
    repeats: RepeatedSamples | None


class RegressorCache:
    """Cache of the cosine transforms of regressors that depend on time and temperature.

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
        def compute_regressor_transforms(effect: Effect) -> list[Floats]:
            return [cosine_transform(series) for series in build_unit_regressors(effect, n, rate_hz, temperature_c)]

        self.curvature = cosine_transform(np.linspace(-1.0, 1.0, n) ** 2)
        """Cosine transform of t², shape (n − 1,)."""
        self.step_power = 0.25 / n / np.sin(0.5 * np.pi * np.arange(1, n) / n) ** 2
        """Mean square of each coefficient of a unit step over all step times, shape (n − 1,)."""
        self._transform_regressors = lru_cache(max(MIN_CACHED_SERIES, MAX_CACHE_BYTES // (8 * n)))(
            compute_regressor_transforms
        )

    def regressor_cosine_transforms(self, effect: Effect) -> list[Floats]:
        """Return the cosine transforms, each of shape (n − 1,), of the regressors of a deterministic effect."""
        return self._transform_regressors(with_regressor_factors(effect, np.ones(2)))


class _NoiseVariances(NamedTuple):
    fitted: list[int]  # index of each noise effect whose size is fitted
    bases: list[Floats]  # [m] variance basis of each of these effects
    start: list[float]  # starting value of θ, the square of the size, for each of these effects
    constant: Floats  # [m] variance that is not fitted


@dataclass(slots=True, eq=False)
class Axis:
    """Samples, cosine transforms and frequency bins of one axis of a recording."""

    name: str
    raw: Floats  # [n] rad/s or m/s² as measured; NaN = missing
    repaired: Floats  # [n] rad/s or m/s², repaired
    coefficients: Floats  # [n − 1] cosine transform of ``repaired``
    bins: FrequencyBins
    leak_sources: Mapping[str, Floats]  # [n − 1] transforms of the axes that may leak into this axis
    temperature_c: Floats | None  # [n] °C
    value_artifacts: ValueArtifacts
    regressors: RegressorCache  # shared by all axes of a recording and of its simulations
    used_bins: Floats = field(init=False)  # [m] 1 for bins that are used, 0 for bins deep in a stop band
    _products: dict[tuple[object, ...], Floats] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        power = self.bins.sum_over_bins(self.coefficients**2) / self.bins.count
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

    @property
    def length_s(self) -> float:
        """Length of the recording in seconds."""
        return self.n / self.rate_hz

    @property
    def coefficient_rms(self) -> float:
        """Root mean square of the cosine transform, in the unit of the axis."""
        return float(np.sqrt(np.mean(self.coefficients**2)))

    def with_repaired_samples(self, repaired: Floats) -> "Axis":
        """Return a copy of the axis with new repaired samples, shape (n,)."""
        return replace(self, repaired=repaired, coefficients=cosine_transform(repaired))

    def regressor_cosine_transforms(self, effect: Effect) -> list[Floats]:
        """Return the cosine transforms, each of shape (n − 1,), of the regressors of a deterministic effect."""
        if isinstance(effect, AxisLeak):
            return [self.leak_sources[effect.source]]
        return self.regressors.regressor_cosine_transforms(effect)

    def fit(
        self,
        effects: Sequence[Effect],
        fixed_noise: frozenset[int] = frozenset(),
        extra_bases: Floats | None = None,
        curvature: bool = False,
        noise_floor: bool = True,
    ) -> "AxisFit":
        """Fit the sizes of effects to the axis by maximum likelihood.

        Parameters
        ----------
        effects : sequence of Effect
            Effects to fit. The sizes are starting values, and the shape parameters stay fixed.
        fixed_noise : frozenset of int, optional
            Indices of the noise effects whose size is fixed.
        extra_bases : ndarray of float64, shape (r, m), optional
            Additional variance bases that belong to no effect.
        curvature : bool, optional
            If True, t² is an additional regressor.
        noise_floor : bool, optional
            If True, white noise is added behind a low-pass filter, because no real sensor is free of noise at half the
            sample rate.

        Returns
        -------
        AxisFit
            Fitted sizes and log-likelihood.
        """
        transforms = _spectral_transforms(effects, self.value_artifacts)
        noise_floor = noise_floor and any(isinstance(one, BandwidthLimit) for one in transforms)
        noise = self._noise_variances(effects, fixed_noise, transforms)
        unnamed = [(np.ones_like(noise.constant), INITIAL_FLOOR_RATIO)] if noise_floor else []
        unnamed += [(row, INITIAL_EXTRA_RATIO) for row in (extra_bases if extra_bases is not None else ())]
        bases = [*noise.bases, *(basis for basis, _ in unnamed)]
        start = [*noise.start, *(ratio * self._full_power_theta(basis) for basis, ratio in unnamed)]
        slices, columns = self._regressors_of(effects)
        fitted = maximise_whittle_likelihood(
            self.bins.count * self.used_bins,
            self.sum_products_over_bins([*columns, CURVATURE] if curvature else columns),
            np.asarray(bases).reshape(len(bases), self.bins.count.size),
            noise.constant,
            np.asarray(start, np.float64),
        )
        return AxisFit(
            self,
            _with_fitted_sizes(effects, noise.fitted, slices, fitted),
            fixed_noise,
            fitted.log_likelihood,
            fitted,
            tuple(noise.fitted),
            slices,
            float(fitted.theta[len(noise.fitted)]) if noise_floor else 0.0,
        )

    def _noise_variances(
        self, effects: Sequence[Effect], fixed_noise: frozenset[int], transforms: Sequence[Transform]
    ) -> _NoiseVariances:
        constant = _density_after(transforms, None, self.bins) / (1.0 / self.rate_hz)
        found = _NoiseVariances([], [], [], constant)
        for at, effect in enumerate(effects):
            if type(effect) not in NOISE_SIZE_PARAMETERS:
                continue
            basis = self._variance_basis(effect, effects, transforms)
            if at in fixed_noise:
                constant += effect_size(effect) ** 2 * basis
            else:
                found.fitted.append(at)
                found.bases.append(basis)
                found.start.append(min(effect_size(effect) ** 2, self._full_power_theta(basis)))
        return found

    def sum_products_over_bins(self, regressors: Sequence[Regressor]) -> BinnedProductSums:
        """Sum the products of axis and regressors over each frequency bin."""
        q, m = len(regressors), self.bins.count.size
        cross, gram = np.empty((q, m)), np.empty((q, q, m))
        for i, column in enumerate(regressors):
            cross[i] = self._binned_product(column, None)
            for j in range(i + 1):
                gram[i, j] = gram[j, i] = self._binned_product(column, regressors[j])
        return BinnedProductSums(self._binned_product(None, None), cross, gram)

    def _regressors_of(self, effects: Sequence[Effect]) -> tuple[tuple[tuple[int, slice], ...], list[Regressor]]:
        slices: list[tuple[int, slice]] = []
        columns: list[Regressor] = []
        for at, effect in enumerate(effects):
            if type(effect) in DETERMINISTIC_SIZE_PARAMETERS:
                count = len(self.regressor_cosine_transforms(effect))
                slices.append((at, slice(len(columns), len(columns) + count)))
                columns += [(effect, i) for i in range(count)]
        return tuple(slices), columns

    def _variance_basis(self, effect: Effect, effects: Sequence[Effect], transforms: Sequence[Transform]) -> Floats:
        """Return the variance that a noise effect of size one adds to each frequency bin, shape (m,)."""
        factor = 1.0
        if isinstance(effect, AngleRandomWalk):
            for other in effects:
                if isinstance(other, NoiseStep):
                    later = 1.0 - min(other.time * self.rate_hz / self.n, 1.0)
                    factor *= 1.0 + later * (other.ratio**2 - 1.0)  # mean variance over the recording
        tau0_s, unit = 1.0 / self.rate_hz, with_effect_size(effect, 1.0)
        assert isinstance(unit, Source)
        source = Spectrum(lambda f: factor * unit.two_sided_psd(f, tau0_s), None, tau0_s)
        density = _density_after(transforms, source, self.bins) - _density_after(transforms, None, self.bins)
        return np.asarray(density / tau0_s)

    def _full_power_theta(self, basis: Floats) -> float:
        """Return the squared size for which a noise effect alone would explain the total power of the axis."""
        power = self._binned_product(None, None).sum()
        return float(power / max((self.bins.count * self.used_bins * basis).sum(), 1e-300))

    def _binned_product(self, a: Regressor | None, b: Regressor | None) -> Floats:
        key = (_regressor_key(a), _regressor_key(b))
        if key not in self._products:
            if len(self._products) > MAX_CACHED_PRODUCTS:
                self._products.clear()
            self._products[key] = self.bins.sum_over_bins(self._column(a) * self._column(b)) * self.used_bins
        return self._products[key]

    def _column(self, regressor: Regressor | None) -> Floats:
        if regressor is None:
            return self.coefficients
        return (
            self.regressors.curvature
            if regressor is CURVATURE
            else self.regressor_cosine_transforms(regressor[0])[regressor[1]]
        )


@dataclass(frozen=True, slots=True, eq=False)
class AxisFit:
    """Effects fitted to an axis by maximum likelihood."""

    axis: Axis
    effects: Effects  # with fitted sizes
    fixed_noise: frozenset[int]  # indices of effects whose size was not fitted
    log_likelihood: float
    whittle: WhittleFit
    fitted_noise: tuple[int, ...]  # index in ``effects`` of each fitted θ
    regressor_slices: tuple[tuple[int, slice], ...]  # index in ``effects`` and slice of β of each deterministic effect
    noise_floor_variance: float = 0.0  # variance of a coefficient due to the white noise floor after a low-pass filter

    def size_standard_error(self, effect_index: int) -> float:
        """Return the standard error of the size of an effect, or NaN if the size was not fitted."""
        if effect_index in self.fitted_noise:
            noise = self.fitted_noise.index(effect_index)
            covariance = np.linalg.pinv(self.whittle.theta_information)
            theta = float(self.whittle.theta[noise])
            return 0.5 * float(np.sqrt(covariance[noise, noise] / theta)) if theta > 0.0 else float("nan")
        for at, place in self.regressor_slices:
            if at == effect_index:  # the two regressors of a sinusoid have equal errors
                return float(np.sqrt(np.diag(self.whittle.beta_covariance)[place].mean()))
        return float("nan")

    def with_regressor_sizes(self, beta: Floats) -> "AxisFit":
        """Return a copy of the fit with new regressor sizes, shape (q,), and the same noise."""
        axis, whittle = self.axis, self.whittle
        sums = axis.sum_products_over_bins(
            [(self.effects[at], i) for at, p in self.regressor_slices for i in range(p.stop - p.start)]
        )
        residual = sums.power - 2.0 * beta @ sums.cross + np.einsum("i,j,ijb->b", beta, beta, sums.gram)
        count = axis.bins.count * axis.used_bins
        value = -0.5 * float((count * np.log(whittle.variance) + residual / whittle.variance).sum())
        changed = replace(whittle, beta=beta, residual=np.maximum(residual, 0.0), log_likelihood=value)
        return replace(self, whittle=changed, log_likelihood=value)

    def coefficients_without_deterministic_effects(self) -> Floats:
        """Return the cosine transform, shape (n − 1,), of the axis less all fitted deterministic effects."""
        left = self.axis.coefficients.copy()
        for at, place in self.regressor_slices:
            for factor, column in zip(
                self.whittle.beta[place], self.axis.regressor_cosine_transforms(self.effects[at]), strict=True
            ):
                left -= factor * column
        return left


def _spectral_transforms(effects: Sequence[Effect], statistics: ValueArtifacts) -> list[Transform]:
    """Return the effects that filter or alter the spectrum, in the order of the signal chain."""
    replaced = statistics.repeats is not None and bool(statistics.repeats.mask.any())
    found = [
        effect
        for effect in effects
        if isinstance(effect, Transform) and not (replaced and isinstance(effect, RandomSampleHold))
    ]
    return sorted(found, key=lambda effect: TRANSFORM_ORDER.index(type(effect)))


def _with_fitted_sizes(
    effects: Sequence[Effect], noises: Sequence[int], slices: Sequence[tuple[int, slice]], fitted: WhittleFit
) -> Effects:
    found = list(effects)
    for theta, at in zip(fitted.theta, noises, strict=False):  # additional bases follow the bases of the effects
        found[at] = with_effect_size(found[at], float(theta) ** 0.5)
    for at, place in slices:
        found[at] = with_regressor_factors(found[at], fitted.beta[place])
    return tuple(found)


def _density_after(transforms: Sequence[Transform], source: Spectrum | None, bins: FrequencyBins) -> Floats:
    """Return the spectral density, shape (m,), of a noise source behind the signal chain of an axis.

    If the source is None, only the noise of the signal chain is returned. Saturation is ignored, because clipped
    samples were replaced.
    """
    spectrum = source or Spectrum(np.zeros_like, np.zeros_like, 1.0 / bins.rate_hz)
    for transform in transforms:
        if isinstance(transform, Resolution):
            spectrum = spectrum + white_noise_spectrum(transform.step**2 / 12.0, spectrum.tau0_s)
        elif not isinstance(transform, Saturation):
            spectrum = transform.transform_spectrum(spectrum)
    return spectrum.density(bins.f_hz)


def _regressor_key(regressor: Regressor | None) -> tuple[object, int] | None:
    """Return a cache key that does not depend on the size of the effect."""
    if regressor is None or regressor is CURVATURE:
        return regressor
    effect, at = regressor
    return (
        with_effect_size(effect, 1.0) if isinstance(effect, AxisLeak) else with_regressor_factors(effect, np.ones(2)),
        at,
    )
