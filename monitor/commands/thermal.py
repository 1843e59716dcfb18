"""Commands ``thermal fit`` and ``thermal predict``: fit thermal models to a recording, and predict the bias of another.

If a model of an axis cannot be fitted or used, the reason is reported, and the remaining axes are processed.
"""

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from drivers.data_types import AXES
from drivers.errors import ConfigError, NotReady
from drivers.host import safe_file_reading
from drivers.recordings import iter_blocks
from drivers.validation.number_ranges import DURATION_S, FIT_NUMBER
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.commands.recording_loading import DEFAULT_LOADING, LoadingOptions, load_recording
from monitor.drift.thermal.interval_means import IntervalMeans, compute_interval_means
from monitor.drift.thermal.thermal_fit import fit_thermal_model
from monitor.drift.thermal.thermal_model import ThermalModel
from monitor.drift.thermal.thermal_response import ThermalModelForm
from monitor.drift.thermal.thermal_results import (
    ThermalFitReport,
    ThermalPredictionReport,
    choose_interval_s,
    compare_model_with_means,
)
from monitor.estimation.regular_grid import place_samples_on_grid

SCHEMA: Final = "imu-monitor/thermal-model/1"


class _AxisModelRecord(msgspec.Struct):
    """Thermal model of one axis in a model file."""

    powers: int
    time_constants: list[float]
    reference: float
    sizes: list[float]
    start: list[float]
    phi: float
    sigma: float
    covariance: list[list[float]]
    temperature: tuple[float, float]
    equation: dict[str, list[float] | float] | None = None
    """Difference equation for other programs. ``read_model_file`` ignores the difference equation."""


class _ModelFile(msgspec.Struct):
    """Content of a model file."""

    schema: str
    interval: float
    axes: dict[str, _AxisModelRecord]


def fit_thermal_models(
    recording: Path,
    interval_s: float | None = None,
    loading: LoadingOptions = DEFAULT_LOADING,
    report_progress: ProgressCallback = ignore_progress,
) -> ThermalFitReport:
    """Fit a thermal model to each axis of a recording.

    Parameters
    ----------
    recording : Path
        Recording with temperature.
    interval_s : float, optional
        Length of an interval in seconds. By default, the interval is about 1/72 of the recording.
    loading : LoadingOptions, optional
        Options for reading the recording.
    report_progress : callable, optional
        Progress callback.

    Raises
    ------
    RecordingError, ConfigError
        If the recording cannot be read, or if it has no temperature.
    """
    means, notes = _read_interval_means(recording, interval_s, loading, report_progress)
    interval = next(iter(means.values())).interval_s  # rounded to a whole number of samples
    fits, refused = {}, {}
    for axis, one in means.items():
        try:
            fits[axis] = fit_thermal_model(one)
        except NotReady as error:
            refused[axis] = str(error)
    return ThermalFitReport(recording.name, interval, means, fits, refused, notes)


def predict_bias_of_recording(
    recording: Path,
    models: Mapping[str, ThermalModel],
    loading: LoadingOptions = DEFAULT_LOADING,
    report_progress: ProgressCallback = ignore_progress,
) -> ThermalPredictionReport:
    """Predict the bias of a recording with thermal models that were fitted to an earlier recording.

    Parameters
    ----------
    recording : Path
        Recording with temperature.
    models : mapping of str to ThermalModel
        Thermal model of each axis.
    loading : LoadingOptions, optional
        Options for reading the recording.
    report_progress : callable, optional
        Progress callback.

    Raises
    ------
    RecordingError, ConfigError
        If the recording cannot be read, or if it has no temperature.
    """
    interval = next(iter(models.values())).interval_s
    means, notes = _read_interval_means(recording, interval, loading, report_progress)
    judged, refused = {}, {}
    for axis, one in means.items():
        if axis not in models:
            refused[axis] = "the model file has no model of this axis"
        elif one.both_known.sum() < 2:
            refused[axis] = f"fewer than two intervals of {interval:g} s"
        else:
            judged[axis] = compare_model_with_means(models[axis], one)
    return ThermalPredictionReport(recording.name, interval, means, judged, refused, notes)


def encode_model_file(report: ThermalFitReport) -> bytes:
    """Return the content of the model file with the thermal models of all fitted axes."""
    rows = {axis: _row(one.model) for axis, one in report.fits.items()}
    return msgspec.json.format(msgspec.json.encode(_ModelFile(SCHEMA, report.interval_s, rows)), indent=1)


