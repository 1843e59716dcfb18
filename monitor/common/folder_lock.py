"""Advisory lock on a storage folder, which prevents two processes from writing the same files.

The lock is ``flock`` on a lock file in the folder, so the operating system releases the lock at the end of the process.
The lock file contains the process id and the host name of the lock holder. Readers need no lock.

Several processes of one daemon share the lock: each of them holds a shared lock, and the file names the daemon.

A process loses the lock if the folder or the lock file is deleted or replaced. Child processes do not inherit the lock.
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

from drivers.host.safe_file_reading import FILE_KINDS, check_folder_or_absent

RECORDING_LOCK: Final = "recording.lock"
HISTORY_LOCK: Final = "history.lock"
LOCKS_UNSUPPORTED_ERRNOS: Final = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)
"""Error numbers of ``flock`` on a file system that does not support locks."""
RETRY_S: Final = 0.05
"""Pause before the second attempt, because the ``doctor`` command holds the lock for a short time."""
HOLDER_BYTES: Final = 300
"""Maximum length of the text in the lock file."""


class FolderLock:
    """Lock on a folder for one purpose, such as recordings or history.

    Parameters
    ----------
    folder : Path
        Folder to lock. ``ensure_held`` creates the folder if necessary.
    name : str
        Name of the lock file in the folder.
    owner_pid : int, optional
        Process id of the daemon that owns the lock. By default, that of this process.
    """

    def __init__(self, folder: Path, name: str, owner_pid: int | None = None) -> None:
        self.folder = folder
        self.path = folder / name
        self.warning = ""
        """Warning if the file system does not support locks, otherwise an empty string."""
        self._descriptor: int | None = None
        self._owner_pid = owner_pid

    def ensure_held(self) -> str:
        """Acquire the lock without waiting, or check that this process still holds the lock.

        Returns
        -------
        str
            Empty string if this process holds the lock, otherwise a message that names the lock holder.

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
                self._descriptor = descriptor
                return ""
            return f"{self.folder}: in use by {_holder(descriptor)}"
        finally:
            if self._descriptor != descriptor:
                os.close(descriptor)

    @property
    def is_held(self) -> bool:
        """True if the last call of ``ensure_held`` acquired or confirmed the lock."""
        return self._descriptor is not None

    def release(self) -> None:
        """Release the lock. The lock file is not deleted."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _in_place(self, descriptor: int) -> bool:
        """Return True if the open lock file has not been deleted or replaced."""
        try:
            return os.path.samestat(os.stat(self.path, follow_symlinks=False), os.fstat(descriptor))
        except OSError:
            return False

    def _lock(self, descriptor: int) -> bool:
        """Try to lock the lock file. Return True on success, or if the file system does not support locks."""
        self.warning = ""
        owner = _format_holder(self._owner_pid or os.getpid())
        for wait_s in (RETRY_S, 0.0):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _write_holder(descriptor, owner)
                if self._owner_pid is not None:
                    fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                if self._owner_pid is not None and _shares_lock(descriptor, owner):
                    return True
                time.sleep(wait_s)
            except OSError as error:
                if error.errno not in LOCKS_UNSUPPORTED_ERRNOS:
                    raise
                _write_holder(descriptor, owner)
                self.warning = (
                    f"{self.folder}: this file system has no locks ({error.strerror}); make sure that no other "
                    f"imu-monitor uses the folder"
                )
                return True
            else:
                return True
        return False


def describe_lock_holder(folder: Path, name: str) -> str:
    """Return the name of the process that holds the lock of a folder.

    Parameters
    ----------
    folder : Path
        Locked folder.
    name : str
        Name of the lock file in the folder. The lock file is not created.

    Returns
    -------
    str
        Process and host of the lock holder. Empty if the lock is free or cannot be checked.
    """
    try:
        descriptor = os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return ""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
        If the lock file cannot be opened, or is not a regular file.
    """
    # O_RDWR: NFS locks only files that are open for writing; O_NONBLOCK: opening a FIFO must not block
    flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(path, flags, 0o644)
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        kind = FILE_KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(errno.EINVAL, f"{path.name} in it is {kind}, not a regular file", str(path))
    return descriptor


def _shares_lock(descriptor: int, owner: bytes) -> bool:
    """Return True if another process of the same daemon holds the lock, which is then shared."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    if os.pread(descriptor, HOLDER_BYTES, 0) == owner:
        return True
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return False


def _format_holder(pid: int) -> bytes:
    return f"{pid} {socket.gethostname()}\n".encode(errors="replace")


def _write_holder(descriptor: int, owner: bytes) -> None:
    # on a full disk, the lock works without the name of the lock holder
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, owner, 0)


def _holder(descriptor: int) -> str:
    words = os.pread(descriptor, HOLDER_BYTES, 0).decode(errors="replace").split()
    if len(words) != 2 or not words[0].isdecimal():
        return "another process"
    host = "" if words[1] == socket.gethostname() else f" on {words[1]}"
    return f"process {words[0]}{host}"
