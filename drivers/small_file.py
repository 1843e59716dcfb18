"""Files that people write, read whole: a configuration, a model, a CAN database. None is large, and a device that never
ends is none.
"""

import errno
import os
from pathlib import Path
from typing import Final

MOST_BYTES: Final = 32_000_000
"""The largest CAN databases of whole vehicles have some megabytes."""


def path(name: str) -> Path:
    """What people write for a file; ``~`` is somebody's home, where there is such a person."""
    return Path(os.path.expanduser(name))


def is_file(path: Path) -> bool:
    """Whether it is there; false too for a name that no file can have, where pathlib raises for some."""
    return os.path.isfile(path)


def read(path: Path) -> bytes:
    """All of a file.

    Raises:
        OSError: it cannot be read, or is larger than MOST_BYTES
    """
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"more than {MOST_BYTES // 1_000_000} MB", str(path))
    return data
