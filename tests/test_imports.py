"""Modules that each command loads, and commands without extras. Each command runs in a process of its own."""

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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.extras import EXTRAS
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import session

ROOT = Path(__file__).parents[1]
OPTIONAL = {
    "scipy", "can", "cantools", "rerun", "matplotlib", "jinja2", "pyarrow", "PyEMD", "pywt", "prometheus_client",
    "msgpack", "rosbags", "pyulog", "pymavlink",
}  # fmt: skip
"""Modules that only extras bring."""
SERVICES = {"http.server", "socketserver"}
"""Modules of optional services of the daemon."""
COMPUTING = {"numba", "llvmlite", "structlog", "asyncio", "zenoh", "rich", "serial"}
"""Modules that reading a configuration does not need."""
PROGRAM = """
import atexit, json, sys
sys.path.insert(0, sys.argv.pop(1))
absent, loaded = json.loads(sys.argv.pop(1)), sys.argv.pop(1)
sys.modules.update(dict.fromkeys(absent))  # as if they were not installed
atexit.register(lambda: open(loaded, "w").write(json.dumps([one for one in sys.modules if sys.modules[one]])))
import imu_monitor
imu_monitor.main()
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


def command(folder: Path, *arguments: object, absent: tuple[str, ...] = ()) -> list[str]:
    """The program, which writes the names of its modules to ``folder`` at its end."""
    loaded = str(folder / "modules.json")
    return [sys.executable, "-c", PROGRAM, str(ROOT), json.dumps(absent), loaded, *map(str, arguments)]


def call(folder: Path, *arguments: object, absent: tuple[str, ...] = ()) -> tuple[int, str]:
    """Exit status and standard error."""
    words = command(folder, *arguments, absent=absent)
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    return done.returncode, done.stderr


def loaded(folder: Path) -> set[str]:
    return set(json.loads((folder / "modules.json").read_text()))


def test_help_loads_no_library_that_computes(tmp_path: Path) -> None:
    assert call(tmp_path, "--help") == (0, "")
    assert not loaded(tmp_path) & (OPTIONAL | SERVICES | COMPUTING | {"numpy", "pydantic"})


def test_check_of_serial_devices_loads_no_library_that_computes(tmp_path: Path) -> None:
    assert call(tmp_path, "check", CONFIG_FOLDER / "serial.toml") == (0, "")
    assert not loaded(tmp_path) & (OPTIONAL | SERVICES | COMPUTING)


def test_check_of_a_can_device_loads_the_libraries_of_can(tmp_path: Path) -> None:
    """So that the tests beside this one would see them."""
    assert call(tmp_path, "check", CONFIG_FOLDER / "can.toml") == (0, "")
    assert loaded(tmp_path) & (OPTIONAL | SERVICES | COMPUTING) >= {"can", "cantools"}


@contextlib.contextmanager
def sensor() -> Iterator[str]:
    """A serial port that prints a line of six numbers every 10 ms."""
    pty, tty = pytest.importorskip("pty"), pytest.importorskip("tty")
    master, terminal = pty.openpty()
    tty.setraw(terminal)
    os.set_blocking(master, False)
    ended = threading.Event()

    def feed() -> None:
        rng, start_s, count = np.random.default_rng(1), time.monotonic(), 0
        while not ended.wait(0.01):
            due = int((time.monotonic() - start_s) * 100.0)
            rows = 1e-3 * rng.standard_normal((due - count, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
            count = due
            with contextlib.suppress(BlockingIOError):  # nobody reads yet
                os.write(master, "".join(" ".join(f"{x:.6f}" for x in row) + "\n" for row in rows).encode())

    thread = threading.Thread(target=feed)
    thread.start()
    try:
        yield os.ttyname(terminal)
    finally:
        ended.set()
        thread.join()
        os.close(terminal)
        os.close(master)


@pytest.mark.parametrize("absent", [(), tuple(sorted(OPTIONAL))], ids=["all extras", "no extras"])
def test_a_daemon_of_a_serial_device_needs_no_extra(tmp_path: Path, absent: tuple[str, ...]) -> None:
    """It publishes coefficients and compensated samples and ends by Ctrl-C."""
    endpoint, messages = free_endpoint(), dict[str, Any]()
    path = tmp_path / "serial.toml"
    with sensor() as port:
        path.write_text(SERIAL.format(endpoint=endpoint, port=port))
        with (
            (tmp_path / "log").open("wb") as log,
            subprocess.Popen(command(tmp_path, "run", path, absent=absent), stdout=log, stderr=log) as process,
        ):
            try:
                with opened(endpoint, process) as listener:
                    subscription = listener.declare_subscriber("imu/imu/*", lambda one: messages.update(keep(one)))
                    wait_for(lambda: estimated(messages.get("coefficients")), (tmp_path / "log").read_text)
                    wait_for(lambda: "compensated" in messages, "compensated samples")
                    subscription.undeclare()
                process.send_signal(signal.SIGINT)
                assert process.wait(PATIENCE_S) == 0
            finally:
                process.kill()
    assert not loaded(tmp_path) & (OPTIONAL | SERVICES)
    assert "serial" in loaded(tmp_path)


@contextlib.contextmanager
def opened(endpoint: str, process: subprocess.Popen[bytes]) -> Iterator[Any]:
    """A session with the daemon, once it listens."""

    def attempt() -> Any:
        assert process.poll() is None
        with contextlib.suppress(Exception):
            return session(connect=[endpoint])
        return None

    with wait_for(attempt, "the daemon's endpoint") as found:
        yield found


def keep(sample: Any) -> dict[str, Any]:
    name = str(sample.key_expr).rpartition("/")[2]
    return {name: bytes(sample.payload)}


def estimated(payload: bytes | None) -> bool:
    """Whether N of gx is there."""
    return payload is not None and '"estimated"' in payload.decode()


def test_offline_commands_need_no_scipy(tmp_path: Path) -> None:
    """All but reconcile."""
    absent = tuple(sorted(OPTIONAL))
    (tmp_path / "model.toml").write_text(
        "sample_rate = 20.0\n[gz.angle_random_walk]\nN = 1e-4\n[gz.bandwidth_limit]\ncutoff = 5.0\norder = 2\n"
        "[gx.angle_random_walk]\nN = 1e-4\n"
    )
    assert call(tmp_path, "simulate", "model.toml", "--seconds", 7200, "--out", "raw.npz", absent=absent) == (0, "")
    with np.load(tmp_path / "raw.npz") as file:
        columns = dict(file)
    t = np.arange(columns["gx"].size) / 20.0
    temperature = 25.0 + 5.0 * np.sin(2.0 * np.pi * t / 3000.0)
    np.savez(tmp_path / "warm.npz", **{**columns, "gx": columns["gx"] + 1e-4 * temperature, "temperature": temperature})
    for arguments in (
        ("analyze", "warm.npz", "--json", "result.json"),
        ("thermal", "fit", "warm.npz", "--out", "model.json"),
        ("thermal", "predict", "warm.npz", "--model", "model.json"),
        ("compensate", "warm.npz", "--out", "compensated.npz"),
        ("compensate", "warm.npz", "--out", "ar.npz", "--method", "ar"),
        ("export", CONFIG_FOLDER / "models" / "consumer-mems.toml", "--format", "kalibr", "--out", "imu.yaml"),
    ):
        assert call(tmp_path, *arguments, absent=absent) == (0, ""), arguments
        assert not loaded(tmp_path) & OPTIONAL
    result = json.loads((tmp_path / "result.json").read_text())
    assert '"without_temperature"' in json.dumps(result)


def test_reconcile_without_its_extra_is_refused_in_one_line(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", fs=100.0, gx=np.random.default_rng(1).standard_normal(6000))
    line = 'imu-monitor: reconcile needs SciPy: pip install "imu-monitor[reconcile]"\n'
    assert call(tmp_path, "reconcile", "x.npz", "--out", "found", absent=("scipy",)) == (2, line)
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("x.bag", 'rosbags: pip install "imu-monitor[ros]"'),
        ("x.ulg", 'pyulog: pip install "imu-monitor[px4]"'),
        ("x.bin", 'pymavlink: pip install "imu-monitor[ardupilot]"'),
    ],
)
def test_a_recording_without_its_extra_is_refused_in_one_line(tmp_path: Path, name: str, line: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    refused = (2, f"imu-monitor: {name}: this recording needs {line}\n")
    assert call(tmp_path, "analyze", name, absent=tuple(sorted(OPTIONAL))) == refused


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


@pytest.mark.parametrize("name", ["check", "run"])
@pytest.mark.parametrize(
    ("absent", "packages"), [(("can", "cantools"), "python-can and cantools"), (("can",), "python-can")]
)
@pytest.mark.parametrize(
    ("link", "what"),
    [('link = "can"\nchannel = "can0"', "a CAN bus"), ('link = "replay"\npath = "x.asc"', "a CAN log")],
)
def test_a_can_device_without_the_extra_is_refused_by_its_name(
    tmp_path: Path, name: str, absent: tuple[str, ...], packages: str, link: str, what: str
) -> None:
    (tmp_path / "x.asc").write_text("")
    (tmp_path / "can.toml").write_text(CAN_DEVICE.format(link=link))
    status, told = call(tmp_path, name, "can.toml", absent=absent)
    assert status == 2
    assert f'driver: {what} needs {packages}: pip install "imu-monitor[can]"' in told
    assert "Traceback" not in told


def test_extras_are_those_of_the_package() -> None:
    """Every package that a message names is brought by the extra that it names, and all extras by ``all``."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        assert {re.split("[<>=]", one)[0] for one in extras[extra]} == {one.lower() for one in packages.values()}
    (everything,) = extras["all"]
    named = set(re.findall(r"\w+", everything.partition("[")[2]))
    assert named == set(extras) - {"all", "test", "fuzz"}
    base = " ".join(project["dependencies"])
    assert not [one for one in ("scipy", "can", "matplotlib", "pyarrow", "rerun") if one in base]
