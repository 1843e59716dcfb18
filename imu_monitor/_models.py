"""Noise models, simulated recordings, and parameter files of other programs."""

from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.recordings import memory_check
from drivers.validation.number_ranges import DURATION_S, RATE_HZ, SEED
from imu_monitor._estimates import AllanEstimate
from imu_monitor._message_wording import errors_name_arguments
from imu_monitor._recordings import Recording, check_range
from monitor.commands.simulate import choose_sample_grid, start_stream
from monitor.common.shipped_config_paths import list_shipped_models
from monitor.noise import model_loading
from monitor.noise.model import NoiseModel
from monitor.publishing import exporters

ModelSource = NoiseModel | str | PathLike[str]
"""Noise model, name of a shipped model, or path of a model file."""


def list_models() -> list[str]:
    """Return the names of the shipped noise models.

    Examples
    --------
    >>> import imu_monitor
    >>> "consumer-mems" in imu_monitor.list_models()
    True
    """
    return list_shipped_models()


@errors_name_arguments()
def load_model(name_or_path: str | PathLike[str]) -> NoiseModel:
    """Read a noise model from a file, or return one of the shipped models.

    Parameters
    ----------
    name_or_path : str or path-like
        Name of a shipped model (``list_models``), or path of a model file.

    Raises
    ------
    ConfigError
        If there is no such model, or if the file does not contain a valid model.

    Examples
    --------
    >>> import imu_monitor
    >>> imu_monitor.load_model("consumer-mems").sample_rate_hz
    100.0
    """
    return model_loading.load_model(fspath(name_or_path), Path.cwd())


def to_model(model: ModelSource) -> tuple[NoiseModel, str]:
    """Return a noise model, and its name for messages."""
    return (model, "the model") if isinstance(model, NoiseModel) else (load_model(model), fspath(model))


@errors_name_arguments()
def simulate(
    model: ModelSource,
    duration_s: float,
    rate_hz: float | None = None,
    *,
    seed: int = 1,
    temperature_c: ArrayLike | None = None,
) -> Recording:
    """Simulate a recording of a noise model.

    The samples are the same as those that ``imu-monitor simulate`` writes with the same seed.

    Parameters
    ----------
    model : NoiseModel, str or path-like
        Noise model, name of a shipped model, or path of a model file.
    duration_s : float
        Duration in s.
    rate_hz : float, optional
        Sample rate in Hz. By default, the rate of the model.
    seed : int
        Seed of the random numbers. The same seed gives the same samples.
    temperature_c : array_like, shape (n,), optional
        Temperature of each sample in °C, which replaces the temperature of the model. After the end of the array, the
        last value is repeated.

    Returns
    -------
    Recording
        Simulated samples of the axes of the model.

    Raises
    ------
    ConfigError
        If the sample rate is unknown, if the model cannot be simulated, or if the samples do not fit into memory.

    Examples
    --------
    >>> import imu_monitor
    >>> from imu_monitor.effects import AngleRandomWalk, ConstantBias
    >>> model = imu_monitor.NoiseModel({"gz": (AngleRandomWalk(N=1e-4), ConstantBias(value=0.02))})
    >>> recording = imu_monitor.simulate(model, duration_s=10.0, rate_hz=200.0)
    >>> recording
    <Recording of gz: 2000 samples, 10 s>
    >>> print(f"{recording['gz'].mean():.4f} rad/s")
    0.0200 rad/s
    """
    noise, name = to_model(model)
    check_range("seed", SEED, seed)
    check_range("duration_s", DURATION_S, duration_s)
    check_range("rate_hz", RATE_HZ, rate_hz)
    grid = choose_sample_grid(noise, duration_s, rate_hz, name)
    free = memory_check.available_bytes()
    needed = memory_check.COPIES * grid.samples * memory_check.ROW_BYTES
    if free is not None and needed > free:
        raise ConfigError(
            f"duration_s: {grid.samples} samples need {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free"
        )
    given: Floats | None = None if temperature_c is None else np.array(temperature_c, np.float64)
    if given is not None and (given.ndim != 1 or not given.size or not np.isfinite(given).all()):
        raise ConfigError(f"temperature_c: shape {given.shape}; expected are finite values of shape (n,)")
    stream = start_stream(noise, grid.rate_hz, seed, given, name)
    found = stream.draw_samples_with_temperature(grid.samples)
    values = np.full((grid.samples, len(AXES)), np.nan)
    for axis in grid.axes:
        values[:, AXES.index(axis)] = found.values[:, AXES.index(axis)]
    return Recording(None, values, np.array(found.temperature_c), grid.rate_hz, grid.axes, ())


@errors_name_arguments()
def export_parameters(
    source: AllanEstimate | ModelSource | Sequence[AllanEstimate],
    format: str,  # noqa: A002 - the name that users expect
    *,
    inflation: float = 1.0,
    dt_s: float | None = None,
    correlation_time_s: float | None = None,
    rostopic: str | None = None,
) -> str:
    """Return noise parameters as the text of a parameter file of another program.

    The text is the same as the output of ``imu-monitor export``. Comments in the text state the units and the source of
    the parameters. For an analysis, the comments also state the 95 % intervals.

    Parameters
    ----------
    source : AllanEstimate, NoiseModel, str, path-like or sequence of AllanEstimate
        Result of ``analyze``, noise model, name of a shipped model, path of a model file, or several results with
        different axes.
    format : str
        Program that reads the parameters, such as "kalibr", "openvins", "px4_ekf2" (docs/reference/export.md).
    inflation : float
        Factor by which N, B and K are multiplied, at least 1.
    dt_s : float, optional
        Time step in s of the program that reads the parameters. Only for formats that depend on the time step.
    correlation_time_s : float, optional
        Correlation time in s of the process that represents B, for the formats "kalman" and "gnss_ins_sim".
    rostopic : str, optional
        Topic of the IMU. Only for formats that contain a topic.

    Raises
    ------
    ConfigError
        If the format is unknown, an argument does not apply to the format, or the model lacks a coefficient.
    NotReady
        If the recording determines none of the coefficients.

    Examples
    --------
    >>> import imu_monitor
    >>> text = imu_monitor.export_parameters("consumer-mems", "kalibr", inflation=5.0)
    >>> print(next(line for line in text.splitlines() if line.startswith("gyroscope_noise_density")))
    gyroscope_noise_density: 7.500000e-04
    """
    if isinstance(source, NoiseModel | str | PathLike):
        model, name = to_model(source)
        noise = exporters.from_model(model, name)
    else:
        results = [source] if isinstance(source, AllanEstimate) else source
        # the JSON of ``to_dict``
        noise = exporters.join_sources([exporters.from_analysis_json(one._message().encode()) for one in results])  # noqa: SLF001
    return exporters.export(
        noise, format, inflation, dt_s=dt_s, correlation_time_s=correlation_time_s, rostopic=rostopic
    )
