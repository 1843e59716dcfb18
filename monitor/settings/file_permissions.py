"""Who else on this machine may change or read a file that the daemon trusts.

A configuration names commands, ports and keys: whoever may write it, or swap it in its folder, runs what he likes as
the daemon. That is refused. A file with a secret in it that everyone may read is worth a warning. A group that may
write is trusted, as many systems give every user a group of his own. In come paths, out go lines for people, "" where
nothing is wrong; only the file system is asked. Where permissions are not POSIX's, nothing is said.
"""

import os
import stat
from pathlib import Path

from drivers.credential_masking import has_secret
from drivers.file_access import open_regular, real_path

SECRET_BYTES = 1_000_000
"""A larger file is no configuration, and not looked through."""


def describe_write_access(path: Path) -> str:
    """Why a file may not be trusted: anyone may write it, or put another in its place; "" where it may."""
    real = real_path(path)
    if _others(real, stat.S_IWOTH):
        return f"anyone on this machine may change it, and with it what the daemon runs: chmod o-w {real}"
    folder = real.parent
    if _others(folder, stat.S_IWOTH) and not _mode(folder) & stat.S_ISVTX:
        return f"anyone on this machine may put another file in its place: chmod o-w {folder}"
    return ""


def describe_exposed_secret(path: Path, secret: bool | None = None) -> str:
    """A file with a secret that anyone may read; "" where there is none, or nobody else may.

    Args:
        path: the file
        secret: whether it is one (a private key); None: as its text shows
    """
    real = real_path(path)
    if not _others(real, stat.S_IROTH) or not _reachable(real):
        return ""
    if has_secret(_text(real)) if secret is None else secret:
        return f"holds a secret that anyone on this machine may read: chmod o-r {real}"
    return ""


def _others(path: Path, may: int) -> bool:
    return os.name == "posix" and bool(_mode(path) & may)


def _reachable(path: Path) -> bool:
    """Whether others get as far as the file: a closed folder above it keeps them out."""
    return all(_mode(folder) & stat.S_IXOTH for folder in path.parents)


def _mode(path: Path) -> int:
    try:
        return path.stat().st_mode
    except OSError:  # whether it is there is for its reader to say
        return 0


def _text(path: Path) -> str:
    try:
        with open_regular(path) as file:
            return file.read(SECRET_BYTES).decode("utf-8", "replace")
    except OSError:
        return ""
