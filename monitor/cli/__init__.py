"""Command line of the program: parses arguments, calls one function for each command, and prints its result.

Exit status: 0 for success, 1 for a failure at run time, 2 for a wrong argument or input file, and 3 if the data do not
support an answer. With status 2, one line on standard error describes the mistake. Each command imports the heavy
libraries that it needs.
"""

import contextlib
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Mapping, MutableMapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn

import typer
from typer.exceptions import TyperException

from drivers.errors import ConfigError, ImuError, NotReady, RecordingError, format_one_line
from drivers.extras import check_extra
from drivers.file_access import real_path
from monitor.cli import doctor, drift, options, output, terminal_session, warm_up
from monitor.cli import history as history_command

# This must precede the import of NumPy. The matrices are small, and the program has its own threads for the work.
# Additional threads of the linear algebra libraries would only wait actively.
for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_pool, "1")

FAILED: Final = 1
"""Exit status of a failure at run time."""
WRONG: Final = 2
"""Exit status of a wrong argument or input file."""
NO_ANSWER: Final = 3
"""Exit status if the data do not support an answer."""
INTERRUPTED: Final = 128 + signal.SIGINT
"""Exit status after Ctrl-C."""
DEBUG: Final = "--debug"
"""Option that prints tracebacks."""
MAX_CAUSE_CHARS: Final = 300
"""Largest length of the text of an unexpected error, in characters. Libraries may write pages."""

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="Configuration file.")]
Viewer = Annotated[
    str | None, typer.Option(metavar="auto|native|web|none|FILE.rrd", help="Where to show the live view.")
]


@app.callback()
def options_of_all_commands(
    debug: Annotated[
        bool, typer.Option(DEBUG, help="Print the traceback of an error and the warnings of libraries.")
    ] = False,
) -> None:
    """Live noise monitor for MEMS IMUs: windowed Allan variance and Q, N, B, K, R while the sensor runs."""


@app.command()
def demo(
    sensor: Annotated[
        str | None, typer.Option(metavar="NAME|MODEL.toml", help="A sensor of the catalogue, or a model file.")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AXIS.EFFECT:P=V,…",
            help="An effect that the sensor takes on, e.g. gz.sinusoidal:amplitude=3e-3,frequency=17; repeatable.",
        ),
    ] = None,
    effect_at: Annotated[
        str | None, typer.Option(metavar="S", help="When, after the start; 90 s, by then changes are looked for.")
    ] = None,
    seconds: options.Seconds = None,
    viewer: Viewer = None,
) -> None:
    """The whole service on a simulated MEMS IMU that speaks a real wire format over a pseudo-terminal."""
    from monitor.simulator.demo import demo_config as configuration

    terminal_session.serve(
        configuration(sensor, effect or (), options.duration("--effect-at", effect_at)), seconds, viewer
    )


@app.command()
def run(
    config: ConfigPath,
    seconds: options.Seconds = None,
    viewer: Viewer = None,
    history: Annotated[
        str | None, typer.Option(metavar="S", help="Open the live view on what was: 1d, 12h; needs [storage].")
    ] = None,
) -> None:
    """The daemon: every device in the file, until a signal."""
    from monitor.settings import loading

    found = terminal_session.with_history(loading.load(config, pipe=True), options.duration("--history", history))
    terminal_session.serve(found, seconds, viewer)


@app.command()
def check(
    config: Annotated[Path | None, typer.Argument(metavar="CONFIG.toml", help="Configuration file.")] = None,
    print_defaults: Annotated[
        bool, typer.Option("--print-defaults", help="Print a configuration file with all keys and their defaults.")
    ] = False,
    link: Annotated[
        str | None, typer.Option(metavar="NAME", help="With --print-defaults: print the keys of this link only.")
    ] = None,
    decoder: Annotated[
        str | None, typer.Option(metavar="NAME", help="With --print-defaults: print the keys of this decoder only.")
    ] = None,
) -> None:
    """Read a configuration file and report all mistakes. No device is opened."""
    from monitor.commands.check import check as check_configuration

    if print_defaults:
        typer.echo(_defaults(link, decoder), nl=False)
        return
    if link is not None or decoder is not None:
        raise ConfigError("--link and --decoder belong to --print-defaults")
    if config is None:
        raise ConfigError("CONFIG.toml is missing; --print-defaults prints one to start from")
    found, wrong = check_configuration(config, pipe=True)
    for line in (*wrong, *(f"warning: {line}" for line in (found.warnings if found else ()))):
        typer.echo(line, err=True)
    if wrong:
        raise typer.Exit(WRONG)
    count = len(found.devices) if found else 0
    typer.echo(f"{config}: {count} device{'s' if count != 1 else ''}, nothing wrong")


