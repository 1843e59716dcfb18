"""TCP ports for tests, none of which is handed out twice on this machine.

A port that the kernel picks can be taken by any other process between the moment it is released and the moment the
program under test binds it. Ports are therefore taken from a range below the kernel's ephemeral ports. Each port is
claimed by a UDP socket that is bound to the same number until the process ends, so that parallel test processes get
different ports. A UDP socket does not prevent a program from listening on the TCP port of the same number.
"""

import random
import socket
from typing import Final

FIRST_PORT: Final = 10_000
LAST_PORT: Final = 30_000
ATTEMPTS: Final = 1000

_random = random.SystemRandom()  # pytest-randomly seeds the shared generator alike in all workers
_claims: list[socket.socket] = []


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that no other test gets.

    Raises
    ------
    RuntimeError
        If no free port is found in 1000 attempts.
    """
    for _ in range(ATTEMPTS):
        port = _random.randrange(FIRST_PORT, LAST_PORT)
        claim = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            claim.bind(("127.0.0.1", port))
            with socket.create_server(("127.0.0.1", port)):
                pass
        except OSError:
            claim.close()
            continue
        _claims.append(claim)
        return port
    raise RuntimeError(f"no free port between {FIRST_PORT} and {LAST_PORT} in {ATTEMPTS} attempts")


def free_endpoint(protocol: str = "tcp") -> str:
    """Return a zenoh endpoint on a free port of 127.0.0.1."""
    return f"{protocol}/127.0.0.1:{free_port()}"


def release_claims() -> None:
    """Close the sockets that claim ports, at the end of the test session."""
    while _claims:
        _claims.pop().close()
