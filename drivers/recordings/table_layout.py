"""Layout of a table: the column that contains each quantity, and the unit of the column.

The options of the user and the column names of the file determine the layout. The same rules apply to all tables: CSV,
.npz, Parquet, Arrow and MATLAB files.

A column name consists of a sensor, an axis and a unit, such as ``gyro_x [deg/s]``, ``wx (rad/s)`` or ``acc_x_g``. The
names of these programs are among the recognized names:

- EuRoC and TUM VI (ASL format): ``#timestamp [ns],w_RS_S_x [rad s^-1],a_RS_S_x [m s^-2]`` (the header that public
  readers and writers of these data sets quote)
- phyphox: ``"Time (s)","Gyroscope x (rad/s)"`` (phyphox/phyphox-android, ``DataExport.java``)
- Sensor Logger: ``time,seconds_elapsed,z,y,x`` in ``Gyroscope.csv`` (tszheichoi/awesome-sensor-logger, ``UNITS.md``)
- AndroSensor: ``ACCELEROMETER X (m/s²);…;TIME SINCE START (ms)``
- Betaflight: ``loopIteration, time (us), gyroADC[0], accSmooth[0]`` (betaflight/blackbox-tools, ``blackbox_decode.c``)
- ``rostopic echo -p``: ``%time,field.angular_velocity.x,field.linear_acceleration.x``
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

import numpy as np

from drivers import units
from drivers.data_types import AXES, NS_PER_S, Floats, Times
from drivers.errors import ConfigError, RecordingError
from drivers.recordings.reading_options import NOT_READ, ReadingOptions
from drivers.recordings.table import (
    COLUMNS,
    NO_TIME_NS,
    TIME_NS,
    Table,
    check_column_count,
    describe_suffix_mismatch,
    format_name_list,
    integers_to_ns,
)
from drivers.validation.module_lookup import format_suggestion


@dataclass(frozen=True, slots=True)
class QuantityKind:
    """Quantities that share a unit."""

    quantities: tuple[str, ...]  # names in COLUMNS
    si_unit: str
    option: str  # option of the commands that states the unit
    convert: Callable[[str], tuple[float, float]]  # returns factor and offset of a unit; ConfigError if unknown
    suffixes: Mapping[str, str]  # unit for each ending of a column name, in lower case and without separators

    @property
    def key(self) -> str:
        """Field of ``ReadingOptions`` that states the unit."""
        return self.option.removeprefix("--").replace("-", "_")


KINDS: Final = (
    QuantityKind(
        AXES[:3], "rad/s", "--gyro-unit", lambda unit: (units.angular_rate_factor(unit), 0.0),
        {
            "rads": "rad/s", "radps": "rad/s", "radsec": "rad/s", "mrads": "mrad/s", "degs": "deg/s", "degps": "deg/s",
            "degsec": "deg/s", "dps": "dps", "mdps": "mdps",
        },
    ),
    QuantityKind(
        AXES[3:], "m/s²", "--accel-unit", lambda unit: (units.acceleration_factor(unit), 0.0),
        {"g": "g", "mg": "mg", "ug": "ug", "ms2": "m/s²", "mps2": "m/s²", "mss": "m/s²", "ms²": "m/s²"},
    ),
    QuantityKind(
        ("temperature",), "°C", "--temperature-unit", units.temperature_factor_and_offset,
        {"c": "°C", "degc": "°C", "celsius": "°C", "k": "K", "kelvin": "K", "f": "°F", "degf": "°F"},
    ),
    QuantityKind(
        ("t",), "s", "--time-unit", lambda unit: (units.time_factor(unit), 0.0),
        {
            "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms",
            "us": "us", "usec": "us", "microseconds": "us", "ns": "ns", "nsec": "ns", "nanoseconds": "ns",
        },
    ),
)  # fmt: skip
KIND_OF: Final[Mapping[str, QuantityKind]] = {name: kind for kind in KINDS for name in kind.quantities}

SENSOR_NAMES: Final[Mapping[str, tuple[str, int]]] = {
    **dict.fromkeys(
        (
            "g", "w", "gyr", "gyro", "gyros", "gyroscope", "omega", "angular velocity", "angular rate", "ang vel",
            "angvel", "rotation rate", "w rs s", "gyro adc", "gyroscope uncalibrated",
        ),
        ("g", 1),
    ),
    **dict.fromkeys(
        (
            "a", "acc", "accel", "acceleration", "accelerometer", "specific force", "a rs s", "acc smooth", "acc adc",
            "total acceleration", "accelerometer uncalibrated",
        ),
        ("a", 1),
    ),
    # On phones, these names mean the acceleration without gravity.
    **dict.fromkeys(("linear acceleration", "linear accelerometer", "lin acc", "user acceleration"), ("a", 2)),
}  # fmt: skip
"""Letter and rank of each sensor. The keys are the words before the axis in a column name. A lower rank is
preferred."""
TIME_NAMES: Final[Mapping[str, tuple[int, str | None]]] = {
    "seconds elapsed": (1, "s"), "time since start": (1, None), "time since start in": (1, None),
    "elapsed time": (1, None), "header stamp": (1, None), "timestamp": (2, None), "time stamp": (2, None),
    "time": (2, None), "stamp": (2, None), "unix time": (2, None), "t": (2, None), "millis": (3, "ms"),
    "micros": (3, "us"),
}  # fmt: skip
"""Rank and implied unit of each column name that contains times."""
TEMPERATURE_NAMES: Final = frozenset(
    ("temperature", "temp", "chip temperature", "chip temp", "die temperature", "die temp")
)
LEADING_WORDS: Final = frozenset(("imu", "field", "data", "sensor"))
"""Words that are ignored at the start of a column name."""
ASSUMED_UNITS: Final = {"gyro adc": "deg/s", "acc smooth": "g/2048"}
"""Units of columns that never state their unit."""
BETAFLIGHT_NOTE: Final = (
    "The Betaflight log states no units: gyroADC is read in deg/s and accSmooth in g/2048. For logs with "
    "blackbox_high_resolution, give --gyro-unit deg/s/10. For another acc_1G than 2048 in the header of the log, give "
    "--accel-unit g/acc_1G, such as g/4096."
)
_BRACKETED: Final = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]*[^\W\d_][^\[\]()]*?)\s*[\])]\s*$")
_INDEX: Final = re.compile(r"\[([012])\]")
_WORDS: Final = re.compile(r"[^\W\d_]?[^\W\d_A-Z]+|[A-Z]+(?![a-z])|\d+|²")


@dataclass(frozen=True, slots=True)
class ColumnName:
    """Meaning of a column name."""

    quantity: str  # name in COLUMNS
    rank: int  # at most 0 for the names of this program; a lower rank is preferred
    unit: str | None  # unit that the name states; None if it states none
    assumed: str | None = None  # unit of the column if nothing states it; None for the SI unit


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Columns of a table that contain the quantities of a recording."""

    columns: dict[str, int]  # index of the column of each quantity, in the order of COLUMNS
    units: dict[str, str]  # unit of each quantity that the file states or implies


