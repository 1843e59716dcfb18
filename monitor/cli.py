"""The command line: arguments in, one call, printing. Nothing is decided here.

Exit status: 0 done; 1 failed while working; 2 what was asked for is wrong, said in one line on standard error; 3
finished, but the data do not support an answer. Heavy libraries are imported by the command that needs them.
"""

import contextlib
import io
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn, TextIO, cast

import typer
from typer.exceptions import TyperException

from drivers.errors import ConfigError, ImuError, NotReady, RecordingError

if TYPE_CHECKING:
    from monitor.estimate.analysis import Analysis
    from monitor.estimate.batch import TauGrid
    from monitor.export import Noise
    from monitor.offline import Tell
    from monitor.settings import Config

FAILED: Final = 1
WRONG: Final = 2
NO_ANSWER: Final = 3

app = typer.Typer(
    help="Live noise monitor for MEMS IMUs: windowed Allan variance and Q, N, B, K, R while the sensor runs.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="Configuration file.")]
Seconds = Annotated[float | None, typer.Option(metavar="S", min=0.1, help="Stop by itself after S seconds.")]
Viewer = Annotated[
    str | None, typer.Option(metavar="auto|native|web|none|FILE.rrd", help="Where to show the live view.")
]


@app.command()
def demo(seconds: Seconds = None, viewer: Viewer = None) -> None:
    """The whole service on a simulated MEMS IMU that speaks a real wire format over a pseudo-terminal."""
    from monitor.settings import CONFIG_FOLDER

    _serve(CONFIG_FOLDER / "demo.toml", seconds, viewer)


@app.command()
def run(config: ConfigPath, seconds: Seconds = None, viewer: Viewer = None) -> None:
    """The daemon: every device in the file, until a signal."""
    _serve(config, seconds, viewer)


@app.command()
def check(
    config: Annotated[Path | None, typer.Argument(metavar="CONFIG.toml", help="Configuration file.")] = None,
    print_defaults: Annotated[
        bool, typer.Option("--print-defaults", help="Print a whole file with every key and its default.")
    ] = False,
) -> None:
    """Read the file and say all that is wrong with it; opens nothing."""
    from monitor import settings
    from monitor.virtual import read_model

    if print_defaults:
        typer.echo((settings.CONFIG_FOLDER / "defaults.toml").read_text("utf-8"), nl=False)
        return
    if config is None:
        raise ConfigError("CONFIG.toml is missing; --print-defaults prints one to start from")
    found, wrong = settings.read(config)
    for device in found.devices if found else ():
        if isinstance(device.link, settings.VirtualTable):
            try:
                read_model(Path(device.link.model))
            except ConfigError as error:
                wrong.append(f"{config}: device {device.name}: {error}")
    for line in wrong:
        typer.echo(line, err=True)
    if wrong:
        raise typer.Exit(WRONG)
    count = len(found.devices) if found else 0
    typer.echo(f"{config}: {count} device{'s' if count != 1 else ''}, nothing wrong")


@app.command()
def watch(
    keyexpr: Annotated[str, typer.Argument(metavar="[KEYEXPR]", help="Which keys to show.")] = "imu/**",
    connect: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Daemon or router, e.g. tcp/127.0.0.1:7450.")
    ] = None,
    seconds: Seconds = None,
) -> None:
    """A live table of any number of daemons, from zenoh alone."""
    import threading

    from rich.console import Console

    from monitor.publish.terminal import watch as show
    from monitor.topics import ENDPOINT

    stop = threading.Event()
    _on_signals(stop.set)
    show(keyexpr, connect or [ENDPOINT], stop, Console(), seconds)


@app.command()
def analyze(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="File, or folder of segments.")],
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Sample rate, where the file says none.")] = None,
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
    from monitor import offline
    from monitor.publish import message

    if rate is not None and not 0.0 < rate < float("inf"):
        raise ConfigError(f"--rate: {rate:g} Hz; it must be above 0")
    if plot is not None and plot.suffix not in (".png", ".html"):
        raise ConfigError(f"--plot: {plot}: a name ending in .png or .html is needed")
    wanted = offline.Request(recording, rate, _tau(tau), _duration("--window", window), rest, bool(json or plot))
    try:
        with _progress() as tell:
            results = offline.make(wanted, tell)
    except offline.TooShort as error:
        if json is not None:
            _write("--json", json, message.no_analysis(str(error), error.samples) + b"\n")
        raise
    if json is not None:
        payload = message.analysis(results.analysis, results.total, results.hadamard, results.dynamic)
        _write("--json", json, payload + b"\n")
    if plot is not None:
        offline.draw(results, plot, recording.name)
    if json != Path("-"):
        _print_analysis(results.analysis)
    if results.lacking:
        raise NotReady(results.lacking)


@app.command()
def export(
    source: Annotated[
        Path,
        typer.Argument(metavar="MODEL.toml|RESULT.json", help="Model, or JSON of analyze; - = standard input."),
    ],
    form: Annotated[str, typer.Option("--format", metavar="kalibr|gyroparams|kalman", help="For which tool.")],
    inflation: Annotated[float, typer.Option(metavar="F", help="Factor on N, B and K, 1 or more.")] = 1.0,
    dt: Annotated[
        float | None, typer.Option(metavar="S", help="kalman: time step; the samples' own unless given.")
    ] = None,
    correlation_time: Annotated[
        float | None, typer.Option(metavar="S", help="kalman: of the process that stands for B.")
    ] = None,
    rostopic: Annotated[str | None, typer.Option(metavar="T", help="kalibr: topic of the IMU; /imu0.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Where to write; else standard output.")] = None,
) -> None:
    """Noise parameters for other tools: Kalibr's imu.yaml, MATLAB's gyroparams, a Kalman filter's F and Q."""
    from monitor import export as exports

    options = {"dt_s": dt, "correlation_time_s": correlation_time, "rostopic": rostopic}
    belong = {"dt_s": "kalman", "correlation_time_s": "kalman", "rostopic": "kalibr"}
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if form in exports.FORMATS and form != belong[name]:
            option = name.removesuffix("_s").replace("_", "-")
            raise ConfigError(f"--{option}: belongs to --format {belong[name]}, not {form}")
    text = exports.export(_noise(source), form, inflation, **given)
    _write("--out", out or Path("-"), text.encode())


