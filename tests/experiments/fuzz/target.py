"""What a target is, and all of them, found by listing ``tests/experiments/fuzz/targets``."""

import importlib
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

Check = Callable[[bytes], None]
Seeds = Callable[[], Iterable[bytes]]

_KNOWN: Final[dict[str, "Target"]] = {}


@dataclass(frozen=True)
class Target:
    """One reader, and how it is tried."""

    name: str
    check: Check  # raises where the reader broke its word
    seeds: Seeds  # inputs to begin with, made by the project's own writers
    size: int  # bytes of the longest input
    words: tuple[bytes, ...] = ()  # what the reader's language is made of


def target(
    name: str, seeds: Seeds | Iterable[bytes] = (), size: int = 1024, words: Iterable[str | bytes] = ()
) -> Callable[[Check], Check]:
    """Make a target of a function of bytes."""
    given = seeds if callable(seeds) else tuple(seeds)

    def add(check: Check) -> Check:
        assert name not in _KNOWN or _KNOWN[name].check.__module__ == check.__module__, f"two targets {name}"
        every: Seeds = given if callable(given) else lambda: given
        tokens = tuple(word.encode() if isinstance(word, str) else word for word in words)
        _KNOWN[name] = Target(name, check, every, size, tokens)
        return check

    return add


def targets() -> dict[str, Target]:
    """Every target by name; imports all modules of the folder."""
    from tests.experiments.fuzz import targets as folder

    for module in pkgutil.iter_modules(folder.__path__):
        importlib.import_module(f"{folder.__name__}.{module.name}")
    return dict(sorted(_KNOWN.items()))
