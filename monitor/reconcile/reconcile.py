"""Comparison of a recording with a noise model, and search for the effects that the model lacks.

Simulated recordings of the noise model define the threshold of each diagnostic. On each axis, the search adds effects
to the model until no diagnostic exceeds the threshold. The extended model is then simulated and compared with the
recording.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import Final

import numpy as np
from scipy.special import expit

from drivers.data_types import AXES
from monitor.noise.effect import AxisLeak, Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    ConstantBias,
    RateRamp,
    SampleRateError,
)
from monitor.noise.model import NoiseModel
from monitor.noise.standard_terms import UNIT_SOURCES
from monitor.reconcile.axis_result_builder import build_axis_result, with_outlier_misfit
from monitor.reconcile.diagnostics.null_distribution import (
    SIMULATED_RECORDINGS,
    AxisNull,
    Findings,
    all_simulations_have_improbable_gain,
    estimate_null_distributions,
    is_significance_clear,
    run_diagnostics,
)
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.axis_fit import Axis, Effects, RegressorCache
from monitor.reconcile.likelihood.effect_roles import is_stationary_gaussian, with_effect_size
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_model_sizes
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.preparation.reconcile_input import RecordedAxes, select_axes_and_smooth_temperature
from monitor.reconcile.recording_checks.checks import check_recording, sort_findings
from monitor.reconcile.recording_checks.sample_rate_from_features import (
    describe_sample_rate_error,
    estimate_sample_rate_error,
)
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisResult,
    Decision,
    DiagnosticGap,
    Location,
    Reconciliation,
    combine_decisions,
)
from monitor.reconcile.search.backward_elimination import MapFunction, eliminate_unneeded_effects
from monitor.reconcile.search.common_vibration_search import name_common_vibrations
from monitor.reconcile.search.leak_direction import (
    add_opposite_leaks_as_alternatives,
    find_leaks_in_wrong_direction,
)
from monitor.reconcile.search.sample_rate_from_spectrum import (
    SAMPLE_RATE_PENALTY_NATS,
    SampleRateErrorEstimate,
    convert_effect_to_stated_time,
    detect_sample_rate_error,
)
from monitor.reconcile.search.sample_repair import build_repaired_axes
from monitor.reconcile.search.scale_factor_vs_sample_rate import add_sample_rate_as_alternative
from monitor.reconcile.search.search import AxisSearchResult, search_missing_effects

MIN_TERM_GAIN_NATS: Final = 3.0
"""Smallest log-likelihood gain, in nats, of a term that the fit of the five terms keeps."""
ProgressCallback = Callable[[str, float | None], None]
"""Function that receives the name of each stage, and the completed share of the stage from 0 to 1 or None."""


@dataclass(frozen=True, slots=True)
class RecordingContext:
    """Recording to compare with a noise model, and the data that all stages share."""

    recording: RecordedAxes
    seed: int
    regressors: RegressorCache
    map_function: MapFunction  # distributes the work on axes
    report_stage: ProgressCallback = lambda _what, _share: None


@dataclass(frozen=True, slots=True)
class _AxesSearchResult:
    searches: dict[str, AxisSearchResult]
    sample_rate_error: SampleRateErrorEstimate | None

    @property
    def searches_that_changed_model(self) -> dict[str, AxisSearchResult]:
        """Searches that added or resized an effect."""
        return {name: search for name, search in self.searches.items() if search.rounds}


def reconcile(
    recording: RecordedAxes,
    model: NoiseModel | None,
    seed: int,
    map_function: MapFunction = map,
    report_stage: ProgressCallback = lambda _what, _share: None,
) -> Reconciliation:
    """Compare a recording with a model and find the effects that the model lacks.

    Parameters
    ----------
    recording : RecordedAxes
        Recording with at least ``MIN_SAMPLES`` samples for each axis.
    model : NoiseModel or None
        Noise model to test. If None, a model with the five terms Q, N, B, K and R is fitted to the recording.
    seed : int
        Seed of all simulations and random draws. The same seed gives the same result.
    map_function : callable, optional
        Function with the signature of ``map`` that distributes the work on axes.
    report_stage : callable, optional
        Function that is called with the name of each stage. During the search, the function is also called after each
        axis with the fraction completed so far, possibly from another thread.

    Returns
    -------
    Reconciliation
        For each axis, the decision, the added and resized effects, and the remaining differences.

    Raises
    ------
    NotReady
        If the recording has too few samples or no axis that can be compared with the model.
    """
    report_stage("checking the recording", None)
    checked = check_recording(recording, model, seed)
    recording, notes = select_axes_and_smooth_temperature(checked.recording, model)
    regressors = RegressorCache(recording.sample_count, recording.rate_hz, recording.temperature_c)
    run = RecordingContext(recording, seed, regressors, map_function, report_stage)
    if model is None:
        report_stage("fitting the five terms", None)
    tested = model or fit_five_terms(run)
    report_stage("simulating the model", None)
    simulated = _diagnose_simulations(tested, run, seed, recording.values)
    null = estimate_null_distributions(simulated)
    found = _search_all_axes(run, tested, null, fitted_first=model is None)
    report_stage("looking for common vibration", None)
    found = replace(found, searches=name_common_vibrations(found.searches, null))
    report_stage("looking for a simpler explanation", None)
    simpler = eliminate_unneeded_effects(found.searches, null, model is None, map_function)
    found = replace(found, searches=simpler)
    found = next(iter(simpler.values())).hypothesis.axis.evaluate_candidate(
        SampleRateError.name, lambda: replace(found, searches=add_sample_rate_as_alternative(simpler)), found
    )
    extended = _add_found_effects(tested, found)
    final = null
    if found.searches_that_changed_model or found.sample_rate_error:
        report_stage("simulating the extended model", None)
        changed = found.searches if found.sample_rate_error else found.searches_that_changed_model
        recorded = {name: with_outlier_misfit(one).findings for name, one in changed.items()}
        simulated |= _diagnose_simulations(extended, run, seed + SIMULATED_RECORDINGS, changed, recorded)
        final = estimate_null_distributions(simulated)
    report_stage("describing the result", None)
    axes = {
        name: build_axis_result(one, null[name], final[name], model is None) for name, one in found.searches.items()
    }
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
        samples=recording.sample_count,
        duration_s=recording.sample_count / recording.rate_hz,
        seed=seed,
        notes=notes,
        recording_findings=checked.findings,
        failed_candidates=tuple(
            f"{name}: {candidate}: {reason}"
            for name, one in found.searches.items()
            for candidate, reason in one.hypothesis.axis.failures.items()
        ),
    )


def fit_five_terms(run: RecordingContext) -> NoiseModel:
    """Fit the noise terms Q, N, B, K and R to each axis, and keep the significant terms."""
    axes = build_repaired_axes(
        run.recording, dict.fromkeys(run.recording.values, ()), run.regressors, np.random.default_rng(run.seed)
    )
    return NoiseModel({name: _fit_terms(axis) for name, axis in axes.items()}, run.recording.rate_hz)


def _fit_terms(axis: Axis) -> Effects:
    best = axis.fit([with_effect_size(effect, axis.cosine_transform_rms) for effect in UNIT_SOURCES[:4]])
    ramp = RateRamp(R=axis.cosine_transform_rms)
    with_ramp = axis.evaluate_candidate(ramp.name, lambda: axis.fit((*best.effects, ramp)), best)
    if with_ramp.log_likelihood - best.log_likelihood > PENALTY_NATS["rate_ramp"]:
        best = with_ramp
    for at in range(len(best.effects) - 1, -1, -1):
        if isinstance(best.effects[at], (AngleRandomWalk, RateRamp)):
            continue
        less = axis.fit(best.effects[:at] + best.effects[at + 1 :])
        if best.log_likelihood - less.log_likelihood < MIN_TERM_GAIN_NATS:
            best = less
    return best.effects


def _effects_by_axis(model: NoiseModel, recording: RecordedAxes) -> dict[str, Effects]:
    """Return the effects of each recorded axis without constant biases, because the mean is always fitted.

    The search may add a floor to a low-pass filter that has none, so such a filter is given a floor of 0.
    """
    return {
        axis: tuple(
            _with_floor(effect, 0.0) for effect in model.effects.get(axis, ()) if not isinstance(effect, ConstantBias)
        )
        for axis in recording.values
    }


def _with_floor(effect: Effect, floor: float | None) -> Effect:
    """Replace a missing or zero floor of a low-pass filter."""
    return replace(effect, floor=floor) if isinstance(effect, BandwidthLimit) and not effect.floor else effect


def _diagnose_simulations(
    model: NoiseModel,
    run: RecordingContext,
    first_seed: int,
    names: Collection[str],
    recorded: Mapping[str, Findings] | None = None,
) -> dict[str, list[Findings]]:
    """Run the diagnostics on simulated recordings of a model, and return the findings of each named axis.

    An axis with Gaussian noise is simulated until its gains are probable under a true model. If the findings on the
    recording are given, an axis is only simulated until it is clear which of these findings are significant.
    """
    effects = _effects_by_axis(model, run.recording)
    findings: dict[str, list[Findings]] = {name: [] for name in names}
    remaining = tuple(names)
    for seed in range(first_seed, first_seed + SIMULATED_RECORDINGS):
        for name, found in _diagnose_simulation(model, run, effects, seed, remaining).items():
            findings[name].append(found)
        remaining = tuple(
            name
            for name in remaining
            if not is_stationary_gaussian(effects[name]) or all_simulations_have_improbable_gain(findings[name])
            if recorded is None or not is_significance_clear(recorded[name], findings[name], len(names))
        )
        if not remaining:
            break
    return findings


def _diagnose_simulation(
    model: NoiseModel, run: RecordingContext, effects: Mapping[str, Effects], seed: int, names: Collection[str]
) -> dict[str, Findings]:
    """Run the diagnostics on some axes of one simulated recording."""
    axes = _simulate_axes(model, run, effects, seed)

    def diagnose_axis(name: str) -> Findings:
        return run_diagnostics(whiten_axis(fit_with_model_sizes(axes[name], effects[name]).fit))

    return dict(zip(names, run.map_function(diagnose_axis, names), strict=True))


def _simulate_axes(
    model: NoiseModel, run: RecordingContext, effects: Mapping[str, Effects], seed: int
) -> dict[str, Axis]:
    template = run.recording
    drawn = model.simulate(template.sample_count, template.rate_hz, seed, template.temperature_c)
    values = {axis: np.ascontiguousarray(drawn[:, AXES.index(axis)]) for axis in template.values}
    del drawn
    return build_repaired_axes(replace(template, values=values), effects, run.regressors, np.random.default_rng(seed))


def _search_all_axes(
    run: RecordingContext, model: NoiseModel, null: Mapping[str, AxisNull], fitted_first: bool
) -> _AxesSearchResult:
    """Test the sample rate, then search every axis for missing effects.

    If two axes appear to leak into each other, the search on one axis is repeated without this leak.
    """
    stage, searched = "searching for missing effects", count(1)
    run.report_stage(stage, 0.0)
    effects = _effects_by_axis(model, run.recording)
    axes = build_repaired_axes(run.recording, effects, run.regressors, np.random.default_rng(run.seed))
    axes = {name: replace(axis, is_model_fitted=fitted_first) for name, axis in axes.items()}
    error = next(iter(axes.values())).evaluate_candidate(
        SampleRateError.name,
        lambda: estimate_sample_rate_error(
            {name: axis.coefficients for name, axis in axes.items()},
            run.recording.rate_hz,
            effects,
            model.sample_rate_hz,
            detect_sample_rate_error(axes, effects),
        ),
        None,
    )
    if error is not None:
        ratio = float(error.ratio.value)
        effects = {
            name: tuple(convert_effect_to_stated_time(effect, ratio) for effect in of) for name, of in effects.items()
        }

    def search_named_axis(name: str) -> AxisSearchResult:
        rng = np.random.default_rng([run.seed, AXES.index(name)])
        result = search_missing_effects(axes[name], effects[name], null[name], rng)
        run.report_stage(stage, min(next(searched) / len(axes), 1.0))
        return result

    first_found = dict(zip(axes, run.map_function(search_named_axis, axes), strict=True))
    found = dict(first_found)
    for name, wrong in find_leaks_in_wrong_direction(first_found, null).items():
        of_model = wrong & {effect.source for effect in effects[name] if isinstance(effect, AxisLeak)}
        leak_sources = {k: one for k, one in axes[name].leak_sources.items() if k not in wrong - of_model}
        axes[name] = replace(axes[name], leak_sources=leak_sources, sources_of_unchanged_leaks=of_model)
        found[name] = search_named_axis(name)
    return _AxesSearchResult(add_opposite_leaks_as_alternatives(found, first_found), error)


def _add_found_effects(model: NoiseModel, found: _AxesSearchResult) -> NoiseModel:
    error = found.sample_rate_error
    ratio = float(error.ratio.value) if error else 1.0
    effects = dict(model.effects)
    for name, search in found.searches_that_changed_model.items():
        bias = tuple(effect for effect in model.effects.get(name, ()) if isinstance(effect, ConstantBias))
        effects[name] = bias + tuple(
            _with_floor(convert_effect_to_stated_time(effect, 1.0 / ratio), None)
            for effect in search.hypothesis.effects
        )
    if error is not None:
        effects[error.axis] = (*effects[error.axis], SampleRateError(ratio=ratio))
    return NoiseModel(effects, model.sample_rate_hz, model.temperature)


def _add_sample_rate_step(
    axes: Mapping[str, AxisResult], error: SampleRateErrorEstimate, null: Mapping[str, AxisNull]
) -> dict[str, AxisResult]:
    """Add the sample rate error to the result of the axis that shows the error most clearly."""
    result = axes[error.axis]
    stated, observed = error.frequency
    margin = 0.01 * abs(observed - stated)
    where = Location(frequency=(min(error.frequency) - margin, max(error.frequency) + margin))
    limit = null[error.axis]["lines"]
    before = DiagnosticGap(
        "lines", where, *(float(np.sqrt(2.0 * x)) for x in (error.gain, limit.null95, limit.threshold))
    )
    step = AddedOrResizedEffect(
        kind="added",
        effect=SampleRateError.name,
        parameters={"ratio": error.ratio},
        confidence=float(expit(error.gain - SAMPLE_RATE_PENALTY_NATS)),
        runners_up=(),
        before=before,
        after=next(score for score in result.start.gaps if score.diagnostic == "lines"),
        held_out=None,
        held_out_reason="the sample rate is common to the whole recording",
        because=(
            f"The feature of the model at {stated:.6g} Hz appears at {observed:.6g} Hz in the recording, and one ratio "
            f"of true to stated sample rate agrees with all axes."
        ),
        snapshot_after=result.start,
        gain_nats=error.gain,
    )
    verdict: Decision = "partly_explained" if result.left_over else "explained"
    return {**axes, error.axis: replace(result, steps=(step, *result.steps), verdict=verdict)}
