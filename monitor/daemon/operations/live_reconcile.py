"""``command/reconcile``: what the live window says, through the same command that reads recordings.

In comes a copy of a window and the query that asked for it; out goes an answer to the query, and a sentence for the
device's events. A thread of its own for each query writes the samples as a recording into a temporary folder, runs
``imu-monitor reconcile`` on it in a child process (of low priority, ended after LIMIT_S), and passes its JSON on.
Nothing waits for it: a fit takes seconds to minutes, and in this process it would hold up every sample. At most one at
a time for each device.

The query cannot say where the report goes, as anyone on the network may send one: it is kept in a folder of its own
below the device's ``reconcile_folder``, or not at all. Outcomes: the result with ``exit`` 0; with ``exit`` 3 where the
data do not support an answer, and the result says why; else an error in one line.
"""

import contextlib
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from drivers.sample import AXES, Floats
from monitor.estimation.window_snapshot import Held
from monitor.publishing.messages import encoding
from monitor.publishing.zenoh.publisher import Command

PROGRAM: Final = (sys.executable, "-P", str(Path(__file__).resolve().parents[3] / "imu_monitor.py"), "reconcile")
"""By its path and without its folder on the module path: whatever else is named ``monitor``, this one is run."""
LIMIT_S: Final = 900.0
NICE: Final = 10
"""Added to the niceness of the daemon: an unprivileged process cannot lower the niceness of its children."""
LARGEST_NICENESS: Final = 19
SEED: Final = 1
DONE: Final = 0
NO_ANSWER: Final = 3
"""Exit status where the data do not support an answer; the result says why."""
JOIN_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class Job:
    """One window to look into."""

    device: str
    unix_s: float  # of its newest sample
    samples: int  # received until then
    window: Held
    temperature_c: Floats  # [n] of the window
    model: Path | None
    folder: Path | None  # where reports are kept


@dataclass(frozen=True, slots=True)
class Finished:
    """What became of a job, in a sentence."""

    device: str
    text: str


class Reconciler:
    """All such queries of a service.

    Args:
        program: what is run, before the recording's path and the options
        limit_s: how long it may take
    """

    def __init__(self, program: Sequence[str] = PROGRAM, limit_s: float = LIMIT_S) -> None:
        self._program = tuple(program)
        self._limit_s = limit_s
        self._running: dict[str, threading.Thread] = {}
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._finished: queue.SimpleQueue[Finished] = queue.SimpleQueue()
        self._closing = threading.Event()

    def start(self, job: Job, command: Command) -> None:
        """Begin, or refuse while one of this device runs; returns at once."""
        before = self._running.get(job.device)
        if before is not None and before.is_alive():
            command.refuse("busy: reconcile runs already for this device")
            return
        name = f"reconcile of {job.device}"
        thread = threading.Thread(target=self._run, args=(job, command), name=name, daemon=True)
        self._running[job.device] = thread
        thread.start()

    def take(self) -> list[Finished]:
        """What has finished since the last call."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._finished.get_nowait())
        return found

    def close(self) -> None:
        """End what still runs; its queries are refused."""
        self._closing.set()
        for child in list(self._children.values()):
            _kill(child)
        for thread in self._running.values():
            thread.join(JOIN_S)

    # --- the thread of one query

    def _run(self, job: Job, command: Command) -> None:
        try:
            result, status, folder = self._result(job)
        except (OSError, RuntimeError) as error:
            command.refuse(str(error))
            self._finished.put(Finished(job.device, f"reconcile failed: {error}"))
            return
        command.answer(encoding.reconciled(job.device, job.unix_s, job.samples, result, status, folder))
        self._finished.put(Finished(job.device, said(result, status)))

    def _result(self, job: Job) -> tuple[dict[str, Any], int, str | None]:
        """What the command said, its exit status, where the report is; RuntimeError: in one line why there is none."""
        with tempfile.TemporaryDirectory(prefix="imu-monitor-") as temporary:
            path, folder = Path(temporary) / f"{job.device}.npz", Path(temporary) / "report"
            if job.folder is not None:
                stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(job.unix_s))
                folder = job.folder / f"{job.device}-{stamp}"
                folder.mkdir(parents=True, exist_ok=True)
            write(path, job)
            options = ["--out", str(folder), "--json", "-", "--seed", str(SEED)]
            if job.model is not None:
                options += ["--model", str(job.model)]
            status, output, errors = self._child(job.device, [*self._program, str(path), *options])
        if status not in (DONE, NO_ANSWER):
            lines = errors.decode("utf-8", "replace").strip().splitlines()
            raise RuntimeError(lines[-1] if lines else f"reconcile ended with status {status}")
        try:
            result = msgspec.json.decode(output, type=dict[str, Any])
        except msgspec.DecodeError as error:
            raise RuntimeError(f"reconcile gave no result that can be read: {error}") from error
        return result, status, None if job.folder is None else str(folder)

    def _child(self, device: str, arguments: list[str]) -> tuple[int, bytes, bytes]:
        """Status, standard output and error of the program."""
        pipe = subprocess.PIPE
        child = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, start_new_session=True)
        self._children[device] = child
        try:
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, child.pid, min(os.nice(0) + NICE, LARGEST_NICENESS))
            if self._closing.is_set():  # it began while the others were ended
                _kill(child)
            output, errors = child.communicate(timeout=self._limit_s)
        except subprocess.TimeoutExpired:
            _kill(child)
            child.communicate()
            raise RuntimeError(f"reconcile was ended after {self._limit_s:g} s") from None
        finally:
            del self._children[device]
        if self._closing.is_set():
            raise RuntimeError("the service is stopping")
        return child.returncode, output, errors


def write(path: Path, job: Job) -> None:
    """The window as a recording: axes and temperature that were measured, at the window's rate."""
    values = job.window.values()
    columns = {axis: values[:, i] for i, axis in enumerate(AXES) if not np.isnan(values[:, i]).all()}
    if not np.isnan(job.temperature_c).all():
        columns["temperature"] = job.temperature_c
    np.savez(path, fs=np.float64(job.window.rate_hz), **columns)  # type: ignore[arg-type]


def said(result: dict[str, Any], status: int = DONE) -> str:
    """The verdict and the names in a sentence.

    >>> said({"verdict": "explained", "axes": {"gz": {"steps": [
    ...     {"kind": "added", "effect": "sinusoidal", "confidence": 0.998}]}}})
    'reconcile: explained: gz sinusoidal added (0.998)'
    """
    if status == NO_ANSWER:
        return f"reconcile: no answer: {result.get('why', 'too little data')}"
    steps = [_step(axis, step) for axis, found in result.get("axes", {}).items() for step in found.get("steps", ())]
    verdict = str(result.get("verdict")).replace("_", " ")
    return f"reconcile: {verdict}" + (f": {', '.join(steps)}" if steps else "")


def _step(axis: str, step: dict[str, Any]) -> str:
    confidence = step.get("confidence")
    sure = f" ({confidence:.3f})" if isinstance(confidence, float) else ""
    return f"{axis} {step.get('effect')} {step.get('kind')}{sure}"


def _kill(child: "subprocess.Popen[bytes]") -> None:
    """With all that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
