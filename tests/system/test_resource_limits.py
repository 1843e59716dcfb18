"""Tests of a daemon that has too few file descriptors or little address space for its devices."""

import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.waiting import PATIENCE_S, wait_for
from tests.system.test_stopped_process import find_udp_port

DEVICES = 20
DEVICE = """
[[device]]
name = "d{i}"
driver = {{ link = "udp", port = {port}, decoder = "text", decoder_options = {{ columns = ["gx"] }} }}
"""
OUTPUTS = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n[service]\nworkers = 1\n'


@pytest.mark.long
@pytest.mark.parametrize(
    ("limit", "reason"),
    [("-n 40", None), ("-n 20", "too many open files"), ("-v 1500000", "can't start new thread|cannot allocate")],
)
def test_device_receives_or_the_status_says_why_not(limit: str, reason: str | None, tmp_path: Path) -> None:
    ports = [find_udp_port() for _ in range(DEVICES)]
    config, log = tmp_path / "daemon.toml", tmp_path / "daemon.log"
    config.write_text(OUTPUTS + "".join(DEVICE.format(i=i, port=port) for i, port in enumerate(ports)))
    with log.open("wb") as out, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        daemon = subprocess.Popen(
            [
                "/bin/sh",
                "-c",
                f'ulimit {limit} && exec "$@"',
                "",
                sys.executable,
                "-m",
                "imu_monitor",
                "run",
                str(config),
            ],
            stdout=subprocess.DEVNULL,
            stderr=out,
        )

        def states() -> dict[str, str]:
            return dict(re.findall(r"device=(\w+) .*(state=.*)", log.read_text()))

        def explained() -> bool:
            for port in ports:
                sender.sendto(b"0.1\n0.2\n0.3\n", ("127.0.0.1", port))
            texts = states().values()
            known = [bool(re.search(f"state=running|{reason}", text)) for text in texts]
            return daemon.poll() is not None or (len(known) == DEVICES and all(known))

        try:
            wait_for(explained, log.read_text)
            running = daemon.poll() is None
            daemon.send_signal(signal.SIGTERM)
            status = daemon.wait(PATIENCE_S)
        finally:
            daemon.kill()
            daemon.wait()
    # A library may abort the process if the address space is used up.
    assert running or (status != 0 and limit.startswith("-v"))
    if reason is None:
        assert all("state=running" in text for text in states().values())
