"""Finds the members of a folder of plug-ins by listing it, imports one when asked for, and types its file keys."""

import importlib
import pkgutil
from collections.abc import Sequence
from difflib import SequenceMatcher, get_close_matches
from types import ModuleType
from typing import Annotated

import msgspec

from drivers.errors import ConfigError

FilePath = Annotated[str, msgspec.Meta(extra={"file": "exists"})]
"""A key that names a file which must be there; relative ones are meant beside the configuration file."""
FileOrName = Annotated[str, msgspec.Meta(extra={"file": "or name"})]
"""A key that names a file beside the configuration file, or something that is shipped."""


def names(package: ModuleType, suffix: str = "") -> tuple[str, ...]:
    """Names of the members of ``package``, sorted, without their suffix; ``base`` is none of them."""
    found = (module.name for module in pkgutil.iter_modules(package.__path__))
    return tuple(sorted(n.removesuffix(suffix) for n in found if n != "base" and n.endswith(suffix)))


def load(package: ModuleType, name: str, suffix: str = "") -> ModuleType:
    """The module of one member; ConfigError with all names, the nearest first, when there is none."""
    known = names(package, suffix)
    if name not in known:
        raise ConfigError(f'unknown name "{name}"{possible(name, known)}')
    return importlib.import_module(f"{package.__name__}.{name}{suffix}")


def nearest(word: str, known: Sequence[str]) -> str:
    """The end of an error line about an unknown word: the nearest known one, or all of them."""
    close = get_close_matches(word, known, n=1, cutoff=0.5)
    return f'; did you mean "{close[0]}"?' if close else f"; known are {', '.join(known)}"


def possible(word: str, known: Sequence[str]) -> str:
    """Return the end of an error line about a word that is none of ``known``: all of them, the nearest first.

    >>> possible("serail", ("can", "serial"))
    '; possible are serial, can'
    """
    near = {one: SequenceMatcher(None, word.lower(), one.lower()).ratio() for one in known}
    return f"; possible are {', '.join(sorted(known, key=lambda one: -near[one]))}"
