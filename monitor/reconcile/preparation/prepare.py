"""A recording made ready: its holes filled, and put right what the model says is wrong with single samples.

What is missing is filled by draws from around it. Repeats of continuous values are known one by one and taken for
missing; so are outliers, once the axis is white enough to see them; clipped samples are drawn from beyond the limit.
Measured and simulated recordings go the same way, each by its model: what is left after that is for the spectrum.
"""

from collections.abc import Mapping
from typing import Final, TypeVar

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import Outliers, SampleHold, Saturation
from monitor.reconcile.diagnostics.diagnostics import sight
from monitor.reconcile.likelihood.hypothesis import believed
from monitor.reconcile.likelihood.outlier_statistics import outliers
from monitor.reconcile.preparation.axis import Axis, Courses, Effects, Shown
from monitor.reconcile.preparation.cosine_bins import Bins, bins, transform
from monitor.reconcile.preparation.sample_repair import filled, unclipped
from monitor.reconcile.preparation.value_statistics import clipped, levels, repeats

FEWEST: Final = 4096
"""Samples: with fewer there is no spectrum to speak of, and no spectrogram."""
NEAR: Final = 1e-9
"""Relative: a sample that near to the limit is at it."""
TURNS: Final = 40
STILL: Final = 5e-4
"""Relative change of the deviation that ends the turns."""
E = TypeVar("E", bound=Effect)


def prepared(
    raw: Mapping[str, Floats],
    rate_hz: float,
    effects: Mapping[str, Effects],
    temperature_c: Floats | None,
    courses: Courses,
    rng: np.random.Generator,
) -> dict[str, Axis]:
    """Axes of one recording.

    Args:
        raw: axis -> samples [n], SI; NaN = missing
        effects: what each axis is said to have
        temperature_c: [n] °C, without holes
        courses: of that length, rate and temperature
    """
    even = bins(len(next(iter(raw.values()))), rate_hz)
    shown = {name: look_at_values(y) for name, y in raw.items()}
    mended = {name: mend(y, shown[name], effects[name], rng) for name, y in raw.items()}
    coefficients = {name: transform(y) for name, y in mended.items()}
    axes = {}
    for name, y in raw.items():
        others = {other: one for other, one in coefficients.items() if may_leak(other, name)}
        axis = Axis(name, y, mended[name], coefficients[name], even, others, temperature_c, shown[name], courses)
        axes[name] = without_outliers(axis, effects[name], rng)
    return axes


def again(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """The same axis, put right for other effects."""
    y = mend(axis.raw, axis.shown, effects, rng)
    return without_outliers(_with(axis, y, axis.bins), effects, rng)


def without_sources(axis: Axis, sources: frozenset[str]) -> Axis:
    """The same axis, in which some axes are known not to leak."""
    others = {name: one for name, one in axis.others.items() if name not in sources}
    return Axis(
        axis.name, axis.raw, axis.y, axis.coefficients, axis.bins, others, axis.temperature_c, axis.shown, axis.courses
    )


def may_leak(source: str, axis: str) -> bool:
    """Gyroscopes and accelerometers into their kind, accelerometers into gyroscopes too."""
    return source != axis and (axis.startswith("g") or source.startswith("a"))


def look_at_values(y: Floats) -> Shown:
    """Steps, ends and repeats of samples [n] as measured."""
    grid = levels(y)
    step = grid.step.value if grid else 0.0
    ends = clipped(y, step)
    return Shown(grid, ends, repeats(y, step, ends.limit.value if ends and ends.symmetric else np.inf))


def mend(y: Floats, shown: Shown, effects: Effects, rng: np.random.Generator) -> Floats:
    """Samples [n] without holes, repeats and clipping."""
    missing = ~np.isfinite(y)
    if _first(effects, SampleHold) and shown.repeats:
        missing = missing | shown.repeats.mask
    mended = filled(y, missing, rng)
    limit = _first(effects, Saturation)
    if limit is not None and shown.clipped is not None and shown.clipped.symmetric:
        at = shown.clipped.limit.value
        inside = np.abs(mended) < at * (1.0 - NEAR)
        sigma = float(np.std(np.diff(mended)[inside[1:] & inside[:-1]])) / 2.0**0.5
        return _beyond(mended, at, sigma, rng)
    return mended


def _beyond(y: Floats, limit: float, sigma: float, rng: np.random.Generator) -> Floats:
    """Clipped samples drawn anew, and the deviation of all with them, in turns: where few were clipped few turns do."""
    whole = y
    for _ in range(TURNS):
        whole = unclipped(y, limit, sigma, rng)
        before, sigma = sigma, float(np.std(np.diff(whole))) / 2.0**0.5
        if abs(sigma - before) < STILL * sigma:
            break
    return whole


def without_outliers(axis: Axis, effects: Effects, rng: np.random.Generator) -> Axis:
    """The axis with its outliers taken for missing, if it is said to have any."""
    if _first(effects, Outliers) is None:
        return axis
    found = outliers(sight(axis, believed(axis, effects).likely).fast)
    return axis if found is None else _with(axis, filled(axis.y, found.mask, rng), axis.bins)


def _with(axis: Axis, y: Floats, binned: Bins) -> Axis:
    return Axis(axis.name, axis.raw, y, transform(y), binned, axis.others, axis.temperature_c, axis.shown, axis.courses)


def _first(effects: Effects, kind: type[E]) -> E | None:
    return next((effect for effect in effects if isinstance(effect, kind)), None)
