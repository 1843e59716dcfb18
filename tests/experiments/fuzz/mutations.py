"""Inputs without coverage: a seed changed at a few places, by a generator with a seed of its own.

Half as good a guide as atheris, but at home everywhere: what the tests run for a moment in every run, and what
``python -m tests.experiments.fuzz --engine random`` runs where atheris has no wheel.
"""

import random
from collections.abc import Iterator, Sequence
from typing import Final

from tests.experiments.fuzz.target import Target

EDGES: Final = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0" * 8, b"\xff" * 8)
KEPT: Final = 200


def inputs(target: Target, n: int, seed: int) -> Iterator[bytes]:
    """The seeds themselves, then so many more."""
    rng = random.Random(f"{target.name} {seed}")
    pool = [b"", *(one[: target.size] for one in target.seeds())][:KEPT]
    yield from pool[:n]
    for _ in range(n - len(pool)):
        data = rng.choice(pool)
        for _ in range(rng.randint(1, 6)):
            data = _changed(rng, data, pool, target.words)
        yield data[: target.size]


def _changed(rng: random.Random, data: bytes, pool: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    at = rng.randint(0, len(data))
    to = min(at + rng.choice((1, 1, 2, 4, 8, 64)), len(data))
    kind = rng.randrange(8)
    if kind == 0 and at < len(data):  # one bit
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 1:  # a number at its edge
        edge = rng.choice(EDGES)
        return data[:at] + edge + data[at + len(edge) :]
    if kind == 2:
        return data[:at] + data[to:]
    if kind == 3:
        return data[:at] + data[at:to] * rng.randint(2, 5) + data[to:]
    if kind == 4:
        return data[:at] + rng.randbytes(rng.randint(1, 8)) + data[to:]
    if kind == 5:
        return data[:at]
    if kind == 6:
        return data[:at] + rng.choice(pool)[rng.randint(0, at) :]
    return data[:at] + (rng.choice(words) if words else rng.choice(EDGES)) + data[at:]
