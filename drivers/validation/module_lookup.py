"""Functions that list and import the modules of a package and suggest corrections of misspelled names."""

import importlib
import pkgutil
from collections.abc import Sequence
from difflib import SequenceMatcher, get_close_matches
from functools import cache
from pathlib import Path
from types import ModuleType

from drivers.errors import ConfigError


def list_modules(package: ModuleType, suffix: str = "") -> tuple[str, ...]:
    """Return the sorted names of the modules of a package that end with a suffix.

    Parameters
    ----------
    package
        Package that contains the modules. If it has the attribute ``SUBPACKAGES``, the modules of those subpackages are
        included. suffix End of the module names, such as "_link". The suffix is removed from the returned names.

    Returns
    -------
    tuple of str
        Sorted names. A module named ``base`` is omitted.
    """
    return tuple(sorted(_find_modules(package, suffix)))


def import_module(package: ModuleType, name: str, suffix: str = "") -> ModuleType:
    """Import one module of a package.

    Parameters
    ----------
    package
        Package that contains the module, as for ``list_modules``.
    name
        Name of the module without its suffix.
    suffix
        End of the module name, such as "_link".

    Raises
    ------
    ConfigError
        If the module does not exist. The error text lists all names, beginning with the most similar name.
    """
    paths = _find_modules(package, suffix)
    if name not in paths:
        raise ConfigError(f'unknown name "{name}"{format_choices_by_similarity(name, tuple(sorted(paths)))}')
    return importlib.import_module(paths[name])


@cache
def _find_modules(package: ModuleType, suffix: str) -> dict[str, str]:
    """Return the name without suffix and the import path of each module of a package and of its ``SUBPACKAGES``."""
    subpackages: tuple[str, ...] = getattr(package, "SUBPACKAGES", ())
    paths = {}
    for subpackage in ("", *subpackages):
        folders = [str(Path(folder, subpackage)) for folder in package.__path__]
        for module in pkgutil.iter_modules(folders):
            if module.name not in ("base", *subpackages) and module.name.endswith(suffix):
                path = ".".join(filter(None, (package.__name__, subpackage, module.name)))
                paths[module.name.removesuffix(suffix)] = path
    return paths


def format_suggestion(word: str, known: Sequence[str]) -> str:
    """Return the end of an error message that suggests the most similar known word.

    If no known word is similar, the text lists all known words.

    Parameters
    ----------
    word
        The unknown word.
    known
        All known words.

    >>> format_suggestion("serail", ("can", "serial"))
    '; did you mean "serial"?'
    """
    close = get_close_matches(word, known, n=1, cutoff=0.5)
    return f'; did you mean "{close[0]}"?' if close else f"; known are {', '.join(known)}"


def format_choices_by_similarity(word: str, known: Sequence[str]) -> str:
    """Return the end of an error message that lists all known words, beginning with the most similar word.

    Parameters
    ----------
    word
        The unknown word.
    known
        All known words.

    >>> format_choices_by_similarity("serail", ("can", "serial"))
    '; possible are serial, can'
    """
    near = {one: SequenceMatcher(None, word.lower(), one.lower()).ratio() for one in known}
    return f"; possible are {', '.join(sorted(known, key=lambda one: -near[one]))}"
