"""Run many command lines of the program in one process, because each start of a process takes about a second.

``python child.py CASES.json RESULTS.json`` reads a list of argument lists and writes a list of results. Commands that
run for minutes or without end are replaced by functions that only accept their arguments.
"""

import contextlib
import io
import json
import resource
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Final

MEMORY_BYTES: Final = 4 * 1024**3
MAX_SIMULATED_SAMPLES: Final = 1_000_000
"""Limit of the simulated samples. A longer simulation is accepted and not run."""
COMMAND_TIMEOUT_S: Final = 300.0
"""Time limit of one command, which is sufficient on a loaded machine."""


class CommandTimeout(BaseException):
    """A command did not end in time. The class is not an Exception, so the program cannot catch it by accident."""


def main() -> None:
    """Run the cases of the first file and write their results to the second file."""
    cases, results = Path(sys.argv[1]), Path(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, _raise_timeout)
    replace_endless_commands()
    results.write_text(json.dumps([run_program(arguments) for arguments in json.loads(cases.read_text())]))


def run_program(arguments: list[str]) -> dict[str, Any]:
    """Run the program once in this process."""
    import monitor.cli

    sys.argv = ["imu-monitor", *arguments]
    out, err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    uncaught, status = "", 0
    with (
        warnings.catch_warnings(record=True) as raised,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        deadline(COMMAND_TIMEOUT_S),
    ):
        warnings.simplefilter("always")
        try:
            monitor.cli.main()
        except SystemExit as ended:
            status = int(ended.code or 0)
        except BaseException:  # noqa: BLE001 - the tests look for any error that the program does not handle
            uncaught = traceback.format_exc()
    messages = [f"{item.category.__name__}: {item.message} ({item.filename}:{item.lineno})" for item in raised]
    return {"arguments": arguments, "status": status, "err": err.getvalue(), "uncaught": uncaught, "warnings": messages}


@contextlib.contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Raise CommandTimeout if the ``with`` block takes longer than ``seconds``."""
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def replace_endless_commands() -> None:
    """Make services, ``reconcile`` and long simulations end as soon as their arguments have been accepted."""
    from monitor.cli.shared import service_in_terminal
    from monitor.commands import reconcile, simulate
    from monitor.publishing.terminal import watch

    functions: list[tuple[Any, str]] = [
        (service_in_terminal, "run_service"),
        (service_in_terminal, "run_fleet_viewer"),
        (watch, "watch"),
        (reconcile, "reconcile_and_write_report"),
    ]
    for module, name in functions:
        setattr(module, name, _make_accepting_function(name))
    write: Callable[..., None] = simulate._write

    def write_short(result: simulate.SimulationResult, *rest: Any) -> None:
        if result.samples > MAX_SIMULATED_SAMPLES:
            raise SystemExit(0)
        write(result, *rest)

    simulate._write = write_short


def _make_accepting_function(name: str) -> Callable[..., None]:
    def accepted(*_: object, **__: object) -> None:
        raise SystemExit(0)

    accepted.__name__ = name
    return accepted


def _raise_timeout(_signal: int, _frame: FrameType | None) -> None:
    raise CommandTimeout


if __name__ == "__main__":
    main()
