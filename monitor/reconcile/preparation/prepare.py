"""Preparation of a recording: replace missing samples and samples that the model describes as wrong.

Missing samples are replaced by random draws from their neighbourhood. The positions of repeats of continuous values are
known, and these samples are treated as missing. Outliers are also treated as missing, once the axis is white enough to
detect them. Clipped samples are drawn from beyond the limit. Measured and simulated recordings are prepared in the same
way, each with its own model. The spectrum then describes the remaining effects.
"""

from collections.abc import Mapping
from typing import Final, TypeVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Outliers, SampleHold, Saturation
from monitor.reconcile.diagnostics.diagnostics import whiten_axis
from monitor.reconcile.likelihood.hypothesis import fit_with_given_sizes
from monitor.reconcile.likelihood.outlier_statistics import fit_outliers
from monitor.reconcile.preparation.axis import Axis, Effects, RegressorCache, ValueStatistics
from monitor.reconcile.preparation.cosine_bins import Bins, cosine_transform, frequency_bins
from monitor.reconcile.preparation.sample_repair import fill_missing, restore_clipped
from monitor.reconcile.preparation.value_statistics import detect_clipping, detect_quantization, detect_repeats

MIN_SAMPLES: Final = 4096
"""Smallest number of samples. With fewer samples, neither a spectrum nor a spectrogram is meaningful."""
CLIP_RELATIVE_TOLERANCE: Final = 1e-9
"""Relative distance to the limit below which a sample counts as clipped."""
MAX_SIGMA_ITERATIONS: Final = 40
"""Largest number of iterations between clipped samples and their standard deviation."""
SIGMA_RELATIVE_TOLERANCE: Final = 5e-4
"""Relative change of the standard deviation that ends the iterations."""
E = TypeVar("E", bound=Effect)


def prepare_axes(
    raw: Mapping[str, Floats],
    rate_hz: float,
    effects: Mapping[str, Effects],
    temperature_c: Floats | None,
    courses: RegressorCache,
    rng: np.random.Generator,
) -> dict[str, Axis]:
    """Return the prepared axes of one recording.

    Parameters
    ----------
    raw : mapping of str to ndarray of float64, shape (n,)
        Samples of each axis in rad/s or m/s². NaN marks a missing sample.
    rate_hz : float
        Sample rate in Hz.
    effects : mapping of str to tuple of Effect
        Effects of each axis according to the model.
    temperature_c : ndarray of float64, shape (n,), or None
        Temperature in °C without missing samples.
    courses : Courses
        Cached regressors for the same length, sample rate and temperature.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    even = frequency_bins(len(next(iter(raw.values()))), rate_hz)
    shown = {name: measure_value_statistics(y) for name, y in raw.items()}
    mended = {name: repair_samples(y, shown[name], effects[name], rng) for name, y in raw.items()}
    coefficients = {name: cosine_transform(y) for name, y in mended.items()}
    axes = {}
    for name, y in raw.items():
        others = {other: one for other, one in coefficients.items() if may_leak(other, name)}
        axis = Axis(name, y, mended[name], coefficients[name], even, others, temperature_c, shown[name], courses)
        axes[name] = replace_outliers(axis, effects[name], rng)
    return axes


def repair_again(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """Return the same axis, repaired for other effects.

    Parameters
    ----------
    axis : Axis
        Axis to repair again from its measured samples.
    effects : tuple of Effect
        Effects of the axis.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    y = repair_samples(axis.raw, axis.shown, effects, rng)
    return replace_outliers(_replace_samples(axis, y, axis.bins), effects, rng)


def without_sources(axis: Axis, sources: frozenset[str]) -> Axis:
    """Return the same axis without some axes as possible sources of a leak.

    Parameters
    ----------
    axis : Axis
        Axis to copy.
    sources : frozenset of str
        Names of the axes that do not leak into this axis.
    """
    others = {name: one for name, one in axis.others.items() if name not in sources}
    return Axis(
        axis.name,
        axis.raw,
        axis.repaired,
        axis.coefficients,
        axis.bins,
        others,
        axis.temperature_c,
        axis.shown,
        axis.courses,
    )


