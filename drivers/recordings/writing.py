"""Writing of recordings. Rows are appended to a file that appears complete or not at all.

A file is written under a temporary name and renamed when it is complete. If a run fails or is interrupted (Ctrl-C), it
leaves no file behind, and an existing file of that name stays unchanged. Memory does not grow with the number of rows.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.errors import ConfigError, RecordingError
from drivers.recordings.formats import format_for_path
from drivers.recordings.table import PARTIAL_SUFFIX, T_LIMIT_S, format_names
from drivers.sample import AXES, Floats


class AppendSamples(Protocol):
    """Function that appends rows to a recording."""

    def __call__(self, t_s: Floats, values: Floats, temperature_c: Floats | None = None) -> None:
        """Append rows.

        Parameters
        ----------
        t_s
            [n] float64, times in s.
        values
            [n, 6] float64 in the order of AXES, rad/s and m/s².
        temperature_c
            [n] float64 in °C. None if no temperature was measured.
        """


@contextmanager
def open_recording_writer(path: Path, axes: Sequence[str], temperature: bool) -> Iterator[AppendSamples]:
    """Write a recording in blocks of rows, in the format of the path's suffix.

    Parameters
    ----------
    path
        File to write. It appears when the context is left without an exception.
    axes
        Columns to write, some of AXES.
    temperature
        True if a temperature column is written.

    Raises
    ------
    ConfigError
        The suffix is unknown, or the file cannot be written there.
    RecordingError
        An axis is unknown, the arrays have different lengths, or a time is missing.
    """
    unknown = [axis for axis in axes if axis not in AXES]
    if unknown or not axes:
        what = f"unknown axis {format_names(unknown)}" if unknown else "no axis has a value"
        raise RecordingError(f"{path}: {what}; axes are {' '.join(AXES)}")
    begin = format_for_path(path).writer
    names = ["t", *axes, *(["temperature"] if temperature else [])]
    with atomic_write_path(path) as part, begin(part, names) as append_columns:

        def append(t_s: Floats, values: Floats, temperature_c: Floats | None = None) -> None:
            _check(path, t_s, values, temperature_c)
            table = {"t": t_s} | {axis: values[:, AXES.index(axis)] for axis in axes}
            if temperature:
                table["temperature"] = np.full(len(t_s), np.nan) if temperature_c is None else temperature_c
            append_columns({name: np.asarray(column, np.float64) for name, column in table.items()})

        yield append


def save_samples(
    path: Path,
    t_s: Floats,
    values: Floats,
    temperature_c: Floats | None = None,
    axes: Sequence[str] | None = None,
) -> None:
    """Write a recording in the format of the path's suffix. Values of float64 are stored without loss.

    Parameters
    ----------
    path
        File to write. It appears complete or not at all.
    t_s
        [n] float64, times in s.
    values
        [n, 6] float64 in the order of AXES, rad/s and m/s².
    temperature_c
        [n] float64 in °C. None if no temperature was measured.
    axes
        Columns to write. None for all axes with at least one value.

    Raises
    ------
    ConfigError
        The suffix is unknown, or the file cannot be written there.
    RecordingError
        The arrays have different lengths, an axis is unknown, or a time is missing.
    """
    _check(path, t_s, values, temperature_c)
    if axes is None:
        axes = [axis for i, axis in enumerate(AXES) if not np.isnan(values[:, i]).all()]
    temperature = temperature_c is not None and not np.isnan(temperature_c).all()
    with open_recording_writer(path, axes, temperature) as append:
        append(t_s, values, temperature_c)


@contextmanager
def atomic_write_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path that is renamed to ``path`` at the end, and removed after an exception.

    Raises
    ------
    ConfigError
        The folder does not exist, ``path`` is a folder, or writing is not permitted.
    """
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: cannot be written: there is no folder {path.parent}")
    if path.is_dir():  # report this before the work rather than after it
        raise ConfigError(f"{path}: cannot be written: it is a folder")
    part = path.with_name(path.name + PARTIAL_SUFFIX)
    try:
        if part.exists() and not part.is_file():  # opening a FIFO would wait for its reader
            part.unlink()
        part.touch()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    try:
        yield part
        os.replace(part, path)
    except (IsADirectoryError, PermissionError) as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    except OSError as error:  # the error of a full disk does not name the file
        error.filename = error.filename or str(path)
        raise
    finally:
        part.unlink(missing_ok=True)


def _check(path: Path, t_s: Floats, values: Floats, temperature_c: Floats | None) -> None:
    """Raise RecordingError if arrays have different lengths or a time is missing."""
    n = len(t_s)
    if n == 0 or values.shape != (n, len(AXES)):
        raise RecordingError(f"{path}: {n} times do not fit values of shape {values.shape}; need [n, 6], n ≥ 1")
    if temperature_c is not None and temperature_c.shape != (n,):
        raise RecordingError(f"{path}: {n} times do not fit {temperature_c.size} temperatures")
    if not np.all(np.abs(t_s) < T_LIMIT_S):
        raise RecordingError(f"{path}: a time is missing or not in seconds")
