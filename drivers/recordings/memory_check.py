"""Limits on the size of a recording, so that reading a file cannot exhaust the memory.

Each reader checks the number of samples before allocating memory. Checking the file size is not sufficient, because a
compressed file of a few megabytes can unpack to gigabytes.

These limits apply (docs/reference/limits.md):

- The samples and the copies made during an analysis must fit into the available memory.
- Reading a file takes at most 500 MB, or 32 bytes per byte on disk if this is more. The file therefore contains at most
  ``MIN_ROW_LIMIT`` rows, or one row for each ``MIN_BYTES_PER_ROW`` bytes on disk. Content that is held as a whole while
  it is read has at most ``MIN_HELD_LIMIT_BYTES``, or ``MAX_HELD_RATIO`` times the size on disk.
- The unpacked size is at most ``MIN_UNPACKED_LIMIT_BYTES`` or ``MAX_UNPACKING_RATIO`` times the size on disk, whichever
  is more.
- A file contains at most ``MAX_COLUMNS`` columns.
"""

import os
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.errors import ConfigError, RecordingError

MEMINFO: Final = Path("/proc/meminfo")
CGROUPS: Final = Path("/sys/fs/cgroup")
OWN_CGROUPS: Final = Path("/proc/self/cgroup")
STATM: Final = Path("/proc/self/statm")

COPIES: Final = 3.0
"""Minimum number of copies of the samples that an analysis keeps in memory."""
ROW_BYTES: Final = 64
"""Size in bytes of one sample in memory. A sample consists of the time, six axes and the temperature as float64."""
MIN_ROW_LIMIT: Final = 2_800_000
MIN_BYTES_PER_ROW: Final = 4
"""Minimum size of a row on disk, in a file with more than MIN_ROW_LIMIT rows. Quantized noise of seven columns, whose
standard deviation is one quantization step, needs 6.2 bytes in a compressed .npz file."""
MIN_HELD_LIMIT_BYTES: Final = 250_000_000
MAX_HELD_RATIO: Final = 16
MIN_UNPACKED_LIMIT_BYTES: Final = 2_000_000_000
MAX_UNPACKING_RATIO: Final = 100
MAX_COLUMNS: Final = 10_000


