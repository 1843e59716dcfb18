"""Command ``check``: finds all mistakes in a configuration file and in the noise models that the file names.

No device is opened. This module checks the noise models because the settings package must not import them.
"""

from collections.abc import Iterator
from pathlib import Path

from drivers.errors import ConfigError
from monitor.settings.loading import Config, ModelDependentSettings, examine_config_file


def check_configuration(path: Path, *, pipe: bool = False) -> tuple[Config | None, list[str]]:
    """Read a configuration file and return all mistakes.

    Parameters
    ----------
    path : Path
        Configuration file.
    pipe : bool, optional
        True if ``path`` may be a pipe.

    Returns
    -------
    config : Config or None
        Configuration, or None if the file contains a mistake.
    wrong : list of str
        One line of text for each mistake, beginning with the path of the file.
    """
    reading = examine_config_file(path, allow_pipe=pipe)
    wrong = [*reading.wrong, *(f"{path}: {use.device}: {line}" for use in reading.models for line in _problems(use))]
    return None if wrong else reading.config, wrong


def _problems(use: ModelDependentSettings) -> Iterator[str]:
    """Yield the mistakes in the noise model of a device or of a simulated sensor."""
    try:
        if use.model is not None:
            from monitor.daemon.operations.coefficient_limits import make_axis_limits
            from monitor.noise.model_loading import read_model

            make_axis_limits(use.limits, read_model(use.model))
    except ConfigError as error:
        yield from error.mistake_lines
    try:
        if use.virtual is not None:
            from monitor.simulator.encoding_sensor import check_noise_model_and_effects

            check_noise_model_and_effects(use.virtual)
    except ConfigError as error:
        yield from error.mistake_lines
