"""Compare a recording with a noise model and return a ``Reconciliation``.

The procedure has these steps:

1. Simulate recordings from the model and run all diagnostics on them, which gives the thresholds.
2. Run the same diagnostics on the measured recording.
3. On each axis that disagrees, try candidate effects and keep the best one, until nothing is left or no effect helps.
4. Simulate the extended model and compare once more.

The axes are independent of each other, except for the sample rate, which is common to all axes.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.special import expit

from drivers.errors import NotReady
from drivers.sample import AXES, Floats
from monitor.noise.effect import Leak
from monitor.noise.effects import (
    AngleRandomWalk,
    Bias,
    RateRamp,
    SampleRateError,
)
from monitor.noise.model import NoiseModel
from monitor.noise.standard_terms import UNIT_SOURCES
from monitor.reconcile.description import describe_axis
from monitor.reconcile.diagnostics.diagnostics import whiten_axis
from monitor.reconcile.diagnostics.gap import Findings, NullDistribution, null_distributions, run_diagnostics
from monitor.reconcile.likelihood.effect_terms import with_size
from monitor.reconcile.likelihood.hypothesis import fit_with_given_sizes
from monitor.reconcile.preparation.axis import Axis, Effects, RegressorCache
from monitor.reconcile.preparation.prepare import MIN_SAMPLES, prepare_axes, without_sources
from monitor.reconcile.preparation.sample_rate_test import SAMPLE_RATE_PENALTY_NATS as CLOCK_PRICE
from monitor.reconcile.preparation.sample_rate_test import (
    SampleRateErrorEstimate,
    detect_sample_rate_error,
    in_stated_time,
)
from monitor.reconcile.result import AxisResult, Decision, Location, Reconciliation, ReconciliationStep, Score
from monitor.reconcile.search.candidates import PENALTY_NATS
from monitor.reconcile.search.search import Search, search_axis

SIMULATED_RECORDINGS: Final = 6
"""Number of simulated recordings that determine a null distribution: with six axes, 36 gains for each diagnostic."""

TEMPERATURE_SMOOTHING_FRACTION: Final = 0.001
"""Length of the moving average of the temperature, as a fraction of the recording. Heat is slow and thermometers are
noisy."""

MIN_VALID_FRACTION: Final = 0.5
"""Smallest fraction of samples of an axis that must be present."""
MIN_TERM_GAIN_NATS: Final = 3.0
"""Log-likelihood gain in nats that a term of the first fit must reach to be kept."""
ProgressCallback = Callable[[str], None]
"""Function that is called with the name of each stage."""

MapFunction = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Function with the signature of ``map``, such as the ``map`` method of a thread pool."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Measured samples of one recording, with its sample rate and temperature."""

    values: Mapping[str, Floats]  # axis -> [n] SI; NaN = missing
    rate_hz: float
    temperature_c: Floats | None = None  # [n] °C; NaN = missing

    @property
    def samples(self) -> int:
        """Number of samples of each axis."""
        return next(iter(self.values.values())).size


def diagnose_simulations(
    model: NoiseModel,
    template: Recording,
    courses: RegressorCache,
    seed: int,
    each: MapFunction = map,
    runs: int = SIMULATED_RECORDINGS,
    only: Collection[str] | None = None,
) -> dict[str, list[Findings]]:
    """Run the diagnostics on recordings that are simulated from a model.

    Parameters
    ----------
    model : NoiseModel
        Model to simulate.
    template : Recording
        Recording whose axes, length, sample rate and temperature the simulations copy.
    courses : Courses
        Cached regressors for the same length, sample rate and temperature.
    seed : int
        Seed of the first simulation. Each further simulation uses the next integer.
    each : callable, optional
        Function with the signature of ``map`` that distributes the simulations.
    runs : int, optional
        Number of simulated recordings.
    only : collection of str, optional
        Names of the axes to diagnose. If None, all axes are diagnosed.

    Returns
    -------
    dict of str to list of Findings
        For each axis, the findings of each simulated recording.
    """
    effects = effects_by_axis(model, template)
    wanted = [name for name in template.values if only is None or name in only]

    def one(run: int) -> dict[str, Findings]:
        drawn = model.simulate(template.samples, template.rate_hz, seed + run, template.temperature_c)
        raw = {axis: drawn[:, AXES.index(axis)] for axis in template.values}
        rng = np.random.default_rng(seed + run)
        axes = prepare_axes(raw, template.rate_hz, effects, template.temperature_c, courses, rng)
        return {
            name: run_diagnostics(whiten_axis(axes[name], fit_with_given_sizes(axes[name], effects[name]).likely))
            for name in wanted
        }

    seen = list(each(one, range(runs)))
    return {axis: [run[axis] for run in seen] for axis in wanted}