@dataclass(frozen=True, slots=True)
class RecordingSizeLimits:
    """Limits on the size of one file or one folder."""

    path: Path
    size_bytes: int  # size on disk
    free: int | None  # available memory in bytes; None if unknown

    def check_row_count(self, rows: int) -> None:
        """Raise an error if a recording has too many samples to be read.

        Raises
        ------
        RecordingError
            If the file is too small for this number of measured samples.
        ConfigError
            If the samples do not fit into the available memory.
        """
        if rows > max(MIN_ROW_LIMIT, self.size_bytes // MIN_BYTES_PER_ROW):
            raise RecordingError(
                f"{self.path}: at least {rows} rows in a file of {self.size_bytes} bytes are not measured samples; "
                f"the limit is {MIN_ROW_LIMIT} rows, or one row per {MIN_BYTES_PER_ROW} bytes in a larger file; "
                "if they are measured, split the file or store it without compression"
            )
        self.check_needed_memory(COPIES * rows * ROW_BYTES)

    def check_needed_memory(self, needed_bytes: float) -> None:
        """Raise ConfigError if a recording needs more memory in bytes than is available."""
        if self.free is not None and needed_bytes > self.free:
            raise ConfigError(
                f"{self.path}: more than {needed_bytes / 1e9:.1f} GB of memory would be needed, "
                f"{self.free / 1e9:.1f} GB are free; read the end of a folder with --last 1d, or split the file"
            )

    def check_held_size(self, held_bytes: int) -> None:
        """Raise RecordingError if the unpacked content that is held in memory is too large for the file."""
        if held_bytes > max(MIN_HELD_LIMIT_BYTES, MAX_HELD_RATIO * self.size_bytes):
            raise RecordingError(
                f"{self.path}: unpacks to more than {held_bytes / 1e6:.0f} MB from {self.size_bytes / 1e6:.1f} MB; "
                f"the limit is {MIN_HELD_LIMIT_BYTES / 1e6:g} MB, or {MAX_HELD_RATIO} times the size of the file; "
                "split the file or store it without compression"
            )
        self.check_needed_memory(COPIES * held_bytes)

    def check_unpacked_size(self, unpacked_bytes: int) -> None:
        """Raise RecordingError if the unpacked data exceed the size limit."""
        if unpacked_bytes > max(MIN_UNPACKED_LIMIT_BYTES, MAX_UNPACKING_RATIO * self.size_bytes):
            raise RecordingError(
                f"{self.path}: unpacks to more than {unpacked_bytes / 1e9:.1f} GB from {self.size_bytes / 1e6:.1f} MB; "
                f"the limit is {MIN_UNPACKED_LIMIT_BYTES / 1e9:g} GB, or {MAX_UNPACKING_RATIO} times the size of the "
                "file; unpack the file and check its content"
            )


def measure_read_limit(path: Path) -> RecordingSizeLimits:
    """Return the size limits of a file. Raise OSError if the file does not exist."""
    return RecordingSizeLimits(path, path.stat().st_size, available_bytes())


def available_bytes() -> int | None:
    """Return the memory in bytes that is available to this process, or None if unknown.

    The result is the minimum of the available system memory, the control group limit and the resource limit
    (``ulimit``).
    """
    stated = (available_system_bytes(), available_cgroup_bytes(), available_rlimit_bytes())
    known = [n for n in stated if n is not None]
    return max(min(known), 0) if known else None


def available_system_bytes(meminfo: Path = MEMINFO) -> int | None:
    """Return the available memory of the system in bytes, or None if unknown."""
    found = _parse_fields(meminfo, ":").get("MemAvailable")
    return None if found is None else 1024 * found


def available_cgroup_bytes(own: Path = OWN_CGROUPS, root: Path = CGROUPS) -> int | None:
    """Return the memory in bytes that the control groups of this process still allow, or None if there is no limit.

    The page cache counts as available memory, because the kernel can free it at any time.

    Parameters
    ----------
    own
        File that lists the control groups of the process.
    root
        Folder where the control group file system is mounted.
    """
    left = [n for folder in _cgroup_folders(own, root) if (n := _left_in_cgroup(folder)) is not None]
    return min(left) if left else None


def available_rlimit_bytes(statm: Path = STATM) -> int | None:
    """Return the memory in bytes that the resource limits of this process still allow, or None if there is no limit."""
    try:
        pages = [int(n) for n in statm.read_text().split()]
    except (OSError, ValueError):
        return None
    page = resource.getpagesize()
    taken = ((resource.RLIMIT_AS, pages[0]), (resource.RLIMIT_DATA, pages[5])) if len(pages) > 5 else ()
    limits = [(resource.getrlimit(kind)[0], page * used) for kind, used in taken]
    left = [limit - used for limit, used in limits if limit != resource.RLIM_INFINITY]
    return min(left) if left else None


def _cgroup_folders(own: Path, root: Path) -> Iterator[Path]:
    """Yield the folders of all control groups that limit the memory of this process, including parent groups."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, name = rest.partition(":")
        if controllers and "memory" not in controllers.split(","):
            continue
        base = root / "memory" if controllers else root
        folder = Path(os.path.normpath(f"{base}/{name}"))
        while folder.is_relative_to(base):
            yield folder
            folder = folder.parent


def _left_in_cgroup(folder: Path) -> int | None:
    """Return the memory in bytes that is available in a control group (version 1 or 2), or None without a limit."""
    for limit, usage, prefix in (
        ("memory.max", "memory.current", ""),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
    ):
        try:
            most, used = int((folder / limit).read_text()), int((folder / usage).read_text())
        except (OSError, ValueError):  # the file does not exist or contains "max"
            continue
        cached = _parse_fields(folder / "memory.stat", " ")
        return most - used + sum(cached.get(f"{prefix}{kind}_file", 0) for kind in ("active", "inactive"))
    return None


def _parse_fields(path: Path, separator: str) -> dict[str, int]:
    found: dict[str, int] = {}
    try:
        lines = path.read_text().splitlines()
    except OSError:
        return found
    for line in lines:
        name, _, value = line.partition(separator)
        digits = value.split()[:1]
        if digits and digits[0].isdecimal():
            found[name] = int(digits[0])
    return found