def main() -> None:
    """The program: every error is one line and a status."""
    try:
        # without its own error pages, typer hands an Exit's status back
        sys.exit(app(standalone_mode=False))
    except TyperException as error:
        _fail(error.format_message(), WRONG)
    except (ConfigError, RecordingError) as error:
        _fail(str(error), WRONG)
    except NotReady as error:
        _fail(str(error), NO_ANSWER)
    except ImuError as error:
        _fail(str(error), FAILED)
    except typer.Abort:
        _fail("interrupted", 128 + signal.SIGINT)
    except BrokenPipeError:
        sys.stderr.close()  # whoever read our output has gone; nothing to say and nobody to say it to
        sys.exit(FAILED)
    except OSError as error:
        _fail(str(error), FAILED)


def _fail(line: str, status: int) -> NoReturn:
    with contextlib.suppress(OSError):  # nobody to say it to: the status stays
        print(f"imu-monitor: {line}", file=sys.stderr)  # noqa: T201
    sys.exit(status)


def _serve(path: Path, seconds: float | None, viewer: str | None) -> None:
    import dataclasses

    import msgspec

    from monitor import settings

    config = settings.load(path)
    if viewer is not None:
        try:
            mode = settings.viewer_mode(viewer)
        except ConfigError as error:
            raise ConfigError(f"--viewer: {error}") from None
        config = dataclasses.replace(config, viewer=msgspec.structs.replace(config.viewer, mode=mode))
    _log_as(config)
    _serve_config(config, seconds)


def _serve_config(config: "Config", seconds: float | None) -> None:
    """Run the service: a table where there is a terminal, else log lines; the last table once more at the end."""
    import time
    from contextlib import nullcontext

    from rich.console import Console
    from rich.live import Live

    from monitor.outputs import LogOutput, TableOutput
    from monitor.publish.terminal import Board
    from monitor.service import Service

    console, board = Console(), Board()
    live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
    service = Service(config, [TableOutput(board, live)] if live else [TableOutput(board), LogOutput()])
    _on_signals(service.stop)
    with live or nullcontext():
        service.run(seconds)
    if live is not None or seconds is not None:
        console.print(board.table(time.monotonic()))


class _Lines(io.TextIOBase):
    """Standard error as the log's place: a line that cannot be written (disk full, reader gone) is dropped."""

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            sys.stderr.flush()


def _log_as(config: "Config") -> None:
    """Structured lines on standard error."""
    import logging

    import structlog

    json = config.log.format == "json"
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.JSONRenderer() if json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, config.log.level.upper())),
        logger_factory=structlog.PrintLoggerFactory(cast("TextIO", _Lines())),
        cache_logger_on_first_use=True,
    )


def _on_signals(stop: Callable[[], None]) -> None:
    """First SIGINT or SIGTERM: stop in order. A second SIGINT ends at once."""
    import threading

    def first(number: int, _frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # in a thread of its own: the main one may hold the lock of the very event that stop sets
        threading.Thread(target=stop, name="stop", daemon=True).start()

    signal.signal(signal.SIGINT, first)
    signal.signal(signal.SIGTERM, first)


def _tau(text: str) -> "TauGrid":
    if text in ("octave", "decade10"):
        return text  # type: ignore[return-value]
    try:
        listed = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f'--tau: "{text}"; possible are octave, decade10, or seconds with commas') from None
    if not all(0.0 < value < float("inf") for value in listed):
        raise ConfigError(f'--tau: "{text}"; every averaging time must be above 0 s')
    return listed


def _duration(option: str, text: str | None) -> float | None:
    from monitor.settings import seconds

    try:
        return None if text is None else seconds(text)
    except ConfigError as error:
        raise ConfigError(f"{option}: {error}") from None


def _noise(source: Path) -> "Noise":
    """What is known of each axis; JSON begins with a brace, as no model does."""
    from monitor.export import from_analysis, from_model
    from monitor.noise.model import NoiseModel

    try:
        text = sys.stdin.buffer.read() if source == Path("-") else source.read_bytes()
        if text.lstrip().startswith(b"{"):
            return from_analysis(text, source.name)
        return from_model(NoiseModel.from_toml(text.decode()), source.name)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{source}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error


def _write(option: str, path: Path, data: bytes) -> None:
    if path == Path("-"):
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
        return
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{option}: {path}: cannot be written: {error.strerror}") from error


@contextlib.contextmanager
def _progress() -> "Iterator[Tell]":
    """A bar on a terminal, nothing where output is piped."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    if not (console.is_terminal and sys.stdout.isatty()):
        yield lambda _what, _share: None
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda what, share: bar.update(task, description=what, total=share and 1.0, completed=share or 0.0)


def _print_analysis(result: "Analysis") -> None:
    from rich.console import Console

    from monitor.publish.terminal import analysis_table

    console = Console()
    estimate = result.estimate
    console.print(f"{estimate.curve.n} samples at {estimate.rate_hz:g} Hz, {result.seconds:.6g} s")
    console.print(analysis_table(estimate))
    for note in result.notes:
        console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
