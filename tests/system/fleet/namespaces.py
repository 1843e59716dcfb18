"""Two network namespaces with a virtual cable between them, which a test can interrupt. This needs root."""

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

INSIDE, OUTSIDE = "10.213.77.1", "10.213.77.2"


@dataclass(frozen=True)
class NamespacePair:
    """Names of two connected namespaces. Their addresses are INSIDE and OUTSIDE."""

    inside: str
    outside: str

    def start_python(self, namespace: str, *arguments: str) -> "subprocess.Popen[str]":
        """Start Python in a namespace. The caller ends the process and closes its pipes."""
        command = ["ip", "netns", "exec", namespace, sys.executable, *arguments]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def set_cable(self, state: str) -> None:
        """Connect (``up``) or interrupt (``down``) the cable."""
        _ip("-n", self.inside, "link", "set", "inside", state)


@contextlib.contextmanager
def create_namespaces() -> Iterator[NamespacePair]:
    """Create two namespaces and remove them at the end. Skip the test if they cannot be created."""
    if os.name != "posix" or os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and ip (iproute2)")
    namespaces = NamespacePair(f"imu-a-{os.getpid()}", f"imu-b-{os.getpid()}")
    with contextlib.ExitStack() as stack:
        for name in (namespaces.inside, namespaces.outside):
            added = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
            if added.returncode:
                pytest.skip(f"no network namespaces here: {added.stderr.strip()}")
            stack.callback(_ip, "netns", "del", name)
        _ip(
            "-n",
            namespaces.inside,
            "link",
            "add",
            "inside",
            "type",
            "veth",
            "peer",
            "name",
            "outside",
            "netns",
            namespaces.outside,
        )
        for name, end, address in ((namespaces.inside, "inside", INSIDE), (namespaces.outside, "outside", OUTSIDE)):
            _ip("-n", name, "addr", "add", f"{address}/30", "dev", end)
            _ip("-n", name, "link", "set", end, "up")
            _ip("-n", name, "link", "set", "lo", "up")
        yield namespaces


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
