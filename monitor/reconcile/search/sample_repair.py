"""Replacement of the missing and altered samples of an axis.

Missing samples are always replaced. Repeated, outlying and clipped samples are replaced if an effect of the axis causes
such samples. A wandering line of the axis is drawn from its distribution given the data, and the drawn line is
subtracted. Measured and simulated recordings are repaired in the same way.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effects import Outliers, RandomSampleHold, Saturation, WanderingLine
from monitor.reconcile.likelihood.axis_fit import Axis, Effects, RegressorCache
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_fixed_noise
from monitor.reconcile.likelihood.outlier_fit import fit_outliers
from monitor.reconcile.likelihood.wandering_line_vs_resonance import draw_wandering_line
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.preparation.cosine_bins import (
    build_frequency_bins,
    cosine_transform,
    inverse_cosine_transform,
)
from monitor.reconcile.preparation.reconcile_input import Recording
from monitor.reconcile.preparation.sample_repair import fill_missing_samples, restore_clipped_samples
from monitor.reconcile.preparation.value_artifacts import ValueArtifacts

CLIP_RELATIVE_TOLERANCE: Final = 1e-9
"""Relative distance from the limit within which a sample is clipped."""
MAX_SIGMA_ITERATIONS: Final = 40
SIGMA_RELATIVE_TOLERANCE: Final = 5e-4


def build_repaired_axes(
    recording: Recording, effects: Mapping[str, Effects], regressors: RegressorCache, rng: np.random.Generator
) -> dict[str, Axis]:
    """Build the axes of one recording with repaired samples.

    Parameters
    ----------
    recording : Recording
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
        )
        axes[name] = _replace_outliers(_subtract_wandering_lines(axis, effects[name], rng), effects[name], rng)
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
    return _replace_outliers(_subtract_wandering_lines(repaired, effects, rng), effects, rng)


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
                fit_with_fixed_noise(axis, effects).fit.cosine_transform_without_deterministic_effects()
            )
            axis = axis.with_repaired_samples(axis.repaired - draw_wandering_line(series, axis.rate_hz, line, rng))
    return axis


def _replace_outliers(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    if not any(isinstance(effect, Outliers) for effect in effects):
        return axis
    found = fit_outliers(whiten_axis(fit_with_fixed_noise(axis, effects).fit).flat_series)
    return axis if found is None else axis.with_repaired_samples(fill_missing_samples(axis.repaired, found.mask, rng))
