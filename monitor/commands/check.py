"""Command ``check``: finds all mistakes in a configuration file and in the model files that it names. No device is
opened.

``settings.examine`` reads the configuration. Model files are read here, because the modules for models are in a higher
layer than the settings. The check covers the noise model of each device with the limits that are relative to the model,
and the model and effects of each simulated sensor.
"""

from collections.abc import Iterator
from pathlib import Path

from drivers.errors import ConfigError
from monitor.settings.loading import Config, ModelDependentSettings, examine


def check_configuration(path: Path, *, pipe: bool = False) -> tuple[Config | None, list[str]]:
    """Read a configuration file and find all mistakes.

    Parameters
    ----------
    path : Path
        Configuration file.
    pipe : bool, optional
        True if a pipe may be read as well, see ``drivers.file_access.read``.

    Returns
    -------
    config : Config or None
        Configuration; None if there is any mistake.
    wrong : list of str
        One line for each mistake, which begins with the file.
    """
    reading = examine(path, pipe=pipe)
    wrong = [*reading.wrong, *(f"{path}: {use.device}: {line}" for use in reading.models for line in _problems(use))]
    return None if wrong else reading.config, wrong


def _problems(use: ModelDependentSettings) -> Iterator[str]:
    """Yield the mistakes in the model files of a device."""
    # imported only if needed, because most configurations have neither a model nor a simulated sensor
    try:
        if use.model is not None:
            from monitor.daemon.operations.coefficient_limits import make_axis_limits
            from monitor.noise.model_loading import read_model

            make_axis_limits(use.limits, read_model(use.model))
    except ConfigError as error:
        yield from error.lines
    try:
        if use.virtual is not None:
            from monitor.simulator.encoding_sensor import check_sensor

            check_sensor(use.virtual)
    except ConfigError as error:
        yield from error.lines
