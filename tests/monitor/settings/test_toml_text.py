"""TOML text: tables, or a ConfigError of one line."""

import pytest

from drivers.errors import ConfigError
from monitor.settings.toml_text import format_tables


def test_whole_numbers_of_64_bits() -> None:
    text = "a = 9223372036854775807\nb = [-9223372036854775808]\n[c]\nd = 1e300"
    assert format_tables(text) == {"a": 2**63 - 1, "b": [-(2**63)], "c": {"d": 1e300}}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a = 9223372036854775808", "beyond 64 bits"),
        ("[a]\nb = [{c = -9223372036854775809}]", "beyond 64 bits"),
        ("a = " + "9" * 5000, "digits"),
        ("a = 0x" + "f" * 5000, "beyond 64 bits"),
        ("a = " + "[" * 3000, "too deep"),
        ("a = 1979-13-01", "not TOML"),
        ("a", "not TOML"),
    ],
)
def test_what_is_wrong_is_one_line(text: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why) as error:
        format_tables(text)
    assert "\n" not in str(error.value)
