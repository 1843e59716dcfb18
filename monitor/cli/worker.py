"""Command ``worker``: runs a worker process of the daemon. The daemon starts this command, not the user."""

from typing import Annotated

import typer


def worker(descriptor: Annotated[int, typer.Argument(help="File descriptor of the socket to the daemon.")]) -> None:
    """Run a worker process of the daemon."""
    from monitor.daemon.workers.worker_service import run_worker

    run_worker(descriptor)
