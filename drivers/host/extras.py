"""Check that the optional packages of an extra (``pip install imu-monitor[extra]``) are installed."""

import importlib.util
import os
import shlex
import shutil
import sys
from collections.abc import Mapping
from typing import Final

from drivers.errors import ConfigError

EXTRAS: Final[Mapping[str, Mapping[str, str]]] = {
    "can": {"can": "python-can", "cantools": "cantools"},
    "reconcile": {"scipy": "SciPy"},
    "ros": {"rosbags": "rosbags"},
    "px4": {"pyulog": "pyulog"},
    "ardupilot": {"pymavlink": "pymavlink"},
    "pattern": {"re2": "google-re2"},
}
"""Modules that each extra provides, with the name of the package that contains each module."""


def find_missing_packages(extra: str) -> tuple[str, ...]:
    """Return the names of the packages of an extra that are not installed."""
    return tuple(package for module, package in EXTRAS[extra].items() if importlib.util.find_spec(module) is None)


def install_command(requirement: str) -> str:
    """Return the command that installs a requirement into the environment of the program.

    pip finds ``imu-monitor[extra]`` in an environment in which imu-monitor is installed, also from a clone of the
    repository. pip in another environment would look for imu-monitor on the package index.
    """
    pip = shutil.which("pip")
    if pip is None or os.path.dirname(pip) != os.path.dirname(sys.executable):
        return f'{shlex.quote(sys.executable)} -m pip install "{requirement}"'
    return f'pip install "{requirement}"'


def require_extra(extra: str, feature: str) -> None:
    """Check that all packages of an extra are installed.

    Parameters
    ----------
    extra
        Key of EXTRAS.
    feature
        Feature that needs the packages, as the subject of the message.

    Raises
    ------
    ConfigError
        If a package is missing. The error text contains the ``pip`` command.
    """
    if missing := find_missing_packages(extra):
        command = install_command(f"imu-monitor[{extra}]")
        raise ConfigError(f"{feature} needs {' and '.join(missing)}: {command}")
