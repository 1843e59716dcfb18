"""Command ``doctor``: prints the findings about a machine and a configuration as a table or as JSON."""

from pathlib import Path
from typing import Annotated, Final

import typer

from monitor.cli.shared import options, output
from monitor.cli.shared.errors import FAILED

SCHEMA: Final = "imu-monitor/doctor/1"
SIGNS: Final = {"well": "[green]✓[/]", "doubt": "[yellow]![/]", "wrong": "[red]✗[/]"}


def doctor(
    config: Annotated[
        Path | None,
        typer.Argument(metavar="CONFIG.toml", help="Configuration file; without it, only the machine is checked."),
    ] = None,
    json: options.JsonFile = None,
) -> None:
    """Check this machine and a configuration for unattended operation. No device is opened."""
    import msgspec

    from monitor.commands.doctor import examine_machine
    from monitor.commands.doctor.finding import worst_mark

    findings = examine_machine(config)
    output.write_json(json, lambda: msgspec.json.encode({"schema": SCHEMA, "findings": findings}))
    if json != Path("-"):
        _print(findings)
    if worst_mark(findings) == "wrong":
        raise typer.Exit(FAILED)


def _print(findings: list) -> None:  # type: ignore[type-arg]
    from rich.markup import escape
    from rich.table import Table

    from monitor.publishing.terminal.console import Console

    table = Table(box=None, show_header=False, pad_edge=False)
    for column in ("sign", "about", "text"):
        table.add_column(column, overflow="fold")
    for one in findings:
        do = f"\n[dim]→[/] {escape(one.do)}" if one.do else ""
        table.add_row(SIGNS[one.mark], escape(one.about), escape(one.text) + do)
    Console().print(table)
