"""Command ``run``: runs the daemon."""

from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.shared import options, service_in_terminal


def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="Configuration file.")],
    seconds: options.Seconds = None,
    viewer: options.Viewer = None,
    units: options.ConfiguredUnits = None,
    history: Annotated[
        str | None,
        typer.Option(
            metavar="S", help="Also show the last part of the history in the viewer, e.g. 1d or 12h; needs [storage]."
        ),
    ] = None,
) -> None:
    """Run the daemon for all devices of a configuration file until the process is interrupted."""
    from monitor.settings import loading

    found = service_in_terminal.with_viewer_history_length(
        loading.load_config(config, allow_pipe=True), options.parse_duration("--history", history)
    )
    service_in_terminal.run_service(found, seconds, viewer, units)
