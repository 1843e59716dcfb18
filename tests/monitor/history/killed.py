"""A writer that is to be killed: rows of a device, thinned as they get old, until it is. ``python -m … FILE FIRST``.

Row i has the sums that ``row_of`` says, so whoever opens the file afterwards knows what must be in it: the rows that
were acknowledged on standard output, and perhaps one that was not any more.
"""

import sys
from pathlib import Path

import numpy as np

from monitor.history import sqlite_store as stores
from monitor.history.history_row import HistoryRow
from monitor.history.sqlite_store import HistoryFileWriter
from monitor.history.stored_events import StoredEvent

T0 = 1_760_400_000  # a multiple of all widths
NAMES = ("gz.N", "rate")
LEVELS = ((60, 40 * 60), (900, 4 * 3600), (21_600, None))
"""Ages so short that every other row has something thinned."""


def row_of(i: int) -> HistoryRow:
    """Minute i: n = i + 1, counts = (i, 1, 2, 3), extremes that come from i alone."""
    low, high = (np.float32(1000.0 + s * (i * 7919 % 1009)) for s in (-0.5, 0.5))
    both = np.array([low, low]), np.array([high, high])
    start_s = T0 + 60 * i
    return HistoryRow(
        start_s, 60, start_s + 59.0, NAMES, np.array([i + 1] * 2), both[0], both[1], both[1], (i, 1, 2, 3), 1
    )


def main() -> None:
    path, first = Path(sys.argv[1]), int(sys.argv[2])
    stores.LEVELS = LEVELS  # type: ignore[misc, assignment]
    store = HistoryFileWriter(path)
    i = first
    while True:
        store.write_rows_and_events(
            [("bench-1", row_of(i))], [("bench-1", StoredEvent(T0 + 60.0 * i, "moved", f"event {i}"))]
        )
        print(i, flush=True)
        store.merge_old_rows(float("inf"), 5)
        i += 1


if __name__ == "__main__":
    main()
