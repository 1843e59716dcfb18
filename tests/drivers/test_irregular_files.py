"""Tests of a FIFO, socket, device, directory or broken symbolic link in place of a file.

Every reader refuses it with an error of one line and does not wait for data.
"""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.errors import ConfigError, ImuError, RecordingError
from drivers.host import safe_file_reading
from drivers.links import replay_link
from drivers.recordings import FORMATS, load_samples, segment_file
from drivers.recordings.writing import atomic_write_path
from drivers.zenoh.session_config import build_session_config
from monitor.commands import thermal
from monitor.common import shipped_config_paths
from monitor.history import sqlite_store
from monitor.noise.model_loading import read_model
from monitor.publishing.zenoh.subscriber import client_configurations
from monitor.settings import loading
from tests.support.waiting import PATIENCE_S

IMU_MONITOR = [sys.executable, "-m", "imu_monitor"]
ERROR_TEXTS = {
    "fifo": "is a FIFO",
    "socket": "is a socket",
    "device": "is a character device",
    "directory": "is a directory",
    "loop": "symbolic links",
    "dangling": "No such file",
}


def make_irregular_file(kind: str, path: Path) -> None:
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "socket":
            with socket.socket(socket.AF_UNIX) as unix_socket:
                folder = os.open(path.parent, os.O_RDONLY)
                try:
                    # the path of a socket has at most 108 characters, so use a short one
                    unix_socket.bind(f"/proc/self/fd/{folder}/{path.name}")
                finally:
                    os.close(folder)
        case "device":
            path.symlink_to("/dev/zero")
        case "directory":
            path.mkdir()
        case "loop":
            path.symlink_to(path.name)
        case "dangling":
            path.symlink_to("nothing-here")


