"""Command ``convert``: writes a recording in another format."""

from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.shared import options, output, service_in_terminal


@options.with_reading_options
def convert(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File, or folder of segments.")],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Recording to write: .csv, .csv.gz, .npz, .parquet, .arrow, .mcap, ….",
        ),
    ],
    rate: options.Rate = None,
    last: options.Last = None,
    reading: options.Reading = None,
    decoder: options.DecoderName = None,
    option: options.DecoderOptions = None,
) -> None:
    """Write a recording in another format, without a change of times and values."""
    from monitor.commands import convert as conversion

    last_s = options.parse_duration("--last", last)
    service_in_terminal.exit_on_sigterm()
    choice = options.parse_decoder(decoder, option)
    request = conversion.ConversionRequest(recording, out, rate, last_s, reading, choice)
    with output.show_progress_bar() as tell:
        result = conversion.run_conversion(request, tell)
    temperature = ", temperature" if conversion.has_temperature(result) else ""
    typer.echo(f"{out}: {len(result)} samples of {' '.join(result.axes)}{temperature}")
    for note in result.notes:
        typer.echo(f"note: {note}")
