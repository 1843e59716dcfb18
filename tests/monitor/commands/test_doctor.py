"""Tests of the command ``doctor``, which examines the machine and the configuration."""

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
from drivers.host.extras import install_command
from drivers.recordings import segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter
from monitor.commands.doctor import devices, examine_machine, installation_and_clock, network
from monitor.commands.doctor.finding import DoctorFinding, worst_mark
from monitor.commands.doctor.storage import SAMPLE_BYTES, check_disk_space, recorded_bytes_per_day
from monitor.common.compiled import kernel_cache_folder
from monitor.common.folder_lock import HISTORY_LOCK, RECORDING_LOCK, FolderLock
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.daemon.storage.recorder import segment_metadata
from monitor.noise.model_loading import read_model
from monitor.settings import loading
from monitor.settings.loading import Storage
from tests.support.fake_iio_device import FakeIioDevice
from tests.support.waiting import PATIENCE_S

QUIET = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'
DEVICE = '[[device]]\nname = "a"\nrate = 100.0\ndriver = {{ {} }}\n'
VIRTUAL = DEVICE.format('link = "virtual"')


def examine_config(folder: Path, text: str, mode: int = 0o600) -> list[DoctorFinding]:
    path = folder / "c.toml"
    path.write_text(text)
    path.chmod(mode)
    return examine_machine(path)


def select_findings(findings: list[DoctorFinding], about: str) -> list[DoctorFinding]:
    return [finding for finding in findings if finding.about == about]


def require_one_finding(findings: list[DoctorFinding], about: str) -> DoctorFinding:
    (found,) = select_findings(findings, about)
    return found


# --- the configuration


def test_every_mistake_in_the_configuration_is_found(tmp_path: Path) -> None:
    found = select_findings(
        examine_config(tmp_path, VIRTUAL + "windw = 1.0\n" + '[log]\nlevel = "loud"\n'), "configuration"
    )
    assert [finding.mark for finding in found] == ["wrong", "wrong"]
    assert "windw" in found[0].text
    assert "log.level" in found[1].text


def test_limit_without_the_term_in_the_model_is_found(tmp_path: Path) -> None:
    limit = '[[device.limit]]\naxes = "gz"\nletter = "R"\ntimes_model = 2.0\n'
    text = '[[device]]\nname = "a"\nmodel = "consumer-mems"\n' + limit + '[device.driver]\nlink = "virtual"\n' + QUIET
    found = require_one_finding(examine_config(tmp_path, text), "configuration")
    assert found.mark == "wrong"
    assert "has no R on gz" in found.text


def test_machine_is_examined_even_if_the_configuration_is_missing(tmp_path: Path) -> None:
    found = examine_machine(tmp_path / "none.toml")
    assert "no such file" in require_one_finding(found, "configuration").text
    assert select_findings(found, "clock")
    assert worst_mark(found) == "wrong"


@pytest.mark.parametrize(
    ("mode", "mark", "text"),
    [(0o600, "well", "0600"), (0o644, "well", "0644"), (0o664, "doubt", "chmod g-w"), (0o666, "wrong", "chmod o-w")],
)
def test_permissions_of_the_configuration_are_examined(tmp_path: Path, mode: int, mark: str, text: str) -> None:
    found = require_one_finding(examine_config(tmp_path, VIRTUAL + QUIET, mode), "permissions")
    assert found.mark == mark
    assert text in found.text + found.do


def test_password_readable_by_everyone_is_found_and_not_printed(tmp_path: Path) -> None:
    secrets = tmp_path / "zenoh.json5"
    secrets.write_text('{transport: {auth: {usrpwd: {user: "imu", password: "hunter2"}}}}')
    text = VIRTUAL + f'[zenoh]\nconfig = "{secrets}"\n[viewer]\nmode = "none"\n'
    secrets.chmod(0o644)
    found = require_one_finding(examine_config(tmp_path, text), "zenoh file")
    assert found.mark == "wrong"
    assert "hunter2" not in found.text + found.do
    secrets.chmod(0o640)
    assert require_one_finding(examine_config(tmp_path, text), "zenoh file").mark == "well"


