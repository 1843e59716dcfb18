"""Maximum-likelihood fit of effects to one axis of a recording.

The fit maximises the Whittle likelihood over the sizes of the effects. Many candidate effects have the same regressors,
so the regressors and the sums over frequency bins are cached.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import inf, isfinite, prod, sqrt
from typing import Final, NamedTuple, TypeVar

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import AxisLeak, Effect, Source, Transform, WhiteNoiseGain
from monitor.noise.effects import (
    TRANSFORM_ORDER,
    AngleRandomWalk,
    BandwidthLimit,
    BiasCurve,
    RandomSampleHold,
    RateRamp,
    Resolution,
    Saturation,
    ScaleFactor,
    Sinusoidal,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
    WanderingVariance,
)
from monitor.noise.spectrum import Spectrum, white_noise_spectrum
from monitor.reconcile.effect_properties import SERIES_SIZE_PARAMETERS
from monitor.reconcile.likelihood.effect_roles import (
    MAX_REGRESSORS,
    UNSIGNED_SERIES,
    build_unit_regressors,
    effect_size,
    is_noise_effect,
    regression_coefficients,
    regressor_count,
    with_effect_size,
    with_regression_coefficients,
)
from monitor.reconcile.likelihood.whittle_fit import BinnedRegressionSums, WhittleFit, maximise_whittle_likelihood
from monitor.reconcile.preparation.cosine_bins import (
    MAX_SMOOTH_COEFFICIENTS,
    FrequencyBins,
    cosine_transform,
    low_frequency_cosine_transform,
    sinusoid_cosine_transforms,
)
from monitor.reconcile.preparation.value_artifacts import ValueArtifacts

MIN_BIN_POWER_RATIO: Final = 1e-4
"""Smallest power of a bin in the fit, relative to the median bin. The stop band of a filter has less power.
"""
MIN_STOP_BAND_FRACTION: Final = 0.02
"""Lowest frequency of a stop band, as a fraction of the sample rate.
"""
MIN_REGRESSOR_SIZE: Final = 1e-30
"""Smallest absolute size of an effect. Smaller sizes are rounding errors and become zero."""
MAX_CACHE_BYTES: Final = 1 << 26
MIN_CACHED_EFFECTS: Final = 8
"""Smallest number of cached effects that are not smooth. An effect has one or two series of 8 bytes per sample."""
MAX_CACHED_SMOOTH_SERIES: Final = 128
SMOOTH_EFFECTS: Final = (RateRamp, BiasCurve, TemperatureBias, TemperatureLag, TurnOnTransient)
"""Deterministic effects that change slowly unless they have a short time constant."""
MIN_BLOCKS_PER_TIME_CONSTANT: Final = 16
"""Smallest time constant of a smooth effect, in blocks of the smooth transform."""
WHOLE_RECORDING: Final = slice(None)
MAX_CACHED_PRODUCTS: Final = 2048
MAX_CACHED_BASES: Final = 512
MAX_CACHED_UNIT_EFFECTS: Final = 4096
MIN_LINE_POWER_GAIN: Final = 1e-12
"""Smallest assumed power gain of a filter for a line, which prevents a division by zero."""
INITIAL_FLOOR_RATIO: Final = 1e-3
"""Smallest starting value of the white noise added after a low-pass filter, relative to the total power."""
Effects = tuple[Effect, ...]
"""Effects of one axis."""
Evaluated = TypeVar("Evaluated")
Regressor = tuple[Effect, int]
"""Deterministic effect and the index of one of its regressors."""


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
    part : slice, optional
        Samples of the recording that the axes contain. By default, the axes contain the whole recording.
    """

    def __init__(self, n: int, rate_hz: float, temperature_c: Floats | None, part: slice = WHOLE_RECORDING) -> None:
        def build_columns(effect: Effect) -> list[Floats]:
            return [series[part] for series in build_unit_regressors(effect, n, rate_hz, temperature_c)]

        def compute_transforms(effect: Effect) -> list[Floats]:
            if isinstance(effect, Sinusoidal):
                return sinusoid_cosine_transforms(effect.frequency / rate_hz, self.first_sample, self.half_sines)
            return [cosine_transform(column) for column in build_columns(effect)]

        def compute_smooth_transforms(effect: Effect) -> list[Floats]:
            return [low_frequency_cosine_transform(column) for column in build_columns(effect)]

        self._whole = n, rate_hz, temperature_c
        self.first_sample, end, _ = part.indices(n)
        """Index in the recording of the first sample of the axes."""
        size = end - self.first_sample
        self._parts: dict[tuple[int, int], RegressorCache] = {}
        self._min_time_constant_s = MIN_BLOCKS_PER_TIME_CONSTANT * size / MAX_SMOOTH_COEFFICIENTS / rate_hz
        self.half_sines = np.sin(0.5 * np.pi * np.arange(1, size) / size)
        """Values sin(πk/2n) of the n samples of the axes for k = 1 … n − 1."""
        self._transform = lru_cache(max(MIN_CACHED_EFFECTS, MAX_CACHE_BYTES // (16 * size)))(compute_transforms)
        self._transform_smooth = lru_cache(MAX_CACHED_SMOOTH_SERIES)(compute_smooth_transforms)

    def restrict_to_part(self, part: slice) -> "RegressorCache":
        """Return the cache for a part of the recording, and keep the cache for the next call.

        The regressors still begin at the start of the recording.
        """
        first, end, _ = part.indices(self._whole[0])
        if (first, end) not in self._parts:
            self._parts[first, end] = RegressorCache(*self._whole, part)
        return self._parts[first, end]

    def regressor_cosine_transforms(self, effect: Effect) -> list[Floats]:
        """Return the cosine transforms of the regressors of a deterministic effect.

        The shape of each transform is (n − 1,). The transform of a smooth regressor can be shorter, because the
        coefficients at high frequencies are nearly zero.
        """
        time_constant_s = getattr(effect, "time_constant", None) or np.inf
        if isinstance(effect, SMOOTH_EFFECTS) and time_constant_s >= self._min_time_constant_s:
            return self._transform_smooth(with_regression_coefficients(effect, np.ones(MAX_REGRESSORS)))
        return self._transform(with_regression_coefficients(effect, np.ones(MAX_REGRESSORS)))


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
    is_model_fitted: bool = False  # True if the model under test was fitted to this recording
    is_temperature_coarse: bool = False  # True if the sizes of temperature effects are not compared with the model
    sources_of_unchanged_leaks: frozenset[str] = frozenset()  # sources of leaks of the model whose size is kept
    failures: dict[str, str] = field(default_factory=dict)  # first numerical failure of each candidate effect, by name
    used_bins: Floats = field(init=False)  # [m] 1 for bins that are used, 0 for bins deep in a stop band
    cosine_transform_rms: float = field(init=False)  # root mean square of the coefficients, in the unit of the axis
    used_count: Floats = field(init=False)  # [m] number of coefficients, or 0 for bins that are not used
    _used_power: float = field(init=False)  # sum of squares of the coefficients in the bins that are used
    _products: dict[frozenset[Regressor | None], Floats] = field(init=False, default_factory=dict)
    _bases: dict[tuple[object, ...], Floats] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        sums = self.bins.sum_over_bins(self.coefficients**2)
        self.cosine_transform_rms = float(np.sqrt(sums.sum() / self.coefficients.size))
        power = sums / self.bins.count
        slow = self.bins.f_hz < MIN_STOP_BAND_FRACTION * self.bins.rate_hz
        self.used_bins = ((power > MIN_BIN_POWER_RATIO * np.median(power)) | slow).astype(np.float64)
        self.used_count = self.bins.count * self.used_bins
        self._used_power = float(sums @ self.used_bins)

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

    def with_repaired_samples(self, repaired: Floats) -> "Axis":
        """Return a copy of the axis that uses other repaired samples, shape (n,)."""
        return replace(self, repaired=repaired, coefficients=cosine_transform(repaired))

    def regressor_cosine_transforms(self, effect: Effect) -> list[Floats]:
        """Return the cosine transforms of the regressors of a deterministic effect, as ``RegressorCache`` does."""
        if isinstance(effect, AxisLeak):
            return [self.leak_sources[effect.source]]
        return self.regressors.regressor_cosine_transforms(effect)

    def clear_cached_sums(self) -> None:
        """Release the memory of the cached sums over bins, which are computed again on demand."""
        self._products.clear()
        self._bases.clear()

    def white_noise_gain_over_time(self, effects: Sequence[Effect]) -> Floats:
        """Return the known gain of the white noise over time, shape (n,). A random gain is one on average."""
        gain = np.ones(self.n)
        for effect in effects:
            if isinstance(effect, WhiteNoiseGain) and not isinstance(effect, WanderingVariance):
                started = effect.start_gain(self.rate_hz, np.random.default_rng(0))
                gain *= started.compute_gain(self.regressors.first_sample, self.n)
        return gain

    def _mean_noise_power(self, gains: Effects) -> float:
        """Return the mean square of the gain of the white noise over the recording."""
        if not gains:
            return 1.0
        key = ("gain", gains)
        if key not in self._bases:
            self._bases[key] = np.mean(self.white_noise_gain_over_time(gains) ** 2, keepdims=True)
        return float(self._bases[key][0])

    def evaluate_candidate(self, name: str, evaluate: Callable[[], Evaluated], rejected: Evaluated) -> Evaluated:
        """Return the result of ``evaluate``, or ``rejected`` if the candidate effect fails numerically.

        The first failure of each name is kept in ``failures``.
        """
        try:
            return evaluate()
        except (ArithmeticError, ValueError) as error:  # includes singular matrices and invalid parameters
            self.failures.setdefault(name, str(error) or type(error).__name__)
            return rejected

    def candidate_log_likelihood(self, effects: Sequence[Effect], fixed_sizes: frozenset[int] = frozenset()) -> float:
        """Return the log-likelihood of a fit whose last effect is a candidate, or −inf if the fit fails numerically."""
        return self.evaluate_candidate(effects[-1].name, lambda: self.fit(effects, fixed_sizes).log_likelihood, -inf)

    def fit(
        self,
        effects: Sequence[Effect],
        fixed_sizes: frozenset[int] = frozenset(),
    ) -> "AxisFit":
        """Fit the sizes of effects to the axis by maximum likelihood.

        Parameters
        ----------
        effects : sequence of Effect
            Effects to fit. The sizes are starting values, and the shape parameters stay fixed.
        fixed_sizes : frozenset of int, optional
            Indices of the effects whose size is fixed. The phase of a sinusoid and the sign of a ramp are always
            fitted, because they differ between recordings.

        Returns
        -------
        AxisFit
            Fitted sizes and log-likelihood.

        Raises
        ------
        FloatingPointError
            If the log-likelihood is not finite.
        """
        transforms = _spectral_transforms(effects, self.value_artifacts)
        noise = self._noise_variances(effects, fixed_sizes, transforms)
        slices, columns = self._regressors_of(effects)
        gains = tuple(_amplitude_gain(effects[at], transforms, 1.0 / self.rate_hz) for at, _ in slices)
        bases = np.asarray(noise.bases).reshape(len(noise.bases), self.bins.count.size)

        def fit_sizes(sums: BinnedRegressionSums) -> WhittleFit:
            start = np.asarray(noise.start, np.float64)
            return maximise_whittle_likelihood(self.used_count, sums, bases, noise.constant, start)

        sums = self.sum_products_over_bins(columns)
        known = [
            (effects[at], place, gain) for (at, place), gain in zip(slices, gains, strict=True) if at in fixed_sizes
        ]
        if not known:
            fitted = fit_sizes(sums)
        else:
            is_unsigned = any(isinstance(effect, UNSIGNED_SERIES) for effect, _, _ in known)
            free_beta = fit_sizes(sums).beta if is_unsigned else np.zeros(len(columns))
            fitted = _fit_with_fixed_regressors(fit_sizes, sums, _fixed_beta(known, free_beta))
        if not isfinite(fitted.log_likelihood):
            raise FloatingPointError("the log-likelihood is not finite")
        return AxisFit(
            self, tuple(effects), fixed_sizes, fitted.log_likelihood, fitted, tuple(noise.fitted), slices, gains
        )

    def _noise_variances(
        self, effects: Sequence[Effect], fixed_sizes: frozenset[int], transforms: Sequence[Transform]
    ) -> _NoiseVariances:
        constant = self._variance_of_transforms(transforms).copy()
        found = _NoiseVariances([], [], [], constant)
        for at, effect in enumerate(effects):
            if not is_noise_effect(effect):
                continue
            basis = self.variance_basis(effect, effects, transforms)
            if at in fixed_sizes:
                constant += effect_size(effect) ** 2 * basis
            else:
                found.fitted.append(at)
                found.bases.append(basis)
                whole = self._full_power_theta(basis)
                least = INITIAL_FLOOR_RATIO * whole if isinstance(effect, BandwidthLimit) else 0.0
                found.start.append(min(max(effect_size(effect) ** 2, least), whole))
        return found

    def sum_products_over_bins(self, regressors: Sequence[Regressor]) -> BinnedRegressionSums:
        """Sum the products of axis and regressors over each frequency bin."""
        q, m = len(regressors), self.bins.count.size
        cross, gram = np.empty((q, m)), np.empty((q, q, m))
        unit = [_with_unit_size(one) for one in regressors]
        for i, column in enumerate(unit):
            cross[i] = self._binned_product(column, None)
            for j in range(i + 1):
                gram[i, j] = gram[j, i] = self._binned_product(column, unit[j])
        return BinnedRegressionSums(self._binned_product(None, None), cross, gram)

    def _regressors_of(self, effects: Sequence[Effect]) -> tuple[tuple[tuple[int, slice], ...], list[Regressor]]:
        slices: list[tuple[int, slice]] = []
        columns: list[Regressor] = []
        for at, effect in enumerate(effects):
            if effect.name in SERIES_SIZE_PARAMETERS:
                count = regressor_count(effect)
                slices.append((at, slice(len(columns), len(columns) + count)))
                columns += [(effect, i) for i in range(count)]
        return tuple(slices), columns

    def variance_basis(self, effect: Effect, effects: Sequence[Effect], transforms: Sequence[Transform]) -> Floats:
        """Return the variance that a noise effect of size one adds to each frequency bin, shape (m,)."""
        gains = tuple(one for one in effects if isinstance(one, WhiteNoiseGain))
        key = (_with_unit_noise_size(effect), gains if isinstance(effect, AngleRandomWalk) else (), *transforms)
        if key not in self._bases:
            if len(self._bases) > MAX_CACHED_BASES:
                self._bases.clear()
            self._bases[key] = self._compute_variance_basis(effect, gains, transforms)
        return self._bases[key]

    def _compute_variance_basis(self, effect: Effect, gains: Effects, transforms: Sequence[Transform]) -> Floats:
        tau0_s = 1.0 / self.rate_hz
        if isinstance(effect, BandwidthLimit):  # the floor is white noise added after the filter
            transforms = transforms[transforms.index(replace(effect, floor=None)) + 1 :]
            source = white_noise_spectrum(1.0 / tau0_s, tau0_s)
        else:
            source = self._unit_spectrum(effect, gains)
        return np.asarray(
            _density_after(transforms, source, self.bins) / tau0_s - self._variance_of_transforms(transforms)
        )

    def _variance_of_transforms(self, transforms: Sequence[Transform]) -> Floats:
        """Return the variance that the signal chain itself adds to each frequency bin, shape (m,)."""
        key = ("chain", *transforms)
        if key not in self._bases:
            self._bases[key] = _density_after(transforms, None, self.bins) * self.rate_hz
        return self._bases[key]

    def _unit_spectrum(self, effect: Effect, gains: Effects) -> Spectrum:
        """Return the spectrum of a noise effect of size one before the transforms."""
        tau0_s = 1.0 / self.rate_hz
        factor = self._mean_noise_power(gains) if isinstance(effect, AngleRandomWalk) else 1.0
        unit = with_effect_size(effect, 1.0)
        assert isinstance(unit, Source)
        return Spectrum(lambda f: factor * unit.two_sided_psd(f, tau0_s), None, tau0_s)

    def _full_power_theta(self, basis: Floats) -> float:
        """Return the squared size for which a noise effect alone would explain the total power of the axis."""
        return self._used_power / max(float(self.used_count @ basis), 1e-300)

    def _binned_product(self, a: Regressor | None, b: Regressor | None) -> Floats:
        """Return the sums of products of two regressors of size one, shape (m,). None stands for the axis."""
        key = frozenset((a, b))
        if key not in self._products:
            if len(self._products) > MAX_CACHED_PRODUCTS:
                self._products.clear()
            first, second = self._column(a), self._column(b)
            size = min(first.size, second.size)
            self._products[key] = self.bins.sum_over_bins(first[:size] * second[:size]) * self.used_bins
        return self._products[key]

    def _column(self, regressor: Regressor | None) -> Floats:
        if regressor is None:
            return self.coefficients
        return self.regressor_cosine_transforms(regressor[0])[regressor[1]]


@dataclass(frozen=True, eq=False)
class AxisFit:
    """Effects fitted to an axis by maximum likelihood."""

    axis: Axis
    start_effects: Effects  # with the starting values of the sizes
    fixed_sizes: frozenset[int]  # indices of effects whose size was not fitted
    log_likelihood: float
    whittle: WhittleFit
    fitted_noise: tuple[int, ...]  # index in ``effects`` of each fitted θ
    regressor_slices: tuple[tuple[int, slice], ...]  # index in ``effects`` and slice of β of each deterministic effect
    regressor_gains: tuple[float, ...]  # gain of the transforms for each of these effects; β = gain times coefficient

    @cached_property
    def effects(self) -> Effects:
        """Effects with the fitted sizes."""
        found = list(self.start_effects)
        for theta, at in zip(self.whittle.theta, self.fitted_noise, strict=True):
            found[at] = with_effect_size(found[at], float(theta) ** 0.5)
        for (at, place), gain in zip(self.regressor_slices, self.regressor_gains, strict=True):
            fitted = with_regression_coefficients(found[at], self.whittle.beta[place] / gain)
            if at not in self.fixed_sizes:
                found[at] = fitted
            elif isinstance(found[at], Sinusoidal):  # the phase is fitted
                found[at] = with_effect_size(fitted, effect_size(found[at]))
        return tuple(found)

    def coefficient_standard_errors(self, effect_index: int) -> Floats:
        """Return the standard error of each coefficient of a deterministic effect, shape (q,)."""
        for (at, place), gain in zip(self.regressor_slices, self.regressor_gains, strict=True):
            if at == effect_index:
                return np.asarray(np.sqrt(np.diag(self.whittle.beta_covariance)[place]) / gain)
        raise ValueError(f"effect {effect_index} is not deterministic")

    def size_standard_error(self, effect_index: int) -> float:
        """Return the standard error of the size of an effect, or NaN if the size was not fitted."""
        if effect_index in self.fitted_noise:
            noise = self.fitted_noise.index(effect_index)
            covariance = np.linalg.pinv(self.whittle.theta_information)
            theta = float(self.whittle.theta[noise])
            return 0.5 * float(np.sqrt(covariance[noise, noise] / theta)) if theta > 0.0 else float("nan")
        if any(at == effect_index for at, _ in self.regressor_slices):
            errors = self.coefficient_standard_errors(effect_index)
            # the two regressors of a sinusoid have equal errors
            sinusoid = isinstance(self.start_effects[effect_index], Sinusoidal)
            return float(np.sqrt(np.mean(errors**2)) if sinusoid else errors[0])
        return float("nan")

    def noise_variance(self, effect_index: int) -> Floats:
        """Return the variance that a noise effect adds to each frequency bin, shape (m,)."""
        effect = self.effects[effect_index]
        transforms = _spectral_transforms(self.effects, self.axis.value_artifacts)
        return effect_size(effect) ** 2 * self.axis.variance_basis(effect, self.effects, transforms)

    def with_regressor_sizes(self, beta: Floats) -> "AxisFit":
        """Return a copy of the fit with new regressor sizes, shape (q,), and the same noise."""
        axis, whittle = self.axis, self.whittle
        beta = np.where(np.abs(beta) < MIN_REGRESSOR_SIZE, 0.0, beta)
        sums = axis.sum_products_over_bins(
            [(self.start_effects[at], i) for at, p in self.regressor_slices for i in range(p.stop - p.start)]
        )
        residual = sums.power - 2.0 * beta @ sums.cross + np.einsum("i,j,ijb->b", beta, beta, sums.gram)
        value = -0.5 * float((axis.used_count * np.log(whittle.variance) + residual / whittle.variance).sum())
        changed = replace(whittle, beta=beta, residual=np.maximum(residual, 0.0), log_likelihood=value)
        return replace(self, whittle=changed, log_likelihood=value)

    def sum_residual_products_over_bins(self, regressors: Sequence[Regressor]) -> tuple[Floats, Floats]:
        """Sum the products of residual and regressors over each frequency bin.

        Parameters
        ----------
        regressors : sequence of Regressor
            Regressors that need not belong to the fitted effects.

        Returns
        -------
        cross : ndarray of float64, shape (q, m)
            Products of each regressor with the axis less all fitted deterministic effects.
        gram : ndarray of float64, shape (q, q, m)
            Products of each pair of regressors.
        """
        fitted = [(self.start_effects[at], i) for at, p in self.regressor_slices for i in range(p.stop - p.start)]
        sums = self.axis.sum_products_over_bins([*regressors, *fitted])
        q = len(regressors)
        cross = sums.cross[:q] - np.einsum("j,ijb->ib", self.whittle.beta, sums.gram[:q, q:])
        return cross, sums.gram[:q, :q]

    def cosine_transform_without_deterministic_effects(self) -> Floats:
        """Return the cosine transform, shape (n − 1,), of the axis less all fitted deterministic effects."""
        left = self.axis.coefficients.copy()
        for at, place in self.regressor_slices:
            for factor, column in zip(
                self.whittle.beta[place], self.axis.regressor_cosine_transforms(self.effects[at]), strict=True
            ):
                left[: column.size] -= factor * column
        return left


def _spectral_transforms(effects: Sequence[Effect], statistics: ValueArtifacts) -> list[Transform]:
    """Return the effects that filter or alter the spectrum, in the order of the signal chain.

    The floors of low-pass filters are omitted, because a floor is fitted as a noise effect.
    """
    found = [
        replace(effect, floor=None) if isinstance(effect, BandwidthLimit) else effect
        for effect in effects
        if isinstance(effect, Transform)
        and not (isinstance(effect, RandomSampleHold) and statistics.repeats and statistics.repeats.mask.any())
    ]
    return sorted(found, key=lambda effect: TRANSFORM_ORDER.index(type(effect)))


def _fixed_beta(known: Sequence[tuple[Effect, slice, float]], free_beta: Floats) -> Floats:
    """Return β with the fixed sizes of some effects, and NaN for all other regressors, shape (q,).

    Parameters
    ----------
    known : sequence of (Effect, slice, float)
        Each effect with a fixed size, its slice of β and the gain of the transforms.
    free_beta : ndarray of float64, shape (q,)
        β of the fit without fixed sizes, which determines signs and phases.
    """
    beta = np.full(free_beta.size, np.nan)
    for effect, place, gain in known:
        beta[place] = gain * regression_coefficients(effect)
        if isinstance(effect, UNSIGNED_SERIES):
            direction = free_beta[place] / max(float(np.linalg.norm(free_beta[place])), 1e-300)
            beta[place] = gain * effect_size(effect) * direction
    return beta


def _fit_with_fixed_regressors(
    fit_sizes: Callable[[BinnedRegressionSums], WhittleFit], sums: BinnedRegressionSums, fixed_beta: Floats
) -> WhittleFit:
    """Fit with given values of some β. The values to be fitted are NaN in ``fixed_beta``."""
    free = np.flatnonzero(np.isnan(fixed_beta))
    beta = np.nan_to_num(fixed_beta)
    fitted = fit_sizes(
        BinnedRegressionSums(
            np.maximum(sums.power - 2.0 * beta @ sums.cross + np.einsum("i,j,ijb->b", beta, beta, sums.gram), 0.0),
            sums.cross[free] - np.einsum("j,ijb->ib", beta, sums.gram[free]),
            sums.gram[np.ix_(free, free)],
        )
    )
    beta[free] = fitted.beta
    information = np.zeros((beta.size, beta.size))
    information[np.ix_(free, free)] = fitted.beta_information
    return replace(fitted, beta=beta, beta_information=information)


def _amplitude_gain(effect: Effect, transforms: Sequence[Transform], tau0_s: float) -> float:
    """Return the factor by which filters and scale factors change the amplitude of a deterministic effect.

    Filters only attenuate lines, because all other effects are slow, or are leaks of samples that are already filtered.
    """
    scales = [one for one in transforms if isinstance(one, (BandwidthLimit, ScaleFactor))]
    if not scales:
        return 1.0
    if not isinstance(effect, Sinusoidal):
        return float(prod(one.factor for one in scales if isinstance(one, ScaleFactor)))
    spectrum = white_noise_spectrum(1.0 / tau0_s, tau0_s)
    for one in scales:
        spectrum = one.transform_spectrum(spectrum)
    return sqrt(max(float(spectrum.density(np.array([effect.frequency]))[0]), MIN_LINE_POWER_GAIN))


def _density_after(transforms: Sequence[Transform], source: Spectrum | None, bins: FrequencyBins) -> Floats:
    """Return the spectral density, shape (m,), that a noise source has after the signal chain of an axis.

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


@lru_cache(MAX_CACHED_UNIT_EFFECTS)
def _with_unit_noise_size(effect: Effect) -> Effect:
    """Return a noise effect of size one, for use in a cache key."""
    return with_effect_size(effect, 1.0)


@lru_cache(MAX_CACHED_UNIT_EFFECTS)
def _with_unit_size(regressor: Regressor) -> Regressor:
    """Return the regressor of the effect with size one, which serves as a cache key."""
    effect, at = regressor
    return with_regression_coefficients(effect, np.ones(MAX_REGRESSORS)), at
