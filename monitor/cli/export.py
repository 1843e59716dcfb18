"""Command ``export``: writes noise parameters for other tools."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from drivers.errors import ConfigError
from drivers.secret_masking import mask_secrets
from monitor.cli.shared import options, output

if TYPE_CHECKING:
    from monitor.publishing.exporters import NoiseCoefficients

OPTION_NAMES: Final = {"dt_s": "--dt", "correlation_time_s": "--correlation-time", "rostopic": "--rostopic"}


def export(
    target_format: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="Program that reads the parameters: kalibr, allan_variance_ros, openvins, vins_fusion, orb_slam3, "
            "lio_sam, fast_lio, gtsam, px4_ekf2, ardupilot_ekf3, robot_localization, imu_utils, gnss_ins_sim, "
            "gyroparams, kalman.",
        ),
    ],
    sources: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="MODEL.toml|NAME|RESULT.json",
            help="Model file, name of a shipped model, or JSON output of analyze; - = standard input. Several results "
            "with different axes are joined.",
        ),
    ] = None,
    inflation: options.Inflation = 1.0,
    dt: options.TimeStep = None,
    correlation_time: options.CorrelationTime = None,
    rostopic: Annotated[str | None, typer.Option(metavar="T", help="ROS topic of the IMU; by default /imu0.")] = None,
    connect: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="Use the results of a running daemon, e.g. tcp/127.0.0.1:7450."),
    ] = None,
    zenoh: options.ZenohFile = None,
    prefix: options.Prefix = "imu",
    device: options.DeviceName = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="File to write; by default standard output.")] = None,
) -> None:
    """Write noise parameters in the file formats of other programs: estimators, calibration programs, simulators."""
    from monitor.publishing import exporters

    live = connect is not None or zenoh is not None
    if live == bool(sources):
        raise ConfigError("give either a model or the JSON of analyze, or --connect ENDPOINT for a running daemon")
    noise = (
        exporters.join_sources([options.read_noise_coefficients(one) for one in sources])
        if sources
        else _from_daemon(connect, zenoh, prefix, device)
    )
    try:
        text = exporters.export(
            noise, target_format, inflation, dt_s=dt, correlation_time_s=correlation_time, rostopic=rostopic
        )
    except ConfigError as error:
        name, colon, rest = str(error).partition(": ")
        raise ConfigError(f"{OPTION_NAMES.get(name, name)}{colon}{rest}") from None
    output.write_file_or_stdout("--out", out or Path("-"), text.encode())
    output.print_written_files(out)
    for sentence in exporters.describe_weak_points(noise):
        typer.echo(f"note: {sentence}", err=True)


def _from_daemon(endpoint: str | None, file: Path | None, prefix: str, name: str | None) -> "NoiseCoefficients":
    """Return the coefficients that a running daemon currently publishes."""
    from monitor.publishing import exporters
    from monitor.publishing.zenoh.clients import receive_coefficients

    found = receive_coefficients(endpoint, name, prefix, file)
    device = options.select_device(name, list(found), mask_secrets(endpoint or str(file)), "result")
    return exporters.from_analysis_json(found[device], f"device {device}, live")
