"""Command ``simulate``: simulates a noise model and writes the samples to a recording."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import ConfigError
from drivers.host.safe_file_reading import real_path
from monitor.cli.shared import options, output, service_in_terminal


@partial(options.with_loading_options, rate_and_last=False)
def simulate(
    model: Annotated[str, typer.Argument(metavar="MODEL.toml|NAME", help="Model file, or name of a shipped model.")],
    seconds: Annotated[str, typer.Option(metavar="S", help="Duration in s, or with a unit, e.g. 30min, 1h or 2d.")],
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Recording to write: .csv, .csv.gz, .npz, .parquet, .arrow, .mcap, ….")
    ],
    seed: options.SimulationSeed = 1,
    rate: options.ModelRate = None,
    temperature_from: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Simulate with the temperature of this recording.")
    ] = None,
    loading: options.Loading = None,
    truth: Annotated[
        bool,
        typer.Option(
            "--truth", help="Also write FILE.truth.json with the model and the random values drawn from the seed."
        ),
    ] = False,
    json: options.JsonFile = None,
) -> None:
    """Simulate the samples of a noise model and write them to a recording."""
    from monitor.commands import simulate as simulation
    from monitor.noise.model_loading import load_model

    length_s = options.parse_duration("--seconds", seconds)
    for name, path in (("--json", json), ("--temperature-from", temperature_from)):
        if path is not None and real_path(path) == real_path(out):
            raise ConfigError(f"{name}: {path} is also the output file of --out; choose another name")
    noise = load_model(model, Path.cwd())
    request = simulation.SimulationRequest(noise, out, length_s, seed, rate, temperature_from, truth, model, loading)
    service_in_terminal.exit_on_sigterm()
    with output.show_progress_bar() as tell:
        result = simulation.run_simulation(request, tell)
    output.write_json(json, result.encode_recording_summary_as_json)
    if json != Path("-"):
        typer.echo(result.describe_in_one_line())
