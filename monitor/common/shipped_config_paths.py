"""Paths of the configuration files and noise models that are shipped with the program."""

import os
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from drivers.validation import module_lookup

CONFIG_FOLDER: Final = Path(__file__).resolve().parents[2] / "config"
MODELS_FOLDER: Final = CONFIG_FOLDER / "models"


def list_shipped_models() -> list[str]:
    """Return the names of the shipped noise models in alphabetical order."""
    return sorted(file.stem for file in MODELS_FOLDER.glob("*.toml"))


def resolve_model_path(name: str, folder: Path) -> Path:
    """Return the path of a noise model that is given by name or by path.

    Parameters
    ----------
    name : str
        Name of a shipped model, or path of a model file.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    ConfigError
        If no such noise model exists. The message suggests the most similar name.
    """
    shipped = MODELS_FOLDER / f"{name}.toml"
    path = shipped if safe_file_reading.is_file(shipped) else folder / safe_file_reading.expand_user(name)
    if os.path.exists(path) and not path.is_dir():
        return path
    suggestion = module_lookup.format_suggestion(name, list_shipped_models())
    raise ConfigError(f'no model "{name}", neither a file nor one of those shipped{suggestion}')
