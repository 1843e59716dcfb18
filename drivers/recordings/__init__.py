"""Reading and writing of recordings in CSV, .npz, Parquet and Arrow files, or in a folder of segments.

Logs of robots and of autopilots (ROS bags, MCAP, logs of PX4 and ArduPilot), MATLAB files, and folders and zip archives
of phone apps are only read.

``load_samples`` reads a file or a folder and returns a ``Recording``, which includes notes about irregularities of the
file, such as missing values.

The reader returns the complete part of a truncated file. Unreadable fields, infinite values and values beyond 1e100
become missing values.

The reader never resamples, sorts or interpolates samples, so the sample times keep their jitter, gaps and backward
steps. The reader never unpickles Python objects.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats, SampleBlock, make_block
from drivers.errors import ConfigError, RecordingError, describe_error, make_printable_and_shorten
from drivers.extras import require_extra
from drivers.file_access import check_regular_file
from drivers.number_ranges import DURATION_S, RATE_HZ
from drivers.recordings import memory_check
from drivers.recordings.formats import FORMATS, WRITABLE, Format, find_format, is_recording, is_recording_folder
from drivers.recordings.reading_options import DEFAULT_OPTIONS, ReadingOptions
from drivers.recordings.table import EXAMPLE_HEADER, T_LIMIT_S, Table
from drivers.recordings.table_layout import find_unit
from drivers.recordings.unit_check import describe_likely_unit_errors
from drivers.recordings.writing import open_recording_writer, save_samples
from drivers.units import time_factor

__all__ = [
    "FORMATS",
    "WRITABLE",
    "ReadingOptions",
    "Recording",
    "create_recording",
    "is_recording",
    "iter_blocks",
    "load_samples",
    "open_recording_writer",
    "require_packages_of_format",
    "save_samples",
    "take_last",
]

MAX_VALUE: Final = 1e100
"""Largest absolute value. The sum of the squares of larger values could overflow float64."""
MIN_UNIX_S: Final = 6e8
"""Unix time in s before which no recording of a MEMS sensor was made (1989)."""
TIME_RESOLUTION_S: Final = 1e-6
"""Time difference in s that is slightly larger than the resolution of Unix times in float64."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Samples of a file or folder in stored order. The arrays are read-only."""

    t_s: Floats | None  # [n] s as stored, with any origin; None if only a rate is known
    values: Floats  # [n, 6] in AXES order, rad/s and m/s²; NaN = missing or absent
    temperature_c: Floats  # [n] °C; NaN = missing or absent
    rate_hz: float | None  # rate that the file or the caller states, not a measured rate
    axes: tuple[str, ...]  # axes with a column in the file, in AXES order
    notes: tuple[str, ...]  # descriptions of irregularities in the file and of their handling

    def __len__(self) -> int:
        return int(self.values.shape[0])


def load_samples(
    path: Path,
    rate_hz: float | None = None,
    last_s: float | None = None,
    options: ReadingOptions = DEFAULT_OPTIONS,
) -> Recording:
    """Read a recording from a file, or from all segments in a folder.

    Parameters
    ----------
    path
        File or folder.
    rate_hz
        Sample rate in Hz for a file without the column ``t``. This rate takes precedence over the rate ``fs`` in the
        file.
    last_s
        Duration in s of the part to read at the end of the recording. None reads the whole recording.
    options
        Topic to read from a log that contains several, and columns and units of a table.

    Raises
    ------
    RecordingError
        If the file or folder contains no recording.
    ConfigError
        If the sample rate or a library is missing, the file suffix is unknown, or the samples do not fit into memory.
    """
    for option, quantity, value in (("--rate", RATE_HZ, rate_hz), ("--last", DURATION_S, last_s)):
        try:
            if value is not None:
                quantity.check(value)
        except ConfigError as error:
            raise ConfigError(f"{option}: {error}") from None
    try:
        if path.is_dir() and not is_recording_folder(path):
            found = _load_folder(path, rate_hz, last_s, options)
        else:
            found = _load_file(path, rate_hz, options)
    except OSError as error:
        raise RecordingError(_error_text(path, error)) from error
    except MemoryError as error:
        raise ConfigError(
            f"{path}: does not fit into the memory that is free; read a part of the recording with --last"
        ) from error
    return found if last_s is None else take_last(found, last_s)


