"""JSON reports of a reconciliation and of a comparison of several recordings: ``report.json``.

Equal reconciliations are encoded as equal bytes. All numbers are in SI units. Times are in seconds from the start of
the recording. A number that is not finite is encoded as null.

Each entry of ``steps`` describes one effect that was added or resized. ``found`` is the difference that led to the
step. ``gap`` compares the same diagnostic before and after the step. ``scores`` lists the gaps of all diagnostics.

``summary`` contains at most five sentences. ``findings`` lists the causes of the gap over all axes, in the order of
``share``. ``remaining`` lists the differences that no effect explains, in the same order. Each share refers to
``gap_nats``.

``recording_findings`` lists the faults of the recording with their evidence, the most serious fault first.

In a comparison, the parameters of an effect are averaged over the recordings. ``p`` is the probability of an equal or
larger scatter if the true value is the same in all recordings. ``each`` contains the values of each recording.
"""

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from drivers.data_types import AXES
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisResult,
    DiagnosticGap,
    ParameterInterval,
    Reconciliation,
    RecordingFinding,
)
from monitor.reconcile.several_recordings.comparison import (
    AxisComparison,
    EffectInRecordings,
    NamedResult,
    RecordingsComparison,
)
from monitor.reconcile.summary.ranked_findings import RankedGapCause, RankedRemainingGap, rank_findings
from monitor.reconcile.summary.summary_sentences import summarize

SCHEMA: Final = "imu-monitor/reconcile/1"
COMPARISON_SCHEMA: Final = "imu-monitor/reconcile-runs/1"


def encode_report(result: Reconciliation) -> bytes:
    """Encode a reconciliation as JSON."""
    ranking = rank_findings(result)
    return _encode({
        "schema": SCHEMA,
        "verdict": result.verdict,
        "summary": summarize(result),
        "gap_nats": ranking.whole_nats,
        "explained_share": ranking.explained_share,
        "findings": [_ranked_entry(finding) for finding in ranking.findings],
        "remaining": [_remainder_entry(one) for one in ranking.remainders],
        "rate": result.rate_hz,
        "samples": result.samples,
        "seconds": result.duration_s,
        "seed": result.seed,
        "fitted_first": result.fitted_first,
        "notes": result.notes,
        "recording_findings": [_finding_entry(finding) for finding in result.recording_findings],
        "axes": {axis: _axis_entry(result.axes[axis]) for axis in AXES if axis in result.axes},
    })  # fmt: skip


def _finding_entry(finding: RecordingFinding) -> dict[str, Any]:
    return {
        "kind": finding.kind,
        "axes": finding.axes,
        "sentence": finding.sentence,
        "parameters": _parameter_entries(finding.parameters),
        "evidence": finding.evidence,
        "corrected": finding.corrected,
    }


def _ranked_entry(finding: RankedGapCause) -> dict[str, Any]:
    return {
        "kind": finding.kind,
        "effect": finding.effect,
        "axes": finding.axes,
        "parameters": _parameter_entries(finding.parameters),
        "size_ratio": finding.size_ratio,
        "old_frequency": finding.old_frequency,
        "confidence": finding.confidence,
        "gain_nats": finding.gain_nats,
        "share": finding.share,
        "allan": {axis: {"ratio": one.ratio, "tau": one.tau_s} for axis, one in finding.influences.items()},
    }


def _remainder_entry(one: RankedRemainingGap) -> dict[str, Any]:
    return {
        "axis": one.axis,
        "group": one.gap.group,
        "gain_nats": one.gap.gain_nats,
        "share": one.share,
        "strongest": _gap_and_location_entry(one.gap.strongest),
    }


def _axis_entry(result: AxisResult) -> dict[str, Any]:
    return {
        "verdict": result.verdict,
        "steps": [_step_entry(step) for step in result.steps],
        "left_over": [_gap_and_location_entry(gap) for gap in result.left_over],
        "scores": [_gap_and_location_entry(gap) for gap in result.start.gaps],
    }


