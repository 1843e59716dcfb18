"""Network namespaces of a test's own: two, with a cable between them that can be pulled. Needs root."""

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
class Pair:
    """Names of two namespaces; the addresses at the ends of the cable between them are INSIDE and OUTSIDE."""

    inside: str
    outside: str

    def python(self, namespace: str, *arguments: str) -> "subprocess.Popen[str]":
        """Python in one of them; its exit and pipes are the caller's."""
        command = ["ip", "netns", "exec", namespace, sys.executable, *arguments]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def cable(self, state: str) -> None:
        """``up`` or ``down``."""
        _ip("-n", self.inside, "link", "set", "inside", state)


@contextlib.contextmanager
def pair() -> Iterator[Pair]:
    """Skips, with the reason, where namespaces cannot be made; removes them at the end."""
    if os.name != "posix" or os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and ip (iproute2)")
    found = Pair(f"imu-a-{os.getpid()}", f"imu-b-{os.getpid()}")
    with contextlib.ExitStack() as ending:
        for name in (found.inside, found.outside):
            made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
            if made.returncode:
                pytest.skip(f"no network namespaces here: {made.stderr.strip()}")
            ending.callback(_ip, "netns", "del", name)
        _ip(
            "-n",
            found.inside,
            "link",
            "add",
            "inside",
            "type",
            "veth",
            "peer",
            "name",
            "outside",
            "netns",
            found.outside,
        )
        for name, end, address in ((found.inside, "inside", INSIDE), (found.outside, "outside", OUTSIDE)):
            _ip("-n", name, "addr", "add", f"{address}/30", "dev", end)
            _ip("-n", name, "link", "set", end, "up")
            _ip("-n", name, "link", "set", "lo", "up")
        yield found


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
