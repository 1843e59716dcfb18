"""Command ``check``: prints the mistakes in a configuration file, or all keys with their defaults."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import ConfigError
from monitor.cli.shared.errors import WRONG, name_option_in_config_errors


def check(
    config: Annotated[Path | None, typer.Argument(metavar="CONFIG.toml", help="Configuration file.")] = None,
    print_defaults: Annotated[
        bool, typer.Option("--print-defaults", help="Print a configuration file with all keys and their defaults.")
    ] = False,
    link: Annotated[
        str | None, typer.Option(metavar="NAME", help="With --print-defaults: print only the keys of this link.")
    ] = None,
    decoder: Annotated[
        str | None, typer.Option(metavar="NAME", help="With --print-defaults: print only the keys of this decoder.")
    ] = None,
) -> None:
    """Read a configuration file and report all mistakes. No device is opened."""
    from monitor.commands.check_configuration import check_configuration
    from monitor.common.unit_formatting import format_count

    if print_defaults:
        typer.echo(_defaults(link, decoder), nl=False)
        return
    if link is not None or decoder is not None:
        raise ConfigError("--link and --decoder require --print-defaults")
    if config is None:
        raise ConfigError("CONFIG.toml is missing; --print-defaults prints an example")
    found, wrong = check_configuration(config, pipe=True)
    for line in (*wrong, *(f"warning: {line}" for line in (found.warnings if found else ()))):
        typer.echo(line, err=True)
    if wrong:
        raise typer.Exit(WRONG)
    count = len(found.devices) if found else 0
    typer.echo(f"{config}: {format_count(count, 'device')}, no mistakes")


def _defaults(link: str | None, decoder: str | None) -> str:
    from monitor.settings import printed_defaults

    texts = []
    for option, name, form in (
        ("--link", link, printed_defaults.format_link_defaults),
        ("--decoder", decoder, printed_defaults.format_decoder_defaults),
    ):
        if name is not None:
            with name_option_in_config_errors(option):
                texts.append(form(name))
    return "\n".join(texts) or printed_defaults.format_defaults()
