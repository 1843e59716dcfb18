"""Opening files by a name from a configuration, a folder or the command line.

``open_regular`` opens regular files only. A FIFO, a socket, a device or a directory in place of a file is refused with
one line, and opening never waits. ``read`` reads a small file whole: a configuration, a model, a CAN database.
"""

import errno
import os
import stat
from pathlib import Path
from typing import IO, Final

MOST_BYTES: Final = 32_000_000
"""The largest CAN databases of whole vehicles have some megabytes."""
KINDS: Final = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a directory",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}


def path(name: str) -> Path:
    """What people write for a file; ``~`` is somebody's home, where there is such a person."""
    return Path(os.path.expanduser(name))


def real_path(path: Path) -> Path:
    """Return the absolute path with symbolic links followed. A loop of links stays as it is, where pathlib raises."""
    return Path(os.path.realpath(path))


def is_file(path: Path) -> bool:
    """Whether it is there; false too for a name that no file can have, where pathlib raises for some."""
    return os.path.isfile(path)


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading; symbolic links are followed.

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
        The file cannot be opened, or is not a regular file. ``strerror`` says which, without the path.
    """
    check_regular(path)  # before anything is opened: opening a device may do something
    # the file may have been replaced since: without blocking, and checked again
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        _check_mode(path, os.fstat(descriptor).st_mode)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_regular(path: Path) -> None:
    """Check that a name belongs to a regular file, for libraries that open a file themselves.

    Nothing is opened: closing another descriptor of a file would drop the locks that SQLite holds on it.

    Raises
    ------
    OSError
        There is no such file, or it is not a regular file. ``strerror`` says which, without the path.
    """
    try:
        mode = os.stat(path).st_mode
    except ValueError as error:  # a NUL character in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    _check_mode(path, mode)


def check_folder(path: Path) -> None:
    """Check that nothing but a folder has this name; that nothing has it is fine.

    Raises
    ------
    OSError
        Something else has this name. ``strerror`` says what, without the path.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "a file")
        raise OSError(errno.ENOTDIR, f"is {kind}, not a folder", str(path))


def read(path: Path, *, pipe: bool = False) -> bytes:
    """Read a small file whole.

    Parameters
    ----------
    path
        Name of the file.
    pipe
        True if a pipe is read as well, for a name given on the command line: ``/dev/stdin`` or ``<(command)``. Opening
        and reading a pipe wait for its writer.

    Raises
    ------
    OSError
        The file cannot be read, is not a regular file, or is larger than MOST_BYTES.
    """
    with path.open("rb") if pipe and _is_fifo(path) else open_regular(path) as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"more than {MOST_BYTES // 1_000_000} MB", str(path))
    return data


def _is_fifo(path: Path) -> bool:
    try:
        return stat.S_ISFIFO(os.stat(path).st_mode)
    except (OSError, ValueError):  # the reader says what is wrong
        return False


def _check_mode(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "something else")
        number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
        raise OSError(number, f"is {kind}, not a regular file", str(path))
