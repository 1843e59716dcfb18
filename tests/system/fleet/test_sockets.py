"""Tests that the daemon and its viewer listen only on loopback, by their sockets and by a port scan from outside."""

import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.support.ports import free_port
from tests.support.waiting import PATIENCE_S, stays_true, wait_for
from tests.system.fleet.namespaces import INSIDE, create_namespaces

LOOPBACK = ("127.0.0.1", "::1", "::ffff:127.0.0.1")
CONFIG = """
[[device]]
name = "bench-1"
rate = 100.0
driver = {{ link = "virtual" }}
[zenoh]
listen = ["tcp/127.0.0.1:{zenoh}"]
[viewer]
mode = "web"
port = {port}
web_port = {web}
"""
SCAN = """
import errno, json, socket, sys
found = {"open": [], "closed": 0}
for port in range(1, 65536):
    with socket.socket() as s:
        s.settimeout(0.5)
        code = s.connect_ex((sys.argv[1], port))
        if code == 0:
            found["open"].append(port)
        elif code == errno.ECONNREFUSED:
            found["closed"] += 1
print(json.dumps(found))
"""
OPEN_PORT = "import socket, sys; s = socket.create_server(('0.0.0.0', 45678)); print('up', flush=True); input()"


@contextlib.contextmanager
def start_daemon(path: Path, *before: str) -> Iterator[psutil.Process]:
    """Start ``imu-monitor run`` with the web viewer in a separate process."""
    ports = {name: free_port() for name in ("zenoh", "port", "web")}
    path.write_text(CONFIG.format(**ports))
    child = subprocess.Popen(
        [*before, sys.executable, "-m", "imu_monitor", "run", str(path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        yield psutil.Process(child.pid)
    finally:
        child.send_signal(signal.SIGTERM)
        _, output = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, output


def listening_sockets(process: psutil.Process) -> set[tuple[str, str]]:
    """Return program and address of every listening TCP socket and open UDP socket of a process and its children."""
    found = set()
    for member in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            for s in member.net_connections("inet"):
                if s.laddr and (s.status == psutil.CONN_LISTEN or s.status == psutil.CONN_NONE):
                    found.add((member.name(), s.laddr.ip))
    return found


def count_listening_sockets(pid: int) -> int:
    """Return the number of listening TCP sockets in the network namespace of a process."""
    lines = Path(f"/proc/{pid}/net/tcp").read_text("ascii").splitlines()[1:]
    return sum(line.split()[3] == "0A" for line in lines)


def test_every_socket_of_the_daemon_and_its_viewer_is_on_loopback(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with start_daemon(tmp_path / "a.toml") as process:
        wait_for(lambda: len({name for name, _ in listening_sockets(process)}) > 1)
        wait_for(
            lambda: any(name.startswith("rerun") for name, _ in listening_sockets(process)), "a socket of the viewer"
        )
        assert stays_true(lambda: {address for _, address in listening_sockets(process)} <= set(LOOPBACK), 1.0)


def test_scan_from_another_namespace_finds_no_port_of_the_daemon(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with create_namespaces() as namespaces:
        open_port = namespaces.start_python(
            namespaces.inside, "-c", OPEN_PORT.replace("input()", "import time; time.sleep(86_400)")
        )
        try:
            assert open_port.stdout is not None
            assert open_port.stdout.readline() == "up\n"
            with start_daemon(tmp_path / "a.toml", "ip", "netns", "exec", namespaces.inside) as process:
                wait_for(lambda: any(child.name().startswith("rerun") for child in process.children(True)))
                # zenoh, two of the viewer, and the port of OPEN_PORT
                wait_for(lambda: count_listening_sockets(process.pid) >= 4)
                scan = namespaces.start_python(namespaces.outside, "-c", SCAN, INSIDE)
                output, _ = scan.communicate(timeout=PATIENCE_S)
        finally:
            open_port.kill()
            open_port.communicate()
    # the scan can find an open port, namely the port that this test opened on purpose
    assert json.loads(output) == {"open": [45678], "closed": 65534}
