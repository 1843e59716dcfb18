"""Recordings: samples of an IMU that are read from a file, simulated, or given as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from drivers import recordings
from drivers.data_types import AXES, Floats, Times, times_to_seconds
from drivers.errors import ConfigError
from drivers.recordings.reading_options import create_reading_options
from drivers.recordings.table import ALIASES, COLUMNS, TIME_NS, integers_to_ns
from drivers.validation.module_lookup import format_suggestion
from drivers.validation.number_ranges import RATE_HZ, NumberRange
from imu_monitor._display import build_dataframe, render_html
from imu_monitor._message_wording import errors_name_arguments, replace_options_by_argument_names
from monitor.commands.analyze import check_averaging_times
from monitor.common.unit_formatting import KIND_NAMES, SAMPLE_UNITS, axes_of, format_duration, format_number
from monitor.estimation.allan.batch import TauGrid

if TYPE_CHECKING:
    import pandas as pd

Samples: TypeAlias = "Recording | Mapping[str, ArrayLike] | ArrayLike"
"""Samples that functions accept: a recording, columns by name (also a pandas DataFrame), or an array."""
AXES_EXAMPLE: Final = 'axes=("gx", "gy", "gz")'


class Recording(recordings.Recording):
    """Samples of one IMU.

    ``read_recording`` and ``simulate`` return recordings. All functions that take samples accept a recording.

    Attributes
    ----------
    times : ndarray of float64 or int64, shape (n,), or None
        Times as stored, with any origin: float64 in s, or int64 in ns if the source contains whole ns, µs or ms. None
        if only the sample rate is known.
    t_s, t_ns : ndarray of float64 or int64, shape (n,), or None
        Times in s or in ns. If the stored times have the other unit, the times are converted at each access.
    values : ndarray of float64, shape (n, 6)
        Angular rates in rad/s and accelerations in m/s², in the order gx, gy, gz, ax, ay, az. NaN means missing.
    temperature_c : ndarray of float64, shape (n,)
        Temperatures in °C. NaN means missing.
    rate_hz : float or None
        Sample rate in Hz as stated by the file or by the caller. None if only the times determine the sample rate.
    axes : tuple of str
        Measured axes.
    notes : tuple of str
        Descriptions of irregularities in the file.

    Examples
    --------
    >>> import imu_monitor
    >>> recording = imu_monitor.simulate("mti-1", duration_s=60.0)
    >>> recording
    <Recording of gx gy gz ax ay az: 6000 samples, 1 min 00 s>
    >>> recording["gz"].shape
    (6000,)
    """

    __slots__ = ()

    def __getitem__(self, axis: str) -> Floats:
        """Return the samples of one axis [n] in rad/s or m/s²."""
        if axis not in AXES:
            raise KeyError(f'unknown axis "{axis}"; possible are {" ".join(AXES)}')
        return self.values[:, AXES.index(axis)]

    @property
    def duration_s(self) -> float:
        """Duration in s: the number of samples times the sample interval or the mean step of the times."""
        if self.rate_hz is not None:
            return len(self) / self.rate_hz
        if self.times is None or len(self) < 2:
            return 0.0
        first_s, last_s = times_to_seconds(self.times[[0, -1]])
        return float(last_s - first_s) * len(self) / (len(self) - 1)

    def to_dict(self) -> dict[str, Floats]:
        """Return the columns of the recording: ``t`` in s, the measured axes, and ``temperature`` in °C if measured."""
        t_s = self.t_s
        columns = {"t": np.arange(len(self)) / (self.rate_hz or 1.0) if t_s is None else t_s}
        columns |= {axis: self[axis] for axis in self.axes}
        return columns | ({} if np.isnan(self.temperature_c).all() else {"temperature": self.temperature_c})

    def to_dataframe(self) -> "pd.DataFrame":
        """Return the columns of ``to_dict`` as a pandas DataFrame.

        Raises
        ------
        ConfigError
            If pandas is not installed.
        """
        return build_dataframe(self.to_dict())

    @errors_name_arguments()
    def save(self, path: str | PathLike[str]) -> None:
        """Write the recording to a file without loss of precision. MCAP stores times in whole nanoseconds.

        Parameters
        ----------
        path : str or path-like
            File that ends in .csv, .csv.gz, .npz, .parquet, .arrow, .feather or .mcap.

        Raises
        ------
        ConfigError
            If the suffix is unknown, a library is missing, or the file cannot be written.
        """
        columns = self.to_dict()
        times = columns["t"] if self.times is None else self.times
        recordings.save_samples(Path(path), times, self.values, columns.get("temperature"), self.axes)

    def __repr__(self) -> str:
        duration = format_duration(self.duration_s)
        return f"<Recording of {' '.join(self.axes) or 'no axis'}: {len(self)} samples, {duration}>"

    def __str__(self) -> str:
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:g} Hz"
        lines = [f"{len(self)} samples{rate}, {format_duration(self.duration_s)}"]
        for kind, unit in SAMPLE_UNITS.items():
            measured = [axis for axis in axes_of(kind) if axis in self.axes]
            if measured:
                lines.append(
                    f"{KIND_NAMES[kind]}, {unit.name}".ljust(22)
                    + "mean".rjust(12)
                    + "std".rjust(12)
                    + "missing".rjust(10)
                )
            for axis in measured:
                valid = self[axis][np.isfinite(self[axis])] * unit.factor
                mean, deviation = (valid.mean(), valid.std()) if valid.size else (np.nan, np.nan)
                lines.append(
                    f"  {axis}".ljust(22) + format_number(float(mean), 4).rjust(12)
                    + format_number(float(deviation)).rjust(12) + f"{len(self) - valid.size}".rjust(10)
                )  # fmt: skip
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def _repr_html_(self) -> str:
        return render_html(str(self))


@errors_name_arguments()
def read_recording(
    path: str | PathLike[str],
    rate_hz: float | None = None,
    *,
    last_s: float | None = None,
    topic: str | None = None,
    columns: Mapping[str, str | int] | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    temperature_unit: str | None = None,
    time_unit: str | None = None,
    assume: bool = False,
) -> Recording:
    """Read a recording from a file, or from all segments in a folder.

    Parameters
    ----------
    path : str or path-like
        File or folder (docs/reference/recording-formats.md). The columns of tables are ``t`` in s,
        ``gx gy gz`` in rad/s, ``ax ay az`` in m/s² and ``temperature`` in °C.
    rate_hz : float, optional
        Sample rate in Hz, for a file without the column ``t``.
    last_s : float, optional
        Read only the last ``last_s`` seconds of the recording. By default, the whole recording is read.
    topic : str, optional
        Topic to read from a ROS bag or an autopilot log. Required only if the file contains several IMUs.
    columns : mapping of str to str or int, optional
        Column of a table for each quantity (``t``, ``gx``, …, ``temperature``): a name, a number from 1, or ``"-"`` to
        leave the quantity out. By default, the columns are recognized by their names.
    gyro_unit : str, optional
        Unit of the angular rates in the file, such as ``"deg/s"``. By default, the unit that the file states or
        that its numbers show, or rad/s.
    accel_unit : str, optional
        Unit of the accelerations in the file, such as ``"g"``. By default, the unit that the file states or that
        its numbers show, or m/s².
    temperature_unit : str, optional
        Unit of the temperatures in the file, such as ``"K"``. By default, the unit that the file states, or °C.
    time_unit : str, optional
        Unit of the times in the file, such as ``"ns"``. By default, the unit that the file states or that its numbers
        show, or s.
    assume : bool, optional
        True to accept a doubtful table with its likeliest units and as one sensor. By default, such a table is refused.

    Returns
    -------
    Recording
        Samples in stored order. They are neither resampled nor sorted.

    Raises
    ------
    RecordingError
        If the file or folder contains no recording.
    ConfigError
        If the sample rate or a library is missing, the suffix, a column or a unit is unknown, or the samples do not fit
        into memory.

    Examples
    --------
    >>> import pathlib
    >>> import tempfile
    >>> import imu_monitor
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
    >>> imu_monitor.simulate("mti-1", duration_s=60.0).save(path)
    >>> imu_monitor.read_recording(path, last_s=30.0)
    <Recording of gx gy gz ax ay az: 3000 samples, 30 s>
    """
    options = create_reading_options(
        {
            "topic": topic,
            "columns": None if columns is None else dict(columns),
            "gyro_unit": gyro_unit,
            "accel_unit": accel_unit,
            "temperature_unit": temperature_unit,
            "time_unit": time_unit,
            "assume": assume,
        }
    )
    return to_public(recordings.load_samples(Path(path), rate_hz, last_s, options))


def to_public(recording: recordings.Recording) -> Recording:
    """Return a recording of the class ``Recording`` with the same samples."""
    parts = {field.name: getattr(recording, field.name) for field in fields(recording)}
    return Recording(**parts | {"notes": tuple(map(replace_options_by_argument_names, recording.notes))})


def to_recording(values: Samples, rate_hz: float | None = None, axes: str | Sequence[str] | None = None) -> Recording:
    """Convert samples in one of the accepted forms to a recording.

    Parameters
    ----------
    values : Recording, mapping or array
        See ``imu_monitor.analyze``.
    rate_hz : float, optional
        Sample rate in Hz.
    axes : str or sequence of str, optional
        Axis of each column of an array.

    Raises
    ------
    ConfigError, RecordingError
        If the samples do not have one of the accepted forms.
    """
    check_range("rate_hz", RATE_HZ, rate_hz)
    if isinstance(values, str | PathLike):
        raise ConfigError(f'values: "{values}" is a path; read the file with read_recording')
    if isinstance(values, recordings.Recording):
        found = values
        if rate_hz is not None:
            found = replace(found, rate_hz=rate_hz)
        return found if isinstance(found, Recording) else to_public(found)
    if isinstance(values, Mapping) or hasattr(values, "columns"):
        columns = _named_columns(values)
    else:
        columns = _array_columns(values, axes)
    if rate_hz is None and not {"t", TIME_NS} & {*columns}:
        raise ConfigError("rate_hz: is needed, because the samples have no times")
    return to_public(recordings.create_recording(columns, rate_hz))


def check_range(argument: str, allowed: NumberRange, value: float | None) -> None:
    """Check that an argument is a number in the supported range, or None.

    Raises
    ------
    ConfigError
        If the argument is out of range. The text names the argument.
    """
    if value is None:
        return
    try:
        allowed.check(value)
    except ConfigError as error:
        raise ConfigError(f"{argument}: {error}") from None
    except TypeError:
        raise ConfigError(f"{argument}: {value!r} is not a number") from None


def to_tau_grid(tau: Literal["octave", "decade10"] | Sequence[float]) -> TauGrid:
    """Return averaging times as the name of a grid, or as a tuple in s.

    Raises
    ------
    ConfigError
        If the name is unknown, or if an averaging time is out of range.
    """
    if isinstance(tau, str):
        if tau not in ("octave", "decade10"):
            raise ConfigError(f'tau: "{tau}"; possible are octave, decade10, or a list of seconds')
        return tau
    grid = tuple(float(tau_s) for tau_s in tau)
    try:
        check_averaging_times(grid)
    except ConfigError as error:
        raise ConfigError(f"tau: {error}") from None
    return grid


def _named_columns(values: Any) -> dict[str, Times]:
    """Return the known columns of a mapping or a pandas DataFrame. Integer times in ns precede times in s."""
    columns: dict[str, Times] = {}
    for name in values.keys():  # noqa: SIM118 - iteration over a pandas DataFrame gives the same names
        known = ALIASES.get(name, name)
        if known in COLUMNS:
            columns[known] = _to_floats(values[name], f"values: {name}", 1)
        elif known == TIME_NS:
            t_ns = np.asarray(values[name])
            if t_ns.dtype.kind not in "iu" or t_ns.ndim != 1:
                raise ConfigError(f"values: {name}: {t_ns.dtype} of shape {t_ns.shape}, expected integers (n,)")
            columns[TIME_NS] = integers_to_ns(t_ns, 1)
    if not set(columns) & set(AXES):
        raise ConfigError(f"values: no column is an axis; possible are {' '.join(AXES)}")
    return columns


def _array_columns(values: ArrayLike, axes: str | Sequence[str] | None) -> dict[str, Times]:
    """Return the columns of an array [n, k], or of an array [n] with the samples of one axis."""
    named = check_axes(axes)
    array = _to_floats(values, "values", 2)
    if array.ndim == 1 and len(named) == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != len(named):
        raise ConfigError(
            f"values: shape {array.shape}, expected ({'n, ' + str(len(named))}) for the axes {' '.join(named)}; name "
            f"other axes, such as {AXES_EXAMPLE}"
        )
    return {axis: array[:, column] for column, axis in enumerate(named)}


def check_axes(axes: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of axes as a tuple. None means all six axes.

    Raises
    ------
    ConfigError
        If an axis is unknown or is given twice.
    """
    named = AXES if axes is None else (axes,) if isinstance(axes, str) else tuple(axes)
    for axis in named:
        if axis not in AXES:
            raise ConfigError(f'axes: unknown axis "{axis}"{format_suggestion(str(axis), AXES)}')
    if len(set(named)) < len(named) or not named:
        raise ConfigError(f"axes: {' '.join(named) or 'no axis'}; each axis can be given once")
    return named


def _to_floats(values: Any, name: str, max_dimensions: int) -> Floats:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name}: is not an array of numbers: {' '.join(str(error).split())}") from error
    if not 1 <= array.ndim <= max_dimensions:
        raise ConfigError(f"{name}: shape {array.shape}, expected {'(n,)' if max_dimensions == 1 else '(n, 6)'}")
    return array
