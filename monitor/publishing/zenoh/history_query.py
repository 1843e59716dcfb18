"""Histories of other daemons, asked over zenoh: what ``imu-monitor history --connect`` does.

A session of its own for one question: a client of the endpoint that is given, closed but for that. An answer that is no
answer of a history is left out and said; where none comes, the reason is an error.
"""

import json
from pathlib import Path
from typing import Any, Final

from drivers.credential_masking import masked
from drivers.errors import ConfigError, LinkUnavailable, NotReady
from drivers.zenoh.connection_errors import refused
from drivers.zenoh.session import plain
from monitor.common import topics
from monitor.history.reading import Past
from monitor.publishing.messages import history
from monitor.publishing.zenoh.subscriber import listeners

PATIENCE_S: Final = 20.0
ERRORS: Final = {2: ConfigError, 3: NotReady}


def ask(
    endpoint: str | None, device: str, parameters: str, prefix: str = "imu", file: Path | None = None
) -> list[Past]:
    """The histories that answer, by device; ``device`` may be ``*``.

    Args:
        endpoint: a daemon or router; None: the first that the file names, or the default
        prefix: of the daemon's keys
        file: a zenoh file, with certificates or a password
    Raises:
        ConfigError: no endpoint, a file that is wrong, or a question that is
        LinkUnavailable: nobody is there, lets us in, or answers
        NotReady: there is nothing in that time
    """
    import zenoh

    endpoint, config = next(iter(listeners([endpoint] if endpoint else [], file).items()))
    selector = f"{topics.HISTORY.key(prefix, device)}?{parameters}"
    try:
        with zenoh.open(config) as session:
            replies = list(session.get(selector, timeout=PATIENCE_S))
    except zenoh.ZError as error:
        raise LinkUnavailable(refused([endpoint], config) or f"{masked(endpoint)}: {plain(error)}") from error
    endpoint = masked(endpoint)
    found, wrong = [], [_wrong(reply.err) for reply in replies if reply.ok is None]
    for reply in replies:
        if reply.ok is not None:
            try:
                found.append(history.read(bytes(reply.ok.payload)))
            except ValueError as error:
                wrong.append(LinkUnavailable(f"{reply.ok.key_expr}: not an answer of a history: {error}"))
    if not found:
        raise wrong[0] if wrong else LinkUnavailable(f"{endpoint}: nobody answers for {device}; is history kept there?")
    return sorted(found, key=lambda one: one.device)


def _wrong(error: Any) -> Exception:
    """What a daemon said."""
    try:
        said = json.loads(bytes(error.payload))
        text, status = history.clean(str(said["error"])[:500]), said.get("exit")
    except (ValueError, KeyError, TypeError, AttributeError):
        return LinkUnavailable("the daemon gave no answer, and no reason that can be read")
    return ERRORS.get(status, LinkUnavailable)(text)
