"""Tests of the masking of secrets in texts."""

import base64
import html
import json
from collections.abc import Callable
from urllib.parse import quote

import pytest

from drivers.secret_masking import (
    has_secret,
    mask_secrets,
    remember_secret,
    remember_secrets_in,
    remember_secrets_of_process,
)

SECRET = "hunter2"
TOKENS = ["q3Zt-9LkUv0_xB7mDwYp", "zk/Pq8+tR2&vN5\\wX1=b", "0123456789abcdef0123456789abcdef"]
NOTATIONS: dict[str, Callable[[str], str]] = {
    "plain": str,
    "upper case": str.upper,
    "percent": lambda token: quote(token, safe=""),
    "percent, every character": lambda token: "".join(f"%{ord(one):02x}" for one in token),
    "percent, twice": lambda token: quote(quote(token, safe=""), safe=""),
    "JSON": lambda token: json.dumps(token).replace("/", "\\/"),
    "JSON, every character": lambda token: "".join(f"\\u{ord(one):04x}" for one in token),
    "HTML": html.escape,
    "HTML, every character": lambda token: "".join(f"&#{ord(one)};" for one in token),
    "hexadecimal": lambda token: token.encode().hex(),
    "hexadecimal with colons": lambda token: token.encode().hex(":"),
    "base64": lambda token: base64.b64encode(token.encode()).decode(),
    "base64 of a header": lambda token: base64.b64encode(f"Token {token}".encode()).decode(),
    "base64 with a user": lambda token: base64.b64encode(f"me:{token}".encode()).decode(),
    "base64 for URLs": lambda token: base64.urlsafe_b64encode(f"{token}".encode()).decode(),
    "split in a header": lambda token: f"{token[:9]}\r\n {token[9:]}",
    "a character per line": "\n".join,
    "cut off": lambda token: token[: len(token) * 2 // 3],
}


@pytest.mark.parametrize("notation", NOTATIONS)
@pytest.mark.parametrize("token", TOKENS)
def test_remembered_secret_is_masked_in_every_notation(token: str, notation: str) -> None:
    echo = NOTATIONS[notation](token)
    text = f"access denied: {echo} is no token of the organisation lab, bucket 7450"
    remember_secret(token)
    masked = mask_secrets(text)
    assert all(echo[at : at + 10] not in masked for at in range(len(echo) - 9))
    assert masked.startswith("access denied: ")
    assert masked.endswith(" is no token of the organisation lab, bucket 7450")


@pytest.mark.parametrize(
    "text",
    ["HTTP 401 unauthorized access", "tcp/127.0.0.1:7450 is busy; trying again", "measured rate 99.3 Hz", "ok", ""],
)
def test_other_texts_are_unchanged_by_remembered_secrets(text: str) -> None:
    for token in TOKENS:
        remember_secret(token)
    remember_secret("ok")  # too short
    assert mask_secrets(text) == text


def test_secrets_of_configuration_environment_and_arguments_are_remembered() -> None:
    remember_secrets_in('port = "rfc2217://bench:fromconfig1@10.0.0.7:4000"\npassword = "fromconfig2"\n')
    environment = {"INFLUX_TOKEN": "fromenviron1", "DATABASE": "sql://me:fromenviron2@h/x", "TOKEN_FILE": "/run/token"}
    remember_secrets_of_process(environment, ["watch", "tls/h:1#connect_private_key_base64=fromargument"])
    for secret in ("fromconfig1", "fromconfig2", "fromenviron1", "fromenviron2", "fromargument"):
        assert mask_secrets(f"the peer said {secret}!") == "the peer said ***!"
    assert mask_secrets("/run/token: no such file") == "/run/token: no such file"


@pytest.mark.parametrize(
    "text",
    [
        f"socket://bench:{SECRET}@10.0.0.7:4000",
        f'password = "{SECRET}"',
        f'{{"password":"{SECRET}"}}',
        f"PASSWORD={SECRET}",
        f"user: 'a', password: '{SECRET}'",
        f'password: "{SECRET}',
        f'password: "a \\" {SECRET}"',
        f"tls/h:1#listen_private_key_base64={SECRET};root_ca_certificate=ca.pem",
        f"mqtt_password: {SECRET}, host: x",
        f"https://bench:{SECRET}@example.org/a?b",
        f"Authorization: Token {SECRET}",
        f'{{"authorization": "Bearer {SECRET}"}}',
    ],
)
def test_secret_is_masked(text: str) -> None:
    assert SECRET not in mask_secrets(text)
    assert has_secret(text)


@pytest.mark.parametrize(
    "text",
    [
        "tcp/127.0.0.1:7450",
        "socket://10.0.0.7:4000",
        "check user and password",
        'listen_private_key: "/etc/imu-monitor/nose.key"',
        "tls/[::1]:7447: its certificate does not hold: certificate has expired",
        '"usrpwd":{"user":null,"password":null,"dictionary_file":null}',
        'password: "", user: ""',
        "2025-11-21T06:10:00Z a@b.c",
        "/etc/imu-monitor/influx-token: No such file or directory",
        "keys/token: cannot be read",
    ],
)
def test_text_without_secret_is_unchanged(text: str) -> None:
    assert mask_secrets(text) == text
    assert not has_secret(text)


@pytest.mark.parametrize("piece", ["a", "a/", "a:", "a/b:c", "password", 'password="', "://"])
def test_secret_behind_a_megabyte_without_separators_is_masked(piece: str) -> None:
    # earlier regular expressions took hours for such a text
    long_text = piece * (1_000_000 // len(piece))
    assert SECRET not in mask_secrets(f"{long_text} password: {SECRET}")
