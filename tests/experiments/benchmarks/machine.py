"""What the benchmarks share: who else is busy, what the machine is, medians of alternated runs, and their tables.

Ratios are taken from one run, the competitors in turn, so that a busy neighbour harms them alike. The
neighbours are measured: processor time of the whole machine less that of this process and its children.
"""

import os
import platform
import time
from collections.abc import Callable, Mapping
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
    """How busy others kept the machine while this process and its children measured."""

    def __init__(self) -> None:
        self._wall_s = time.monotonic()
        self._busy_s = _busy_s()
        self._own_s = _own_s()

    def others(self) -> float:
        """Cores that others used since the start, on average."""
        wall_s = time.monotonic() - self._wall_s
        return max(0.0, (_busy_s() - self._busy_s - (_own_s() - self._own_s)) / wall_s)

    def said(self) -> str:
        """For the foot of a table."""
        return f"meanwhile others used {self.others():.2f} of {os.cpu_count()} cores"


def _busy_s() -> float:
    t = psutil.cpu_times()
    return float(sum(t) - t.idle - getattr(t, "iowait", 0.0))


def _own_s() -> float:
    # children that were waited for are in os.times; those that still run are asked
    t = os.times()
    running = psutil.Process().children(recursive=True)
    return t.user + t.system + t.children_user + t.children_system + sum(_process_s(child) for child in running)


def _process_s(process: psutil.Process) -> float:
    try:
        t = process.cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(t.user + t.system)


def about() -> str:
    """Machine class and versions, one line."""
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"{os.cpu_count()}-core {platform.machine()}, Python {platform.python_version()}, {libraries}"


def alternate(works: Mapping[str, Callable[[], None]], rounds: int) -> dict[str, tuple[float, float]]:
    """(median, best) processor seconds of each work over that many rounds, one after the other in each round.

    Processor time of this thread: where others wait for the same cores, the clock on the wall measures them.
    """
    took: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            start = time.thread_time()
            work()
            took[name].append(time.thread_time() - start)
    return {name: (float(np.median(t)), min(t)) for name, t in took.items()}


def table(title: str, first: str, *columns: str) -> Table:
    """A table of figures: the first column words, the others numbers."""
    made = Table(title=title, title_justify="left")
    made.add_column(first)
    for heading in columns:
        made.add_column(heading, justify="right")
    return made
