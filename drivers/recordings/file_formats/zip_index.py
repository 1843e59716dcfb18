"""Protection against zip archives whose index does not fit into memory."""

import zipfile
from io import FileIO
from typing import Final

MAX_INDEX_BYTES: Final = 4_000_000
"""Maximum size in bytes of the index of an archive, enough for about 50 000 files."""


class IndexSizeLimitedFile(FileIO):
    """File that raises an error if more than MAX_INDEX_BYTES are read at once.

    ``zipfile`` reads the whole index at once and uses about ten times as much memory as the size of the index.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to ``size`` bytes from the file."""
        if size is not None and size > MAX_INDEX_BYTES:
            raise zipfile.BadZipFile(f"the index has {size} bytes, expected at most {MAX_INDEX_BYTES}")
        return super().read(size) or b""
