"""zenoh sessions that are closed unless told otherwise: a peer that scouts nobody and listens nowhere.

Nothing is opened here: the link, the daemon's results and ``watch`` each open the session of a configuration.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import zenoh

CLOSED: Final[Mapping[str, Any]] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "listen/endpoints": [],
}
"""What a session is unless told otherwise; zenoh's own defaults scout and listen everywhere."""


def configuration(
    own: Mapping[str, Any], file: str | Path | None = None, unsaid: Mapping[str, Any] = CLOSED
) -> "zenoh.Config":
    """zenoh's configuration: ``own`` keys that are not None, over the file's, over ``unsaid``.

    Raises:
        zenoh.ZError: a file or a value that zenoh refuses
    """
    import zenoh

    defaults = zenoh.Config()
    config = zenoh.Config.from_file(str(file)) if file else zenoh.Config()
    for key, value in unsaid.items():
        if config.get_json(key) == defaults.get_json(key):
            config.insert_json5(key, json.dumps(value))
    for key, value in own.items():
        if value is not None:
            config.insert_json5(key, json.dumps(value))
    return config


def plain(error: Exception) -> str:
    """zenoh's reason without the place in its own source code."""
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", " ".join(str(error).split()))