def _defaults(link: str | None, decoder: str | None) -> str:
    """Return the text of all keys, or of the keys of a link and a decoder."""
    from monitor.settings import printed_defaults

    texts = []
    for option, name, form in (
        ("--link", link, printed_defaults.format_link),
        ("--decoder", decoder, printed_defaults.format_decoder),
    ):
        if name is not None:
            try:
                texts.append(form(name))
            except ConfigError as error:
                raise ConfigError(f"{option}: {error}") from None
    return "\n".join(texts) or printed_defaults.format_defaults()


app.command()(doctor.doctor)
app.command()(warm_up.warm_up)


@app.command()
def watch(
    keyexpr: options.KeyExpr = "imu/**",
    connect: options.Connect = None,
    zenoh: options.ZenohFile = None,
    seconds: options.Seconds = None,
) -> None:
    """A live table of any number of daemons, from zenoh alone."""
    import threading

    from rich.console import Console

    from monitor.publishing.terminal.watch import watch as show

    stop = threading.Event()
    terminal_session.on_signals(stop.set)
    show(keyexpr, connect or (), stop, Console(), seconds, zenoh)


@app.command()
def view(
    keyexpr: options.KeyExpr = "imu/**",
    connect: options.Connect = None,
    zenoh: options.ZenohFile = None,
    detail: Annotated[
        list[str] | None, typer.Option(metavar="DEVICE", help="Show its samples and curves too; repeatable.")
    ] = None,
    viewer: Viewer = None,
    seconds: options.Seconds = None,
) -> None:
    """One viewer for any number of daemons, from zenoh alone: a table of all, chosen devices in detail."""
    terminal_session.view(keyexpr, connect or (), zenoh, detail or (), viewer or "auto", seconds)


@app.command()
def analyze(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File, or folder of segments.")],
    rate: options.Rate = None,
    last: options.Last = None,
    tau: Annotated[
        str, typer.Option(metavar="octave|decade10|S,S,…", help="Averaging times: a grid, or seconds.")
    ] = "octave",
    window: Annotated[
        str | None, typer.Option(metavar="S", help="Curves over time too, in a window of S seconds; also 5min, 1h.")
    ] = None,
    rest: Annotated[bool, typer.Option("--rest", help="Strike out stretches in which the sensor moved.")] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Result as JSON; - = standard output.")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png|.html", help="The curves as a picture, or all of it as a page.")
    ] = None,
) -> None:
    """Allan deviation of a recording, with Q, N, B, K, R and their intervals; motion and changes in it."""
    from monitor.commands import analyze as offline
    from monitor.publishing.messages.analysis import AnalysisMessage, FailedAnalysisMessage

    if plot is not None and plot.suffix not in (".png", ".html"):
        raise ConfigError(f"--plot: {plot}: a name ending in .png or .html is needed")
    window_s = options.duration("--window", window)
    last_s = options.duration("--last", last)
    wanted = offline.Request(recording, rate, options.tau(tau), window_s, rest, bool(json or plot), last_s)
    try:
        with output.progress() as tell:
            output.compile_kernels(tell)
            results = offline.run_analysis(wanted, tell)
    except offline.TooFewSamples as error:
        if json is not None:
            output.write("--json", json, FailedAnalysisMessage(error.samples, [str(error)]).encode() + b"\n")
        raise
    if json is not None:
        message = AnalysisMessage.of(
            results.analysis, results.total, results.hadamard, results.dynamic, results.without_temperature
        )
        output.write("--json", json, message.encode() + b"\n")
    if plot is not None:
        offline.draw_plots(results, plot, recording.name)
    if json != Path("-"):
        output.print_analysis(results.analysis)
    if results.lacking:
        raise NotReady(results.lacking)


