"""Checks whether other users of the machine can change or read configuration files.

A user who can change a configuration file can run commands as the user of the service. The group of a file is trusted,
because many systems have one group per user. Without POSIX permissions, files are not checked.
"""

import os
import stat
from pathlib import Path
from typing import Final

from drivers.host.safe_file_reading import open_regular_file, real_path
from drivers.secret_masking import has_secret

MAX_SECRET_FILE_BYTES: Final = 1_000_000
"""Number of bytes at the start of a file that are searched for a secret."""


def explain_untrusted_file(path: Path) -> str:
    """Return a message if other users can change or replace a file, otherwise an empty string."""
    real = real_path(path)
    if _others_may(real, stat.S_IWOTH):
        return f"anyone on this machine may change it, and with it what the daemon runs: chmod o-w {real}"
    folder = real.parent
    if _others_may(folder, stat.S_IWOTH) and not _mode(folder) & stat.S_ISVTX:
        return f"anyone on this machine may put another file in its place: chmod o-w {folder}"
    return ""


def describe_exposed_secret(path: Path, is_secret: bool | None = None) -> str:
    """Return a warning if all users can read a secret in a file, otherwise an empty string.

    Parameters
    ----------
    path
        File to check.
    is_secret
        True if the whole file is secret, such as a private key. By default, the file is searched for secrets.
    """
    real = real_path(path)
    if not _others_may(real, stat.S_IROTH) or not _is_reachable(real):
        return ""
    if contains_secret(real) if is_secret is None else is_secret:
        return f"holds a secret that anyone on this machine may read: chmod o-r {real}"
    return ""


def contains_secret(path: Path) -> bool:
    """Return True if a file probably contains a password or a private key."""
    try:
        with open_regular_file(path) as file:
            return has_secret(file.read(MAX_SECRET_FILE_BYTES).decode("utf-8", "replace"))
    except OSError:  # the reader of the file reports the error
        return False


def _others_may(path: Path, permission: int) -> bool:
    return os.name == "posix" and bool(_mode(path) & permission)


def _is_reachable(path: Path) -> bool:
    """Return True if other users can access all parent folders of a file."""
    return all(_mode(folder) & stat.S_IXOTH for folder in path.parents)


def _mode(path: Path) -> int:
    """Return the permission bits of a file, or 0 if the file does not exist."""
    try:
        return path.stat().st_mode
    except OSError:
        return 0
