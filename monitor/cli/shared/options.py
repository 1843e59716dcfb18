"""Command-line options that several commands share, and functions that parse option values."""

import functools
import inspect
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, overload

import typer

from drivers import units
from drivers.errors import ConfigError, make_printable_and_shorten
from drivers.validation.number_ranges import (
    DURATION_S,
    INFLATION,
    RATE_HZ,
    RUN_TIME_S,
    SEED,
    Number,
    NumberRange,
)
from monitor.cli.shared.errors import name_option_in_config_errors
from monitor.cli.shared.output import check_output_file

if TYPE_CHECKING:
    from monitor.commands.recording_loading import DecoderChoice, LoadingOptions
    from monitor.common.unit_formatting import UnitSystem
    from monitor.drift.compensation.arma import Order
    from monitor.estimation.allan.batch import TauGrid
    from monitor.publishing.exporters import NoiseCoefficients


def make_range_callback(allowed_range: NumberRange) -> Callable[[typer.CallbackParam, Number | None], Number | None]:
    """Return a typer callback that checks whether an option value is within the allowed range.

    Raises
    ------
    ConfigError
        If the option value is outside the allowed range.
    """

    def check_option_value(option: typer.CallbackParam, value: Number | None) -> Number | None:
        if value is not None:
            with name_option_in_config_errors(option.opts[0]):
                allowed_range.check(value)
        return value

    return check_option_value


def _check_json_file(path: Path | None) -> Path | None:
    check_output_file("--json", path)
    return path


def _text_option(metavar: str, help_text: str) -> Any:
    return Annotated[str | None, typer.Option(metavar=metavar, help=help_text)]


JsonFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Write the result as JSON; - = standard output.", callback=_check_json_file),
]
Viewer = Annotated[str | None, typer.Option(metavar="auto|native|web|none|FILE.rrd", help="Where to show the viewer.")]
KeyExpr = Annotated[
    str, typer.Argument(metavar="KEYEXPR", help="Key expression of the devices to show, e.g. imu/NAME for one device.")
]
Connect = Annotated[
    list[str] | None,
    typer.Option(metavar="ENDPOINT", help="Daemon or router to connect to, e.g. tcp/127.0.0.1:7450; repeatable."),
]
ZenohFile = Annotated[
    Path | None,
    typer.Option(
        "--zenoh",
        metavar="FILE.json5",
        help="zenoh configuration file, e.g. with certificates, user and password, endpoints.",
    ),
]
Prefix = Annotated[str, typer.Option(metavar="KEY", help="Prefix of the zenoh keys of the daemon.")]
DeviceName = Annotated[
    str | None, typer.Option(metavar="NAME", help="Name of the device; required if there are several devices.")
]
ModelRate = Annotated[
    float | None,
    typer.Option(
        metavar="HZ", help="Sample rate; by default the rate of the model.", callback=make_range_callback(RATE_HZ)
    ),
]
Seconds = Annotated[
    float | None, typer.Option(metavar="S", help="Stop after S seconds.", callback=make_range_callback(RUN_TIME_S))
]
SimulationSeed = Annotated[
    int,
    typer.Option(
        metavar="N",
        help="Seed of the random numbers; the same seed gives the same recording.",
        callback=make_range_callback(SEED),
    ),
]
ReportSeed = Annotated[
    int,
    typer.Option(
        metavar="N",
        help="Seed of the random numbers; the same seed gives the same report.",
        callback=make_range_callback(SEED),
    ),
]
Inflation = Annotated[
    float,
    typer.Option(
        metavar="F",
        help="Factor by which N, B and K are multiplied, 1 or more.",
        callback=make_range_callback(INFLATION),
    ),
]
TimeStep = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        help="Time step of the program that reads the parameters; by default its usual time step or the sample period.",
        callback=make_range_callback(DURATION_S),
    ),
]
CorrelationTime = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        help="Correlation time of the process that represents B, for the formats kalman and gnss_ins_sim.",
        callback=make_range_callback(DURATION_S),
    ),
]

_UNITS = typer.Option(
    metavar="imu|datasheet|si",
    help="Units of tables and plots: N in °/√h; with datasheet also in m°/s/√Hz; with si in rad/s/√Hz.",
)
Units = Annotated[str, _UNITS]
ConfiguredUnits = Annotated[str | None, _UNITS]