def create_recording(columns: Mapping[str, Floats], rate_hz: float | None = None, source: str = "values") -> Recording:
    """Create a recording from columns in memory, in the same way as from the columns of a file.

    Parameters
    ----------
    columns
        float64 arrays [n] by name: ``t`` in s, the axes in rad/s and m/s², and ``temperature`` in °C. NaN means
        missing. The recording contains copies.
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
    copies = {name: np.array(column, np.float64) for name, column in columns.items()}
    return _assemble(Path(source), Table(copies, None, []), rate_hz, DEFAULT_OPTIONS)


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
    for start in range(0, len(recording), rows):
        part = slice(start, min(start + rows, len(recording)))
        yield make_block(_times_ns(recording, part), recording.values[part], recording.temperature_c[part])


def require_packages_of_format(path: Path) -> None:
    """Raise ConfigError if the packages that read a file are not installed. A folder of segments is not checked."""
    extra = find_format(path).extra if is_recording(path) else ""
    if extra:
        require_extra(extra, f"{path}: this recording")


def _error_text(path: Path, error: RecordingError | OSError) -> str:
    if isinstance(error, RecordingError):
        return str(error)
    return f"{error.filename or path}: cannot be read: {describe_error(error)}"


# --- from columns to a recording -----------------------------------------------------------------


def _load_file(path: Path, rate_hz: float | None, options: ReadingOptions) -> Recording:
    if not _is_empty(path):
        return _assemble(path, _format_with_packages(path).read(path, options), rate_hz, options)
    if not is_recording(path):
        raise ConfigError(
            f"{path}: the file is empty, and its name does not end like that of a recording; known are "
            f"{' '.join(FORMATS)}"
        )
    raise RecordingError(
        f"{path}: the file is empty, expected columns such as {EXAMPLE_HEADER}; record it again, or name another file"
    )


def _is_empty(path: Path) -> bool:
    """Return True if a file is empty. Raise OSError if the path is neither a file nor the folder of one recording."""
    if is_recording_folder(path):
        return False
    check_regular_file(path)
    return path.stat().st_size == 0


def _format_with_packages(path: Path) -> Format:
    require_packages_of_format(path)
    return find_format(path)


def _assemble(path: Path, table: Table, rate_hz: float | None, options: ReadingOptions) -> Recording:
    n = _common_length(path, table.columns)
    notes = list(table.notes)
    rate = _choose_rate(_supported_fs(table.fs, notes), rate_hz, notes)
    t_s, rows = _usable_times(path, table.columns.get("t"), rate, notes)
    if t_s is None and rate is None:
        why = next((f" ({note.rstrip('.')})" for note in notes if note.startswith("fs ")), "")
        fs = f"a usable fs{why}" if why else "fs"
        raise ConfigError(f"{path}: has neither t nor {fs}, so its rate is not known; give it with --rate HZ")
    axes = tuple(a for a in AXES if a in table.columns)
    values = np.full((n, len(AXES)), np.nan)
    for axis in axes:
        values[:, AXES.index(axis)] = table.columns[axis]
    temperature_c = table.columns.get("temperature", np.full(n, np.nan))
    values, temperature_c = values[rows], temperature_c[rows].copy()
    _drop_large(values, temperature_c, notes)
    notes += describe_likely_unit_errors(
        values, _mean_rate(t_s, rate), *(find_unit(table, options, axis) for axis in (AXES[0], AXES[3]))
    )
    return _read_only_recording(t_s, values, temperature_c, rate, axes, notes)


def _mean_rate(t_s: Floats | None, rate_hz: float | None) -> float | None:
    """Return the stated sample rate in Hz, or the rate that follows from the times. None if neither is known."""
    if rate_hz is not None or t_s is None or t_s.size < 2:
        return rate_hz
    steps = np.diff(t_s[: 1 << 16])
    step_s = float(np.mean(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
    return 1.0 / step_s if step_s else None


def _read_only_recording(
    t_s: Floats | None,
    values: Floats,
    temperature_c: Floats,
    rate_hz: float | None,
    axes: tuple[str, ...],
    notes: Sequence[str],
) -> Recording:
    for array in (t_s, values, temperature_c):
        if array is not None:
            array.flags.writeable = False
    return Recording(t_s, values, temperature_c, rate_hz, axes, tuple(map(make_printable_and_shorten, notes)))


def _common_length(path: Path, columns: Mapping[str, Floats]) -> int:
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
    path: Path, t: Floats | None, rate_hz: float | None, notes: list[str]
) -> tuple[Floats | None, NDArray[np.bool_] | slice]:
    """Return the usable times and a mask of the corresponding rows.

    If most times are unusable, return None and all rows.
    """
    if t is None:
        return None, slice(None)
    usable = np.abs(t) < T_LIMIT_S  # also False for NaN
    lost = int(t.size - np.count_nonzero(usable))
    if 2 * lost > t.size:
        what = f"{lost} of {t.size} values of t are not times in seconds (first: {t[~usable][0]:g})"
        if rate_hz is None:
            raise RecordingError(f"{path}: {what}; {_suggest_time_unit(t)}or leave t out and give --rate HZ")
        notes.append(f"{what}; the stated rate of {rate_hz:g} Hz is used instead of t.")
        return None, slice(None)
    if lost:
        notes.append(f"{lost} of {t.size} rows have no usable time and were left out.")
    return t[usable], usable


def _suggest_time_unit(t: Floats) -> str:
    """Return the advice to state the unit of times that fit Unix times in another unit than s."""
    median = float(np.median(np.abs(t[np.isfinite(t)]))) if np.isfinite(t).any() else 0.0
    unit = next((unit for unit in ("ms", "us", "ns") if MIN_UNIX_S < median * time_factor(unit) < T_LIMIT_S), None)
    return "give t in seconds, " if unit is None else f"they fit Unix times in {unit}: give --time-unit {unit}, "


def _drop_large(values: Floats, temperature_c: Floats, notes: list[str]) -> None:
    """Replace values beyond MAX_VALUE by NaN in place, and append a note with the number of replaced values."""
    count = 0
    for array in (values, temperature_c):
        large = np.abs(array) > MAX_VALUE
        count += int(np.count_nonzero(large))
        array[large] = np.nan
    if count:
        notes.append(f"{count} values that are infinite or beyond {MAX_VALUE:g} were read as missing.")


def _times_ns(recording: Recording, part: slice) -> NDArray[np.int64]:
    if recording.t_s is not None:
        seconds = recording.t_s[part]
    elif recording.rate_hz is not None:
        seconds = np.arange(part.start, part.stop) / recording.rate_hz
    else:
        raise RecordingError("a recording needs times or a rate")
    return np.rint(seconds * 1e9).astype(np.int64)


# --- folders -------------------------------------------------------------------------------------


def _load_folder(path: Path, rate_hz: float | None, last_s: float | None, options: ReadingOptions) -> Recording:
    """Read all segments in a folder. Skip unreadable segments, and append a note for each skipped segment."""
    segments = sorted((p for p in path.iterdir() if is_recording(p) and p.name[0] != "."), key=_number_order)
    if not segments:
        raise RecordingError(f"{path}: no recordings in this folder; known are {' '.join(FORMATS)}")
    parts: list[Recording] = []  # newest first
    notes: list[str] = []
    free = memory_check.available_bytes()
    rows = size_bytes = 0
    if last_s is None:
        _check_folder(path, segments, free, options)
    for segment in reversed(segments):
        try:
            part = _load_file(segment, rate_hz, options)
        except (RecordingError, OSError) as error:
            notes.append(f"A segment was left out: {_error_text(segment, error)}.")
            continue
        parts.append(part)
        rows, size_bytes = rows + len(part), size_bytes + segment.stat().st_size
        memory_check.RecordingSizeLimits(path, size_bytes, free).check_row_count(rows)
        notes += [f"{segment.name}: {note}" for note in reversed(part.notes)]
        if last_s is not None and _duration_s(parts) > last_s:
            break
    if not parts:
        raise RecordingError(f"{path}: none of {len(segments)} segments can be read; {notes[-1]}")
    return _concatenate(path, parts[::-1], notes[::-1])


def _number_order(path: Path) -> list[str | int]:
    """Return a key that sorts ``run_10.bag`` after ``run_2.bag``."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", path.name))]


