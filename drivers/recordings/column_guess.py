"""Guess of the columns of a table whose names do not tell them, for the message that asks the user.

The times increase in nearly equal steps. An accelerometer at rest measures a vector of constant length, which is
gravity in a usual unit. The gyroscope is the nearest other vector whose length is not constant. The guess is never used
without the user, because a magnetometer or the gravity of a motion filter may look the same.
"""

import shlex
from collections.abc import Callable, Mapping, Sequence
from math import log
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from drivers.errors import UnknownColumnsError
from drivers.units import G0

EXAMINED_ROWS: Final = 1000
MIN_ROWS: Final = 20
MAX_LENGTH_SPREAD: Final = 0.03
"""Largest standard deviation of the length of a constant vector, relative to its median."""
MAX_GRAVITY_DISTANCE: Final = log(1.12)
GRAVITIES: Final = (G0, 1.0, 1000.0, 1000.0 * G0, *(float(2**k) for k in range(8, 16)))
"""Gravity in m/s², g, mg, mm/s², and in counts of usual sensitivities."""
MAX_LISTED_COLUMNS: Final = 200
MAX_NUMBER: Final = 1e30
SHOWN_VALUES: Final = 3

ReadColumn = Callable[[int], Sequence[Any] | NDArray[Any]]
"""Function that returns the first values of a column. Text is not converted to numbers."""


def guess_columns(numbers: Floats) -> tuple[dict[str, int], list[int]]:
    """Return the index of the column of each quantity that the numbers [rows, columns] may contain. NaN means text.

    A list of the first columns of other vectors follows that may be an accelerometer as well.
    """
    if len(numbers) < MIN_ROWS:
        return {}, []
    numbers = np.where(np.abs(numbers) < MAX_NUMBER, numbers, np.nan)
    steps = np.diff(numbers, axis=0)
    typical = np.median(steps, axis=0)
    steady = (steps > 0.0).all(axis=0) & (np.quantile(steps, 0.9, axis=0) < 2.0 * typical)
    times = [int(i) for i in np.flatnonzero(steady & ~(steps == 1.0).all(axis=0))]
    found = {"t": times[0]} if times else {}
    varying = np.isfinite(numbers).all(axis=0) & (numbers.std(axis=0) > 0.0) & ~steady
    triads = [i for i in range(numbers.shape[1] - 2) if varying[i : i + 3].all()]
    lengths = {i: np.linalg.norm(numbers[:, i : i + 3], axis=1) for i in triads}
    constant = {i for i in triads if lengths[i].std() < MAX_LENGTH_SPREAD * np.median(lengths[i])}
    accels = [i for i in constant if _gravity_distance(float(np.median(lengths[i]))) < MAX_GRAVITY_DISTANCE]
    pairs = [(abs(gyro - accel - 2), accel, gyro) for accel in accels for gyro in triads if abs(gyro - accel) >= 3]
    pairs = [pair for pair in pairs if pair[2] not in constant]
    accel, gyro = min(pairs)[1:] if pairs else (min(accels, default=None), None)
    for start, axes in ((gyro, AXES[:3]), (accel, AXES[3:])):
        if start is not None:
            found |= {axis: start + i for i, axis in enumerate(axes)}
    others: list[int] = []
    for start in sorted(accels):
        if all(abs(start - taken) >= 3 for taken in (*others, accel, gyro) if taken is not None):
            others.append(start)
    return found, others


def _gravity_distance(length: float) -> float:
    return min(abs(log(length / gravity)) for gravity in GRAVITIES)


def create_unknown_columns_error(
    path: Path,
    names: Sequence[str],
    text: str,
    read_column: ReadColumn,
    known: Mapping[str, int] = MappingProxyType({}),
    example: str = "1",
) -> UnknownColumnsError:
    """Create the error about a table whose columns the user has to name, with a table of the columns and a command.

    Parameters
    ----------
    path
        Path of the file.
    names
        Names of the columns.
    text
        What is wrong with the table.
    read_column
        Returns the first values of a column.
    known
        Index of the column of each quantity that is recognized, such as the time.
    example
        Column in the command if the numbers do not suggest any.
    """
    columns = [read_column(i) for i in range(min(len(names), MAX_LISTED_COLUMNS))]
    rows = max((len(column) for column in columns), default=0)
    numbers = [_to_numbers(column, rows) for column in columns]
    guess, others = guess_columns(np.column_stack(numbers)) if numbers else ({}, [])
    guess = {quantity: i for quantity, i in guess.items() if quantity not in known}
    options = ",".join(f"{quantity}={i + 1}" for quantity, i in guess.items()) or shlex.quote(f"gx={example}")
    rate = "" if "t" in (*guess, *known) or "fs" in names else " --rate HZ"
    quantities = {start + i: f"{axis}?" for start in others for i, axis in enumerate(AXES[3:])}
    quantities |= {i: quantity for quantity, i in (*guess.items(), *known.items())}
    lines = [f"{'column':6}  {'guess':5}  {'name':24}  first values"]
    for i, column in enumerate(columns):
        values = " ".join(_format_value(value) for value in column[:SHOWN_VALUES])
        lines.append(f"{i + 1:<6}  {quantities.get(i, ''):5}  {names[i][:24]:24}  {values}")
    if len(names) > len(columns):
        lines.append(f"{len(names) - len(columns)} more columns")
    if others:
        listed = ", ".join(f"{start + 1} to {start + 3}" for start in others)
        lines.append(f"Columns {listed} may be the accelerometer as well: choose one.")
    command = f"imu-monitor analyze {shlex.quote(str(path))} --columns {options}{rate}"
    return UnknownColumnsError(f"{text}, such as {command}", lines)


def _to_numbers(column: Sequence[Any] | NDArray[Any], rows: int) -> Floats:
    """Return a column as numbers. A shorter column and a column of text become NaN."""
    try:
        numbers = np.asarray(column, np.float64)
    except (ValueError, TypeError):
        return np.full(rows, np.nan)
    return numbers if len(numbers) == rows else np.full(rows, np.nan)


def _format_value(value: Any) -> str:
    text = f"{value:.12g}" if isinstance(value, (int, float, np.integer, np.floating)) else str(value)
    return text.strip()[:24]
