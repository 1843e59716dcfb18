"""Noise coefficients of a recording after removal of the temperature dependence of the bias.

``fit_thermal_model`` decides whether the bias of an axis depends on temperature. The thermal model of a significant
dependence is subtracted from the samples, and the noise coefficients are computed again. A thermal model can follow
part of a random walk by chance. A change of K or R by a few percent is therefore not significant.
"""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import NotReady
from monitor.drift.thermal.interval_means import BLOCK_SAMPLES, compute_interval_means
from monitor.drift.thermal.thermal_fit import MIN_SWING_C, ThermalFit, fit_thermal_model
from monitor.drift.thermal.thermal_model import predict_interval_means
from monitor.drift.thermal.thermal_results import choose_interval_s
from monitor.estimation.analysis import RecordingAnalysis, fit_other_samples
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status

SLOW_LETTERS: Final = ("B", "K", "R")
MAIN_SHARE: Final = 0.5
"""Minimum explained share of the variance at which temperature is said to explain most of the variance."""


@dataclass(frozen=True, slots=True)
class TemperatureDependence:
    """Significant dependence of a bias on temperature."""

    share: float  # share of the variance of the interval means that temperature explains
    p_value: float  # p-value of the null hypothesis that the bias does not depend on temperature
    form: str  # name of the thermal model, with " with hysteresis" if heating and cooling differ
    one_way: bool  # True if the temperature only rose or only fell
    interval_s: float

    @property
    def explains_most_variance(self) -> bool:
        """Return True if temperature explains at least half of the bias variance."""
        return self.share >= MAIN_SHARE


@dataclass(frozen=True, slots=True)
class TemperatureRemovalComparison:
    """Temperature dependence of each axis, and noise coefficients before and after its removal."""

    models: Mapping[str, str]  # form of the thermal model by axis, for axes with a fitted model
    before: Coefficients
    coefficients: Coefficients
    k_or_r: tuple[bool, ...]  # [6] True if K and R cannot be distinguished, as in ``Estimate``
    dependences: Mapping[str, TemperatureDependence] = field(default_factory=dict)  # significant dependences by axis

    @property
    def axes_explained_by_temperature(self) -> tuple[str, ...]:
        """Return the axes on which temperature explains at least half of the bias variance."""
        return tuple(axis for axis, one in self.dependences.items() if one.explains_most_variance)

    def variance_share_of_temperature(self, letter: str, axis: str) -> float | None:
        """Return the share 1 − after²/before² of a squared noise coefficient that temperature explains.

        If only an upper bound of the coefficient is known after the removal, the share is a lower bound.

        Parameters
        ----------
        letter : str
            Symbol of the coefficient, one of SYMBOLS.
        axis : str
            Name of the axis.

        Returns
        -------
        float or None
            Share from 0 to 1, or None if the coefficient is not known both before and after the removal.
        """
        at = SYMBOLS.index(letter), AXES.index(axis)
        if self.before.status[at] != Status.ESTIMATED or self.coefficients.status[at] == Status.UNESTIMATED:
            return None
        bounded = self.coefficients.status[at] == Status.UPPER_BOUND
        after = float((self.coefficients.hi if bounded else self.coefficients.value)[at])
        return max(1.0 - (after / float(self.before.value[at])) ** 2, 0.0)

    def coefficient_decreased_significantly(self, letter: str, axis: str) -> bool:
        """Return True if removing the temperature dependence has reduced a noise coefficient significantly.

        The reduction is significant if the confidence intervals before and after the removal do not overlap.

        Parameters
        ----------
        letter : str
            Symbol of the coefficient, one of SYMBOLS.
        axis : str
            Name of the axis.
        """
        at = SYMBOLS.index(letter), AXES.index(axis)
        return self.variance_share_of_temperature(letter, axis) is not None and bool(
            self.coefficients.hi[at] < self.before.lo[at]
        )


def temperature_varied(temperatures_c: Floats) -> bool:
    """Return True if the temperatures [n] in °C are known and vary by more than MIN_SWING_C."""
    return (
        bool(np.isfinite(temperatures_c).any())
        and float(np.ptp(temperatures_c[np.isfinite(temperatures_c)])) > MIN_SWING_C
    )


