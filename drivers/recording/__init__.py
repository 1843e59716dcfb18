"""Recordings in and out: CSV (plain or gzip), .npz, Parquet and Arrow IPC, or a folder of segments.

In comes a path, out comes one ``Recording``: times, six axes, temperature, a stated rate, and notes
that say in plain sentences what was found and what was done about it. Each format has one module
that only finds columns (``Table``); what columns mean is decided once, here in ``_assemble``.

Outcomes: a ``Recording`` with at least one sample; ``RecordingError`` when the file is none (one
line: file, what is wrong, what would be right); ``ConfigError`` when the file is one but more has to
be said (``--rate``) or installed (pyarrow). A file cut off in the middle is read up to the cut.
What is doubtful is never passed on as a number: a line without its end, an unreadable field or an
infinite value, or one beyond 1e100, becomes missing, and a note counts it.

Time stamps are passed on as stored, with their jitter, gaps and steps back. Nothing is resampled,
sorted or filled here, no unit is guessed, and nothing is ever unpickled.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError, RecordingError, in_one_line
from drivers.quantities import DURATION_S, RATE_HZ
from drivers.recording import room
from drivers.recording.formats import FORMATS, format_of, is_recording
from drivers.recording.saving import save_samples, writing
from drivers.recording.table import EXAMPLE_HEADER, T_LIMIT_S, Table
from drivers.sample import AXES, Floats, SampleBlock, block
from drivers.small_file import check_regular

__all__ = ["FORMATS", "Recording", "is_recording", "iter_blocks", "load_samples", "save_samples", "writing"]

MAX_VALUE: Final = 1e100
"""Maximum size of a value. Sums of squares of larger values can exceed the range of float64."""
RESOLUTION_S: Final = 1e-6
"""Of Unix times in a double, and a little more."""


@dataclass(frozen=True, slots=True)
class Recording:
    """All samples of one file or folder, in stored order; arrays are read-only."""

    t_s: Floats | None  # [n] s as stored, any origin; None where only a rate is known
    values: Floats  # [n, 6] in AXES order, rad/s and m/s²; NaN = missing or absent
    temperature_c: Floats  # [n] °C; NaN = missing or absent
    rate_hz: float | None  # stated (fs of the file, or the caller's), not measured
    axes: tuple[str, ...]  # axes present as columns, in AXES order
    notes: tuple[str, ...]  # what was found and done

    def __len__(self) -> int:
        return int(self.values.shape[0])


def load_samples(path: Path, rate_hz: float | None = None, last_s: float | None = None) -> Recording:
    """Read a recording, or a folder of segments sorted by name as one recording.

    ``rate_hz`` is used where the file has no ``t``, and goes before the file's own ``fs``; of a long recording
    ``last_s`` takes the end alone, and of a folder only the segments for it are read.

    Raises RecordingError when the path holds no recording, ConfigError when a rate or a library is missing,
    the suffix is unknown, or the folder holds more than the memory does.
    """
    for option, quantity, value in (("--rate", RATE_HZ, rate_hz), ("--last", DURATION_S, last_s)):
        try:
            if value is not None:
                quantity.check(value)
        except ConfigError as error:
            raise ConfigError(f"{option}: {error}") from None
    try:
        found = _load_folder(path, rate_hz, last_s) if path.is_dir() else _load_file(path, rate_hz)
    except OSError as error:
        raise RecordingError(_why(path, error)) from error
    except MemoryError as error:
        raise ConfigError(f"{path}: does not fit into the memory that is free; read a part of it") from error
    return found if last_s is None else _end(found, last_s)


def iter_blocks(recording: Recording, rows: int = 4096) -> Iterator[SampleBlock]:
    """The recording as blocks of ``rows`` samples at most; ``t_ns`` are the recording's own times.

    Without ``t`` the first sample is at 0 and the rest follow at the stated rate.
    """
    for start in range(0, len(recording), rows):
        part = slice(start, min(start + rows, len(recording)))
        yield block(_times_ns(recording, part), recording.values[part], recording.temperature_c[part])


def _why(path: Path, error: RecordingError | OSError) -> str:
    """Why a file cannot be read, in one line that names it."""
    if isinstance(error, RecordingError):
        return str(error)
    return f"{error.filename or path}: cannot be read: {error.strerror or error}"


# --- from columns to a recording -----------------------------------------------------------------


def _load_file(path: Path, rate_hz: float | None) -> Recording:
    _check_content(path)
    return _assemble(path, format_of(path).read(path), rate_hz)


def _check_content(path: Path) -> None:
    """Raise an error for an empty file, and for a name that is not a regular file: a pipe or a device has no end."""
    check_regular(path)
    if path.stat().st_size:
        return
    if not is_recording(path):
        raise ConfigError(
            f"{path}: the file is empty, and its name does not end like a recording's; known are {' '.join(FORMATS)}"
        )
    raise RecordingError(
        f"{path}: the file is empty, expected columns such as {EXAMPLE_HEADER}; record it again, or name another file"
    )


def _assemble(path: Path, table: Table, rate_hz: float | None) -> Recording:
    """Give columns their meaning: lengths, times, rate, missing values."""
    n = _common_length(path, table.columns)
    notes = list(table.notes)
    rate = _stated_rate(_supported_fs(table.fs, notes), rate_hz, notes)
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
    return _recording(t_s, values, temperature_c, rate, axes, notes)


def _recording(
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
    return Recording(t_s, values, temperature_c, rate_hz, axes, tuple(map(in_one_line, notes)))


def _common_length(path: Path, columns: Mapping[str, Floats]) -> int:
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
    """Return the rate that the file states; None with a note if it is outside the supported range."""
    try:
        return fs if fs is None else RATE_HZ.check(fs)
    except ConfigError as error:
        notes.append(f"fs was left aside: {error}.")
        return None


def _stated_rate(fs: float | None, rate_hz: float | None, notes: list[str]) -> float | None:
    if rate_hz is not None and fs is not None and rate_hz != fs:
        notes.append(f"The file states {fs:g} Hz; {rate_hz:g} Hz was asked for and is used.")
    return fs if rate_hz is None else float(rate_hz)


def _usable_times(
    path: Path, t: Floats | None, rate_hz: float | None, notes: list[str]
) -> tuple[Floats | None, NDArray[np.bool_] | slice]:
    """The times that can be used, and the rows they stand in; None and all rows where t is of no use."""
    if t is None:
        return None, slice(None)
    usable = np.abs(t) < T_LIMIT_S  # false for NaN too
    lost = int(t.size - np.count_nonzero(usable))
    if 2 * lost > t.size:
        what = f"{lost} of {t.size} values of t are no time in seconds (first: {t[~usable][0]:g})"
        if rate_hz is None:
            raise RecordingError(f"{path}: {what}; t must be in seconds, or absent and --rate HZ given")
        notes.append(f"{what}; t was left aside and the stated rate of {rate_hz:g} Hz used.")
        return None, slice(None)
    if lost:
        notes.append(f"{lost} of {t.size} rows have no usable time and were left out.")
    return t[usable], usable


def _drop_large(values: Floats, temperature_c: Floats, notes: list[str]) -> None:
    """Replace values beyond MAX_VALUE by NaN, in place, and add a note that counts them."""
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


def _load_folder(path: Path, rate_hz: float | None, last_s: float | None) -> Recording:
    """Segments in the order of their names; one that cannot be read is left out, with a note."""
    segments = sorted(p for p in path.iterdir() if is_recording(p) and p.name[0] != ".")
    if not segments:
        raise RecordingError(f"{path}: no recordings in this folder; known are {' '.join(FORMATS)}")
    parts: list[Recording] = []  # newest first
    notes: list[str] = []
    free, taken = room.free_bytes(), 0
    if last_s is None:
        _check_folder(path, segments, free)
    for segment in reversed(segments):
        try:
            part = _load_file(segment, rate_hz)
        except (RecordingError, OSError) as error:
            notes.append(f"A segment was left out: {_why(segment, error)}.")
            continue
        parts.append(part)
        taken += part.values.nbytes + 2 * part.temperature_c.nbytes
        room.check(path, taken, free)
        notes += [f"{segment.name}: {note}" for note in reversed(part.notes)]
        if last_s is not None and _lasted_s(parts) > last_s:
            break
    if not parts:
        raise RecordingError(f"{path}: none of {len(segments)} segments can be read; {notes[-1]}")
    return _joined(path, parts[::-1], notes[::-1])


def _check_folder(path: Path, segments: Sequence[Path], free: int | None) -> None:
    """Raise an error if the rows of all segments exceed the limits; segments that cannot be read do not count."""
    rows = size_bytes = 0
    for segment in segments:
        try:
            _check_content(segment)
            rows += format_of(segment).count_rows(segment)
        except (RecordingError, OSError):
            continue  # left out, with a note, when it is read
        size_bytes += segment.stat().st_size
        room.ReadLimit(path, size_bytes, free).check_rows(rows)


def _lasted_s(parts: Sequence[Recording]) -> float:
    """From the first sample of the last of them to the end of the first."""
    newest, oldest = parts[0].t_s, parts[-1].t_s
    if newest is not None and oldest is not None:
        return float(newest[-1] - oldest[0])
    return sum(len(one) / one.rate_hz for one in parts if one.rate_hz)


def _end(found: Recording, last_s: float) -> Recording:
    """The last seconds, from where on no sample is older."""
    if found.t_s is not None:
        older = np.flatnonzero(found.t_s <= found.t_s[-1] - last_s + RESOLUTION_S)
        # the newest sample is always within a duration, however short that is
        first = min(int(older[-1]) + 1, len(found) - 1) if older.size else 0
    else:
        first = max(len(found) - max(round(last_s * (found.rate_hz or 0.0)), 1), 0)
    t_s = None if found.t_s is None else found.t_s[first:]
    note = f"Its last {last_s:g} s were taken, {len(found) - first} samples."
    values, temperature_c = found.values[first:].copy(), found.temperature_c[first:].copy()
    return _recording(t_s, values, temperature_c, found.rate_hz, found.axes, (*found.notes, note))


def _joined(path: Path, parts: Sequence[Recording], notes: list[str]) -> Recording:
    times = [part.t_s for part in parts if part.t_s is not None]
    rates = {part.rate_hz for part in parts}
    if 0 < len(times) < len(parts):
        raise RecordingError(f"{path}: some segments have t and some have not; all must, or none")
    if not times and len(rates) > 1:
        raise RecordingError(f"{path}: its segments state different rates and have no t; give --rate HZ")
    back = sum(a[-1] >= b[0] for a, b in pairwise(times))
    if back:
        notes.append(f"t does not go on from one segment to the next at {back} of {len(times) - 1} joints.")
    if not times and len(parts) > 1:
        notes.append("The segments have no t; each is taken to follow the one before without a gap.")
    return _recording(
        np.concatenate(times) if times else None,
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.temperature_c for part in parts]),
        rates.pop() if len(rates) == 1 else None,
        tuple(a for a in AXES if any(a in part.axes for part in parts)),
        notes,
    )
