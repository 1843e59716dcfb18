"""Diagnosis of connection errors. zenoh itself does not report the cause of a connection error.

The functions connect to an endpoint with the configuration of the failed attempt. For TLS, the test includes the
handshake with the same certificates. The result is one line of text, or "" if no program listens at the endpoint or the
protocol is QUIC or UDP. Testing an endpoint may take twice ``timeout_s``, so a thread that processes samples must not
run the test.
"""

import json
import re
import socket
import ssl
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from drivers.errors import describe_error
from drivers.secret_masking import mask_secrets

if TYPE_CHECKING:
    import zenoh

TIMEOUT_S: Final = 2.0
LOGIN_REFUSED: Final = "answers, but refuses the login: check user and password"
"""Only possible reason if the connection and the handshake succeed."""
UNKNOWN_AUTHORITY: Final = "does not accept our certificate: it is not signed by its authority"
_ENDPOINT: Final = re.compile(r"(tcp|tls|ws|wss)/\[?([^\]?#]+?)\]?:(\d+)(?:[?#].*)?")
_TLS_REASONS: Final = {
    "CERTIFICATE_REQUIRED": "requires a certificate of ours: set connect_certificate and connect_private_key",
    "UNKNOWN_CA": UNKNOWN_AUTHORITY,
    "CERTIFICATE_EXPIRED": "does not accept our certificate: it has expired",
    "BAD_CERTIFICATE": "does not accept our certificate",
    "DECRYPT_ERROR": UNKNOWN_AUTHORITY,
    "WRONG_VERSION_NUMBER": "speaks no TLS",
    "UNEXPECTED_EOF_WHILE_READING": "speaks no TLS",
}


def explain_refusals(endpoints: Sequence[str], config: "zenoh.Config") -> str:
    """Return the reasons why endpoints refuse a connection. An endpoint is omitted if the reason is unknown.

    Parameters
    ----------
    endpoints
        Endpoints such as "tcp/127.0.0.1:7447".
    config
        Configuration of the zenoh session.
    """
    found = [(endpoint, explain_refusal(endpoint, config)) for endpoint in endpoints]
    return "; ".join(f"{mask_secrets(endpoint)}: {reason}" for endpoint, reason in found if reason)


def explain_refusal(endpoint: str, config: "zenoh.Config", timeout_s: float = TIMEOUT_S) -> str:
    """Return the reason why an endpoint refuses a connection, or "" if the reason is unknown.

    Parameters
    ----------
    endpoint
        Endpoint such as "tcp/127.0.0.1:7447".
    config
        Configuration of the zenoh session.
    timeout_s
        Longest wait in s for the connection, and again for the handshake.
    """
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None:
        return ""
    protocol, host, port = found.groups()
    try:
        with socket.create_connection((host, int(port)), timeout_s) as plain:
            if protocol not in ("tls", "wss"):
                return LOGIN_REFUSED
            return _explain_handshake_failure(plain, host, config)
    except ConnectionRefusedError:
        return ""
    except socket.gaierror:
        return f'there is no host "{host}"'
    except TimeoutError:
        return "does not answer"
    except OSError as error:
        return f"cannot be reached: {describe_error(error)}"


def _explain_handshake_failure(plain: socket.socket, host: str, config: "zenoh.Config") -> str:
    try:
        context = _tls_context(json.loads(config.get_json("transport/link/tls")))
    except (OSError, ssl.SSLError) as error:
        return f"our certificates cannot be read: {describe_error(error)}"
    try:
        with context.wrap_socket(plain, server_hostname=host) as secure:
            secure.recv(1)  # TLS 1.3 rejects a certificate after the handshake
    except TimeoutError:
        return LOGIN_REFUSED  # the endpoint waits for the first zenoh message
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is not valid: {error.verify_message}"
    except ssl.SSLError as error:
        reason = error.reason or ""
        return next((text for word, text in _TLS_REASONS.items() if word in reason), f"refuses TLS: {reason.lower()}")
    except ConnectionResetError:
        return "hangs up in the handshake"
    return LOGIN_REFUSED


def _tls_context(tls: dict[str, Any]) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=tls.get("root_ca_certificate"))
    context.check_hostname = tls.get("verify_name_on_connect") is not False
    certificate, key = tls.get("connect_certificate"), tls.get("connect_private_key")
    if tls.get("enable_mtls") and certificate and key:
        context.load_cert_chain(certificate, key)
    return context