def smooth_temperature(temperature_c: Floats) -> Floats:
    """Return the temperature with missing samples interpolated and with thermometer noise averaged out.

    Parameters
    ----------
    temperature_c : ndarray of float64, shape (n,)
        Temperature in °C. NaN marks a missing sample. At least one sample must be finite.

    Returns
    -------
    ndarray of float64, shape (n,)
        Smoothed temperature in °C.
    """
    known = np.flatnonzero(np.isfinite(temperature_c))
    whole = np.interp(np.arange(temperature_c.size), known, temperature_c[known])
    half = int(0.5 * TEMPERATURE_SMOOTHING_FRACTION * whole.size)
    if half < 1:
        return whole
    sums = np.concatenate([[0.0], np.cumsum(np.pad(whole - whole[0], half, mode="edge"))])
    return np.asarray((sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1) + whole[0])


def effects_by_axis(model: NoiseModel, recording: Recording) -> dict[str, Effects]:
    """Return the effects of each recorded axis without constant biases.

    A constant bias is not compared, because the mean of each axis is always free.

    Parameters
    ----------
    model : NoiseModel
        Model under test.
    recording : Recording
        Recording whose axes are used.

    Returns
    -------
    dict of str to tuple of Effect
        Effects of each axis.
    """
    return {
        axis: tuple(effect for effect in model.effects.get(axis, ()) if not isinstance(effect, Bias))
        for axis in recording.values
    }


@dataclass(frozen=True, slots=True)
class SearchResults:
    """Results of the search on all axes of one recording."""

    searches: dict[str, Search]
    clock: SampleRateErrorEstimate | None


def search_all_axes(
    recording: Recording,
    model: NoiseModel,
    null: Mapping[str, Mapping[str, NullDistribution]],
    courses: RegressorCache,
    seed: int,
    each: MapFunction,
) -> SearchResults:
    """Search every axis for missing effects.

    The sample rate is tested first. If two axes each seem to leak into the other, the search is repeated on one of them
    without that source.

    Parameters
    ----------
    recording : Recording
        Recording to explain.
    model : NoiseModel
        Model under test.
    null : mapping of str to mapping of str to Null
        Null distribution for each axis and diagnostic.
    courses : Courses
        Cached regressors for the same length, sample rate and temperature.
    seed : int
        Seed of all random draws.
    each : callable
        Function with the signature of ``map`` that distributes the axes.
    """
    effects = effects_by_axis(model, recording)
    rng = np.random.default_rng(seed)
    axes = prepare_axes(recording.values, recording.rate_hz, effects, recording.temperature_c, courses, rng)
    clock = detect_sample_rate_error(axes, effects)
    if clock is not None:
        ratio = float(clock.ratio.value)
        effects = {
            name: tuple(in_stated_time(effect, ratio) for effect in of_axis) for name, of_axis in effects.items()
        }

    def one(name: str) -> Search:
        return search_axis(axes[name], effects[name], null[name], np.random.default_rng([seed, AXES.index(name)]))

    found = dict(zip(axes, each(one, axes), strict=True))
    for name, innocent in _reversed_leak_sources(found, null).items():
        axes[name] = without_sources(axes[name], innocent)
        found[name] = one(name)
    return SearchResults(found, clock)


