"""Python interface of imu-monitor, and the entry point of the command ``imu-monitor``.

The names in ``__all__`` are the public interface (docs/reference/python-api.md). Each name is imported when it is first
used, so that ``import imu_monitor`` and the start of the command stay fast.

``monitor`` and ``drivers`` are common names. Another package with one of these names would be found first if it is in
the current folder, in a folder on ``PYTHONPATH`` (which every ROS shell sets), or imported by a ``sitecustomize``. The
name ``imu_monitor`` is unique, and the package is next to the folders ``monitor``, ``drivers`` and ``config``. The
import of ``imu_monitor`` binds the names ``monitor`` and ``drivers`` to these folders. The order of ``sys.path`` is not
changed, so that a module in ``site-packages`` cannot replace a module of the standard library. The folder ``config``
contains only data, and is located by its path next to ``monitor``.

The commands ``imu-monitor`` and ``python -m imu_monitor`` call ``main``.
"""

import atexit
import contextlib
import gc
import importlib
import io
import os
import sys
import threading
import warnings
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, NoReturn

if TYPE_CHECKING:
    from drivers.errors import ConfigError, ImuError, NotReady, RecordingError
    from imu_monitor import effects
    from imu_monitor._allan_window import AllanWindow
    from imu_monitor._analysis import Analysis, analyze
    from imu_monitor._estimates import AllanEstimate, AxisEstimate, Coefficient, Deviations, plot_allan
    from imu_monitor._models import export_parameters, list_models, load_model, simulate
    from imu_monitor._reconciliation import Reconciliation, reconcile
    from imu_monitor._recordings import Recording, read_recording
    from monitor.noise.model import NoiseModel

    __version__: str

__all__ = [
    "AllanEstimate",
    "AllanWindow",
    "Analysis",
    "AxisEstimate",
    "Coefficient",
    "ConfigError",
    "Deviations",
    "ImuError",
    "NoiseModel",
    "NotReady",
    "Reconciliation",
    "Recording",
    "RecordingError",
    "analyze",
    "effects",
    "export_parameters",
    "list_models",
    "load_model",
    "plot_allan",
    "read_recording",
    "reconcile",
    "simulate",
]
_MODULES: Final = {
    "drivers.errors": ("ConfigError", "ImuError", "NotReady", "RecordingError"),
    "imu_monitor._analysis": ("Analysis", "analyze"),
    "imu_monitor._estimates": ("AllanEstimate", "AxisEstimate", "Coefficient", "Deviations", "plot_allan"),
    "imu_monitor._models": ("export_parameters", "list_models", "load_model", "simulate"),
    "imu_monitor._reconciliation": ("Reconciliation", "reconcile"),
    "imu_monitor._recordings": ("Recording", "read_recording"),
    "imu_monitor._allan_window": ("AllanWindow",),
    "monitor.noise.model": ("NoiseModel",),
}
"""Modules that define the public names. A module is imported when one of its names is first used."""

FOLDER: Final = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
PACKAGES: Final = ("monitor", "drivers")
REQUIRED: Final = {"monitor": "cli/__init__.py", "drivers": "errors.py", "config": "demo.toml"}
"""For each folder, a file that a folder of another project with the same name does not contain."""
DEBUG: Final = "--debug"
FAILED: Final = 1
GARBAGE_THRESHOLD: Final = 20_000
"""Number of new objects between two garbage collections. Imports create many objects that are not garbage."""


class OwnPackages(MetaPathFinder):
    """Finder for the packages ``monitor`` and ``drivers`` next to this package. Other modules are not found."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the location of ``monitor`` or ``drivers``. Return None for any other module."""
        return PathFinder.find_spec(fullname, [FOLDER], target) if fullname in PACKAGES else None


def bind_own_packages() -> None:
    """Bind the names ``monitor`` and ``drivers`` to the folders next to this package, in the whole process.

    If modules of other projects with these names have already been imported, they are removed from ``sys.modules``.

    Raises
    ------
    ImportError
        If a folder next to this package is missing or belongs to another package. The error text names the folder.
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
    """Open the standard streams that are closed, so that files that are opened later do not get their numbers.

    Standard input is then empty, and standard error is discarded. Writing to standard output still fails.
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
    """Run the program and end the process, or raise ``SystemExit``."""
    open_standard_streams()
    gc.set_threshold(GARBAGE_THRESHOLD)
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
    try:
        run()
    except SystemExit as end:
        others = [one for one in threading.enumerate() if one is not threading.main_thread()]
        if others and not isinstance(end.code, str) and all(one.daemon for one in others):
            _exit_beside_threads(int(end.code or 0))
        raise


def _exit_beside_threads(status: int) -> NoReturn:
    """End the process without the interpreter's own end, which aborts the process if a thread computes a transform."""
    atexit._run_exitfuncs()  # noqa: SLF001 - there is no public name
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


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


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used.

    Raises
    ------
    AttributeError
        If there is no public name ``name``.
    ImportError
        If the folder ``monitor`` or ``drivers`` is missing or belongs to another package.
    """
    value: Any
    if name == "__version__":
        from importlib import metadata

        value = metadata.version("imu-monitor")
    elif name == "effects":
        value = importlib.import_module("imu_monitor.effects")
    else:
        module = next((module for module, names in _MODULES.items() if name in names), None)
        if module is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        bind_own_packages()
        value = getattr(importlib.import_module(module), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


if __name__ == "__main__":
    main()
else:
    with contextlib.suppress(ImportError):  # ``main`` and the first use of a public name report the missing folder
        bind_own_packages()
