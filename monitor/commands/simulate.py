"""Command ``simulate``: writes a recording that is simulated with a noise model.

The samples are simulated and written in blocks, so that the required memory does not depend on the length. The
recording contains only the axes of the noise model. The truth file contains the noise model, the seed, and random
values such as the times of events.
"""

from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.recordings import Recording, open_recording_writer
from drivers.recordings.writing import atomic_write_path
from drivers.validation.number_ranges import SAMPLE_COUNT
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.commands.recording_loading import DEFAULT_LOADING, LoadingOptions, load_recording
from monitor.noise.model import NoiseModel
from monitor.noise.simulation import ModelStream, SimulatedSamples

TRUTH_SCHEMA: Final = "imu-monitor/truth/1"
RESULT_SCHEMA: Final = "imu-monitor/simulate/1"
CHUNK_ROWS: Final = 1 << 16


@dataclass(frozen=True, slots=True)
class SimulationRequest:
    """Noise model, output file and options of the command ``simulate``."""

    model: NoiseModel
    out: Path
    seconds: float
    seed: int
    rate_hz: float | None = None  # None for the rate of the model
    temperature_from: Path | None = None  # recording from which the temperature is taken
    truth: bool = False  # True to write a file with the drawn random values
    name: str = "the model"  # name of the model in messages
    loading: LoadingOptions = DEFAULT_LOADING  # options for reading the recording with the temperature


@dataclass(frozen=True, slots=True)
class SimulationResult:
    """Description of the simulated recording."""

    out: Path
    samples: int
    rate_hz: float
    seed: int
    axes: tuple[str, ...]
    temperature: bool
    truth: Path | None

    @property
    def duration_s(self) -> float:
        """Return the length of the recording in seconds."""
        return self.samples / self.rate_hz

    def describe_in_one_line(self) -> str:
        """Return a description of the recording in one line."""
        columns = " ".join([*self.axes, *(["temperature"] if self.temperature else [])])
        beside = f"; truth in {self.truth}" if self.truth else ""
        return (
            f"{self.out}: {self.samples} samples at {self.rate_hz:g} Hz, {self.duration_s:.6g} s, "
            f"seed {self.seed}: {columns}{beside}"
        )

    def encode_recording_summary_as_json(self) -> bytes:
        """Return the description of the recording as JSON."""
        return msgspec.json.encode(
            {
                "schema": RESULT_SCHEMA,
                "out": str(self.out),
                "samples": self.samples,
                "rate": self.rate_hz,
                "seconds": self.duration_s,
                "seed": self.seed,
                "axes": self.axes,
                "temperature": self.temperature,
                "truth": None if self.truth is None else str(self.truth),
            }
        )


class SampleGrid(NamedTuple):
    """Sample rate, number of samples and axes of a simulated recording."""

    rate_hz: float
    samples: int
    axes: tuple[str, ...]


def choose_sample_grid(
    model: NoiseModel, duration_s: float, rate_hz: float | None = None, name: str = "the model"
) -> SampleGrid:
    """Return the sample rate, the number of samples and the axes of a simulated recording.

    Parameters
    ----------
    model : NoiseModel
        Noise model to simulate.
    duration_s : float
        Length of the recording, s.
    rate_hz : float or None, optional
        Sample rate, Hz. None for the rate of the model.
    name : str, optional
        Name of the model in error messages.

    Raises
    ------
    ConfigError
        If the sample rate is unknown, if the recording has no or too many samples, or if the model has no axis.
    """
    rate_hz = rate_hz or model.sample_rate_hz
    if rate_hz is None:
        raise ConfigError(f"{name}: the model has no sample_rate; set the rate with --rate HZ")
    samples = round(duration_s * rate_hz)
    try:
        SAMPLE_COUNT.check(samples)
    except ConfigError as error:
        raise ConfigError(f"{duration_s:g} s at {rate_hz:g} Hz: {error}") from None
    axes = tuple(axis for axis in AXES if axis in model.effects)
    if not axes:
        raise ConfigError(f"{name}: the model has no axis; possible are {' '.join(AXES)}")
    return SampleGrid(rate_hz, samples, axes)