def _check_folder(path: Path, segments: Sequence[Path], free: int | None, options: ReadingOptions) -> None:
    """Raise an error if the readable segments together contain too many rows."""
    rows = size_bytes = 0
    for segment in segments:
        try:
            rows += 0 if _is_empty(segment) else _format_with_packages(segment).count_rows(segment, options)
        except (RecordingError, OSError):
            continue  # the note about the segment is added when the segment is read
        size_bytes += segment.stat().st_size
        memory_check.RecordingSizeLimits(path, size_bytes, free).check_row_count(rows)


def _duration_s(parts: Sequence[Recording]) -> float:
    """Return the total duration of recordings in s. ``parts`` is sorted from newest to oldest."""
    newest, oldest = parts[0].t_s, parts[-1].t_s
    if newest is not None and oldest is not None:
        return float(newest[-1] - oldest[0])
    return sum(len(one) / one.rate_hz for one in parts if one.rate_hz)


def take_last(found: Recording, last_s: float) -> Recording:
    """Return the last ``last_s`` seconds of a recording, and at least the newest sample."""
    if found.t_s is not None:
        older = np.flatnonzero(found.t_s <= found.t_s[-1] - last_s + TIME_RESOLUTION_S)
        # The newest sample is always included.
        first = min(int(older[-1]) + 1, len(found) - 1) if older.size else 0
    else:
        first = max(len(found) - max(round(last_s * (found.rate_hz or 0.0)), 1), 0)
    t_s = None if found.t_s is None else found.t_s[first:]
    note = f"Only the last {last_s:g} s are used, {len(found) - first} samples."
    values, temperature_c = found.values[first:].copy(), found.temperature_c[first:].copy()
    return _read_only_recording(t_s, values, temperature_c, found.rate_hz, found.axes, (*found.notes, note))


def _concatenate(path: Path, parts: Sequence[Recording], notes: list[str]) -> Recording:
    times = [part.t_s for part in parts if part.t_s is not None]
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
        np.concatenate(times) if times else None,
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.temperature_c for part in parts]),
        rates.pop() if len(rates) == 1 else None,
        tuple(a for a in AXES if any(a in part.axes for part in parts)),
        notes,
    )
