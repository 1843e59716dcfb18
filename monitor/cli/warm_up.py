"""Command ``warm-up``: compiles the numerical kernels in advance."""

import sys
import time
from typing import Annotated

import typer

from drivers.errors import ConfigError
from monitor.cli.shared import output


def warm_up(from_stdin: Annotated[bool, typer.Option("--from-stdin", hidden=True)] = False) -> None:
    """Compile the numerical kernels and store them on disk, so that later commands start quickly."""
    from monitor.common.compiled import kernel_cache_folder
    from monitor.daemon.kernels import kernel_compilation, kernel_groups

    if from_stdin:
        kernel_compilation.compile_from_stdin(sys.stdin, sys.stdout)
    folder = kernel_cache_folder()
    if folder is None:
        raise ConfigError(
            "compiled kernels cannot be stored, because no cache folder can be written; set NUMBA_CACHE_DIR to a "
            "writable folder"
        )
    cold = [group for group in kernel_groups.GROUPS if not kernel_compilation.is_warm(group)]
    begun_s = time.monotonic()
    with output.show_progress_bar() as show:

        def report_progress(progress: kernel_compilation.CompilationProgress) -> None:
            show(str(progress), progress.compiled_share)
            if not sys.stderr.isatty():
                typer.echo(progress, err=True)

        for group in cold:
            for _ in kernel_compilation.prepare_kernels(group, report_progress):
                pass
    parts = sum(len(group.parts) for group in cold)
    done = f"compiled {parts} parts in {time.monotonic() - begun_s:.0f} s" if cold else "nothing to compile"
    typer.echo(f"{done}; kernels are kept in {folder}")