def reconcile(
    recording: Recording,
    model: NoiseModel | None,
    seed: int,
    each: MapFunction = map,
    tell: ProgressCallback = lambda _what: None,
) -> Reconciliation:
    """Compare a recording with a model and find the effects that the model lacks.

    Parameters
    ----------
    recording : Recording
        Recording with at least ``FEWEST`` samples for each axis.
    model : NoiseModel or None
        Model under test. If None, the five classic terms are fitted first.
    seed : int
        Seed of all simulations and random draws. The same seed gives the same result.
    each : callable, optional
        Function with the signature of ``map`` that distributes work over axes and simulated recordings.
    tell : callable, optional
        Function that is called with the name of each stage.

    Returns
    -------
    Reconciliation
        Decision, effects and remaining differences of each axis.

    Raises
    ------
    NotReady
        If there are too few samples or no axis can be compared with the model.
    """
    recording, notes = select_usable_axes(recording, model)
    courses = RegressorCache(recording.samples, recording.rate_hz, recording.temperature_c)
    if model is None:
        tell("fitting the five terms")
    tested = model or fit_five_terms(recording, courses, seed)
    tell("simulating the model")
    simulated = diagnose_simulations(tested, recording, courses, seed, each)
    null = null_distributions(simulated, len(simulated))
    tell("looking for what is missing")
    found = search_all_axes(recording, tested, null, courses, seed, each)
    rounds = {name: one for name, one in found.searches.items() if one.rounds}
    augmented = add_found_effects(tested, found)
    final = null
    if rounds or found.clock:
        tell("simulating the new model")
        changed = None if found.clock else rounds
        simulated |= diagnose_simulations(
            augmented, recording, courses, seed + SIMULATED_RECORDINGS, each, only=changed
        )
        final = null_distributions(simulated, len(simulated))
    tell("writing down")
    axes = {name: describe_axis(one, null[name], final[name]) for name, one in found.searches.items()}
    if found.clock is not None:
        axes = add_sample_rate_step(axes, found.clock, null)
    return Reconciliation(
        verdict=combine_decisions([one.verdict for one in axes.values()]),
        axes=axes,
        baseline=tested,
        model=augmented,
        fitted_first=model is None,
        rate_hz=recording.rate_hz,
        samples=recording.samples,
        duration_s=recording.samples / recording.rate_hz,
        seed=seed,
        notes=notes,
    )


def select_usable_axes(recording: Recording, model: NoiseModel | None) -> tuple[Recording, tuple[str, ...]]:
    """Select the axes that can be compared.

    Parameters
    ----------
    recording : Recording
        Recording to check.
    model : NoiseModel or None
        Model under test. If None, every axis with enough samples and varying values is kept.

    Returns
    -------
    recording : Recording
        Recording with the selected axes and the smoothed temperature.
    notes : tuple of str
        One sentence for each axis that was left out.

    Raises
    ------
    NotReady
        If there are too few samples or no axis is left.
    """
    if recording.samples < MIN_SAMPLES:
        raise NotReady(
            f"{recording.samples} samples; {MIN_SAMPLES} are the least that anything can be said of "
            f"({MIN_SAMPLES / recording.rate_hz:.0f} s at {recording.rate_hz:g} Hz)"
        )
    notes, kept = [], {}
    for name, y in recording.values.items():
        there = y[np.isfinite(y)]
        if there.size < MIN_SAMPLES or there.size < MIN_VALID_FRACTION * y.size:
            notes.append(f"{name}: {there.size} of {y.size} samples are there; left out")
        elif np.ptp(there) == 0.0:
            notes.append(f"{name}: all samples are the same; left out")
        elif model is not None and not model.effects.get(name):
            notes.append(f"{name}: the model says nothing of it; left out")
        else:
            kept[name] = y
    if not kept:
        raise NotReady("no axis to compare: " + "; ".join(notes))
    warmth = recording.temperature_c
    if warmth is not None:
        warmth = smooth_temperature(warmth) if np.isfinite(warmth).any() else None
    return Recording(kept, recording.rate_hz, warmth), tuple(notes)


def fit_five_terms(recording: Recording, courses: RegressorCache, seed: int) -> NoiseModel:
    """Fit the terms Q, N, B, K and R to each axis and keep the terms that the data support.

    Parameters
    ----------
    recording : Recording
        Recording to fit.
    courses : Courses
        Cached regressors for the same length, sample rate and temperature.
    seed : int
        Seed of the draws that replace missing samples.

    Returns
    -------
    NoiseModel
        Model with the supported terms of each axis.
    """
    rng = np.random.default_rng(seed)
    none: dict[str, Effects] = dict.fromkeys(recording.values, ())
    axes = prepare_axes(recording.values, recording.rate_hz, none, recording.temperature_c, courses, rng)
    return NoiseModel({name: _fit_terms(axis, UNIT_SOURCES[:4]) for name, axis in axes.items()}, recording.rate_hz)


