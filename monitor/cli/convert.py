"""Command ``convert``: writes a recording in another format."""

from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.shared import options, output, service_in_terminal


@options.with_loading_options
def convert(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File of a recording, or folder of segments.")],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Recording to write: .csv, .csv.gz, .npz, .parquet, .arrow, .mcap, ….",
        ),
    ],
    loading: options.Loading = None,
) -> None:
    """Write a recording in another format, without changing its times or values."""
    from monitor.commands import convert as conversion

    service_in_terminal.exit_on_sigterm()
    with output.show_progress_bar() as tell:
        result = conversion.run_conversion(recording, out, loading, tell)
    temperature = ", temperature" if conversion.has_temperature(result) else ""
    typer.echo(f"{out}: {len(result)} samples of {' '.join(result.axes)}{temperature}")
    for note in result.notes:
        typer.echo(f"note: {note}")
