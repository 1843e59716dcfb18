"""Paths of the files in ``config/``: example configurations, noise models and DBC files."""

import os
from pathlib import Path
from typing import Final

from drivers import file_access
from drivers import module_lookup as discovery
from drivers.errors import ConfigError

CONFIG_FOLDER: Final = Path(__file__).resolve().parents[2] / "config"


def resolve_model_path(name: str, folder: Path) -> Path:
    """Return the path of a noise model.

    Parameters
    ----------
    name : str
        Name of a shipped model, or path of a file.
    folder : Path
        Folder at which relative paths begin.

    Raises
    ------
    ConfigError
        If there is no such model and no such file. The message suggests the nearest name.
    """
    models = CONFIG_FOLDER / "models"
    shipped = models / f"{name}.toml"
    path = shipped if file_access.is_file(shipped) else folder / file_access.expand_user(name)
    if os.path.exists(path) and not path.is_dir():
        return path  # the reader reports a file that is no model
    names = sorted(file.stem for file in models.glob("*.toml"))
    raise ConfigError(
        f'no model "{name}", neither a file nor one of those shipped{discovery.format_suggestion(name, names)}'
    )
