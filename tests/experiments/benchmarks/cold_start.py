"""Time from the start of ``imu-monitor demo`` to its first results, with and without compiled kernels on disk.

    python -m tests.experiments.benchmarks.cold_start [--load N] [--share F] [--rounds N]

Each round starts the program twice, first with an empty folder for compiled kernels and then with the folder that the
first start has filled. Another process listens over zenoh: ``curve`` is the first Allan deviation, ``coefficients`` the
first estimated value, ``everything`` the first status after the last kernel. The times are elapsed times
from the start of the process. ``lost`` is the number of samples that the sensor or the service lost in this time.

``--load`` also starts busy processes. ``--share`` simulates a slower board: program and compilers run on one processor
with so many busy processes that they get about this share of the processor.
"""

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, run_busy_processes
from tests.support.zenoh_sessions import open_session

ROOT = Path(__file__).parents[3]
HOST, PORT = "127.0.0.1", 7450
PATIENCE_S = 900.0


def measure_start(cache: Path) -> dict[str, float]:
    """Start the program once; return the seconds until each result, and how many samples were lost."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["NUMBA_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-P", str(ROOT / "imu_monitor" / "__init__.py"), "demo", "--viewer", "none"]
    found: dict[str, float] = {}
    with tempfile.TemporaryFile() as log:
        began_s = time.monotonic()
        program = subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=ROOT)
        try:
            _wait_for(_is_listening, began_s)
            with open_session(connect=[f"tcp/{HOST}:{PORT}"]) as opened:

                def take(sample: Any) -> None:
                    topic = str(sample.key_expr).rsplit("/", 1)[-1]
                    _record_time(found, topic, sample.payload.to_bytes(), time.monotonic() - began_s)

                subscriber = opened.declare_subscriber("imu/**", take)
                _wait_for(lambda: "everything" in found, began_s)
                subscriber.undeclare()
        finally:
            program.send_signal(signal.SIGTERM)
            program.wait()
    return found


def _wait_for(condition: Callable[[], bool], began_s: float) -> None:
    while not condition():
        if time.monotonic() - began_s > PATIENCE_S:
            raise TimeoutError(f"nothing after {PATIENCE_S:g} s")
        time.sleep(0.02)


def _is_listening() -> bool:
    with contextlib.suppress(OSError), socket.create_connection((HOST, PORT), 1.0):
        return True
    return False


def _record_time(found: dict[str, float], topic: str, payload: bytes, now_s: float) -> None:
    if topic == "allan":
        found.setdefault("curve", now_s)
    elif topic == "coefficients":
        axes = msgspec.json.decode(payload)["axes"].values()
        if any(axis["N"]["status"] == "estimated" for axis in axes):
            found.setdefault("coefficients", now_s)
    elif topic == "status":
        status = msgspec.json.decode(payload)
        found["lost"] = float(status["lost"])
        if status["state"] == "running" and "coefficients" in found and "compiling" not in status["text"]:
            found.setdefault("everything", now_s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--load", type=int, default=0, help="number of busy processes")
    parser.add_argument("--share", type=float, help="share of one processor, e.g. 0.25")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    processors, load = os.sched_getaffinity(0), arguments.load
    if arguments.share is not None:
        processors, load = {min(processors)}, round(1.0 / arguments.share) - 1
    console.print(describe_machine())
    machine_load, rows = Load(), list[tuple[str, ...]]()
    for _ in range(arguments.rounds):
        with tempfile.TemporaryDirectory() as folder, run_busy_processes(load, processors):
            for kernels in ("cold", "warm"):
                found = measure_start(Path(folder))
                rows.append((kernels, *(f"{found[name]:.1f}" for name in NAMES)))
    table = create_table("seconds after the start", "kernels", *NAMES)
    for row in sorted(rows):
        table.add_row(*row)
    console.print(table)
    console.print(machine_load.describe())


NAMES = ("curve", "coefficients", "everything", "lost")

if __name__ == "__main__":
    main()
