"""JSON report of a reconciliation: ``report.json``, schema imu-monitor/reconcile/1.

The same reconciliation always gives the same bytes. Numbers are in SI units of their axis, and times are in seconds
from the start of the recording. A number that is not finite becomes null, because JSON cannot represent it. A parameter
that names an axis has a value and no interval.

In each step, ``found`` holds the location and the threshold that the difference passed, under the model before the
step. ``gap`` holds the same diagnostic before and after the step. Its ``null95`` and ``threshold`` belong to the model
after the step and decide whether a difference is left over. ``scores`` holds all diagnostics: for an axis, the
comparison with the first model; for a step, the comparison after the step.

``recording_findings`` lists faults of the recording itself, the gravest first, with their evidence.
"""

from math import isfinite
from typing import Any, Final

import msgspec

from drivers.sample import AXES
from monitor.reconcile.result import (
    AxisResult,
    Location,
    ParameterInterval,
    Reconciliation,
    ReconciliationStep,
    RecordingFinding,
    Score,
)

SCHEMA: Final = "imu-monitor/reconcile/1"
"""Name and version of the JSON schema."""
_JSON_ENCODER: Final = msgspec.json.Encoder()


def encode_report(r: Reconciliation) -> bytes:
    """Encode a reconciliation as JSON, with the axes in the order of ``AXES``."""
    return _JSON_ENCODER.encode({
        "schema": SCHEMA,
        "verdict": r.verdict,
        "rate": finite_or_none(r.rate_hz),
        "samples": int(r.samples),
        "seconds": finite_or_none(r.duration_s),
        "seed": int(r.seed),
        "fitted_first": bool(r.fitted_first),
        "notes": r.notes,
        "recording_findings": [_finding_entry(finding) for finding in r.recording_findings],
        "axes": {axis: _axis_entry(r.axes[axis]) for axis in AXES if axis in r.axes},
    })  # fmt: skip


def _finding_entry(finding: RecordingFinding) -> dict[str, Any]:
    """Return the report entry of a fault of the recording."""
    return {
        "kind": finding.kind,
        "axes": finding.axes,
        "sentence": finding.sentence,
        "parameters": {name: parameter_entry(bounds) for name, bounds in finding.parameters.items()},
        "evidence": {name: finite_or_none(number) for name, number in finding.evidence.items()},
        "corrected": finding.corrected,
    }


def _axis_entry(result: AxisResult) -> dict[str, Any]:
    """Return the report entry of one axis."""
    return {
        "verdict": result.verdict,
        "steps": [_step_entry(step) for step in result.steps],
        "left_over": [_score_entry(score) for score in result.left_over],
        "scores": [_score_entry(score) for score in result.start.scores],
    }


def _step_entry(step: ReconciliationStep) -> dict[str, Any]:
    """Return the report entry of one step."""
    held_out = _gap_entry(step.held_out_before, step.held_out_after)
    return {
        "found": _score_entry(step.found),
        "kind": step.kind,
        "effect": step.effect,
        "parameters": {name: parameter_entry(bounds) for name, bounds in step.parameters.items()},
        "confidence": finite_or_none(step.confidence),
        "runners_up": [{"effect": one.effect, "confidence": finite_or_none(one.confidence)} for one in step.runners_up],
        "gap": _gap_entry(step.before, step.after),
        "held_out_gap": held_out,
        **({} if held_out else {"held_out_reason": step.held_out_reason}),
        "because": step.because,
        "scores": [_score_entry(score) for score in step.look.scores],
    }


def _gap_entry(before: Score | None, after: Score | None) -> dict[str, float | None] | None:
    """Return the gaps before and after a step, or None if one of them is unknown."""
    if before is None or after is None:
        return None
    return {
        "before": finite_or_none(before.gap),
        "after": finite_or_none(after.gap),
        "null95": finite_or_none(after.null95),
        "threshold": finite_or_none(after.threshold),
    }


def _score_entry(score: Score) -> dict[str, Any]:
    """Return the report entry of one score."""
    return {
        "lens": score.lens,
        "where": _where_entry(score.where),
        "gap": finite_or_none(score.gap),
        "null95": finite_or_none(score.null95),
        "threshold": finite_or_none(score.threshold),
    }


def _where_entry(where: Location) -> dict[str, Any]:
    """Return the report entry of a location."""
    found = where.found().items()
    return {name: place if isinstance(place, str) else [finite_or_none(end) for end in place] for name, place in found}


def parameter_entry(bounds: ParameterInterval) -> dict[str, Any]:
    """Return the report entry of a parameter."""
    if isinstance(bounds.value, str):
        return {"value": bounds.value}
    return {"value": finite_or_none(bounds.value), "lo": finite_or_none(bounds.lo), "hi": finite_or_none(bounds.hi)}


def finite_or_none(value: float | None) -> float | None:
    """Return a Python float, because the encoder does not accept NumPy scalars, or None if the value is not finite."""
    return None if value is None or not isfinite(value) else float(value)
