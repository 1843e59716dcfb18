"""Advisory lock on a storage folder: one process at a time writes recordings there, and one writes the history.

The lock is ``flock`` on a file in the folder. The operating system releases the lock when the process that holds the
lock ends. The file is never deleted. It contains the process id and the host of the holder, for messages. Readers need
no lock.

``ensure_held`` takes the lock, or checks that this process still holds the lock. If the folder or the lock file is
deleted or replaced, the lock is lost. The file descriptor is closed when another program is executed, so hooks and
viewers do not inherit it.
"""

import contextlib
import errno
import fcntl
import os
import socket
import stat
import time
from pathlib import Path
from typing import Final

from drivers.file_access import FILE_KINDS, check_folder_or_absent

RECORDING_LOCK: Final = "recording.lock"
HISTORY_LOCK: Final = "history.lock"
LOCKS_UNSUPPORTED_ERRNOS: Final = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)
"""Error numbers of ``flock`` on a file system without locks."""
RETRY_S: Final = 0.05
"""Pause before the second attempt, because the command ``doctor`` briefly holds the lock during its check."""
HOLDER_BYTES: Final = 300
"""Largest length of the text about the holder in the lock file."""


class FolderLock:
    """Lock of a folder for one purpose: recordings or history.

    Parameters
    ----------
    folder : Path
        Folder to lock. ``ensure_held`` creates it if it does not exist.
    name : str
        Name of the lock file in the folder.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.path = folder / name
        self.warning = ""
        """Message if the file system does not support locks, so that the folder is used without a lock; else empty."""
        self._descriptor: int | None = None

    def ensure_held(self) -> str:
        """Take the lock, or check that this process still holds it. The method does not wait for another holder.

        Returns
        -------
        str
            "" if the lock is held, else one line that names the process that holds it.

        Raises
        ------
        OSError
            If the folder or the lock file cannot be created or opened.
        """
        if self._descriptor is not None:
            if self._in_place(self._descriptor):
                return ""
            self.release()
        check_folder_or_absent(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        descriptor = _open_lock_file(self.path)
        try:
            free = self._lock(descriptor)
            if free and self._in_place(descriptor):
                _write_holder(descriptor)
                self._descriptor = descriptor
                return ""
            return f"{self.folder}: in use by {_holder(descriptor)}"
        finally:
            if self._descriptor != descriptor:
                os.close(descriptor)

    @property
    def is_held(self) -> bool:
        """True if the lock was held at the last call of ``ensure_held``."""
        return self._descriptor is not None

    def release(self) -> None:
        """Release the lock. The lock file is not deleted."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _in_place(self, descriptor: int) -> bool:
        """Return True if the open lock file is still the file of that name in the folder."""
        try:
            return os.path.samestat(os.stat(self.path, follow_symlinks=False), os.fstat(descriptor))
        except OSError:
            return False

    def _lock(self, descriptor: int) -> bool:
        """Try to lock the file; return True if it succeeds, or if the file system has no locks."""
        self.warning = ""
        for wait_s in (RETRY_S, 0.0):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(wait_s)
            except OSError as error:
                if error.errno not in LOCKS_UNSUPPORTED_ERRNOS:
                    raise
                self.warning = (
                    f"{self.folder}: this file system has no locks ({error.strerror}); make sure that no other "
                    f"imu-monitor uses the folder"
                )
                return True
            else:
                return True
        return False


def describe_lock_holder(folder: Path, name: str) -> str:
    """Return a text that names the holder of a folder's lock.

    Parameters
    ----------
    folder : Path
        Locked folder.
    name : str
        Name of the lock file in the folder. It is not created.

    Returns
    -------
    str
        "" if the lock is free, or if its state cannot be determined.
    """
    try:
        descriptor = os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return ""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _holder(descriptor)
    except OSError:
        return ""
    else:
        return ""
    finally:
        os.close(descriptor)


def _open_lock_file(path: Path) -> int:
    """Open or create the lock file.

    Raises
    ------
    OSError
        If the file cannot be opened, or if it is not a regular file.
    """
    # NFS locks only files that are open for writing. Without O_NONBLOCK, opening a FIFO would block.
    flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(path, flags, 0o644)
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        kind = FILE_KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(errno.EINVAL, f"{path.name} in it is {kind}, not a regular file", str(path))
    return descriptor


def _write_holder(descriptor: int) -> None:
    """Write the process id and the host name into the lock file."""
    # on a full disk the lock still works, but its holder has no name
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()} {socket.gethostname()}\n".encode(errors="replace"), 0)


def _holder(descriptor: int) -> str:
    """Return the name of the holder, as read from the lock file."""
    words = os.pread(descriptor, HOLDER_BYTES, 0).decode(errors="replace").split()
    if len(words) != 2 or not words[0].isdecimal():
        return "another process"
    host = "" if words[1] == socket.gethostname() else f" on {words[1]}"
    return f"process {words[0]}{host}"