def find_layout(
    path: Path,
    names: Sequence[str],
    options: ReadingOptions,
    notes: list[str],
    where: str = "",
    sensor: str = "",
) -> TableLayout:
    """Find the column and the unit of each quantity.

    Parameters
    ----------
    path
        Path of the file, used in error messages.
    names
        Names of all columns in the file.
    options
        Columns and units that the user states. They precede the names in the file.
    notes
        List to which notes are appended.
    where
        Position of the column names in the file, used in error messages, such as " in line 3".
    sensor
        Name of the sensor for columns that are only named ``x``, ``y`` and ``z``.

    Raises
    ------
    RecordingError
        If the file contains no axis, several columns fit one quantity, or the file has too many columns.
    ConfigError
        If a column in the options does not exist.
    """
    check_column_count(path, len(names))
    chosen = {
        quantity: _find_given_column(path, names, quantity, column)
        for quantity, column in options.columns.items()
        if column != NOT_READ
    }
    _check_used_once(path, names, chosen)
    meanings = {i: meaning for i, name in enumerate(names) if (meaning := parse_column_name(name, sensor)) is not None}
    for quantity in COLUMNS:
        if quantity not in options.columns:
            free = {i: one for i, one in meanings.items() if one.quantity == quantity and i not in chosen.values()}
            if free:
                chosen[quantity] = _select_candidate(path, names, quantity, free)
    if not any(axis in chosen for axis in AXES):
        raise RecordingError(
            f"{path}: no axis among its columns ({format_name_list(names)}){where}; a recording has some of "
            f"{' '.join(AXES)}; name its columns, such as --columns gx={_example_name(names)}"
            f"{describe_suffix_mismatch(path)}"
        )
    others = [name for i, name in enumerate(names) if i not in chosen.values() and name not in ("", "fs")]
    if others:
        notes.append(f"Other columns are not used: {format_name_list(others)}.")
    return TableLayout(
        {quantity: chosen[quantity] for quantity in COLUMNS if quantity in chosen},
        _stated_units(names, chosen, meanings, options, notes),
    )


