"""Encoding of results as JSON messages with schema, device, time and sample count.

NaN becomes null, because JSON cannot represent it. ``t`` is the Unix time of the newest sample in seconds. In a status
and in the reply to a reset it may be null. This is the case before the first sample of a recording or of a device that
has its own clock.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np

from drivers.credential_masking import mask_secrets
from drivers.sample import AXES, Event, Floats
from monitor.common import topics
from monitor.common.health import Health
from monitor.drift.thermal.live_thermal import ThermalUpdate
from monitor.drift.thermal.recursive_least_squares import PredictionInterval
from monitor.drift.thermal.temperature_share import SLOW_LETTERS, TemperatureShare
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.analysis import Analysis
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.detection.motion_detection import Motion
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS, Coefficients, Status

ANALYZE_SCHEMA: Final = "imu-monitor/analyze/1"
_ENCODER: Final = msgspec.json.Encoder()


def encode_allan(device: str, unix_s: float, estimate: Estimate) -> bytes:
    """Encode ``imu/<device>/allan``: the Allan deviation of each measured axis and its 95 % interval at each τ.

    ``recent`` holds the same over a shorter time span, max(10 s, 16 τ) for each τ.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s].
    estimate
        The estimate.
    """
    tau = _list(estimate.curve.tau_s)
    axes: dict[str, dict[str, Any]] = {axis: _curve(estimate.curve, i) for i, axis in measured_axes(estimate)}
    if estimate.display_curve is not None:
        for i, axis in measured_axes(estimate):
            axes[axis]["recent"] = _curve(estimate.display_curve, i)
    return _encode(topics.ALLAN, device, unix_s, estimate.samples, _window_payload(estimate, tau=tau, axes=axes))


def encode_coefficients(device: str, unix_s: float, estimate: Estimate) -> bytes:
    """Encode ``imu/<device>/coefficients``: Q, N, B, K and R of each measured axis with interval and status.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s].
    estimate
        The estimate.
    """
    axes = {
        axis: coefficient_table(estimate.coefficients, i, bool(estimate.k_or_r[i]))
        for i, axis in measured_axes(estimate)
    }
    return _encode(topics.COEFFICIENTS, device, unix_s, estimate.samples, _window_payload(estimate, axes=axes))


def encode_gap(device: str, unix_s: float, look: ModelGap) -> bytes:
    """Encode ``imu/<device>/gap``: measured deviations and those of the model in use.

    Only axes that can be tested are included.

    ``agrees`` is the current decision (null: none yet), see ``agreement``. It has hysteresis: it changes later than
    ``gap`` crosses its threshold.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s].
    look
        Result of the comparison with the model.
    """
    axes = {
        axis: {
            "agrees": look.agrees.get(axis),
            "gap": one.gap,
            "where": {"tau": one.tau_s},
            "ratio": one.ratio,
            "null95": one.null95,
            "threshold": one.threshold,
            "measured": _list(one.measured),
            "model": _list(one.model),
            "z": _list(one.z),
        }
        for axis, one in look.axes.items()
    }
    filled_s = look.n / look.rate_hz
    payload = {
        "rate": look.rate_hz,
        "window": look.window_s,
        "filled": filled_s,
        "tau": _list(look.tau_s),
        "axes": axes,
    }
    return _encode(topics.GAP, device, unix_s, look.samples, payload)


def encode_thermal(device: str, unix_s: float, samples: int, look: ThermalUpdate) -> bytes:
    """Encode ``imu/<device>/thermal``: the mean bias of an interval and its prediction; ``t`` is the interval's end.

    ``multi_step`` is predicted from the temperature alone, ``one_step`` also from the preceding bias. Both are null if
    there is no model; ``text`` then gives the reason.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the end of the interval [s].
    samples
        Number of samples since the start.
    look
        Result of the thermal model for the interval.
    """
    axes = {
        axis: {
            "bias": _number(one.bias),
            "error": _number(one.error),
            "multi_step": _band(one.multi_step),
            "one_step": _band(one.one_step),
            "model": one.model or None,
            "slope": _number(one.slope),
            "text": one.text,
        }
        for axis, one in look.axes.items()
    }
    payload = {"interval": look.interval_s, "temperature": look.temperature_c, "axes": axes}
    return _encode(topics.THERMAL, device, unix_s, samples, payload)


def encode_total(device: str, unix_s: float, samples: int, total: TotalCurve, hadamard: HadamardCurve) -> bytes:
    """Encode ``imu/<device>/total``: total and Hadamard deviation of each measured axis, each with its own τ.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s].
    samples
        Number of samples since the start.
    total
        Total variance.
    hadamard
        Hadamard variance.
    """
    curves = {
        "total": (total.tau_s, np.sqrt(total.tvar), total.lo, total.hi),
        "hadamard": (hadamard.tau_s, np.sqrt(hadamard.hvar), hadamard.lo, hadamard.hi),
    }
    payload = {
        name: {
            "tau": _list(tau_s),
            "axes": {
                axis: {"deviation": _list(deviation[:, i]), "lo": _list(lo[:, i]), "hi": _list(hi[:, i])}
                for i, axis in enumerate(AXES)
                if np.isfinite(deviation[:, i]).any()
            },
        }
        for name, (tau_s, deviation, lo, hi) in curves.items()
    }
    return _encode(topics.TOTAL, device, unix_s, samples, payload)


def coefficient_table(all_axes: Coefficients, axis: int, k_or_r: bool = False) -> dict[str, dict[str, Any]]:
    """Return the coefficients of one axis, one table per letter, as in messages and in ``analyze --json``.

    Parameters
    ----------
    all_axes
        Coefficients of all axes, shape [5, 6], SI.
    axis
        Column of the axis.
    k_or_r
        True if either K or R is present and the data do not show which. Each then names the other letter in ``or``.
    """
    other = {"K": "R", "R": "K"} if k_or_r else {}
    return {
        letter: {
            "value": _number(all_axes.value[row, axis]),
            "lo": _number(all_axes.lo[row, axis]),
            "hi": _number(all_axes.hi[row, axis]),
            "status": Status(int(all_axes.status[row, axis])).name.lower(),
            **({"or": other[letter]} if letter in other else {}),
        }
        for row, letter in enumerate(SYMBOLS)
    }


def encode_event(device: str, unix_s: float, samples: int, what: Event, since_s: float | None) -> bytes:
    """Encode ``imu/<device>/event``.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the event [s].
    samples
        Number of samples since the start.
    what
        The event.
    since_s
        Unix time at which the reported condition began [s]; None if unknown.
    """
    payload = {
        "kind": what.kind,
        "axis": what.axis,
        "what": what.values,
        "since": since_s,
        "sigma": what.sigma,
        "text": mask_secrets(what.text),
    }
    return _encode(topics.EVENT, device, unix_s, samples, payload)


def event_start_s(unix_s: float, what: Event) -> float | None:
    """Return the Unix time [s] at which the condition reported by an event began; None if unknown.

    Parameters
    ----------
    unix_s
        Unix time of the event [s].
    what
        The event.
    """
    return None if what.since_ns is None else unix_s - (what.t_ns - what.since_ns) / 1e9


def encode_status(device: str, unix_s: float | None, health: Health) -> bytes:
    """Encode ``imu/<device>/status``.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s]; None before the first sample.
    health
        Health of the device.
    """
    payload = {
        "state": health.state,
        "rate": health.rate_hz,
        "received": health.received,
        "lost": health.lost,
        "bad": health.bad,
        "overflowed": health.overflowed,
        "latency": {"p50": health.latency_p50_s, "p99": health.latency_p99_s},
        "memory": health.memory_bytes,
        "outputs": {name: mask_secrets(said) for name, said in health.outputs.items()},
        "uptime": health.uptime_s,
        "repeated": health.repeated,
        "late": health.late,
        "moving": health.moving,
        "moved": health.moved,
        "crossed": health.crossed,
        "text": mask_secrets(health.text),
    }
    return _encode(topics.STATUS, device, unix_s, health.received, payload)


def encode_reply(device: str, unix_s: float | None, samples: int, text: str) -> bytes:
    """Encode the reply to ``imu/<device>/command/<verb>``.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s]; None before the first sample.
    samples
        Number of samples since the start.
    text
        Result of the command, for the user.
    """
    return _encode(topics.RESET, device, unix_s, samples, {"text": text})


def encode_reconciled(
    device: str, unix_s: float, samples: int, result: Mapping[str, Any], status: int, folder: str | None
) -> bytes:
    """Encode the reply to ``imu/<device>/command/reconcile``: the keys of the report, exit status and folder.

    Parameters
    ----------
    device
        Name of the device.
    unix_s
        Unix time of the newest sample [s].
    samples
        Number of samples since the start.
    result
        The report as a mapping.
    status
        Exit status of the command.
    folder
        Folder that contains the complete report; None if it was not saved.
    """
    own = {key: value for key, value in result.items() if key not in ("schema", "device", "t", "samples")}
    return _encode(topics.RECONCILE, device, unix_s, samples, {**own, "exit": status, "folder": folder})


def encode_analysis(
    result: Analysis,
    total: TotalCurve | None = None,
    hadamard: HadamardCurve | None = None,
    dynamic: DynamicAllan | None = None,
    warmth: TemperatureShare | None = None,
) -> bytes:
    """Encode the output of ``analyze --json``, with the optional curves that were computed.

    Parameters
    ----------
    result
        The analysis.
    total
        Total variance.
    hadamard
        Hadamard variance.
    dynamic
        Dynamic Allan variance.
    warmth
        K and R after the temperature-correlated bias has been removed.
    """
    estimate = result.estimate
    rate_hz = estimate.rate_hz
    tau = _list(estimate.curve.tau_s)
    axes: dict[str, dict[str, Any]] = {}
    for i, axis in measured_axes(estimate):
        axes[axis] = {
            "allan": {"tau": tau, **_curve(estimate.curve, i)},
            **({"total": _deviation_of_axis(total.tau_s, total.tvar, total.lo, total.hi, i)} if total else {}),
            **(
                {"hadamard": _deviation_of_axis(hadamard.tau_s, hadamard.hvar, hadamard.lo, hadamard.hi, i)}
                if hadamard
                else {}
            ),
            "coefficients": coefficient_table(estimate.coefficients, i, bool(estimate.k_or_r[i])),
            "bandwidth": _number(result.bandwidth_hz[i]),
            **(
                {"temperature": _temperature_dependence(warmth, axis)}
                if axis in result.axes_of_temperature and warmth
                else {}
            ),
            **({"without_temperature": _without_temperature(warmth, axis)} if warmth and axis in warmth.models else {}),
        }
    payload = {
        "schema": ANALYZE_SCHEMA,
        "rate": rate_hz,
        "samples": estimate.samples,
        "seconds": result.seconds,
        "notes": result.notes,
        "axes": axes,
        "motions": [_motion(motion, rate_hz) for motion in result.motions],
        "changes": [_change(change, rate_hz) for change in result.changes],
    }
    if dynamic is not None:
        payload["dynamic"] = _dynamic(dynamic, measured_axes(estimate))
    return _ENCODER.encode(payload)


def encode_failed_analysis(why: str, samples: int) -> bytes:
    """Encode the output of ``analyze --json`` if the data do not support an estimate.

    Parameters
    ----------
    why
        The reason, for the user.
    samples
        Number of samples.
    """
    return _ENCODER.encode({"schema": ANALYZE_SCHEMA, "samples": samples, "notes": [why], "axes": {}})


def _window_payload(estimate: Estimate, **more: Any) -> dict[str, Any]:
    """Return rate, window length and filled part of the window, followed by ``more``."""
    filled_s = estimate.curve.n / estimate.rate_hz
    return {"rate": estimate.rate_hz, "window": estimate.window_s, "filled": filled_s, **more}


def _encode(topic: topics.Topic, device: str, unix_s: float | None, samples: int, payload: dict[str, Any]) -> bytes:
    """Encode a message of a topic."""
    return _ENCODER.encode({"schema": topic.schema(), "device": device, "t": unix_s, "samples": samples, **payload})


def measured_axes(estimate: Estimate) -> list[tuple[int, str]]:
    """Return the column and name of each axis that has a curve."""
    avar = estimate.curve.avar
    return [(i, axis) for i, axis in enumerate(AXES) if not np.isnan(avar[:, i]).all()]


def _curve(curve: AllanCurve, axis: int) -> dict[str, list[float]]:
    """Return the Allan deviation of one axis with its interval."""
    columns = {"deviation": np.sqrt(curve.avar), "lo": curve.lo, "hi": curve.hi}
    return {name: _list(column[:, axis]) for name, column in columns.items()}


def _deviation_of_axis(tau_s: Floats, variance: Floats, lo: Floats, hi: Floats, axis: int) -> dict[str, list[float]]:
    """Return another kind of deviation of one axis, with its own averaging times."""
    columns = {"deviation": np.sqrt(variance), "lo": lo, "hi": hi}
    return {"tau": _list(tau_s), **{name: _list(column[:, axis]) for name, column in columns.items()}}


def _temperature_dependence(warmth: TemperatureShare, axis: str) -> dict[str, Any]:
    """Return the measures of how strongly the bias of an axis depends on temperature."""
    one = warmth.dependences[axis]
    return {
        "share": one.share,
        "p_value": one.p_value,
        "form": one.form,
        "one_way": one.one_way,
        "interval": one.interval_s,
    }


def _without_temperature(warmth: TemperatureShare, axis: str) -> dict[str, Any]:
    """Return K and R of an axis after its temperature-correlated bias has been removed."""
    i = AXES.index(axis)
    table = coefficient_table(warmth.coefficients, i, warmth.k_or_r[i])
    return {
        "model": warmth.models[axis],
        "coefficients": {letter: table[letter] for letter in SLOW_LETTERS},
        "share": {letter: warmth.variance_share(letter, axis) for letter in SLOW_LETTERS},
    }


def _motion(motion: Motion, rate_hz: float) -> dict[str, Any]:
    """Return a detected motion; ``t`` is its start [s] after the first sample."""
    return {
        "kind": motion.kind,
        "axis": motion.axis,
        "t": motion.since / rate_hz,
        "seconds": motion.seconds,
        "peak": motion.peak,
        "text": motion.text,
    }


def _change(change: Change, rate_hz: float) -> dict[str, Any]:
    """Return a detected change; ``t`` is its start [s] after the first sample."""
    return {
        "kind": change.kind,
        "axis": AXES[change.axis],
        "t": change.since / rate_hz,
        "sigma": change.sigma,
        "what": change.sides(),
        "text": change.text,
    }


def _dynamic(dynamic: DynamicAllan, axes: Sequence[tuple[int, str]]) -> dict[str, Any]:
    """Return the dynamic Allan deviation as lists by time step; deviations hold one list by τ in each."""
    return {
        "window": dynamic.window_s,
        "t": _list(dynamic.t_s),
        "tau": _list(dynamic.tau_s),
        "axes": {
            axis: {
                "deviation": _list(dynamic.deviation[:, :, i]),
                "lo": _list(dynamic.lo[:, :, i]),
                "hi": _list(dynamic.hi[:, :, i]),
                "coefficients": {
                    letter: {
                        "value": _list(dynamic.value[:, row, i]),
                        "lo": _list(dynamic.value_lo[:, row, i]),
                        "hi": _list(dynamic.value_hi[:, row, i]),
                        "status": [Status(one).name.lower() for one in dynamic.status[:, row, i].tolist()],
                    }
                    for row, letter in enumerate(SYMBOLS)
                },
            }
            for i, axis in axes
        },
    }


def _band(band: PredictionInterval | None) -> dict[str, float] | None:
    """Return a predicted bias with its interval; None if there is no model."""
    return None if band is None else {"bias": band.bias, "lo": band.lo, "hi": band.hi}


def _number(value: float | np.float64) -> float | None:
    """Return the value, or None if it is not finite."""
    return float(value) if np.isfinite(value) else None


def _list(column: Floats) -> list[float]:
    """Return an array as a list."""
    result: list[float] = column.tolist()
    return result
