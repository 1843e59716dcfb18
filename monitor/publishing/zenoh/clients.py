"""Clients that request coefficients or stored results from daemons, for ``export --connect`` and ``history --connect``.

Each query of stored results opens a separate zenoh session that connects only to the given endpoint. Invalid replies
are ignored. If no reply is valid, the query raises an exception with the reason.
"""

import json
import time
from pathlib import Path
from typing import Any, Final

from drivers.errors import ConfigError, LinkUnavailable, NotReady
from drivers.secret_masking import mask_secrets
from drivers.zenoh.connection_diagnosis import explain_refusals
from drivers.zenoh.session_config import format_zenoh_error
from monitor.common import topics
from monitor.common.control_characters import remove_control_characters
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.messages.history import decode_history
from monitor.publishing.remote_device_states import split_device_and_topic
from monitor.publishing.zenoh.subscriber import ZenohSubscriber, client_configurations

PATIENCE_S: Final = 20.0
"""Time for which a client waits for the first message or for the reply to a query."""
FURTHER_DEVICES_S: Final = 2.0
"""Time for which the client waits for messages of further devices, if no device is named."""


def receive_coefficients(
    endpoint: str | None, device: str | None, prefix: str = "imu", file: Path | None = None
) -> dict[str, bytes]:
    """Return the newest message ``imu/<device>/coefficients`` of each device, as JSON.

    Parameters
    ----------
    endpoint
        Endpoint of a daemon or router. By default, the first endpoint in ``file`` is used, or the default endpoint.
    device
        Name of the device. If None, the messages of all devices are returned.
    prefix
        Prefix of the daemon's zenoh keys.
    file
        zenoh configuration file with certificates or a password.

    Raises
    ------
    ConfigError
        If the endpoint, the configuration file or the name is invalid.
    LinkUnavailable
        If no message arrives in time.
    """
    subscriber = ZenohSubscriber(topics.COEFFICIENTS.key(prefix, device or "*"), [endpoint] if endpoint else [], file)
    subscriber.start()
    found: dict[str, bytes] = {}
    try:
        deadline_s = time.monotonic() + PATIENCE_S
        while (left_s := deadline_s - time.monotonic()) > 0.0 and not (found and device):
            for message in subscriber.take(left_s):
                key = split_device_and_topic(message.key)
                if key is not None and key[1] is topics.COEFFICIENTS and message.payload is not None:
                    if not found:
                        deadline_s = min(deadline_s, time.monotonic() + FURTHER_DEVICES_S)
                    found[key[0].removeprefix(f"{prefix}/")] = message.payload
        state = subscriber.state
    finally:
        subscriber.close()
    if not found:
        where = mask_secrets(endpoint or str(file or topics.ENDPOINT))
        raise LinkUnavailable(f"{where}: no coefficients of {device or 'any device'} in {PATIENCE_S:g} s ({state})")
    return found


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
