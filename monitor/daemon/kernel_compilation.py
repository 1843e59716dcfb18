"""Parallel compilation of the numerical kernels in child processes.

Numba compiles a kernel at its first call and keeps the machine code in a folder on disk. After an installation or an
upgrade this folder is empty, and compilation takes tens of seconds of processor time. Child processes therefore compile
the parts side by side, and this process loads each part from disk once it is compiled. The main loop is not delayed,
and the memory that the compiler needs is never allocated by the process that runs for months.

The stamp, a file in the same folder, shows that every part is compiled for this version of the program, of Numba and of
the processor.
"""

import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import IO, Final, NoReturn

import numba
import numpy as np
from llvmlite import binding

from drivers.extras import missing_packages
from drivers.sample import SampleBlock, make_block
from monitor.common.compiled import cache_folder, source_hash
from monitor.drift.compensation.arma import fit_arma
from monitor.drift.compensation.compensator import Compensator
from monitor.drift.thermal import thermal_response
from monitor.estimation.detection.change_detection import ChangeDetector
from monitor.estimation.detection.signal_monitor import SignalMonitor
from monitor.estimation.estimator import Estimator

MAX_PROCESSES: Final = 2
"""Largest number of compiling processes. Each takes some 200 MB, which must be available on a small board too."""
PROGRAM: Final = (
    sys.executable,
    "-P",
    str(Path(__file__).resolve().parents[2] / "imu_monitor.py"),
    "warm-up",
    "--from-stdin",
)
"""Command line of a child process."""
NICENESS: Final = 5
"""Niceness of the child processes. The processing of samples has priority."""
BAR_LENGTH: Final = 12
"""Length of the progress bar in characters."""


@dataclass(frozen=True, slots=True)
class KernelPart:
    """Kernels that are compiled together.

    Attributes
    ----------
    name : str
        Name of the computation, as shown to the user.
    prepare : callable
        Calls each kernel with every signature that the program uses. It compiles the kernels that are not in the cache
        on disk.
    """

    name: str
    prepare: Callable[[], None]


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of the compilation.

    Attributes
    ----------
    done : int
        Number of compiled parts.
    of : int
        Number of all parts.
    running : tuple of str
        Names of the parts that are being compiled.

    Examples
    --------
    >>> print(Progress(2, 8, ("change detection",)), Progress(2, 8).bar)
    compiling 3 of 8: change detection ███░░░░░░░░░
    """

    done: int
    of: int
    running: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the progress as one line of text."""
        return f"compiling {min(self.done + 1, self.of)} of {self.of}: {' and '.join(self.running)}"

    @property
    def share(self) -> float:
        """Share of the parts that are compiled, 0 to 1."""
        return self.done / self.of

    @property
    def bar(self) -> str:
        """Text bar that shows ``share``."""
        filled = round(BAR_LENGTH * self.share)
        return "█" * filled + "░" * (BAR_LENGTH - filled)


@dataclass(frozen=True, slots=True)
class KernelGroup:
    """Parts that are needed together. A part comes after the parts whose kernels it uses."""

    name: str
    parts: tuple[KernelPart, ...]


def prepare_kernels(
    group: KernelGroup, tell: Callable[[Progress], None], processes: int | None = None
) -> Iterator[str]:
    """Make the kernels of a group ready to be called, and yield the name of each part when it is ready.

    Parameters
    ----------
    group : Group
        Parts to prepare.
    tell : callable
        Called with a ``Progress`` when the compilation of a part begins or ends. Not called if all parts are in the
        cache on disk.
    processes : int, optional
        Number of child processes that compile. The default is one for each processor, at most ``MAX_PROCESSES``. With
        0, or if no cache folder can be written, this process compiles by itself.

    Yields
    ------
    str
        Name of the part that is ready.

    Raises
    ------
    OSError
        The cache cannot be written, for example on a full disk, or what ``tell`` raises.
    """
    if is_warm(group):
        for part in group.parts:
            part.prepare()
            yield part.name
        return
    folder = cache_folder()
    if folder is None:
        processes = 0
    elif processes is None:
        processes = min(_processors(), MAX_PROCESSES)
    with _Compilers(group.parts, processes, tell) as compilers:
        for done, part in enumerate(group.parts):
            if not compilers.wait_for(part):
                tell(Progress(done, len(group.parts), (part.name,)))  # no child has compiled it, so this process does
            part.prepare()
            yield part.name
    if folder is not None:
        _stamp_file(folder, group).touch()