def convert_to_si(path: Path, table: Table, options: ReadingOptions) -> Table:
    """Return a table with columns in SI units and °C. Integer times in ns, µs or ms become the column ``t_ns``.

    A unit in the options takes precedence over the unit that the file states.

    Raises
    ------
    ConfigError
        If the file states an unknown unit.
    """
    columns, notes = {}, list(table.notes)
    for quantity, column in table.columns.items():
        if quantity == TIME_NS:
            columns[TIME_NS] = column
            continue
        kind = KIND_OF[quantity]
        try:
            factor, offset = kind.convert(find_unit(table, options, quantity))
        except ConfigError as error:
            raise ConfigError(f"{path}: column of {quantity}: {error}; state the unit with {kind.option}") from None
        name, numbers = _convert(quantity, column, factor, offset)
        columns[name] = numbers
    for kind in KINDS:
        given = getattr(options, kind.key)
        contradicted = sorted({table.units[one] for one in kind.quantities if one in table.units} - {given})
        if given is not None and contradicted:
            notes.append(f"The file states {', '.join(contradicted)}; the requested {given} is used.")
    return Table(columns, table.fs, notes, table.units)


def find_unit(table: Table, options: ReadingOptions, quantity: str) -> str:
    """Return the unit of a quantity from the options, otherwise from the file, or the SI unit if neither states one."""
    kind = KIND_OF[quantity]
    unit: str = getattr(options, kind.key) or table.units.get(quantity) or kind.si_unit
    return unit


def is_known_column(name: str, options: ReadingOptions) -> bool:
    """Return True if a column may be part of a recording."""
    return name in options.columns.values() or parse_column_name(name) is not None


def names_an_axis(names: Sequence[str]) -> bool:
    """Return True if one of the column names is the name of an axis."""
    return any((meaning := parse_column_name(name)) is not None and meaning.quantity in AXES for name in names)


def parse_column_name(name: str, sensor: str = "") -> ColumnName | None:
    """Return the meaning of a column name, or None if the name is not recognized.

    >>> parse_column_name("gyro_x [deg/s]")
    ColumnName(quantity='gx', rank=1, unit='deg/s', assumed=None)
    >>> parse_column_name("z", sensor="TotalAcceleration").quantity
    'az'
    """
    if name in COLUMNS:
        return ColumnName(name, 0, None)
    if name == TIME_NS:
        return ColumnName("t", -1, "ns")
    stem, unit = _split_unit(name)
    words = [] if stem.strip() == "T" else _split_words(stem)  # T is a time or a temperature
    for at in range(len(words), 0, -1):
        found = _match_words(words[:at], sensor)
        if found is None:
            continue
        ending = "".join(words[at:])
        if not ending:
            return ColumnName(found.quantity, found.rank, unit or found.unit, found.assumed)
        if unit is None and ending in (suffixes := KIND_OF[found.quantity].suffixes):
            return ColumnName(found.quantity, found.rank, suffixes[ending])
    return None


def _match_words(words: Sequence[str], sensor: str) -> ColumnName | None:
    """Return the meaning of the words of a column name without its unit."""
    text = " ".join(words)
    if text in TIME_NAMES:
        rank, unit = TIME_NAMES[text]
        return ColumnName("t", rank, unit)
    if text in TEMPERATURE_NAMES:
        return ColumnName("temperature", 1, None)
    axis = words[-1][-1]
    before = " ".join(one for one in (*words[:-1], words[-1][:-1]) if one)
    if axis not in "xyz":
        return None
    before = before or " ".join(_split_words(sensor))
    if before not in SENSOR_NAMES:
        return None
    letter, rank = SENSOR_NAMES[before]
    return ColumnName(letter + axis, rank, None, ASSUMED_UNITS.get(before))


def _split_unit(name: str) -> tuple[str, str | None]:
    """Split ``gyro x [deg/s]`` into name and unit. The unit is None if the name has no brackets with a unit."""
    found = _BRACKETED.match(name)
    return (found[1], found[2]) if found else (name, None)


def _split_words(text: str) -> list[str]:
    """Return the words of a column name in lower case, without words such as ``imu`` at the start.

    >>> _split_words("gyroADC[0]"), _split_words("imu.AngularVelocity.x")
    (['gyro', 'adc', 'x'], ['angular', 'velocity', 'x'])
    """
    indexed = _INDEX.sub(lambda index: " " + "xyz"[int(index[1])], text)
    words = [word.lower() for word in _WORDS.findall(indexed)]
    while len(words) > 1 and (words[0] in LEADING_WORDS or words[0].isdigit()):
        del words[0]
    return words


