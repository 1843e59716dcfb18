"""Layout of a table: the column that contains each quantity, and the unit of the column.

The options of the user, the column names (``column_names``) and the numbers (``unit_inference``) determine the layout,
in this order. The same rules apply to all tables: CSV, .npz, Parquet, Arrow and MATLAB files.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, cast

import numpy as np

from drivers.data_types import AXES, NS_PER_S, Floats, Times
from drivers.errors import ConfigError, RecordingError
from drivers.recordings.column_guess import ReadColumn, create_unknown_columns_error
from drivers.recordings.column_names import (
    KIND_OF,
    KINDS,
    UNSCALED,
    ColumnName,
    counts_week_seconds,
    find_ending_unit,
    names_sensor,
    parse_column_name,
    split_unit,
)
from drivers.recordings.reading_options import NOT_READ, ReadingOptions
from drivers.recordings.table import (
    COLUMNS,
    NO_TIME_NS,
    SENSOR,
    TIME_NS,
    Table,
    check_column_count,
    describe_suffix_mismatch,
    format_name_list,
    integers_to_ns,
    unwrap_times,
)
from drivers.recordings.topic_selection import HOW_TO_CHOOSE
from drivers.recordings.unit_inference import infer_units
from drivers.validation.module_lookup import format_suggestion

BETAFLIGHT_NOTE: Final = (
    "The Betaflight log states no units: gyroADC is read in deg/s and accSmooth in g/2048. For logs with "
    "blackbox_high_resolution, give --gyro-unit deg/s/10. For another acc_1G than 2048 in the header of the log, give "
    "--accel-unit g/acc_1G, such as g/4096."
)

MAX_LISTED_NAMES: Final = 60
"""Number of column names in the message about a table without axes. The needed names may be the last ones."""
MAX_SENSORS: Final = 32
"""Number of different values up to which a column can tell the rows of several sensors apart."""

WEEK_S: Final = 604_800
MIN_INTERLEAVED_ROWS: Final = 240
MIN_SEPARATION: Final = 5.0
"""Ratio of the difference of two means to the standard deviation from which alternating rows belong to two sensors."""


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Columns of a table that contain the quantities of a recording."""

    columns: dict[str, int]  # index of the column of each quantity, in the order of COLUMNS
    units: dict[str, str]  # unit of each quantity that the file states or implies
    names: dict[str, str]  # column name of each quantity