def is_warm(group: KernelGroup) -> bool:
    """Return True if all kernels of a group are in the cache on disk, for this program, Numba and processor."""
    folder = cache_folder()
    return folder is not None and _stamp_file(folder, group).is_file()


def compile_from_stdin(stdin: IO[str], stdout: IO[str]) -> NoReturn:
    """Compile the parts whose names arrive line by line, and answer each line with the same line.

    This function is the child's side of ``prepare_kernels``. The process ends when its standard input closes, even in
    the middle of a compilation, because its parent has ended then.

    Parameters
    ----------
    stdin : text file
        Source of the part names.
    stdout : text file
        Receives the name of each compiled part.
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


@dataclass(slots=True)
class _Job:
    """Compilation of one part."""

    part: KernelPart
    finished: bool = False
    compiled: bool = False


class _Compilers:
    """Pool of child processes, each with a thread that passes one part after the other to it."""

    def __init__(self, parts: Sequence[KernelPart], processes: int, tell: Callable[[Progress], None]) -> None:
        self._jobs = {part.name: _Job(part) for part in parts}
        self._waiting = list(self._jobs.values())
        self._running: list[str] = []
        self._tell = tell
        self._lock = threading.Lock()
        self._changes: queue.SimpleQueue[Progress] = queue.SimpleQueue()
        self._children: list[subprocess.Popen[str]] = []
        self._processes = processes
        self._active_threads = processes  # number of threads that still take parts

    def __enter__(self) -> "_Compilers":
        for number in range(self._processes):
            threading.Thread(target=self._work, name=f"compiler {number}", daemon=True).start()
        if not self._processes:
            self._release_waiting()
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._waiting.clear()
            for child in self._children:
                child.kill()

    def wait_for(self, part: KernelPart) -> bool:
        """Wait until a child process has compiled a part, and report the progress meanwhile.

        Returns
        -------
        bool
            False if no child process will compile the part.
        """
        job = self._jobs[part.name]
        while not (job.finished and self._changes.empty()):
            progress = self._changes.get()
            if progress.running:
                self._tell(progress)
        return job.compiled

    def _work(self) -> None:
        """Run one child process. If it cannot be started or has ended, this process compiles the remaining parts."""
        try:
            with suppress(OSError):
                self._pass_parts_to_child()
        finally:
            with self._lock:
                self._active_threads -= 1
                if self._active_threads == 0:
                    self._release_waiting()

    def _pass_parts_to_child(self) -> None:
        """Pass parts to a child process until none is left or the child fails."""
        pipe = subprocess.PIPE
        child = subprocess.Popen(
            PROGRAM, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, start_new_session=True
        )
        with child:
            os.setpriority(os.PRIO_PROCESS, child.pid, NICENESS)
            self._children.append(child)
            while job := self._next_job():
                try:
                    job.compiled = _compile_in_child(child, job.part)
                finally:
                    self._finish(job)
                if not job.compiled:
                    break

    def _release_waiting(self) -> None:
        """Release the waiting parts, so that this process compiles them."""
        for job in self._waiting:
            job.finished = True
        self._put_progress()

    def _next_job(self) -> _Job | None:
        """Return the next part to compile; None if no part is left."""
        with self._lock:
            if not self._waiting:
                return None
            job = self._waiting.pop(0)
            self._running.append(job.part.name)
            self._put_progress()
            return job

    def _finish(self, job: _Job) -> None:
        """Report the end of the compilation of a part."""
        with self._lock:
            self._running.remove(job.part.name)
            job.finished = True
            self._put_progress()

    def _put_progress(self) -> None:
        """Queue the progress for the thread that waits."""
        done = sum(job.compiled for job in self._jobs.values())
        self._changes.put(Progress(done, len(self._jobs), tuple(self._running)))


def _compile_in_child(child: "subprocess.Popen[str]", part: KernelPart) -> bool:
    """Let a child process compile a part; return True if it has."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        print(part.name, file=child.stdin, flush=True)
        return child.stdout.readline().rstrip("\n") == part.name
    except OSError:
        return False


def _processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # missing on macOS
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _stamp_file(folder: Path, group: KernelGroup) -> Path:
    """Return the path of the stamp of a group. The file name depends on everything that the machine code depends on."""
    machine = [binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()]
    parts = [part.name for part in group.parts]
    everything = [*parts, source_hash(Path(__file__)), numba.__version__, sys.version, *machine]
    return folder / f"{group.name}-{sha256(' '.join(everything).encode()).hexdigest()[:16]}.warm"


