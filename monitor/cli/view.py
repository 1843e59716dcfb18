"""Command ``view``: shows the devices of several daemons in one viewer."""

from typing import Annotated

import typer

from monitor.cli.shared import options, service_in_terminal


def view(
    keyexpr: options.KeyExpr = "imu/**",
    connect: options.Connect = None,
    zenoh: options.ZenohFile = None,
    detail: Annotated[
        list[str] | None,
        typer.Option(metavar="DEVICE", help="Also show samples and Allan deviations of this device; repeatable."),
    ] = None,
    viewer: options.Viewer = None,
    seconds: options.Seconds = None,
    units: options.Units = "imu",
) -> None:
    """Show several daemons in one viewer, with a table of all devices and details of selected devices."""
    service_in_terminal.run_fleet_viewer(
        keyexpr, connect or (), zenoh, detail or (), viewer or "auto", seconds, options.parse_units(units)
    )
