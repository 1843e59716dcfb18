"""Why an endpoint does not let us in: zenoh itself only says that it could not connect.

In come an endpoint and the configuration it was tried with, out goes one line, "" where nobody listens there at all or
the endpoint is of a kind that cannot be asked (QUIC, UDP). What is tried is what zenoh does first: a connection and,
for TLS, the handshake with the same certificates, so the words are those of the failure itself. Nothing is sent beyond
that handshake. May wait for ``timeout_s`` twice: never to be called where samples pass.
"""

import json
import re
import socket
import ssl
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from drivers.credential_masking import masked

if TYPE_CHECKING:
    import zenoh

TIMEOUT_S: Final = 2.0
ANSWERS: Final = "answers, but lets us not in: check user and password"
"""All that is left once connection and handshake are well."""
_ENDPOINT: Final = re.compile(r"(tcp|tls|ws|wss)/\[?([^\]?#]+?)\]?:(\d+)(?:[?#].*)?")
_OF_TLS: Final = {
    "CERTIFICATE_REQUIRED": "wants a certificate of ours: set connect_certificate and connect_private_key",
    "UNKNOWN_CA": "does not accept our certificate: it is not signed by its authority",
    "CERTIFICATE_EXPIRED": "does not accept our certificate: it has expired",
    "BAD_CERTIFICATE": "does not accept our certificate",
    "DECRYPT_ERROR": "does not accept our certificate: it is not signed by its authority",
    "WRONG_VERSION_NUMBER": "speaks no TLS",
    "UNEXPECTED_EOF_WHILE_READING": "speaks no TLS",
}


def refused(endpoints: Sequence[str], config: "zenoh.Config") -> str:
    """Why these do not let us in, those that have no reason left out."""
    found = [(endpoint, why(endpoint, config)) for endpoint in endpoints]
    return "; ".join(f"{masked(endpoint)}: {reason}" for endpoint, reason in found if reason)


def why(endpoint: str, config: "zenoh.Config", timeout_s: float = TIMEOUT_S) -> str:
    """One line, without the endpoint."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None:
        return ""
    protocol, host, port = found.groups()
    try:
        with socket.create_connection((host, int(port)), timeout_s) as plain:
            if protocol not in ("tls", "wss"):
                return ANSWERS
            return _handshake(plain, host, config)
    except ConnectionRefusedError:
        return ""
    except socket.gaierror:
        return f'there is no host "{host}"'
    except TimeoutError:
        return "does not answer"
    except OSError as error:
        return f"cannot be reached: {error.strerror or error}"


def _handshake(plain: socket.socket, host: str, config: "zenoh.Config") -> str:
    try:
        context = _context(json.loads(config.get_json("transport/link/tls")))
    except (OSError, ssl.SSLError) as error:
        return f"our certificates cannot be read: {getattr(error, 'strerror', None) or error}"
    try:
        with context.wrap_socket(plain, server_hostname=host) as secure:
            secure.recv(1)  # in TLS 1.3 a refusal of our certificate comes after the handshake
    except TimeoutError:
        return ANSWERS  # it waits for zenoh's first message
    except ssl.SSLCertVerificationError as error:
        return f"its certificate does not hold: {error.verify_message}"
    except ssl.SSLError as error:
        reason = error.reason or ""
        return next((text for word, text in _OF_TLS.items() if word in reason), f"refuses TLS: {reason.lower()}")
    except ConnectionResetError:
        return "hangs up in the handshake"
    return ANSWERS


def _context(tls: dict[str, Any]) -> ssl.SSLContext:
    """TLS as zenoh has it of these settings."""
    context = ssl.create_default_context(cafile=tls.get("root_ca_certificate"))
    context.check_hostname = tls.get("verify_name_on_connect") is not False
    certificate, key = tls.get("connect_certificate"), tls.get("connect_private_key")
    if tls.get("enable_mtls") and certificate and key:
        context.load_cert_chain(certificate, key)
    return context
