"""Checks of ports and endpoints: whether a port is free, and whether an endpoint answers."""

import errno
import re
import socket
from typing import Final

from monitor.commands.doctor.finding import DoctorFinding, doubt, well, wrong

CONNECT_TIMEOUT_S: Final = 2.0


MAX_PORT: Final = 65535


TCP_ENDPOINT: Final = re.compile(r"(?:tcp|tls)/\[?([^\]]+?)\]?:(\d+)(?:[?#].*)?")
"""Regular expression that matches the host and the port of a zenoh endpoint over TCP or TLS."""


LOOPBACK: Final = ("127.", "::1", "localhost")


def check_port_free(subject: str, endpoint: str) -> DoctorFinding:
    """Check that a port is free by listening on it briefly.

    Parameters
    ----------
    subject : str
        Subject of the finding, shown before the result.
    endpoint : str
        Zenoh endpoint.
    """
    address = _parse_endpoint(subject, endpoint, "cannot listen")
    if isinstance(address, DoctorFinding):
        return address
    try:
        with socket.create_server(address, family=socket.AF_INET6 if ":" in address[0] else socket.AF_INET):
            return well(subject, f"{endpoint}: free")
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            do = "no problem if it is this service; otherwise end it, or choose another port"
            return doubt(subject, f"{endpoint}: another program listens there", do)
        return wrong(subject, f"{endpoint}: cannot listen: {getattr(error, 'strerror', None) or error}")


def check_reachable(about: str, endpoint: str) -> DoctorFinding:
    """Check that a program answers at an endpoint."""
    address = _parse_endpoint(about, endpoint, "no answer")
    if isinstance(address, DoctorFinding):
        return address
    try:
        with socket.create_connection(address, timeout=CONNECT_TIMEOUT_S):
            return well(about, f"{endpoint}: answers")
    except (OSError, UnicodeError) as error:
        text = f"{endpoint}: no answer: {getattr(error, 'strerror', None) or error}"
        do = "start the program there, or check cables and firewalls; the service tries again"
        return doubt(about, text, do)


def _parse_endpoint(about: str, endpoint: str, failure: str) -> tuple[str, int] | DoctorFinding:
    """Return the host and the port of a TCP endpoint, or a finding if the endpoint cannot be checked."""
    match = TCP_ENDPOINT.fullmatch(endpoint)
    if match is None:
        return well(about, f"{endpoint}: not checked, since only TCP endpoints can be checked")
    if int(match[2]) > MAX_PORT:
        return wrong(about, f"{endpoint}: {failure}: the largest port is {MAX_PORT}")
    return match[1], int(match[2])
