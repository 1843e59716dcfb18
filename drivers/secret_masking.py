"""Masking of secrets in text for logs, status and error messages.

``mask_secrets`` masks the password in a URL (``scheme://user:password@host``), the value of a key such as ``password``
in a configuration file or a zenoh endpoint, and each secret that ``remember_secret`` has received. A server can send a
secret back in any notation. A remembered secret is therefore found in plain text, percent-encoded, in escapes of JSON
and HTML, in hexadecimal and base64 notation, with line breaks or other punctuation in it, and if a part of it is cut
off. File names are not secrets. The module does no I/O.
"""

import base64
import html
import re
from collections.abc import Iterable, Mapping
from typing import Final

MASK: Final = "***"
MIN_SECRET_CHARACTERS: Final = 6
"""Number of letters and digits of the shortest secret that is remembered. A shorter one would match ordinary words."""
FRAGMENT_CHARACTERS: Final = 8
"""Number of letters and digits in sequence that reveal a part of a secret."""

# Matching the whole URL scheme would take quadratic time, so the pattern matches only its last character.
_URL_PASSWORD: Final = re.compile(r"([a-z0-9+.-]:?//?[^/\s:@\"']*):([^/\s@\"']+)@", re.IGNORECASE)
_NAME: Final = "(?:password|passwd|passphrase|secret|token|api_?key|private_key_base64)"
# Before a colon, the name may also be the name of a file in an error message, which follows a slash.
_NAMED_SECRET: Final = re.compile(
    rf"""(["']?\b\w*{_NAME}["']?\s*=\s*|(?<![^\s"'{{\[(,;#&?])["']?[\w.-]*{_NAME}["']?\s*:\s*"""
    r"""|\bauthorization["']?\s*[:=]\s*["']?(?:token|bearer|basic)\s+)"""
    r"""("(?:[^"\\]|\\.)+"|'(?:[^'\\]|\\.)+'|(?!null\b)["']?[^\s;,}"']+)""",
    re.IGNORECASE,
)
_SECRET_VARIABLE: Final = re.compile(r"passw|passphrase|secret|token|credential|api_?key|private_?key", re.IGNORECASE)
_LETTER_OR_ESCAPE: Final = re.compile(
    r"%(?:25)*([0-9a-f]{2})|\\+(?:u00|x)([0-9a-f]{2})|\\+[nrt]|(&#?\w{1,8};)|([0-9a-z])", re.IGNORECASE | re.ASCII
)

_fragments: Final[dict[int, set[str]]] = {
    length: set() for length in range(MIN_SECRET_CHARACTERS, FRAGMENT_CHARACTERS + 1)
}
"""Fragments of the remembered secrets, by their length."""


def remember_secret(secret: str) -> None:
    """Mask a secret in all texts from now on, unless it has fewer than MIN_SECRET_CHARACTERS letters and digits."""
    plain = _decode_letters(secret)[0]
    if len(plain) < MIN_SECRET_CHARACTERS:
        return
    data = secret.encode()
    forms = [plain, data.hex()]
    for offset in range(3):  # position of the secret in a group of three bytes of base64
        first, end = -(-8 * offset // 6), 8 * (offset + len(data)) // 6  # characters that only the secret determines
        forms.append(_decode_letters(base64.b64encode(bytes(offset) + data).decode()[first:end])[0])
    for form in forms:
        if (length := min(FRAGMENT_CHARACTERS, len(form))) in _fragments:
            _fragments[length].update(form[at : at + length] for at in range(len(form) - length + 1))


def remember_secrets_in(text: str) -> None:
    """Remember the passwords in URLs and the values of keys such as ``password`` in a text."""
    for pattern in (_URL_PASSWORD, _NAMED_SECRET):
        for _, secret in pattern.findall(text):
            remember_secret(secret.strip("\"'"))


def remember_secrets_of_process(environment: Mapping[str, str], arguments: Iterable[str]) -> None:
    """Remember the secrets in the environment variables and in the arguments of the program.

    Parameters
    ----------
    environment
        Values by name. A value is secret if the name says so and the value is not a path.
    arguments
        Arguments of the program.
    """
    for name, value in environment.items():
        if _SECRET_VARIABLE.search(name) and not value.startswith("/"):
            remember_secret(value)
        remember_secrets_in(value)
    for argument in arguments:
        remember_secrets_in(argument)


def mask_secrets(text: str) -> str:
    """Return the text with each secret replaced by three stars.

    >>> mask_secrets("rfc2217://bench:hunter2@10.0.0.7:4000 is busy")
    'rfc2217://bench:***@10.0.0.7:4000 is busy'
    >>> mask_secrets('usrpwd: {user: "nose", password: "hunter2"}')
    'usrpwd: {user: "nose", password: ***}'
    >>> mask_secrets("tls/h:7447#listen_private_key_base64=MIIE;so=1")
    'tls/h:7447#listen_private_key_base64=***;so=1'
    """
    text = _mask_remembered_secrets(text) if any(_fragments.values()) else text
    return _NAMED_SECRET.sub(rf"\1{MASK}", _URL_PASSWORD.sub(rf"\1:{MASK}@", text))


def has_secret(text: str) -> bool:
    """Return True if the text contains a secret that ``mask_secrets`` would replace.

    >>> has_secret('password: "x"'), has_secret('listen_private_key: "key.pem"'), has_secret("password: null")
    (True, False, False)
    """
    return mask_secrets(text) != text


def _decode_letters(text: str) -> tuple[str, list[tuple[int, int]]]:
    """Return the letters and digits of a text in lower case without escapes, and the place of each in the text."""
    letters, places = [], []
    for match in _LETTER_OR_ESCAPE.finditer(text):
        percent, backslash, entity, plain = match.groups()
        decoded = plain or (html.unescape(entity) if entity else chr(int(percent or backslash or "0", 16)))
        if decoded.isascii() and decoded.isalnum():
            letters.append(decoded.lower())
            places.append(match.span())
    return "".join(letters), places


def _mask_remembered_secrets(text: str) -> str:
    letters, places = _decode_letters(text)
    parts, copied_to, last = [], 0, -2  # ``last`` is the last letter of the fragments found so far
    for at in range(len(letters)):
        for length, fragments in _fragments.items():
            if letters[at : at + length] in fragments:
                if at > last + 1:
                    parts += [text[copied_to : places[at][0]], MASK]
                last = max(last, at + length - 1)
                copied_to = places[last][1]
    return "".join(parts) + text[copied_to:]
