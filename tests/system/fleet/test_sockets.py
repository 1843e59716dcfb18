"""What the daemon can be reached by: nothing beyond loopback, as its sockets say and as a scan from outside finds."""

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
from tests.system.fleet.namespaces import INSIDE, pair

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
OPEN = "import socket, sys; s = socket.create_server(('0.0.0.0', 45678)); print('up', flush=True); input()"


@contextlib.contextmanager
def daemon(path: Path, *before: str) -> Iterator[psutil.Process]:
    """``imu-monitor run`` with the page, as a process."""
    ports = {name: free_port() for name in ("zenoh", "port", "web")}
    path.write_text(CONFIG.format(**ports))
    child = subprocess.Popen(
        [*before, sys.executable, "-m", "monitor.cli", "run", str(path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        yield psutil.Process(child.pid)
    finally:
        child.send_signal(signal.SIGTERM)
        _, said = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, said


def listening(process: psutil.Process) -> set[tuple[str, str]]:
    """Program and address of every socket of a process and all its children that takes what comes: TCP and UDP."""
    found = set()
    for one in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            for s in one.net_connections("inet"):
                if s.laddr and (s.status == psutil.CONN_LISTEN or s.status == psutil.CONN_NONE):
                    found.add((one.name(), s.laddr.ip))
    return found


def taking(pid: int) -> int:
    """Listening TCP sockets in the namespace of a process."""
    lines = Path(f"/proc/{pid}/net/tcp").read_text("ascii").splitlines()[1:]
    return sum(line.split()[3] == "0A" for line in lines)


def test_every_socket_of_the_daemon_and_its_viewer_is_on_loopback(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with daemon(tmp_path / "a.toml") as process:
        wait_for(lambda: len({name for name, _ in listening(process)}) > 1)
        wait_for(lambda: any(name.startswith("rerun") for name, _ in listening(process)), "a socket of the viewer")
        assert stays_true(lambda: {address for _, address in listening(process)} <= set(LOOPBACK), 1.0)


def test_a_scan_from_another_namespace_finds_nothing(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with pair() as namespaces:
        beside = namespaces.python(namespaces.inside, "-c", OPEN.replace("input()", "import time; time.sleep(86_400)"))
        try:
            assert beside.stdout is not None
            assert beside.stdout.readline() == "up\n"
            with daemon(tmp_path / "a.toml", "ip", "netns", "exec", namespaces.inside) as process:
                wait_for(lambda: any(one.name().startswith("rerun") for one in process.children(True)))
                wait_for(lambda: taking(process.pid) >= 4)  # zenoh, the viewer's two, and that one
                scan = namespaces.python(namespaces.outside, "-c", SCAN, INSIDE)
                said, _ = scan.communicate(timeout=PATIENCE_S)
        finally:
            beside.kill()
            beside.communicate()
    # the scan does find what is open: the port that this test opened on purpose
    assert json.loads(said) == {"open": [45678], "closed": 65534}
