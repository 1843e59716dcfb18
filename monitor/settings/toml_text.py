"""TOML text -> tables, for configurations and models; what is wrong with it is a ConfigError of one line.

Numbers are those that TOML promises: whole ones within 64 bits, so that none is too large for what follows.
"""

import tomllib
from typing import Any, Final

from drivers.errors import ConfigError

MAX_INTEGER: Final = 1 << 63


def format_tables(text: str) -> dict[str, Any]:
    """The tables of the text.

    >>> format_tables("a = 1")
    {'a': 1}

    Raises:
        ConfigError: it is no TOML, is nested too deep, or holds a number beyond 64 bits
    """
    try:
        found = tomllib.loads(text)
        _check(found)
    except RecursionError as error:
        raise ConfigError("not TOML: nested too deep") from error
    except ValueError as error:  # of a number of thousands of digits, or a date that is none, too
        raise ConfigError(f"not TOML: {error}") from error
    return found


def _check(value: Any) -> None:
    if isinstance(value, int) and not -MAX_INTEGER <= value < MAX_INTEGER:
        raise ValueError("a whole number beyond 64 bits")
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check(one)
