"""JSON report of a reconciliation: ``report.json``, schema imu-monitor/reconcile/1.

Equal reconciliations are encoded as equal bytes. All numbers are in SI units. Times are in seconds from the start of
the recording. A number that is not finite is encoded as null.

Each entry of ``steps`` describes one effect that was added or resized. ``found`` is the difference that led to the
step. ``gap`` compares the same diagnostic before and after the step. ``scores`` lists the gaps of all diagnostics.

``summary`` contains at most five sentences. ``findings`` lists the causes of the gap over all axes, in the order of
``share``. ``remaining`` lists the differences that no effect explains, in the same order. Each share refers to
``gap_nats``.

``recording_findings`` lists the faults of the recording with their evidence, the most serious fault first.
"""

from math import isfinite
from typing import Any, Final

import msgspec

from drivers.data_types import AXES
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisResult,
    DiagnosticGap,
    Location,
    ParameterInterval,
    Reconciliation,
    RecordingFinding,
)
from monitor.reconcile.summary.ranked_findings import RankedGapCause, RankedRemainingGap, rank_findings
from monitor.reconcile.summary.summary_sentences import summarize

SCHEMA: Final = "imu-monitor/reconcile/1"
_JSON_ENCODER: Final = msgspec.json.Encoder()


def encode_report(result: Reconciliation) -> bytes:
    """Encode a reconciliation as JSON."""
    ranking = rank_findings(result)
    return _JSON_ENCODER.encode({
        "schema": SCHEMA,
        "verdict": result.verdict,
        "summary": summarize(result),
        "gap_nats": finite_or_none(ranking.whole_nats),
        "explained_share": finite_or_none(ranking.explained_share),
        "findings": [_ranked_entry(finding) for finding in ranking.findings],
        "remaining": [_remainder_entry(one) for one in ranking.remainders],
        "rate": finite_or_none(result.rate_hz),
        "samples": int(result.samples),
        "seconds": finite_or_none(result.duration_s),
        "seed": int(result.seed),
        "fitted_first": bool(result.fitted_first),
        "notes": result.notes,
        "recording_findings": [_finding_entry(finding) for finding in result.recording_findings],
        "axes": {axis: _axis_entry(result.axes[axis]) for axis in AXES if axis in result.axes},
    })  # fmt: skip


def _finding_entry(finding: RecordingFinding) -> dict[str, Any]:
    return {
        "kind": finding.kind,
        "axes": finding.axes,
        "sentence": finding.sentence,
        "parameters": {name: parameter_entry(bounds) for name, bounds in finding.parameters.items()},
        "evidence": {name: finite_or_none(number) for name, number in finding.evidence.items()},
        "corrected": finding.corrected,
    }


def _ranked_entry(finding: RankedGapCause) -> dict[str, Any]:
    return {
        "kind": finding.kind,
        "effect": finding.effect,
        "axes": finding.axes,
        "parameters": {name: parameter_entry(bounds) for name, bounds in finding.parameters.items()},
        "size_ratio": finite_or_none(finding.size_ratio),
        "old_frequency": finding.old_frequency,
        "confidence": finite_or_none(finding.confidence),
        "gain_nats": finite_or_none(finding.gain_nats),
        "share": finite_or_none(finding.share),
        "allan": {
            axis: {"ratio": finite_or_none(one.ratio), "tau": finite_or_none(one.tau_s)}
            for axis, one in finding.influences.items()
        },
    }


def _remainder_entry(one: RankedRemainingGap) -> dict[str, Any]:
    return {
        "axis": one.axis,
        "group": one.gap.group,
        "gain_nats": finite_or_none(one.gap.gain_nats),
        "share": finite_or_none(one.share),
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
    held_out = _gap_entry(step.held_out_before, step.held_out_after)
    return {
        "found": _gap_and_location_entry(step.before),
        "kind": step.kind,
        "effect": step.effect,
        "parameters": {name: parameter_entry(bounds) for name, bounds in step.parameters.items()},
        "confidence": finite_or_none(step.confidence),
        "gain_nats": finite_or_none(step.gain_nats),
        "runners_up": [{"effect": one.effect, "confidence": finite_or_none(one.confidence)} for one in step.runners_up],
        "gap": _gap_entry(step.before, step.after),
        "held_out_gap": held_out,
        **({} if held_out else {"held_out_reason": step.held_out_reason}),
        "because": step.because,
        "scores": [_gap_and_location_entry(gap) for gap in step.snapshot_after.gaps],
    }


def _gap_entry(before: DiagnosticGap | None, after: DiagnosticGap | None) -> dict[str, float | None] | None:
    if before is None or after is None:
        return None
    return {
        "before": finite_or_none(before.gap),
        "after": finite_or_none(after.gap),
        "null95": finite_or_none(after.null95),
        "threshold": finite_or_none(after.threshold),
    }


def _gap_and_location_entry(gap: DiagnosticGap) -> dict[str, Any]:
    return {
        "lens": gap.diagnostic,
        "where": _where_entry(gap.where),
        "gap": finite_or_none(gap.gap),
        "null95": finite_or_none(gap.null95),
        "threshold": finite_or_none(gap.threshold),
    }


def _where_entry(where: Location) -> dict[str, Any]:
    return {
        name: place if isinstance(place, str) else [finite_or_none(end) for end in place]
        for name, place in where.resolved_location_dimensions().items()
    }


def parameter_entry(bounds: ParameterInterval) -> dict[str, Any]:
    """Return the JSON entry of a parameter."""
    if isinstance(bounds.value, str):
        return {"value": bounds.value}
    return {"value": finite_or_none(bounds.value), "lo": finite_or_none(bounds.lo), "hi": finite_or_none(bounds.hi)}


def finite_or_none(value: float | None) -> float | None:
    """Convert a finite value to a Python float. Return None for any other value."""
    return None if value is None or not isfinite(value) else float(value)
