"""Noise models by name: from the catalogue in ``config/models``, or from a user's file."""

from pathlib import Path

from drivers import file_access
from drivers.errors import ConfigError
from monitor.common.shipped_config_paths import resolve_model_path
from monitor.noise.model import NoiseModel


def read_model(path: Path) -> NoiseModel:
    """Return the model in a file.

    Raises
    ------
    ConfigError
        If the file cannot be read or is not valid. Each line names the file and the table.
    """
    try:
        return NoiseModel.from_toml(file_access.read_small_file(path).decode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except ConfigError as error:
        raise ConfigError(*(f"{path}: {line}" for line in error.lines)) from error


def load_model(name: str, folder: Path) -> NoiseModel:
    """Return a model of the catalogue by its name, or the model in a file.

    Parameters
    ----------
    name : str
        Name in the catalogue, or path of a file.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    ConfigError
        If there is no such model, or if it is not valid.
    """
    return read_model(resolve_model_path(name, folder))
