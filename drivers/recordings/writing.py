"""Write recordings to files of any supported format.

Each recording is written to a temporary file, which is renamed on completion. If writing fails or is interrupted, an
existing recording remains unchanged.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.data_types import AXES, Floats, Times, times_to_seconds
from drivers.errors import ConfigError, RecordingError
from drivers.recordings.formats import find_writer
from drivers.recordings.table import BATCH_ROWS, PARTIAL_SUFFIX, T_LIMIT_S, TIME_NS, column_dtype, format_name_list


class AppendSamples(Protocol):
    """Function that appends rows to a recording."""

    def __call__(self, times: Times, values: Floats, temperature_c: Floats | None = None) -> None:
        """Append samples to the recording.

        Parameters
        ----------
        times
            [n] times of the type that the file was opened with: float64 in s, or int64 in ns.
        values
            [n, 6] float64 in the order of AXES, rad/s and m/s².
        temperature_c
            [n] float64 in °C. None if no temperature was measured.
        """


@contextmanager
def open_recording_writer(
    path: Path, axes: Sequence[str], temperature: bool, *, times_in_ns: bool = False
) -> Iterator[AppendSamples]:
    """Create a recording file and yield a function that appends samples. The file suffix determines the format.

    Parameters
    ----------
    path
        File to write. The file appears when the context ends without an exception.
    axes
        Axes to write, a subset of AXES.
    temperature
        True if a temperature column is written.
    times_in_ns
        True if the times are int64 in ns. The file then contains the column ``t_ns`` instead of ``t``.

    Raises
    ------
    ConfigError
        If the suffix is unknown, or the file cannot be written.
    RecordingError
        If an axis is unknown, the arrays have different lengths, or a time is missing.
    """
    unknown = [axis for axis in axes if axis not in AXES]
    if unknown or not axes:
        what = f"unknown axis {format_name_list(unknown)}" if unknown else "no axis has a value"
        raise RecordingError(f"{path}: {what}; axes are {' '.join(AXES)}")
    open_writer = find_writer(path)
    time_name = TIME_NS if times_in_ns else "t"
    names = [time_name, *axes, *(["temperature"] if temperature else [])]
    with atomic_write_path(path) as part, open_writer(part, names) as append_columns:

        def append_samples(times: Times, values: Floats, temperature_c: Floats | None = None) -> None:
            _check_arrays(path, times, values, temperature_c)
            table = {time_name: times} | {axis: values[:, AXES.index(axis)] for axis in axes}
            if temperature:
                table["temperature"] = np.full(len(times), np.nan) if temperature_c is None else temperature_c
            append_columns({name: np.asarray(column, column_dtype(name)) for name, column in table.items()})

        yield append_samples


def save_samples(
    path: Path,
    times: Times,
    values: Floats,
    temperature_c: Floats | None = None,
    axes: Sequence[str] | None = None,
    report_share: Callable[[float], None] = lambda _share: None,
) -> None:
    """Save samples as a recording without loss of precision. The file suffix determines the format.

    Parameters
    ----------
    path
        File to write.
    times
        [n] float64, times in s, or int64, times in ns.
    values
        [n, 6] float64 in the order of AXES, rad/s and m/s².
    temperature_c
        [n] float64 in °C. None if no temperature was measured.
    axes
        Axes to write. By default, all axes with at least one value are written.
    report_share
        Function that receives the share of the rows that have been written, from 0 to 1.

    Raises
    ------
    ConfigError
        If the suffix is unknown, or the file cannot be written.
    RecordingError
        If the arrays have different lengths, an axis is unknown, or a time is missing.
    """
    _check_arrays(path, times, values, temperature_c)
    if axes is None:
        axes = [axis for i, axis in enumerate(AXES) if not np.isnan(values[:, i]).all()]
    temperature = temperature_c is not None and not np.isnan(temperature_c).all()
    with open_recording_writer(path, axes, temperature, times_in_ns=times.dtype == np.int64) as append_samples:
        for start in range(0, len(times), BATCH_ROWS):
            report_share(start / len(times))
            rows = slice(start, start + BATCH_ROWS)
            append_samples(times[rows], values[rows], None if temperature_c is None else temperature_c[rows])
        report_share(1.0)


@contextmanager
def atomic_write_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path, and rename the temporary file to ``path`` at the end of the context.

    If an exception occurs, the temporary file is removed.

    Raises
    ------
    ConfigError
        If the folder does not exist, ``path`` is a folder, or writing is not permitted.
    """
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: cannot be written: there is no folder {path.parent}")
    if path.is_dir():  # otherwise the error would occur only after writing
        raise ConfigError(f"{path}: cannot be written: it is a folder")
    part = path.with_name(path.name + PARTIAL_SUFFIX)
    try:
        if part.exists() and not part.is_file():  # opening a FIFO would wait for a reading program
            part.unlink()
        part.touch()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    try:
        yield part
        os.replace(part, path)
    except (IsADirectoryError, PermissionError) as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    except OSError as error:  # the exception for a full disk does not name the file
        error.filename = error.filename or str(path)
        raise
    finally:
        part.unlink(missing_ok=True)


def _check_arrays(path: Path, times: Times, values: Floats, temperature_c: Floats | None) -> None:
    """Raise RecordingError if the arrays have different lengths, or if a time is missing."""
    n = len(times)
    if n == 0 or values.shape != (n, len(AXES)):
        raise RecordingError(f"{path}: {n} times and values of shape {values.shape}, expected shape [n, 6] with n ≥ 1")
    if temperature_c is not None and temperature_c.shape != (n,):
        raise RecordingError(f"{path}: {n} times and {temperature_c.size} temperatures, expected equal numbers")
    if not np.all(np.abs(times_to_seconds(times)) < T_LIMIT_S):
        raise RecordingError(f"{path}: a time is missing or not in seconds")
