"""Settings from a table, for tests of links and decoders."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from drivers.errors import ConfigError
from drivers.validation.settings_model import SettingsModel, check_table

Model = TypeVar("Model", bound=SettingsModel)


def read_settings(kind: type[Model], table: Mapping[str, Any], folder: Path | None = None) -> Model:
    """Return the settings of a table. Raise ConfigError with a line for each mistake."""
    checked = check_table(kind, table, folder)
    if checked.problems or checked.value is None:
        raise ConfigError(*map(str, checked.problems))
    return checked.value
