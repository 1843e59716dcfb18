"""Text for people without the passwords in it: for logs, status and errors.

What counts as a secret is the password of a URL (``scheme://user:password@host``) and whatever follows a word like
``password`` and a colon or an equals sign, as configuration files and zenoh's endpoints write it. Names of files are
no secrets. Pure.
"""

import re
from typing import Final

HIDDEN: Final = "***"
# One character of the scheme is enough. A search for all of it from every letter would take quadratic time.
_USER: Final = re.compile(r"([a-z0-9+.-]:?//?[^/\s:@\"']*):[^/\s@\"']+@", re.IGNORECASE)
_WORD: Final = re.compile(
    r"""(["']?\b\w*(?:password|passwd|passphrase|secret|token|private_key_base64)["']?\s*[:=]\s*)"""
    r"""("(?:[^"\\]|\\.)+"|'(?:[^'\\]|\\.)+'|(?!null\b)["']?[^\s;,}"']+)""",
    re.IGNORECASE,
)


def masked(text: str) -> str:
    """The same text, each secret as three stars.

    >>> masked("rfc2217://bench:hunter2@10.0.0.7:4000 is busy")
    'rfc2217://bench:***@10.0.0.7:4000 is busy'
    >>> masked('usrpwd: {user: "nose", password: "hunter2"}'), masked("tls/h:7447#listen_private_key_base64=MIIE;so=1")
    ('usrpwd: {user: "nose", password: ***}', 'tls/h:7447#listen_private_key_base64=***;so=1')
    """
    return _WORD.sub(rf"\1{HIDDEN}", _USER.sub(rf"\1:{HIDDEN}@", text))


def has_secret(text: str) -> bool:
    """Whether something in it would be masked.

    >>> has_secret('password: "x"'), has_secret('listen_private_key: "key.pem"'), has_secret("password: null")
    (True, False, False)
    """
    return masked(text) != text
