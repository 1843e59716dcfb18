"""Finding reported by the ``doctor`` command, and checks used by several of its parts."""

import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from monitor.settings.file_permissions import contains_secret

Mark = Literal["well", "doubt", "wrong"]


@dataclass(frozen=True, slots=True)
class DoctorFinding:
    """Result of one check of the machine or the configuration."""

    mark: Mark
    about: str
    text: str
    do: str = ""  # advice; empty if no action is needed


well, doubt, wrong = partial(DoctorFinding, "well"), partial(DoctorFinding, "doubt"), partial(DoctorFinding, "wrong")


def worst_mark(findings: Iterable[DoctorFinding]) -> Mark:
    """Return the most severe mark among all findings."""
    marks = {one.mark for one in findings}
    return "wrong" if "wrong" in marks else "doubt" if "doubt" in marks else "well"


def check_permissions(path: Path, about: str = "permissions", secret: bool | None = None) -> DoctorFinding:
    """Check which users may write a file, and which users may read it if it is secret.

    By default, a file is secret if it contains a password.
    """
    try:
        seen = path.stat()
    except OSError as error:
        return wrong(about, f"{path}: {error.strerror or error}")
    mode = stat.S_IMODE(seen.st_mode)
    if mode & stat.S_IWOTH:
        text = f"{path}: everyone can write it, and run commands as the user of the service"
        return wrong(about, text, f"chmod o-w {path}")
    if seen.st_uid not in (0, os.geteuid()):
        text = f"{path}: belongs to another user ({user_name(seen.st_uid)}), who can change what the service does"
        return doubt(about, text, f"chown root {path}")
    if mode & stat.S_IWGRP:
        return doubt(about, f"{path}: the group {group_name(seen.st_gid)} can write it", f"chmod g-w {path}")
    if mode & stat.S_IROTH and (contains_secret(path) if secret is None else secret):
        return wrong(about, f"{path}: everyone can read the password in it", f"chmod o-r {path}")
    return well(about, f"{path}: {mode:04o}, owner {user_name(seen.st_uid)}")


def user_name(uid: int) -> str:
    """Return the name of a user, or the number of the user if there is no name."""
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def group_name(gid: int) -> str:
    """Return the name of a group, or the number of the group if there is no name."""
    import grp

    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
