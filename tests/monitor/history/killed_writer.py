"""A program that writes history rows until it is killed: ``python -m … FILE FIRST``.

Row i has the sums of ``make_minute_row``, so the content of the file can be checked afterwards. The file must have
all rows that were acknowledged on standard output, and possibly one more.
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
"""The ages are so short that every second row causes older rows to be merged."""


def make_minute_row(i: int) -> HistoryRow:
    """Return minute i with n = i + 1, counts = (i, 1, 2, 3) and extremes computed from i."""
    low, high = (np.float32(1000.0 + s * (i * 7919 % 1009)) for s in (-0.5, 0.5))
    extremes = np.array([low, low]), np.array([high, high])
    start_s = T0 + 60 * i
    return HistoryRow(
        start_s,
        60,
        start_s + 59.0,
        NAMES,
        np.array([i + 1] * 2),
        extremes[0],
        extremes[1],
        extremes[1],
        (i, 1, 2, 3),
        1,
    )


def main() -> None:
    path, first = Path(sys.argv[1]), int(sys.argv[2])
    stores.LEVELS = LEVELS  # type: ignore[misc, assignment]
    store = HistoryFileWriter(path)
    i = first
    while True:
        store.write_rows_and_events(
            [("bench-1", make_minute_row(i))], [("bench-1", StoredEvent(T0 + 60.0 * i, "moved", f"event {i}"))]
        )
        print(i, flush=True)
        store.merge_old_rows(float("inf"), 5)
        i += 1


if __name__ == "__main__":
    main()
