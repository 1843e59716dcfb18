"""Recording of an IMU in memory: creation from columns, division into blocks, and concatenation."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import (
    AXES,
    NO_TICK,
    NS_PER_S,
    Floats,
    Ints,
    SampleBlock,
    Times,
    make_block,
    times_to_ns,
    times_to_seconds,
)
from drivers.errors import ConfigError, RecordingError, make_printable_and_shorten
from drivers.recordings.reading_options import DEFAULT_OPTIONS, ReadingOptions
from drivers.recordings.table import BATCH_ROWS, POSSIBLE_TIMES, T_LIMIT_S, TIME_NS, Columns, Table, column_dtype
from drivers.recordings.table_layout import find_unit
from drivers.recordings.unit_check import describe_likely_unit_errors
from drivers.units import time_factor
from drivers.validation.number_ranges import RATE_HZ

MAX_VALUE: Final = 1e100
"""Largest absolute value. The sum of the squares of larger values could overflow float64."""
MIN_UNIX_S: Final = 6e8
"""Unix time in s before which no recording of a MEMS sensor was made (1989)."""
TIME_RESOLUTION_S: Final = 1e-6
"""Time difference in s that is slightly larger than the resolution of Unix times in float64."""


N = TypeVar("N", np.float64, np.int64)


@dataclass(frozen=True, slots=True)
class Recording:
    """Samples of a file or folder in stored order. The arrays are read-only."""

    times: Times | None  # [n] as stored, with any origin: int64 in ns, or float64 in s; None if only a rate is known
    values: Floats  # [n, 6] in AXES order, rad/s and m/s²; NaN = missing or absent
    temperature_c: Floats  # [n] °C; NaN = missing or absent
    rate_hz: float | None  # rate that the file or the caller states, not a measured rate
    axes: tuple[str, ...]  # axes with a column in the file, in AXES order
    notes: tuple[str, ...]  # descriptions of irregularities in the file and of their handling

    @property
    def t_s(self) -> Floats | None:
        """Times [n] in s, with any origin. None if only a rate is known. Times in ns are converted at each access."""
        return None if self.times is None else _read_only(times_to_seconds(self.times))

    @property
    def t_ns(self) -> Ints | None:
        """Times [n] in ns. None if only a rate is known. Times in s are rounded at each access."""
        return None if self.times is None else _read_only(times_to_ns(self.times))

    def __len__(self) -> int:
        return int(self.values.shape[0])


def create_recording(columns: Columns, rate_hz: float | None = None, source: str = "values") -> Recording:
    """Create a recording from columns in memory, in the same way as from the columns of a file.

    Parameters
    ----------
    columns
        float64 arrays [n] by name: ``t`` in s, the axes in rad/s and m/s², and ``temperature`` in °C. NaN means
        missing. An int64 array ``t_ns`` in ns can replace ``t``. The recording contains copies.
    rate_hz
        Sample rate in Hz, which takes precedence over the times.
    source
        Name of the source in error messages.

    Raises
    ------
    RecordingError
        If the columns are empty or have different lengths, or if no time is usable.
    ConfigError
        If there are neither times nor a sample rate.
    """
    copies = {name: np.array(column, column_dtype(name)) for name, column in columns.items()}
    return assemble_recording(Path(source), Table(copies, None, []), rate_hz, DEFAULT_OPTIONS)


def iter_blocks(recording: Recording, rows: int = 4096) -> Iterator[SampleBlock]:
    """Yield the samples of a recording in blocks.

    Parameters
    ----------
    recording
        Recording to split.
    rows
        Maximum number of samples per block.

    Yields
    ------
    SampleBlock
        Consecutive samples. If the recording contains no times, the sample times start at 0 and follow from the sample
        rate.
    """
    t_ns, ticks = _times_ns(recording), np.full(min(rows, len(recording)), NO_TICK, np.int64)
    for start in range(0, len(recording), rows):  # views, because many small arrays do not return to the system
        part = slice(start, min(start + rows, len(recording)))
        yield make_block(
            t_ns[part], recording.values[part], recording.temperature_c[part], ticks[: part.stop - part.start]
        )


def assemble_recording(path: Path, table: Table, rate_hz: float | None, options: ReadingOptions) -> Recording:
    """Return a recording built from the columns of a file.

    Parameters
    ----------
    path
        Path of the file, used in error messages.
    table
        Columns in SI units.
    rate_hz
        Sample rate in Hz, which takes precedence over the rate of the file.
    options
        Units that the user states, used in notes.

    Raises
    ------
    RecordingError
        If the columns are empty or have different lengths, or if no time is usable.
    ConfigError
        If there are neither times nor a sample rate.
    """
    n = _common_length(path, table.columns)
    notes = list(table.notes)
    rate = _choose_rate(_supported_fs(table.fs, notes), rate_hz, notes)
    times, rows = _usable_times(path, table.columns.get(TIME_NS, table.columns.get("t")), rate, notes)
    if times is None and rate is None:
        why = next((f" ({note.rstrip('.')})" for note in notes if note.startswith("fs ")), "")
        fs = f"a usable fs{why}" if why else "fs"
        times_note = next((f". {note.rstrip('.')}" for note in notes if note.startswith(POSSIBLE_TIMES)), "")
        raise ConfigError(
            f"{path}: has neither t nor {fs}, so its rate is not known; give it with --rate HZ{times_note}"
        )
    axes = tuple(a for a in AXES if a in table.columns)
    values = _stack_axes(table.columns, n)[rows]
    stored_c = cast(Floats | None, table.columns.get("temperature"))
    temperature_c = np.full(len(values), np.nan) if stored_c is None else stored_c[rows].copy()
    _drop_large(values, temperature_c, notes)
    notes += describe_likely_unit_errors(
        values, _mean_rate(times, rate), *(find_unit(table, options, axis) for axis in (AXES[0], AXES[3]))
    )
    return _read_only_recording(times, values, temperature_c, rate, axes, notes)


def _stack_axes(columns: Columns, n: int) -> Floats:
    """Return the axes as an array [n, 6]. An array that already begins with these columns is not copied."""
    whole = columns[AXES[0]].base if AXES[0] in columns else None
    if whole is not None and whole.shape[1:] == (len(AXES),) and len(whole) >= n:
        parts = {axis: whole[:n, i].__array_interface__ for i, axis in enumerate(AXES)}
        if all(axis in columns and columns[axis].__array_interface__ == part for axis, part in parts.items()):
            return whole[:n]
    values = np.full((n, len(AXES)), np.nan)
    for i, axis in enumerate(AXES):
        if axis in columns:
            values[:, i] = columns[axis]
    return values


def _mean_rate(times: Times | None, rate_hz: float | None) -> float | None:
    """Return the stated sample rate in Hz, or the rate that follows from the times. None if neither is known."""
    if rate_hz is not None or times is None or times.size < 2:
        return rate_hz
    steps = np.diff(times_to_seconds(times[: 1 << 16]))
    step_s = float(np.mean(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
    return 1.0 / step_s if step_s else None


def _read_only(array: NDArray[N]) -> NDArray[N]:
    array.flags.writeable = False
    return array


def _read_only_recording(
    times: Times | None,
    values: Floats,
    temperature_c: Floats,
    rate_hz: float | None,
    axes: tuple[str, ...],
    notes: Sequence[str],
) -> Recording:
    for array in (times, values, temperature_c):
        if array is not None:
            array.flags.writeable = False
    return Recording(times, values, temperature_c, rate_hz, axes, tuple(map(make_printable_and_shorten, notes)))


def _common_length(path: Path, columns: Columns) -> int:
    """Return the common length of all columns. Raise RecordingError if the columns are empty or differ in length."""
    first = next(iter(columns))
    n = columns[first].size
    for name, column in columns.items():
        if column.size != n:
            raise RecordingError(
                f"{path}: {name} has {column.size} values but {first} has {n}; columns must be equally long"
            )
    if n == 0:
        raise RecordingError(f"{path}: has columns but no samples")
    return n


def _supported_fs(fs: float | None, notes: list[str]) -> float | None:
    """Return the sample rate of the file. If the sample rate is unsupported, return None and append a note."""
    try:
        return fs if fs is None else RATE_HZ.check(fs)
    except ConfigError as error:
        notes.append(f"fs is not used: {error}.")
        return None


def _choose_rate(fs: float | None, rate_hz: float | None, notes: list[str]) -> float | None:
    if rate_hz is not None and fs is not None and rate_hz != fs:
        notes.append(f"The file states {fs:g} Hz; the requested {rate_hz:g} Hz are used.")
    return fs if rate_hz is None else float(rate_hz)


def _usable_times(
    path: Path, times: Times | None, rate_hz: float | None, notes: list[str]
) -> tuple[Times | None, NDArray[np.bool_] | slice]:
    """Return the usable times and a mask of the corresponding rows.

    If most times are unusable, return None and all rows.
    """
    if times is None:
        return None, slice(None)
    limit = T_LIMIT_S if times.dtype == np.float64 else int(T_LIMIT_S * NS_PER_S)
    if -limit < times.min() and times.max() < limit:  # also False for NaN
        # A view of one column would keep a larger array in memory.
        return cast(Times, np.ascontiguousarray(times)), slice(None)
    usable = (times > -limit) & (times < limit)
    lost = int(times.size - np.count_nonzero(usable))
    if 2 * lost > times.size:
        t = times_to_seconds(times)
        what = f"{lost} of {t.size} values of t are not times in seconds (first: {t[~usable][0]:g})"
        if rate_hz is None:
            raise RecordingError(f"{path}: {what}; {_suggest_time_unit(t)}or leave t out and give --rate HZ")
        notes.append(f"{what}; the stated rate of {rate_hz:g} Hz is used instead of t.")
        return None, slice(None)
    notes.append(f"{lost} of {times.size} rows have no usable time and were left out.")
    return times[usable], usable


def _suggest_time_unit(t: Floats) -> str:
    """Return the advice to state the unit of times that fit Unix times in another unit than s."""
    median = float(np.median(np.abs(t[np.isfinite(t)]))) if np.isfinite(t).any() else 0.0
    unit = next((unit for unit in ("ms", "us", "ns") if MIN_UNIX_S < median * time_factor(unit) < T_LIMIT_S), None)
    return "give t in seconds, " if unit is None else f"they fit Unix times in {unit}: give --time-unit {unit}, "


def _drop_large(values: Floats, temperature_c: Floats, notes: list[str]) -> None:
    """Replace values beyond MAX_VALUE by NaN in place, and append a note with the number of replaced values."""
    count = 0
    for array in (values, temperature_c):
        for start in range(0, len(array), BATCH_ROWS):  # a mask of all rows would need more memory
            block = array[start : start + BATCH_ROWS]
            large = np.abs(block) > MAX_VALUE
            count += int(np.count_nonzero(large))
            block[large] = np.nan
    if count:
        notes.append(f"{count} values that are infinite or beyond {MAX_VALUE:g} were read as missing.")


def _times_ns(recording: Recording) -> Ints:
    if recording.times is not None:
        return times_to_ns(recording.times)
    if recording.rate_hz is None:
        raise RecordingError("a recording needs times or a rate")
    return times_to_ns(np.arange(len(recording)) / recording.rate_hz)


def take_last(found: Recording, last_s: float) -> Recording:
    """Return the last ``last_s`` seconds of a recording, and at least the newest sample."""
    if (t_s := found.t_s) is not None:
        older = np.flatnonzero(t_s <= t_s[-1] - last_s + TIME_RESOLUTION_S)
        # The newest sample is always included.
        first = min(int(older[-1]) + 1, len(found) - 1) if older.size else 0
    else:
        first = max(len(found) - max(round(last_s * (found.rate_hz or 0.0)), 1), 0)
    times = None if found.times is None else found.times[first:]
    note = f"Only the last {last_s:g} s are used, {len(found) - first} samples."
    values, temperature_c = found.values[first:].copy(), found.temperature_c[first:].copy()
    return _read_only_recording(times, values, temperature_c, found.rate_hz, found.axes, (*found.notes, note))


def _overlaps(one: Recording, other: Recording) -> bool:
    """Return True if two recordings were made at the same time."""
    if one.t_s is None or other.t_s is None:
        return False
    return bool(one.t_s[0] < other.t_s[-1] and other.t_s[0] < one.t_s[-1])


def concatenate_recordings(path: Path, parts: Sequence[Recording], notes: list[str]) -> Recording:
    """Concatenate the recordings of the segments in a folder.

    Parameters
    ----------
    path
        Path of the folder, used in error messages.
    parts
        Recordings, oldest first.
    notes
        Notes of the result, to which further notes are appended.

    Raises
    ------
    RecordingError
        If only some of the recordings have times, if they have no times and different sample rates, or if
        recordings of different axes overlap.
    """
    first = parts[0]
    other = next((part for part in parts if not {*part.axes} & {*first.axes} and _overlaps(part, first)), None)
    if other is not None:
        measured = f"{' '.join(first.axes)} and {' '.join(other.axes)}"
        raise RecordingError(
            f"{path}: its files measure different axes ({measured}) and are no segments of one recording; name one "
            "file after the gyroscope and one after the accelerometer, such as gyro.csv and accel.csv, to join them"
        )
    times = [part.times for part in parts if part.times is not None]
    if len({one.dtype for one in times}) > 1:
        times = [times_to_seconds(one) for one in times]
    rates = {part.rate_hz for part in parts}
    if 0 < len(times) < len(parts):
        raise RecordingError(f"{path}: some segments have t and some have not; give t in all of them, or in none")
    if not times and len(rates) > 1:
        raise RecordingError(f"{path}: its segments state different rates and have no t; give --rate HZ")
    back = sum(a[-1] >= b[0] for a, b in pairwise(times))
    if back:
        notes.append(f"t does not increase from one segment to the next at {back} of {len(times) - 1} joints.")
    if not times and len(parts) > 1:
        notes.append("The segments have no t; they are joined without gaps.")
    return _read_only_recording(
        cast(Times, np.concatenate(times)) if times else None,
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.temperature_c for part in parts]),
        rates.pop() if len(rates) == 1 else None,
        tuple(a for a in AXES if any(a in part.axes for part in parts)),
        notes,
    )
