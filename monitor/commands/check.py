"""Find all mistakes in a configuration file and in the model files that it names; opens no device.

``settings.examine`` reads the configuration. Model files are read here, as the modules that know them stand above the
settings: the model in force of each device with the limits relative to it, and the model and the effects of each
simulated sensor.
"""

from collections.abc import Iterator
from pathlib import Path

from drivers.errors import ConfigError
from monitor.settings.loading import Config, ModelUse, examine


def check(path: Path, *, pipe: bool = False) -> tuple[Config | None, list[str]]:
    """Return the configuration, or None and all that is wrong with it.

    Parameters
    ----------
    path
        Configuration file.
    pipe
        True if a pipe is read as well, see ``small_file.read``.

    Returns
    -------
    tuple
        The configuration, None if anything is wrong, and one line for each mistake, which begins with the file.
    """
    reading = examine(path, pipe=pipe)
    wrong = [*reading.wrong, *(f"{path}: {use.device}: {line}" for use in reading.models for line in _problems(use))]
    return None if wrong else reading.config, wrong


def _problems(use: ModelUse) -> Iterator[str]:
    # each of them is imported where the configuration has it: most have neither
    try:
        if use.model is not None:
            from monitor.daemon.operations.limits import bounds
            from monitor.noise.catalogue import read_model

            bounds(use.limits, read_model(use.model))
    except ConfigError as error:
        yield from error.lines
    try:
        if use.virtual is not None:
            from monitor.simulator.sensor import check_sensor

            check_sensor(use.virtual)
    except ConfigError as error:
        yield from error.lines
