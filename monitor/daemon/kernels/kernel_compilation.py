"""Parallel compilation of the numerical kernels in child processes.

Numba compiles a kernel at the first call and stores the machine code in a cache folder. After an installation, the
folder is empty, and compilation takes tens of seconds of processor time. Child processes therefore compile the kernels
in parallel, and the main process loads the machine code from disk.

A stamp file in the cache folder shows that all kernels are compiled for the current program, Numba and processor.
"""

import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import IO, Final, NoReturn

import numba
from llvmlite import binding

from monitor.common.compiled import hash_module_with_imports, kernel_cache_folder
from monitor.common.program_command_line import PROGRAM
from monitor.daemon.kernels.kernel_groups import GROUPS, KernelGroup, KernelPart

MAX_PROCESSES: Final = 2
"""Maximum number of compiling processes. Each process needs about 200 MB of memory."""
COMPILER: Final = (*PROGRAM, "warm-up", "--from-stdin")
"""Command line of a child process."""
NICENESS: Final = 5
"""Niceness of the child processes."""
BAR_LENGTH: Final = 12
"""Length of the progress bar in characters."""


@dataclass(frozen=True, slots=True)
class CompilationProgress:
    """Progress of the compilation.

    Examples
    --------
    >>> print(CompilationProgress(2, 8, ("change detection",)), CompilationProgress(2, 8).bar_of_block_characters)
    compiling 3 of 8: change detection ███░░░░░░░░░
    """

    done: int  # number of compiled parts
    of: int  # number of all parts
    running: tuple[str, ...] = ()  # names of the parts that are being compiled

    def __str__(self) -> str:
        """Return the progress as one line of text."""
        return f"compiling {min(self.done + 1, self.of)} of {self.of}: {' and '.join(self.running)}"

    @property
    def compiled_share(self) -> float:
        """Fraction of the parts that are compiled, from 0 to 1."""
        return self.done / self.of

    @property
    def bar_of_block_characters(self) -> str:
        """Text of the progress bar."""
        filled = round(BAR_LENGTH * self.compiled_share)
        return "█" * filled + "░" * (BAR_LENGTH - filled)


def prepare_kernels(
    group: KernelGroup, report_progress: Callable[[CompilationProgress], None], processes: int | None = None
) -> Iterator[str]:
    """Compile the kernels of a group or load them from the cache, and yield the name of each finished part.

    Parameters
    ----------
    group : KernelGroup
        Parts to prepare.
    report_progress : callable
        Function that is called when the compilation of a part begins or ends.
    processes : int, optional
        Number of child processes, by default at most ``MAX_PROCESSES``. If the number is 0, the calling process
        compiles the kernels.

    Yields
    ------
    str
        Name of a finished part.

    Raises
    ------
    OSError
        If the cache cannot be written, for example on a full disk.
    """
    if is_warm(group):
        for part in group.parts:
            part.prepare()
            yield part.name
        return
    folder = kernel_cache_folder()
    if folder is None:
        processes = 0
    elif processes is None:
        processes = min(_count_processors(), MAX_PROCESSES)
    with closing(_ChildProcesses(group.parts, processes)) as children:
        for done, part in enumerate(group.parts):
            if not children.wait_for_part(part, report_progress):
                report_progress(CompilationProgress(done, len(group.parts), (part.name,)))
            part.prepare()
            yield part.name
    if folder is not None:
        _stamp_file(folder, group).touch()


def is_warm(group: KernelGroup) -> bool:
    """Return True if all kernels of a group are cached for the current program, Numba and processor."""
    folder = kernel_cache_folder()
    return folder is not None and _stamp_file(folder, group).is_file()


