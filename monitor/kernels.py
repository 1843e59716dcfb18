"""Compilation of the numerical kernels, in parts and by processes of its own.

Numba compiles a kernel at its first call and keeps the machine code in a folder on disk. After an installation or an
upgrade this folder is empty, and compilation takes tens of seconds of processor time. Child processes therefore compile
the parts side by side, and this process loads each part from disk once it is compiled. The main loop is not held up,
and the memory that the compiler needs is never taken by the process that runs for months.

A file in the same folder, the stamp, says that every part is there for this version of the program, of Numba and of the
processor.
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
from drivers.sample import SampleBlock, block
from monitor.compiled import cache_folder, stamp
from monitor.drift import heat
from monitor.drift.arma import identify
from monitor.drift.compensator import Compensator
from monitor.estimate.change import ChangeDetector
from monitor.estimate.estimator import Estimator
from monitor.estimate.watch import Watch

MAX_PROCESSES: Final = 2
"""Each takes some 200 MB while it compiles, which a small board has to have."""
PROGRAM: Final = (
    sys.executable,
    "-P",
    str(Path(__file__).resolve().parent.parent / "imu_monitor.py"),
    "warm-up",
    "--from-stdin",
)
NICENESS: Final = 5
"""Niceness of the child processes. The processing of samples has priority."""
BAR_LENGTH: Final = 12


@dataclass(frozen=True, slots=True)
class Part:
    """Kernels that are compiled together.

    Attributes
    ----------
    name
        What they compute, in the words of the user.
    prepare
        Calls each kernel with every signature that the program uses. It compiles what is not in the cache on disk.
    """

    name: str
    prepare: Callable[[], None]


@dataclass(frozen=True, slots=True)
class Progress:
    """How far compilation is; ``running`` are the parts that are being compiled just now.

    >>> print(Progress(2, 8, ("change detection",)), Progress(2, 8).bar)
    compiling 3 of 8: change detection ███░░░░░░░░░
    """

    done: int
    of: int
    running: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line for people."""
        return f"compiling {min(self.done + 1, self.of)} of {self.of}: {' and '.join(self.running)}"

    @property
    def share(self) -> float:
        """The part of the work that is done, 0 to 1."""
        return self.done / self.of

    @property
    def bar(self) -> str:
        """``share`` as a bar of characters."""
        filled = round(BAR_LENGTH * self.share)
        return "█" * filled + "░" * (BAR_LENGTH - filled)


@dataclass(frozen=True, slots=True)
class Group:
    """Parts that are needed together; a part comes after those whose kernels it uses too."""

    name: str
    parts: tuple[Part, ...]


def prepare(group: Group, tell: Callable[[Progress], None], processes: int | None = None) -> Iterator[str]:
    """Make the kernels of a group ready to be called; yield the name of each part when it is.

    Parameters
    ----------
    group
        What is needed.
    tell
        Called when the compilation of a part begins or ends. Not called if all parts are in the cache on disk.
    processes
        How many child processes compile; by default one for each processor, at most ``MAX_PROCESSES``. With 0, or where
        nothing can be kept on disk, this process compiles by itself.

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
                tell(Progress(done, len(group.parts), (part.name,)))  # no child has compiled it: this process does
            part.prepare()
            yield part.name
    if folder is not None:
        _stamp_file(folder, group).touch()


def is_warm(group: Group) -> bool:
    """Return True if all kernels of a group are in the cache on disk, for this program, Numba and processor."""
    folder = cache_folder()
    return folder is not None and _stamp_file(folder, group).is_file()


def compile_from_stdin(stdin: IO[str], stdout: IO[str]) -> NoReturn:
    """Compile the parts whose names come line by line, and answer each line with the same line: the child's side.

    The process ends when its standard input does, even in the middle of a compilation, as its parent has ended then.
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
    part: Part
    finished: bool = False
    compiled: bool = False


class _Compilers:
    """Child processes, each with a thread that hands it one part after the other."""

    def __init__(self, parts: Sequence[Part], processes: int, tell: Callable[[Progress], None]) -> None:
        self._jobs = {part.name: _Job(part) for part in parts}
        self._waiting = list(self._jobs.values())
        self._running: list[str] = []
        self._tell = tell
        self._lock = threading.Lock()
        self._changes: queue.SimpleQueue[Progress] = queue.SimpleQueue()
        self._children: list[subprocess.Popen[str]] = []
        self._processes = processes
        self._left = processes  # threads that still take parts

    def __enter__(self) -> "_Compilers":
        for number in range(self._processes):
            threading.Thread(target=self._work, name=f"compiler {number}", daemon=True).start()
        if not self._processes:
            self._give_up()
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._waiting.clear()
            for child in self._children:
                child.kill()

    def wait_for(self, part: Part) -> bool:
        """Wait until a child has compiled a part and report the progress meanwhile; return False if none will."""
        job = self._jobs[part.name]
        while not (job.finished and self._changes.empty()):
            progress = self._changes.get()
            if progress.running:
                self._tell(progress)
        return job.compiled

    def _work(self) -> None:
        try:
            with suppress(OSError):  # no process can be started, or it ended: the parts are compiled by this process
                self._hand_out_parts()
        finally:
            with self._lock:
                self._left -= 1
                if self._left == 0:
                    self._give_up()

    def _hand_out_parts(self) -> None:
        pipe = subprocess.PIPE
        child = subprocess.Popen(
            PROGRAM, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, start_new_session=True
        )
        with child:
            os.setpriority(os.PRIO_PROCESS, child.pid, NICENESS)
            self._children.append(child)
            while job := self._next():
                try:
                    job.compiled = _compiled_by(child, job.part)
                finally:
                    self._end(job)
                if not job.compiled:
                    break

    def _give_up(self) -> None:
        for job in self._waiting:
            job.finished = True
        self._put_progress()

    def _next(self) -> _Job | None:
        with self._lock:
            if not self._waiting:
                return None
            job = self._waiting.pop(0)
            self._running.append(job.part.name)
            self._put_progress()
            return job

    def _end(self, job: _Job) -> None:
        with self._lock:
            self._running.remove(job.part.name)
            job.finished = True
            self._put_progress()

    def _put_progress(self) -> None:
        done = sum(job.compiled for job in self._jobs.values())
        self._changes.put(Progress(done, len(self._jobs), tuple(self._running)))


