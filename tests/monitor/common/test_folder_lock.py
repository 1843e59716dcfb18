"""Tests of the lock that gives one process at a time the use of a folder."""

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

HOLDER_PROGRAM = """
import subprocess, sys
from pathlib import Path
from monitor.common.folder_lock import FolderLock
lock = FolderLock(Path(sys.argv[1]), sys.argv[2])
assert lock.ensure_held() == ""
child = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE, close_fds=False)
print(child.pid, flush=True)
sys.stdin.read()
"""


def test_second_lock_names_the_holder_and_succeeds_after_release(tmp_path: Path) -> None:
    first, second = FolderLock(tmp_path / "store", "a.lock"), FolderLock(tmp_path / "store", "a.lock")
    assert first.ensure_held() == ""
    assert second.ensure_held() == f"{tmp_path / 'store'}: in use by process {os.getpid()}"
    assert (first.is_held, second.is_held) == (True, False)
    assert first.ensure_held() == ""
    first.release()
    assert second.ensure_held() == ""
    assert (tmp_path / "store" / "a.lock").exists()
    second.release()


def test_locks_of_different_names_are_independent(tmp_path: Path) -> None:
    first, second = FolderLock(tmp_path, "a.lock"), FolderLock(tmp_path, "b.lock")
    assert (first.ensure_held(), second.ensure_held()) == ("", "")
    first.release()
    second.release()


def test_processes_of_one_daemon_share_the_lock(tmp_path: Path) -> None:
    first, second, foreign = (FolderLock(tmp_path, "a.lock", owner_pid=pid) for pid in (11, 11, 12))
    alone = FolderLock(tmp_path, "a.lock")
    in_use = f"{tmp_path}: in use by process 11"
    assert (first.ensure_held(), second.ensure_held()) == ("", "")
    assert (foreign.ensure_held(), alone.ensure_held()) == (in_use, in_use)
    first.release()
    assert (foreign.ensure_held(), alone.ensure_held()) == (in_use, in_use)
    assert describe_lock_holder(tmp_path, "a.lock") == "process 11"
    assert first.ensure_held() == ""
    first.release()
    second.release()
    assert foreign.ensure_held() == ""
    assert first.ensure_held() == f"{tmp_path}: in use by process 12"
    foreign.release()
    assert alone.ensure_held() == ""
    assert first.ensure_held() == f"{tmp_path}: in use by process {os.getpid()}"
    alone.release()


def test_lock_of_a_killed_process_is_free_although_its_child_lives(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER_PROGRAM, str(tmp_path), "a.lock"],
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
        os.kill(child, 0)  # the child lives
        assert lock.ensure_held() == ""
        assert describe_lock_holder(tmp_path, "a.lock") == f"process {os.getpid()}"
    finally:
        process.kill()
        process.communicate()
        os.kill(child, 9)
        lock.release()
    assert describe_lock_holder(tmp_path, "a.lock") == ""


def test_describing_the_holder_creates_no_files(tmp_path: Path) -> None:
    assert describe_lock_holder(tmp_path / "store", "a.lock") == ""
    assert describe_lock_holder(tmp_path, "a.lock") == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("lost", ["lock file", "folder", "folder renamed"])
def test_holder_that_loses_the_file_takes_the_lock_again_or_names_the_new_holder(lost: str, tmp_path: Path) -> None:
    folder = tmp_path / "store"
    first, second = FolderLock(folder, "a.lock"), FolderLock(folder, "a.lock")
    for other_is_faster in (False, True):
        assert first.ensure_held() == ""
        match lost:
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
def test_lock_path_that_is_no_regular_file_raises_without_waiting(kind: str, tmp_path: Path) -> None:
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


def test_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "store").write_text("x")
    with pytest.raises(OSError, match="is a file, not a folder"):
        FolderLock(tmp_path / "store", "a.lock").ensure_held()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_file_system_without_locks_gives_a_warning(
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


def test_holder_on_another_host_is_named_with_the_host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = FolderLock(tmp_path, RECORDING_LOCK)
    monkeypatch.setattr(socket, "gethostname", lambda: "bench-pc")
    assert lock.ensure_held() == ""
    monkeypatch.undo()
    assert describe_lock_holder(tmp_path, RECORDING_LOCK) == f"process {os.getpid()} on bench-pc"
    lock.path.write_text("rubbish")
    assert describe_lock_holder(tmp_path, RECORDING_LOCK) == "another process"
    lock.release()