def may_leak(source: str, axis: str) -> bool:
    """Return True if one axis may leak into another.

    Gyroscopes and accelerometers leak into their own kind. Accelerometers also leak into gyroscopes.

    Parameters
    ----------
    source : str
        Name of the axis that leaks.
    axis : str
        Name of the affected axis.
    """
    return source != axis and (axis.startswith("g") or source.startswith("a"))


def measure_value_statistics(y: Floats) -> ValueStatistics:
    """Return the quantization, clipping and repeats of measured samples ``y``, shape (n,), in rad/s or m/s²."""
    grid = detect_quantization(y)
    step = grid.step.value if grid else 0.0
    ends = detect_clipping(y, step)
    return ValueStatistics(grid, ends, detect_repeats(y, step, ends.limit.value if ends and ends.symmetric else np.inf))


def repair_samples(y: Floats, shown: ValueStatistics, effects: Effects, rng: np.random.Generator) -> Floats:
    """Return the samples with missing, repeated and clipped samples replaced.

    Parameters
    ----------
    y : ndarray of float64, shape (n,)
        Measured samples. NaN marks a missing sample.
    shown : Shown
        Statistics of the measured values.
    effects : tuple of Effect
        Effects of the axis. Repeats and clipping are repaired only if they are among them.
    rng : numpy.random.Generator
        Generator for the replacement samples.

    Returns
    -------
    ndarray of float64, shape (n,)
        Repaired samples in the unit of ``y``.
    """
    missing = ~np.isfinite(y)
    if _first_of_type(effects, SampleHold) and shown.repeats:
        missing = missing | shown.repeats.mask
    mended = fill_missing(y, missing, rng)
    limit = _first_of_type(effects, Saturation)
    if limit is not None and shown.clipped is not None and shown.clipped.symmetric:
        at = shown.clipped.limit.value
        inside = np.abs(mended) < at * (1.0 - CLIP_RELATIVE_TOLERANCE)
        sigma = float(np.std(np.diff(mended)[inside[1:] & inside[:-1]])) / 2.0**0.5
        return _restore_clipped(mended, at, sigma, rng)
    return mended


def _restore_clipped(y: Floats, limit: float, sigma: float, rng: np.random.Generator) -> Floats:
    """Redraw the clipped samples and update the standard deviation in turns until it converges.

    A few iterations suffice if few samples were clipped.
    """
    whole = y
    for _ in range(MAX_SIGMA_ITERATIONS):
        whole = restore_clipped(y, limit, sigma, rng)
        before, sigma = sigma, float(np.std(np.diff(whole))) / 2.0**0.5
        if abs(sigma - before) < SIGMA_RELATIVE_TOLERANCE * sigma:
            break
    return whole


def replace_outliers(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """Return the axis with its outliers replaced, if its effects include outliers.

    Parameters
    ----------
    axis : Axis
        Axis to repair.
    effects : tuple of Effect
        Effects of the axis.
    rng : numpy.random.Generator
        Generator for the replacement samples.
    """
    if _first_of_type(effects, Outliers) is None:
        return axis
    found = fit_outliers(whiten_axis(axis, fit_with_given_sizes(axis, effects).likely).fast)
    return axis if found is None else _replace_samples(axis, fill_missing(axis.repaired, found.mask, rng), axis.bins)


def _replace_samples(axis: Axis, y: Floats, binned: Bins) -> Axis:
    """Return a copy of an axis with other samples and bins."""
    return Axis(
        axis.name, axis.raw, y, cosine_transform(y), binned, axis.others, axis.temperature_c, axis.shown, axis.courses
    )


def _first_of_type(effects: Effects, kind: type[E]) -> E | None:
    """Return the first effect of a type, or None."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)
