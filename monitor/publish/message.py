"""Results -> bytes: JSON, each payload with schema, device, time and sample count.

NaN becomes null, as JSON has no word for it. ``t`` is the Unix time of the newest sample in s.
"""

from typing import Any, Final

import msgspec
import numpy as np

from drivers.sample import AXES, Event, Floats
from monitor import topics
from monitor.estimate.analysis import Analysis
from monitor.estimate.coefficients import LETTERS, Coefficients, Status
from monitor.estimate.curve import AllanCurve
from monitor.estimate.estimate import Estimate
from monitor.health import Health

ANALYZE_SCHEMA: Final = "imu-monitor/analyze/1"
_ENCODER: Final = msgspec.json.Encoder()


def allan(device: str, unix_s: float, estimate: Estimate) -> bytes:
    """``imu/<device>/allan``: deviation and its 95 % interval at each τ, axes that are measured."""
    tau = _list(estimate.curve.tau_s)
    axes = {axis: _curve(estimate.curve, i) for i, axis in measured_axes(estimate)}
    return _encode(topics.ALLAN, device, unix_s, estimate.samples, _window(estimate, tau=tau, axes=axes))


def coefficients(device: str, unix_s: float, estimate: Estimate) -> bytes:
    """``imu/<device>/coefficients``: Q N B K R of each measured axis with interval and status."""
    axes = {axis: coefficient_table(estimate.coefficients, i) for i, axis in measured_axes(estimate)}
    return _encode(topics.COEFFICIENTS, device, unix_s, estimate.samples, _window(estimate, axes=axes))


def coefficient_table(all_axes: Coefficients, axis: int) -> dict[str, dict[str, Any]]:
    """One axis of the coefficients, a table a letter; also what ``analyze --json`` writes."""
    return {
        letter: {
            "value": _number(all_axes.value[row, axis]),
            "lo": _number(all_axes.lo[row, axis]),
            "hi": _number(all_axes.hi[row, axis]),
            "status": Status(int(all_axes.status[row, axis])).name.lower(),
        }
        for row, letter in enumerate(LETTERS)
    }


def event(device: str, unix_s: float, samples: int, what: Event, since_s: float | None) -> bytes:
    """``imu/<device>/event``."""
    payload = {
        "kind": what.kind,
        "axis": what.axis,
        "what": what.what,
        "since": since_s,
        "sigma": what.sigma,
        "text": what.text,
    }
    return _encode(topics.EVENT, device, unix_s, samples, payload)


def status(device: str, unix_s: float, health: Health) -> bytes:
    """``imu/<device>/status``."""
    payload = {
        "state": health.state,
        "rate": health.rate_hz,
        "received": health.received,
        "lost": health.lost,
        "bad": health.bad,
        "overflowed": health.overflowed,
        "latency": {"p50": health.latency_p50_s, "p99": health.latency_p99_s},
        "memory": health.memory_bytes,
        "outputs": health.outputs,
        "uptime": health.uptime_s,
        "text": health.text,
    }
    return _encode(topics.STATUS, device, unix_s, health.received, payload)


def reply(device: str, unix_s: float, samples: int, text: str) -> bytes:
    """Answer of ``imu/<device>/command/<verb>``."""
    return _encode(topics.RESET, device, unix_s, samples, {"text": text})


def analysis(result: Analysis) -> bytes:
    """``analyze --json``: schema imu-monitor/analyze/1."""
    estimate = result.estimate
    tau = _list(estimate.curve.tau_s)
    axes = {
        axis: {
            "allan": {"tau": tau, **_curve(estimate.curve, i)},
            "coefficients": coefficient_table(estimate.coefficients, i),
        }
        for i, axis in measured_axes(estimate)
    }
    return _ENCODER.encode(
        {
            "schema": ANALYZE_SCHEMA,
            "rate": estimate.rate_hz,
            "samples": estimate.samples,
            "seconds": result.seconds,
            "notes": result.notes,
            "axes": axes,
        }
    )


def no_analysis(why: str, samples: int) -> bytes:
    """``analyze --json`` where the data do not support an answer."""
    return _ENCODER.encode({"schema": ANALYZE_SCHEMA, "samples": samples, "notes": [why], "axes": {}})


def _window(estimate: Estimate, **more: Any) -> dict[str, Any]:
    filled_s = estimate.curve.n / estimate.rate_hz
    return {"rate": estimate.rate_hz, "window": estimate.window_s, "filled": filled_s, **more}


def _encode(topic: topics.Topic, device: str, unix_s: float, samples: int, payload: dict[str, Any]) -> bytes:
    return _ENCODER.encode({"schema": topic.schema(), "device": device, "t": unix_s, "samples": samples, **payload})


def measured_axes(estimate: Estimate) -> list[tuple[int, str]]:
    """Column and name of each axis that has a curve."""
    avar = estimate.curve.avar
    return [(i, axis) for i, axis in enumerate(AXES) if not np.isnan(avar[:, i]).all()]


def _curve(curve: AllanCurve, axis: int) -> dict[str, list[float]]:
    columns = {"deviation": np.sqrt(curve.avar), "lo": curve.lo, "hi": curve.hi}
    return {name: _list(column[:, axis]) for name, column in columns.items()}


def _number(value: np.float64) -> float | None:
    return float(value) if np.isfinite(value) else None


def _list(column: Floats) -> list[float]:
    result: list[float] = column.tolist()
    return result