def _samples(n: int) -> SampleBlock:
    """Return a block of ``n`` samples with value zero."""
    return make_block(np.arange(n, dtype=np.int64), np.zeros((n, 6)))


def _call_window() -> None:
    """Call the kernels of the Allan deviation."""
    Estimator(100.0, 1.0).update(_samples(100))


def _call_fit() -> None:
    """Call the kernels of the noise coefficients."""
    estimator = Estimator(100.0, 1.0)
    estimator.update(_samples(100))
    estimator.get()


def _call_motion_detection() -> None:
    """Call the kernels of the motion detection."""
    SignalMonitor(100.0, alarms_per_day=0.0).update(_samples(100))


def _call_change_detection() -> None:
    """Call the kernels of the change detection."""
    SignalMonitor(100.0).update(_samples(100))
    ChangeDetector(100.0).restart()


def _call_compensation() -> None:
    """Call the kernels of the drift compensation."""
    compensator = Compensator(100.0)
    compensator.compensate(1e-3 * np.random.default_rng(0).standard_normal((6000, 6)))
    compensator.set_model(0, fit_arma(*compensator.identification_data(0), [(2, 1)]))
    compensator.compensate(np.zeros((1, 6)), lost=1)
    _ = compensator.error


def _call_slow_statistics() -> None:
    """Call the kernels of the total and Hadamard deviations."""
    estimator = Estimator(100.0, 1.0)
    estimator.update(_samples(100))
    estimator.restart(0, 10)
    while estimator.step_slow_statistics() is None:  # total and Hadamard deviation
        pass


def _call_refit() -> None:
    """Call the kernels of the refit at every sample."""
    Estimator(100.0, 1.0, every_sample=True).update(_samples(100))


def _call_temperature_lag() -> None:
    """Call the kernels of the thermal model."""
    thermal_response.first_order_lag(np.zeros(2), 0.5)


def _call_analysis() -> None:
    """Call the kernels of the analysis of recordings."""
    from monitor.estimation.analysis import analyze  # imported here because the service does not need it

    analyze([_samples(100)], 100.0)


def _call_reconciliation() -> None:
    """Call the kernels of the reconciliation."""
    from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
    from monitor.noise.model import NoiseModel
    from monitor.reconcile.preparation.recording import Recording
    from monitor.reconcile.reconcile import reconcile  # imported here because the service does not need it

    model = NoiseModel({"gz": (AngleRandomWalk(N=1e-4), BiasInstability(B=3e-5), RateRandomWalk(K=1e-6))})
    series, rng = model.simulate(4200, 10.0, 1)[:, 2], np.random.default_rng(1)
    size = float(np.std(series))
    series += 4.0 * size * (rng.integers(0, 2, 42).repeat(100) + (np.arange(4200) > 2100))
    series[::500] += 20.0 * size
    reconcile(Recording({"gz": series}, 10.0, np.linspace(20.0, 30.0, 4200)), model, seed=1)


WINDOW: Final = "Allan deviation"
"""Name of the part after which a window can be filled."""
FIT: Final = "noise coefficients"
"""Name of the part after which coefficients can be fitted."""
SERVICE: Final = KernelGroup(
    "service",
    (
        KernelPart(WINDOW, _call_window),
        KernelPart("motion detection", _call_motion_detection),
        KernelPart(FIT, _call_fit),
        KernelPart("change detection", _call_change_detection),
        KernelPart("drift compensation", _call_compensation),
        KernelPart("total and Hadamard deviation", _call_slow_statistics),
        KernelPart("refit at every sample", _call_refit),
        KernelPart("temperature lag", _call_temperature_lag),
    ),
)
"""Parts that the running service needs, in the order in which it needs them."""
_ANALYSIS: Final = KernelPart("analysis of recordings", _call_analysis)
_RECONCILIATION: Final = KernelPart("reconciliation", _call_reconciliation)
COMMANDS: Final = KernelGroup(
    "commands", (_ANALYSIS,) if missing_packages("reconcile") else (_ANALYSIS, _RECONCILIATION)
)
"""Parts that only the commands on recordings need. A few kernels of rare cases are compiled at their first call."""
GROUPS: Final = (SERVICE, COMMANDS)
"""All groups."""
