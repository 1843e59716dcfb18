"""A reconciliation as JSON for programs: ``report.json``, schema imu-monitor/reconcile/1.

In comes a ``Reconciliation``, out go bytes; the same reconciliation gives the same bytes. Numbers are SI of their axis,
times s from the start of the recording. What is not a finite number becomes null, as JSON has no word for it; a
parameter that names an axis has a value and no interval.

Of each step, ``found`` has the place and the threshold that it passed, under the model before the step; ``gap`` is the
same lens before and after, with ``null95`` and ``threshold`` under the model after it, which decide what is left over.
``scores`` are all lenses: of an axis beside the first model, of a step after it.
"""

from math import isfinite
from typing import Any, Final

import msgspec

from drivers.sample import AXES
from monitor.reconcile.result import AxisResult, Bounds, Reconciliation, Score, Step, Where

SCHEMA: Final = "imu-monitor/reconcile/1"
_ENCODER: Final = msgspec.json.Encoder()


def to_json(r: Reconciliation) -> bytes:
    """The report, axes in the order of ``AXES``."""
    return _ENCODER.encode({
        "schema": SCHEMA,
        "verdict": r.verdict,
        "rate": _number(r.rate_hz),
        "samples": int(r.samples),
        "seconds": _number(r.seconds),
        "seed": int(r.seed),
        "fitted_first": bool(r.fitted_first),
        "notes": r.notes,
        "axes": {axis: _axis(r.axes[axis]) for axis in AXES if axis in r.axes},
    })  # fmt: skip


def _axis(result: AxisResult) -> dict[str, Any]:
    return {
        "verdict": result.verdict,
        "steps": [_step(step) for step in result.steps],
        "left_over": [_score(score) for score in result.left_over],
        "scores": [_score(score) for score in result.start.scores],
    }


def _step(step: Step) -> dict[str, Any]:
    held_out = _gap(step.held_out_before, step.held_out_after)
    return {
        "found": _score(step.found),
        "kind": step.kind,
        "effect": step.effect,
        "parameters": {name: _bounds(bounds) for name, bounds in step.parameters.items()},
        "confidence": _number(step.confidence),
        "runners_up": [{"effect": one.effect, "confidence": _number(one.confidence)} for one in step.runners_up],
        "gap": _gap(step.before, step.after),
        "held_out_gap": held_out,
        **({} if held_out else {"held_out_reason": step.held_out_reason}),
        "because": step.because,
        "scores": [_score(score) for score in step.look.scores],
    }


def _gap(before: Score | None, after: Score | None) -> dict[str, float | None] | None:
    if before is None or after is None:
        return None
    return {
        "before": _number(before.gap),
        "after": _number(after.gap),
        "null95": _number(after.null95),
        "threshold": _number(after.threshold),
    }


def _score(score: Score) -> dict[str, Any]:
    return {
        "lens": score.lens,
        "where": _where(score.where),
        "gap": _number(score.gap),
        "null95": _number(score.null95),
        "threshold": _number(score.threshold),
    }


def _where(where: Where) -> dict[str, Any]:
    found = where.found().items()
    return {name: place if isinstance(place, str) else [_number(end) for end in place] for name, place in found}


def _bounds(bounds: Bounds) -> dict[str, Any]:
    if isinstance(bounds.value, str):
        return {"value": bounds.value}
    return {"value": _number(bounds.value), "lo": _number(bounds.lo), "hi": _number(bounds.hi)}


def _number(value: float | None) -> float | None:
    """Python's own float: NumPy's are not known to the encoder."""
    return None if value is None or not isfinite(value) else float(value)