@app.command()
def simulate(
    model: Annotated[str, typer.Argument(metavar="MODEL.toml|NAME", help="Model file, or one of the catalogue.")],
    seconds: Annotated[str, typer.Option(metavar="S", help="Length in seconds; also 30min, 1h, 2d.")],
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="What to write: .csv, .csv.gz, .npz, .parquet, .arrow, .feather.")
    ],
    seed: options.SimulationSeed = 1,
    rate: options.ModelRate = None,
    temperature_from: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Take the temperature of this recording.")
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Write FILE.truth.json too: the model, and what was drawn from the seed.")
    ] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Result as JSON; - = standard output.")] = None,
) -> None:
    """A recording from a model, of any length; it appears whole or not at all."""
    from monitor.commands import simulate as simulation
    from monitor.noise.catalogue import load_model

    length_s = options.duration("--seconds", seconds)
    output.check_place("--json", json)
    for option, path in (("--json", json), ("--temperature-from", temperature_from)):
        if path is not None and real_path(path) == real_path(out):
            raise ConfigError(f"{option}: {path} is what --out writes; another name is needed")
    noise = load_model(model, Path.cwd())
    request = simulation.Request(noise, out, length_s, seed, rate, temperature_from, truth, model)
    terminal_session.end_on_sigterm()
    with output.progress() as tell:
        result = simulation.run_simulation(request, tell)
    if json is not None:
        output.write("--json", json, result.to_json() + b"\n")
    if json != Path("-"):
        typer.echo(result.text())


@app.command()
def reconcile(
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING…", help="File, or folder of segments; several of one sensor are compared."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the report and the augmented model.")],
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL.toml|NAME",
            help="Model under test; else the five classic terms are fitted first, to the first recording.",
        ),
    ] = None,
    seed: options.ReportSeed = 1,
    rate: options.Rate = None,
    last: options.Last = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Result as JSON; - = standard output.")] = None,
) -> None:
    """Where recording and model disagree, which effect is missing, and what is left once it is added."""
    check_extra("reconcile", "reconcile")
    from rich.console import Console

    from monitor.commands import reconcile as reconciling
    from monitor.noise.catalogue import load_model
    from monitor.publishing.terminal import reconcile_text as text
    from monitor.reconcile import report
    from monitor.reconcile.several_recordings import comparison_report

    last_s = options.duration("--last", last)
    output.check_place("--json", json)
    tested = None if model is None else load_model(model, Path.cwd())
    several = len(recordings) > 1
    terminal_session.end_on_sigterm()
    try:
        with output.progress() as tell:
            output.compile_kernels(tell)
            if several:
                every = reconciling.ComparisonRequest(tuple(recordings), tested, out, seed, rate, last_s)
                runs = reconciling.compare_recordings(every, tell)
                data, show = comparison_report.encode_comparison(runs), partial(text.print_comparison, runs)
            else:
                one = reconciling.run_reconciliation(
                    reconciling.Request(recordings[0], tested, out, seed, rate, last_s=last_s), tell
                )
                data, show = report.encode_report(one), partial(text.print_report, one)
    except NotReady:
        if json is not None:
            output.write("--json", json, (out / reconciling.REPORT).read_bytes() + b"\n")
        raise
    if json is not None:
        output.write("--json", json, data + b"\n")
    if json != Path("-"):
        show(Console())


thermal_app = typer.Typer(
    help="Bias against temperature: fit a model to a recording, predict another.", rich_markup_mode=None
)
app.add_typer(thermal_app, name="thermal")

app.command()(drift.compensate)
app.command()(history_command.history)

RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help="File, or folder of segments.")]
JsonPath = Annotated[Path | None, typer.Option(metavar="FILE", help="Result as JSON; - = standard output.")]
PlotPath = Annotated[Path | None, typer.Option(metavar="FILE.png", help="Means and model as a picture.")]


@thermal_app.command("fit")
def thermal_fit(
    recording: RecordingPath,
    out: Annotated[Path | None, typer.Option(metavar="MODEL.json", help="Where to write the model.")] = None,
    interval: Annotated[
        str | None, typer.Option(metavar="S", help="Length of a mean; also 10min, 1h. Else about 72 in the recording.")
    ] = None,
    rate: options.Rate = None,
    last: options.Last = None,
    json: JsonPath = None,
    plot: PlotPath = None,
) -> None:
    """Fit the bias of each axis as a function of temperature and its past."""
    from rich.console import Console

    from monitor.commands import thermal
    from monitor.publishing.terminal import thermal_text as text

    _check_thermal(json, plot)
    output.check_place("--out", out)
    interval_s, last_s = options.duration("--interval", interval), options.duration("--last", last)
    study = thermal.fit_recording(recording, interval_s, rate, last_s)
    if json is not None:
        output.write("--json", json, text.encode_thermal_fit(study) + b"\n")
    if not study.fits:
        raise NotReady("; ".join(f"{axis}: {why}" for axis, why in study.refused.items()))
    if out is not None:
        output.write("--out", out, thermal.write_model_file(study) + b"\n")
    if plot is not None:
        from monitor.publishing.plots.thermal_plot import save_thermal_fit_plot

        save_thermal_fit_plot(study, plot)
    if Path("-") not in (json, out):
        text.print_thermal_fit(study, Console())


