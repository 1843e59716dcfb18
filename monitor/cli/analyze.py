"""Command ``analyze``: prints the Allan deviation and the noise coefficients of a recording."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import NotReady
from monitor.cli.shared import options, output


@options.with_loading_options
def analyze(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File of a recording, or folder of segments.")],
    tau: Annotated[
        str,
        typer.Option(metavar="octave|decade10|S,S,…", help="Averaging times: name of a grid, or list of times in s."),
    ] = "octave",
    window: Annotated[
        str | None,
        typer.Option(
            metavar="S",
            help="Also compute Allan deviations over time, in a sliding window of S seconds, or e.g. 5min or 1h.",
        ),
    ] = None,
    rest: Annotated[bool, typer.Option("--rest", help="Exclude periods in which the sensor moved.")] = False,
    units: options.Units = "imu",
    json: options.JsonFile = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png|.html",
            help="Write the Allan deviations as a picture, or the whole result as an HTML page.",
        ),
    ] = None,
    loading: options.Loading = None,
) -> None:
    """Print Allan deviations, the noise coefficients Q, N, B, K and R, motion and noise changes of a recording."""
    from monitor.commands import analyze as offline
    from monitor.commands.recording_loading import load_recording
    from monitor.publishing.messages.analysis_json import FailedAnalysisMessage

    unit_system = options.parse_units(units)
    output.check_output_file("--plot", plot, ".png", ".html")
    window_s = options.parse_duration("--window", window)
    times = options.parse_averaging_times(tau)
    try:
        with output.show_progress_bar() as tell:
            output.compile_analysis_kernels(tell)
            found = load_recording(recording, loading, tell)
            results = offline.analyze_recording(found, times, window_s, rest, bool(json or plot), tell)
    except offline.TooFewSamples as error:
        output.write_json(json, FailedAnalysisMessage(error.samples, [str(error)]).encode)
        raise
    output.write_json(json, lambda: results.to_message().encode())
    if plot is not None:
        offline.save_plot_or_report(results, plot, recording.name, unit_system)
    if json != Path("-"):
        from monitor.publishing.terminal.coefficient_tables import print_analysis

        analysis = results.analysis
        print_analysis(analysis.estimate, analysis.axes_of_temperature, analysis.notes, unit_system)
    output.print_written_files(json, plot)
    if results.lacking:
        raise NotReady(results.lacking)