def compile_from_stdin(stdin: IO[str], stdout: IO[str]) -> NoReturn:
    """Compile parts of the kernels in a child process, and exit when the standard input closes.

    The function reads one part name per line, compiles the part, and writes the name.

    Parameters
    ----------
    stdin : text file
        Standard input, with part names.
    stdout : text file
        Standard output, for the names of compiled parts.
    """
    parts = {part.name: part for group in GROUPS for part in group.parts}
    names: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in stdin:
            names.put(line.rstrip("\n"))
        os._exit(0)

    threading.Thread(target=read, name="names of parts", daemon=True).start()
    while True:
        name = names.get()
        parts[name].prepare()
        print(name, file=stdout, flush=True)


class _ChildProcesses:
    """Child processes that compile parts of the kernels, each controlled by a thread.

    If a child process fails, the calling process compiles the remaining parts.
    """

    def __init__(self, parts: Sequence[KernelPart], processes: int) -> None:
        self._number_of_parts = len(parts)
        self._waiting = deque(part.name for part in parts)
        self._running: list[str] = []
        # True if a child process has compiled the part, False if the calling process must compile the part
        self._compiled: dict[str, bool] = {}
        self._changes: queue.SimpleQueue[CompilationProgress] = queue.SimpleQueue()
        self._children: list[subprocess.Popen[str]] = []
        self._active_threads = processes
        self._lock = threading.Lock()
        for number in range(processes):
            threading.Thread(target=self._run_child, name=f"compiler {number}", daemon=True).start()
        if not processes:
            self._leave_waiting_parts()

    def close(self) -> None:
        """Kill the child processes."""
        with self._lock:
            self._waiting.clear()
            for child in self._children:
                child.kill()

    def wait_for_part(self, part: KernelPart, report_progress: Callable[[CompilationProgress], None]) -> bool:
        """Wait for a part, and return False if the calling process must compile the part."""
        while part.name not in self._compiled or not self._changes.empty():
            progress = self._changes.get()
            if progress.running:
                report_progress(progress)
        return self._compiled[part.name]

    def _run_child(self) -> None:
        """Send part names to a child process until no part is left or the child process fails."""
        pipe = subprocess.PIPE
        try:
            with (
                suppress(OSError),
                subprocess.Popen(
                    COMPILER, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, start_new_session=True
                ) as child,
            ):
                os.setpriority(os.PRIO_PROCESS, child.pid, NICENESS)
                self._children.append(child)
                while (name := self._begin_next()) is not None:
                    compiled = _compile_in_child(child, name)
                    self._finish(name, compiled)
                    if not compiled:
                        break
        finally:
            with self._lock:
                self._active_threads -= 1
                if self._active_threads == 0:
                    self._leave_waiting_parts()

    def _leave_waiting_parts(self) -> None:
        self._compiled |= dict.fromkeys(self._waiting, False)
        self._put_progress()

    def _begin_next(self) -> str | None:
        with self._lock:
            if not self._waiting:
                return None
            name = self._waiting.popleft()
            self._running.append(name)
            self._put_progress()
            return name

    def _finish(self, name: str, compiled: bool) -> None:
        with self._lock:
            self._running.remove(name)
            self._compiled[name] = compiled
            self._put_progress()

    def _put_progress(self) -> None:
        done = sum(self._compiled.values())
        self._changes.put(CompilationProgress(done, self._number_of_parts, tuple(self._running)))


def _compile_in_child(child: "subprocess.Popen[str]", name: str) -> bool:
    """Compile a part in a child process; return True on success."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        print(name, file=child.stdin, flush=True)
        return child.stdout.readline().rstrip("\n") == name
    except OSError:
        return False


def _count_processors() -> int:
    affinity = getattr(os, "sched_getaffinity", None)  # missing on macOS
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _stamp_file(folder: Path, group: KernelGroup) -> Path:
    """Return the path of the stamp file of a group, whose name depends on everything that affects the machine code."""
    machine = [binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()]
    parts = [part.name for part in group.parts]
    everything = [*parts, hash_module_with_imports(Path(__file__)), numba.__version__, sys.version, *machine]
    return folder / f"{group.name}-{sha256(' '.join(everything).encode()).hexdigest()[:16]}.warm"
