"""Client that requests stored results from daemons over zenoh, for ``imu-monitor history --connect``.

Each query opens a separate zenoh session that connects only to the given endpoint. Invalid replies are ignored. If no
reply is valid, the query raises an exception with the reason.
"""

import json
from pathlib import Path
from typing import Any, Final

from drivers.credential_masking import mask_secrets
from drivers.errors import ConfigError, LinkUnavailable, NotReady
from drivers.zenoh.connection_diagnosis import explain_refusals
from drivers.zenoh.session_config import format_zenoh_error
from monitor.common import topics
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.messages.history import decode_history
from monitor.publishing.messages.message import remove_control_characters
from monitor.publishing.zenoh.subscriber import client_configurations

PATIENCE_S: Final = 20.0
"""Timeout of a history query."""
ERRORS: Final = {2: ConfigError, 3: NotReady}
"""Exception class for each exit status that an error reply contains."""


def query_histories(
    endpoint: str | None, device: str, parameters: str, prefix: str = "imu", file: Path | None = None
) -> list[HistoryTable]:
    """Return the stored results of all devices that reply, sorted by device.

    Parameters
    ----------
    endpoint
        Endpoint of a daemon or router. By default, the first endpoint in ``file`` is used, or the default endpoint.
    device
        Name of the device, or ``*`` for all devices.
    parameters
        Parameters of the zenoh selector, which ``monitor.history.query_parameters`` describes.
    prefix
        Prefix of the daemon's zenoh keys.
    file
        zenoh configuration file with certificates or a password.

    Raises
    ------
    ConfigError
        If the endpoint, the configuration file or the query is invalid.
    LinkUnavailable
        If no daemon can be reached, or if no daemon accepts the connection or replies.
    NotReady
        If no results are stored for the time range.
    """
    import zenoh

    endpoint, config = next(iter(client_configurations([endpoint] if endpoint else [], file).items()))
    selector = f"{topics.HISTORY.key(prefix, device)}?{parameters}"
    try:
        with zenoh.open(config) as session:
            replies = list(session.get(selector, timeout=PATIENCE_S))
    except zenoh.ZError as error:
        raise LinkUnavailable(
            explain_refusals([endpoint], config) or f"{mask_secrets(endpoint)}: {format_zenoh_error(error)}"
        ) from error
    endpoint = mask_secrets(endpoint)
    found, errors = [], [_error_of_reply(reply.err) for reply in replies if reply.ok is None]
    for reply in replies:
        if reply.ok is not None:
            try:
                found.append(decode_history(bytes(reply.ok.payload)))
            except ValueError as error:
                errors.append(LinkUnavailable(f"{reply.ok.key_expr}: not a history message: {error}"))
    if not found:
        raise (
            errors[0]
            if errors
            else LinkUnavailable(f"{endpoint}: no answer for {device}; check that the daemon stores a history")
        )
    return sorted(found, key=lambda one: one.device)


def _error_of_reply(error: Any) -> Exception:
    try:
        reply = json.loads(bytes(error.payload))
        text, status = remove_control_characters(str(reply["error"])[:500]), reply.get("exit")
    except (ValueError, KeyError, TypeError, AttributeError):
        return LinkUnavailable("the daemon sent an error without a readable reason")
    return ERRORS.get(status, LinkUnavailable)(text)
