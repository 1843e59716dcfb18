"""Check for rows that are missing in a recording."""

from collections.abc import Mapping

import numpy as np

from drivers.data_types import Floats
from monitor.reconcile.result import ParameterInterval, RecordingFinding


def check_missing_rows(values: Mapping[str, Floats], rate_hz: float) -> list[RecordingFinding]:
    """Report rows that are missing on all axes.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        Samples of each axis on a regular grid; NaN means missing.
    rate_hz : float
        Sample rate in Hz.
    """
    missing = np.logical_and.reduce([~np.isfinite(y) for y in values.values()])
    if not missing.any():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2]
    longest = int(lengths.argmax())
    begin_s, duration_s = edges[2 * longest] / rate_hz, lengths[longest] / rate_hz
    rows, holes = int(missing.sum()), lengths.size
    where = f"in one hole at {begin_s:.5g} s" if holes == 1 else f"in {holes} holes, the longest at {begin_s:.5g} s"
    return [
        RecordingFinding(
            "missing_rows",
            tuple(values),
            f"{rows} of {missing.size} rows are missing {where} for {duration_s:.3g} s. "
            f"The missing samples were replaced by draws from their neighbourhood.",
            {"time": ParameterInterval(begin_s), "duration": ParameterInterval(duration_s)},
            {"rows": float(rows), "holes": float(holes), "share": rows / missing.size},
            corrected=True,
        )
    ]
