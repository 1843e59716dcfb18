"""Settings of the heap for programs that allocate large arrays repeatedly."""

import ctypes
import sys
from typing import Final

HEAP_SETTINGS: Final = {-1: 1 << 30, -3: 1 << 30, -8: 1}
"""Values for mallopt(3): M_TRIM_THRESHOLD and M_MMAP_THRESHOLD in bytes, and M_ARENA_MAX."""


def keep_freed_memory() -> None:
    """Keep the memory of freed arrays in the process, and use one heap for all threads.

    By default, the C library returns the memory of each large array to the system. The system clears the memory before
    it is used again, which takes longer than most operations on the array. On other systems than Linux with the GNU C
    library, nothing changes.
    """
    if sys.platform != "linux":
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        for setting, value in HEAP_SETTINGS.items():
            library.mallopt(setting, value)