def find_layout(
    path: Path,
    names: Sequence[str],
    options: ReadingOptions,
    notes: list[str],
    where: str = "",
    sensor: str = "",
    read_column: ReadColumn | None = None,
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
    read_column
        Returns the first values of a column, which an error message shows.

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
    sensor_column = next((i for i, name in enumerate(names) if names_sensor(name) and i not in chosen.values()), None)
    meanings = _select_named_sensor(path, meanings, options, sensor_column is not None)
    for quantity in COLUMNS:
        if quantity not in options.columns:
            free = {i: one for i, one in meanings.items() if one.quantity == quantity and i not in chosen.values()}
            if free:
                chosen[quantity] = _select_candidate(path, names, quantity, free)
    if not any(axis in chosen for axis in AXES):
        cut = next((note.rstrip(".") for note in notes if "cut off" in note), "")
        if cut:
            raise RecordingError(f"{path}: {cut}; no axis is left among its columns ({format_name_list(names)})")
        what = (
            f"{path}: no axis among its columns ({format_name_list(names, MAX_LISTED_NAMES)}){where}; a recording "
            f"has some of {' '.join(AXES)}; name its columns"
        )
        mismatch = describe_suffix_mismatch(path)
        if read_column is not None and not mismatch:
            raise create_unknown_columns_error(path, names, what, read_column, chosen, _example_name(names))
        raise RecordingError(f"{what}, such as --columns gx={_example_name(names)}{mismatch}")
    if sensor_column is not None:
        chosen[SENSOR] = sensor_column
    others = [name for i, name in enumerate(names) if i not in chosen.values() and name not in ("", "fs")]
    if others:
        notes.append(f"Other columns are not used: {format_name_list(others)}.")
    return TableLayout(
        {quantity: chosen[quantity] for quantity in (*COLUMNS, SENSOR) if quantity in chosen},
        _stated_units(names, chosen, meanings, options, notes),
        {quantity: quantity if sensor and names[i] in ("x", "y", "z") else names[i] for quantity, i in chosen.items()},
    )


def convert_to_si(path: Path, table: Table, options: ReadingOptions) -> Table:
    """Return a table with columns in SI units and °C. Integer times in ns, µs or ms become the column ``t_ns``.

    A unit in the options takes precedence over the unit that the file states. If neither states the unit, it is
    inferred from the numbers.

    Raises
    ------
    ConfigError
        If the file states an unknown unit, or if the numbers fit several units.
    """
    notes = list(table.notes)
    stated = table.units
    table = _select_rows_of_sensor(path, table, options)
    if table.names and not options.assume:
        _check_interleaving(path, table.columns)
    table = _infer_units(path, table, options, notes)
    columns = {}
    for quantity, column in table.columns.items():
        if quantity == TIME_NS:
            columns[TIME_NS] = column
            continue
        factor, offset = _find_conversion(path, quantity, find_unit(table, options, quantity))
        name, numbers = _convert(quantity, column, factor, offset)
        if quantity == "t" and counts_week_seconds(table.names.get("t", "")):
            numbers = unwrap_times(numbers, WEEK_S * (int(NS_PER_S) if name == TIME_NS else 1))
        columns[name] = numbers
    for kind in KINDS:
        given = getattr(options, kind.key)
        contradicted = sorted({stated[one] for one in kind.quantities if one in stated} - {given})
        if given is not None and contradicted:
            notes.append(f"The file states {', '.join(contradicted)}; the requested {given} is used.")
    return Table(columns, table.fs, notes, table.units)


def _select_named_sensor(
    path: Path, meanings: Mapping[int, ColumnName], options: ReadingOptions, has_sensor_column: bool
) -> dict[int, ColumnName]:
    """Return the columns of one of several sensors whose names are part of the column names, such as ``imu2_gyro_x``.

    Raises
    ------
    ConfigError
        If the user must choose a sensor, or if the chosen sensor does not exist.
    """
    axes = {
        i: one
        for i, one in _without_common_name(meanings).items()
        if one.quantity in AXES and one.quantity not in options.columns
    }
    sensors = sorted({one.sensor for one in axes.values()} - {""})
    topic = options.topic
    chosen = next((one for one in sensors if topic is not None and one.lower() == topic.lower()), None)
    if chosen is not None:
        measured = {one.quantity for one in axes.values() if one.sensor == chosen}
        others = {i for i, one in axes.items() if one.sensor != chosen and (one.sensor or one.quantity in measured)}
        return {i: one for i, one in meanings.items() if i not in others}
    if topic is not None and not has_sensor_column:
        if sensors:
            raise ConfigError(f'{path}: has no sensor "{topic}"; it has {", ".join(sensors)}')
        raise ConfigError(f"{path}: contains a single table and no topics; leave out the topic {topic}")
    unnamed = {one.quantity for one in axes.values() if not one.sensor}
    counts = Counter(one.quantity for one in axes.values() if one.sensor and one.quantity not in unnamed)
    if len(sensors) > 1 and counts and max(counts.values()) > 1:
        of_sensor = {sensor: [one.quantity for one in axes.values() if one.sensor == sensor] for sensor in sensors}
        listed = "; ".join(f"{sensor} ({' '.join(quantities)})" for sensor, quantities in of_sensor.items())
        raise ConfigError(
            f"{path}: contains the columns of {len(sensors)} sensors: {listed}; {HOW_TO_CHOOSE}, such as {sensors[0]}"
        )
    return dict(meanings)


def _without_common_name(meanings: Mapping[int, ColumnName]) -> dict[int, ColumnName]:
    """Return the columns without the name of the device, which begins the names of all sensors."""
    quantities: dict[str, set[str]] = {}
    for one in meanings.values():
        if one.quantity in AXES:
            quantities.setdefault(one.sensor, set()).add(one.quantity)
    common = min(quantities, key=len, default="")
    own = quantities.pop(common, set())
    if not all(sensor.startswith(common) for sensor in quantities) or own & set().union(*quantities.values()):
        return dict(meanings)
    return {i: replace(one, sensor=one.sensor.removeprefix(common)) for i, one in meanings.items()}


def _select_rows_of_sensor(path: Path, table: Table, options: ReadingOptions) -> Table:
    """Return the rows of one sensor of a table with a column that tells the rows of several sensors apart.

    Raises
    ------
    ConfigError
        If the user must choose a sensor, or if the chosen sensor does not exist.
    """
    columns = dict(table.columns)
    codes = columns.pop(SENSOR, None)
    if codes is None:
        return table
    found, counts = np.unique(codes[np.isfinite(codes)], return_counts=True)
    rest = Table(columns, table.fs, table.notes, table.units, {q: n for q, n in table.names.items() if q != SENSOR})
    if not 1 < found.size <= MAX_SENSORS:  # a single sensor, or a counter
        return rest
    column = table.names[SENSOR]
    values = [table.sensors[int(code)] if table.sensors else f"{code:g}" for code in found]
    topics = [f"{column}={value}" for value in values]
    if options.topic is None:
        listed = ", ".join(f"{topic} ({count} rows)" for topic, count in zip(topics, counts.tolist(), strict=True))
        raise ConfigError(
            f"{path}: contains the rows of {found.size} sensors: {listed}; {HOW_TO_CHOOSE}, such as {topics[0]}"
        )
    match = [code for code, *known in zip(found, topics, values, strict=True) if options.topic in known]
    if not match:
        raise ConfigError(f'{path}: has no rows of "{options.topic}"; it has {", ".join(topics)}')
    rows = codes == match[0]
    return replace(rest, columns={quantity: values[rows] for quantity, values in columns.items()})


def _check_interleaving(path: Path, columns: Mapping[str, Times]) -> None:
    """Raise RecordingError if the rows of several sensors alternate without a column that tells them apart.

    The values of every k-th row then agree with each other, and differ from those of the other rows. A line at the k-th
    part of the sample rate has the same pattern. Several sensors have the pattern on several axes, or in the times.
    """
    measured = [columns[one] for one in AXES if one in columns and columns[one].size >= 2 * MIN_INTERLEAVED_ROWS]
    for sensors in (2, 3, 4):
        differing = sum(_alternates(column, sensors) for column in measured)
        in_times = "t" in columns and _alternates(np.diff(columns["t"]), sensors)
        if differing and (in_times or differing > max(1, len(measured) // 2)):
            raise RecordingError(
                f"{path}: every {['second', 'third', 'fourth'][sensors - 2]} row agrees, and the others differ: the "
                f"rows of {sensors} sensors alternate; add a column that names the sensor, such as imu, or write one "
                "file for each sensor. If the table contains one sensor, use --assume"
            )


def _alternates(column: Times, sensors: int) -> bool:
    """Return True if the values differ between every k-th row at the start, in the middle and at the end."""
    if column.size < MIN_INTERLEAVED_ROWS:
        return False
    starts = (0, (column.size - MIN_INTERLEAVED_ROWS) // 2, column.size - MIN_INTERLEAVED_ROWS)
    parts = [column[at : at + MIN_INTERLEAVED_ROWS].reshape(-1, sensors) for at in starts]
    with np.errstate(over="ignore", invalid="ignore"):  # corrupt rows
        return all(np.ptp(part.mean(axis=0)) > MIN_SEPARATION * part.std(axis=0).mean() for part in parts)


def _find_conversion(path: Path, quantity: str, unit: str) -> tuple[float, float]:
    """Return factor and offset of a unit. Raise ConfigError if the unit is unknown."""
    kind = KIND_OF[quantity]
    try:
        return kind.convert(unit)
    except ConfigError as error:
        raise ConfigError(f"{path}: column of {quantity}: {error}; state the unit with {kind.option}") from None


def _infer_units(path: Path, table: Table, options: ReadingOptions, notes: list[str]) -> Table:
    """Return a table with the inferred units of the quantities whose unit neither the file nor the user states.

    Raises
    ------
    ConfigError
        If the numbers fit several units and the user does not accept the likeliest.
    """
    if not table.names:
        return table
    stated = dict(table.units)
    for kind in KINDS:
        of_triad = {stated[one] for one in kind.quantities if one in stated}
        unit = getattr(options, kind.key)
        if unit is not None:
            stated |= dict.fromkeys(kind.quantities, unit)
        elif len(of_triad) == 1:  # the unit of one axis is that of the triad
            stated |= dict.fromkeys(kind.quantities, of_triad.pop())
    for quantity in table.columns:
        if quantity in stated and stated[quantity].lower() not in UNSCALED:
            _find_conversion(path, quantity, stated[quantity])
    found = infer_units(table.columns, table.names, stated, table.fs)
    inferred = [kind for kind in KINDS if kind.name in found.reasons]
    doubtful = [kind for kind in inferred if kind.name in found.alternatives]
    if doubtful and not options.assume:
        doubts = "; ".join(f"{kind.name} in {' or '.join(found.alternatives[kind.name])}" for kind in doubtful)
        stating = " ".join(f"{kind.option} {found.likeliest[kind.name]}" for kind in doubtful)
        raise ConfigError(
            f"{path}: the file states no unit, and its numbers fit several: {doubts}. State the unit, such as "
            f"{stating}, or accept the likeliest with --assume"
        )
    said = [
        f"{kind.name} in {found.reasons[kind.name]}"
        for kind in inferred
        if found.likeliest[kind.name] != kind.si_unit or kind in doubtful
    ]
    if said:
        what = "The likeliest units are assumed" if doubtful else "Units found from the numbers"
        notes.append(f"{what}: {'; '.join(said)}.")
    return Table(table.columns, table.fs, notes, {**stated, **found.units}, table.names)


def find_unit(table: Table, options: ReadingOptions, quantity: str) -> str:
    """Return the unit of a quantity from the options, otherwise from the file, or the SI unit if neither states one."""
    kind = KIND_OF[quantity]
    unit: str = getattr(options, kind.key) or table.units.get(quantity) or kind.si_unit
    return unit


def is_known_column(name: str, options: ReadingOptions) -> bool:
    """Return True if a column may be part of a recording."""
    return name in options.columns.values() or parse_column_name(name) is not None


def names_an_axis(names: Sequence[str], sensor: str = "") -> bool:
    """Return True if one of the column names is the name of an axis."""
    return any((meaning := parse_column_name(name, sensor)) is not None and meaning.quantity in AXES for name in names)


def _find_given_column(path: Path, names: Sequence[str], quantity: str, column: str) -> int:
    """Return the index of a column that the user names, by its number, its name, or its name without the unit."""
    option = f"--columns {quantity}={column}"
    if column.isdecimal():
        if not 1 <= int(column) <= len(names):
            raise ConfigError(f"{path}: {option}: there is no column {column}; the file has {len(names)} columns")
        return int(column) - 1
    for spelled in (list(names), [split_unit(name)[0] for name in names]):
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
    if quantity == "t" and len(stated := [i for i in best if candidates[i].unit is not None]) == 1:
        best = stated
    if len({names[i] for i in best}) < len(best):
        raise RecordingError(
            f"{path}: column {names[best[0]]} occurs twice; each may occur once: give its number, such as "
            f"--columns {quantity}={best[0] + 1}"
        )
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
        if quantity == SENSOR:
            continue
        kind, meaning = KIND_OF[quantity], meanings.get(i)
        if meaning is None or KIND_OF[meaning.quantity] is not kind:
            meaning = ColumnName(quantity, 0, find_ending_unit(names[i], kind))
        unit = meaning.unit
        if unit is None and getattr(options, kind.key) is None:
            unit = meaning.assumed
            assumes = assumes or unit is not None
        if unit is not None:
            found[quantity] = kind.find_unit(unit) or unit
    if assumes:
        notes.append(BETAFLIGHT_NOTE)
    return found


def _convert(quantity: str, column: Times, factor: float, offset: float) -> tuple[str, Times]:
    """Return the name of the converted column, and its numbers."""
    if column.dtype.kind in "iu":
        ns_per_unit = round(factor * NS_PER_S)
        if factor < 1.0 and abs(factor * NS_PER_S - ns_per_unit) < 1e-6:
            t_ns = integers_to_ns(column, ns_per_unit)
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
