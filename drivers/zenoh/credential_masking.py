"""Masking of passwords in text for logs, status and error messages.

Two kinds of secrets are masked: the password in a URL (``scheme://user:password@host``), and the value of a key such as
``password`` in a configuration file or a zenoh endpoint. File names are not secrets. The module does no I/O.
"""

import re
from typing import Final

MASK: Final = "***"
# Matching the whole URL scheme would take quadratic time, so the pattern matches only its last character.

_URL_PASSWORD: Final = re.compile(r"([a-z0-9+.-]:?//?[^/\s:@\"']*):[^/\s@\"']+@", re.IGNORECASE)
_NAMED_SECRET: Final = re.compile(
    r"""(["']?\b\w*(?:password|passwd|passphrase|secret|token|private_key_base64)["']?\s*[:=]\s*)"""
    r"""("(?:[^"\\]|\\.)+"|'(?:[^'\\]|\\.)+'|(?!null\b)["']?[^\s;,}"']+)""",
    re.IGNORECASE,
)


def mask_secrets(text: str) -> str:
    """Return the text with each secret replaced by three stars.

    >>> mask_secrets("rfc2217://bench:hunter2@10.0.0.7:4000 is busy")
    'rfc2217://bench:***@10.0.0.7:4000 is busy'
    >>> mask_secrets('usrpwd: {user: "nose", password: "hunter2"}')
    'usrpwd: {user: "nose", password: ***}'
    >>> mask_secrets("tls/h:7447#listen_private_key_base64=MIIE;so=1")
    'tls/h:7447#listen_private_key_base64=***;so=1'
    """
    return _NAMED_SECRET.sub(rf"\1{MASK}", _URL_PASSWORD.sub(rf"\1:{MASK}@", text))


def has_secret(text: str) -> bool:
    """Return True if the text contains a secret that ``mask_secrets`` would replace.

    >>> has_secret('password: "x"'), has_secret('listen_private_key: "key.pem"'), has_secret("password: null")
    (True, False, False)
    """
    return mask_secrets(text) != text
