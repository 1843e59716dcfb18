"""Command ``reconcile``: compares recordings with a noise model."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import NotReady
from drivers.host.extras import require_extra
from monitor.cli.shared import options, output, service_in_terminal


@options.with_loading_options
def reconcile(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING…",
            help="File of a recording, or folder of segments; several recordings must be of the same sensor.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the report and the augmented model.")],
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL.toml|NAME",
            help="Noise model to compare; by default, Q, N, B, K and R are fitted to the first recording.",
        ),
    ] = None,
    seed: options.ReportSeed = 1,
    units: options.Units = "imu",
    json: options.JsonFile = None,
    details: Annotated[
        bool, typer.Option("--details", help="Print all findings, axes and steps of the search.")
    ] = False,
    loading: options.Loading = None,
) -> None:
    """Compare recordings with a noise model, and find the effects that are missing from the model."""
    require_extra("reconcile", "reconcile")
    from monitor.commands import reconcile as reconciling
    from monitor.common.heap_memory import keep_freed_memory
    from monitor.noise.model_loading import load_model
    from monitor.publishing.terminal import reconcile_text as text
    from monitor.publishing.terminal.console import Console
    from monitor.reconcile import json_report

    unit_system = options.parse_units(units)
    tested = None if model is None else load_model(model, Path.cwd())
    several = len(recordings) > 1
    service_in_terminal.exit_on_sigterm()
    keep_freed_memory()
    try:
        with output.show_progress_bar() as tell:
            output.compile_analysis_kernels(tell)
            if several:
                runs = reconciling.compare_recordings(recordings, tested, out, seed, loading, tell, unit_system)
                data = json_report.encode_comparison(runs)
                show = partial(text.print_comparison, runs, details=details, units=unit_system)
            else:
                one = reconciling.reconcile_and_write_report(
                    recordings[0], tested, out, seed, loading, report_progress=tell, units=unit_system
                )
                data = json_report.encode_report(one)
                show = partial(text.print_reconciliation, one, details=details, units=unit_system)
    except NotReady:
        output.write_json(json, (out / reconciling.REPORT).read_bytes)
        raise
    output.write_json(json, lambda: data)
    if json != Path("-"):
        show(Console())
    output.print_written_files(json, out / "report.html", out / "model.toml")