def start_stream(
    model: NoiseModel, rate_hz: float, seed: int, temperature_c: Floats | None = None, name: str = "the model"
) -> ModelStream:
    """Start a simulation. Error messages contain the name of the model.

    Parameters
    ----------
    model, rate_hz, seed, temperature_c
        See ``NoiseModel.start_stream``.
    name : str, optional
        Name of the model in error messages.

    Raises
    ------
    ConfigError
        If the model cannot be simulated.
    """
    try:
        return model.start_stream(rate_hz, seed, temperature_c)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from error


def run_simulation(request: SimulationRequest, report_progress: ProgressCallback = ignore_progress) -> SimulationResult:
    """Simulate a recording and write the recording to a file.

    Parameters
    ----------
    request : SimulationRequest
        Noise model, output file and options.
    report_progress : callable, optional
        Progress callback.

    Returns
    -------
    SimulationResult
        Description of the written recording.

    Raises
    ------
    ConfigError
        If the sample rate is unknown, if the noise model cannot be simulated, or if the file cannot be written.
    RecordingError
        If the recording with the temperature cannot be read.
    """
    grid = choose_sample_grid(request.model, request.seconds, request.rate_hz, request.name)
    rate_hz, n, axes = grid.rate_hz, grid.samples, grid.axes
    report_progress("preparing", None)
    stream = start_stream(
        request.model, rate_hz, request.seed, _temperature(request, rate_hz, n, report_progress), request.name
    )
    first = stream.draw_samples_with_temperature(min(n, CHUNK_ROWS))
    temperature = not bool(np.isnan(first.temperature_c).all())
    truth = request.out.with_name(request.out.name + ".truth.json") if request.truth else None
    result = SimulationResult(request.out, n, rate_hz, request.seed, axes, temperature, truth)
    if truth is None:
        _write(result, stream, first, report_progress)
    else:
        with atomic_write_path(truth) as part:
            _write(result, stream, first, report_progress)
            part.write_bytes(_truth(result, request.model, stream))
    return result


def _write(result: SimulationResult, stream: ModelStream, first: SimulatedSamples, tell: ProgressCallback) -> None:
    with open_recording_writer(result.out, result.axes, result.temperature) as append:
        block, written = first, 0
        while True:
            append(np.arange(written, written + len(block.values)) / result.rate_hz, block.values, block.temperature_c)
            written += len(block.values)
            tell("simulating", written / result.samples)
            if written == result.samples:
                break
            block = stream.draw_samples_with_temperature(min(CHUNK_ROWS, result.samples - written))
        tell("finishing the file", None)  # some formats are compressed only at the end


def _temperature(
    request: SimulationRequest, rate_hz: float, n: int, report_progress: ProgressCallback
) -> Floats | None:
    """Return the temperature [≤ n] in °C, interpolated to the times of the simulated samples.

    The result is None if no recording with a temperature is given.
    """
    if request.temperature_from is None:
        return None
    found = _load_recording(request, request.temperature_from, report_progress)
    known = np.isfinite(found.temperature_c)
    if not known.any():
        raise ConfigError(f"{request.temperature_from}: has no temperature; a column temperature in °C is needed")
    stored_s = found.t_s
    t_s = np.arange(len(found)) / (found.rate_hz or rate_hz) if stored_s is None else stored_s - stored_s[0]
    t_s, temperature_c = t_s[known], found.temperature_c[known]
    order = np.argsort(t_s, kind="stable")
    length = min(n, int(t_s.max() * rate_hz) + 1)
    return np.interp(np.arange(length) / rate_hz, t_s[order], temperature_c[order])


def _load_recording(request: SimulationRequest, path: Path, report_progress: ProgressCallback) -> Recording:
    """Load the recording of the temperature. The requested sample rate is used if the recording has none."""
    try:
        return load_recording(path, request.loading, report_progress)
    except ConfigError:
        if request.rate_hz is None:
            raise
        return load_recording(path, replace(request.loading, rate_hz=request.rate_hz), report_progress)


def _truth(result: SimulationResult, model: NoiseModel, stream: ModelStream) -> bytes:
    return msgspec.json.encode(
        {
            "schema": TRUTH_SCHEMA,
            "version": _version(),
            "model": model.to_dict(),
            "seed": result.seed,
            "rate": result.rate_hz,
            "seconds": result.duration_s,
            "samples": result.samples,
            "axes": result.axes,
            "drawn": stream.drawn_random_values(),
        }
    )


def _version() -> str | None:
    try:
        return version("imu-monitor")
    except PackageNotFoundError:
        return None
