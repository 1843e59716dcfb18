"""Functions that write results to standard output or files, and show a progress bar in the terminal."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import typer

from drivers.errors import ConfigError
from monitor.commands.progress_callback import ProgressCallback, ignore_progress


def check_output_file(option: str, path: Path | None, *suffixes: str) -> None:
    """Check the suffix and the folder of an output file before the results are computed.

    Parameters
    ----------
    option : str
        Name of the option, used in error messages.
    path : Path or None
        File to write.
    *suffixes : str
        Allowed file suffixes. By default, all suffixes are allowed.

    Raises
    ------
    ConfigError
        If the suffix is not allowed or the folder does not exist.
    """
    if path is None:
        return
    if suffixes and path.suffix not in suffixes:
        raise ConfigError(f"{option}: {path}: a name ending in {' or '.join(suffixes)} is needed")
    if path != Path("-") and not path.parent.is_dir():
        raise ConfigError(f"{option}: {path}: cannot be written: there is no folder {path.parent}")


def write_json(path: Path | None, encode: Callable[[], bytes]) -> None:
    """Write the value of the option ``--json``, if the option was given.

    Parameters
    ----------
    path : Path or None
        File to write, or ``-`` for standard output.
    encode : callable
        Function that returns the JSON text.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    if path is not None:
        write_file_or_stdout("--json", path, encode() + b"\n")


def write_file_or_stdout(option: str, path: Path, data: bytes) -> None:
    """Write data to a file. The path ``-`` means standard output.

    Parameters
    ----------
    option : str
        Name of the option, used in error messages.
    path : Path
        File to write.
    data : bytes
        Bytes to write.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    if path == Path("-"):
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
        return
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{option}: {path}: cannot be written: {error.strerror}") from error


def print_written_files(*paths: Path | None) -> None:
    """Print the path of each file that a command has written.

    The lines go to standard error if one of the paths is ``-``, because standard output then contains the data.
    """
    to_stderr = Path("-") in paths
    for path in paths:
        if path not in (None, Path("-")):
            typer.echo(f"{path} written", err=to_stderr)


@contextlib.contextmanager
def show_progress_bar() -> Iterator[ProgressCallback]:
    """Show a progress bar if the output is a terminal, and yield a callback that updates the progress bar."""
    from rich.progress import Progress

    from monitor.publishing.terminal.console import Console

    console = Console(stderr=True)
    if not (console.is_terminal and sys.stdout.isatty()):
        yield ignore_progress
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(step: str, share: float | None) -> None:
            if bar.tasks[0].description != step:
                bar.reset(task, description=step)  # the time left follows from the speed of this step alone
            bar.update(task, total=None if share is None else 1.0, completed=share or 0.0)

        yield show


def compile_analysis_kernels(report_progress: ProgressCallback) -> None:
    """Compile the numerical kernels that analyze recordings, unless the disk cache already contains them."""
    from monitor.daemon.kernels import kernel_compilation, kernel_groups

    for group in kernel_groups.GROUPS:
        if not kernel_compilation.is_warm(group):
            with contextlib.suppress(OSError):  # without a disk cache, kernels are compiled at the first call
                for _ in kernel_compilation.prepare_kernels(
                    group, lambda progress: report_progress(str(progress), progress.compiled_share)
                ):
                    pass
