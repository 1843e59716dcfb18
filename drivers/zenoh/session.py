"""zenoh sessions that are closed unless told otherwise: a peer that scouts nobody and listens nowhere.

Nothing is opened here: the link, the daemon's results and ``watch`` each open the session of a configuration.
"""

import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.credential_masking import masked
from drivers.file_access import check_regular

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


SECRET_FILES: Final = (
    "transport/link/tls/listen_private_key",
    "transport/link/tls/connect_private_key",
    "transport/auth/usrpwd/dictionary_file",
    "transport/auth/pubkey/private_key_file",
)
"""Keys of files that nobody else should read."""
PUBLIC_FILES: Final = (
    "transport/link/tls/root_ca_certificate",
    "transport/link/tls/listen_certificate",
    "transport/link/tls/connect_certificate",
    "transport/auth/pubkey/public_key_file",
    "transport/auth/pubkey/known_keys_file",
)


def configuration(
    own: Mapping[str, Any], file: str | Path | None = None, unsaid: Mapping[str, Any] = CLOSED
) -> "zenoh.Config":
    """zenoh's configuration: ``own`` keys that are not None, over the file's, over ``unsaid``.

    Raises:
        zenoh.ZError: a file or a value that zenoh refuses
    """
    import zenoh

    defaults = zenoh.Config()
    if file:
        _check_file(Path(file))
    config = zenoh.Config.from_file(str(file)) if file else zenoh.Config()
    for named in _named_files(config):
        _check_file(named)
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
    return _named_files(config, SECRET_FILES)


def _named_files(config: "zenoh.Config", keys: Sequence[str] | None = None) -> tuple[Path, ...]:
    """Files that a configuration names; those of ``keys`` alone, or all."""
    found = (json.loads(config.get_json(key)) for key in keys or (*SECRET_FILES, *PUBLIC_FILES))
    return tuple(Path(named) for named in found if named)


def _check_file(path: Path) -> None:
    """Raise ZError if something else than a regular file has this name: zenoh would wait for a FIFO without end."""
    import zenoh

    try:
        check_regular(path)
    except FileNotFoundError:
        return  # zenoh says so itself
    except OSError as error:
        raise zenoh.ZError(f"{path}: {error.strerror or error}") from error
