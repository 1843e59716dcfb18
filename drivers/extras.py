"""Packages that only an extra of the installation brings: are they there, and how to install them."""

import importlib.util
from collections.abc import Mapping
from typing import Final

from drivers.errors import ConfigError

EXTRAS: Final[Mapping[str, Mapping[str, str]]] = {
    "can": {"can": "python-can", "cantools": "cantools"},
    "reconcile": {"scipy": "SciPy"},
}
"""Extra -> module -> name of its package."""


def missing_packages(extra: str) -> tuple[str, ...]:
    """Return the names of the packages of an extra that are not installed."""
    return tuple(package for module, package in EXTRAS[extra].items() if importlib.util.find_spec(module) is None)


def check_extra(extra: str, user: str) -> None:
    """Raise ConfigError if a package of an extra is not installed.

    Parameters
    ----------
    extra : key of EXTRAS.
    user : what needs the packages, as the subject of the message.
    """
    if missing := missing_packages(extra):
        raise ConfigError(f'{user} needs {" and ".join(missing)}: pip install "imu-monitor[{extra}]"')
