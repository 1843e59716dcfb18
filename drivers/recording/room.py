"""Whether what is read has room in memory.

The kernel ends a program that takes more than there is, and perhaps the daemon beside it.
"""

from pathlib import Path
from typing import Final

from drivers.errors import ConfigError

MEMINFO: Final = Path("/proc/meminfo")
COPIES: Final = 3.0
"""Of its samples at least, that anything made of a recording holds at once."""


def free_bytes(meminfo: Path = MEMINFO) -> int | None:
    """Memory that programs may still take; None where the system does not say."""
    try:
        lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines() if ":" in line)
        return 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError, IndexError):
        return None


def check(path: Path, needed_bytes: int, free: int | None) -> None:
    """ConfigError where so much, with what is made of it, does not fit into what was free before."""
    if free is not None and COPIES * needed_bytes > free:
        raise ConfigError(
            f"{path}: more than {COPIES * needed_bytes / 1e9:.1f} GB of memory would be needed, {free / 1e9:.1f} GB "
            f"are free; take the end of it with --last 1d, or name some of its segments"
        )