def remove_temperature_effect(analysis: RecordingAnalysis) -> TemperatureRemovalComparison | None:
    """Compute the noise coefficients of a recording after removal of the temperature dependence of the bias.

    The result is None if the temperature is missing or constant, or if no axis depends on it.
    """
    temperature_c, rate_hz = analysis.temperature_c, analysis.estimate.rate_hz
    if not temperature_varied(temperature_c):
        return None
    interval_s = choose_interval_s(len(analysis.values) / rate_hz, rate_hz)
    models, dependences = dict[str, str](), dict[str, TemperatureDependence]()
    after, k_or_r = deepcopy(analysis.estimate.coefficients), list(map(bool, analysis.estimate.k_or_r))
    for at, axis in enumerate(AXES):
        samples = analysis.values[:, at]
        means = compute_interval_means(samples, temperature_c, rate_hz, interval_s)
        try:
            found = fit_thermal_model(means)
        except NotReady:
            continue
        dependence = find_temperature_dependence(found)
        if dependence is None:
            continue
        dependences[axis], model = dependence, found.model
        if not model.shape.is_constant:
            models[axis] = model.shape.name
            course = predict_interval_means(model, means.temperature_c, starts_with_fit=True).bias
            effect = interpolate_with_zero_mean(course, round(means.interval_s * rate_hz), len(samples))
            fit = fit_other_samples(analysis, (samples - effect)[:, None])
            k_or_r[at] = bool(fit.k_or_r[0])
            for one in fields(after):
                getattr(after, one.name)[:, at] = getattr(fit.coefficients, one.name)[:, 0]
    if not dependences:
        return None
    return TemperatureRemovalComparison(models, analysis.estimate.coefficients, after, tuple(k_or_r), dependences)


def find_temperature_dependence(found: ThermalFit) -> TemperatureDependence | None:
    """Return the dependence of a bias on temperature that a thermal fit found, or None if there is none."""
    shape = found.model.shape
    loop = found.hysteresis if found.hysteresis is not None and found.hysteresis.is_significant else None
    if shape.is_constant and loop is None:
        return None
    if loop is None or loop.share < found.explained + 0.01:  # prefer the simpler form
        return TemperatureDependence(
            found.explained, found.p_value, shape.name, not found.temperature_rose_and_fell, found.model.interval_s
        )
    return TemperatureDependence(
        loop.share,
        loop.p_value,
        f"{shape.name} with hysteresis",
        not found.temperature_rose_and_fell,
        found.model.interval_s,
    )


def interpolate_with_zero_mean(interval_values: Floats, interval_samples: int, n_samples: int) -> Floats:
    """Interpolate interval values to samples with a natural cubic spline, and subtract the mean.

    The spline takes the interval values at the centres of the intervals. It continues linearly before the first and
    after the last centre.

    Parameters
    ----------
    interval_values : ndarray, shape (intervals,)
        Values of at least two intervals.
    interval_samples : int
        Number of samples per interval.
    n_samples : int
        Number of samples.

    Examples
    --------
    >>> interpolate_with_zero_mean(np.array([1.0, 3.0, 5.0]), 2, 6).tolist()
    [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    """
    bend = _natural_spline(interval_values)
    first = interval_values[1] - interval_values[0] - bend[1] / 6.0
    last = interval_values[-1] - interval_values[-2] + bend[-2] / 6.0
    made = np.empty(n_samples)
    for begin in range(0, n_samples, BLOCK_SAMPLES):  # intermediate results of all samples would need much memory
        block = made[begin : begin + BLOCK_SAMPLES]
        at = (np.arange(begin, begin + block.size) + 0.5) / interval_samples - 0.5  # intervals from the first centre
        left = np.clip(at.astype(np.int64), 0, interval_values.size - 2)
        right = left + 1
        t = np.clip(at, 0.0, interval_values.size - 1.0) - left
        block[:] = (1.0 - t) * interval_values[left] + t * interval_values[right]
        block += ((1.0 - t) ** 3 - (1.0 - t)) / 6.0 * bend[left] + (t**3 - t) / 6.0 * bend[right]
        block += first * np.minimum(at, 0.0) + last * np.maximum(at - (interval_values.size - 1.0), 0.0)
    made -= made.mean()
    return made


def _natural_spline(y: Floats) -> Floats:
    """Return the second derivatives of the natural cubic spline through equidistant values y [n ≥ 2].

    The derivatives solve the tridiagonal system (1, 4, 1) / 6 (de Boor, A Practical Guide to Splines, 1978, chapter
    IV).

    >>> _natural_spline(np.array([0.0, 1.0, 0.0])).tolist()
    [0.0, -3.0, 0.0]
    """
    inner = y.size - 2
    matrix = 4.0 * np.eye(inner) + np.eye(inner, k=1) + np.eye(inner, k=-1)
    return np.pad(np.linalg.solve(matrix, 6.0 * np.diff(y, 2)), 1)
