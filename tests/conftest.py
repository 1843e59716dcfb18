"""Start of the test session: kernels, number of parallel workers, and threads that must end with their test."""

import gc
import os
import signal
import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, settings

# This must be set before NumPy is imported. As in the program, the matrices are too small for parallel linear algebra.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ.get("OPENBLAS_NUM_THREADS", "1")
# Foreign packages named monitor, drivers or config may come first on the module path. Tests and the programs that they
# start import the packages of this project.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH"))))

import imu_monitor  # noqa: F401 - binds the packages of the project
from drivers import secret_masking
from tests.support.kernels import compile_kernels
from tests.support.ports import release_claims
from tests.support.waiting import PATIENCE_S

WORKERS_PER_CORE: Final = 2
"""Some tests wait, so two workers for each core keep the processors busy. Each worker collects all tests."""
MAX_WORKERS: Final = 12
LONG_FOLDERS: Final = {"benchmarks", "blind", "fuzz", "system"}
"""End-to-end, fault, network and fuzzing tests, blind trials of the reconciliation, and tests of the benchmarks."""

SLOWEST_TESTS: Final = (
    "test_no_recording_of_600_of_the_model_has_a_finding",
    "test_commands_of_tutorial_print_what_it_shows",
    "test_wandering_lines_are_named",
)
"""Tests that run first. Otherwise, one worker could run one of them alone at the end."""

# By default, Hypothesis limits the elapsed time of each example to 200 ms. A loaded machine exceeds this limit.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers for ``-n auto``."""
    return min(WORKERS_PER_CORE * (os.cpu_count() or 1), MAX_WORKERS)


def pytest_configure() -> None:
    """Receive SIGINT even if the shell that started pytest in the background ignores it.

    Programs that tests start inherit an ignored signal, and could not be interrupted.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels before any worker or test starts, so that no test's time limit includes it."""
    if session.config.option.collectonly:
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    compile_kernels(_ignore_line if reporter is None else reporter.write_line)


def _ignore_line(_line: str) -> None: ...


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the slowest tests first, and mark the tests of ``LONG_FOLDERS`` as long before tests are selected by markers.

    pytest-randomly has shuffled the tests before.
    """
    items.sort(key=lambda item: not item.name.startswith(SLOWEST_TESTS))
    for item in items:
        if not LONG_FOLDERS.isdisjoint(item.nodeid.partition("::")[0].split("/")):
            item.add_marker("long")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip the folders of the long tests if no long test is selected, because every worker would import them."""
    return True if collection_path.name in LONG_FOLDERS and "not long" in config.option.markexpr else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep the garbage collector from searching the hundreds of thousands of objects of ten thousand tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_collect_file(file_path: Path) -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """Search for doctests, which takes long, only in files that contain an example."""
    found = yield
    if not found or ">>>" in file_path.read_text("utf-8"):
        return found
    return [one for one in found if type(one) is pytest.Module]


def pytest_unconfigure() -> None:
    """Release the ports that this process has claimed."""
    release_claims()


@pytest.fixture(autouse=True)
def _forget_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a test remember secrets that do not affect the texts of other tests."""
    monkeypatch.setattr(secret_masking, "_fragments", {length: set() for length in secret_masking._fragments})


@pytest.fixture(autouse=True)
def _wait_for_drift_threads() -> Iterator[None]:
    """Wait for the threads that identify a drift.

    pytest and SciPy both set warning filters, which apply to the whole process. A thread that outlives its test would
    run under the filters of the next test.
    """
    yield
    for thread in threading.enumerate():
        if thread.name.startswith("drift of "):
            thread.join(PATIENCE_S)
