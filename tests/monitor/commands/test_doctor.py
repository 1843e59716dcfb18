"""What is wrong with a machine or a configuration is found before the service is left alone with them."""

import json
import os
import pwd
import shutil
import socket
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import make_block
from drivers.driver import AxisMap
from drivers.recordings import segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter
from monitor.commands import doctor
from monitor.commands.doctor import (
    SAMPLE_BYTES,
    Finding,
    check_disk_space,
    examine_machine,
    recorded_bytes_per_day,
    version_satisfies,
    worst_mark,
)
from monitor.common.compiled import kernel_cache_folder
from monitor.common.folder_lock import HISTORY_LOCK, RECORDING_LOCK, FolderLock
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.daemon.storage.recorder import segment_metadata
from monitor.noise.model_loading import read_model
from monitor.settings import loading
from monitor.settings.loading import Storage
from tests.support.waiting import PATIENCE_S

QUIET = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'
DEVICE = '[[device]]\nname = "a"\nrate = 100.0\ndriver = {{ {} }}\n'
VIRTUAL = DEVICE.format('link = "virtual"')


def examined(folder: Path, text: str, mode: int = 0o600) -> list[Finding]:
    path = folder / "c.toml"
    path.write_text(text)
    path.chmod(mode)
    return examine_machine(path)


def of(findings: list[Finding], about: str) -> list[Finding]:
    return [one for one in findings if one.about == about]


def one_of(findings: list[Finding], about: str) -> Finding:
    (found,) = of(findings, about)
    return found


# --- the configuration


def test_all_that_is_wrong_with_the_file_is_found(tmp_path: Path) -> None:
    found = of(examined(tmp_path, VIRTUAL + "windw = 1.0\n" + '[log]\nlevel = "loud"\n'), "configuration")
    assert [one.mark for one in found] == ["wrong", "wrong"]
    assert "windw" in found[0].text
    assert "log.level" in found[1].text


def test_a_limit_that_its_model_cannot_bear_is_found(tmp_path: Path) -> None:
    limit = '[[device.limit]]\naxes = "gz"\nletter = "R"\ntimes_model = 2.0\n'
    text = '[[device]]\nname = "a"\nmodel = "consumer-mems"\n' + limit + '[device.driver]\nlink = "virtual"\n' + QUIET
    found = one_of(examined(tmp_path, text), "configuration")
    assert found.mark == "wrong"
    assert "has no R on gz" in found.text


def test_a_file_that_is_not_there_is_wrong_and_the_machine_is_looked_at_still(tmp_path: Path) -> None:
    found = examine_machine(tmp_path / "none.toml")
    assert "no such file" in one_of(found, "configuration").text
    assert of(found, "clock")
    assert worst_mark(found) == "wrong"


@pytest.mark.parametrize(
    ("mode", "mark", "words"),
    [(0o600, "well", "0600"), (0o644, "well", "0644"), (0o664, "doubt", "chmod g-w"), (0o666, "wrong", "chmod o-w")],
)
def test_who_may_write_the_file_may_do_as_the_service(tmp_path: Path, mode: int, mark: str, words: str) -> None:
    found = one_of(examined(tmp_path, VIRTUAL + QUIET, mode), "permissions")
    assert found.mark == mark
    assert words in found.text + found.do


def test_a_password_that_everyone_may_read_is_found_and_not_said(tmp_path: Path) -> None:
    secrets = tmp_path / "zenoh.json5"
    secrets.write_text('{transport: {auth: {usrpwd: {user: "imu", password: "hunter2"}}}}')
    text = VIRTUAL + f'[zenoh]\nconfig = "{secrets}"\n[viewer]\nmode = "none"\n'
    secrets.chmod(0o644)
    found = one_of(examined(tmp_path, text), "zenoh file")
    assert found.mark == "wrong"
    assert "hunter2" not in found.text + found.do
    secrets.chmod(0o640)
    assert one_of(examined(tmp_path, text), "zenoh file").mark == "well"


def test_a_hook_that_everyone_may_write_is_found(tmp_path: Path) -> None:
    tell = tmp_path / "tell"
    tell.write_text("#!/bin/sh\n")
    text = VIRTUAL + QUIET + '[[hook]]\non = ["*"]\ncommand = ["./tell"]\n'
    tell.chmod(0o755)
    assert one_of(examined(tmp_path, text), "hook tell").mark == "well"
    tell.chmod(0o777)
    assert one_of(examined(tmp_path, text), "hook tell").mark == "wrong"


