"""TOML parser for configuration files and noise models.

Integers are limited to 64 bits, which is the range that the TOML standard guarantees.
"""

import tomllib
from typing import Any, Final

from drivers.errors import ConfigError

MAX_INTEGER: Final = 1 << 63


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text into nested dictionaries.

    >>> parse_toml("a = 1")
    {'a': 1}

    Raises
    ------
    ConfigError
        If the text is not valid TOML, is nested too deeply, or contains an integer of more than 64 bits.
    """
    try:
        found = tomllib.loads(text)
        _check(found)
    except RecursionError as error:
        raise ConfigError("not TOML: nested too deep") from error
    except ValueError as error:  # also for a number of thousands of digits or an invalid date
        raise ConfigError(f"not TOML: {error}") from error
    return found


def _check(value: Any) -> None:
    if isinstance(value, int) and not -MAX_INTEGER <= value < MAX_INTEGER:
        raise ValueError("an integer of more than 64 bits")
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check(one)
