"""Fuzz targets, which are found by listing ``tests/experiments/fuzz/targets``."""

import importlib
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

Check = Callable[[bytes], None]
Seeds = Callable[[], Iterable[bytes]]

_TARGETS: Final[dict[str, "Target"]] = {}


@dataclass(frozen=True)
class Target:
    """Reader of external data, with its checks and its first inputs."""

    name: str
    check: Check  # raises an exception if the reader violates a condition
    seeds: Seeds  # first inputs, from the project's own writers
    size: int  # length of the longest input in bytes
    words: tuple[bytes, ...] = ()  # words that occur in inputs of the reader


def target(
    name: str, seeds: Seeds | Iterable[bytes] = (), size: int = 1024, words: Iterable[str | bytes] = ()
) -> Callable[[Check], Check]:
    """Register a function of bytes as a fuzz target."""
    fixed_seeds = seeds if callable(seeds) else tuple(seeds)

    def add(check: Check) -> Check:
        assert name not in _TARGETS or _TARGETS[name].check.__module__ == check.__module__, f"two targets {name}"
        all_seeds: Seeds = fixed_seeds if callable(fixed_seeds) else lambda: fixed_seeds
        tokens = tuple(word.encode() if isinstance(word, str) else word for word in words)
        _TARGETS[name] = Target(name, check, all_seeds, size, tokens)
        return check

    return add


def load_targets() -> dict[str, Target]:
    """Import all modules of the folder and return all targets by name."""
    from tests.experiments.fuzz import targets as folder

    for module in pkgutil.iter_modules(folder.__path__):
        importlib.import_module(f"{folder.__name__}.{module.name}")
    return dict(sorted(_TARGETS.items()))