@thermal_app.command("predict")
def thermal_predict(
    recording: RecordingPath,
    model: Annotated[Path, typer.Option(metavar="MODEL.json", help="What thermal fit wrote.")],
    rate: options.Rate = None,
    last: options.Last = None,
    json: JsonPath = None,
    plot: PlotPath = None,
) -> None:
    """What a model expects of another recording's bias, and how far off it is."""
    from rich.console import Console

    from monitor.commands import thermal
    from monitor.publishing.terminal import thermal_text as text

    _check_thermal(json, plot)
    outlook = thermal.predict_recording(
        recording, thermal.read_model_file(model), rate, options.duration("--last", last)
    )
    if json is not None:
        output.write("--json", json, text.encode_thermal_prediction(outlook) + b"\n")
    if not outlook.judged:
        raise NotReady("; ".join(f"{axis}: {why}" for axis, why in outlook.refused.items()))
    if plot is not None:
        from monitor.publishing.plots.thermal_plot import save_thermal_prediction_plot

        save_thermal_prediction_plot(outlook, plot)
    if json != Path("-"):
        text.print_thermal_prediction(outlook, Console())


def _check_thermal(json: Path | None, plot: Path | None) -> None:
    """Check the output files of the ``thermal`` commands before the work begins.

    Raises
    ------
    ConfigError
        A file cannot be written, or the picture has another suffix than .png.
    """
    if plot is not None and plot.suffix != ".png":
        raise ConfigError(f"--plot: {plot}: a name ending in .png is needed")
    output.check_place("--json", json)
    output.check_place("--plot", plot)


@app.command()
def export(
    source: Annotated[
        Path,
        typer.Argument(metavar="MODEL.toml|RESULT.json", help="Model, or JSON of analyze; - = standard input."),
    ],
    form: Annotated[str, typer.Option("--format", metavar="kalibr|gyroparams|kalman", help="For which tool.")],
    inflation: options.Inflation = 1.0,
    dt: options.TimeStep = None,
    correlation_time: options.CorrelationTime = None,
    rostopic: Annotated[str | None, typer.Option(metavar="T", help="kalibr: topic of the IMU; /imu0.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Where to write; else standard output.")] = None,
) -> None:
    """Noise parameters for other tools: Kalibr's imu.yaml, MATLAB's gyroparams, a Kalman filter's F and Q."""
    from monitor.publishing import exporters as exports

    keys = {"dt_s": dt, "correlation_time_s": correlation_time, "rostopic": rostopic}
    belong = {"dt_s": "kalman", "correlation_time_s": "kalman", "rostopic": "kalibr"}
    given = {name: value for name, value in keys.items() if value is not None}
    for name in given:
        if form in exports.FORMATS and form != belong[name]:
            option = name.removesuffix("_s").replace("_", "-")
            raise ConfigError(f"--{option}: belongs to --format {belong[name]}, not {form}")
    text = exports.export(options.noise(source), form, inflation, **given)
    output.write("--out", out or Path("-"), text.encode())