# --- devices


@pytest.fixture
def port() -> Iterator[str]:
    master, slave = os.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    os.close(slave)
    yield name
    os.close(master)


def serial(folder: Path, port: str) -> Finding:
    driver = f'link = "serial", port = "{port}", decoder = "stim300"'
    return one_of(examined(folder, DEVICE.format(driver) + QUIET), "device a")


def test_a_port_that_is_there_and_free_is_well_and_one_that_is_held_is_told(tmp_path: Path, port: str) -> None:
    assert serial(tmp_path, port).mark == "well"
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("needs /proc")
    wait = "import sys; f = open(sys.argv[1], 'rb', 0); print('open', flush=True); sys.stdin.read()"
    command = [sys.executable, "-S", "-c", wait, port]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        found = serial(tmp_path, port)
        holder.communicate()
    assert found.mark == "doubt"
    assert f"(pid {holder.pid})" in found.text


def test_a_port_that_is_missing_or_none_is_wrong(tmp_path: Path) -> None:
    missing = serial(tmp_path, "/dev/ttyUSB987")
    assert (missing.mark, "no such port" in missing.text) == ("wrong", True)
    (tmp_path / "file").touch()
    assert serial(tmp_path, str(tmp_path / "file")).text.endswith("not a serial port")
    assert serial(tmp_path, "socket://127.0.0.1:1").mark == "well"


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_port_that_may_not_be_read_says_which_group_may(tmp_path: Path, port: str) -> None:
    os.chmod(port, 0)
    found = serial(tmp_path, port)
    assert found.mark == "wrong"
    assert found.do.startswith("sudo usermod -aG ")
    assert pwd.getpwuid(os.geteuid()).pw_name in found.do


@pytest.mark.skipif(not hasattr(socket, "AF_CAN"), reason="no socketcan here")
def test_a_bus_is_there_and_up_or_what_to_do_is_said(tmp_path: Path) -> None:
    def interface(name: str, kind: str, flags: str) -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "flags").write_text(f"{flags}\n")

    interface("can0", "280", "0x40081")
    interface("can1", "280", "0x40080")
    interface("eth0", "1", "0x1003")

    def said(name: str) -> tuple[str, str]:
        found = doctor.check_can_interface("device a", "socketcan", name, tmp_path)
        return found.mark, found.text

    assert said("can0") == ("well", "can0: is up")
    assert said("can1") == ("wrong", "can1: is down")
    assert said("eth0") == ("wrong", "eth0: not a CAN interface")
    assert said("can7") == ("wrong", "can7: no such interface; existing CAN interfaces: can0, can1")


def test_a_package_that_the_interface_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "msgpack", None)  # as if it were not installed
    found = doctor.check_can_interface("device a", "udp_multicast", "239.74.163.2")
    assert (found.mark, found.text) == ("wrong", "CAN interface udp_multicast needs the package msgpack")
    assert found.do == 'pip install "imu-monitor[multicast]"'


# --- outputs


