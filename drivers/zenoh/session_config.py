"""Configuration of zenoh sessions. By default, a session neither searches for other programs nor accepts connections.

The link, the publisher and the command ``watch`` open separate sessions.
"""

import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers.host.safe_file_reading import check_regular_file
from drivers.secret_masking import mask_secrets, remember_secrets_in

if TYPE_CHECKING:
    import zenoh

DEFAULT_CONFIGURATION: Final[Mapping[str, Any]] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "listen/endpoints": [],
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
    "transport/link/rx/max_message_size": 64_000_000,
    "transport/shared_memory/enabled": False,
}
"""Default configuration of a zenoh session.

With the defaults of zenoh, a session would search for other programs and listen on all network interfaces, and would
accept messages of 1 GiB. A lost connection is retried at least once per second. A message longer than 64 MB is dropped,
and the connection stays open. A message of 64 MB could contain an hour of samples at 1 kHz. Shared memory is not used,
because zenoh would wake two threads 30 times per second for it.
"""

SECRET_FILES: Final = (
    "transport/link/tls/listen_private_key",
    "transport/link/tls/connect_private_key",
    "transport/auth/usrpwd/dictionary_file",
    "transport/auth/pubkey/private_key_file",
)
"""Configuration keys that name files which other users must not be able to read."""
PUBLIC_FILES: Final = (
    "transport/link/tls/root_ca_certificate",
    "transport/link/tls/listen_certificate",
    "transport/link/tls/connect_certificate",
    "transport/auth/pubkey/public_key_file",
    "transport/auth/pubkey/known_keys_file",
)
"""Configuration keys that name files which other users may read."""


def build_session_config(
    overrides: Mapping[str, Any], file: str | Path | None = None, defaults: Mapping[str, Any] = DEFAULT_CONFIGURATION
) -> "zenoh.Config":
    """Return the configuration of a zenoh session.

    Parameters
    ----------
    overrides
        Values of configuration keys, which take precedence over the file. A value of None is ignored.
    file
        zenoh configuration file. None uses the defaults of zenoh.
    defaults
        Values of keys that the file does not set.

    Raises
    ------
    zenoh.ZError
        If zenoh rejects the file or a value.
    """
    import zenoh

    unchanged = zenoh.Config()
    if file:
        _check_file(Path(file))
    config = zenoh.Config.from_file(str(file)) if file else zenoh.Config()
    for named in _named_files(config):
        _check_file(named)
    for key, value in defaults.items():
        if config.get_json(key) == unchanged.get_json(key):
            config.insert_json5(key, json.dumps(value))
    for key, value in overrides.items():
        if value is not None:
            config.insert_json5(key, json.dumps(value))
    remember_secrets_in(str(config))
    return config


def format_zenoh_error(error: Exception) -> str:
    """Return the text of a zenoh error as a single line.

    Source code positions are removed. Quotations from a configuration file are also removed, because they may contain
    passwords.
    """
    text = re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error))
    text = re.sub(r"\s*-->\s*(\d+):(\d+)\s*\n.*\n\s*=\s*", r"line \1, column \2: ", text, flags=re.DOTALL)
    text = re.sub(r"(invalid (?:type|value): \w+) (?:`[^`]*`|\"[^\"]*\")", r"\1", text)
    text = re.sub(
        r'JSON error: Message \{ msg: "(.*)", location: Some\(Location \{ (line): (\d+), (column): (\d+) \}\) \}',
        r"\2 \3, \4 \5: \1",
        text,
    )
    return mask_secrets(" ".join(text.split()))


def is_unconnected(session: "zenoh.Session") -> bool:
    """Return True if a session is open but has no connection."""
    import zenoh

    with contextlib.suppress(zenoh.ZError):
        return not session.info.routers_zid() and not session.info.peers_zid()
    return False


def find_connect_endpoints(config: "zenoh.Config") -> tuple[str, ...]:
    """Return the endpoints to which a session with the given configuration connects."""
    found = json.loads(config.get_json("connect/endpoints"))
    if isinstance(found, dict):
        found = found.get(json.loads(config.get_json("mode")) or "peer", [])
    return tuple(str(endpoint) for endpoint in found)


def find_secret_files(config: "zenoh.Config") -> tuple[Path, ...]:
    """Return the configured files that contain private keys or passwords and must not be readable by other users."""
    return _named_files(config, SECRET_FILES)


def _named_files(config: "zenoh.Config", keys: Sequence[str] | None = None) -> tuple[Path, ...]:
    found = (json.loads(config.get_json(key)) for key in keys or (*SECRET_FILES, *PUBLIC_FILES))
    return tuple(Path(named) for named in found if named)


def _check_file(path: Path) -> None:
    """Raise ZError if the path is not a regular file, because zenoh would wait forever when reading a FIFO."""
    import zenoh

    try:
        check_regular_file(path)
    except FileNotFoundError:
        return  # zenoh reports a missing file
    except OSError as error:
        raise zenoh.ZError(f"{path}: {error.strerror or error}") from error