LENGTH_OPTIONS = {
    "rate": Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Sample rate for a recording that has neither times nor a rate.",
            callback=make_range_callback(RATE_HZ),
        ),
    ],
    "last": _text_option("S", "Use only the last part of the recording: S seconds, or e.g. 1h or 1d."),
}
"""Options for the rate and the length of a recording."""
READING_OPTIONS = {
    "topic": _text_option(
        "NAME",
        "Topic of a ROS bag or an autopilot log, or one of several sensors of a table; by default the only one with "
        "IMU data. A+B joins two topics.",
    ),
    "columns": _text_option(
        "Q=COLUMN,…", "Columns of a table by name or number, e.g. gx=omega_x,t=1; by default recognized by name."
    ),
    "gyro_unit": _text_option(
        "UNIT", f"Unit of gx, gy, gz in the file: {', '.join(units.RATE)}, or divided by a sensitivity: deg/s/131."
    ),
    "accel_unit": _text_option(
        "UNIT",
        f"Unit of ax, ay, az in the file: {', '.join(units.ACCELERATION)}, or divided by a sensitivity: g/16384.",
    ),
    "temperature_unit": _text_option("UNIT", f"Unit of the temperature in the file: {', '.join(units.TEMPERATURE)}."),
    "time_unit": _text_option("UNIT", f"Unit of the times in the file: {', '.join(units.TIME)}."),
    "assume": Annotated[
        bool | None,
        typer.Option("--assume", help="Accept a doubtful table with its likeliest units and as one sensor."),
    ],
}
"""Options that determine how a recording is read, by the field of ``ReadingOptions``."""
DECODER_OPTIONS = {
    "decoder": _text_option("NAME", "Decoder of a CAN log or of captured bytes: dbc, vectornav_binary, …."),
    "option": Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE", help="Key of the decoder, e.g. file=imu.dbc, signals.gz=Rates.Z; repeatable."
        ),
    ],
}
"""Options for a recording that contains the wire format of a sensor."""
Loading = Any
"""Annotation that marks the argument that ``with_loading_options`` replaces with the options for loading a
recording."""
Command = TypeVar("Command", bound=Callable[..., None])


def with_loading_options(command: Command, *, rate_and_last: bool = True) -> Command:
    """Replace the ``loading`` argument of a command with the options that determine how a recording is read.

    Parameters
    ----------
    command : callable
        Command that receives ``LoadingOptions`` as its argument ``loading``.
    rate_and_last : bool
        True to include the options ``--rate`` and ``--last``.
    """
    added = {**(LENGTH_OPTIONS if rate_and_last else {}), **READING_OPTIONS, **DECODER_OPTIONS}

    @functools.wraps(command)
    def parse_options_and_run(**arguments: Any) -> None:
        given = {name: arguments.pop(name) for name in added}
        command(**arguments, loading=_parse_loading_options(given))

    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name == "loading":
            parameters += (
                inspect.Parameter(name, parameter.kind, default=None, annotation=annotation)
                for name, annotation in added.items()
            )
        else:
            parameters.append(parameter)
    parse_options_and_run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    parse_options_and_run.__annotations__ = {one.name: one.annotation for one in parameters}
    return cast("Command", parse_options_and_run)


def _parse_loading_options(given: dict[str, Any]) -> "LoadingOptions":
    from drivers.recordings.reading_options import create_reading_options, parse_column_mapping
    from monitor.commands.recording_loading import LoadingOptions

    reading = {name: given[name] for name in READING_OPTIONS}
    if reading["columns"] is not None:
        with name_option_in_config_errors("--columns"):
            reading["columns"] = parse_column_mapping(reading["columns"])
    return LoadingOptions(
        given.get("rate"),
        parse_duration("--last", given.get("last")),
        create_reading_options(reading),
        parse_decoder(given["decoder"], given["option"]),
    )


def parse_decoder(name: str | None, options: list[str] | None) -> "DecoderChoice | None":
    """Parse the options ``--decoder`` and ``--option``.

    A value is read as in TOML. Text needs no quotes.

    >>> parse_decoder("dbc", ["file=imu.dbc", "signals.gz=Rates.Z", "tick=1e-4"]).options
    {'file': 'imu.dbc', 'signals': {'gz': 'Rates.Z'}, 'tick': 0.0001}

    Parameters
    ----------
    name : str or None
        Name of the decoder.
    options : list of str or None
        Keys and values, separated by ``=``. Dots separate a table from its keys.

    Raises
    ------
    ConfigError
        If there are options without a decoder, or if an option is not a key with a value.
    """
    from monitor.commands.recording_loading import DecoderChoice

    if name is None:
        if options:
            raise ConfigError(f"--option: {make_printable_and_shorten(options[0])}: name the decoder with --decoder")
        return None
    tables: dict[str, Any] = {}
    for text in options or ():
        path, separator, value = text.partition("=")
        *parents, key = path.strip().split(".")
        table: Any = tables
        for parent in parents:
            table = table.setdefault(parent, {}) if isinstance(table, dict) else None
        if not separator or not key or not isinstance(table, dict) or key in table:
            shown = make_printable_and_shorten(text)
            raise ConfigError(f'--option: "{shown}": expected KEY=VALUE once per key, such as file=imu.dbc')
        table[key] = _parse_toml_value(value.strip()) if path != "channel" else value.strip()
    return DecoderChoice(name, tables)


