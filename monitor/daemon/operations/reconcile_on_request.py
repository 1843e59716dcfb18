"""Reconciliation of the live window on request: answers the zenoh query ``command/reconcile``.

For each query, a thread saves a copy of the window as a recording and runs ``imu-monitor reconcile`` in a child
process. A separate process is used because a fit takes seconds to minutes. The thread answers the query with the JSON
result, and the device publishes an event. Each device has at most one reconciliation at a time.

The query cannot choose the folder of the report, because anyone on the network may send a query. The report is kept in
a new folder inside ``reconcile_folder``. The oldest reports of a device are deleted. If the data do not
support an answer, the result contains ``exit`` 3 and a reason.
"""

import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from drivers.data_types import AXES, Floats
from monitor.common.program_command_line import PROGRAM
from monitor.common.unexpected_errors import log_unexpected_error
from monitor.estimation.window_sample_snapshot import WindowSnapshot
from monitor.publishing.messages.results import ReconcileReply
from monitor.publishing.zenoh.publisher import Command

COMMAND: Final = (*PROGRAM, "reconcile")
"""Command of the child process."""
TIMEOUT_S: Final = 900.0
"""Time in seconds after which the child process is killed."""
NICENESS_INCREASE: Final = 10
"""Niceness of the child process relative to the daemon."""
LARGEST_NICENESS: Final = 19
SEED: Final = 1
"""Seed of the random numbers."""
DONE: Final = 0
"""Exit status of a successful reconciliation."""
NO_ANSWER: Final = 3
"""Exit status if the data do not support an answer."""
KEPT_REPORTS: Final = 20
"""Number of newest reports of a device that are kept in ``reconcile_folder``."""
JOIN_TIMEOUT_S: Final = 3.0
"""Longest wait for a thread when the service ends."""


@dataclass(frozen=True, slots=True)
class WindowCopyForReconcile:
    """Copy of the window of a device, for a reconciliation."""

    device: str
    unix_s: float  # time of the newest sample
    samples: int  # number of received samples up to the newest one
    window: WindowSnapshot
    temperature_c: Floats  # [n] temperatures of the samples in the window
    model: Path | None  # model under test
    folder: Path | None  # folder for reports; None if reports are not kept


@dataclass(frozen=True, slots=True)
class ReconciliationOutcomeText:
    """Result of a finished reconciliation in one sentence."""

    device: str
    text: str


