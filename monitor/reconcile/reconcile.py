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

from drivers.sample import AXES
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
from monitor.reconcile.diagnostics.null_distribution import AxisNull, Findings, null_distributions, run_diagnostics
from monitor.reconcile.likelihood.axis import Axis, Effects, RegressorCache
from monitor.reconcile.likelihood.effect_terms import with_size
from monitor.reconcile.likelihood.hypothesis import fit_with_given_sizes
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.preparation.recording import Recording, select_usable_axes
from monitor.reconcile.recording_checks.checks import check_recording, sort_findings
from monitor.reconcile.recording_checks.sample_rate import describe_sample_rate_error, estimate_sample_rate_error
from monitor.reconcile.result import (
    AxisResult,
    Decision,
    Location,
    Reconciliation,
    ReconciliationStep,
    Score,
    combine_decisions,
)
from monitor.reconcile.search.axis_preparation import prepare_axes
from monitor.reconcile.search.candidates import PENALTY_NATS
from monitor.reconcile.search.sample_rate_error import (
    SAMPLE_RATE_PENALTY_NATS,
    SampleRateErrorEstimate,
    detect_sample_rate_error,
    in_stated_time,
)
from monitor.reconcile.search.search import Search, search_axis

SIMULATED_RECORDINGS: Final = 6
"""Number of simulated recordings that determine a null distribution. With six axes, each diagnostic has 36 gains."""
MIN_TERM_GAIN_NATS: Final = 3.0
"""Log-likelihood gain in nats that a term of the first fit must reach to be kept."""
ProgressCallback = Callable[[str], None]
"""Function that is called with the name of each stage."""
MapFunction = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Function with the signature of ``map``, such as the ``map`` method of a thread pool."""


@dataclass(frozen=True, slots=True)
class RunContext:
    """Recording, with the seed and the cached regressors of one reconciliation."""

    recording: Recording
    seed: int
    regressors: RegressorCache
    map: MapFunction  # distributes work over axes and simulated recordings

    def prepare(self, recording: Recording, effects: Mapping[str, Effects], seed: int) -> dict[str, Axis]:
        """Return the prepared axes of the measured recording or of a simulated one with the same temperature.

        Parameters
        ----------
        recording : Recording
            Recording to prepare.
        effects : mapping of str to tuple of Effect
            Effects of each axis.
        seed : int
            Seed of the draws that replace missing samples.
        """
        return prepare_axes(recording, effects, self.regressors, np.random.default_rng(seed))


@dataclass(frozen=True, slots=True)
class SearchResults:
    """Results of the search on all axes of one recording."""

    searches: dict[str, Search]
    sample_rate_error: SampleRateErrorEstimate | None

    @property
    def extended(self) -> dict[str, Search]:
        """Searches that changed the model."""
        return {name: search for name, search in self.searches.items() if search.rounds}


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
        Recording with at least ``MIN_SAMPLES`` samples for each axis.
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
    tell("checking the recording")
    checked = check_recording(recording, model, seed)
    recording, notes = select_usable_axes(checked.recording, model)
    regressors = RegressorCache(recording.samples, recording.rate_hz, recording.temperature_c)
    run = RunContext(recording, seed, regressors, each)
    if model is None:
        tell("fitting the five terms")
    tested = model or fit_five_terms(run)
    tell("simulating the model")
    simulated = _diagnose_simulations(tested, run, seed, recording.values)
    null = null_distributions(simulated, len(simulated))
    tell("searching for missing effects")
    found = _search_all_axes(run, tested, null)
    extended = _add_found_effects(tested, found)
    final = null
    if found.extended or found.sample_rate_error:
        tell("simulating the extended model")
        changed = recording.values if found.sample_rate_error else found.extended
        simulated |= _diagnose_simulations(extended, run, seed + SIMULATED_RECORDINGS, changed)
        final = null_distributions(simulated, len(simulated))
    tell("describing the result")
    axes = {name: describe_axis(one, null[name], final[name]) for name, one in found.searches.items()}
    if found.sample_rate_error is not None:
        axes = _add_sample_rate_step(axes, found.sample_rate_error, null)
        rate_finding = describe_sample_rate_error(found.sample_rate_error, recording.rate_hz)
        checked = replace(checked, findings=sort_findings((rate_finding, *checked.findings)))
    return Reconciliation(
        verdict=combine_decisions([one.verdict for one in axes.values()]),
        axes=axes,
        baseline=tested,
        model=extended,
        fitted_first=model is None,
        rate_hz=recording.rate_hz,
        samples=recording.samples,
        duration_s=recording.samples / recording.rate_hz,
        seed=seed,
        notes=notes,
        recording_findings=checked.findings,
    )


def fit_five_terms(run: RunContext) -> NoiseModel:
    """Fit the terms Q, N, B, K and R to each axis and keep the terms that the data support."""
    axes = run.prepare(run.recording, dict.fromkeys(run.recording.values, ()), run.seed)
    return NoiseModel({name: _fit_terms(axis) for name, axis in axes.items()}, run.recording.rate_hz)


def _fit_terms(axis: Axis) -> Effects:
    """Fit the classic terms to one axis and drop each term that gains too little likelihood."""
    best = axis.fit([with_size(effect, axis.rms) for effect in UNIT_SOURCES[:4]])
    with_ramp = axis.fit((*best.effects, RateRamp(R=axis.rms)))
    if with_ramp.log_likelihood - best.log_likelihood > PENALTY_NATS["rate_ramp"]:
        best = with_ramp
    for at in range(len(best.effects) - 1, -1, -1):
        if isinstance(best.effects[at], (AngleRandomWalk, RateRamp)):
            continue
        less = axis.fit(best.effects[:at] + best.effects[at + 1 :])
        if best.log_likelihood - less.log_likelihood < MIN_TERM_GAIN_NATS:
            best = less
    return best.effects


def _effects_by_axis(model: NoiseModel, recording: Recording) -> dict[str, Effects]:
    """Return the effects of each recorded axis without constant biases.

    A constant bias is not compared, because the mean of each axis is always free.
    """
    return {
        axis: tuple(effect for effect in model.effects.get(axis, ()) if not isinstance(effect, Bias))
        for axis in recording.values
    }


def _diagnose_simulations(
    model: NoiseModel, run: RunContext, first_seed: int, names: Collection[str]
) -> dict[str, list[Findings]]:
    """Run the diagnostics on simulations of a model that have the axes, length and temperature of the recording.

    The result has, for each of the named axes, the findings of each simulated recording.
    """
    template = run.recording
    effects = _effects_by_axis(model, template)

    def diagnose(seed: int) -> dict[str, Findings]:
        drawn = model.simulate(template.samples, template.rate_hz, seed, template.temperature_c)
        simulated = replace(template, values={axis: drawn[:, AXES.index(axis)] for axis in template.values})
        axes = run.prepare(simulated, effects, seed)
        return {
            name: run_diagnostics(whiten_axis(fit_with_given_sizes(axes[name], effects[name]).fit)) for name in names
        }

    findings = list(run.map(diagnose, range(first_seed, first_seed + SIMULATED_RECORDINGS)))
    return {axis: [one[axis] for one in findings] for axis in names}


def _search_all_axes(run: RunContext, model: NoiseModel, null: Mapping[str, AxisNull]) -> SearchResults:
    """Search every axis for missing effects.

    The sample rate is tested first. If two axes each seem to leak into the other, the search is repeated on one of them
    without that source.
    """
    effects = _effects_by_axis(model, run.recording)
    axes = run.prepare(run.recording, effects, run.seed)
    error = estimate_sample_rate_error(
        {name: axis.coefficients for name, axis in axes.items()},
        run.recording.rate_hz,
        effects,
        model.sample_rate_hz,
        detect_sample_rate_error(axes, effects),
    )
    if error is not None:
        ratio = float(error.ratio.value)
        effects = {name: tuple(in_stated_time(effect, ratio) for effect in of) for name, of in effects.items()}

    def search(name: str) -> Search:
        rng = np.random.default_rng([run.seed, AXES.index(name)])
        return search_axis(axes[name], effects[name], null[name], rng)

    found = dict(zip(axes, run.map(search, axes), strict=True))
    for name, wrong in _reversed_leak_sources(found, null).items():
        others = {source: one for source, one in axes[name].others.items() if source not in wrong}
        axes[name] = replace(axes[name], others=others)
        found[name] = search(name)
    return SearchResults(found, error)


def _reversed_leak_sources(found: Mapping[str, Search], null: Mapping[str, AxisNull]) -> dict[str, frozenset[str]]:
    """Return, for each axis, the sources of leaks that in fact have the opposite direction."""
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
        finding = found[source].findings["other_axes"]
        suspected = finding.where.source == name and finding.gain > null[source]["other_axes"].threshold
        if suspected or gains.get((source, name), np.inf) < gain:
            back[source] = back.get(source, frozenset()) | {name}
    return back


def _add_found_effects(model: NoiseModel, found: SearchResults) -> NoiseModel:
    """Return the model with all effects that were found."""
    error = found.sample_rate_error
    ratio = float(error.ratio.value) if error else 1.0
    effects = dict(model.effects)
    for name, search in found.extended.items():
        bias = tuple(effect for effect in model.effects.get(name, ()) if isinstance(effect, Bias))
        effects[name] = bias + tuple(in_stated_time(effect, 1.0 / ratio) for effect in search.state.effects)
    if error is not None:
        effects[error.axis] = (*effects[error.axis], SampleRateError(ratio=ratio))
    return NoiseModel(effects, model.sample_rate_hz, model.temperature)


def _add_sample_rate_step(
    axes: Mapping[str, AxisResult], error: SampleRateErrorEstimate, null: Mapping[str, AxisNull]
) -> dict[str, AxisResult]:
    """Return the results with a step for the wrong sample rate, on the axis that shows the error most clearly."""
    result = axes[error.axis]
    stated, observed = error.frequency
    margin = 0.01 * abs(observed - stated)
    where = Location(frequency=(min(error.frequency) - margin, max(error.frequency) + margin))
    limit = null[error.axis]["lines"]
    before = Score("lines", where, *(float(np.sqrt(2.0 * x)) for x in (error.gain, limit.null95, limit.threshold)))
    step = ReconciliationStep(
        found=before,
        kind="added",
        effect=SampleRateError.name,
        parameters={"ratio": error.ratio},
        confidence=float(expit(error.gain - SAMPLE_RATE_PENALTY_NATS)),
        runners_up=(),
        before=before,
        after=next(score for score in result.start.scores if score.lens == "lines"),
        held_out_before=None,
        held_out_after=None,
        held_out_reason="the sample rate is common to the whole recording",
        because=(
            f"The feature of the model at {stated:.6g} Hz appears at {observed:.6g} Hz in the recording, and one ratio "
            f"of true to stated sample rate agrees with all axes."
        ),
        look=result.start,
    )
    verdict: Decision = "partly_explained" if result.left_over else "explained"
    return {**axes, error.axis: replace(result, steps=(step, *result.steps), verdict=verdict)}