def test_ports_that_are_taken_and_routers_that_do_not_answer_are_told(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as free:
        busy, idle = taken.getsockname()[1], free.getsockname()[1]
        free.close()
        text = (
            VIRTUAL
            + f'[zenoh]\nlisten = ["tcp/127.0.0.1:{busy}"]\n'
            + f'connect = ["tcp/127.0.0.1:{busy}", "tcp/127.0.0.1:{idle}"]\n'
            + f'[viewer]\nmode = "none"\n[metrics]\nlisten = "127.0.0.1:{busy}"\n'
        )
        found = examined(tmp_path, text)
    assert [(one.mark, one.text.partition(": ")[2].partition(":")[0]) for one in of(found, "zenoh")] == [
        ("doubt", "another program listens there"),
        ("well", "answers"),
        ("doubt", "no answer"),
    ]
    assert one_of(found, "metrics").mark == "doubt"


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:99999", f"tcp/{'a' * 70}.example:1", "tcp/192.0.2.1:7447"])
def test_an_address_that_cannot_be_listened_on_is_wrong(endpoint: str) -> None:
    found = doctor.check_port_free("zenoh", endpoint)
    assert found.mark == "wrong"
    assert found.text.startswith(f"{endpoint}: cannot listen: ")


def test_what_listens_beyond_this_machine_without_protection_is_told(tmp_path: Path) -> None:
    text = (
        VIRTUAL + '[zenoh]\nlisten = ["tcp/0.0.0.0:0"]\n[viewer]\nmode = "none"\n[metrics]\nlisten = "0.0.0.0:9464"\n'
    )
    found = examined(tmp_path, text)
    assert "everyone who reaches this machine can read all data and send commands" in str(of(found, "zenoh"))
    assert "everyone who reaches this machine can read the metrics" in str(of(found, "metrics"))


def test_the_folder_of_recordings_is_tried_and_left_as_it_was(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    found = one_of(examined(tmp_path, VIRTUAL + QUIET + '[storage]\nfolder = "kept/here"\n'), "storage")
    assert found.mark in ("well", "doubt")
    assert "about 0.302 GB per day" in found.text
    assert not (tmp_path / "kept").exists()
    (tmp_path / "file").touch()
    found = one_of(examined(tmp_path, VIRTUAL + QUIET + '[storage]\nfolder = "file/here"\n'), "storage")
    assert (found.mark, "cannot be written" in found.text) == ("wrong", True)


def test_a_rate_that_is_not_configured_leaves_the_disk_unjudged(tmp_path: Path) -> None:
    text = VIRTUAL.replace("rate = 100.0\n", "") + QUIET + '[storage]\nfolder = "kept"\n'
    found = examined(tmp_path, text)
    assert "disk use per day unknown" in str(of(found, "storage"))
    config = loading.load_config(tmp_path / "c.toml")
    assert recorded_bytes_per_day(config) is None


def test_room_is_judged_by_days(tmp_path: Path) -> None:
    own = Storage(folder=tmp_path, keep_s=30 * 86400.0, disk_share=0.9)
    marks = [
        check_disk_space(own, 1e9, 100_000_000_000, free) for free in (90_000_000_000, 25_000_000_000, 10_500_000_000)
    ]
    assert [one.mark for one in marks] == ["well", "doubt", "wrong"]
    assert "the oldest data will be deleted after about 15 days" in marks[1].text


def test_what_a_sample_is_said_to_take_is_what_it_takes(tmp_path: Path) -> None:
    """Ten minutes of noise that fills a 32-bit float, packed as the daemon does it."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    values = (
        read_model(CONFIG_FOLDER / "models" / "consumer-mems.toml").start_stream(100.0, 1).draw_next_samples(60_000)
    )
    values = values.astype(np.float32).astype(np.float64)
    rng = np.random.default_rng(1)
    t_ns = 1_760_000_000_000_000_000 + np.arange(60_000) * 10_000_000 + rng.integers(-1000, 1000, 60_000)
    temperature = np.round(25.0 + 0.01 * rng.standard_normal(60_000), 2)
    writer = SegmentFileWriter(tmp_path / segment_file.format_segment_name(1, 1.76e9), segment_metadata("a", AxisMap()))
    for at in range(0, 60_000, 50):
        rows = slice(at, at + 50)
        ticks = np.arange(at, at + 50) * 10
        writer.write_samples(
            [make_block(t_ns[rows].copy(), values[rows].copy(), temperature[rows].copy(), ticks)], DaemonState()
        )
    writer.close()
    list(segment_file.compress_segment_stepwise(writer.path))
    (packed,) = tmp_path.iterdir()
    assert 0.8 * SAMPLE_BYTES < packed.stat().st_size / 60_000 < SAMPLE_BYTES


# --- the machine


def test_the_libraries_here_are_those_that_are_required() -> None:
    found = doctor.check_library_versions()
    assert [one.mark for one in found] == ["well"], found
    required = {name: optional for name, _, optional in doctor.library_requirements()}
    assert required["numpy"] is False
    assert required["rerun-sdk"] is True
    assert "pytest" not in required


@pytest.mark.parametrize(
    ("version", "wanted", "fits"),
    [
        ("2.0", ">=2.0", True),
        ("1.26.4", ">=2", False),
        ("2.0.0", "==2", True),
        ("0.9", ">0.9,<1", False),
        ("1", "", True),
    ],
)
def test_versions_are_compared_by_their_numbers(version: str, wanted: str, fits: bool) -> None:
    assert version_satisfies(version, wanted) is fits


@pytest.mark.long
def test_kernels_that_cannot_be_kept_are_told(tmp_path: Path) -> None:
    assert kernel_cache_folder() is not None
    say = "from monitor.common.compiled import kernel_cache_folder; print(kernel_cache_folder())"
    copy = tmp_path / "copy"
    shutil.copytree(Path(doctor.__file__).parents[1], copy / "monitor", ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "monitor" / "common" / "__pycache__").touch()  # no folder can be made there
    (tmp_path / "file").touch()
    environment = {**os.environ, "PYTHONPATH": str(copy), "HOME": str(tmp_path / "file")}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    for more, wanted in (({}, "None"), ({"NUMBA_CACHE_DIR": str(tmp_path / "cache")}, str(tmp_path / "cache"))):
        done = subprocess.run(
            [sys.executable, "-c", say],
            cwd=tmp_path,
            env={**environment, **more},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip().startswith(wanted)


def test_the_clock_is_asked_and_an_answer_given() -> None:
    found = doctor.check_clock()
    assert found.mark in ("well", "doubt")
    assert bool(found.do) == ("not synchronised" in found.text)


@pytest.mark.parametrize(
    ("seen", "mark"),
    [
        ({"ActiveState": "active", "NRestarts": "0", "UnitFileState": "enabled"}, "well"),
        ({"ActiveState": "active", "NRestarts": "7", "UnitFileState": "enabled"}, "doubt"),
        ({"ActiveState": "active", "NRestarts": "0", "UnitFileState": "disabled"}, "doubt"),
        ({"ActiveState": "inactive", "NRestarts": "0"}, "doubt"),
        ({"ActiveState": "failed", "NRestarts": "0"}, "wrong"),
    ],
)
def test_the_unit_is_judged_by_what_systemd_says(seen: dict[str, str], mark: str) -> None:
    assert [one.mark for one in doctor.check_systemd_unit_state({"LoadState": "loaded", **seen})] == [mark]


# --- the command


def run(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "monitor.cli", "doctor", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(CONFIG_FOLDER.parent), "COLUMNS": "200"}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.mark.long
def test_the_command_prints_a_sign_a_line_and_ends_with_1_if_anything_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + QUIET)
    (tmp_path / "c.toml").chmod(0o600)
    well = run(tmp_path, "c.toml", "--json", "found.json")
    assert (well.returncode, well.stderr) == (0, "")
    assert all(line.lstrip()[0] in "✓!→" for line in well.stdout.splitlines())
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["schema"] == "imu-monitor/doctor/1"
    assert {one["mark"] for one in found["findings"]} <= {"well", "doubt"}
    assert {"mark", "about", "text", "do"} == set(found["findings"][0])
    (tmp_path / "c.toml").chmod(0o666)
    wrong = run(tmp_path, "c.toml")
    assert (wrong.returncode, wrong.stderr) == (1, "")
    assert "✗  permissions" in wrong.stdout
    assert "→ chmod o-w c.toml" in wrong.stdout


@pytest.mark.long
def test_json_alone_goes_to_standard_output(tmp_path: Path) -> None:
    done = run(tmp_path, "none.toml", "--json", "-")
    assert done.returncode == 1
    assert {one["about"] for one in json.loads(done.stdout)["findings"]} >= {"configuration", "libraries", "clock"}
    refused = run(tmp_path, "--json", "nowhere/x.json")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1


@pytest.mark.parametrize("name", [RECORDING_LOCK, HISTORY_LOCK])
def test_a_folder_that_another_process_uses_is_found(name: str, tmp_path: Path) -> None:
    text = VIRTUAL + QUIET + f'[storage]\nfolder = "{tmp_path / "kept"}"\n'
    assert not [one for one in of(examined(tmp_path, text), "storage") if "in use" in one.text]
    lock = FolderLock(tmp_path / "kept", name)
    assert lock.ensure_held() == ""
    (found,) = [one for one in of(examined(tmp_path, text), "storage") if "in use" in one.text]
    assert found.mark == "doubt"
    assert found.text == f"{tmp_path / 'kept'}: in use by process {os.getpid()}"
    assert "choose another folder" in found.do
    lock.release()


def test_a_fifo_in_place_of_the_folder_is_found(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "kept")
    text = VIRTUAL + QUIET + f'[storage]\nfolder = "{tmp_path / "kept"}"\n'
    found = [one for one in of(examined(tmp_path, text), "storage") if one.mark == "wrong"]
    assert "is a FIFO, not a folder" in found[-1].text