def main() -> None:
    """Run the program with the arguments of the process, and exit with its status.

    Every error is printed as one line on standard error. ``--debug``, before or after the name of the command, prints
    the traceback of an error before this line.
    """
    arguments, debug = split_debug(sys.argv[1:])
    threading.excepthook = partial(report_failed_thread, debug)
    _ignore_impossible_width(os.environ)
    try:
        # without standalone mode, typer returns the status of an Exit
        status = app(args=arguments, prog_name="imu-monitor", standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
    except Exception as error:  # noqa: BLE001 - any other error is printed in one line, with a request to report it
        if debug:
            traceback.print_exc()
        line, status = explain(error)
        if isinstance(error, OSError):
            _discard_output()
        if not isinstance(error, BrokenPipeError):  # the reader of the output has gone, so a message is useless
            _fail(line, status)
    if status == INTERRUPTED:  # typer converts Ctrl-C to an Exit
        _fail("interrupted", INTERRUPTED)
    sys.exit(status)


def report_failed_thread(debug: bool, failed: threading.ExceptHookArgs) -> None:
    """Print one line on standard error with the reason why a thread ended.

    Parameters
    ----------
    debug : bool
        True if the traceback is printed as well.
    failed : threading.ExceptHookArgs
        Thread and its exception.
    """
    error = failed.exc_value
    if not isinstance(error, Exception) or sys.stderr is None:
        return
    with contextlib.suppress(OSError, ValueError):
        if debug:
            traceback.print_exception(error)
        thread = "a thread" if failed.thread is None else f'thread "{failed.thread.name}"'
        print(f"imu-monitor: {thread} ended: {explain(error)[0]}", file=sys.stderr, flush=True)  # noqa: T201


def _ignore_impossible_width(environment: MutableMapping[str, str]) -> None:
    """Remove terminal sizes from the environment that leave no space to print: a table of no columns would be empty."""
    for name in ("COLUMNS", "LINES"):
        if not re.fullmatch(r"0*[1-9][0-9]{0,4}", environment.get(name, "")):
            environment.pop(name, None)


def split_debug(arguments: Sequence[str]) -> tuple[list[str], bool]:
    """Return the arguments without ``--debug``, and True if it was among them. ``--`` ends the options.

    Examples
    --------
    >>> split_debug(["analyze", "a.csv", "--debug"]), split_debug(["analyze", "--", "--debug"])
    ((['analyze', 'a.csv'], True), (['analyze', '--', '--debug'], False))
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return [*(one for one in arguments[:end] if one != DEBUG), *arguments[end:]], DEBUG in arguments[:end]


def explain(error: Exception) -> tuple[str, int]:
    """Return the line for standard error and the exit status of an error that ended a command."""
    match error:
        case TyperException():
            return format_one_line(_usage(error)), WRONG
        case ConfigError() | RecordingError():
            return str(error), WRONG
        case NotReady():
            return str(error), NO_ANSWER
        case ImuError():
            return str(error), FAILED
        case typer.Abort():
            return "interrupted", INTERRUPTED
        case OSError():
            return format_one_line(_system_error(error)), FAILED
        case MemoryError():
            why = f" ({cause})" if (cause := _cause(error)) else ""
            return f"not enough memory{why}; read less at once, e.g. the end of a recording with --last 1h", FAILED
    return (
        f"internal error: {type(error).__name__}: {_cause(error)}; please report it with the output of the same "
        f"command with {DEBUG}",
        FAILED,
    )


def _cause(error: Exception) -> str:
    """Return the text of an error in one line of limited length."""
    text = " ".join(format_one_line(str(error)).split())
    return text if len(text) <= MAX_CAUSE_CHARS else f"{text[:MAX_CAUSE_CHARS]} …"


def _system_error(error: OSError) -> str:
    """Return the text of a system error; a missing working directory gets its own message."""
    if error.filename is None:
        try:
            os.getcwd()
        except OSError:
            return f"the current folder is gone or cannot be read ({error.strerror}); change to another folder"
    return str(error)


def _usage(error: TyperException) -> str:
    """Return a message about wrong arguments, with the missing or the possible arguments."""
    text, context = error.format_message(), getattr(error, "ctx", None)
    if isinstance(error, typer.BadParameter) and error.param is not None and not error.message:
        option: Any = error.param
        what = f" ({option.metavar})" if option.metavar and option.param_type_name == "option" else ""
        where = f" See {context.command_path} --help" if context else ""
        return f"{text.rstrip('.')}{what}: {option.help or ''}{where}"
    if context is None:
        return text
    unknown = getattr(error, "option_name", None)
    if unknown is not None and text.startswith("No such option"):
        known = {name.lstrip("-"): name for option in context.command.params for name in option.opts if name[0] == "-"}
        near = get_close_matches(unknown.lstrip("-"), known, n=1)
        hint = f"did you mean {known[near[0]]}?" if near else f"known are {', '.join(known.values())}"
        return f"No such option: {unknown} of {context.command_path}; {hint}"
    commands: Mapping[str, object] = getattr(context.command, "commands", {})
    if commands and "Did you mean" not in text:
        return f"{text.rstrip('.')}; known are {', '.join(commands)}"
    return text


def _discard_output() -> None:
    """Discard the buffered rest of standard output, whose output at exit would fail again with a traceback."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # standard output is closed, or is not a file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _fail(line: str, status: int) -> NoReturn:
    """Print an error on standard error and exit."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):  # standard error cannot be written, so only the status remains
            print(f"imu-monitor: {line}", file=sys.stderr, flush=True)  # noqa: T201
    sys.exit(status)
