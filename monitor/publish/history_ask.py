"""Histories of other daemons, asked over zenoh: what ``imu-monitor history --connect`` does.

A session of its own for one question: a client of the endpoint that is given, closed but for that. An answer that is no
answer of a history is left out and said; where none comes, the reason is an error.
"""

import json
from typing import Any, Final

from drivers.errors import ConfigError, LinkUnavailable, NotReady
from drivers.zenoh_session import CLOSED, configuration, plain
from monitor import topics
from monitor.history.past import Past
from monitor.publish import history_message

PATIENCE_S: Final = 20.0
ERRORS: Final = {2: ConfigError, 3: NotReady}


def ask(endpoint: str, device: str, parameters: str, prefix: str = "imu") -> list[Past]:
    """The histories that answer, by device; ``device`` may be ``*``.

    Raises:
        ConfigError: no endpoint, or a question that is wrong
        LinkUnavailable: nobody is there, or nobody answers
        NotReady: there is nothing in that time
    """
    import zenoh

    try:
        config = configuration({"connect/endpoints": [endpoint], "mode": "client"}, None, CLOSED)
    except zenoh.ZError as error:
        raise ConfigError(f'--connect: "{endpoint}": no endpoint; write e.g. {topics.ENDPOINT}') from error
    selector = f"{topics.HISTORY.key(prefix, device)}?{parameters}"
    try:
        with zenoh.open(config) as session:
            replies = list(session.get(selector, timeout=PATIENCE_S))
    except zenoh.ZError as error:
        raise LinkUnavailable(f"{endpoint}: {plain(error)}") from error
    found, wrong = [], [_wrong(reply.err) for reply in replies if reply.ok is None]
    for reply in replies:
        if reply.ok is not None:
            try:
                found.append(history_message.read(bytes(reply.ok.payload)))
            except ValueError as error:
                wrong.append(LinkUnavailable(f"{reply.ok.key_expr}: not an answer of a history: {error}"))
    if not found:
        raise wrong[0] if wrong else LinkUnavailable(f"{endpoint}: nobody answers for {device}; is history kept there?")
    return sorted(found, key=lambda one: one.device)


def _wrong(error: Any) -> Exception:
    """What a daemon said."""
    try:
        said = json.loads(bytes(error.payload))
        text, status = history_message.clean(str(said["error"])[:500]), said.get("exit")
    except (ValueError, KeyError, TypeError, AttributeError):
        return LinkUnavailable("the daemon gave no answer, and no reason that can be read")
    return ERRORS.get(status, LinkUnavailable)(text)