def test_hook_writable_by_everyone_is_found(tmp_path: Path) -> None:
    hook = tmp_path / "tell"
    hook.write_text("#!/bin/sh\n")
    text = VIRTUAL + QUIET + '[[hook]]\non = ["*"]\ncommand = ["./tell"]\n'
    hook.chmod(0o755)
    assert require_one_finding(examine_config(tmp_path, text), "hook tell").mark == "well"
    hook.chmod(0o777)
    assert require_one_finding(examine_config(tmp_path, text), "hook tell").mark == "wrong"


# --- devices


@pytest.fixture
def port() -> Iterator[str]:
    master, slave = os.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    os.close(slave)
    yield name
    os.close(master)


def examine_serial_port(folder: Path, port: str) -> DoctorFinding:
    driver = f'link = "serial", port = "{port}", decoder = "stim300"'
    return require_one_finding(examine_config(folder, DEVICE.format(driver) + QUIET), "device a")


def test_free_port_is_fine_and_used_port_names_the_process(tmp_path: Path, port: str) -> None:
    assert examine_serial_port(tmp_path, port).mark == "well"
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("needs /proc")
    wait = "import sys; f = open(sys.argv[1], 'rb', 0); print('open', flush=True); sys.stdin.read()"
    command = [sys.executable, "-S", "-c", wait, port]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        found = examine_serial_port(tmp_path, port)
        holder.communicate()
    assert found.mark == "doubt"
    assert f"(pid {holder.pid})" in found.text


def test_missing_port_or_other_file_is_wrong(tmp_path: Path) -> None:
    missing = examine_serial_port(tmp_path, "/dev/ttyUSB987")
    assert (missing.mark, "no such port" in missing.text) == ("wrong", True)
    (tmp_path / "file").touch()
    assert examine_serial_port(tmp_path, str(tmp_path / "file")).text.endswith("not a serial port")
    assert examine_serial_port(tmp_path, "socket://127.0.0.1:1").mark == "well"


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_unreadable_port_names_the_group_to_join(tmp_path: Path, port: str) -> None:
    os.chmod(port, 0)
    found = examine_serial_port(tmp_path, port)
    assert found.mark == "wrong"
    assert found.do.startswith("sudo usermod -aG ")
    assert pwd.getpwuid(os.geteuid()).pw_name in found.do


def examine_udp_port(folder: Path, port: int, host: str = "127.0.0.1") -> DoctorFinding:
    driver = f'link = "udp", host = "{host}", port = {port}, decoder = "mavlink"'
    return require_one_finding(examine_config(folder, DEVICE.format(driver) + QUIET), "device a")


def test_udp_port_must_be_free_and_local(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        found = examine_udp_port(tmp_path, holder.getsockname()[1])
        assert (found.mark, "used by another program" in found.text) == ("doubt", True)
    assert examine_udp_port(tmp_path, 0).mark == "well"
    found = examine_udp_port(tmp_path, 9, "192.0.2.1")
    assert (found.mark, "no address of this computer" in found.text) == ("wrong", True)


@pytest.mark.skipif(not hasattr(socket, "AF_CAN"), reason="no socketcan here")
def test_can_interface_must_exist_and_be_up(tmp_path: Path) -> None:
    def write_interface(name: str, kind: str, flags: str) -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "flags").write_text(f"{flags}\n")

    write_interface("can0", "280", "0x40081")
    write_interface("can1", "280", "0x40080")
    write_interface("eth0", "1", "0x1003")

    def check_interface(name: str) -> tuple[str, str]:
        found = devices.check_can_interface("device a", "socketcan", name, tmp_path)
        return found.mark, found.text

    assert check_interface("can0") == ("well", "can0: is up")
    assert check_interface("can1") == ("wrong", "can1: is down")
    assert check_interface("eth0") == ("wrong", "eth0: not a CAN interface")
    assert check_interface("can7") == ("wrong", "can7: no such interface; existing CAN interfaces: can0, can1")


