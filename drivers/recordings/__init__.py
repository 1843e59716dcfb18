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
from collections.abc import Sequence
from pathlib import Path

from drivers.data_types import times_to_seconds
from drivers.errors import ConfigError, RecordingError, describe_error
from drivers.host.extras import require_extra
from drivers.host.safe_file_reading import check_regular_file
from drivers.recordings import memory_check
from drivers.recordings.formats import FORMATS, WRITABLE, Format, find_format, is_recording, is_recording_folder
from drivers.recordings.reading_options import DEFAULT_OPTIONS, ReadingOptions
from drivers.recordings.recording import (
    Recording,
    assemble_recording,
    concatenate_recordings,
    create_recording,
    iter_blocks,
    take_last,
)
from drivers.recordings.writing import open_recording_writer, save_samples
from drivers.validation.number_ranges import DURATION_S, RATE_HZ

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


def require_packages_of_format(path: Path) -> None:
    """Raise ConfigError if the packages that read a file are not installed. A folder of segments is not checked."""
    extra = find_format(path).extra if is_recording(path) else ""
    if extra:
        require_extra(extra, f"{path}: this recording")


def _error_text(path: Path, error: RecordingError | OSError) -> str:
    if isinstance(error, RecordingError):
        return str(error)
    return f"{error.filename or path}: cannot be read: {describe_error(error)}"


# --- files ---------------------------------------------------------------------------------------


def _load_file(path: Path, rate_hz: float | None, options: ReadingOptions) -> Recording:
    if not _is_empty(path):
        return assemble_recording(path, _format_with_packages(path).read(path, options), rate_hz, options)
    if not is_recording(path):
        raise ConfigError(
            f"{path}: the file is empty, and its name does not end like that of a recording; known are "
            f"{' '.join(FORMATS)}"
        )
    raise RecordingError(
        f"{path}: the file is empty, expected samples of an IMU; record it again, or name another file"
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
    return concatenate_recordings(path, parts[::-1], notes[::-1])


def _number_order(path: Path) -> list[str | int]:
    """Return a key that sorts ``run_10.bag`` after ``run_2.bag``."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", path.name))]


def _duration_s(parts: Sequence[Recording]) -> float:
    """Return the total duration of recordings in s. ``parts`` is sorted from newest to oldest."""
    newest, oldest = parts[0].times, parts[-1].times
    if newest is not None and oldest is not None:
        return float(times_to_seconds(newest[-1:])[0] - times_to_seconds(oldest[:1])[0])
    return sum(len(one) / one.rate_hz for one in parts if one.rate_hz)
