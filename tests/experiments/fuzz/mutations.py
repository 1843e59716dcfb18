"""Random inputs without coverage: valid inputs with a few changed bytes.

Random inputs reach fewer branches than those of atheris, but they need no extra package. The tests use them, and so
does ``python -m tests.experiments.fuzz --engine random`` on systems without atheris.
"""

import random
from collections.abc import Iterator, Sequence
from typing import Final

from tests.experiments.fuzz.target import Target

EDGES: Final = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0" * 8, b"\xff" * 8)
MAX_POOL_SIZE: Final = 200


def generate_inputs(target: Target, n: int, seed: int) -> Iterator[bytes]:
    """Generate ``n`` inputs: first the seeds of the target, then mutations of the seeds."""
    rng = random.Random(f"{target.name} {seed}")
    pool = [b"", *(data[: target.size] for data in target.seeds())][:MAX_POOL_SIZE]
    yield from pool[:n]
    for _ in range(n - len(pool)):
        data = rng.choice(pool)
        for _ in range(rng.randint(1, 6)):
            data = _mutate(rng, data, pool, target.words)
        yield data[: target.size]


def _mutate(rng: random.Random, data: bytes, pool: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    at = rng.randint(0, len(data))
    to = min(at + rng.choice((1, 1, 2, 4, 8, 64)), len(data))
    kind = rng.randrange(8)
    if kind == 0 and at < len(data):  # one bit
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 1:  # a number at the end of its range
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
