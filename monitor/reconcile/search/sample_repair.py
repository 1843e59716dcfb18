"""Replacement of missing, wrong and clipped samples by random samples with the same statistics.

``fill_missing_samples`` adds a random deviation to the mean of neighbouring samples. The deviation is taken from a
randomly chosen valid sample (**donor**). Mean level, drift and white noise therefore continue through missing samples.
A long run of missing samples is filled with successive samples from the neighbourhood, so that the spectrum of the
noise continues too.

The deviations of single donors are white, so they would raise the spectrum where the noise is weak, for example beyond
the cutoff of a low-pass filter. ``draw_missing_samples`` therefore draws the missing samples again from their
distribution, given the samples that are present and the spectrum of the noise.

``restore_clipped_samples`` replaces each clipped sample by a random sample from the tail of a Gaussian.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled
from monitor.noise.effects import Outliers, RandomSampleHold, Saturation, WanderingLine
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects, RegressorCache
from monitor.reconcile.likelihood.effect_roles import is_noise_effect, is_stationary_gaussian
from monitor.reconcile.likelihood.hypothesis_fit import fit_deterministic_effects
from monitor.reconcile.likelihood.wandering_line_vs_resonance import draw_wandering_line
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.preparation.cosine_bins import (
    MIN_POWER,
    build_frequency_bins,
    cosine_transform,
    inverse_cosine_transform,
)
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.preparation.value_artifacts import Mask, ValueArtifacts

NEIGHBOURHOOD_WIDTHS: Final = (1024, 256, 64, 16, 4)
"""Possible numbers of neighbours on each side, in descending order."""
MAX_VARIANCE_RATIO: Final = 1.01
"""Largest prediction variance of a neighbourhood, relative to the best neighbourhood.
"""
MAX_WIDTH_TEST_SAMPLES: Final = 20_000
DONOR_RANGE_SAMPLES: Final = 1024
"""Number of valid samples on each side from which the donor is chosen."""
LONG_GAP_SAMPLES: Final = 100
"""Number of consecutive missing samples above which successive samples are copied."""
SPECTRUM_DRAWS: Final = 8
"""Number of times that the missing samples are drawn if the spectrum is estimated from the filled series.

At 10 % random loss, each draw reduces the error of the spectrum to about a third.
"""
MAX_DEVIANCE_NATS_PER_BIN: Final = 1.0
"""Largest deviance between series and model for a draw with the spectrum of the model.

