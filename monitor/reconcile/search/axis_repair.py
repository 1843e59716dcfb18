"""Preparation of the axes of a recording: replace missing samples and samples that the model describes as wrong.

Missing samples are replaced by random draws from their neighbourhood. The positions of repeats of continuous values are
known, and these samples are treated as missing. Outliers are detected in the whitened axis and are also treated as
missing. Clipped samples are drawn from beyond the limit. Measured and simulated recordings are prepared in the same
way, each with its own model. The spectrum then describes the remaining effects.
"""

from collections.abc import Mapping
from typing import Final, TypeVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Outliers, RandomSampleHold, Saturation
from monitor.reconcile.likelihood.axis import Axis, Effects, RegressorCache, ValueStatistics
from monitor.reconcile.likelihood.hypothesis import fit_with_fixed_noise
from monitor.reconcile.likelihood.outlier_statistics import fit_outliers
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.preparation.cosine_bins import cosine_transform, frequency_bins
from monitor.reconcile.preparation.recording import Recording
from monitor.reconcile.preparation.sample_repair import fill_missing, restore_clipped
from monitor.reconcile.preparation.value_statistics import detect_clipping, detect_quantization, detect_repeats

CLIP_RELATIVE_TOLERANCE: Final = 1e-9
"""Relative distance to the limit below which a sample counts as clipped."""
MAX_SIGMA_ITERATIONS: Final = 40
"""Largest number of iterations between clipped samples and their standard deviation."""
SIGMA_RELATIVE_TOLERANCE: Final = 5e-4
"""Relative change of the standard deviation that ends the iterations."""
E = TypeVar("E", bound=Effect)


def build_repaired_axes(
    recording: Recording, effects: Mapping[str, Effects], regressors: RegressorCache, rng: np.random.Generator
) -> dict[str, Axis]:
    """Return the prepared axes of one recording.

    Parameters
    ----------
    recording : Recording
        Measured or simulated recording. The temperature must not have missing samples.
    effects : mapping of str to tuple of Effect
        Effects of each axis according to the model.
    regressors : RegressorCache
        Cached regressors for the same length, sample rate and temperature.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    raw = recording.values
    bins = frequency_bins(recording.samples, recording.rate_hz)
    statistics = {name: measure_value_statistics(y) for name, y in raw.items()}
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
        axes[name] = _replace_outliers(axis, effects[name], rng)
    return axes


def repair_axis_again(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """Return the same axis, repaired for other effects.

    Parameters
    ----------
    axis : Axis
        Axis to repair again from the measured samples.
    effects : tuple of Effect
        Effects of the axis.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    return _replace_outliers(
        axis.with_samples(_repair_samples(axis.raw, axis.value_statistics, effects, rng)), effects, rng
    )


def _may_leak(source: str, axis: str) -> bool:
    """Return True if one axis may leak into another.

    Gyroscopes and accelerometers leak into their own kind. Accelerometers also leak into gyroscopes.
    """
    return source != axis and (axis.startswith("g") or source.startswith("a"))


def measure_value_statistics(y: Floats) -> ValueStatistics:
    """Return the quantization, clipping and repeats of measured samples ``y``, shape (n,), in rad/s or m/s²."""
    grid = detect_quantization(y)
    step = grid.step.value if grid else 0.0
    ends = detect_clipping(y, step)
    return ValueStatistics(grid, ends, detect_repeats(y, step, ends.limit.value if ends and ends.symmetric else np.inf))


def _repair_samples(y: Floats, statistics: ValueStatistics, effects: Effects, rng: np.random.Generator) -> Floats:
    """Return the samples ``y``, shape (n,), with missing, repeated and clipped samples replaced.

    Repeats and clipping are repaired only if they are among the effects.
    """
    missing = ~np.isfinite(y)
    if _first_of_type(effects, RandomSampleHold) and statistics.repeats:
        missing = missing | statistics.repeats.mask
    repaired = fill_missing(y, missing, rng)
    limit = _first_of_type(effects, Saturation)
    if limit is None or statistics.clipping is None or not statistics.clipping.symmetric:
        return repaired
    return _restore_clipped(repaired, statistics.clipping.limit.value, rng)


def _restore_clipped(y: Floats, limit: float, rng: np.random.Generator) -> Floats:
    """Redraw the clipped samples and update the standard deviation in turns until it converges.

    A few iterations suffice if few samples were clipped.
    """
    inside = np.abs(y) < limit * (1.0 - CLIP_RELATIVE_TOLERANCE)
    sigma = float(np.std(np.diff(y)[inside[1:] & inside[:-1]])) / 2.0**0.5
    whole = y
    for _ in range(MAX_SIGMA_ITERATIONS):
        whole = restore_clipped(y, limit, sigma, rng)
        before, sigma = sigma, float(np.std(np.diff(whole))) / 2.0**0.5
        if abs(sigma - before) < SIGMA_RELATIVE_TOLERANCE * sigma:
            break
    return whole


def _replace_outliers(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """Return the axis with the outliers replaced, if the effects include outliers."""
    if _first_of_type(effects, Outliers) is None:
        return axis
    found = fit_outliers(whiten_axis(fit_with_fixed_noise(axis, effects).fit).flat_series)
    return axis if found is None else axis.with_samples(fill_missing(axis.repaired, found.mask, rng))


def _first_of_type(effects: Effects, kind: type[E]) -> E | None:
    """Return the first effect of a type, or None."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)
