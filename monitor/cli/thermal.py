"""Commands ``thermal fit`` and ``thermal predict``: fit and apply a model of bias as a function of temperature."""

from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import NotReady
from monitor.cli.shared import options, output

RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help="File of a recording, or folder of segments.")]
PlotPath = Annotated[
    Path | None, typer.Option(metavar="FILE.png", help="Write the interval means and the model as a picture.")
]


@options.with_loading_options
def thermal_fit(
    recording: RecordingPath,
    out: Annotated[Path | None, typer.Option(metavar="MODEL.json", help="Model file to write.")] = None,
    interval: Annotated[
        str | None,
        typer.Option(
            metavar="S",
            help="Averaging interval: S seconds, or e.g. 10min or 1h; by default, about 72 intervals per recording.",
        ),
    ] = None,
    units: options.Units = "imu",
    json: options.JsonFile = None,
    plot: PlotPath = None,
    loading: options.Loading = None,
) -> None:
    """Fit the bias of each axis as a function of the temperature and its history."""
    from monitor.commands import thermal
    from monitor.publishing.terminal import thermal_output as text
    from monitor.publishing.terminal.console import Console

    output.check_output_file("--plot", plot, ".png")
    output.check_output_file("--out", out)
    unit_system = options.parse_units(units)
    interval_s = options.parse_duration("--interval", interval)
    with output.show_progress_bar() as tell:
        study = thermal.fit_thermal_models(recording, interval_s, loading, tell)
    output.write_json(json, lambda: text.encode_thermal_fit(study))
    if not study.fits:
        raise NotReady("; ".join(f"{axis}: {why}" for axis, why in study.refused.items()))
    if out is not None:
        output.write_file_or_stdout("--out", out, thermal.encode_model_file(study) + b"\n")
    if plot is not None:
        from monitor.publishing.plots.thermal_plot import save_thermal_fit_plot

        save_thermal_fit_plot(study, plot, unit_system)
    if Path("-") not in (json, out):
        text.print_thermal_fit(study, Console(), unit_system)
    output.print_written_files(json, out, plot)


@options.with_loading_options
def thermal_predict(
    recording: RecordingPath,
    model: Annotated[Path, typer.Option(metavar="MODEL.json", help="Model file that thermal fit has written.")],
    units: options.Units = "imu",
    json: options.JsonFile = None,
    plot: PlotPath = None,
    loading: options.Loading = None,
) -> None:
    """Predict the bias of another recording with a model, and print the errors of the prediction."""
    from monitor.commands import thermal
    from monitor.publishing.terminal import thermal_output as text
    from monitor.publishing.terminal.console import Console

    output.check_output_file("--plot", plot, ".png")
    unit_system = options.parse_units(units)
    models = thermal.read_model_file(model)
    with output.show_progress_bar() as tell:
        outlook = thermal.predict_bias_of_recording(recording, models, loading, tell)
    output.write_json(json, lambda: text.encode_thermal_prediction(outlook))
    if not outlook.judged:
        raise NotReady("; ".join(f"{axis}: {why}" for axis, why in outlook.refused.items()))
    if plot is not None:
        from monitor.publishing.plots.thermal_plot import save_thermal_prediction_plot

        save_thermal_prediction_plot(outlook, plot, unit_system)
    if json != Path("-"):
        text.print_thermal_prediction(outlook, Console(), unit_system)
    output.print_written_files(json, plot)