class Reconciler:
    """Runner of the reconciliations of all devices.

    Parameters
    ----------
    program : sequence of str, optional
        Command line, without the path of the recording and the options.
    limit_s : float, optional
        Time in seconds after which the child process is killed.
    """

    def __init__(self, program: Sequence[str] = COMMAND, limit_s: float = TIMEOUT_S) -> None:
        self._program = tuple(program)
        self._limit_s = limit_s
        self._running: dict[str, threading.Thread] = {}
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._finished: queue.SimpleQueue[ReconciliationOutcomeText] = queue.SimpleQueue()
        self._closing = threading.Event()

    def start_reconciliation(self, job: WindowCopyForReconcile, command: Command) -> None:
        """Start a reconciliation in a thread, or refuse a second query for the same device.

        Parameters
        ----------
        job : WindowCopyForReconcile
            Window to reconcile.
        command : Command
            Query that receives the answer.
        """
        before = self._running.get(job.device)
        if before is not None and before.is_alive():
            command.reply_refusal("busy: a reconciliation of this device is already running")
            return
        name = f"reconcile of {job.device}"
        thread = threading.Thread(target=self._run, args=(job, command), name=name, daemon=True)
        self._running[job.device] = thread
        thread.start()

    def take_finished_reconciliations(self) -> list[ReconciliationOutcomeText]:
        """Return the reconciliations that have finished since the last call."""
        found = []
        while not self._finished.empty():  # this method is the only reader
            found.append(self._finished.get_nowait())
        return found

    def abort_reconciliations(self) -> None:
        """Kill the running reconciliations, and refuse the pending queries."""
        self._closing.set()
        for child in list(self._children.values()):
            _kill(child)
        for thread in self._running.values():
            thread.join(JOIN_TIMEOUT_S)

    # --- thread of one query

    def _run(self, job: WindowCopyForReconcile, command: Command) -> None:
        try:
            result, status, folder = self._reconcile(job)
        except Exception as error:  # noqa: BLE001 - the reply contains the error
            expected = isinstance(error, OSError | RuntimeError)
            text = str(error) if expected else log_unexpected_error(f"reconcile of {job.device}", error)
            command.reply_refusal(text)
            self._finished.put(ReconciliationOutcomeText(job.device, f"reconcile failed: {text}"))
            return
        head = ReconcileReply(device=job.device, t=job.unix_s, samples=job.samples)
        command.reply_result(head.encode_report(result, status, folder, KEPT_REPORTS))
        self._finished.put(ReconciliationOutcomeText(job.device, describe_reconcile_result(result, status)))

    def _reconcile(self, job: WindowCopyForReconcile) -> tuple[dict[str, Any], int, str | None]:
        """Return the JSON result, the exit status, and the folder of the report or None."""
        with tempfile.TemporaryDirectory(prefix="imu-monitor-") as temporary:
            path, folder = Path(temporary) / f"{job.device}.npz", Path(temporary) / "report"
            if job.folder is not None:
                stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(job.unix_s))
                folder = job.folder / f"{job.device}-{stamp}"
                folder.mkdir(parents=True, exist_ok=True)
            _write_window(path, job)
            options = ["--out", str(folder), "--json", "-", "--seed", str(SEED)]
            if job.model is not None:
                options += ["--model", str(job.model)]
            try:
                status, output, errors = self._run_child(job.device, [*self._program, str(path), *options])
            finally:
                if job.folder is not None:
                    _delete_old_reports(job.folder, job.device)
        if status not in (DONE, NO_ANSWER):
            lines = errors.decode("utf-8", "replace").strip().splitlines()
            raise RuntimeError(lines[-1] if lines else f"reconcile ended with status {status}")
        try:
            result = msgspec.json.decode(output, type=dict[str, Any])
        except msgspec.DecodeError as error:
            raise RuntimeError(f"the result of reconcile cannot be read: {error}") from error
        return result, status, None if job.folder is None else str(folder)

    def _run_child(self, device: str, arguments: list[str]) -> tuple[int, bytes, bytes]:
        """Run the program; return the exit status, the standard output and the standard error."""
        pipe = subprocess.PIPE
        child = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, start_new_session=True)
        self._children[device] = child
        try:
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, child.pid, min(os.nice(0) + NICENESS_INCREASE, LARGEST_NICENESS))
            if self._closing.is_set():  # ``close`` was called while the child was started
                _kill(child)
            output, errors = child.communicate(timeout=self._limit_s)
        except subprocess.TimeoutExpired:
            _kill(child)
            child.communicate()
            raise RuntimeError(f"reconcile was killed after {self._limit_s:g} s") from None
        finally:
            del self._children[device]
        if self._closing.is_set():
            raise RuntimeError("the service is stopping")
        return child.returncode, output, errors


def _delete_old_reports(folder: Path, device: str) -> None:
    """Delete the oldest reports of a device and keep ``KEPT_REPORTS``. The name of a report contains its time."""
    name = re.compile(rf"{re.escape(device)}-\d{{8}}T\d{{6}}Z")
    reports = sorted(path for path in folder.iterdir() if name.fullmatch(path.name) and not path.is_symlink())
    for path in reports[:-KEPT_REPORTS]:
        shutil.rmtree(path)


def _write_window(path: Path, job: WindowCopyForReconcile) -> None:
    values = job.window.restore_samples()
    columns = {axis: values[:, i] for i, axis in enumerate(AXES) if not np.isnan(values[:, i]).all()}
    if not np.isnan(job.temperature_c).all():
        columns["temperature"] = job.temperature_c
    np.savez(path, fs=np.float64(job.window.rate_hz), **columns)  # type: ignore[arg-type]


def describe_reconcile_result(result: dict[str, Any], status: int = DONE) -> str:
    """Return the verdict of a reconciliation and the changes of the model in one sentence.

    Parameters
    ----------
    result : dict
        JSON result of ``imu-monitor reconcile``.
    status : int, optional
        Exit status of the command.

    Examples
    --------
    >>> describe_reconcile_result({"verdict": "explained", "axes": {"gz": {"steps": [
    ...     {"kind": "added", "effect": "sinusoidal", "confidence": 0.998}]}}})
    'reconcile: explained: gz sinusoidal added (0.998)'
    """
    if status == NO_ANSWER:
        return f"reconcile: no answer: {result.get('why', 'too little data')}"
    steps = [
        _step_text(axis, step) for axis, found in result.get("axes", {}).items() for step in found.get("steps", ())
    ]
    verdict = str(result.get("verdict")).replace("_", " ")
    return f"reconcile: {verdict}" + (f": {', '.join(steps)}" if steps else "")


def _step_text(axis: str, step: dict[str, Any]) -> str:
    confidence = step.get("confidence")
    sure = f" ({confidence:.3f})" if isinstance(confidence, float) else ""
    return f"{axis} {step.get('effect')} {step.get('kind')}{sure}"


def _kill(child: "subprocess.Popen[bytes]") -> None:
    """Kill a child process and all processes that it has started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