def _compiled_by(child: "subprocess.Popen[str]", part: Part) -> bool:
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        print(part.name, file=child.stdin, flush=True)
        return child.stdout.readline().rstrip("\n") == part.name
    except OSError:
        return False


def _processors() -> int:
    """Return how many processors this process may use, or how many there are where the system does not tell."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _stamp_file(folder: Path, group: Group) -> Path:
    """Return the place of the stamp of a group; its name changes with all that the machine code depends on."""
    machine = [binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()]
    parts = [part.name for part in group.parts]
    everything = [*parts, stamp(Path(__file__)), numba.__version__, sys.version, *machine]
    return folder / f"{group.name}-{sha256(' '.join(everything).encode()).hexdigest()[:16]}.warm"


def _samples(n: int) -> SampleBlock:
    return block(np.arange(n, dtype=np.int64), np.zeros((n, 6)))


def _call_window() -> None:
    Estimator(100.0, 1.0).update(_samples(100))


def _call_fit() -> None:
    estimator = Estimator(100.0, 1.0)
    estimator.update(_samples(100))
    estimator.get()


def _call_motion_detection() -> None:
    Watch(100.0, alarms_per_day=0.0).update(_samples(100))


def _call_change_detection() -> None:
    Watch(100.0).update(_samples(100))
    ChangeDetector(100.0).restart()


def _call_compensation() -> None:
    compensator = Compensator(100.0)
    compensator.update(1e-3 * np.random.default_rng(0).standard_normal((6000, 6)))
    compensator.adopt(0, identify(*compensator.window(0), [(2, 1)]))
    compensator.update(np.zeros((1, 6)), lost=1)
    _ = compensator.error


def _call_slow_statistics() -> None:
    estimator = Estimator(100.0, 1.0)
    estimator.update(_samples(100))
    estimator.restart(0, 10)
    while estimator.step() is None:  # total and Hadamard deviation
        pass


def _call_refit() -> None:
    Estimator(100.0, 1.0, every_sample=True).update(_samples(100))


def _call_temperature_lag() -> None:
    heat.lagged(np.zeros(2), 0.5)


def _call_analysis() -> None:
    from monitor.estimate.analysis import analyze  # the service does not need it

    analyze([_samples(100)], 100.0)


def _call_reconciliation() -> None:
    from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
    from monitor.noise.model import NoiseModel
    from monitor.reconcile.reconcile import Recording, reconcile  # the service does not need it

    model = NoiseModel({"gz": (AngleRandomWalk(N=1e-4), BiasInstability(B=3e-5), RateRandomWalk(K=1e-6))})
    series, rng = model.simulate(4200, 10.0, 1)[:, 2], np.random.default_rng(1)
    size = float(np.std(series))
    series += 4.0 * size * (rng.integers(0, 2, 42).repeat(100) + (np.arange(4200) > 2100))
    series[::500] += 20.0 * size
    reconcile(Recording({"gz": series}, 10.0, np.linspace(20.0, 30.0, 4200)), model, seed=1)


WINDOW: Final = "Allan deviation"
FIT: Final = "noise coefficients"
SERVICE: Final = Group(
    "service",
    (
        Part(WINDOW, _call_window),
        Part("motion detection", _call_motion_detection),
        Part(FIT, _call_fit),
        Part("change detection", _call_change_detection),
        Part("drift compensation", _call_compensation),
        Part("total and Hadamard deviation", _call_slow_statistics),
        Part("refit at every sample", _call_refit),
        Part("temperature lag", _call_temperature_lag),
    ),
)
"""What the running service needs; what it needs first comes first."""
_ANALYSIS: Final = Part("analysis of recordings", _call_analysis)
_RECONCILIATION: Final = Part("reconciliation", _call_reconciliation)
COMMANDS: Final = Group("commands", (_ANALYSIS,) if missing_packages("reconcile") else (_ANALYSIS, _RECONCILIATION))
"""What only commands on recordings need. A few kernels of rare cases are compiled when they are called."""
GROUPS: Final = (SERVICE, COMMANDS)
