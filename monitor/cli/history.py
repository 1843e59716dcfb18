"""Command ``history``: prints stored results from the history file or from a running daemon."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from drivers.errors import ConfigError
from drivers.secret_masking import mask_secrets
from monitor.cli.shared import options, output
from monitor.cli.shared.errors import name_option_in_config_errors

if TYPE_CHECKING:
    from monitor.history.bucketed_history import HistoryTable
    from monitor.history.query_parameters import HistoryQuery
    from monitor.history.time_ranges import TimeRange

MAX_TABLE_ROWS: Final = 24
Get = Callable[["HistoryQuery"], "HistoryTable"]
"""Function that runs a query of the history and returns the result."""


def history(
    source: Annotated[
        Path | None,
        typer.Argument(metavar="CONFIG.toml|FOLDER", help="Configuration file, or the folder that [storage] names."),
    ] = None,
    connect: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="Query a running daemon instead of a file, e.g. tcp/127.0.0.1:7450."),
    ] = None,
    zenoh: options.ZenohFile = None,
    prefix: options.Prefix = "imu",
    device: options.DeviceName = None,
    since: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="T", help="Start of the period, e.g. -7d, 2026-11-20 or 2026-11-20T14:30; by default -1d."
        ),
    ] = None,
    until: Annotated[
        str | None, typer.Option("--to", metavar="T", help="End of the period, in the same form; by default now.")
    ] = None,
    step: Annotated[
        str | None, typer.Option(metavar="S", help="Minimum time that a row covers, e.g. 15min, 1h or 1d.")
    ] = None,
    axis: Annotated[
        str | None, typer.Option(metavar="AXIS", help="Print the results of one axis over time, e.g. gz.")
    ] = None,
    json: options.JsonFile = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write all numbers as a table: .csv, .parquet, .npz, .arrow.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Write coefficients over time and events as a picture.")
    ] = None,
    units: options.Units = "imu",
) -> None:
    """Print past coefficients, temperatures, lost samples and events over a period of hours to years."""
    from drivers.data_types import AXES
    from drivers.recordings.formats import find_writer
    from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
    from monitor.history.bucketed_history import choose_bucket_width_s as width_of
    from monitor.history.query_parameters import PARTS, HistoryQuery
    from monitor.history.time_ranges import parse_duration_s
    from monitor.publishing.terminal import history_text
    from monitor.publishing.terminal.console import Console

    if axis is not None and axis not in AXES:
        raise ConfigError(f'--axis: "{axis}"; possible are {", ".join(AXES)}')
    unit_system = options.parse_units(units)
    output.check_output_file("--plot", plot, ".png")
    output.check_output_file("--out", out)
    if out is not None:
        find_writer(out, any_columns=True)
    live = connect is not None or zenoh is not None
    if source is not None and live:
        raise ConfigError(f"{source}: give either a file or --connect, not both")
    with name_option_in_config_errors("--step"):
        step_s = None if step is None else max(int(parse_duration_s(step)), 1)
    axes = AXES if axis is None else (axis,)
    asked = HistoryQuery(_span(since, until), step_s, PARTS, axes)
    get = _from_daemon(connect, zenoh, prefix, device) if live else _from_file(source, device)
    past = get(asked)
    _save(past, asked, json, out)
    if plot is not None:
        from monitor.publishing.plots.history_plot import save_history_plot

        save_history_plot(past, plot, asked.axes, unit_system)
    output.print_written_files(json, out, plot)
    if json == Path("-"):
        return
    console = Console()
    history_text.print_history_summary(past, axes, SYMBOLS if axis else history_text.LETTERS, console, unit_system)
    if axis is not None and len(past):
        few_s = max(width_of(past.span, None, MAX_TABLE_ROWS), past.step_s)
        few = past if few_s == past.step_s else get(HistoryQuery(asked.span, few_s, ("coefficients", "status"), axes))
        history_text.print_axis_history(few, axis, SYMBOLS, console, unit_system)


def _save(past: "HistoryTable", asked: "HistoryQuery", json: Path | None, out: Path | None) -> None:
    from monitor.publishing.messages.history import HistoryMessage
    from monitor.publishing.reports import history_file

    newest_s = float(past.end_s[-1]) if len(past) else past.span.end_s
    samples = int(past.counts[:, 0].sum())
    output.write_json(json, lambda: HistoryMessage.build_reply(past, asked, newest_s, samples).encode())
    if out is not None:
        history_file.save_history(past, out)


def _from_file(source: Path | None, name: str | None) -> Get:
    """Return a function that queries the history file, even while a daemon writes to the file."""
    from monitor.history import bucketed_history as past
    from monitor.history.sqlite_store import open_history

    if source is None:
        raise ConfigError("CONFIG.toml or a folder is needed, or --connect ENDPOINT for a running daemon")
    path = _history_path(source)
    with open_history(path) as reader:
        device = options.select_device(name, list(reader.list_devices()), str(path), "history")

    def query_file(query: "HistoryQuery") -> "HistoryTable":
        with open_history(path) as reader:
            return past.read_history(reader, device, query.span, query.selects_column, query.step_s)

    return query_file


def _from_daemon(endpoint: str | None, file: Path | None, prefix: str, name: str | None) -> Get:
    from monitor.publishing.zenoh.clients import query_histories

    def query_daemon(query: "HistoryQuery") -> "HistoryTable":
        found = {
            one.device: one for one in query_histories(endpoint, name or "*", query.format_parameters(), prefix, file)
        }
        return found[options.select_device(name, list(found), mask_secrets(endpoint or str(file)), "history")]

    return query_daemon


def _history_path(source: Path) -> Path:
    """Return the path of the history file, given a configuration file, a storage folder or the history file itself."""
    from monitor.history.sqlite_store import FILE_NAME
    from monitor.settings import loading

    if source.is_dir():
        return source / FILE_NAME
    if source.name == FILE_NAME:
        return source
    config = loading.load_config(source, allow_pipe=True)
    if config.storage is None:
        raise ConfigError(f"{source}: stores no history, because [storage] has no folder")
    return config.storage.folder / FILE_NAME


def _span(since: str | None, until: str | None) -> "TimeRange | None":
    """Return the time range given by the options ``--from`` and ``--to``, or None if both options are missing."""
    from monitor.history.time_ranges import TimeRange, parse_time

    if since is None and until is None:
        return None
    now_s = time.time()
    with name_option_in_config_errors("--from"):
        start_s = float("-inf") if since is None else parse_time(since, now_s)
    with name_option_in_config_errors("--to"):
        end_s = float("inf") if until is None else parse_time(until, now_s)
    if end_s <= start_s:
        raise ConfigError(f"--to: {until} is not after --from {since}")
    return TimeRange(start_s, end_s, end_included=False)
