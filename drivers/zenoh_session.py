"""zenoh sessions that are closed unless told otherwise: a peer that scouts nobody and listens nowhere.

Nothing is opened here: the link, the daemon's results and ``watch`` each open the session of a configuration.
"""

import contextlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.masked import masked

if TYPE_CHECKING:
    import zenoh

CLOSED: Final[Mapping[str, Any]] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "listen/endpoints": [],
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
    "transport/link/rx/max_message_size": 64_000_000,
}
"""What a session is unless told otherwise; zenoh's own defaults scout and listen everywhere, and take in 1 GiB at once.

Who was there once is looked for every second. A longer message is dropped piece by piece as it comes, and the
connection stays; an hour of a 1 kHz sensor in one batch would fit.
"""


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
    """zenoh's reason in one line: without the place in its own source code, and without what a file says there.

    The line that zenoh shows of a file it cannot read may hold a password.
    """
    text = re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error))
    text = re.sub(r"\s*-->\s*(\d+):(\d+)\s*\n.*\n\s*=\s*", r"line \1, column \2: ", text, flags=re.DOTALL)
    text = re.sub(r"(invalid (?:type|value): \w+) (?:`[^`]*`|\"[^\"]*\")", r"\1", text)
    text = re.sub(
        r'JSON error: Message \{ msg: "(.*)", location: Some\(Location \{ (line): (\d+), (column): (\d+) \}\) \}',
        r"\2 \3, \4 \5: \1",
        text,
    )
    return masked(" ".join(text.split()))


def alone(session: "zenoh.Session") -> bool:
    """Whether this session is connected to nobody; False once it is closed."""
    import zenoh

    with contextlib.suppress(zenoh.ZError):
        return not session.info.routers_zid() and not session.info.peers_zid()
    return False


def endpoints(config: "zenoh.Config") -> tuple[str, ...]:
    """Where this configuration connects to; a list for each mode is that of its own."""
    found = json.loads(config.get_json("connect/endpoints"))
    if isinstance(found, dict):
        found = found.get(json.loads(config.get_json("mode")) or "peer", [])
    return tuple(str(one) for one in found)


def secret_files(config: "zenoh.Config") -> tuple[Path, ...]:
    """Files of this configuration that nobody else should read: private keys and lists of passwords."""
    keys = [f"transport/link/tls/{side}_private_key" for side in ("listen", "connect")]
    keys += ["transport/auth/usrpwd/dictionary_file", "transport/auth/pubkey/private_key_file"]
    return tuple(Path(named) for key in keys if (named := json.loads(config.get_json(key))))
