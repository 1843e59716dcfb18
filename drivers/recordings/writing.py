"""Recordings out: rows are appended to a file that appears whole or not at all.

A file is written under another name and renamed once it is whole, so that a run that fails or is broken off (Ctrl-C)
leaves nothing behind, and a file of that name stays as it was. Memory does not grow with the rows.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.errors import ConfigError, RecordingError
from drivers.recordings.formats import format_of
from drivers.recordings.table import PART, T_LIMIT_S, listed
from drivers.sample import AXES, Floats


class AppendSamples(Protocol):
    """Takes the next rows of a recording."""

    def __call__(self, t_s: Floats, values: Floats, temperature_c: Floats | None = None) -> None:
        """``t_s`` [n] s, ``values`` [n, 6] in AXES order, ``temperature_c`` [n] °C where that column is written."""


@contextmanager
def writing(path: Path, axes: Sequence[str], temperature: bool) -> Iterator[AppendSamples]:
    """Write a recording, some rows at a time, in the format of the path's suffix.

    Args:
        path: it appears when the context is left without an exception
        axes: the columns to write, some of AXES
        temperature: whether there is that column too
    Raises:
        ConfigError: a suffix or place that cannot be written
        RecordingError: unfit axes; rows that do not fit each other, or without a time
    """
    unknown = [axis for axis in axes if axis not in AXES]
    if unknown or not axes:
        what = f"unknown axis {listed(unknown)}" if unknown else "no axis has a value"
        raise RecordingError(f"{path}: {what}; axes are {' '.join(AXES)}")
    begin = format_of(path).writer
    names = ["t", *axes, *(["temperature"] if temperature else [])]
    with whole(path) as part, begin(part, names) as append_columns:

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
    """Write a recording in the format of the path's suffix; float64 comes back bit for bit.

    ``t_s`` [n] s, ``values`` [n, 6] in AXES order, ``temperature_c`` [n] °C. ``axes`` names the columns
    to write; by default those with at least one value. The file appears whole or not at all.

    Raises ConfigError for a suffix or place that cannot be written, RecordingError for unfit arrays.
    """
    _check(path, t_s, values, temperature_c)
    if axes is None:
        axes = [axis for i, axis in enumerate(AXES) if not np.isnan(values[:, i]).all()]
    temperature = temperature_c is not None and not np.isnan(temperature_c).all()
    with writing(path, axes, temperature) as append:
        append(t_s, values, temperature_c)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A name to write to, renamed to ``path`` at the end and removed after any exception.

    Raises:
        ConfigError: there is no such folder, a folder of that name, or no permission and whatever else forbids it
    """
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: cannot be written: there is no folder {path.parent}")
    if path.is_dir():  # said before the work rather than after it
        raise ConfigError(f"{path}: cannot be written: it is a folder")
    part = path.with_name(path.name + PART)
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
    except OSError as error:  # a full disk does not say of which file
        error.filename = error.filename or str(path)
        raise
    finally:
        part.unlink(missing_ok=True)


def _check(path: Path, t_s: Floats, values: Floats, temperature_c: Floats | None) -> None:
    n = len(t_s)
    if n == 0 or values.shape != (n, len(AXES)):
        raise RecordingError(f"{path}: {n} times do not fit values of shape {values.shape}; need [n, 6], n ≥ 1")
    if temperature_c is not None and temperature_c.shape != (n,):
        raise RecordingError(f"{path}: {n} times do not fit {temperature_c.size} temperatures")
    if not np.all(np.abs(t_s) < T_LIMIT_S):
        raise RecordingError(f"{path}: a time is missing or not in seconds")
