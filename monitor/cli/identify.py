"""Command ``identify``: prints the configuration for the sensor on a serial port."""

from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.shared import service_in_terminal


def identify(
    source: Annotated[
        str, typer.Argument(metavar="PORT|FILE", help="Serial port such as /dev/ttyUSB0, or file of captured bytes.")
    ],
    seconds: Annotated[
        float, typer.Option(min=0.1, max=600.0, metavar="S", help="Longest time to listen at each baud rate.")
    ] = 2.0,
) -> None:
    """Find the baud rate and the decoder of a sensor, and print its configuration."""
    from monitor.commands import identify as identification

    service_in_terminal.exit_on_sigterm()
    if Path(source).is_file():
        found = identification.identify_file(Path(source))
    else:
        found = identification.identify_port(source, seconds, lambda line: typer.echo(line, err=True))
    for line in identification.show_text(found.format.text_lines):
        typer.echo(f"received: {line}", err=True)
    typer.echo(_describe(found.format.samples, found.format.bad, found.format.rate_hz), err=True)
    typer.echo(identification.write_configuration(found), nl=False)


def _describe(samples: int, bad: int, rate_hz: float | None) -> str:
    rate = f", {rate_hz:.4g} Hz" if rate_hz is not None else ""
    return f"found {samples} samples, {bad} rejected frames{rate}"