The expectation for the true model is 0.5 nats, and 0.64 nats in a bin with a single coefficient.
"""
MIN_POWER_RATIO: Final = 1e-6
"""Smallest power of a frequency bin relative to the mean, which limits the condition of the equations."""
MAX_SOLVER_ITERATIONS: Final = 300
SOLVER_TOLERANCE: Final = 1e-3
"""Largest residual of the equations, in units of its standard deviation for a random draw."""
CLIP_LEVEL_SAMPLES: Final = 64
"""Number of samples on each side that determine the mean level of clipped samples."""
MAX_CLIP_ITERATIONS: Final = 50
CLIP_TOLERANCE_SIGMA: Final = 1e-2
"""Largest change of a sample, in standard deviations, at convergence."""
CLIP_RELATIVE_TOLERANCE: Final = 1e-9
"""Relative distance from the limit within which a sample is clipped."""
MAX_SIGMA_ITERATIONS: Final = 40
SIGMA_RELATIVE_TOLERANCE: Final = 5e-4


def fill_missing_samples(y: Floats, replace_mask: Mask, rng: np.random.Generator) -> Floats:
    """Return a copy of a series with masked and non-finite samples replaced.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis.
    replace_mask : ndarray of bool, shape (n,)
        True for each sample to be replaced.
    rng : numpy.random.Generator
        Generator for the replacement samples.

    Returns
    -------
    ndarray of float64, shape (n,)
        Series without missing samples.

    Raises
    ------
    ValueError
        If the series contains no valid sample.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> y = 5.0 + rng.standard_normal(100_000)
    >>> new = fill_missing_samples(y, rng.random(100_000) < 0.3, rng)
    >>> print(f"{new.mean():.2f} {new.std():.2f}")
    5.00 1.00
    """
    good = np.isfinite(y) & ~replace_mask
    missing = np.flatnonzero(~good)
    new = y.copy()
    if not missing.size:
        return new
    where = np.flatnonzero(good)
    if not where.size:
        raise ValueError("the series contains no good sample")
    middle = float(y[where[where.size // 2]])
    sums, counts = _running_sums(y, good, middle)
    width = _neighbourhood_width(y, where, sums, counts, middle)
    breaks = np.flatnonzero(np.diff(missing) > 1)
    firsts = missing[np.concatenate([[0], breaks + 1])]
    lasts = missing[np.concatenate([breaks, [missing.size - 1]])]
    is_long = lasts - firsts >= LONG_GAP_SAMPLES
    short = missing[~np.repeat(is_long, lasts - firsts + 1)]
    _draw_missing(new, where, short, sums, counts, middle, width, rng.random(short.size))
    known = np.ones(y.size, np.bool_)
    known[missing[np.repeat(is_long, lasts - firsts + 1)]] = False
    known_at = np.flatnonzero(known)
    for first, last in zip(firsts[is_long].tolist(), lasts[is_long].tolist(), strict=True):
        _copy_samples(new, known_at, first, last, width, rng)
    return new


def _copy_samples(new: Floats, known_at: Ints, first: int, last: int, width: int, rng: np.random.Generator) -> None:
    """Fill a long run of missing samples with successive samples from the side of the run with more samples.

    A linear trend is added to the copied samples, so that the mean levels beside their original place match those
    beside the run. If there are too few samples, they are extended with their mirror image.

    Parameters
    ----------
    new : ndarray of float64, shape (n,)
        Series, which is changed in place.
    known_at : ndarray of int64, shape (m,)
        Indices of the samples that are not part of a long run.
    first, last : int
        First and last missing sample.
    width : int
        Number of samples that determine the mean level.
    rng : numpy.random.Generator
        Generator for the place of the copied samples.
    """
    length, place = last - first + 1, int(np.searchsorted(known_at, first))
    left, right = new[known_at[max(place - width, 0) : place]], new[known_at[place : place + width]]
    size = length + left.size + right.size
    reach, use_before = size + DONOR_RANGE_SAMPLES, 2 * place > known_at.size
    chosen = known_at[max(place - reach, 0) : place][::-1] if use_before else known_at[place : place + reach]
    near = np.pad(new[chosen], (0, max(size - chosen.size, 0)), "reflect" if chosen.size > 1 else "edge")
    start = int(rng.integers(near.size - size + 1))
    copied = near[start : start + size]
    copied = copied[::-1] if use_before else copied
    ends = [
        float(beside.mean() - one.mean())
        for beside, one in ((left, copied[: left.size]), (right, copied[size - right.size :]))
        if beside.size
    ]
    part = np.arange(1, length + 1) / (length + 1)
    new[first : last + 1] = copied[left.size : left.size + length] + ends[0] + (ends[-1] - ends[0]) * part


def restore_clipped_samples(y: Floats, limit: float, sigma: float, rng: np.random.Generator) -> Floats:
    """Return a copy of a series with each clipped sample replaced by a random sample beyond the limit.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Series in the unit of the axis. NaN values are kept.
    limit : float
        Limit of the measuring range, in the unit of ``y``. Samples at or beyond ± limit are replaced.
    sigma : float
        Standard deviation of the noise before clipping, in the unit of ``y``.
    rng : numpy.random.Generator
        Generator for the replacement samples.

    Returns
    -------
    ndarray of float64, shape (n,)
        Series with random samples beyond the limit.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = 0.5 + rng.standard_normal(100_000)
    >>> new = restore_clipped_samples(np.clip(x, -1.0, 1.0), 1.0, 1.0, rng)
    >>> print(f"{new.mean():.2f} {new.std():.2f}")
    0.50 1.00
    """
    new = y.copy()
    at = np.flatnonzero(np.abs(y) >= limit * (1.0 - 1e-9))
    if not at.size:
        return new
    side = np.sign(y[at])
    good = np.isfinite(y)
    for _ in range(MAX_CLIP_ITERATIONS):
        level = _local_means(new, good, at)
        beyond = (limit - side * level) / sigma
        # mean of the Gaussian tail: m + σ φ(a)/Φ(−a)
        tail = level + side * sigma * np.exp(-0.5 * beyond**2 - log_ndtr(-beyond)) / np.sqrt(2.0 * np.pi)
        moved = float(np.abs(tail - new[at]).max())
        new[at] = tail
        if moved < CLIP_TOLERANCE_SIGMA * sigma:
            break
    beyond = (limit - side * _local_means(new, good, at)) / sigma
    chance = (1.0 - rng.random(at.size)) * ndtr(-np.minimum(beyond, 37.0))
    new[at] = side * (limit + sigma * np.maximum(-ndtri(chance) - np.minimum(beyond, 37.0), 0.0))
    return new


def _local_means(y: Floats, good: Mask, at: Ints) -> Floats:
    """Return the means of the valid samples within ``CLIP_LEVEL_SAMPLES`` samples of given positions."""
    sums, counts = _running_sums(y, good, 0.0)
    lo, hi = np.maximum(at - CLIP_LEVEL_SAMPLES, 0), np.minimum(at + CLIP_LEVEL_SAMPLES + 1, y.size)
    return np.asarray((sums[hi] - sums[lo]) / (counts[hi] - counts[lo]))


@compiled
def _running_sums(y: Floats, good: Mask, middle: float) -> tuple[Floats, Ints]:
    """Return running sums and running counts of the valid samples, after subtraction of ``middle``."""
    sums, counts = np.empty(y.size + 1), np.empty(y.size + 1, np.int64)
    total, count = 0.0, 0
    for k in range(y.size):
        sums[k], counts[k] = total, count
        if good[k]:
            total += y[k] - middle
            count += 1
    sums[-1], counts[-1] = total, count
    return sums, counts


def _neighbourhood_width(y: Floats, where: Ints, sums: Floats, counts: Ints, middle: float) -> int:
    """Return the largest neighbourhood width whose mean predicts a sample nearly as well as the best width."""
    some = where[:: max(1, where.size // MAX_WIDTH_TEST_SAMPLES)]
    errors = []
    for width in NEIGHBOURHOOD_WIDTHS:
        lo, hi = np.maximum(some - width, 0), np.minimum(some + width + 1, y.size)
        others = counts[hi] - counts[lo] - 1
        some_, lo, hi, others = (x[others > 0] for x in (some, lo, hi, others))
        value = y[some_] - middle
        predicted = (sums[hi] - sums[lo] - value) / others
        # the mean of k samples adds 1/k of the variance of one sample
        errors.append(float(np.mean((value - predicted) ** 2 / (1.0 + 1.0 / others))) if some_.size else np.inf)
    return next(
        width
        for width, error in zip(NEIGHBOURHOOD_WIDTHS, errors, strict=True)
        if error <= MAX_VARIANCE_RATIO * min(errors)
    )


@compiled
def _draw_missing(
    new: Floats, where: Ints, missing: Ints, sums: Floats, counts: Ints, middle: float, width: int, chances: Floats
) -> None:
    n = new.size
    for k in range(missing.size):
        at = missing[k]
        # use the nearest good samples, ``width`` on each side
        left = counts[at]
        first, last = max(left - width, 0), min(left + width, where.size)
        before, after = left - first, last - left
        lo = where[first]
        hi = where[last - 1] + 1
        level = (sums[hi] - sums[lo]) / (before + after)
        used = float(before + after)
        pool, stop = max(left - DONOR_RANGE_SAMPLES, 0), min(left + DONOR_RANGE_SAMPLES, where.size)
        donor = where[pool + int(chances[k] * (stop - pool))]
        from_, to = max(donor - width, 0), min(donor + width + 1, n)
        others = counts[to] - counts[from_]
        away = new[donor] - middle - (sums[to] - sums[from_]) / others
        # scale the deviation of the donor so that the variance of the new sample equals the variance of a valid sample
        grown = 1.0
        if used > 1.0 and others > 1:
            grown = ((1.0 - 1.0 / used) / (1.0 - 1.0 / others)) ** 0.5
        new[at] = middle + level + grown * away


def build_repaired_axes(
    recording: RecordedAxes, effects: Mapping[str, Effects], regressors: RegressorCache, rng: np.random.Generator
) -> dict[str, Axis]:
    """Build the axes of one recording with repaired samples.

    Parameters
    ----------
    recording : RecordedAxes
        Measured or simulated recording without missing temperatures.
    effects : mapping of str to tuple of Effect
        Effects of each axis in the model.
    regressors : RegressorCache
        Cached regressors for the same length, sample rate and temperature.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    raw = recording.values
    bins = build_frequency_bins(recording.sample_count, recording.rate_hz)
    statistics = {name: ValueArtifacts(y) for name, y in raw.items()}
    repaired = {name: _repair_samples(y, statistics[name], effects[name], rng) for name, y in raw.items()}
    coefficients = {name: cosine_transform(y) for name, y in repaired.items()}
    axes = {}
    for name, y in raw.items():
        others = {other: one for other, one in coefficients.items() if _may_leak(other, name)}
        axis = Axis(
            name,
            y,
            repaired[name],
            coefficients[name],
            bins,
            others,
            recording.temperature_c,
            statistics[name],
            regressors,
            is_temperature_coarse=recording.is_temperature_coarse,
        )
        axes[name] = _repair_by_effects(axis, effects[name], rng)
    return axes


