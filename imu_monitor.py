"""The entry point of the program ``imu-monitor``: imports its own packages, whatever else the environment offers.

``monitor``, ``drivers`` and ``config`` are common names. Another package or module of such a name on ``PYTHONPATH``
(every ROS shell sets it), in the current folder or imported by a ``sitecustomize`` would be found first. This module
has a name of its own. It stands beside the three folders and binds the names ``monitor`` and ``drivers`` to these
folders before it imports anything from them. The order of ``sys.path`` stays as it is, so that a module in
``site-packages`` cannot take the place of one of the standard library. ``config`` holds data only and is found beside
``monitor`` by its path.

``imu-monitor``, ``python -m imu_monitor`` and ``python -m monitor.cli`` end in ``main``.
"""

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Final, NoReturn

FOLDER: Final = os.path.dirname(os.path.abspath(__file__))
PACKAGES: Final = ("monitor", "drivers")
REQUIRED: Final = {"monitor": "cli/__init__.py", "drivers": "errors.py", "config": "demo.toml"}
"""A file of each folder that a foreign folder of that name does not have."""
DEBUG: Final = "--debug"
FAILED: Final = 1


class OwnPackages(MetaPathFinder):
    """Finds the program's own packages beside this file, and nothing else."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a package of the program is; None for every other module."""
        return PathFinder.find_spec(fullname, [FOLDER], target) if fullname in PACKAGES else None


def bind_own_packages() -> None:
    """Make ``monitor`` and ``drivers`` mean the folders beside this file, from now on and in this process.

    Foreign modules of these names that are already imported are dropped from ``sys.modules``.

    Raises
    ------
    ImportError
        A folder beside this file is missing or belongs to another package. The text names the folder.
    """
    for name, file in REQUIRED.items():
        folder = os.path.join(FOLDER, name)
        if not os.path.isfile(os.path.join(folder, file)):
            raise ImportError(
                f"{folder}: is missing or belongs to another package; install imu-monitor again, in an environment of "
                "its own"
            )
    if not any(isinstance(finder, OwnPackages) for finder in sys.meta_path):
        sys.meta_path.insert(0, OwnPackages())
    for name in PACKAGES:
        if name in sys.modules and not _is_own(sys.modules[name], name):
            for module in [one for one in sys.modules if one == name or one.startswith(f"{name}.")]:
                del sys.modules[module]


def open_standard_streams() -> None:
    """Give closed standard streams a file descriptor, so that no file that is opened later takes their numbers.

    Standard input is empty and standard error goes nowhere. Writing to standard output fails, as with a closed one.
    """
    for number, flags in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, flags)  # the lowest free number, which is this one
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, encoding="utf-8", closefd=False)
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a character that the locale lacks, or a file name that is no text, is written by its number
        sys.stdout.reconfigure(errors="backslashreplace")


def main() -> None:
    """Run the program; it ends with ``SystemExit``."""
    open_standard_streams()
    debug = DEBUG in sys.argv[1:]
    if not debug:
        warnings.simplefilter("ignore")  # they are for developers; the environment may even make errors of them
    try:
        bind_own_packages()
        from monitor.cli import main as run
    except ImportError as error:
        if debug:
            raise
        _fail(f"cannot be started: {' '.join(str(error).split())}")
    run()


def _is_own(module: ModuleType, name: str) -> bool:
    file = getattr(module, "__file__", None)  # None of a namespace package
    own = os.path.join(FOLDER, name, "__init__.py")
    with contextlib.suppress(OSError):
        return file is not None and os.path.samefile(file, own)
    return False


def _fail(line: str) -> NoReturn:
    with contextlib.suppress(OSError):
        print(f"imu-monitor: {line}", file=sys.stderr, flush=True)  # noqa: T201 - the program's message
    sys.exit(FAILED)


if __name__ == "__main__":
    main()
