"""Deletion of old segments by age and by disk usage."""

import shutil
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

from drivers.recordings import segment_file

MIN_KEPT_SEGMENTS: Final = 2
"""Number of newest segments in a folder that are kept to rebuild the window."""


def delete_old_segments(folders: Sequence[Path], keep_s: float, segment_s: float) -> None:
    """Delete segments that ended more than ``keep_s`` seconds before the start of the newest segment.

    Two estimates of the age must both exceed ``keep_s``: the difference of the times in the file names, and
    ``segment_s`` times the number of later segments. The second estimate protects segments if the host clock was wrong.

    Parameters
    ----------
    folders : sequence of Path
        Folders of segments.
    keep_s : float
        Maximum age of segments in seconds.
    segment_s : float
        Maximum length of a segment in seconds.
    """
    for folder in folders:
        known = segment_file.list_segments(folder)
        for at, (path, after) in enumerate(pairwise(known[: 1 - MIN_KEPT_SEGMENTS])):
            end_s = segment_file.parse_segment_start_s(after)  # a segment ends at the start of the next segment
            by_name_s = segment_file.parse_segment_start_s(known[-1]) - end_s
            by_number_s = (len(known) - 1 - at) * segment_s
            if min(by_name_s, by_number_s) > keep_s:
                _delete(path)


def delete_until_free(disk_folder: Path, segment_folders: Sequence[Path], max_used_share: float) -> str:
    """Delete the oldest segments until at most ``max_used_share`` of the disk is in use.

    Parameters
    ----------
    disk_folder : Path
        Folder on the disk. If the folder does not exist, no segment is deleted.
    segment_folders : sequence of Path
        Folders of segments.
    max_used_share : float
        Maximum fraction of the disk that may be in use, from 0 to 1.

    Returns
    -------
    str
        Error message, or "" if at most ``max_used_share`` is in use.
    """
    if not disk_folder.is_dir():
        return ""
    olds: deque[Path] | None = None
    while (taken := used_disk_share(disk_folder)) > max_used_share:
        if olds is None:
            every = [path for one in segment_folders for path in segment_file.list_segments(one)[:-MIN_KEPT_SEGMENTS]]
            olds = deque(sorted(every, key=segment_file.parse_segment_start_s))
        if not olds:
            return (
                f"{disk_folder}: the disk is {100 * taken:.4g} % full, disk_share allows {100 * max_used_share:.4g} %, "
                f"and no older segment is left to delete; recording stopped"
            )
        _delete(olds.popleft())
    return ""


def _delete(path: Path) -> None:
    if not path.is_dir() or path.is_symlink():
        path.unlink(missing_ok=True)


def used_disk_share(folder: Path) -> float:
    """Return the fraction of the disk of a folder that is in use, from 0 to 1, for users other than root."""
    usage = shutil.disk_usage(folder)
    return 1.0 - usage.free / usage.total
