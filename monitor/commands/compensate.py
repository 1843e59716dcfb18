"""Command ``compensate``: removes the gyro drift from a recording and measures the improvement.

The method ``adaptive`` processes the samples one by one, as the daemon does. The method ``fixed`` does not adapt the
estimated drift noise. All methods are evaluated on the same samples, which were taken while the sensor was at rest. The
first third of the samples at rest is excluded from the evaluation, because some methods use it for learning.
"""

from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError, NotReady
from drivers.recordings import iter_blocks
from drivers.recordings.writing import save_samples
from drivers.validation.module_lookup import format_suggestion
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.commands.recording_loading import DEFAULT_LOADING, LoadingOptions, load_recording
from monitor.drift.compensation.arma import ORDERS, Order, fit_arma
from monitor.drift.compensation.compensation_score import AxisCompensation, DriftCompensationResult, score_at_rest
from monitor.drift.compensation.gyro_drift_compensator import Compensator, MeasuredAndPredictedDrift
from monitor.drift.compensation.reference_methods import REFERENCE_METHODS, apply_reference_method
from monitor.drift.compensation.sage_husa import MIN_CONFIRMED_INTERVALS, REJECTED, STEPPED, USED
from monitor.estimation.regular_grid import place_samples_on_grid

METHODS: Final = ("adaptive", "fixed", *REFERENCE_METHODS)
GYROS: Final = AXES[:3]
LEARNING_SHARE: Final = 1.0 / 3.0
"""Fraction of the samples at rest that is used for learning and excluded from the evaluation."""


def run_compensation(
    recording: Path,
    out: Path,
    method: str = "adaptive",
    order: Order | None = None,
    loading: LoadingOptions = DEFAULT_LOADING,
    report_progress: ProgressCallback = ignore_progress,
) -> DriftCompensationResult:
    """Remove the gyro drift from a recording and write the compensated recording.

    Parameters
    ----------
    recording, out : Path
        Recording to compensate, and file to write.
    method : str
        One of METHODS.
    order : Order, optional
        Order of the ARMA drift model. By default, a criterion selects the order.
    loading : LoadingOptions, optional
        Options for reading the recording.
    report_progress : callable, optional
        Function that receives the progress.

    Returns
    -------
    DriftCompensationResult
        Quality of the uncompensated and compensated angular rates of each gyro axis.

    Raises
    ------
    ConfigError, RecordingError
        If the method is unknown, the recording cannot be read or has no gyro axis, or the result cannot be written.
    NotReady
        If the sensor was never at rest for long enough. In this case, no file is written.
    """
    if method not in METHODS:
        raise ConfigError(f'--method: unknown method "{method}"{format_suggestion(method, METHODS)}')
    found = load_recording(recording, loading, report_progress)
    axes = tuple(axis for axis in GYROS if axis in found.axes)
    if not axes:
        raise ConfigError(f"{recording}: there is no gyro axis; columns gx, gy, gz in rad/s are needed")
    grid = place_samples_on_grid(list(iter_blocks(found)), found.rate_hz)
    values, temperature_c, rate_hz, notes = grid.values, grid.temperature_c, grid.rate_hz, grid.notes_with_missing()
    orders = ORDERS if order is None else (order,)
    live = Compensator(rate_hz, adapts=method != "fixed", orders=orders)
    compensated = _run(live, values, report_progress)
    intervals = tuple(live.take_finished_intervals())
    rest = _at_rest(intervals, len(values), live.interval_samples)
    learned, judged = _split_learning(rest)
    if not judged.any():
        raise NotReady(
            f"{recording}: never at rest for {MIN_CONFIRMED_INTERVALS * live.interval_s:g} s, "
            "so the drift cannot be learned"
        )
    if method in REFERENCE_METHODS:
        compensated = _compensate_offline(method, values, learned, axes, report_progress)
    report_progress("evaluating", None)
    judged_axes: dict[str, AxisCompensation] = {
        str(axis): _evaluate_axis(AXES.index(axis), values, compensated, learned, judged, live, intervals)
        for axis in axes
    }
    start_s = 0.0 if (stored_s := found.t_s) is None else float(stored_s[0])
    t_s = start_s + np.arange(len(values)) / rate_hz
    there = np.flatnonzero(np.isfinite(compensated).any(axis=1))
    report = partial(report_progress, "writing")
    save_samples(out, t_s[there], compensated[there], temperature_c[there], found.axes, report)
    return DriftCompensationResult(
        recording=recording.name,
        out=out,
        method=method,
        rate_hz=rate_hz,
        samples=len(values),
        interval_s=live.interval_s,
        learning_rest_s=float(learned.any(axis=1).sum() / rate_hz),
        evaluated_rest_s=float(judged.any(axis=1).sum() / rate_hz),
        intervals=intervals,
        axes=judged_axes,
        notes=(*found.notes, *notes),
    )


def _run(live: Compensator, values: Floats, tell: ProgressCallback) -> Floats:
    """Compensate the drift as the daemon does, except that each drift model is identified without delay."""
    out = np.empty_like(values)
    size = live.interval_samples
    for start in range(0, len(values), size):
        out[start : start + size] = live.compensate(values[start : start + size])
        live.identify_due_models()
        if start % (256 * size) == 0:
            tell("compensating", start / len(values))
    return out


def _at_rest(intervals: tuple[MeasuredAndPredictedDrift, ...], n: int, size: int) -> NDArray[np.bool_]:
    """Return a mask [n, 3] that is True for samples in intervals at rest with a known bias."""
    mask = np.zeros((n, len(GYROS)), dtype=bool)
    for one in intervals:
        mask[one.end - size : one.end] = (one.outcome == USED) & np.isfinite(one.expected)
    return mask


def _split_learning(rest: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Split the samples at rest into two masks: the first third for learning, and the remainder for evaluation."""
    count = np.cumsum(rest, axis=0)
    first = count <= LEARNING_SHARE * count[-1]
    return rest & first, rest & ~first


def _compensate_offline(
    method: str, values: Floats, learned: NDArray[np.bool_], axes: tuple[str, ...], tell: ProgressCallback
) -> Floats:
    out = values.copy()
    for axis in axes:
        at = AXES.index(axis)
        tell(f"{method} {axis}", None)
        out[:, at] = apply_reference_method(values[:, at], values[learned[:, at], at], REFERENCE_METHODS[method])
    return out


def _evaluate_axis(
    at: int,
    values: Floats,
    out: Floats,
    learned: NDArray[np.bool_],
    judged: NDArray[np.bool_],
    live: Compensator,
    intervals: tuple[MeasuredAndPredictedDrift, ...],
) -> AxisCompensation:
    before = values[:, at] - np.nanmean(values[learned[:, at], at])
    first = int(np.argmax(judged[:, at]))
    model = live.models[at]
    became = np.array([one.outcome[at] for one in intervals])
    return AxisCompensation(
        model=None
        if model is None
        else fit_arma(
            *live.means_and_noise_variance_for_identification(at), [model.order], with_confidence_intervals=True
        ),
        uncompensated=score_at_rest(np.where(judged[:, at], before, np.nan)[first:], live.rate_hz),
        compensated=score_at_rest(np.where(judged[:, at], out[:, at], np.nan)[first:], live.rate_hz),
        rejected_intervals=int((became == REJECTED).sum()),
        steps=int((became == STEPPED).sum()),
    )
