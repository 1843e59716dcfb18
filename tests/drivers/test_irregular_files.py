"""A FIFO, socket, device, directory or looping link in place of a file is one line, and nothing waits for it."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers import file_access
from drivers.errors import ConfigError, ImuError, RecordingError
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

IMU_MONITOR = [sys.executable, "-m", "monitor.cli"]
KINDS = {
    "fifo": "is a FIFO",
    "socket": "is a socket",
    "device": "is a character device",
    "directory": "is a directory",
    "loop": "symbolic links",
    "dangling": "No such file",
}


def make(kind: str, path: Path) -> None:
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "socket":
            with socket.socket(socket.AF_UNIX) as one:
                here = os.open(path.parent, os.O_RDONLY)
                try:
                    one.bind(f"/proc/self/fd/{here}/{path.name}")  # a short name: sockets allow 108 characters
                finally:
                    os.close(here)
        case "device":
            path.symlink_to("/dev/zero")
        case "directory":
            path.mkdir()
        case "loop":
            path.symlink_to(path.name)
        case "dangling":
            path.symlink_to("nothing-here")


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def one_line(error: BaseException) -> str:
    text = str(error)
    assert "\n" not in text
    return text


def test_open_regular_says_what_it_is(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "name"
    make(kind, path)
    for read in (file_access.read_small_file, file_access.open_regular_file, file_access.check_regular_file):
        with pytest.raises(OSError, match=KINDS[kind]):
            read(path)


def test_a_descriptor_is_not_inherited(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    with file_access.open_regular_file(tmp_path / "a") as file:
        assert not os.get_inheritable(file.fileno())
        assert file.read() == b"1"


def test_a_name_with_a_nul_character_is_an_os_error() -> None:
    with pytest.raises(OSError, match="null byte"):
        file_access.open_regular_file(Path("a\0b"))


@pytest.mark.parametrize("suffix", tuple(FORMATS))
def test_a_recording(kind: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    make(kind, path)
    with pytest.raises(RecordingError) as error:
        load_samples(path)
    said = "no recordings in this folder" if kind == "directory" else KINDS[kind]
    assert said in one_line(error.value)


def test_a_recording_in_a_folder_is_left_out_with_a_note(kind: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,gx\n0.0,1.0\n0.1,2.0\n")
    make(kind, tmp_path / "b.csv")
    found = load_samples(tmp_path)
    assert len(found) == 2
    (note,) = [note for note in found.notes if "left out" in note]
    assert KINDS[kind] in note


@pytest.mark.parametrize(
    "read",
    [segment_file.read_metadata, segment_file.read_last_piece, lambda path: list(segment_file.read_samples(path))],
)
def test_a_segment(kind: str, read: Callable[[Path], object], tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / segment_file.format_segment_name(1, 1.7e9)
    make(kind, path)
    with pytest.raises((RecordingError, OSError), match=KINDS[kind]):
        read(path)


def test_a_part_file_in_the_way_of_a_new_one(tmp_path: Path) -> None:
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
def test_a_file_of_settings(kind: str, name: str, read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "name"
    make(kind, path)
    if kind in ("fifo", "socket", "device") and name == "model name":
        assert read(path) == path  # its reader says what is wrong
        return
    with pytest.raises(ImuError) as error:
        read(path)
    assert str(tmp_path) in one_line(error.value)


@pytest.mark.parametrize("kind", ["socket", "device", "directory", "loop", "dangling"])
def test_a_thermal_model(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "name"
    make(kind, path)
    with pytest.raises(ConfigError, match=KINDS[kind]):
        thermal.read_model_file(path)


@pytest.mark.parametrize("suffix", [".csv", ".bin", ".log", ".blf", ".asc", ".csv.gz"])
@pytest.mark.parametrize("kind", ["fifo", "socket", "device", "loop"])
def test_what_is_replayed(kind: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    make(kind, path)
    with pytest.raises(ConfigError, match=KINDS[kind]):
        replay_link.build(replay_link.Settings(path=str(path)))


def test_a_segment_of_raw_bytes_that_is_replayed(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    os.mkfifo(tmp_path / segment_file.format_segment_name(1, 1.7e9))
    link = replay_link.build(replay_link.Settings(path=str(tmp_path)))
    with pytest.raises(OSError, match="is a FIFO"):
        link.open()


def test_a_file_that_a_zenoh_file_names(tmp_path: Path) -> None:
    import zenoh

    os.mkfifo(tmp_path / "key.pem")
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{transport: {{link: {{tls: {{listen_private_key: "{tmp_path / "key.pem"}"}}}}}}}}')
    with pytest.raises(zenoh.ZError, match="is a FIFO"):
        build_session_config({}, file)


@pytest.mark.parametrize("suffix", [".dbc", ".kcd"])
def test_a_can_database(kind: str, suffix: str, tmp_path: Path) -> None:
    from drivers.decoders.dbc import database

    path = tmp_path / f"a{suffix}"
    make(kind, path)
    with pytest.raises(ConfigError, match=KINDS[kind]):
        database._load(path)


@pytest.mark.parametrize("end", ["", "-wal", "-shm", "-journal"])
@pytest.mark.parametrize("kind", ["fifo", "socket", "device", "directory", "loop"])
def test_a_history(kind: str, end: str, tmp_path: Path) -> None:
    if end:
        sqlite_store.HistoryFileWriter(tmp_path / sqlite_store.FILE_NAME).close()
    path = tmp_path / f"{sqlite_store.FILE_NAME}{end}"
    make(kind, path)
    for look in (
        lambda: sqlite_store.HistoryFileWriter(tmp_path / sqlite_store.FILE_NAME).close(),
        lambda: list(read_history(tmp_path)),
    ):
        with pytest.raises((RecordingError, OSError), match=KINDS[kind]):
            look()


def read_history(folder: Path) -> Iterator[str]:
    with sqlite_store.open_history(folder / sqlite_store.FILE_NAME) as reader:
        yield from reader.list_devices()


# --- from the command line


def finished(arguments: list[str], **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # type: ignore[call-overload, no-any-return]
        [*IMU_MONITOR, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False, **options
    )


@pytest.mark.parametrize("command", [["run"], ["analyze"], ["simulate", "--seconds", "1", "--out", "x.csv"]])
def test_a_socket_or_device_on_the_command_line_is_status_2_and_one_line(command: list[str], tmp_path: Path) -> None:
    name = tmp_path / "a.csv"
    make("socket", name)
    done = finished([command[0], str(name), *command[1:]], cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "is a socket" in done.stderr


def test_a_configuration_and_a_model_from_a_pipe(tmp_path: Path) -> None:
    text = (shipped_config_paths.CONFIG_FOLDER / "demo.toml").read_text()
    done = finished(["check", "/dev/stdin"], input=text)
    assert (done.returncode, done.stderr) == (0, "")
    model = (shipped_config_paths.CONFIG_FOLDER / "models" / "consumer-mems.toml").read_text()
    for name in ("/dev/stdin", "-"):
        done = finished(["export", name, "--format", "kalibr"], input=model)
        assert (done.returncode, done.stderr) == (0, "")
        assert "noise_density" in done.stdout


@pytest.mark.parametrize("number", [2, 15])
def test_a_pipe_whose_writer_says_nothing_is_waited_for_until_a_signal(number: int, tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    os.mkfifo(path, 0o600)
    process = subprocess.Popen([*IMU_MONITOR, "run", str(path)], stderr=subprocess.PIPE)
    writer = -1
    try:
        writer = opened_for_writing(path)
        process.send_signal(number)
        process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        os.close(writer)
    assert process.returncode in (-number, 128 + number)


def opened_for_writing(path: Path) -> int:
    """A descriptor, once somebody reads."""
    until_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            assert time.monotonic() < until_s, "nobody reads"
            time.sleep(0.01)