def read_model_file(path: Path) -> dict[str, ThermalModel]:
    """Read the thermal model of each axis from a model file.

    Raises
    ------
    ConfigError
        If the file cannot be read, or if its content is invalid.
    """
    try:
        found = msgspec.json.decode(safe_file_reading.read_small_file(path, allow_pipe=True), type=_ModelFile)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not a thermal model: {error}") from error
    if found.schema != SCHEMA:
        raise ConfigError(f'{path}: unknown schema "{found.schema}"; "{SCHEMA}" is expected')
    if not found.axes:
        raise ConfigError(f"{path}: there is no axis in the file")
    try:
        DURATION_S.check(found.interval)
    except ConfigError as error:
        raise ConfigError(f"{path}: interval: {error}") from None
    return {axis: _model(path, axis, row, found.interval) for axis, row in found.axes.items()}


def _row(model: ThermalModel) -> _AxisModelRecord:
    return _AxisModelRecord(
        powers=model.shape.powers,
        time_constants=list(model.shape.constants_s),
        reference=model.reference_c,
        sizes=model.coefficients.tolist(),
        start=model.initial_state.tolist(),
        phi=model.phi,
        sigma=model.sigma,
        covariance=model.covariance.tolist(),
        temperature=(model.lowest_c, model.highest_c),
        equation=model.equation,
    )


def _model(path: Path, axis: str, row: _AxisModelRecord, interval_s: float) -> ThermalModel:
    k = len(row.time_constants)
    terms = 1 + row.powers + k
    size = terms + 2 * k
    square = len(row.covariance) == size and all(len(one) == size for one in row.covariance)
    numbers = (row.reference, row.phi, row.sigma, *row.temperature, *row.sizes, *row.start, *chain(*row.covariance))
    wrong = [
        (axis in AXES, f"no such axis; possible are {', '.join(AXES)}"),
        (row.powers >= 0, f"powers: {row.powers}; it must be 0 or more"),
        (
            all(map(DURATION_S.supports, row.time_constants)),
            f"time_constants: each must be {DURATION_S.format_range()}",
        ),
        (
            all(map(FIT_NUMBER.supports, numbers)),
            f"a number is outside the supported range {FIT_NUMBER.format_range()}",
        ),
        (len(row.sizes) == terms, f"sizes: {len(row.sizes)} values; {terms} are needed"),
        (len(row.start) == k, f"start: {len(row.start)} values; {k} are needed"),
        (
            row.temperature[0] < row.temperature[1],
            "temperature: the lowest and then the highest temperature of the fit are needed",
        ),
        (0.0 <= row.phi < 1.0, f"phi: {row.phi:g}; it must be from 0 to below 1"),
        (square, f"covariance: {size} rows and columns are needed"),
    ]
    for right, text in wrong:
        if not right:
            raise ConfigError(f"{path}: axes.{axis}: {text}")
    return ThermalModel(
        shape=ThermalModelForm(row.powers, tuple(row.time_constants)),
        interval_s=interval_s,
        reference_c=row.reference,
        coefficients=np.array(row.sizes),
        initial_state=np.array(row.start),
        phi=row.phi,
        sigma=row.sigma,
        covariance=np.array(row.covariance, dtype=np.float64),
        lowest_c=row.temperature[0],
        highest_c=row.temperature[1],
    )


def _read_interval_means(
    recording: Path, interval_s: float | None, loading: LoadingOptions, report_progress: ProgressCallback
) -> tuple[dict[str, IntervalMeans], tuple[str, ...]]:
    """Return the interval means of each recorded axis, and notes about the recording."""
    found = load_recording(recording, loading, report_progress)
    grid = place_samples_on_grid(list(iter_blocks(found)), found.rate_hz)
    if not np.isfinite(grid.temperature_c).any():
        raise ConfigError(f"{recording}: there is no temperature; a column temp or temperature in °C is needed")
    interval_s = interval_s or choose_interval_s(len(grid.values) / grid.rate_hz, grid.rate_hz)
    means = {
        axis: compute_interval_means(grid.values[:, at], grid.temperature_c, grid.rate_hz, interval_s)
        for at, axis in enumerate(AXES)
        if np.isfinite(grid.values[:, at]).any()
    }
    return means, (*found.notes, *grid.notes_with_missing())