def parse_units(name: str) -> "UnitSystem":
    """Return the unit system of the option ``--units``.

    Raises
    ------
    ConfigError
        If the name is unknown.
    """
    from monitor.common.unit_formatting import UNIT_SYSTEMS

    if name not in UNIT_SYSTEMS:
        raise ConfigError(f'--units: "{make_printable_and_shorten(name)}"; possible are {", ".join(UNIT_SYSTEMS)}')
    return UNIT_SYSTEMS[name]


def _parse_toml_value(text: str) -> Any:
    """Return a value of TOML, or the text itself if it is not a value of TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def parse_averaging_times(text: str) -> "TauGrid":
    """Parse the option ``--tau``, which is the name of a grid or a list of averaging times in seconds.

    Raises
    ------
    ConfigError
        If the text is neither the name of a grid nor a list of seconds, or if a time is outside the supported range.
    """
    from monitor.commands.analyze import check_averaging_times

    if text in ("octave", "decade10"):
        return text  # type: ignore[return-value]
    try:
        listed = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(
            f'--tau: "{make_printable_and_shorten(text)[:60]}"; possible are octave, decade10, or seconds with commas'
        ) from None
    with name_option_in_config_errors("--tau"):
        check_averaging_times(listed)
    return listed


@overload
def parse_duration(option: str, text: str) -> float: ...
@overload
def parse_duration(option: str, text: None) -> None: ...
@overload
def parse_duration(option: str, text: str | None) -> float | None: ...
def parse_duration(option: str, text: str | None) -> float | None:
    """Convert a duration such as "90", "30min" or "1h" to seconds.

    Parameters
    ----------
    option : str
        Name of the option, used in error messages.
    text : str or None
        Duration as text. If the text is None, the result is None.

    Raises
    ------
    ConfigError
        If the text is not a duration.
    """
    from monitor.settings.loading import parse_duration_s

    duration_s = None
    if text is not None:
        with name_option_in_config_errors(option):
            duration_s = parse_duration_s(text)
    return duration_s


def parse_arma_order(text: str | None) -> "Order | None":
    """Parse the orders p and q of an ARMA(p, q) model, for example "2,1".

    Raises
    ------
    ConfigError
        If the text is not a pair of supported orders.
    """
    from monitor.drift.compensation.arma import ORDERS

    if text is None:
        return None
    for one in ORDERS:
        if text.replace(" ", "") == f"{one[0]},{one[1]}":
            return one
    raise ConfigError(f'--order: "{text}"; possible are {" ".join(f"{p},{q}" for p, q in ORDERS)}')


def read_noise_coefficients(source: str) -> "NoiseCoefficients":
    """Read noise coefficients from a model file or from the JSON output of ``analyze``.

    Parameters
    ----------
    source : str
        Path of the file, name of a shipped model, or ``-`` for standard input.

    Raises
    ------
    ConfigError
        If the file cannot be read, or if its content is invalid.
    """
    from drivers.host import safe_file_reading
    from monitor.common.shipped_config_paths import resolve_model_path
    from monitor.noise.model import NoiseModel
    from monitor.publishing.exporters import from_analysis_json, from_model

    path = Path(source) if source == "-" else resolve_model_path(source, Path.cwd())
    try:
        text = sys.stdin.buffer.read() if source == "-" else safe_file_reading.read_small_file(path, allow_pipe=True)
        if text.lstrip().startswith(b"{"):
            return from_analysis_json(text, path.name)
        return from_model(NoiseModel.from_toml(text.decode()), path.name)
    except OSError as error:
        raise ConfigError(f"{source}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{source}: cannot be read: byte {error.start} is not text; expected a model, or the JSON that "
            "imu-monitor analyze RECORDING --json FILE writes"
        ) from error
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error


def select_device(name: str | None, there: list[str], where: str, what: str) -> str:
    """Return the name of the requested device, or of the only device if no name is given.

    Parameters
    ----------
    name : str or None
        Name of the requested device.
    there : list of str
        Names of all devices.
    where : str
        Place of the results, for error messages.
    what : str
        Kind of the results, such as ``history``, for error messages.

    Raises
    ------
    NotReady
        If there is no device yet.
    ConfigError
        If no device has this name, or if there are several devices and no name is given.
    """
    from drivers.errors import NotReady
    from drivers.validation.module_lookup import format_suggestion

    if not there:
        raise NotReady(f"{where}: there is no {what} yet")
    if name is None and len(there) == 1:
        return there[0]
    if name is None:
        raise ConfigError(f"{where}: {what} of {len(there)} devices; choose one with --device: {', '.join(there)}")
    if name not in there:
        raise ConfigError(f'--device: "{name}"{format_suggestion(name, there)}')
    return name
