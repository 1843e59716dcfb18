"""Command ``compensate``: removes the drift of gyroscopes from a recording."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import ConfigError
from drivers.host.safe_file_reading import real_path
from monitor.cli.shared import options, output, service_in_terminal


@options.with_loading_options
def compensate(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File of a recording, or folder of segments.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Compensated recording to write: .npz, .csv, .parquet, ….")],
    method: Annotated[
        str,
        typer.Option(
            metavar="M",
            help="Method: adaptive, as in the daemon; for comparison: fixed, ar, emd, wavelet (extra: denoise).",
        ),
    ] = "adaptive",
    order: Annotated[
        str | None,
        typer.Option(
            metavar="P,Q",
            help="Order of the ARMA model of the drift, up to 2,1; by default, the BIC selects the order.",
        ),
    ] = None,
    units: options.Units = "imu",
    json: options.JsonFile = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Write the drift and the Allan deviations as a picture.")
    ] = None,
    loading: options.Loading = None,
) -> None:
    """Remove the gyro drift from a recording, and write the compensated recording."""
    from monitor.commands import compensate as compensating
    from monitor.publishing.terminal import compensate_output as text
    from monitor.publishing.terminal.console import Console

    output.check_output_file("--plot", plot, ".png")
    output.check_output_file("--out", out)
    for name, place in (("--json", json), ("--plot", plot), ("RECORDING", recording)):
        if place is not None and real_path(place) == real_path(out):
            raise ConfigError(f"{name}: {place} is also the output file of --out; choose another name")
    service_in_terminal.exit_on_sigterm()
    arma_order, unit_system = options.parse_arma_order(order), options.parse_units(units)
    with output.show_progress_bar() as tell:
        output.compile_analysis_kernels(tell)
        result = compensating.run_compensation(recording, out, method, arma_order, loading, tell)
    output.write_json(json, lambda: text.encode_compensation(result))
    if plot is not None:
        from monitor.publishing.plots.compensate_plot import save_compensation_plot

        save_compensation_plot(result, plot, unit_system)
    if json != Path("-"):
        text.print_compensation(result, Console(), unit_system)
    output.print_written_files(json, out, plot)
