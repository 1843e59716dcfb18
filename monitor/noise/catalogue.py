"""Noise models by name: one of the shipped catalogue in ``config/models``, or a file of one's own."""

from pathlib import Path

from drivers import file_access
from drivers.errors import ConfigError
from monitor.noise.model import NoiseModel
from monitor.settings.loading import model_path


def read_model(path: Path) -> NoiseModel:
    """The model in a file.

    Raises:
        ConfigError: one line: the file, the place in it, what is wrong
    """
    try:
        return NoiseModel.from_toml(file_access.read(path).decode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except ConfigError as error:
        raise ConfigError(*(f"{path}: {line}" for line in error.lines)) from error


def load(name: str, folder: Path) -> NoiseModel:
    """The model of that name in the catalogue, or in that file; relative paths begin at ``folder``.

    Raises:
        ConfigError: there is none, with the nearest name; or what is wrong with it
    """
    return read_model(model_path(name, folder))
