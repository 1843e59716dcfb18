"""Functions that read noise models from the catalogue ``config/models`` or from a file."""

from pathlib import Path

from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from monitor.common.shipped_config_paths import resolve_model_path
from monitor.noise.model import NoiseModel


def read_model(path: Path) -> NoiseModel:
    """Read a noise model from a file.

    Raises
    ------
    ConfigError
        If the file cannot be read or does not contain a valid noise model.
    """
    try:
        return NoiseModel.from_toml(safe_file_reading.read_small_file(path).decode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except ConfigError as error:
        raise ConfigError(*(f"{path}: {line}" for line in error.mistake_lines)) from error


def load_model(name_or_path: str, base_folder: Path) -> NoiseModel:
    """Read a noise model from the catalogue or from a file.

    Parameters
    ----------
    name_or_path : str
        Name of a noise model in the catalogue, or path of a model file.
    base_folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    ConfigError
        If the noise model does not exist or is not valid.
    """
    return read_model(resolve_model_path(name_or_path, base_folder))
