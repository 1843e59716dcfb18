"""Tests of the TOML parser."""

import pytest

from drivers.errors import ConfigError
from monitor.settings.toml_parser import parse_toml


def test_integers_of_64_bits_are_parsed() -> None:
    text = "a = 9223372036854775807\nb = [-9223372036854775808]\n[c]\nd = 1e300"
    assert parse_toml(text) == {"a": 2**63 - 1, "b": [-(2**63)], "c": {"d": 1e300}}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a = 9223372036854775808", "more than 64 bits"),
        ("[a]\nb = [{c = -9223372036854775809}]", "more than 64 bits"),
        ("a = " + "9" * 5000, "digits"),
        ("a = 0x" + "f" * 5000, "more than 64 bits"),
        ("a = " + "[" * 3000, "too deep"),
        ("a = 1979-13-01", "not TOML"),
        ("a", "not TOML"),
    ],
)
def test_invalid_text_is_refused_in_one_line(text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        parse_toml(text)
    assert "\n" not in str(error.value)
