"""JSON report of a comparison of several recordings: schema imu-monitor/reconcile-runs/1.

Equal comparisons are encoded as equal bytes. All numbers are in SI units. A number that is not finite is encoded as
null. The parameters of an effect are averaged over the recordings. ``p`` is the probability of an equal or larger
scatter if the true value is the same in all recordings. ``each`` contains the values of each recording.
"""

from typing import Any, Final

import msgspec

from monitor.reconcile.json_report import finite_or_none, parameter_entry
from monitor.reconcile.result import AddedOrResizedEffect
from monitor.reconcile.several_recordings.comparison import (
    AxisComparison,
    EffectInRecordings,
    NamedResult,
    RecordingsComparison,
)

SCHEMA: Final = "imu-monitor/reconcile-runs/1"


def encode_comparison(comparison: RecordingsComparison) -> bytes:
    """Encode a comparison of several recordings as JSON."""
    return msgspec.json.encode({
        "schema": SCHEMA,
        "verdict": comparison.verdict,
        "seed": int(comparison.seed),
        "fitted_to": comparison.fitted_to,
        "recordings": [
            *(_run_entry(run) for run in comparison.runs),
            *(
                {"name": name, "folder": name, "verdict": None, "why": why}
                for name, why in comparison.without_result.items()
            ),
        ],
        "axes": {axis: _axis_entry(one) for axis, one in comparison.axes.items()},
    })  # fmt: skip


def _run_entry(run: NamedResult) -> dict[str, Any]:
    return {
        "name": run.name,
        "folder": run.name,
        "verdict": run.result.verdict,
        "rate": finite_or_none(run.result.rate_hz),
        "samples": int(run.result.samples),
        "seconds": finite_or_none(run.result.duration_s),
    }


def _axis_entry(one: AxisComparison) -> dict[str, Any]:
    return {
        "verdicts": {run: result.verdict for run, result in one.results.items()},
        "common": [_effect_entry(matched) for matched in one.common],
        "single": [
            {
                **_effect_entry(matched),
                "absent": [{"run": a.run, "meaning": a.meaning, "because": a.because} for a in matched.absent],
            }
            for matched in one.single
        ],
    }


def _effect_entry(matched: EffectInRecordings) -> dict[str, Any]:
    return {
        "effect": matched.effect,
        "kind": matched.kind,
        "recordings": list(matched.steps),
        "parameters": {
            name: {**parameter_entry(one.bounds), **({} if one.p_value is None else {"p": finite_or_none(one.p_value)})}
            for name, one in matched.parameters.items()
        },
        "consistent": matched.sizes_agree,
        "p": finite_or_none(matched.p),
        "each": {run: _step_entry(step) for run, step in matched.steps.items()},
    }


def _step_entry(step: AddedOrResizedEffect) -> dict[str, Any]:
    return {
        "parameters": {name: parameter_entry(one) for name, one in step.parameters.items()},
        "confidence": finite_or_none(step.confidence),
        "gap": {"before": finite_or_none(step.before.gap), "after": finite_or_none(step.after.gap)},
    }