def _find_given_column(path: Path, names: Sequence[str], quantity: str, column: str) -> int:
    """Return the index of a column that the user names, by its number, its name, or its name without the unit."""
    option = f"--columns {quantity}={column}"
    if column.isdecimal():
        if not 1 <= int(column) <= len(names):
            raise ConfigError(f"{path}: {option}: there is no column {column}; the file has {len(names)} columns")
        return int(column) - 1
    for spelled in (list(names), [_split_unit(name)[0] for name in names]):
        if spelled.count(column) > 1:
            raise ConfigError(f"{path}: {option}: {spelled.count(column)} columns have this name; give a number")
        if column in spelled:
            return spelled.index(column)
    shown = [one[:40] for one in names[:12]]
    raise ConfigError(f'{path}: {option}: there is no column "{column}"{format_suggestion(column, shown)}')


def _check_used_once(path: Path, names: Sequence[str], chosen: Mapping[str, int]) -> None:
    repeated = [i for i, count in Counter(chosen.values()).items() if count > 1]
    if repeated:
        quantities = [quantity for quantity, i in chosen.items() if i == repeated[0]]
        raise ConfigError(
            f"{path}: --columns: column {repeated[0] + 1} ({names[repeated[0]][:40]}) is given for "
            f"{' and '.join(quantities)}; give one column for each"
        )


def _select_candidate(path: Path, names: Sequence[str], quantity: str, candidates: Mapping[int, ColumnName]) -> int:
    """Return the column with the lowest rank. Raise RecordingError if several columns have this rank."""
    lowest = min(one.rank for one in candidates.values())
    best = [i for i, one in candidates.items() if one.rank == lowest]
    if len({names[i] for i in best}) < len(best):
        raise RecordingError(f"{path}: column {names[best[0]]} occurs twice; each may occur once")
    if len(best) > 1:
        listed = format_name_list([names[i] for i in best])
        raise RecordingError(
            f"{path}: {len(best)} columns fit {quantity}: {listed}; choose one, such as "
            f"--columns {quantity}={names[best[0]]} (in a configuration file: columns)"
        )
    return best[0]


def _example_name(names: Sequence[str]) -> str:
    first = next((name for name in names if name not in ("", "fs") and parse_column_name(name) is None), "2")
    return first[:40] if first.isprintable() else "2"


def _stated_units(
    names: Sequence[str],
    chosen: Mapping[str, int],
    meanings: Mapping[int, ColumnName],
    options: ReadingOptions,
    notes: list[str],
) -> dict[str, str]:
    """Return the unit of each quantity, as stated or implied by the column names."""
    found = {}
    assumes = False
    for quantity, i in chosen.items():
        kind, meaning = KIND_OF[quantity], meanings.get(i)
        if meaning is None or KIND_OF[meaning.quantity] is not kind:
            meaning = ColumnName(quantity, 0, _unit_of_other_name(names[i], kind))
        unit = meaning.unit
        if unit is None and getattr(options, kind.key) is None:
            unit = meaning.assumed
            assumes = assumes or unit is not None
        if unit is not None:
            found[quantity] = _correct_case(unit, kind)
    if assumes:
        notes.append(BETAFLIGHT_NOTE)
    return found


def _unit_of_other_name(name: str, kind: QuantityKind) -> str | None:
    """Return the unit in a column name whose other words are not recognized."""
    stem, unit = _split_unit(name)
    words = _split_words(stem)
    endings = ("".join(words[at:]) for at in range(1, len(words)))
    return unit or next((kind.suffixes[ending] for ending in endings if ending in kind.suffixes), None)


def _correct_case(unit: str, kind: QuantityKind) -> str:
    """Return a unit in lower case if only this spelling is known, as in ``RAD/S``."""
    for spelled in (unit, unit.lower()):
        try:
            kind.convert(spelled)
        except ConfigError:
            continue
        return spelled
    return unit


def _convert(quantity: str, column: Times, factor: float, offset: float) -> tuple[str, Times]:
    """Return the name of the converted column, and its numbers."""
    if column.dtype.kind in "iu":
        if factor < 1.0:
            t_ns = integers_to_ns(column, round(factor * NS_PER_S))
            if 2 * np.count_nonzero(t_ns == NO_TIME_NS) <= t_ns.size:
                return TIME_NS, t_ns
        column = np.where(column == NO_TIME_NS, np.nan, column.astype(np.float64))
    with np.errstate(invalid="ignore", over="ignore"):  # a huge number becomes infinite
        return quantity, _scale(cast(Floats, column), factor, offset)


def _scale(column: Floats, factor: float, offset: float) -> Floats:
    if (factor, offset) == (1.0, 0.0):
        return column
    divisor = round(1.0 / factor) if factor < 1.0 else 0
    if divisor and 1.0 / divisor == factor:  # 1e-9 is not a binary number: the quotient is exact to the last digit
        return column / divisor + offset
    return np.asarray(column * factor + offset)
