"""Command ``watch``: shows a live table of the devices of several daemons, or prints their messages as JSON."""

import sys
import threading
from typing import Annotated

import typer

from monitor.cli.shared import options, service_in_terminal


def watch(
    keyexpr: options.KeyExpr = "imu/**",
    connect: options.Connect = None,
    zenoh: options.ZenohFile = None,
    seconds: options.Seconds = None,
    units: options.Units = "imu",
    json: Annotated[
        bool, typer.Option("--json", help="Print each message as one line of JSON instead of the table.")
    ] = False,
) -> None:
    """Show a live table of the devices of several daemons, whose results are received over zenoh.

    If KEYEXPR names a single device, its Allan deviations are also drawn.
    """
    unit_system = options.parse_units(units)
    stop = threading.Event()
    service_in_terminal.install_signal_handlers(stop.set)
    if json:
        from monitor.publishing.terminal.watch import print_messages_as_json

        print_messages_as_json(keyexpr, connect or (), stop, sys.stdout, sys.stderr, seconds, zenoh)
        return
    from monitor.publishing.terminal.console import Console
    from monitor.publishing.terminal.watch import watch as show

    show(keyexpr, connect or (), stop, Console(), seconds, zenoh, unit_system)
