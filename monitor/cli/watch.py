"""Command ``watch``: shows a live table of the devices of several daemons."""

import threading

from monitor.cli.shared import options, service_in_terminal


def watch(
    keyexpr: options.KeyExpr = "imu/**",
    connect: options.Connect = None,
    zenoh: options.ZenohFile = None,
    seconds: options.Seconds = None,
) -> None:
    """Show a live table of several daemons, whose results are received over zenoh."""
    from rich.console import Console

    from monitor.publishing.terminal.watch import watch as show

    stop = threading.Event()
    service_in_terminal.install_signal_handlers(stop.set)
    show(keyexpr, connect or (), stop, Console(), seconds, zenoh)
