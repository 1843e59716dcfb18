"""Command ``analyze``: prints the Allan deviation and the noise coefficients of a recording."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import NotReady
from monitor.cli.shared import options, output


@options.with_reading_options
def analyze(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File, or folder of segments.")],
    rate: options.Rate = None,
    last: options.Last = None,
    reading: options.Reading = None,
    decoder: options.DecoderName = None,
    option: options.DecoderOptions = None,
    tau: Annotated[
        str, typer.Option(metavar="octave|decade10|S,S,…", help="Averaging times: a grid, or a list of seconds.")
    ] = "octave",
    window: Annotated[
        str | None,
        typer.Option(
            metavar="S", help="Also compute Allan deviations over time, in a window of S seconds; also 5min, 1h."
        ),
    ] = None,
    rest: Annotated[bool, typer.Option("--rest", help="Leave out periods in which the sensor moved.")] = False,
    units: options.Units = "imu",
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Result as JSON; - = standard output.")] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png|.html", help="Allan deviations as a picture, or the whole result as a page."),
    ] = None,
) -> None:
    """Print the Allan deviations, noise coefficients Q, N, B, K, R, motion and noise changes of a recording."""
    from monitor.commands import analyze as offline
    from monitor.publishing.messages.analysis_json import AnalysisMessage, FailedAnalysisMessage

    unit_system = options.parse_units(units)
    output.check_output_file("--plot", plot, ".png", ".html")
    window_s = options.parse_duration("--window", window)
    last_s = options.parse_duration("--last", last)
    wanted = offline.AnalysisRequest(
        recording,
        rate,
        options.parse_averaging_times(tau),
        window_s,
        rest,
        bool(json or plot),
        last_s,
        reading,
        options.parse_decoder(decoder, option),
    )
    try:
        with output.show_progress_bar() as tell:
            output.compile_analysis_kernels(tell)
            results = offline.run_analysis(wanted, tell)
    except offline.TooFewSamples as error:
        if json is not None:
            output.write_file_or_stdout(
                "--json", json, FailedAnalysisMessage(error.samples, [str(error)]).encode() + b"\n"
            )
        raise
    if json is not None:
        message = AnalysisMessage.from_analysis(
            results.analysis, results.total, results.hadamard, results.dynamic, results.without_temperature
        )
        output.write_file_or_stdout("--json", json, message.encode() + b"\n")
    if plot is not None:
        offline.save_plot_or_report(results, plot, recording.name, unit_system)
    if json != Path("-"):
        from monitor.publishing.terminal.coefficient_tables import print_analysis

        found = results.analysis
        print_analysis(found.estimate, found.axes_of_temperature, found.notes, unit_system)
    if results.lacking:
        raise NotReady(results.lacking)
