"""Runs many command lines of the program in one process; a process of its own for each would take a second.

``python child.py CASES.json RESULTS.json`` reads a list of argument lists and writes a list of results. Commands that
run until they are stopped, or for minutes, are replaced by ones that only accept their arguments.
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
LONGEST_SIMULATION: Final = 1_000_000
"""Samples that are written; a simulation of more is accepted and not done."""
CASE_S: Final = 300.0
"""Bound on the time of one command, generous for a loaded machine."""


class TooLong(BaseException):
    """A command did not end in time; no ``except Exception`` catches it."""


def main() -> None:
    """Run the cases of the first file and write what became of each to the second."""
    cases, results = Path(sys.argv[1]), Path(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, _too_long)
    replace_endless_commands()
    results.write_text(json.dumps([run(arguments) for arguments in json.loads(cases.read_text())]))


def run(arguments: list[str]) -> dict[str, Any]:
    """Run the program once in this process."""
    import monitor.cli

    sys.argv = ["imu-monitor", *arguments]
    out, err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    escaped, status = "", 0
    with (
        warnings.catch_warnings(record=True) as raised,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        deadline(CASE_S),
    ):
        warnings.simplefilter("always")
        try:
            monitor.cli.main()
        except SystemExit as ended:
            status = int(ended.code or 0)
        except BaseException:  # noqa: BLE001 - an error that escapes the program is what is looked for
            escaped = traceback.format_exc()
    told = [f"{one.category.__name__}: {one.message} ({one.filename}:{one.lineno})" for one in raised]
    return {"arguments": arguments, "status": status, "err": err.getvalue(), "escaped": escaped, "warnings": told}


@contextlib.contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Raise TooLong in the block if it takes longer."""
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def replace_endless_commands() -> None:
    """Let services, ``reconcile`` and long simulations end where their arguments have been accepted."""
    from monitor.cli.shared import service_in_terminal
    from monitor.commands import reconcile, simulate
    from monitor.publishing.terminal import watch

    places: list[tuple[Any, str]] = [
        (service_in_terminal, "run_service"),
        (service_in_terminal, "run_fleet_viewer"),
        (watch, "watch"),
        (reconcile, "reconcile_and_write_report"),
    ]
    for place, name in places:
        setattr(place, name, _accepted(name))
    write: Callable[..., None] = simulate._write

    def write_short(result: simulate.SimulationResult, *rest: Any) -> None:
        if result.samples > LONGEST_SIMULATION:
            raise SystemExit(0)
        write(result, *rest)

    simulate._write = write_short


def _accepted(name: str) -> Callable[..., None]:
    def accepted(*_: object, **__: object) -> None:
        raise SystemExit(0)

    accepted.__name__ = name
    return accepted


def _too_long(_signal: int, _frame: FrameType | None) -> None:
    raise TooLong


if __name__ == "__main__":
    main()
