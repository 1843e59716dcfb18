"""Command ``demo``: runs the daemon on a simulated sensor."""

from typing import Annotated

import typer

from monitor.cli.shared import options, service_in_terminal


def demo(
    sensor: Annotated[
        str | None, typer.Option(metavar="NAME|MODEL.toml", help="Name of a shipped sensor model, or a model file.")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AXIS.EFFECT:P=V,…",
            help="Effect that begins during the run, e.g. gz.sinusoidal:amplitude=3e-3,frequency=17; repeatable.",
        ),
    ] = None,
    effect_at: Annotated[
        str | None,
        typer.Option(
            metavar="S", help="Time at which the effects begin; by default 90 s, when change detection is active."
        ),
    ] = None,
    seconds: options.Seconds = None,
    viewer: options.Viewer = None,
    units: options.ConfiguredUnits = None,
) -> None:
    """Run the daemon with a simulated MEMS IMU, which sends a real wire format over a pseudo-terminal."""
    from monitor.simulator.demo_config import build_demo_config as configuration

    service_in_terminal.run_service(
        configuration(sensor, effect or (), options.parse_duration("--effect-at", effect_at)),
        seconds,
        viewer,
        units,
    )
