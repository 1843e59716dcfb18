"""TOML parser for configuration files and noise models.

Integers are limited to 64 bits, which is the range that the TOML standard guarantees.
"""

import re
import tomllib
from typing import Any, Final

from drivers.errors import ConfigError

MAX_INTEGER: Final = 1 << 63
MAX_LEVELS: Final = 64
"""Maximum number of nested levels of tables and arrays."""
DEEP_KEY: Final = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++\s*\.\s*){{{MAX_LEVELS}}}")
"""Key with too many levels, which the parser of the standard library reads in quadratic time."""


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
        if DEEP_KEY.search(text):
            raise RecursionError
        found = tomllib.loads(text)
        _check(found)
    except RecursionError as error:
        raise ConfigError(f"not TOML: nested too deep, at most {MAX_LEVELS} levels are supported") from error
    except ValueError as error:  # also for a number of thousands of digits or an invalid date
        raise ConfigError(f"not TOML: {error}") from error
    return found


def _check(value: Any, level: int = 0) -> None:
    if level > MAX_LEVELS:
        raise RecursionError
    if isinstance(value, int) and not -MAX_INTEGER <= value < MAX_INTEGER:
        raise ValueError("an integer of more than 64 bits")
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check(one, level + 1)