def _fit_terms(axis: Axis, start: Effects) -> Effects:
    """Fit the classic terms to one axis and drop each term that gains too little likelihood."""
    scale = float(np.sqrt(np.mean(axis.coefficients**2)))
    best = axis.fit([with_size(effect, scale) for effect in start])
    with_ramp = axis.fit((*best.effects, RateRamp(R=scale)))
    if with_ramp.log_likelihood - best.log_likelihood > PENALTY_NATS["rate_ramp"]:
        best = with_ramp
    for at in range(len(best.effects) - 1, -1, -1):
        effect = best.effects[at]
        if isinstance(effect, (AngleRandomWalk, RateRamp)):
            continue
        less = axis.fit(best.effects[:at] + best.effects[at + 1 :])
        if best.log_likelihood - less.log_likelihood < MIN_TERM_GAIN_NATS:
            best = less
    return best.effects


def add_found_effects(model: NoiseModel, found: SearchResults) -> NoiseModel:
    """Return the model with all effects that were found.

    Parameters
    ----------
    model : NoiseModel
        Model under test.
    found : SearchResults
        Results of the search.
    """
    ratio = float(found.clock.ratio.value) if found.clock else 1.0
    effects = dict(model.effects)
    for name, one in found.searches.items():
        if not one.rounds:
            continue
        bias = tuple(effect for effect in model.effects.get(name, ()) if isinstance(effect, Bias))
        effects[name] = bias + tuple(in_stated_time(effect, 1.0 / ratio) for effect in one.state.effects)
    if found.clock is not None:
        effects[found.clock.axis] = (*effects[found.clock.axis], SampleRateError(ratio=ratio))
    return NoiseModel(effects, model.sample_rate_hz, model.temperature)


def add_sample_rate_step(
    axes: Mapping[str, AxisResult], clock: SampleRateErrorEstimate, null: Mapping[str, Mapping[str, NullDistribution]]
) -> dict[str, AxisResult]:
    """Return the results with a step for the wrong sample rate, on the axis that shows the error most clearly.

    Parameters
    ----------
    axes : mapping of str to AxisResult
        Results of all axes.
    clock : Clock
        Detected sample rate error.
    null : mapping of str to mapping of str to Null
        Null distribution for each axis and diagnostic.
    """
    one = axes[clock.axis]
    half = abs(clock.frequency[1] - clock.frequency[0])
    where = Location(frequency=(min(clock.frequency) - 0.01 * half, max(clock.frequency) + 0.01 * half))
    limit = null[clock.axis]["lines"]
    before, null95, threshold = (float(np.sqrt(2.0 * x)) for x in (clock.gain, limit.null95, limit.threshold))
    after = next(score for score in one.start.scores if score.lens == "lines")
    score = Score("lines", where, before, null95, threshold)
    step = ReconciliationStep(
        found=score,
        kind="added",
        effect=SampleRateError.name,
        parameters={"ratio": clock.ratio},
        confidence=float(expit(clock.gain - CLOCK_PRICE)),
        runners_up=(),
        before=score,
        after=after,
        held_out_before=None,
        held_out_after=None,
        held_out_reason="the clock is one for the whole recording",
        because=(
            f"What the model has at {clock.frequency[0]:.6g} Hz is seen at {clock.frequency[1]:.6g} Hz, and all axes "
            f"agree with one ratio of the clocks."
        ),
        look=one.start,
    )
    verdict = one.verdict if one.verdict in ("explained", "partly_explained") else "explained"
    if one.left_over:
        verdict = "partly_explained"
    return {**axes, clock.axis: replace(one, steps=(step, *one.steps), verdict=verdict)}


def combine_decisions(verdicts: Iterable[Decision]) -> Decision:
    """Combine the decisions of all axes into the decision for the recording."""
    every = set(verdicts)
    if every <= {"agrees"}:
        return "agrees"
    if every <= {"agrees", "explained"}:
        return "explained"
    return "unexplained" if every <= {"agrees", "unexplained"} else "partly_explained"


def _reversed_leak_sources(
    found: Mapping[str, Search], null: Mapping[str, Mapping[str, NullDistribution]]
) -> dict[str, frozenset[str]]:
    """Return, for each axis, the sources whose leak is wrongly assumed because the true leak has the opposite
    direction."""
    gains = {
        (name, effect.source): step.trials[0].value
        for name, one in found.items()
        for step in one.rounds
        if isinstance(effect := step.trials[0].effect, Leak)
    }
    back: dict[str, frozenset[str]] = {}
    for (name, source), gain in gains.items():
        if source not in found:
            continue
        seen = found[source].seen["other_axes"]
        suspected = seen.where.source == name and seen.gain > null[source]["other_axes"].threshold
        if suspected or gains.get((source, name), np.inf) < gain:
            back[source] = back.get(source, frozenset()) | {name}
    return back
