"""Client that receives the present coefficients of the devices of a daemon, for ``imu-monitor export --connect``."""

import time
from pathlib import Path
from typing import Final

from drivers.credential_masking import mask_secrets
from drivers.errors import LinkUnavailable
from monitor.common import topics
from monitor.publishing.remote_device_states import split_device_and_topic
from monitor.publishing.zenoh.subscriber import ZenohSubscriber

PATIENCE_S: Final = 20.0
"""Time for which the client waits for the first message."""
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
