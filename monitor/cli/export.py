"""Command ``export``: writes noise parameters for other tools."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import ConfigError
from monitor.cli.shared import options, output


def export(
    source: Annotated[
        Path,
        typer.Argument(metavar="MODEL.toml|RESULT.json", help="Model, or JSON of analyze; - = standard input."),
    ],
    target_format: Annotated[
        str, typer.Option("--format", metavar="kalibr|gyroparams|kalman", help="Tool that reads the parameters.")
    ],
    inflation: options.Inflation = 1.0,
    dt: options.TimeStep = None,
    correlation_time: options.CorrelationTime = None,
    rostopic: Annotated[
        str | None, typer.Option(metavar="T", help="kalibr: topic of the IMU; /imu0 by default.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="File to write; by default standard output.")] = None,
) -> None:
    """Write noise parameters for other tools: Kalibr's imu.yaml, MATLAB's gyroparams, F and Q of a Kalman filter."""
    from monitor.publishing import exporters as exports

    keys = {"dt_s": dt, "correlation_time_s": correlation_time, "rostopic": rostopic}
    belong = {"dt_s": "kalman", "correlation_time_s": "kalman", "rostopic": "kalibr"}
    given = {name: value for name, value in keys.items() if value is not None}
    for name in given:
        if target_format in exports.FORMATS and target_format != belong[name]:
            option = name.removesuffix("_s").replace("_", "-")
            raise ConfigError(f"--{option}: belongs to --format {belong[name]}, not {target_format}")
    text = exports.export(options.read_noise_coefficients(source), target_format, inflation, **given)
    output.write_file_or_stdout("--out", out or Path("-"), text.encode())
