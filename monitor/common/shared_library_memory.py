"""Release of the pages of a shared library that are no longer needed.

LLVM is only needed to compile or load kernels, but 70 MB of its library stay in the resident memory of the process.
Released pages are read from the file again when they are used.
"""

import ctypes
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

LLVM_LIBRARY: Final = "libllvmlite"
SMAPS: Final = Path("/proc/self/smaps")
MADV_DONTNEED: Final = 4
"""Linux value of the madvise(2) advice that the pages are not needed."""


def release_library_pages(name: str) -> None:
    """Release the resident pages of a shared library, except in mappings with modified pages.

    Outside Linux, nothing is released.

    Parameters
    ----------
    name : str
        Beginning of the file name of the library.
    """
    if not SMAPS.exists():
        return
    madvise = ctypes.CDLL(None).madvise
    for start, end in list(_find_unmodified_mappings(name, SMAPS.read_text())):
        madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), MADV_DONTNEED)


def _find_unmodified_mappings(name: str, smaps: str) -> Iterator[tuple[int, int]]:
    """Yield the first and the last address of each mapping of a library without modified pages (proc(5), smaps)."""
    for start, end, path, fields in re.findall(r"^(\w+)-(\w+) .*?(/.*)?\n((?:\w+: .*\n)*)", smaps, re.MULTILINE):
        if Path(path).name.startswith(name) and re.search(r"^Anonymous: +0 kB", fields, re.MULTILINE):
            yield int(start, 16), int(end, 16)
