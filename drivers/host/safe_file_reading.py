"""Safe functions for opening and reading files that are named by users or found in folders.

``open_regular_file`` raises an error, and never blocks, if the path is a FIFO, a socket, a device or a directory.
``read_small_file`` reads a complete small file, such as a configuration, a model or a CAN database.
"""

import errno
import os
import stat
from pathlib import Path
from typing import IO, Final

MAX_BYTES: Final = 32_000_000
"""Maximum size of a file for ``read_small_file``. CAN databases of complete vehicles are a few megabytes in size."""
FILE_KINDS: Final = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a directory",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}
"""Names of file types other than regular files, for error messages."""


def expand_user(name: str) -> Path:
    """Replace a leading ``~`` or ``~user`` with the home folder, and return the path."""
    return Path(os.path.expanduser(name))


def real_path(path: Path) -> Path:
    """Return the absolute path without symbolic links.

    Unlike ``Path.resolve``, this function raises no error if symbolic links form a loop.
    """
    return Path(os.path.realpath(path))


def is_file(path: Path) -> bool:
    """Return True if the path is an existing file. Unlike ``Path.is_file``, return False for an invalid name."""
    return os.path.isfile(path)


def open_regular_file(path: Path) -> IO[bytes]:
    """Open a regular file for reading. Symbolic links are followed.

    Parameters
    ----------
    path
        Name of the file.

    Returns
    -------
    IO[bytes]
        Buffered binary file. Child processes do not inherit the descriptor.

    Raises
    ------
    OSError
        If the file cannot be opened or is not a regular file. The attribute ``strerror`` contains the reason without
        the path.
    """
    check_regular_file(path)  # opening a device file may have side effects
    # The file may be replaced after the first check, so open it without blocking and check it again.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        _check_mode(path, os.fstat(descriptor).st_mode)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_regular_file(path: Path) -> None:
    """Check that a path is a regular file, before a library opens the file.

    The check does not open the file, since closing another file descriptor would release the locks of SQLite.

    Raises
    ------
    OSError
        If the file does not exist or is not a regular file. The attribute ``strerror`` contains the reason without the
        path.
    """
    try:
        mode = os.stat(path).st_mode
    except ValueError as error:  # the name contains a NUL character
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    _check_mode(path, mode)


def check_folder_or_absent(path: Path) -> None:
    """Raise OSError if the path exists and is not a folder."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(mode):
        kind = FILE_KINDS.get(stat.S_IFMT(mode), "a file")
        raise OSError(errno.ENOTDIR, f"is {kind}, not a folder", str(path))


def read_small_file(path: Path, *, allow_pipe: bool = False) -> bytes:
    """Read a whole small file.

    Parameters
    ----------
    path
        Name of the file.
    allow_pipe
        True if the path may also be a pipe, such as ``/dev/stdin`` or ``<(command)``. Reading from a pipe blocks until
        the other program closes it.

    Returns
    -------
    bytes
        Content of the file.

    Raises
    ------
    OSError
        If the file cannot be read, is not a regular file, or is larger than MAX_BYTES.
    """
    with path.open("rb") if allow_pipe and _is_fifo(path) else open_regular_file(path) as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise OSError(errno.EFBIG, f"more than {MAX_BYTES // 1_000_000} MB", str(path))
    return data


def _is_fifo(path: Path) -> bool:
    try:
        return stat.S_ISFIFO(os.stat(path).st_mode)
    except (OSError, ValueError):  # the error is reported when the file is read
        return False


def _check_mode(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = FILE_KINDS.get(stat.S_IFMT(mode), "something else")
        number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
        raise OSError(number, f"is {kind}, not a regular file", str(path))