def repair_axis_again(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """Repair the measured samples of an axis again for another set of effects.

    Parameters
    ----------
    axis : Axis
        Axis with the measured samples.
    effects : tuple of Effect
        Effects of the axis.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    repaired = axis.with_repaired_samples(_repair_samples(axis.raw, axis.value_artifacts, effects, rng))
    return _repair_by_effects(repaired, effects, rng)


def _repair_by_effects(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    axis = draw_missing_samples(axis, effects, rng)
    return _replace_outliers(_subtract_wandering_lines(axis, effects, rng), effects, rng)


def draw_missing_samples(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """Draw the missing samples from their distribution, given the present samples and the spectrum of the noise.

    For Gaussian noise with the precision matrix Q, let z be a series with the same spectrum. The missing samples y of
    the draw then minimise (y − z)ᵀ Q (y − z), while the other samples stay fixed (Hoffman & Ribak, "Constrained
    realizations of Gaussian fields", Astrophys. J. 380, 1991).

    The spectrum is the one of the model. If the filled series contradicts this spectrum, the spectrum is estimated from
    the filled series instead. The series z is then the filled series at a random lag, so that the draw keeps the local
    level of the noise and heavy tails.

    Parameters
    ----------
    axis : Axis
        Axis whose missing samples have been filled.
    effects : tuple of Effect
        Effects of the axis in the model.
    rng : numpy.random.Generator
        Generator of z.
    """
    missing = np.flatnonzero(~np.isfinite(axis.raw))
    if not missing.size:
        return axis
    if any(is_noise_effect(effect) for effect in effects) and is_stationary_gaussian(effects):
        fit = fit_deterministic_effects(axis, effects)
        noise = fit.cosine_transform_without_deterministic_effects()
        spectrum = _expand_spectrum(axis, fit.whittle.variance)
        template = inverse_cosine_transform(np.sqrt(spectrum) * rng.standard_normal(noise.size))
        drawn = _draw_given_spectrum(axis, inverse_cosine_transform(noise), template, spectrum, missing)
        if _fits_spectrum(fit_deterministic_effects(drawn, effects)):
            return drawn
    for _ in range(SPECTRUM_DRAWS):
        series = inverse_cosine_transform(axis.coefficients)
        spectrum = _expand_spectrum(axis, axis.bins.smoothed_mean_square(axis.coefficients))
        lag = int(rng.integers(DONOR_RANGE_SAMPLES // 4, DONOR_RANGE_SAMPLES))
        template = np.concatenate([series[lag:], series[: -lag - 1 : -1]])
        axis = _draw_given_spectrum(axis, series, template, spectrum, missing)
    return axis


def _expand_spectrum(axis: Axis, variance: Floats) -> Floats:
    """Return the variance of each coefficient, shape (n − 1,), with a lower limit."""
    limit = MIN_POWER_RATIO * float(variance @ axis.bins.count) / float(axis.bins.count.sum())
    return axis.bins.expand_to_coefficients(np.maximum(variance, max(limit, MIN_POWER)))


def _fits_spectrum(fit: AxisFit) -> bool:
    """Return True if the power in the frequency bins agrees with the spectrum of the model."""
    used = fit.axis.used_count > 0.0
    ratio = np.maximum(fit.whittle.residual, MIN_POWER)[used] / (fit.axis.used_count * fit.whittle.variance)[used]
    deviance = 0.5 * float((fit.axis.used_count[used] * (ratio - 1.0 - np.log(ratio))).sum())
    return deviance < MAX_DEVIANCE_NATS_PER_BIN * float(used.sum())


def _draw_given_spectrum(axis: Axis, series: Floats, template: Floats, spectrum: Floats, missing: Ints) -> Axis:
    difference = series - template
    _minimise_at_missing(difference, missing, 1.0 / spectrum)
    repaired = axis.repaired.copy()
    repaired[missing] += template[missing] + difference[missing] - series[missing]
    return axis.with_repaired_samples(repaired)


def _minimise_at_missing(x: Floats, missing: Ints, weights: Floats) -> None:
    """Minimise Σ w_k X_k² over the missing samples of a series x by conjugate gradients. X is the cosine transform."""

    def gradient(step: Floats) -> Floats:
        return inverse_cosine_transform(weights * cosine_transform(step))[missing]

    left = -gradient(x)
    direction, square = left, float(left @ left)
    step = np.zeros_like(x)
    for _ in range(MAX_SOLVER_ITERATIONS):
        if square <= SOLVER_TOLERANCE**2 * missing.size * float(weights.mean()):
            return
        step[missing] = direction
        turned = gradient(step)
        size = square / float(direction @ turned)
        x[missing] += size * direction
        left = left - size * turned
        before, square = square, float(left @ left)
        direction = left + square / before * direction


def _may_leak(source: str, axis: str) -> bool:
    """Return True if one axis can leak into another axis. A gyroscope never leaks into an accelerometer."""
    return source != axis and (axis.startswith("g") or source.startswith("a"))


def _repair_samples(y: Floats, statistics: ValueArtifacts, effects: Effects, rng: np.random.Generator) -> Floats:
    """Replace missing samples. Also replace repeated or clipped samples if one of the effects causes them."""
    missing = ~np.isfinite(y)
    types = {type(effect) for effect in effects}
    if RandomSampleHold in types and statistics.repeats:
        missing = missing | statistics.repeats.mask
    repaired = fill_missing_samples(y, missing, rng)
    if Saturation not in types or statistics.clipping is None or not statistics.clipping.symmetric:
        return repaired
    return _restore_clipped_samples(repaired, statistics.clipping.limit.value, rng)


def _restore_clipped_samples(y: Floats, limit: float, rng: np.random.Generator) -> Floats:
    """Restore the clipped samples repeatedly until the standard deviation of the noise converges."""
    inside = np.abs(y) < limit * (1.0 - CLIP_RELATIVE_TOLERANCE)
    sigma = float(np.std(np.diff(y)[inside[1:] & inside[:-1]])) / 2.0**0.5
    whole = y
    for _ in range(MAX_SIGMA_ITERATIONS):
        whole = restore_clipped_samples(y, limit, sigma, rng)
        before, sigma = sigma, float(np.std(np.diff(whole))) / 2.0**0.5
        if abs(sigma - before) < SIGMA_RELATIVE_TOLERANCE * sigma:
            break
    return whole


def _subtract_wandering_lines(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    for line in effects:
        if isinstance(line, WanderingLine):
            series = inverse_cosine_transform(
                fit_deterministic_effects(axis, effects).cosine_transform_without_deterministic_effects()
            )
            axis = axis.with_repaired_samples(axis.repaired - draw_wandering_line(series, axis.rate_hz, line, rng))
    return axis


def _replace_outliers(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    if not any(isinstance(effect, Outliers) for effect in effects):
        return axis
    found = whiten_axis(fit_deterministic_effects(axis, effects)).outlier_fit
    return axis if found is None else axis.with_repaired_samples(fill_missing_samples(axis.repaired, found.mask, rng))
