"""Command line of the program. Every error becomes one line of text and an exit status.

The exit status is 0 for success, 1 for a failure at run time, and 2 for an invalid argument or input file. The exit
status 3 means that the data do not support an answer.
"""

import contextlib
import logging
import os
import re
import sys
import threading
import traceback
from collections.abc import MutableMapping, Sequence
from functools import partial
from typing import Annotated, NoReturn

import typer

from drivers.errors import UnknownColumnsError
from drivers.secret_masking import remember_secrets_of_process
from monitor.cli import (
    analyze,
    check,
    compensate,
    convert,
    demo,
    doctor,
    export,
    history,
    identify,
    reconcile,
    run,
    simulate,
    thermal,
    view,
    warm_up,
    watch,
    worker,
)
from monitor.cli.shared.command_help import PlainHelpCommand
from monitor.cli.shared.errors import DEBUG, INTERRUPTED, error_message_and_exit_status

# The thread limits must be set before NumPy is imported. The matrices are too small for parallel linear algebra.
for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_pool, "1")
# Without this setting, pydantic would search all installed packages for plug-ins.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

app = typer.Typer(
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    epilog="\b\nExamples:\n  imu-monitor demo\n  imu-monitor identify /dev/ttyUSB0\n  imu-monitor analyze run.csv",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        try:
            version = metadata.version("imu-monitor")
        except metadata.PackageNotFoundError:  # the program runs from a source tree without installation
            version = "(version unknown: the package is not installed)"
        typer.echo(f"imu-monitor {version}")
        raise typer.Exit


@app.callback()
def _options_of_all_commands(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
    debug: Annotated[
        bool, typer.Option(DEBUG, help="Print the traceback of an error and the warnings of libraries.")
    ] = False,
) -> None:
    """Live noise monitor for MEMS IMUs: windowed Allan variance and Q, N, B, K, R while the sensor runs."""


for _command, _summary, _example in (
    (demo.demo, "Run the daemon with a simulated IMU.", "demo --effect gz.sinusoidal:amplitude=4e-3,frequency=17"),
    (run.run, "Run the daemon with the devices of a configuration file.", "run bench.toml"),
    (check.check, "Report all mistakes in a configuration file.", "check bench.toml"),
    (doctor.doctor, "Check this machine: ports, permissions, clock, disk.", "doctor bench.toml"),
    (identify.identify, "Find the baud rate and the decoder of a sensor.", "identify /dev/ttyUSB0"),
    (warm_up.warm_up, "Compile the numerical kernels in advance.", "warm-up"),
    (watch.watch, "Show a live table of several daemons.", "watch --connect tcp/127.0.0.1:7450"),
    (view.view, "Show several daemons in one viewer.", "view --detail bench-1"),
    (
        analyze.analyze,
        "Compute Allan deviations and coefficients of a recording.",
        "analyze run.csv --plot report.html",
    ),
    (simulate.simulate, "Simulate a recording from a noise model.", "simulate mpu-6050 --seconds 1h --out hour.npz"),
    (
        reconcile.reconcile,
        "Find the effects that a noise model lacks.",
        "reconcile run.csv --model mpu-6050 --out report",
    ),
    (compensate.compensate, "Remove the gyro drift from a recording.", "compensate run.csv --out compensated.csv"),
    (convert.convert, "Write a recording in another format.", "convert flight.ulg flight.mcap"),
    (history.history, "Print, plot or export past results.", "history bench.toml --from -7d --plot week.png"),
    (export.export, "Write noise parameters for other programs.", "export run.json --format kalibr --out imu.yaml"),
):
    app.command(cls=PlainHelpCommand, short_help=_summary, epilog=f"Example: imu-monitor {_example}")(_command)
app.command(hidden=True)(worker.worker)
_thermal = typer.Typer(
    help="Bias against temperature: fit a model to a recording, and predict another recording.",
    short_help="Fit bias against temperature, and predict it.",
    rich_markup_mode=None,
)
_thermal.command(
    "fit",
    cls=PlainHelpCommand,
    short_help="Fit a model to a recording.",
    epilog="Example: imu-monitor thermal fit run.csv --out thermal.json",
)(thermal.thermal_fit)
_thermal.command(
    "predict",
    cls=PlainHelpCommand,
    short_help="Predict another recording.",
    epilog="Example: imu-monitor thermal predict new.csv --model thermal.json",
)(thermal.thermal_predict)
app.add_typer(_thermal, name="thermal")


def main() -> None:
    """Run the program with the arguments of the process, and exit with the status of the command.

    Every error is printed as one line on standard error. The option ``--debug`` adds the traceback and debug messages,
    and may precede or follow the name of the command.
    """
    remember_secrets_of_process(os.environ, sys.argv)
    arguments, debug = _split_debug(sys.argv[1:])
    if debug:
        logging.basicConfig(format="imu-monitor: %(message)s")
        logging.getLogger("monitor").setLevel(logging.DEBUG)
    threading.excepthook = partial(report_failed_thread, debug)
    _ignore_impossible_width(os.environ)
    try:
        # In this mode, typer returns the status of an Exit exception instead of ending the process.
        status = app(args=arguments, prog_name="imu-monitor", standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
    except Exception as error:  # noqa: BLE001 - any other error is printed in one line, with a request to report it
        if debug:
            traceback.print_exc()
        line, status = error_message_and_exit_status(error)
        if isinstance(error, OSError):
            _discard_output()
        if not isinstance(error, BrokenPipeError):  # nobody reads the output of a broken pipe
            _fail(line, status, error.column_lines if isinstance(error, UnknownColumnsError) else ())
    if status == INTERRUPTED:  # typer converts Ctrl-C to an Exit exception
        _fail("interrupted", INTERRUPTED)
    sys.exit(status)


def report_failed_thread(debug: bool, failed: threading.ExceptHookArgs) -> None:
    """Print one line on standard error that says why a thread ended.

    Parameters
    ----------
    debug : bool
        True if the traceback is also printed.
    failed : threading.ExceptHookArgs
        Thread and its exception.
    """
    error = failed.exc_value
    if not isinstance(error, Exception) or sys.stderr is None:
        return
    with contextlib.suppress(OSError, ValueError):
        if debug:
            traceback.print_exception(error)
        thread = "a thread" if failed.thread is None else f'thread "{failed.thread.name}"'
        print(f"imu-monitor: {thread} ended: {error_message_and_exit_status(error)[0]}", file=sys.stderr, flush=True)  # noqa: T201


def _ignore_impossible_width(environment: MutableMapping[str, str]) -> None:
    """Remove terminal sizes of zero from the environment, because tables of zero width would be empty."""
    for name in ("COLUMNS", "LINES"):
        if not re.fullmatch(r"0*[1-9][0-9]{0,4}", environment.get(name, "")):
            environment.pop(name, None)


def _split_debug(arguments: Sequence[str]) -> tuple[list[str], bool]:
    """Return the arguments without ``--debug``, and a flag that is True if ``--debug`` was given."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return [*(one for one in arguments[:end] if one != DEBUG), *arguments[end:]], DEBUG in arguments[:end]


def _discard_output() -> None:
    """Redirect standard output to the null device, because flushing the buffered text at exit would fail again."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # standard output is closed or not a file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _fail(line: str, status: int, details: Sequence[str] = ()) -> NoReturn:
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):  # if standard error fails, only the status remains
            print("\n".join((f"imu-monitor: {line}", *details)), file=sys.stderr, flush=True)  # noqa: T201
    sys.exit(status)
