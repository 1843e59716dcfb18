"""One process at a time holds a folder, whatever becomes of the process, of the lock file and of the folder."""

import errno
import fcntl
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from monitor.common.folder_lock import RECORDING_LOCK, FolderLock, describe_lock_holder

HOLDER = """
import subprocess, sys
from pathlib import Path
from monitor.common.folder_lock import FolderLock
lock = FolderLock(Path(sys.argv[1]), sys.argv[2])
assert lock.ensure_held() == ""
child = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE, close_fds=False)
print(child.pid, flush=True)
sys.stdin.read()
"""


def test_the_second_is_told_who_holds_it_and_takes_it_after_the_first(tmp_path: Path) -> None:
    first, second = FolderLock(tmp_path / "store", "a.lock"), FolderLock(tmp_path / "store", "a.lock")
    assert first.ensure_held() == ""
    assert second.ensure_held() == f"{tmp_path / 'store'}: in use by process {os.getpid()}"
    assert (first.is_held, second.is_held) == (True, False)
    assert first.ensure_held() == ""
    first.release()
    assert second.ensure_held() == ""
    assert (tmp_path / "store" / "a.lock").exists()
    second.release()


def test_each_kind_of_content_has_a_lock_of_its_own(tmp_path: Path) -> None:
    one, other = FolderLock(tmp_path, "a.lock"), FolderLock(tmp_path, "b.lock")
    assert (one.ensure_held(), other.ensure_held()) == ("", "")
    one.release()
    other.release()


def test_a_holder_that_is_killed_gives_it_back_although_a_child_lives_on(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path), "a.lock"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    child = int(process.stdout.readline())
    lock = FolderLock(tmp_path, "a.lock")
    try:
        assert f"process {process.pid}" in lock.ensure_held()
        assert describe_lock_holder(tmp_path, "a.lock") == f"process {process.pid}"
        process.kill()
        process.wait()
        os.kill(child, 0)  # it lives
        assert lock.ensure_held() == ""
        assert describe_lock_holder(tmp_path, "a.lock") == f"process {os.getpid()}"
    finally:
        process.kill()
        process.communicate()
        os.kill(child, 9)
        lock.release()
    assert describe_lock_holder(tmp_path, "a.lock") == ""


def test_looking_for_a_holder_makes_nothing(tmp_path: Path) -> None:
    assert describe_lock_holder(tmp_path / "store", "a.lock") == ""
    assert describe_lock_holder(tmp_path, "a.lock") == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("what", ["lock file", "folder", "folder renamed"])
def test_who_loses_the_file_takes_it_anew_or_says_who_has_it(what: str, tmp_path: Path) -> None:
    folder = tmp_path / "store"
    first, second = FolderLock(folder, "a.lock"), FolderLock(folder, "a.lock")
    for other_is_faster in (False, True):
        assert first.ensure_held() == ""
        match what:
            case "lock file":
                first.path.unlink()
            case "folder":
                shutil.rmtree(folder)
            case _:
                folder.rename(tmp_path / f"away{other_is_faster}")
        if other_is_faster:
            assert second.ensure_held() == ""
            assert "in use by process" in first.ensure_held()
            assert not first.is_held
        else:
            assert first.ensure_held() == ""
            assert "in use by process" in second.ensure_held()
    second.release()


@pytest.mark.parametrize("kind", ["fifo", "directory", "link"])
def test_a_lock_file_that_is_none_is_an_error_and_not_waited_for(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.lock"
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "directory":
            path.mkdir()
        case _:
            path.symlink_to(tmp_path / "elsewhere")
    lock = FolderLock(tmp_path, "a.lock")
    with pytest.raises(OSError, match=r"FIFO|directory|symbolic links"):
        lock.ensure_held()
    assert not lock.is_held
    assert not (tmp_path / "elsewhere").exists()


def test_a_file_in_place_of_the_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "store").write_text("x")
    with pytest.raises(OSError, match="is a file, not a folder"):
        FolderLock(tmp_path / "store", "a.lock").ensure_held()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_used_with_a_warning(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    lock = FolderLock(tmp_path, "a.lock")
    assert lock.ensure_held() == ""
    assert lock.is_held
    assert lock.warning.startswith(f"{tmp_path}: this file system has no locks ({os.strerror(number)})")
    assert describe_lock_holder(tmp_path, "a.lock") == ""
    lock.release()


def test_a_holder_on_another_host_is_named_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = FolderLock(tmp_path, RECORDING_LOCK)
    monkeypatch.setattr(socket, "gethostname", lambda: "bench-pc")
    assert lock.ensure_held() == ""
    monkeypatch.undo()
    assert describe_lock_holder(tmp_path, RECORDING_LOCK) == f"process {os.getpid()} on bench-pc"
    lock.path.write_text("rubbish")
    assert describe_lock_holder(tmp_path, RECORDING_LOCK) == "another process"
    lock.release()
