"""Export of the stored results of a device as a table in CSV, Parquet, Arrow or .npz format.

Each row is a time interval (bucket), and each column is a quantity in SI units. Column names contain the unit in ASCII,
as in ``gz.N (rad/sqrt(s))``. The smallest and largest values of ``gz.N`` are in the columns ``gz.N low`` and ``gz.N
high``. If the export fails, no incomplete file remains.
"""

from pathlib import Path
from typing import Final

import numpy as np

from drivers.data_types import Floats
from drivers.recordings.formats import find_writer
from drivers.recordings.writing import atomic_write_path
from monitor.common.unit_formatting import sensor_kind
from monitor.history.bucketed_history import HistoryTable
from monitor.history.history_row import COUNTS, STATES
from monitor.publishing.exporters.export_input import ascii_unit

STATUS_UNITS: Final = {"rate": "Hz", "latency": "s", "memory": "B", "temperature": "degC"}
STATE_COLUMN_NAME: Final = "state (" + "; ".join(f"{i} {name}" for i, name in enumerate(STATES)) + ")"


def save_history(past: HistoryTable, path: Path) -> None:
    """Write the stored results of a device to a file. The suffix of the file selects the format.

    Parameters
    ----------
    past
        Stored history of the device.
    path
        File to write, with a suffix such as .csv or .parquet.

    Raises
    ------
    ConfigError
        If the suffix is unknown or the file cannot be written.
    """
    columns = history_columns(past)
    begin = find_writer(path, any_columns=True)
    with atomic_write_path(path) as part, begin(part, list(columns)) as append:
        append(columns)


def history_columns(past: HistoryTable) -> dict[str, Floats]:
    """Return all columns of the exported table by name, each of shape [p]."""
    columns: dict[str, Floats] = {
        "t (Unix s)": past.start_s.astype(np.float64),
        "width (s)": past.width_s.astype(np.float64),
    }
    for name in past.names:
        course, unit = past.select_column(name), _column_unit(name)
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


def _column_unit(name: str) -> str:
    """Return the SI unit of a stored column in ASCII.

    >>> _column_unit("gz.N.lo"), _column_unit("az.sigma.0.1"), _column_unit("rate")
    ('rad/sqrt(s)', 'm/s^2', 'Hz')
    """
    axis, _, rest = name.partition(".")
    if not rest:
        return STATUS_UNITS[name]
    quantity = rest.split(".")[0]
    return ascii_unit("B" if quantity == "sigma" else quantity, sensor_kind(axis))  # σ has the unit of B
