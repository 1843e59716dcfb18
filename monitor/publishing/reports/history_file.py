"""Export of a history as a table: CSV, Parquet, Arrow or .npz, one row per bucket and one column per number, in SI.

Column names include the unit in ASCII: ``gz.N (rad/sqrt(s))``, and for the extremes ``gz.N low (rad/sqrt(s))`` and
``gz.N high (rad/sqrt(s))``. Missing values are empty or NaN. The file is created completely or not at all.
"""

from pathlib import Path
from typing import Final

import numpy as np

from drivers.recordings.formats import format_for_path
from drivers.recordings.writing import atomic_write_path
from drivers.sample import Floats
from monitor.common.units import sensor_kind
from monitor.history.bucket import COUNTS, STATES
from monitor.history.reading import HistoryTable

COEFFICIENT_SI_UNITS: Final = {
    "gyro": {"Q": "rad", "N": "rad/sqrt(s)", "B": "rad/s", "K": "rad/s/sqrt(s)", "R": "rad/s^2", "sigma": "rad/s"},
    "accel": {"Q": "m/s", "N": "m/s/sqrt(s)", "B": "m/s^2", "K": "m/s^2/sqrt(s)", "R": "m/s^3", "sigma": "m/s^2"},
}
STATUS_UNITS: Final = {"rate": "Hz", "latency": "s", "memory": "B", "temperature": "degC"}
STATE_COLUMN_NAME: Final = (
    "state (" + ", ".join(f"{i} {name}" for i, name in enumerate(STATES)).replace(", ", "; ") + ")"
)


def save(past: HistoryTable, path: Path) -> None:
    """Write a history in the format of the path's suffix.

    Parameters
    ----------
    past
        The history.
    path
        File to write.

    Raises
    ------
    ConfigError
        The suffix is unknown or the file cannot be written.
    """
    columns = table(past)
    begin = format_for_path(path).open_writer
    with atomic_write_path(path) as part, begin(part, list(columns)) as append:
        append(columns)


def table(past: HistoryTable) -> dict[str, Floats]:
    """Return the columns by name, shape [p] each; interval ends and bounds have only their last value per bucket."""
    columns: dict[str, Floats] = {
        "t (Unix s)": past.start_s.astype(np.float64),
        "width (s)": past.width_s.astype(np.float64),
    }
    for name in past.names:
        course, unit = past.column(name), unit_of(name)
        columns[f"{name} ({unit})"] = course.last
        if name.endswith((".lo", ".hi", ".bound")):
            continue
        columns[f"{name} low ({unit})"] = course.low
        columns[f"{name} high ({unit})"] = course.high
        columns[f"{name} n"] = course.n.astype(np.float64)
    for i, name in enumerate(COUNTS):
        columns[f"{name} (samples)"] = past.counts[:, i].astype(np.float64)
    columns[STATE_COLUMN_NAME] = past.state.astype(np.float64)
    return columns


def unit_of(name: str) -> str:
    """Return the SI unit of a column of a history row.

    >>> unit_of("gz.N.lo"), unit_of("az.sigma.0.1"), unit_of("rate")
    ('rad/sqrt(s)', 'm/s^2', 'Hz')
    """
    axis, _, rest = name.partition(".")
    return COEFFICIENT_SI_UNITS[sensor_kind(axis)][rest.split(".")[0]] if rest else STATUS_UNITS[name]