def test_missing_package_of_a_can_interface_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "msgpack", None)  # as if it were not installed
    found = devices.check_can_interface("device a", "udp_multicast", "239.74.163.2")
    assert (found.mark, found.text) == ("wrong", "CAN interface udp_multicast needs the package msgpack")
    assert found.do == install_command("imu-monitor[multicast]")


def test_iio_device_and_its_permissions_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", {"in_timestamp": "le:s64/64>>0"})
    user = pwd.getpwuid(os.geteuid()).pw_name

    def check(name: str, enable: bool) -> tuple[str, str]:
        found = devices.check_iio_device("device a", name, enable, tmp_path)
        return found.mark, found.text

    good = f"{device.node}: exists, and {user} has the necessary permissions"
    assert check("bmi160", True) == ("well", good)
    assert check("bmi160", False) == ("doubt", f"{device.node}: its buffer is not enabled")
    (device.folder / "buffer/enable").write_text("1\n")
    assert check("bmi160", False) == ("well", good)
    assert check("bmi270", False)[0] == "wrong"
    enabled = device.folder / "buffer/enable"
    monkeypatch.setattr(os, "access", lambda path, mode: path != enabled)  # root may write every file
    assert check("bmi160", True) == ("wrong", f"{enabled}: {user} cannot write it, as enable = true needs")
    monkeypatch.setattr(os, "access", lambda path, mode: path != device.node)
    assert check("bmi160", True) == ("wrong", f"{device.node}: does not exist, or {user} cannot read it")
    device.unplug()


# --- outputs