@pytest.fixture(params=ERROR_TEXTS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def get_one_line_text(error: BaseException) -> str:
    text = str(error)
    assert "\n" not in text
    return text


def test_error_names_the_kind_of_file(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "name"
    make_irregular_file(kind, path)
    for read in (
        safe_file_reading.read_small_file,
        safe_file_reading.open_regular_file,
        safe_file_reading.check_regular_file,
    ):
        with pytest.raises(OSError, match=ERROR_TEXTS[kind]):
            read(path)


def test_file_descriptor_is_not_inherited(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    with safe_file_reading.open_regular_file(tmp_path / "a") as file:
        assert not os.get_inheritable(file.fileno())
        assert file.read() == b"1"


def test_name_with_a_nul_character_raises_os_error() -> None:
    with pytest.raises(OSError, match="embedded null"):
        safe_file_reading.open_regular_file(Path("a\0b"))


@pytest.mark.parametrize("suffix", tuple(FORMATS))
def test_irregular_recording_is_refused(kind: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    make_irregular_file(kind, path)
    with pytest.raises(RecordingError) as error:
        load_samples(path)
    expected = "no recordings in this folder" if kind == "directory" else ERROR_TEXTS[kind]
    assert expected in get_one_line_text(error.value)


def test_irregular_recording_in_a_folder_is_left_out_with_a_note(kind: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,gx\n0.0,1.0\n0.1,2.0\n")
    make_irregular_file(kind, tmp_path / "b.csv")
    found = load_samples(tmp_path)
    assert len(found) == 2
    (note,) = [note for note in found.notes if "left out" in note]
    assert ERROR_TEXTS[kind] in note


@pytest.mark.parametrize(
    "read",
    [segment_file.read_metadata, segment_file.read_last_piece, lambda path: list(segment_file.read_samples(path))],
)
def test_irregular_segment_is_refused(kind: str, read: Callable[[Path], object], tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    make_irregular_file(kind, path)
    with pytest.raises((RecordingError, OSError), match=ERROR_TEXTS[kind]):
        read(path)


def test_irregular_part_file_is_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv.part")
    with atomic_write_path(tmp_path / "a.csv") as part:
        part.write_text("x")
    assert (tmp_path / "a.csv").read_text() == "x"
    pytest.importorskip("pyarrow")
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    os.mkfifo(path.with_name(path.name + ".part"))
    segment_file.SegmentFileWriter(path, segment_file.SegmentMetadata("a", "samples")).close()


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("configuration", loading.load_config),
        ("model", read_model),
        ("model name", lambda path: shipped_config_paths.resolve_model_path(str(path), path.parent)),
        ("zenoh file", lambda path: client_configurations((), path)),
    ],
)
def test_irregular_settings_file_is_refused(
    kind: str, name: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "name"
    make_irregular_file(kind, path)
    if kind in ("fifo", "socket", "device") and name == "model name":
        assert read(path) == path  # the reader of the model reports the error
        return
    with pytest.raises(ImuError) as error:
        read(path)
    assert str(tmp_path) in get_one_line_text(error.value)


@pytest.mark.parametrize("kind", ["socket", "device", "directory", "loop", "dangling"])
def test_irregular_thermal_model_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "name"
    make_irregular_file(kind, path)
    with pytest.raises(ConfigError, match=ERROR_TEXTS[kind]):
        thermal.read_model_file(path)


@pytest.mark.parametrize("suffix", [".csv", ".bin", ".log", ".blf", ".asc", ".csv.gz"])
@pytest.mark.parametrize("kind", ["fifo", "socket", "device", "loop"])
def test_irregular_replay_file_is_refused(kind: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    make_irregular_file(kind, path)
    with pytest.raises(ConfigError, match=ERROR_TEXTS[kind]):
        replay_link.build(replay_link.Settings(path=str(path)))


def test_irregular_raw_segment_is_not_replayed(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    os.mkfifo(tmp_path / segment_file.format_segment_name(1, 1.7e9))
    link = replay_link.build(replay_link.Settings(path=str(tmp_path)))
    with pytest.raises(OSError, match="is a FIFO"):
        link.open()


def test_irregular_key_file_of_a_zenoh_file_is_refused(tmp_path: Path) -> None:
    import zenoh

    os.mkfifo(tmp_path / "key.pem")
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{transport: {{link: {{tls: {{listen_private_key: "{tmp_path / "key.pem"}"}}}}}}}}')
    with pytest.raises(zenoh.ZError, match="is a FIFO"):
        build_session_config({}, file)


@pytest.mark.parametrize("suffix", [".dbc", ".kcd"])
def test_irregular_can_database_is_refused(kind: str, suffix: str, tmp_path: Path) -> None:
    from drivers.decoders.dbc import database

    path = tmp_path / f"a{suffix}"
    make_irregular_file(kind, path)
    with pytest.raises(ConfigError, match=ERROR_TEXTS[kind]):
        database._load(path)


@pytest.mark.parametrize("suffix", ["", "-wal", "-shm", "-journal"])
@pytest.mark.parametrize("kind", ["fifo", "socket", "device", "directory", "loop"])
def test_irregular_history_is_refused(kind: str, suffix: str, tmp_path: Path) -> None:
    if suffix:
        sqlite_store.HistoryFileWriter(tmp_path / sqlite_store.FILE_NAME).close()
    path = tmp_path / f"{sqlite_store.FILE_NAME}{suffix}"
    make_irregular_file(kind, path)
    for access in (
        lambda: sqlite_store.HistoryFileWriter(tmp_path / sqlite_store.FILE_NAME).close(),
        lambda: list(read_history(tmp_path)),
    ):
        with pytest.raises((RecordingError, OSError), match=ERROR_TEXTS[kind]):
            access()


def read_history(folder: Path) -> Iterator[str]:
    with sqlite_store.open_history(folder / sqlite_store.FILE_NAME) as reader:
        yield from reader.list_devices()


# --- from the command line


def run_program(arguments: list[str], **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # type: ignore[call-overload, no-any-return]
        [*IMU_MONITOR, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False, **options
    )


@pytest.mark.parametrize("command", [["run"], ["analyze"], ["simulate", "--seconds", "1", "--out", "x.csv"]])
def test_socket_on_the_command_line_gives_status_2_and_one_line(command: list[str], tmp_path: Path) -> None:
    name = tmp_path / "a.csv"
    make_irregular_file("socket", name)
    result = run_program([command[0], str(name), *command[1:]], cwd=tmp_path)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert "is a socket" in result.stderr


def test_configuration_and_model_can_be_read_from_a_pipe(tmp_path: Path) -> None:
    text = (shipped_config_paths.CONFIG_FOLDER / "demo.toml").read_text()
    result = run_program(["check", "/dev/stdin"], input=text)
    assert (result.returncode, result.stderr) == (0, "")
    model = (shipped_config_paths.CONFIG_FOLDER / "models" / "consumer-mems.toml").read_text()
    for name in ("/dev/stdin", "-"):
        result = run_program(["export", name, "--format", "kalibr"], input=model)
        assert (result.returncode, result.stderr) == (0, "")
        assert "noise_density" in result.stdout


@pytest.mark.parametrize("number", [2, 15])
def test_program_waits_for_a_silent_pipe_until_a_signal(number: int, tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    os.mkfifo(path, 0o600)
    process = subprocess.Popen([*IMU_MONITOR, "run", str(path)], stderr=subprocess.PIPE)
    writer = -1
    try:
        writer = open_for_writing(path)
        end_with_signal(process, number)
    finally:
        process.kill()
        os.close(writer)
    assert process.returncode in (-number, 128 + number)


def end_with_signal(process: "subprocess.Popen[bytes]", number: int) -> None:
    """Send a signal until the process ends, because Python does not notice a signal just before it begins to read."""
    deadline_s = time.monotonic() + PATIENCE_S
    while process.poll() is None:
        assert time.monotonic() < deadline_s, "the process does not end"
        process.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=2.0)


def open_for_writing(path: Path) -> int:
    """Wait until another process reads the FIFO. Return a file descriptor for writing."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            assert time.monotonic() < deadline_s, "no process reads the FIFO"
            time.sleep(0.01)
