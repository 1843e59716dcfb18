"""Safe opening and reading of files whose names come from a configuration, a folder or the command line.

``open_regular`` opens regular files only. It refuses a FIFO, a socket, a device or a directory with a one-line error,
and it never blocks. ``read_small_file`` reads a whole small file, such as a configuration, a model or a CAN database.
"""

import errno
import os
import stat
from pathlib import Path
from typing import IO, Final

MAX_BYTES: Final = 32_000_000
"""Maximum size of a file that ``read_small_file`` accepts.

The largest CAN databases of whole vehicles have some megabytes.
"""
FILE_KINDS: Final = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a directory",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}
"""Names of the kinds of files that are not regular, for error messages."""


def expand_user(name: str) -> Path:
    """Return the path for a name as users write it.

    A leading ``~`` is replaced by the home folder if the user exists.
    """
    return Path(os.path.expanduser(name))


def real_path(path: Path) -> Path:
    """Return the absolute path with symbolic links followed. A loop of links is kept, where pathlib raises."""
    return Path(os.path.realpath(path))


def is_file(path: Path) -> bool:
    """Return True if the path is an existing file. Return False for an invalid name, where pathlib may raise."""
    return os.path.isfile(path)


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading. Symbolic links are followed.

    Parameters
    ----------
    path
        Name of the file.

    Returns
    -------
    IO[bytes]
        Buffered binary file. Its descriptor is closed when another program is executed.

    Raises
    ------
    OSError
        The file cannot be opened, or it is not a regular file. ``strerror`` gives the reason without the path.
    """
    check_regular(path)  # check before opening, since opening a device may have side effects
    # the file may have been replaced since: open without blocking, and check again
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        _check_mode(path, os.fstat(descriptor).st_mode)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_regular(path: Path) -> None:
    """Check that a name belongs to a regular file, for libraries that open a file themselves.

    The file is not opened. Closing another descriptor of a file would drop the locks that SQLite holds on it.

    Raises
    ------
    OSError
        There is no such file, or it is not a regular file. ``strerror`` gives the reason without the path.
    """
    try:
        mode = os.stat(path).st_mode
    except ValueError as error:  # a NUL character in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    _check_mode(path, mode)


def check_folder(path: Path) -> None:
    """Check that a path is a folder or does not exist.

    Raises
    ------
    OSError
        The path is not a folder. ``strerror`` names the kind of file, without the path.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(mode):
        kind = FILE_KINDS.get(stat.S_IFMT(mode), "a file")
        raise OSError(errno.ENOTDIR, f"is {kind}, not a folder", str(path))


def read_small_file(path: Path, *, pipe: bool = False) -> bytes:
    """Read a whole small file.

    Parameters
    ----------
    path
        Name of the file.
    pipe
        True if a pipe may be read as well, for a name given on the command line: ``/dev/stdin`` or ``<(command)``.
        Opening and reading a pipe wait for its writer.

    Returns
    -------
    bytes
        Content of the file.

    Raises
    ------
    OSError
        The file cannot be read, is not a regular file, or is larger than MOST_BYTES.
    """
    with path.open("rb") if pipe and _is_fifo(path) else open_regular(path) as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise OSError(errno.EFBIG, f"more than {MAX_BYTES // 1_000_000} MB", str(path))
    return data


def _is_fifo(path: Path) -> bool:
    """Return True if the path is a FIFO."""
    try:
        return stat.S_ISFIFO(os.stat(path).st_mode)
    except (OSError, ValueError):  # reading the file reports the error
        return False


def _check_mode(path: Path, mode: int) -> None:
    """Raise OSError if the mode is not that of a regular file."""
    if not stat.S_ISREG(mode):
        kind = FILE_KINDS.get(stat.S_IFMT(mode), "something else")
        number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
        raise OSError(number, f"is {kind}, not a regular file", str(path))