def test_used_ports_and_silent_routers_are_found(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as free:
        busy, idle = taken.getsockname()[1], free.getsockname()[1]
        free.close()
        text = (
            VIRTUAL
            + f'[zenoh]\nlisten = ["tcp/127.0.0.1:{busy}"]\n'
            + f'connect = ["tcp/127.0.0.1:{busy}", "tcp/127.0.0.1:{idle}"]\n'
            + f'[viewer]\nmode = "none"\n[metrics]\nlisten = "127.0.0.1:{busy}"\n'
        )
        found = examine_config(tmp_path, text)
    assert [
        (finding.mark, finding.text.partition(": ")[2].partition(":")[0]) for finding in select_findings(found, "zenoh")
    ] == [
        ("doubt", "another program listens there"),
        ("well", "answers"),
        ("doubt", "no answer"),
    ]
    assert require_one_finding(found, "metrics").mark == "doubt"


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:99999", f"tcp/{'a' * 70}.example:1", "tcp/192.0.2.1:7447"])
def test_address_that_cannot_be_bound_is_wrong(endpoint: str) -> None:
    found = network.check_port_free("zenoh", endpoint)
    assert found.mark == "wrong"
    assert found.text.startswith(f"{endpoint}: cannot listen: ")


def test_unprotected_listening_beyond_this_machine_is_found(tmp_path: Path) -> None:
    text = (
        VIRTUAL + '[zenoh]\nlisten = ["tcp/0.0.0.0:0"]\n[viewer]\nmode = "none"\n[metrics]\nlisten = "0.0.0.0:9464"\n'
    )
    found = examine_config(tmp_path, text)
    assert "everyone who reaches this machine can read all data and send commands" in str(
        select_findings(found, "zenoh")
    )
    assert "everyone who reaches this machine can read the metrics" in str(select_findings(found, "metrics"))


def test_router_of_ros2_is_checked(tmp_path: Path) -> None:
    def check(port: int) -> list[DoctorFinding]:
        text = VIRTUAL + QUIET + f'[ros2]\ndomain = 0\nconnect = ["tcp/127.0.0.1:{port}"]\n'
        return select_findings(examine_config(tmp_path, text), "ros2")

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert [one.mark for one in check(port)] == ["well"]
    assert [one.mark for one in check(port)] == ["doubt"]


def test_influx_server_and_token_are_checked(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("s3cret")
    token.chmod(0o644)

    def check(url: str) -> list[DoctorFinding]:
        text = VIRTUAL + QUIET + f'[influx]\nurl = "{url}"\ntoken_file = "token"\n'
        return select_findings(examine_config(tmp_path, text), "influx")

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        (answer,) = check(f"http://127.0.0.1:{port}/write")
    assert (answer.mark, answer.text) == ("well", f"tcp/127.0.0.1:{port}: answers")
    (silence,) = check(f"http://127.0.0.1:{port}/write")
    assert silence.mark == "doubt"
    assert f"tcp/127.0.0.1:{port}: no answer" in silence.text
    unencrypted = check("http://influx.invalid/write")
    assert [one.do for one in unencrypted if "everyone on the network" in one.text] == ["use https"]
    assert not any("everyone on the network" in one.text for one in check("https://influx.invalid/write"))


@pytest.mark.skipif(os.name != "posix", reason="permissions are not POSIX's here")
def test_exposed_token_is_wrong(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("s3cret")
    text = VIRTUAL + QUIET + '[influx]\nurl = "http://127.0.0.1:1/write"\ntoken_file = "token"\n'
    for mode, mark in ((0o644, "wrong"), (0o640, "well")):
        token.chmod(mode)
        assert require_one_finding(examine_config(tmp_path, text), "influx token").mark == mark


def test_storage_folder_is_tested_and_left_unchanged(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    found = require_one_finding(
        examine_config(tmp_path, VIRTUAL + QUIET + '[storage]\nfolder = "kept/here"\n'), "storage"
    )
    assert found.mark in ("well", "doubt")
    assert "about 0.328 GB per day" in found.text
    assert not (tmp_path / "kept").exists()
    (tmp_path / "file").touch()
    found = require_one_finding(
        examine_config(tmp_path, VIRTUAL + QUIET + '[storage]\nfolder = "file/here"\n'), "storage"
    )
    assert (found.mark, "cannot be written" in found.text) == ("wrong", True)


def test_unknown_rate_gives_unknown_disk_use(tmp_path: Path) -> None:
    text = VIRTUAL.replace("rate = 100.0\n", "") + QUIET + '[storage]\nfolder = "kept"\n'
    found = examine_config(tmp_path, text)
    assert "disk use per day unknown" in str(select_findings(found, "storage"))
    config = loading.load_config(tmp_path / "c.toml")
    assert recorded_bytes_per_day(config) is None


def test_disk_space_is_rated_by_the_days_it_lasts(tmp_path: Path) -> None:
    own = Storage(folder=tmp_path, keep_s=30 * 86400.0, disk_share=0.9)
    marks = [
        check_disk_space(own, 1e9, 100_000_000_000, free) for free in (90_000_000_000, 25_000_000_000, 10_500_000_000)
    ]
    assert [finding.mark for finding in marks] == ["well", "doubt", "wrong"]
    assert "the oldest data will be deleted after about 15 days" in marks[1].text


def test_sample_size_estimate_agrees_with_a_packed_segment(tmp_path: Path) -> None:
    """Pack ten minutes of noise that uses all bits of a 32-bit float, as the daemon does."""
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


def test_installed_libraries_satisfy_the_requirements() -> None:
    found = installation_and_clock.check_library_versions()
    assert [finding.mark for finding in found] == ["well"], found
    required = {one.name: optional for one, optional in installation_and_clock.library_requirements()}
    assert required["numpy"] is False
    assert required["rerun-sdk"] is True
    assert "pytest" not in required


@pytest.mark.long
def test_kernel_cache_folder_is_none_only_if_nothing_is_writable(tmp_path: Path) -> None:
    assert kernel_cache_folder() is not None
    program = "from monitor.common.compiled import kernel_cache_folder; print(kernel_cache_folder())"
    copy = tmp_path / "copy"
    shutil.copytree(
        Path(installation_and_clock.__file__).parents[2], copy / "monitor", ignore=shutil.ignore_patterns("__pycache__")
    )
    (copy / "monitor" / "common" / "__pycache__").touch()  # no folder can be created at this path
    (tmp_path / "file").touch()
    environment = {**os.environ, "PYTHONPATH": str(copy), "HOME": str(tmp_path / "file")}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    for more, wanted in (({}, "None"), ({"NUMBA_CACHE_DIR": str(tmp_path / "cache")}, str(tmp_path / "cache"))):
        done = subprocess.run(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            env={**environment, **more},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip().startswith(wanted)


def test_clock_check_advises_only_if_not_synchronised() -> None:
    found = installation_and_clock.check_clock()
    assert found.mark in ("well", "doubt")
    assert bool(found.do) == ("not synchronised" in found.text)


@pytest.mark.parametrize(
    ("properties", "mark"),
    [
        ({"ActiveState": "active", "NRestarts": "0", "UnitFileState": "enabled"}, "well"),
        ({"ActiveState": "active", "NRestarts": "7", "UnitFileState": "enabled"}, "doubt"),
        ({"ActiveState": "active", "NRestarts": "0", "UnitFileState": "disabled"}, "doubt"),
        ({"ActiveState": "inactive", "NRestarts": "0"}, "doubt"),
        ({"ActiveState": "failed", "NRestarts": "0"}, "wrong"),
    ],
)
def test_systemd_unit_state_is_rated(properties: dict[str, str], mark: str) -> None:
    assert [
        finding.mark
        for finding in installation_and_clock.check_systemd_unit_state({"LoadState": "loaded", **properties})
    ] == [mark]


# --- the command


def run_doctor(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "imu_monitor", "doctor", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(CONFIG_FOLDER.parent), "COLUMNS": "200"}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.mark.long
def test_command_prints_one_sign_per_line_and_returns_1_on_errors(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + QUIET)
    (tmp_path / "c.toml").chmod(0o600)
    well = run_doctor(tmp_path, "c.toml", "--json", "found.json")
    assert (well.returncode, well.stderr) == (0, "")
    assert all(line.lstrip()[0] in "✓!→" for line in well.stdout.splitlines())
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["schema"] == "imu-monitor/doctor/1"
    assert {finding["mark"] for finding in found["findings"]} <= {"well", "doubt"}
    assert {"mark", "about", "text", "do"} == set(found["findings"][0])
    (tmp_path / "c.toml").chmod(0o666)
    wrong = run_doctor(tmp_path, "c.toml")
    assert (wrong.returncode, wrong.stderr) == (1, "")
    assert "✗  permissions" in wrong.stdout
    assert "→ chmod o-w c.toml" in wrong.stdout


@pytest.mark.long
def test_json_on_standard_output_is_not_mixed_with_text(tmp_path: Path) -> None:
    done = run_doctor(tmp_path, "none.toml", "--json", "-")
    assert done.returncode == 1
    assert {finding["about"] for finding in json.loads(done.stdout)["findings"]} >= {
        "configuration",
        "libraries",
        "clock",
    }
    refused = run_doctor(tmp_path, "--json", "nowhere/x.json")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1


@pytest.mark.parametrize("name", [RECORDING_LOCK, HISTORY_LOCK])
def test_folder_used_by_another_process_is_found(name: str, tmp_path: Path) -> None:
    text = VIRTUAL + QUIET + f'[storage]\nfolder = "{tmp_path / "kept"}"\n'
    assert not [
        finding for finding in select_findings(examine_config(tmp_path, text), "storage") if "in use" in finding.text
    ]
    lock = FolderLock(tmp_path / "kept", name)
    assert lock.ensure_held() == ""
    (found,) = [
        finding for finding in select_findings(examine_config(tmp_path, text), "storage") if "in use" in finding.text
    ]
    assert found.mark == "doubt"
    assert found.text == f"{tmp_path / 'kept'}: in use by process {os.getpid()}"
    assert "choose another folder" in found.do
    lock.release()


def test_fifo_in_place_of_the_folder_is_found(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "kept")
    text = VIRTUAL + QUIET + f'[storage]\nfolder = "{tmp_path / "kept"}"\n'
    found = [
        finding for finding in select_findings(examine_config(tmp_path, text), "storage") if finding.mark == "wrong"
    ]
    assert "is a FIFO, not a folder" in found[-1].text
