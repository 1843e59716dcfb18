"""Tests of the modules that each command loads, and of commands without extras, each in a separate process."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.host.extras import EXTRAS, install_command
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session

ROOT = Path(__file__).parents[1]
OPTIONAL = {
    "scipy", "can", "cantools", "rerun", "matplotlib", "jinja2", "pyarrow", "PyEMD", "pywt", "prometheus_client",
    "msgpack", "rosbags", "pyulog", "pymavlink", "re2",
}  # fmt: skip
"""Modules that only extras install."""
SERVICES = {"http.server", "socketserver"}
"""Standard modules of optional services of the daemon."""
HEAVY = {"numba", "llvmlite", "structlog", "asyncio", "zenoh", "rich", "serial"}
"""Modules that are not needed to read a configuration."""
PROGRAM = """
import atexit, json, sys
sys.path.insert(0, sys.argv.pop(1))
absent, loaded, commands = json.loads(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
sys.modules.update(dict.fromkeys(absent))  # as if they were not installed
atexit.register(lambda: open(loaded, "w").write(json.dumps([name for name in sys.modules if sys.modules[name]])))
import imu_monitor
for command in commands:
    sys.argv[1:] = command
    try:
        imu_monitor.main()
    except SystemExit as end:
        if end.code:
            raise
"""
SERIAL = """
[zenoh]
listen = ["{endpoint}"]
[viewer]
mode = "none"
[[device]]
name = "imu"
rate = 100.0
window = "60s"
driver = {{ link = "serial", port = "{port}", baudrate = 921600, decoder = "text", decoder_options = {{ columns = [
    "gx", "gy", "gz", "ax", "ay", "az"], gyro_unit = "rad/s", accel_unit = "m/s^2" }} }}
"""


def build_command(folder: Path, *arguments: object, absent: tuple[str, ...] = ()) -> list[str]:
    """Return a command that runs the program and writes the names of its loaded modules to ``folder`` at its end."""
    return build_command_sequence(folder, [arguments], absent)


def build_command_sequence(folder: Path, commands: Sequence[Sequence[object]], absent: tuple[str, ...]) -> list[str]:
    """Return a command that runs the program once for each list of arguments, up to the first failure."""
    arguments = json.dumps([list(map(str, command)) for command in commands])
    return [sys.executable, "-c", PROGRAM, str(ROOT), json.dumps(absent), str(folder / "modules.json"), arguments]


def run_program(folder: Path, *arguments: object, absent: tuple[str, ...] = ()) -> tuple[int, str]:
    """Run the program and return its exit status and standard error."""
    return run_sequence(folder, [arguments], absent)


def run_sequence(folder: Path, commands: Sequence[Sequence[object]], absent: tuple[str, ...]) -> tuple[int, str]:
    """Run the program once for each list of arguments, and return the exit status and standard error."""
    command = build_command_sequence(folder, commands, absent)
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    return done.returncode, done.stderr


def read_loaded_modules(folder: Path) -> set[str]:
    return set(json.loads((folder / "modules.json").read_text()))


def test_help_loads_no_heavy_library(tmp_path: Path) -> None:
    assert run_program(tmp_path, "--help") == (0, "")
    assert not read_loaded_modules(tmp_path) & (OPTIONAL | SERVICES | HEAVY | {"numpy", "pydantic"})


def test_check_of_serial_devices_loads_no_heavy_library(tmp_path: Path) -> None:
    assert run_program(tmp_path, "check", CONFIG_FOLDER / "serial.toml") == (0, "")
    loaded = read_loaded_modules(tmp_path)
    assert not loaded & (OPTIONAL | SERVICES | HEAVY)
    assert not [name for name in loaded if name.startswith(("drivers.recordings", "drivers.links.replay"))]


def test_check_of_can_device_loads_the_can_libraries(tmp_path: Path) -> None:
    """This shows that the other tests of this file can detect loaded libraries."""
    assert run_program(tmp_path, "check", CONFIG_FOLDER / "can.toml") == (0, "")
    assert read_loaded_modules(tmp_path) & (OPTIONAL | SERVICES | HEAVY) >= {"can", "cantools"}


@contextlib.contextmanager
def simulate_serial_sensor() -> Iterator[str]:
    """Provide a serial port that receives a line of six numbers every 10 ms."""
    pty, tty = pytest.importorskip("pty"), pytest.importorskip("tty")
    master, terminal = pty.openpty()
    tty.setraw(terminal)
    os.set_blocking(master, False)
    ended = threading.Event()

    def write_lines() -> None:
        rng, start_s, count = np.random.default_rng(1), time.monotonic(), 0
        while not ended.wait(0.01):
            due = int((time.monotonic() - start_s) * 100.0)
            rows = 1e-3 * rng.standard_normal((due - count, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
            count = due
            with contextlib.suppress(BlockingIOError):  # nobody reads yet
                os.write(master, "".join(" ".join(f"{x:.6f}" for x in row) + "\n" for row in rows).encode())

    thread = threading.Thread(target=write_lines)
    thread.start()
    try:
        yield os.ttyname(terminal)
    finally:
        ended.set()
        thread.join()
        os.close(terminal)
        os.close(master)


@pytest.mark.parametrize("absent", [(), tuple(sorted(OPTIONAL))], ids=["all extras", "no extras"])
def test_daemon_with_serial_device_needs_no_extra(tmp_path: Path, absent: tuple[str, ...]) -> None:
    """The daemon publishes coefficients and compensated samples, and ends after SIGINT."""
    endpoint, messages = free_endpoint(), dict[str, Any]()
    path = tmp_path / "serial.toml"
    with simulate_serial_sensor() as port:
        path.write_text(SERIAL.format(endpoint=endpoint, port=port))
        with (
            (tmp_path / "log").open("wb") as log,
            subprocess.Popen(build_command(tmp_path, "run", path, absent=absent), stdout=log, stderr=log) as process,
        ):
            try:
                with connect_to_daemon(endpoint, process) as listener:
                    subscription = listener.declare_subscriber(
                        "imu/imu/*", lambda sample: messages.update(get_topic_and_payload(sample))
                    )
                    wait_for(lambda: has_estimate(messages.get("coefficients")), (tmp_path / "log").read_text)
                    wait_for(lambda: "compensated" in messages, "compensated samples")
                    subscription.undeclare()
                process.send_signal(signal.SIGINT)
                assert process.wait(PATIENCE_S) == 0
            finally:
                process.kill()
    assert not read_loaded_modules(tmp_path) & (OPTIONAL | SERVICES)
    assert "serial" in read_loaded_modules(tmp_path)


@contextlib.contextmanager
def connect_to_daemon(endpoint: str, process: subprocess.Popen[bytes]) -> Iterator[Any]:
    """Open a zenoh session with the daemon as soon as it listens."""

    def attempt() -> Any:
        assert process.poll() is None
        with contextlib.suppress(Exception):
            return open_session(connect=[endpoint])
        return None

    with wait_for(attempt, "the daemon's endpoint") as found:
        yield found


def get_topic_and_payload(sample: Any) -> dict[str, Any]:
    name = str(sample.key_expr).rpartition("/")[2]
    return {name: bytes(sample.payload)}


def has_estimate(payload: bytes | None) -> bool:
    """Return True if the payload contains an estimated coefficient."""
    return payload is not None and '"estimated"' in payload.decode()


def test_offline_commands_except_reconcile_need_no_extra(tmp_path: Path) -> None:
    absent = tuple(sorted(OPTIONAL))
    (tmp_path / "model.toml").write_text(
        "sample_rate = 20.0\n[gz.angle_random_walk]\nN = 1e-4\n[gz.bandwidth_limit]\ncutoff = 5.0\norder = 2\n"
        "[gx.angle_random_walk]\nN = 1e-4\n"
    )
    assert run_program(tmp_path, "simulate", "model.toml", "--seconds", 2400, "--out", "raw.npz", absent=absent) == (
        0,
        "",
    )
    with np.load(tmp_path / "raw.npz") as file:
        columns = dict(file)
    t = np.arange(columns["gx"].size) / 20.0
    temperature = 25.0 + 5.0 * np.sin(2.0 * np.pi * t / 1000.0)
    np.savez(tmp_path / "warm.npz", **{**columns, "gx": columns["gx"] + 1e-4 * temperature, "temperature": temperature})
    commands: list[tuple[object, ...]] = [
        ("analyze", "warm.npz", "--json", "result.json"),
        ("thermal", "fit", "warm.npz", "--out", "model.json"),
        ("thermal", "predict", "warm.npz", "--model", "model.json"),
        ("compensate", "warm.npz", "--out", "compensated.npz"),
        ("compensate", "warm.npz", "--out", "ar.npz", "--method", "ar"),
        ("export", CONFIG_FOLDER / "models" / "consumer-mems.toml", "--format", "kalibr", "--out", "imu.yaml"),
    ]
    assert run_sequence(tmp_path, commands, absent) == (0, "")
    assert not read_loaded_modules(tmp_path) & OPTIONAL
    result = json.loads((tmp_path / "result.json").read_text())
    assert '"without_temperature"' in json.dumps(result)


def test_reconcile_without_scipy_names_the_missing_extra(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", fs=100.0, gx=np.random.default_rng(1).standard_normal(6000))
    line = f"imu-monitor: reconcile needs SciPy: {install_command('imu-monitor[reconcile]')}\n"
    assert run_program(tmp_path, "reconcile", "x.npz", "--out", "found", absent=("scipy",)) == (2, line)
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("x.bag", f"rosbags: {install_command('imu-monitor[ros]')}"),
        ("x.ulg", f"pyulog: {install_command('imu-monitor[px4]')}"),
        ("x.bin", f"pymavlink: {install_command('imu-monitor[ardupilot]')}"),
    ],
)
def test_a_recording_without_its_extra_is_refused_in_one_line(tmp_path: Path, name: str, line: str) -> None:
    (tmp_path / name).write_bytes(b"\xa3\x95\x80\x80")  # other .bin files contain captured bytes
    refused = (2, f"imu-monitor: {name}: this recording needs {line}\n")
    assert run_program(tmp_path, "analyze", name, absent=tuple(sorted(OPTIONAL))) == refused


CAN_DEVICE = """
[zenoh]
mode = "none"
[[device]]
name = "bus"
[device.driver]
{link}
decoder = "dbc"
[device.driver.decoder_options]
file = "j1939_imu"
signals = {{ gx = "AngularRateInformation.RollRate" }}
"""


@pytest.mark.parametrize(
    ("name", "absent", "packages"),
    [("check", ("can", "cantools"), "python-can and cantools"), ("run", ("can",), "python-can")],
)
@pytest.mark.parametrize(
    ("link", "source"),
    [('link = "can"\nchannel = "can0"', "a CAN bus"), ('link = "replay"\npath = "x.asc"', "a CAN log")],
)
def test_can_device_without_can_libraries_names_the_missing_extra(
    tmp_path: Path, name: str, absent: tuple[str, ...], packages: str, link: str, source: str
) -> None:
    (tmp_path / "x.asc").write_text("")
    (tmp_path / "can.toml").write_text(CAN_DEVICE.format(link=link))
    status, stderr = run_program(tmp_path, name, "can.toml", absent=absent)
    assert status == 2
    assert f"driver: {source} needs {packages}: {install_command('imu-monitor[can]')}" in stderr
    assert "Traceback" not in stderr


def test_install_command_belongs_to_the_environment_of_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The short form is right only if the shell finds the pip beside the Python of the program."""
    own, other = tmp_path / "my env" / "bin", tmp_path / "other"
    for folder in (own, other):
        folder.mkdir(parents=True)
        (folder / "pip").write_text("#!/bin/sh\n")
        (folder / "pip").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(own / "python"))
    monkeypatch.setenv("PATH", f"{own}:{other}")
    assert install_command("imu-monitor[ros]") == 'pip install "imu-monitor[ros]"'
    for path in (f"{other}:{own}", str(tmp_path)):
        monkeypatch.setenv("PATH", path)
        assert install_command("imu-monitor[ros]") == f"'{own}/python' -m pip install \"imu-monitor[ros]\""


def test_extras_in_messages_agree_with_pyproject() -> None:
    """The extra in a message installs every package in this message, and ``all`` installs all extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        assert {re.split("[<>=]", item)[0] for item in extras[extra]} == {name.lower() for name in packages.values()}
    (everything,) = extras["all"]
    named = set(re.findall(r"\w+", everything.partition("[")[2]))
    assert named == set(extras) - {"all", "test", "docs", "fuzz"}
    base = " ".join(project["dependencies"])
    assert not [name for name in ("scipy", "can", "matplotlib", "pyarrow", "rerun") if name in base]
