"""How long recordings are kept: by age, and by how full the disk is. Deletes segments, the oldest first."""

import shutil
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

from drivers.recordings import segment

NEWEST_KEPT: Final = 2
"""Segments of a folder that are never deleted: the window is rebuilt from them."""


def delete_old(folders: Sequence[Path], keep_s: float, segment_s: float) -> None:
    """Delete segments that ended more than ``keep_s`` before the newest of their folder began.

    Two clocks have to say so: the times in the names, and how many segments of ``segment_s`` at most came after. The
    first alone would delete a year for a host's clock that is set wrong once, the second for many short segments.
    """
    for folder in folders:
        known = segment.segments(folder)
        for at, (path, after) in enumerate(pairwise(known[: 1 - NEWEST_KEPT])):
            by_name_s = segment.began_s(known[-1]) - segment.began_s(after)  # it ended where the next began
            by_number_s = (len(known) - 1 - at) * segment_s
            if min(by_name_s, by_number_s) > keep_s:
                _delete(path)


def make_room(folder: Path, folders: Sequence[Path], share: float) -> str:
    """Delete the oldest segments while more than ``share`` of the disk of ``folder`` is taken.

    Returns "" where there is room then, else in a sentence why not.
    """
    if not folder.is_dir():
        return ""
    olds: deque[Path] | None = None
    while (taken := taken_share(folder)) > share:
        if olds is None:
            every = [path for one in folders for path in segment.segments(one)[:-NEWEST_KEPT]]
            olds = deque(sorted(every, key=segment.began_s))
        if not olds:
            return (
                f"{folder}: the disk is {100 * taken:.4g} % full, disk_share allows {100 * share:.4g} %, and no older "
                f"segment is left to delete; recording stopped"
            )
        _delete(olds.popleft())
    return ""


def _delete(path: Path) -> None:
    """Delete a file; a directory that has the name of a segment stays."""
    if not path.is_dir() or path.is_symlink():
        path.unlink(missing_ok=True)


def taken_share(folder: Path) -> float:
    """Of the disk, as seen by whoever is not root."""
    usage = shutil.disk_usage(folder)
    return 1.0 - usage.free / usage.total