def _step_entry(step: AddedOrResizedEffect) -> dict[str, Any]:
    return {
        "found": _gap_and_location_entry(step.before),
        "kind": step.kind,
        "effect": step.effect,
        "parameters": _parameter_entries(step.parameters),
        "confidence": step.confidence,
        "gain_nats": step.gain_nats,
        "runners_up": step.runners_up,
        "gap": _gap_entry(step.before.gap, step.after.gap, step.after),
        "held_out_gap": None if step.held_out is None else _gap_entry(*step.held_out, step.after),
        **({} if step.held_out else {"held_out_reason": step.held_out_reason}),
        "because": step.because,
        "scores": [_gap_and_location_entry(gap) for gap in step.snapshot_after.gaps],
    }


def _gap_entry(before: float, after: float, limits: DiagnosticGap) -> dict[str, float]:
    return {"before": before, "after": after, "null95": limits.null95, "threshold": limits.threshold}


def _gap_and_location_entry(gap: DiagnosticGap) -> dict[str, Any]:
    return {
        "lens": gap.diagnostic,
        "where": gap.where.resolved_location_dimensions(),
        "gap": gap.gap,
        "null95": gap.null95,
        "threshold": gap.threshold,
    }


def _parameter_entries(parameters: Mapping[str, ParameterInterval]) -> dict[str, Any]:
    return {name: _parameter_entry(bounds) for name, bounds in parameters.items()}


def _parameter_entry(bounds: ParameterInterval) -> dict[str, Any]:
    """Return the JSON entry of a parameter."""
    if isinstance(bounds.value, str):
        return {"value": bounds.value}
    return {"value": bounds.value, "lo": bounds.lo, "hi": bounds.hi}


def _encode(report: dict[str, Any]) -> bytes:
    """Encode a report as JSON. Numbers that are not finite become null, and NumPy scalars become numbers."""
    return msgspec.json.encode(report, enc_hook=lambda scalar: scalar.item())


def encode_comparison(comparison: RecordingsComparison) -> bytes:
    """Encode a comparison of several recordings as JSON."""
    return _encode({
        "schema": COMPARISON_SCHEMA,
        "verdict": comparison.verdict,
        "seed": comparison.seed,
        "fitted_to": comparison.fitted_to,
        "recordings": [
            *(_run_entry(run) for run in comparison.runs),
            *(
                {"name": name, "folder": name, "verdict": None, "why": why}
                for name, why in comparison.without_result.items()
            ),
        ],
        "axes": {axis: _compared_axis_entry(one) for axis, one in comparison.axes.items()},
    })  # fmt: skip


def _run_entry(run: NamedResult) -> dict[str, Any]:
    return {
        "name": run.name,
        "folder": run.name,
        "verdict": run.result.verdict,
        "rate": run.result.rate_hz,
        "samples": run.result.samples,
        "seconds": run.result.duration_s,
    }


def _compared_axis_entry(one: AxisComparison) -> dict[str, Any]:
    return {
        "verdicts": {run: result.verdict for run, result in one.results.items()},
        "common": [_effect_entry(matched) for matched in one.common],
        "single": [{**_effect_entry(matched), "absent": matched.absent} for matched in one.single],
    }


def _effect_entry(matched: EffectInRecordings) -> dict[str, Any]:
    return {
        "effect": matched.effect,
        "kind": matched.kind,
        "recordings": list(matched.steps),
        "parameters": {
            name: {**_parameter_entry(one.bounds), **({} if one.p_value is None else {"p": one.p_value})}
            for name, one in matched.parameters.items()
        },
        "consistent": matched.sizes_agree,
        "p": matched.p,
        "each": {run: _step_summary_entry(step) for run, step in matched.steps.items()},
    }


def _step_summary_entry(step: AddedOrResizedEffect) -> dict[str, Any]:
    return {
        "parameters": _parameter_entries(step.parameters),
        "confidence": step.confidence,
        "gap": {"before": step.before.gap, "after": step.after.gap},
    }
