"""Load of the machine, description of the machine, times of alternating runs, and tables for all benchmarks.

The methods of a comparison run alternately, so that a load by other processes affects them alike. The load is the
processor time of the whole machine less that of this process and its children.
"""

import contextlib
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from typing import Final

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

LIBRARIES: Final = ("numpy", "scipy", "numba", "eclipse-zenoh", "pyserial", "allantools")
WIDTH: Final = 118

console = Console(width=WIDTH)


class Load:
    """Processor time that other processes used during a measurement."""

    def __init__(self) -> None:
        self._wall_s = time.monotonic()
        self._busy_s = _busy_s()
        self._own_s = _own_s()

    def others(self) -> float:
        """Return the mean number of cores that other processes used since the start."""
        wall_s = time.monotonic() - self._wall_s
        return max(0.0, (_busy_s() - self._busy_s - (_own_s() - self._own_s)) / wall_s)

    def describe(self) -> str:
        """Return a sentence for the end of a table."""
        return f"other processes used {self.others():.2f} of {os.cpu_count()} cores during the measurement"


@contextlib.contextmanager
def run_busy_processes(processes: int, processors: set[int]) -> Iterator[None]:
    """Keep processors busy with child processes. Other processes that start meanwhile use the same processors."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, processors)  # child processes inherit this
    children = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()
        os.sched_setaffinity(0, before)


def _busy_s() -> float:
    t = psutil.cpu_times()
    return float(sum(t) - t.idle - getattr(t, "iowait", 0.0))


def _own_s() -> float:
    # os.times includes only children that have ended
    t = os.times()
    running = psutil.Process().children(recursive=True)
    return t.user + t.system + t.children_user + t.children_system + sum(_process_s(child) for child in running)


def _process_s(process: psutil.Process) -> float:
    try:
        t = process.cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(t.user + t.system)


def describe_machine() -> str:
    """Return the machine type and the versions of libraries in one line."""
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"{os.cpu_count()}-core {platform.machine()}, Python {platform.python_version()}, {libraries}"


def time_alternately(works: Mapping[str, Callable[[], None]], rounds: int) -> dict[str, tuple[float, float]]:
    """Run all works in each round, and return the median and least processor time of each work in seconds.

    The times are processor times of this thread, because the wall clock also measures other processes.
    """
    took: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            start = time.thread_time()
            work()
            took[name].append(time.thread_time() - start)
    return {name: (float(np.median(t)), min(t)) for name, t in took.items()}


def create_table(title: str, first: str, *columns: str) -> Table:
    """Return a table whose first column contains text and whose other columns contain numbers."""
    new_table = Table(title=title, title_justify="left")
    new_table.add_column(first)
    for heading in columns:
        new_table.add_column(heading, justify="right")
    return new_table
